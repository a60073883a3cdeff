"""The figures of a replayed run."""

from pathlib import Path as FilePath

import numpy as np
from matplotlib.figure import Figure

from adp_path_follower.bags.columns import Series
from adp_path_follower.bags.reader import Run
from adp_path_follower.drawing.figure_style import COLORS
from adp_path_follower.drawing.run_figures import RunView, save_figures
from adp_path_follower.study.replay.replay import Replay


def view_of_replay(run: Run, replay: Replay) -> RunView:
    """Return the view of a recorded run: its weights as recorded, the rest as replayed."""
    start, time = replay.stamp[0], replay.time
    nothing = Series(np.zeros(0, dtype=np.int64), np.zeros((0, 0)))
    critic = run.series.get("critic_weights", nothing)
    actor = run.series.get("actor_weights", nothing)
    count = min(len(critic.stamp), len(actor.stamp))
    # Weights carry no stamp. With one message for each step they belong to the steps in order;
    # else the time of their arrival, which lags, must do.
    every_step = count == len(time)
    return RunView(
        time=time,
        path=replay.follower.path.points(0.05)[:, :2],
        track=replay.pose,
        target=np.array([output.target_pose[:2] for output in replay.outputs]),
        error=np.array([output.error for output in replay.outputs]),
        modified_input=np.array([output.modified_input for output in replay.outputs]),
        weight_time=time if every_step else (critic.stamp[:count] - start) * 1e-9,
        critic_weights=critic.values[:count],
        actor_weights=actor.values[:count],
        labels=critic.labels,
    )


def draw_replay(replay: Replay, file: FilePath) -> None:
    """Draw recorded and replayed commands over time."""
    save_figures({file.name: lambda: _figure(replay)}, file.parent)


def _figure(replay: Replay) -> Figure:
    time = replay.time
    figure = Figure(figsize=(9.0, 5.0))
    panels = figure.subplots(2, 1, sharex=True)
    for column, (axes, label) in enumerate(zip(panels, ("v [m/s]", "ω [rad/s]"), strict=True)):
        axes.plot(time, replay.recorded[:, column], color="0.6", linewidth=3, label="recorded")
        axes.plot(time, replay.replayed[:, column], color=COLORS[1], label="replayed")
        axes.set_ylabel(label)
    panels[0].set_title("Commands to the recorded odometry")
    panels[0].legend()
    panels[1].set_xlabel("time [s]")
    return figure
