"""The closed loop of `PathFollower` and the unicycle without ROS, many starts at once."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower import criteria
from adp_path_follower.core.control.cost import MotionCost
from adp_path_follower.core.control.virtual_target import VirtualTarget
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.driving.output import Controller, ControlOutput, FollowerOutput
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.files import read_csv_columns
from adp_path_follower.core.geometry import FloatArray, pose_in_frame, tracking_error
from adp_path_follower.core.learning.weights import Weights
from adp_path_follower.core.path.curve import Path, PathFrame
from adp_path_follower.core.path.speed_profile import SpeedProfile, SpeedReference
from adp_path_follower.core.robot.robot import Robot
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import update
from adp_path_follower.resources import FORTY_STARTS
from adp_path_follower.study.simulation.trajectories import (
    Trajectories,
    TrajectoryRecorder,
    batch_of_one,
    weights_of,
)
from sim_unicycle.fault_script import FaultScript
from sim_unicycle.settings import PlantSettings, SimulatorSettings
from sim_unicycle.unicycle import Unicycle

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PAPER_START = (-0.5, 0.25, -math.pi / 6.0)
LEARNING_MODES = ("cold", "warm", "frozen")

# Makes a controller for a batch of robots, of settings, path and each robot's arc length (B,) [m].
ControllerFactory = Callable[[Settings, Path, FloatArray], Controller]
# Sees some of the runs at a time [s]: their true poses, shape (B, 3), and what was made of them.
Observer = Callable[[slice, float, FloatArray, ControlOutput], None]

_LONGEST_STEP = 0.01  # [s] of the cost's quadrature
_WARM_MARGIN = 6.0  # [m] that a warm start learns beyond what v_des covers
HIGHEST_RATE = 1e4  # [Hz]
_LOST = 1e4  # |e| beyond which a run has failed and is frozen
_BLOCK = 512  # runs at once: enough to hide Python's overhead
_MOST_BYTES = 2**27  # of a block's weights, where each run has its own along the path
_REPORT_PERIOD = 0.1  # [s] of simulated time between two looks at progress and certificate


@dataclass(frozen=True)
class SimulationResult:
    """Outcome of B runs.

    Attributes:
        starts: Initial errors [s, y, theta], shape (B, 3).
        cost: J over the run, integrated along the true motion, shape (B,).
        effort: The inputs' part of it, the integral of u^T R u by control steps, shape (B,).
        final_error: e at the end, shape (B, 3).
        settling_time: Time after which |e| of the true pose stays below 0.05 [s], infinite where it
            does not, shape (B,); see `criteria`.
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
    trajectories: Trajectories | None = None

    def __repr__(self) -> str:
        """Return the cost and the settling time of the runs in one line."""
        sound = self.cost[~self.failed]
        settled = self.settling_time[np.isfinite(self.settling_time)]
        cost = f"J {np.median(sound):.6g}" if len(sound) else "no J"
        after = f" after {np.median(settled):.2f} s" if len(settled) else ""
        runs = "1 run" if len(self.starts) == 1 else f"{len(self.starts)} runs"
        return (
            f"SimulationResult({runs}: {cost} (median), {len(settled)} settled"
            f"{after}, {int(self.failed.sum())} failed)"
        )

    def plot(self, axes: "Axes | None" = None, *, run: int = 0) -> "Axes":
        """Plot the errors of one run over time, on given axes or new ones; return them.

        Raises AdpError if the trajectories were not recorded.
        """
        from adp_path_follower.drawing.run_figures import draw_errors, plotted

        found = self.trajectories
        if found is None:
            raise AdpError("no trajectories to plot: simulate with record=True")
        return plotted(lambda place: draw_errors(place, found.time, found.error[run]), axes)


def read_starts(file: FilePath = FORTY_STARTS) -> FloatArray:
    """Return the starts in a CSV file, by default the forty of the reference, shape (B, 3)."""
    return read_csv_columns(file, ("s", "y", "theta"))


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
    record_weights: bool = True,
    observe: Observer | None = None,
    progress: Callable[[float], None] | None = None,
    at_once: int | None = None,
) -> SimulationResult:
    """Simulate the closed loop from one or many starts; the outcome is in their order.

    Each run is as it would be alone, with a learner of its own. Starts are errors [s, y, theta],
    shape (3,) or (B, 3), to the virtual target at `start_arc_length` [m]; runs last `duration` [s],
    with `rate` control steps per second [Hz], between which commands are held.

    `learning`, of `PathFollower` only, is "cold" with the weights of the settings, "warm" if it
    first learns at the start until they settle, or "frozen". The robot is ideal by default; run
    number n has the seed of `plant` plus n, and entries of `faults` about messages have no effect.
    Poses that are late are moved on to now. Only a robot that is not ideal, or has faults, is
    driven by `robot_model`, one run at a time.
    `record` keeps trajectories: 16 bytes for each weight of each step of each run, unless
    `record_weights` is false. `observe` is called at every control step, with which of the starts
    it is about, `progress` with the fraction that is done.

    Blocks of `at_once` runs, by default as many as fit into 128 MB, bound the memory; the outcome
    is the same with any number. Raises AdpError for a start, duration or rate that is not finite,
    or not positive, or a place that the path has not.
    """
    errors = checked_starts(starts)
    path.check_place(start_arc_length)
    _check(duration, rate, learning, at_once)
    if learning == "frozen":
        settings = update(settings, {"learning": False})
    size = _block_size(settings, path, duration) if at_once is None else at_once
    ideal = (plant or PlantSettings()).ideal and not (faults and faults.entries)
    modelled, model_settings = not ideal and settings.robot.robot_model != "ideal", settings
    if modelled:
        size, settings = 1, update(settings, {"actuation_delay": 0.0})
    steps, period = round(duration * rate), 1.0 / rate
    recorder = None
    if record:
        recorder = TrajectoryRecorder(len(errors), steps + 1, period, record_weights)
    frame = path.frame(start_arc_length).pose

    def outcome(first: int) -> SimulationResult:
        """Return the outcome of a block; nothing else of it is kept."""
        block = errors[first : first + size]
        count = len(block)
        if count == 1 and controller is PathFollower:
            block = block[0]  # numbers are faster than arrays of one
        robot = Unicycle(pose_in_frame(block, frame), plant or PlantSettings(), first)
        places = np.full(block.shape[:-1], start_arc_length)
        follower = controller(settings, path, places)
        if learning == "warm" and isinstance(follower, PathFollower):
            ahead = duration * settings.target.desired_speed + _WARM_MARGIN
            follower.learn_at_rest(robot.pose, ahead)
        # A controller of a user's own may know no other speed than that along the path.
        reference = getattr(follower, "reference", None)
        reference = reference or SpeedReference(SpeedProfile(path, settings), settings)
        chosen: Controller | _Modelled = follower
        if modelled:
            target = VirtualTarget(path, settings.target, places, reference)
            chosen = _Modelled(model_settings, follower, target)

        def note(step: int, output: ControlOutput, pose: FloatArray, cost: FloatArray) -> None:
            if (recorder or observe) and pose.ndim == 1:
                output, pose = batch_of_one(output), pose[None]
            if recorder is not None:
                recorder.note(first, step, output, pose, np.atleast_1d(cost))
            if observe is not None:
                observe(slice(first, first + count), step * period, pose, output)

        def report(fraction: float) -> None:
            if progress is not None:
                progress((first + fraction * count) / len(errors))

        cost = MotionCost(settings, path, reference)
        loop = _ClosedLoop(settings, cost, block, chosen, robot, faults)
        found = loop.run(steps, period, note, report)
        return found if block.ndim == 2 else batch_of_one(found)

    results = [outcome(first) for first in range(0, len(errors), size)]
    return _joined(results, None if recorder is None else recorder.trajectories())


def checked_starts(starts: ArrayLike) -> FloatArray:
    """Return starts (3,) or (B, 3) as an array (B, 3); AdpError if they are none, or not finite."""
    try:
        errors = np.atleast_2d(np.asarray(starts, dtype=float))
    except (TypeError, ValueError):
        errors = np.zeros((0, 3))
    if errors.ndim != 2 or errors.shape[1] != 3 or not len(errors) or not np.isfinite(errors).all():
        raise AdpError("starts must be finite values s, y, theta, three for each start")
    return errors


def _check(duration: float, rate: float, learning: str, at_once: int | None) -> None:
    """Raise `AdpError` if an argument of `simulate` is wrong."""
    if learning not in LEARNING_MODES:
        raise AdpError(f"learning is '{learning}', but must be one of {', '.join(LEARNING_MODES)}")
    if not (0.0 < duration < math.inf and 0.0 < rate <= HIGHEST_RATE):
        raise AdpError(
            f"duration is {duration} s and rate {rate} Hz, but they must be positive (rate at "
            f"most {HIGHEST_RATE:g})"
        )
    if at_once is not None and at_once < 1:
        raise AdpError(f"at_once is {at_once} runs, but must be at least 1")


def _block_size(settings: Settings, path: Path, duration: float) -> int:
    learning = settings.learning
    if learning.scheduling != "arc_length" or not learning.learning:
        return _BLOCK
    covered = 1.5 * duration * settings.target.desired_speed + _WARM_MARGIN
    covered = min(covered, path.length) + 2.0 * learning.preview_distance * settings.stretch
    weights = covered / learning.knot_spacing * 2.0 * len(learning.value_basis.labels)
    return int(np.clip(_MOST_BYTES / (8.0 * weights), 1, _BLOCK))


class _Modelled:
    """A controller on the estimator and the model of its robot, as the node runs its own.

    It is asked for the pose at which its command will act. Error, target and arc length in the
    output are those of the present pose.
    """

    def __init__(self, settings: Settings, controller: Controller, target: VirtualTarget) -> None:
        """Take the settings of the robot's model, and the target of the present pose."""
        self._controller, self._robot, self._target = controller, Robot(settings), target
        self._time = self._then = 0  # [ns]

    def step(self, pose: FloatArray, dt: float, motion: FloatArray) -> ControlOutput:
        """Return the command for a pose and v, w and age of the odometry, (3,) or (1, 3) each."""
        first = self._time == 0
        self._time += round(1e9 * dt)
        found, then = self._robot.ahead(pose.reshape(3), self._time, motion.reshape(3))
        ahead = found.reshape(pose.shape)
        if first and then > self._time and hasattr(self._controller, "lead"):
            self._controller.lead(pose, ahead, (then - self._time) * 1e-9)
        elapsed, self._then = 0.0 if first else (then - self._then) * 1e-9, then
        if isinstance(self._controller, PathFollower):
            self._controller.law.robot_is_ideal = self._robot.ideal
        output = self._controller.step(ahead, elapsed)
        command = self._robot.command(output.command.reshape(2))
        self._robot.learn()
        frame, error = self._target.move(pose, dt)
        return replace(
            output,
            command=command.reshape(output.command.shape),
            error=error,
            target_pose=frame.pose,
            arc_length=self._target.arc_length,
            curvature=frame.curvature,
        )


class _ClosedLoop:
    """One block of runs: plant, controller and the cost along the way."""

    def __init__(
        self,
        settings: Settings,
        motion_cost: MotionCost,
        starts: FloatArray,
        controller: Controller | _Modelled,
        robot: Unicycle,
        faults: FaultScript | None,
    ) -> None:
        self._starts, self._controller = starts, controller
        self._robot, self._faults = robot, faults
        self._undisturbed = SimulatorSettings(plant=robot.plant)
        self._motion_cost = motion_cost
        self._input_cost = settings.cost.input_cost_matrix()
        self._failed = np.zeros(starts.shape[:-1], dtype=bool)

    def run(
        self,
        steps: int,
        period: float,
        note: Callable[[int, ControlOutput, FloatArray, FloatArray], None],
        report: Callable[[float], None],
    ) -> SimulationResult:
        """Return the outcome after control periods; `note` gets number, output, poses, J."""
        batch = self._starts.shape[:-1]
        last_outside = np.full(batch, -1)
        max_inputs, step_times = np.zeros((*batch, 2)), np.zeros(steps + 1)
        excitation = np.full(batch, math.inf)
        cost, effort = np.zeros(batch), np.zeros(batch)
        for step in range(steps + 1):
            pose, motion = self._robot.present_pose(), self._robot.measured_motion()
            begun = time.perf_counter()
            if isinstance(self._controller, _Modelled):
                output = self._controller.step(pose, period, motion)
            else:
                output = self._controller.step(pose, period)
            step_times[step] = time.perf_counter() - begun
            distance = np.sqrt(np.einsum("...i,...i->...", output.error, output.error))
            command = self._checked_command(output, distance)
            error = tracking_error(self._robot.pose, output.target_pose)
            last_outside[~criteria.is_settled(error)] = step
            note(step, output, self._robot.pose, cost)
            if step % max(1, round(_REPORT_PERIOD / period)) == 0:
                report(step / (steps + 1))
                if isinstance(output, FollowerOutput):
                    excitation = np.fmin(excitation, output.excitation)
            if step < steps:
                np.maximum(max_inputs, np.abs(command), out=max_inputs)
                cost += self._move(output, command, period)
                applied = output.modified_input
                effort += period * np.einsum(
                    "...i,ij,...j->...", applied, self._input_cost, applied
                )
        settling_time = np.where(last_outside < steps, (last_outside + 1) * period, math.inf)
        return SimulationResult(
            starts=self._starts,
            cost=np.where(self._failed, math.nan, cost),
            effort=np.where(self._failed, math.nan, effort),
            final_error=np.where(self._failed[..., None], math.nan, output.error),
            settling_time=np.where(self._failed, math.inf, settling_time),
            max_inputs=max_inputs,
            weights=weights_of(output),
            excitation=np.where(np.isfinite(excitation), excitation, math.nan),
            step_time=float(np.median(step_times)),
            failed=self._failed,
        )

    def _checked_command(self, output: ControlOutput, distance: FloatArray) -> FloatArray:
        """Return the command, zero for runs that are lost; those stay where they are."""
        finite = np.isfinite(output.command).all(axis=-1)
        self._failed = self._failed | ~(finite & (distance < _LOST))
        if not self._failed.any():
            return output.command
        if isinstance(self._controller, PathFollower):
            self._controller.reset_learning(self._failed)
        return np.where(self._failed[..., None], 0.0, output.command)

    def _move(self, output: ControlOutput, command: FloatArray, period: float) -> FloatArray:
        """Move the robot for one period; return the cost along its true motion, shape (B,)."""
        count = math.ceil(period / _LONGEST_STEP - 1e-9)
        step = period / count
        cost, arc_length, error = np.zeros(self._starts.shape[:-1]), output.arc_length, None
        frame = PathFrame(output.target_pose, output.curvature)
        for _ in range(count):
            if self._faults is not None:
                settings = self._faults.settings_at(self._undisturbed, self._robot.time)
                self._robot.plant = settings.plant
            start = self._robot.pose
            self._robot.step(command, step)
            end = None if self._robot.plant.push[1] else self._robot.pose  # of an arc
            spent, arc_length, frame, error = self._motion_cost(
                start, self._robot.twist, arc_length, step, frame, error, end
            )
            error = None if end is None else error
            cost += spent
        return cost


def _joined(blocks: list[SimulationResult], trajectories: Trajectories | None) -> SimulationResult:
    own = ("weights", "step_time", "trajectories")
    joined: dict[str, Any] = {
        item.name: np.concatenate([getattr(block, item.name) for block in blocks])
        for item in fields(SimulationResult)
        if item.name not in own
    }
    critic = np.concatenate([block.weights.critic for block in blocks])
    actor = np.concatenate([block.weights.actor for block in blocks])
    step_time = float(np.median([block.step_time for block in blocks]))
    return SimulationResult(
        **joined, weights=Weights(critic, actor), step_time=step_time, trajectories=trajectories
    )
