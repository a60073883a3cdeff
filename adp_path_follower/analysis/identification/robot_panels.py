"""The robot's model over the course of a recorded run, and what it explains."""

from collections.abc import Mapping

import numpy as np

from adp_path_follower.analysis.identification.recording import Recording
from adp_path_follower.analysis.identification.response import modelled
from adp_path_follower.analysis.recorded_run import Drive
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.model import RobotModel
from adp_path_follower.drawing.charts import Line, Panel, line_of

# Label of a panel -> the recorded numbers that it shows, and half of the least span of its axis.
_PANELS = {
    "times [s]": (("delay [s]", "linear lag [s]", "angular lag [s]"), 0.05),
    "gains": (("k_v", "k_w"), 0.02),
    "bias [rad/m]": (("bias [rad/m]",), 0.02),
}
_ROOM = 1.1  # span of an axis as a multiple of what it shows
_RAMPS = ("ramp [m/s^2]", "angular ramp [rad/s^2]")


def robot_panels(drive: Drive, buckets: int) -> dict[str, tuple[Panel, ...]]:
    """Return the parameters over time, and measured beside modelled velocities, where recorded."""
    told = drive.learner.get("robot_model")
    names = [name for shown, _ in _PANELS.values() for name in shown]
    if told is None or not {*names, *_RAMPS} <= {*told.labels} or not len(told.time):
        return {}
    if told.values.shape[1] != len(told.labels):
        return {}
    columns = dict(zip(told.labels, told.values.T, strict=True))
    edges = {name: _edges(columns, name) for name in names}

    def lines(name: str) -> list[Line]:
        around = [line_of(name, told.time, edge, buckets, background=True) for edge in edges[name]]
        return [*around, line_of(name.partition(" [")[0], told.time, columns[name], buckets)]

    def span(shown: tuple[str, ...], least: float) -> tuple[float, float] | None:
        parts = [part for name in shown for part in (columns[name], *(e[-1:] for e in edges[name]))]
        return _span(np.concatenate(parts), least)

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
            Panel(
                label,
                tuple(line for name in shown for line in lines(name)),
                span=span(shown, least),
            )
            for label, (shown, least) in _PANELS.items()
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


def _edges(columns: Mapping[str, FloatArray], name: str) -> list[FloatArray]:
    """Return two deviations below and above a number; nothing if driving did not narrow them."""
    spread = columns.get(f"deviation of {name}", np.zeros(len(columns[name])))
    narrowed = bool((spread < spread[0]).any())
    return [columns[name] + sign * 2.0 * spread for sign in (-1.0, 1.0)] if narrowed else []


def _span(values: FloatArray, least: float) -> tuple[float, float] | None:
    """Return the axis of values with their last deviations, for the first ones may be huge."""
    if not np.isfinite(values).all():
        return None
    middle = 0.5 * float(values.min() + values.max())
    half = max(_ROOM * (float(values.max()) - middle), least)
    return middle - half, middle + half
