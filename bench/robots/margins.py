"""Measure how soon a learned model serves, which delays and lags are borne, and faults meanwhile.

python bench/robots/margins.py [serves|margins|noise|faults ...]
"""

from __future__ import annotations

import math
import sys
from dataclasses import astuple, replace

import numpy as np
from drives import Outcome, drive, ours, start_pose
from paths import bend
from plants import STEP, AnalyticPlant, Odometry
from random_robots import Case
from robots import TYPICAL, Robot

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.robot.model import IDEAL, RobotModel, RobotState, advanced
from adp_path_follower.core.robot.robot import settings_of
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

_SERVES = 0.25  # share of what the ideal model misses that one which serves may miss
_OVERSHOOT, _SWING = 0.25, 0.01  # of the first distance, and [m] beside the path after 10 s
_BEGIN, _END = 3.0, 4.0  # [s] of a fault


def model_of(robot: Robot) -> RobotModel:
    """Return the model of a robot of the analytic plant."""
    gain, turn_gain, bias = robot.gains
    ramp, turn_ramp = robot.ramps
    return RobotModel(robot.delay, robot.lag, robot.lag, ramp, gain, turn_gain, bias, turn_ramp)


def tuned(kind: str, robot: Robot) -> Settings:
    """Return settings with a kind of model."""
    given = settings_of(model_of(robot)) if kind == "given" else {}
    return build(Settings, {**given, "robot_model": kind})


def missed(truth: RobotModel, model: RobotModel, command: tuple[float, float]) -> float:
    """Return how far apart both models are after 1 s of a command from rest [m]."""
    ends = []
    for each in (truth, model):
        held = [(0.0, 0.0, each.delay), (*command, 1.0 - each.delay)]
        ends.append(astuple(advanced(each, RobotState(0.0, 0.0, 0.0), held))[:3])
    return math.dist(*ends)


def time_to_serve(case: Case) -> float:
    """Return after which time of driving a learned model misses little of what the ideal misses."""
    truth, command, late = model_of(case.robot), (case.speed, 0.5), 0.0

    def look(time: float, driver: Driver, output: object) -> None:
        nonlocal late
        if missed(truth, driver.robot.model, command) > _SERVES * missed(truth, IDEAL, command):
            late = time

    settings = case.settings()
    drive(case.plant(), ours(settings, case.path, look), case.path, settings, 12.0)
    return late


def serves() -> None:
    """Print when the models of 20 robots serve."""
    times = [time_to_serve(Case(seed)) for seed in range(20)]
    print(
        f"serves after {np.median(times):.1f} s, 90 % after {np.quantile(times, 0.9):.1f} s", times
    )


def steady(kind: str, delay: float, lag: float) -> bool:
    """Return whether a robot comes to a line from 0.3 m without much overshoot or swing."""
    robot, path = Robot(delay=delay, lag=lag), named_path("line")
    settings = tuned(kind, robot)
    outcome = drive(
        AnalyticPlant(robot, start_pose(path, (0.0, 0.3, 0.0))),
        ours(settings, path),
        path,
        settings,
        14.0,
    )
    across, late = outcome.trace[:, 8], outcome.trace[:, 0] > 10.0
    return bool(
        late.any() and across.min() > -_OVERSHOOT * 0.3 and np.abs(across[late]).max() < _SWING
    )


def margins() -> None:
    """Print the longest delay [s] that is borne with some lags."""
    for lag in (0.0, 0.15, 0.3, 0.6):
        found = {}
        for kind in ("ideal", "learned", "given"):
            low, high = 0.0, 1.0
            while high - low > 0.04:
                middle = 0.5 * (low + high)
                low, high = (middle, high) if steady(kind, middle, lag) else (low, middle)
            found[kind] = round(low, 2)
        print(f"lag {lag} s: longest delay", found, flush=True)


def noise() -> None:
    """Print the total variation of the steering with 1 cm and 1 degree of noise."""
    noisy = {"position_noise": 0.01, "heading_noise": math.radians(1.0), "angular_noise": 0.02}
    for name, robot in (("typical", replace(TYPICAL, **noisy)), ("ideal", Robot(**noisy))):
        shown(name, {kind: driven(kind, AnalyticPlant, robot) for kind in ("ideal", "learned")})


class Faulty(AnalyticPlant):
    """A robot with a fault for a second."""

    kind = ""

    def step(self, command: FloatArray) -> None:
        """Move; it is carried 0.3 m aside, or its wheels spin."""
        before, fault = self.pose, self.kind if _BEGIN <= self.time < _END else ""
        super().step(command)
        if fault == "carried":
            self.pose = before + np.array([0.0, 0.3 * STEP, 0.0])
        if fault == "slip":
            self.pose = before + 0.5 * (self.pose - before)

    def arrived(self) -> list[Odometry]:
        """Return the odometry, which jumps, fails or contradicts the commands."""
        found, fault = super().arrived(), self.kind if _BEGIN <= self.time < _END else ""
        if fault == "dropout":
            return []
        if fault == "jump":
            return [replace(one, pose=one.pose + np.array([0.0, 0.3, 0.2])) for one in found]
        if self.kind == "sign":
            return [replace(one, twist=one.twist * [1.0, -1.0]) for one in found]
        return found


def driven(kind: str, plant: type[AnalyticPlant], robot: Robot) -> Outcome:
    """Return the outcome of a drive round the bend."""
    path, settings = bend(), tuned(kind, robot)
    return drive(
        plant(robot, start_pose(path, (0.0, 0.1, -0.2))), ours(settings, path), path, settings, 20.0
    )


def shown(name: str, found: dict[str, Outcome]) -> None:
    """Print outcomes."""
    for kind, one in found.items():
        farthest = np.abs(one.trace[:, 8]).max()
        print(
            f"{name:8s} {kind:8s} J {one.cost:.3f} RMS {1e3 * one.rms:.1f} mm, "
            f"at most {1e3 * farthest:.0f} mm, variation {one.variation:.2f}",
            flush=True,
        )


def faults() -> None:
    """Print what faults while identifying lead to."""
    for fault in ("none", "jump", "dropout", "carried", "slip", "sign"):
        plant = type("Plant", (Faulty,), {"kind": fault})
        shown(fault, {kind: driven(kind, plant, TYPICAL) for kind in ("ideal", "learned")})


if __name__ == "__main__":
    for wanted in sys.argv[1:] or ("serves", "margins", "noise", "faults"):
        globals()[wanted]()
