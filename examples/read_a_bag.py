"""Read a recorded run: `python examples/read_a_bag.py BAG`, of any controller."""

import sys

import adp_path_follower as adp


def main(bag: str) -> None:
    """Print how well the robot kept to the path, and what happened."""
    run = adp.analyze(bag)
    print(run)
    for name in ("cross_track_max", "heading_rms", "command_rate", "latency_p99"):
        print(f"{name:20} {run.metrics[name]:.4g}")
    for event in run.events[:5]:
        print(f"{event.time:8.2f} s  {event.text}")


if __name__ == "__main__":
    main(*sys.argv[1:])
