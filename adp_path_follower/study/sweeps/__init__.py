"""Parameter sweeps and tuning on local or cluster workers.

May import `study.simulation`, `study.optimum` and all rooms below; needs the extra `sweep`.
Never runs nodes.
"""
