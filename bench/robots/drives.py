"""Drive robots along paths, and what that costs along the true motion."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from plants import STEP, Odometry, Plant

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.cost import RunningCost
from adp_path_follower.core.control.virtual_target import VirtualTarget
from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.geometry import FloatArray, advance_pose, pose_in_frame
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.speed_profile import SpeedProfile, SpeedReference
from adp_path_follower.core.settings.groups import Settings

PERIOD = 0.01  # [s] of control
SETTLED = 8.0  # [s] after which the distance counts

# From the time [s] and the last odometry: the command.
Control = Callable[[float, Odometry], FloatArray]


@dataclass(frozen=True)
class Outcome:
    """The cost of a drive.

    Attributes:
        cost: J along the true motion.
        rms: Root mean square of the true distance from the path after `SETTLED` [m].
        variation: Total variation of the commanded turn rate per second after it [rad/s^2].
        trace: time, pose, true twist, command, distance: shape (N, 9).

    """

    cost: float
    rms: float
    variation: float
    trace: FloatArray


def pose_at(time: float, odometry: Odometry) -> FloatArray:
    """Return the pose at a time [s], moved on at constant twist."""
    v, w = odometry.twist
    return advance_pose(odometry.pose, v, w, max(time - odometry.stamp, 0.0))


def ours(settings: Settings, path: Path, log: Callable[..., object] | None = None) -> Control:
    """Return this package's controller with some settings."""
    driver = Driver(settings)
    driver.follow(path)

    def control(time: float, odometry: Odometry) -> FloatArray:
        motion = np.array([*odometry.twist, time - odometry.stamp])
        output = driver.step(pose_at(time, odometry), round(1e9 * time) + 1, motion)
        if log is not None:
            log(time, driver, output)
        return output.command

    return control


def peer(factory, settings: Settings, path: Path, rate: float = 50.0) -> Control:
    """Return a peer of the comparison."""
    made: list = []
    last = [-1.0, np.zeros(2)]

    def control(time: float, odometry: Odometry) -> FloatArray:
        pose = pose_at(time, odometry)[None]
        if not made:
            made.append(factory(settings, path, np.zeros(1)))
        elif time - last[0] < 1.0 / rate - 1e-6:
            return last[1]
        dt = 0.0 if last[0] < 0.0 else time - last[0]
        last[0], last[1] = time, made[0].step(pose, dt).command[0]
        return last[1]

    return control


def drive(
    plant: Plant, control: Control, path: Path, settings: Settings, duration: float
) -> Outcome:
    """Drive for a time [s]; the robot starts beside the beginning of the path."""
    profile = SpeedProfile(path, settings)
    reference = SpeedReference(profile, settings)
    target = VirtualTarget(path, settings.target, 0.0, reference)
    running = RunningCost(settings.cost)
    odometry: Odometry | None = None
    cost, before = 0.0, None
    rows = []
    place = 0.0
    command = np.zeros(2)
    steps = round(PERIOD / STEP)
    start: float | None = None
    tick = 0
    while True:
        for found in plant.arrived():
            if odometry is None or found.stamp >= odometry.stamp:
                odometry = found
        time = tick * PERIOD
        if odometry is not None:
            command = control(time, odometry)
            if start is None and command.any():  # one that is behind a network answers later
                start = time
        if start is not None:
            frame, error = target.move(plant.pose, PERIOD if before is not None else 0.0)
            v_des = target.v_des
            extra = plant.twist - error_dynamics.feedforward(frame.curvature[()], v_des)
            rate = float(running(error, extra))
            if before is not None:
                cost += 0.5 * PERIOD * (rate + before)
            before = rate
            place, across = nearest(path, plant.pose, place)
            rows.append((time - start, *plant.pose, *plant.twist, *command, across))
            if time - start >= duration or not abs(across) < 5.0:
                break
            if not path.closed and place >= path.length - 0.02:
                break
        for _ in range(steps):
            plant.step(command)
        tick += 1
    trace = np.array(rows)
    late = trace[:, 0] >= SETTLED
    if not late.any() or abs(trace[-1, 8]) >= 5.0:
        return Outcome(math.inf, math.inf, math.inf, trace)
    return Outcome(
        cost,
        float(np.sqrt(np.mean(trace[late, 8] ** 2))),
        float(np.abs(np.diff(trace[late, 7])).sum() / (PERIOD * late.sum())),
        trace,
    )


def nearest(path: Path, pose: FloatArray, place: float) -> tuple[float, float]:
    """Return the place on the path near another one [m], and the distance from there [m]."""
    for _ in range(3):
        frame = path.frame(place)
        x, y, heading = frame.pose.tolist()
        dx, dy = pose[0] - x, pose[1] - y
        along = math.cos(heading) * dx + math.sin(heading) * dy
        across = math.cos(heading) * dy - math.sin(heading) * dx
        place += along / max(0.3, 1.0 - float(frame.curvature) * across)
        if not path.closed:
            place = min(max(place, 0.0), path.length)
    return place, across


def start_pose(path: Path, error: tuple[float, float, float]) -> FloatArray:
    """Return a pose with an error to the beginning of a path."""
    return pose_in_frame(np.array(error), path.frame(0.0).pose)
