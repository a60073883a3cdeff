"""The robot's model over the course of a recorded run, and what it explains."""

import numpy as np

from adp_path_follower.analysis.identification.recording import Recording
from adp_path_follower.analysis.identification.response import modelled
from adp_path_follower.analysis.recorded_run import Drive
from adp_path_follower.core.robot.model import RobotModel
from adp_path_follower.drawing.charts import Line, Panel, line_of

# Label of a panel -> the recorded numbers that it shows.
_PANELS = {
    "times [s]": ("delay [s]", "linear lag [s]", "angular lag [s]"),
    "gains": ("k_v", "k_w"),
    "bias [rad/m]": ("bias [rad/m]",),
}
_RAMPS = ("ramp [m/s^2]", "angular ramp [rad/s^2]")


def robot_panels(drive: Drive, buckets: int) -> dict[str, tuple[Panel, ...]]:
    """Return the parameters over time, and measured beside modelled velocities, where recorded."""
    told = drive.learner.get("robot_model")
    names = [name for shown in _PANELS.values() for name in shown]
    if told is None or not {*names, *_RAMPS} <= {*told.labels} or not len(told.time):
        return {}
    if told.values.shape[1] != len(told.labels):
        return {}
    columns = dict(zip(told.labels, told.values.T, strict=True))

    def lines(name: str) -> list[Line]:
        spread = columns.get(f"deviation of {name}", np.zeros(len(told.time)))
        edges = [columns[name] + sign * 2.0 * spread for sign in (-1.0, 1.0)]
        around = [line_of(name, told.time, edge, buckets, background=True) for edge in edges]
        return [*around, line_of(name.partition(" [")[0], told.time, columns[name], buckets)]

    last = {name: float(values[-1]) for name, values in columns.items()}
    model = RobotModel(
        delay=last["delay [s]"],
        linear_lag=last["linear lag [s]"],
        angular_lag=last["angular lag [s]"],
        ramp=last[_RAMPS[0]],
        angular_ramp=last[_RAMPS[1]],
    )
    time, values = drive.odometry.time, drive.odometry.values
    found = {
        "robot_model": tuple(
            Panel(label, tuple(line for name in shown for line in lines(name)))
            for label, shown in _PANELS.items()
        )
    }
    if len(drive.commands.time) and np.isfinite([*last.values()][:3]).all():
        sent, commands = drive.commands.time, drive.commands.values
        poses, encoders = values[:, :3], values[:, 3:]
        recording = Recording(sent, commands, time, poses, encoders, False, sent[:0], ())
        answer = modelled(recording, model)
        found["robot_velocity"] = tuple(
            Panel(
                label,
                (
                    line_of("measured", time, values[:, 3 + part], buckets),
                    line_of("model", time, answer[:, part], buckets),
                ),
            )
            for part, label in enumerate(("v [m/s]", "ω [rad/s]"))
        )
    return found
