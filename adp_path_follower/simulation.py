"""The closed loop of `PathFollower` and the unicycle without ROS, many starts at once."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core import error_dynamics
from adp_path_follower.core.controller import Controller, ControlOutput, RunningCost
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.follower import FollowerOutput, PathFollower
from adp_path_follower.core.geometry import FloatArray, advance_pose, pose_in_frame
from adp_path_follower.core.learner import Weights
from adp_path_follower.core.path import Path
from adp_path_follower.core.schema import update
from adp_path_follower.core.settings import Settings
from adp_path_follower.core.speed_profile import SpeedProfile
from sim_unicycle.fault_script import FaultScript
from sim_unicycle.settings import PlantSettings, SimulatorSettings
from sim_unicycle.unicycle import Unicycle

PAPER_START = (-0.5, 0.25, -math.pi / 6.0)
LEARNING_MODES = ("cold", "warm", "frozen")
SETTLED_ERROR = 0.05  # |e| below which a run counts as settled

# Makes a controller for a batch of robots, of settings, path and each robot's arc length (B,) [m].
ControllerFactory = Callable[[Settings, Path, FloatArray], Controller]

_LONGEST_STEP = 0.01  # [s] of the cost's quadrature
_WARM_MARGIN = 6.0  # [m] that a warm start learns beyond what v_des covers
_LOST = 1e4  # |e| beyond which a run has failed and is frozen
_BLOCK = 128  # starts at once: enough to hide Python's overhead, small enough for the caches


@dataclass(frozen=True)
class Trajectories:
    """What happened at each of the T control steps of B runs.

    Attributes:
        time: Time since the start [s], shape (T,).
        pose: True pose, shape (B, T, 3).
        error: e = [s, y, theta], shape (B, T, 3).
        arc_length: s_p [m], shape (B, T).
        command: [v, w], shape (B, T, 2).
        modified_input: u = [v_e, w_e], shape (B, T, 2).
        critic_weights: Wc, shape (B, T, L); L = 0 for controllers without.
        actor_weights: Wa, shape (B, T, L).
        bellman_error: delta at the state, shape (B, T); NaN for controllers without.

    """

    time: FloatArray
    pose: FloatArray
    error: FloatArray
    arc_length: FloatArray
    command: FloatArray
    modified_input: FloatArray
    critic_weights: FloatArray
    actor_weights: FloatArray
    bellman_error: FloatArray


@dataclass(frozen=True)
class SimulationResult:
    """Outcome of B runs.

    Attributes:
        starts: Initial errors [s, y, theta], shape (B, 3).
        cost: J over the run, integrated along the true motion, shape (B,).
        effort: The inputs' part of it, the integral of u^T R u by control steps, shape (B,).
        final_error: e at the end, shape (B, 3).
        settling_time: Time after which |e| stays below 0.05 [s], infinite where it does not (B,).
        max_inputs: Largest |v| and |w| commanded, shape (B, 2).
        weights: Weights at the end, shape (B, L) each; L = 0 for controllers without.
        excitation: Smallest value of the certificate during the run, shape (B,); NaN for
            controllers without.
        step_time: Computing time of a control step of the batch, median [s].
        failed: Runs that lost the path altogether; their numbers are not finite, shape (B,).
        trajectories: The runs themselves, if they were asked for.

    """

    starts: FloatArray
    cost: FloatArray
    effort: FloatArray
    final_error: FloatArray
    settling_time: FloatArray
    max_inputs: FloatArray
    weights: Weights
    excitation: FloatArray
    step_time: float
    failed: np.ndarray
    trajectories: Trajectories | None = field(default=None, repr=False)


def simulate(
    settings: Settings,
    path: Path,
    starts: ArrayLike = PAPER_START,
    *,
    start_arc_length: float = 0.0,
    duration: float = 30.0,
    rate: float = 100.0,
    learning: str = "cold",
    plant: PlantSettings | None = None,
    faults: FaultScript | None = None,
    controller: ControllerFactory = PathFollower,
    record: bool = False,
    progress: Callable[[float], None] | None = None,
) -> SimulationResult:
    """Simulate the closed loop from one or many starts.

    Args:
        settings: The controller's settings.
        path: The path to follow.
        starts: Initial errors [s, y, theta] to the virtual target, shape (3,) or (B, 3).
        start_arc_length: Where the virtual target starts [m].
        duration: Simulated time [s].
        rate: Control steps per second [Hz]; commands are held between them.
        learning: "cold" starts with the weights of the settings, "warm" first learns at the start
            until the weights settle, "frozen" never changes the weights.
        plant: Imperfections of the robot; an ideal one by default. Run number n of the starts has
            the seed of the plant plus n, whatever the controller and its rate.
        faults: How the imperfections change with time; what it says of messages has no effect.
        controller: What makes the controller; `learning` matters to `PathFollower` only.
        record: Keep trajectories.
        progress: Called now and then with the fraction that is done.

    Returns:
        The outcome, in the order of the starts.

    Raises:
        AdpError: A start, a duration or a rate that is not finite and positive.

    """
    try:
        errors = np.atleast_2d(np.asarray(starts, dtype=float))
    except (TypeError, ValueError):
        errors = np.zeros((0, 3))
    if errors.ndim != 2 or errors.shape[1] != 3 or not len(errors) or not np.isfinite(errors).all():
        raise AdpError("starts must be finite values s, y, theta, three for each start")
    if not math.isfinite(start_arc_length):
        raise AdpError(f"start_arc_length is {start_arc_length} m, but must be finite")
    if learning not in LEARNING_MODES:
        raise AdpError(f"learning is '{learning}', but must be one of {', '.join(LEARNING_MODES)}")
    if not (0.0 < duration < math.inf and 0.0 < rate <= 1e4):
        raise AdpError(
            f"duration is {duration} s and rate {rate} Hz, but they must be positive (rate at "
            "most 10000)"
        )
    blocks = [errors[first : first + _BLOCK] for first in range(0, len(errors), _BLOCK)]
    results = []
    frame = path.frame(np.full(1, start_arc_length)).pose
    for index, block in enumerate(blocks):
        robot = Unicycle(pose_in_frame(block, frame), plant or PlantSettings(), _BLOCK * index)
        loop = _ClosedLoop(
            settings, path, block, start_arc_length, learning, robot, faults, controller, duration
        )

        def report(fraction: float, index: int = index) -> None:
            if progress is not None:
                progress((index + fraction) / len(blocks))

        results.append(loop.run(round(duration * rate), 1.0 / rate, record, report))
    return _joined(results)


class _ClosedLoop:
    """One block of runs: plant, controller and the cost along the way."""

    def __init__(
        self,
        settings: Settings,
        path: Path,
        starts: FloatArray,
        start_arc_length: float,
        learning: str,
        robot: Unicycle,
        faults: FaultScript | None,
        controller: ControllerFactory,
        duration: float,
    ) -> None:
        if learning == "frozen":
            settings = update(settings, {"learning": False})
        arc_length = np.full(len(starts), start_arc_length)
        self._starts = starts
        self._settings, self._path = settings, path
        self._controller = controller(settings, path, arc_length)
        self._profile = getattr(self._controller, "profile", None)
        self._robot, self._faults = robot, faults
        self._undisturbed = SimulatorSettings(plant=robot.plant)
        if learning == "warm" and isinstance(self._controller, PathFollower):
            ahead = duration * settings.target.desired_speed + _WARM_MARGIN
            self._controller.learn_at_rest(robot.pose, ahead)
        self._failed = np.zeros(len(starts), dtype=bool)

    def run(
        self, steps: int, period: float, record: bool, progress: Callable[[float], None]
    ) -> SimulationResult:
        """Return the outcome after so many control periods [s]."""
        count = len(self._starts)
        records: list[tuple[ControlOutput, FloatArray]] = []
        last_outside = np.full(count, -1)
        max_inputs = np.zeros((count, 2))
        excitation = np.full(count, math.inf)
        cost, effort = np.zeros(count), np.zeros(count)
        running_cost = RunningCost(self._settings.cost)
        step_times = np.zeros(steps + 1)
        for step in range(steps + 1):
            begun = time.perf_counter()
            output = self._controller.step(self._robot.measured_pose(), period)
            step_times[step] = time.perf_counter() - begun
            command = self._checked_command(output)
            outside = ~(np.linalg.norm(output.error, axis=-1) < SETTLED_ERROR)
            last_outside[outside] = step
            if record:
                records.append((output, self._robot.pose))
            if step % max(1, round(0.1 / period)) == 0:
                progress(step / (steps + 1))
                if isinstance(output, FollowerOutput):
                    excitation = np.fmin(excitation, output.excitation)
            if step < steps:
                max_inputs = np.maximum(max_inputs, np.abs(command))
                cost += self._move(output.arc_length, command, period)
                effort += period * running_cost(np.zeros((count, 3)), output.modified_input)
        settling_time = np.where(last_outside < steps, (last_outside + 1) * period, math.inf)
        return SimulationResult(
            starts=self._starts,
            cost=np.where(self._failed, math.nan, cost),
            effort=np.where(self._failed, math.nan, effort),
            final_error=np.where(self._failed[:, None], math.nan, output.error),
            settling_time=np.where(self._failed, math.inf, settling_time),
            max_inputs=max_inputs,
            weights=_weights(output),
            excitation=np.where(np.isfinite(excitation), excitation, math.nan),
            step_time=float(np.median(step_times)),
            failed=self._failed,
            trajectories=_trajectories(records, period) if record else None,
        )

    def _checked_command(self, output: ControlOutput) -> FloatArray:
        """Return the command, zero for runs that are lost; those stay where they are."""
        finite = np.isfinite(output.command).all(axis=-1)
        if isinstance(self._controller, PathFollower):
            after = self._controller.weights
            for values in (after.critic, after.actor):
                finite = finite & np.isfinite(values).all(axis=-1)
        near = np.linalg.norm(output.error, axis=-1) < _LOST
        self._failed = self._failed | ~(finite & near)
        if not self._failed.any():
            return output.command
        if isinstance(self._controller, PathFollower):
            self._controller.reset_learning(self._failed)
        return np.where(self._failed[:, None], 0.0, output.command)

    def _move(self, arc_length: FloatArray, command: FloatArray, period: float) -> FloatArray:
        """Move the robot for one period; return the cost along its true motion, shape (B,)."""
        count = math.ceil(period / _LONGEST_STEP - 1e-9)
        step = period / count
        cost = np.zeros(len(self._starts))
        for _ in range(count):
            if self._faults is not None:
                settings = self._faults.settings_at(self._undisturbed, self._robot.time)
                self._robot.plant = settings.plant
            start = self._robot.pose
            self._robot.step(command, step)
            spent, arc_length = motion_cost(
                *(self._settings, self._path, start, self._robot.twist, arc_length, step),
                self._profile,
            )
            cost += spent
        return cost


def motion_cost(
    settings: Settings,
    path: Path,
    pose: FloatArray,
    twist: FloatArray,
    arc_length: FloatArray,
    duration: float,
    profile: SpeedProfile | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the cost of moving at constant twist, and where the virtual target is afterwards.

    Simpson's rule along the robot's arc, with the virtual target moving on beside it from where
    the controller has it at the start.

    Args:
        settings: Give cost and target.
        path: The path that is followed.
        pose: Pose at the start, shape (..., 3).
        twist: [v, w] that is held, shape (..., 2).
        arc_length: s_p at the start [m], shape (...).
        duration: Time [s]; at most 10 ms for an error below 1e-6 of the cost.
        profile: The speed along the path, by default `desired_speed` everywhere.

    """
    target, running_cost = settings.target, RunningCost(settings.cost)

    def rates(time: float, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        here = advance_pose(pose, twist[..., 0], twist[..., 1], time)
        frame = path.frame(place)
        error = error_dynamics.tracking_error(here, frame.pose)
        v_des = profile.speed(place) if profile is not None and profile.varies else None
        modified_input = twist - error_dynamics.feedforward(frame.curvature, target, v_des)
        cost_rate = running_cost(error, modified_input)
        return cost_rate, error_dynamics.target_speed(error, target, v_des)

    first, speed = rates(0.0, arc_length)
    middle, speed = rates(0.5 * duration, arc_length + 0.5 * duration * speed)
    arc_length = arc_length + duration * speed
    last, _ = rates(duration, arc_length)
    return duration / 6.0 * (first + 4.0 * middle + last), arc_length


def _weights(output: ControlOutput) -> Weights:
    """Return the weights of an output, one set for each run, shape (B, L) each."""
    if not isinstance(output, FollowerOutput):
        none = np.zeros((len(output.error), 0))
        return Weights(none, none)

    def repeated(values: FloatArray) -> FloatArray:
        return np.broadcast_to(values, (len(output.error), values.shape[-1]))

    return Weights(repeated(output.weights.critic), repeated(output.weights.actor))


def _bellman_error(output: ControlOutput) -> FloatArray:
    if not isinstance(output, FollowerOutput):
        return np.full(len(output.error), math.nan)
    return output.bellman_error


def _trajectories(records: list[tuple[ControlOutput, FloatArray]], period: float) -> Trajectories:
    """Return the records of a block with the runs first."""

    def stacked(take: Callable[[ControlOutput], FloatArray]) -> FloatArray:
        return np.stack([take(output) for output, _ in records], axis=1)

    return Trajectories(
        time=np.arange(len(records), dtype=float) * period,
        pose=np.stack([pose for _, pose in records], axis=1),
        error=stacked(lambda output: output.error),
        arc_length=stacked(lambda output: output.arc_length),
        command=stacked(lambda output: output.command),
        modified_input=stacked(lambda output: output.modified_input),
        critic_weights=stacked(lambda output: _weights(output).critic),
        actor_weights=stacked(lambda output: _weights(output).actor),
        bellman_error=stacked(_bellman_error),
    )


def _joined(blocks: list[SimulationResult]) -> SimulationResult:
    """Return the blocks as one result."""

    def joined(take: Callable[[SimulationResult], FloatArray]) -> FloatArray:
        return np.concatenate([take(block) for block in blocks])

    recorded = [block.trajectories for block in blocks if block.trajectories is not None]
    trajectories = None
    if recorded:
        runs = {
            name: np.concatenate([getattr(block, name) for block in recorded])
            for name in (item.name for item in fields(Trajectories))
            if name != "time"
        }
        trajectories = Trajectories(time=recorded[0].time, **runs)
    return SimulationResult(
        starts=joined(lambda block: block.starts),
        cost=joined(lambda block: block.cost),
        effort=joined(lambda block: block.effort),
        final_error=joined(lambda block: block.final_error),
        settling_time=joined(lambda block: block.settling_time),
        max_inputs=joined(lambda block: block.max_inputs),
        weights=Weights(
            joined(lambda block: block.weights.critic), joined(lambda block: block.weights.actor)
        ),
        excitation=joined(lambda block: block.excitation),
        step_time=float(np.median([block.step_time for block in blocks])),
        failed=joined(lambda block: block.failed),
        trajectories=trajectories,
    )
