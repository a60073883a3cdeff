"""The robot of some bags: its parameters with intervals, and those that the drive did not tell."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from adp_path_follower.analysis.identification.estimate import Estimate
from adp_path_follower.analysis.identification.gains import fit_gains
from adp_path_follower.analysis.identification.recording import Recording
from adp_path_follower.analysis.identification.response import fit_response, modelled
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.model import RobotModel
from adp_path_follower.core.robot.robot import settings_of
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build, flatten, yaml_text
from sim_unicycle.settings import SimulatorSettings

_LITTLE = 0.5  # share of the velocities; a model that explains less is none
_RECKONED = 1e-3  # [m]: a localised pose has more noise, beside the encoders
_WELL = {"delay": 0.05, "linear lag": 0.08, "angular lag": 0.08, "k_v": 0.03, "k_w": 0.05}
_WELL["bias"] = 0.03
# Parameter -> its unit, and the drive that would tell it.
_DRIVES = {
    "delay": ("s", "start, stop and turn to both sides"),
    "linear lag": ("s", "start and stop several times"),
    "angular lag": ("s", "turn to both sides, as in a slalom"),
    "k_v": ("", "drive some metres with a localised pose"),
    "k_w": ("", "turn to both sides, as in a slalom"),
    "bias": ("rad/m", "drive straight as well as turns to both sides"),
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

    @property
    def missing(self) -> tuple[Parameter, ...]:
        """Return the parameters that the drive did not tell."""
        return tuple(item for item in self.parameters if item.drive)

    def value(self, name: str) -> float:
        """Return a parameter, NaN where it was not measured."""
        found = (item.value for item in self.parameters if item.name == name and not item.drive)
        return next(found, math.nan)

    def yaml(self) -> str:
        """Return parameter files of a controller that is given the model, and of a simulator."""
        model, robot = self.model, {"robot_model": "given", **settings_of(self.model)}
        simulated: dict[str, object] = {
            "command_ramp": model.ramp,
            "command_delay": model.delay,
            "velocity_lag": model.linear_lag,
            "angular_lag": model.angular_lag,
            "gains": (model.linear_gain, model.angular_gain),
            "bias": model.bias,
            "encoder_noise": (self.value("noise of v"), self.value("noise of w")),
        }
        for name, key in (
            ("position_noise", "noise of x, y"),
            ("heading_noise", "noise of heading"),
            ("odometry_rate", "odometry rate"),
            ("odometry_delay", "odometry latency"),
            ("odometry_jitter", "odometry jitter"),
        ):
            if math.isfinite(self.value(key)):
                simulated[name] = self.value(key)
        text = _section("path_follower", Settings, robot)
        return text + _section("unicycle_sim", SimulatorSettings, simulated)


def _section(node: str, tree: type, values: dict[str, object]) -> str:
    """Return a node's section of a parameter file; SettingsError for what it does not take."""
    rounded = {name: _rounded(value) for name, value in values.items()}
    known = flatten(build(tree, rounded))
    lines = [f"/**/{node}:", "  ros__parameters:"]
    return "\n".join([*lines, *(f"    {name}: {yaml_text(known[name])}" for name in values), ""])


def _rounded(value: object) -> object:
    if isinstance(value, tuple):
        return tuple(_rounded(item) for item in value)
    return float(f"{value:.5g}") if isinstance(value, float) else value


def identify(recordings: Sequence[Recording]) -> Identification:
    """Return the robot of some recordings of it."""
    response, gains = fit_response(recordings), fit_gains(recordings)
    names = tuple(_WELL)
    parts = [*(_named(name, response.values, at) for at, name in enumerate(names[:3]))]
    parts += [_named(name, gains.values, at) for at, name in enumerate(names[3:])]
    told = {item.name: item.value for item in parts if not item.drive}
    slow, (least, most) = float(response.values.values[3]), response.values.interval(3)
    ramped = least > 0.0 and slow > 0.02 and "linear lag" in told
    if ramped:
        parts.insert(3, Parameter("ramp", "m/s²", 1.0 / slow, 1.0 / most, 1.0 / least))
    model = RobotModel(
        delay=told.get("delay", 0.0),
        linear_lag=told.get("linear lag", 0.0),
        angular_lag=told.get("angular lag", 0.0),
        ramp=1.0 / slow if ramped else math.inf,
        linear_gain=told.get("k_v", 1.0),
        angular_gain=told.get("k_w", 1.0),
        bias=told.get("bias", 0.0),
    )
    count = sum(len(item.time) for item in recordings)
    noises = (*zip(("noise of v", "noise of w"), ("m/s", "rad/s"), response.noise, strict=True),)
    noises += (*zip(("noise of x, y", "noise of heading"), ("m", "rad"), gains.noise, strict=True),)
    parts += [_deviation(name, unit, size, count) for name, unit, size in noises]
    parts += _odometry(recordings)
    notes = [note for item in recordings for note in item.notes]
    excited = [name in told for name in ("linear lag", "angular lag")]
    explained = np.where(excited, response.explained, math.nan)
    low = [name for name, share in zip("vω", explained, strict=True) if share < _LITTLE]
    if low:
        notes.append(
            f"the model explains less than half of {' and '.join(low)}: are these the commands "
            "that the robot gets, and is it limited behind them?"
        )
    if gains.noise[0] < _RECKONED:
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


def _named(name: str, found: Estimate, index: int) -> Parameter:
    """Return a parameter of the model, or which drive would tell it."""
    unit, drive = _DRIVES[name]
    low, high = found.interval(index)
    told = 0.5 * (high - low) <= _WELL[name]
    if unit == "s":
        low = max(low, 0.0)
    return Parameter(name, unit, float(found.values[index]), low, high, "" if told else drive)


def _deviation(name: str, unit: str, size: float, count: int) -> Parameter:
    """Return a standard deviation of so many numbers, with its interval."""
    low, high = size * np.sqrt((count - 1) / chi2.ppf([0.975, 0.025], count - 1))
    return Parameter(name, unit, float(size), float(low), float(high))


def _odometry(recordings: Sequence[Recording]) -> list[Parameter]:
    """Return rate, latency and jitter of the odometry, as far as they are known."""
    periods = np.concatenate([np.diff(item.time) for item in recordings])
    found = [_mean("odometry period", "s", periods[periods < 3.0 * np.median(periods)])]
    period = found[0]
    found[0] = Parameter(
        "odometry rate", "Hz", 1.0 / period.value, 1.0 / period.high, 1.0 / period.low
    )
    late = np.concatenate([item.latency for item in recordings])
    if len(late) > 1:
        found.append(_mean("odometry latency", "s", late))
        found.append(_deviation("odometry jitter", "s", float(np.std(late)), len(late)))
    return found


def _mean(name: str, unit: str, values: FloatArray) -> Parameter:
    half = 1.96 * float(np.std(values)) / math.sqrt(len(values))
    mean = float(np.mean(values))
    return Parameter(name, unit, mean, mean - half, mean + half)
