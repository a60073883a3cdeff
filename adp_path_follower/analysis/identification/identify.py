"""The robot of some bags: its parameters with intervals, and those that the drive did not tell."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from scipy.stats import chi2

from adp_path_follower.analysis.identification.estimate import Estimate
from adp_path_follower.analysis.identification.gains import fit_gains
from adp_path_follower.analysis.identification.recording import Recording
from adp_path_follower.analysis.identification.response import fit_response, modelled
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.model import RobotModel
from adp_path_follower.core.robot.robot import settings_of

_LITTLE = 0.5  # share of the velocities; a model that explains less is none
_RECKONED = 1e-3  # [m]: a localised pose has more noise, beside the encoders
_NOISES = {"noise of v": "m/s", "noise of w": "rad/s", "noise of x, y": "m"}
_NOISES["noise of heading"] = "rad"
_SLALOM = "turn to both sides, as in a slalom"
# Parameter -> its unit, how wide half its interval may be, and the drive that would tell it.
_DRIVES = {
    "delay": ("s", 0.05, "start, stop and turn to both sides"),
    "linear lag": ("s", 0.08, "start and stop several times"),
    "angular lag": ("s", 0.08, _SLALOM),
    "k_v": ("", 0.03, "drive some metres with a localised pose"),
    "k_w": ("", 0.05, _SLALOM),
    "bias": ("rad/m", 0.03, "drive straight as well as turns to both sides"),
}


@dataclass(frozen=True)
class Parameter:
    """One property of a robot."""

    name: str
    unit: str
    value: float
    low: float  # of the interval of 95 %
    high: float
    drive: str = ""  # which drive would tell it, empty where this one does


@dataclass(frozen=True)
class Identification:
    """A robot as its bags tell it."""

    parameters: tuple[Parameter, ...]
    model: RobotModel  # with the parameters that the drive tells, the others as an ideal robot's
    # Share of the encoders' v and w that it explains, NaN where the drive does not tell.
    explained: tuple[float, float]
    # Time [s] (N,), measured v, w (N, 2) and those of the model, for each recording.
    courses: tuple[tuple[FloatArray, FloatArray, FloatArray], ...]
    notes: tuple[str, ...]  # sentences about data, and about how far to trust this

    def value(self, name: str) -> float:
        """Return a parameter, NaN where it was not measured."""
        found = (item.value for item in self.parameters if item.name == name and not item.drive)
        return next(found, math.nan)

    def parameter_file(self) -> str:
        """Return parameter files of a controller that is given the model, and of a simulator."""
        model = self.model
        simulated = {
            "command_ramps": model.ramps,
            "command_delay": model.delay,
            "velocity_lag": model.linear_lag,
            "angular_lag": model.angular_lag,
            "gains": (model.linear_gain, model.angular_gain),
            "bias": model.bias,
            "encoder_noise": (self.value("noise of v"), self.value("noise of w")),
            "position_noise": self.value("noise of x, y"),
            "heading_noise": self.value("noise of heading"),
            "odometry_rate": self.value("odometry rate"),
            "odometry_delay": self.value("odometry latency"),
            "odometry_jitter": self.value("odometry jitter"),
        }
        sections = {"path_follower": settings_of(model), "unicycle_sim": simulated}
        content = {
            f"/**/{node}": {"ros__parameters": _rounded(values)}
            for node, values in sections.items()
        }
        return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def _rounded(value: Any) -> Any:
    """Return numbers with five digits, without those that are not known."""
    if isinstance(value, dict):
        known = {name: item for name, item in value.items() if item == item}
        return {name: _rounded(item) for name, item in known.items()}
    if isinstance(value, tuple):
        return [_rounded(item) for item in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def identify(recordings: Sequence[Recording]) -> Identification:
    """Return the robot of some recordings of it."""
    response, encoder_noise, shares = fit_response(recordings)
    gains, pose_noise = fit_gains(recordings)
    found = zip(
        _DRIVES,
        np.append(response.values[:3], gains.values).tolist(),
        np.append(response.room[:3], gains.room).tolist(),
        strict=True,
    )
    parts = [_named(name, value, room) for name, value, room in found]
    told = {item.name: item.value for item in parts if not item.drive}
    ramps = _ramps(response, told)
    parts[3:3] = ramps.values()
    model = RobotModel(
        delay=told.get("delay", 0.0),
        linear_lag=told.get("linear lag", 0.0),
        angular_lag=told.get("angular lag", 0.0),
        ramp=ramps["linear"].value if "linear" in ramps else math.inf,
        angular_ramp=ramps["angular"].value if "angular" in ramps else math.inf,
        linear_gain=told.get("k_v", 1.0),
        angular_gain=told.get("k_w", 1.0),
        bias=told.get("bias", 0.0),
    )
    sizes = zip(_NOISES.items(), (*encoder_noise, *pose_noise), strict=True)
    count = sum(len(item.time) for item in recordings)
    parts += [_deviation(name, unit, float(size), count) for (name, unit), size in sizes]
    parts += _odometry(recordings)
    notes = [note for item in recordings for note in item.notes]
    excited = [name in told for name in ("linear lag", "angular lag")]
    explained = np.where(excited, shares, math.nan)
    low = [name for name, share in zip("vω", explained, strict=True) if share < _LITTLE]
    if low:
        notes.append(
            f"the model explains less than half of {' and '.join(low)}: are these the commands "
            "that the robot gets, and is it limited behind them?"
        )
    if pose_noise[0] < _RECKONED and not all(item.localised for item in recordings):
        notes.append(
            "the pose follows the encoders without noise: if it is their integral, gains and bias "
            "say nothing about the robot; name a localised pose by --pose"
        )
    return Identification(
        tuple(parts),
        model,
        (float(explained[0]), float(explained[1])),
        tuple((item.time, item.encoders, modelled(item, model)) for item in recordings),
        tuple(dict.fromkeys(notes)),
    )


def _ramps(fitted: Estimate, told: Iterable[str]) -> dict[str, Parameter]:
    """Return the ramps of the firmware that a drive tells, by the part of the motion."""
    found = {}
    parts = {"linear": ("m/s²", 0.02), "angular": ("rad/s²", 0.01)}  # and what is no ramp
    sizes = zip(parts.items(), fitted.values[3:].tolist(), fitted.room[3:].tolist(), strict=True)
    for (part, (unit, least)), slow, room in sizes:
        if slow > max(1.5 * room, least) and f"{part} lag" in told:
            edges = 1.0 / slow, 1.0 / (slow + room), 1.0 / (slow - room)
            found[part] = Parameter(f"{part} ramp", unit, *edges)
    return found


def _named(name: str, value: float, room: float) -> Parameter:
    """Return a parameter of the model, or which drive would tell it."""
    unit, most, drive = _DRIVES[name]
    low = max(value - room, 0.0) if unit == "s" else value - room
    return Parameter(name, unit, value, low, value + room, "" if room <= most else drive)


def _deviation(name: str, unit: str, size: float, count: int) -> Parameter:
    """Return a standard deviation of so many numbers, with its interval."""
    low, high = size * np.sqrt((count - 1) / chi2.ppf([0.975, 0.025], count - 1))
    return Parameter(name, unit, float(size), float(low), float(high))


def _odometry(recordings: Sequence[Recording]) -> list[Parameter]:
    """Return rate, latency and jitter of the odometry, as far as they are known."""
    periods = np.concatenate([np.diff(item.time) for item in recordings])
    period = _mean("", "", periods[periods < 3.0 * np.median(periods)])
    rate = 1.0 / period.value, 1.0 / period.high, 1.0 / period.low
    found = [Parameter("odometry rate", "Hz", *rate)]
    late = np.concatenate([item.latency for item in recordings])
    if len(late) > 1:
        found.append(_mean("odometry latency", "s", late))
        found.append(_deviation("odometry jitter", "s", float(np.std(late)), len(late)))
    return found


def _mean(name: str, unit: str, values: FloatArray) -> Parameter:
    half = 1.96 * float(np.std(values)) / math.sqrt(len(values))
    mean = float(np.mean(values))
    return Parameter(name, unit, mean, mean - half, mean + half)
