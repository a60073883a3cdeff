"""Feed what a recorded run measured to `PathFollower` again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adp_path_follower.bags.columns import Series
from adp_path_follower.bags.configuration import Configuration, parse_configuration
from adp_path_follower.bags.reader import Run
from adp_path_follower.bags.recorded_routes import RecordedRoutes
from adp_path_follower.core.driver import Driver
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.follower import FollowerOutput, PathFollower
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.route import Route
from adp_path_follower.core.settings import Settings
from adp_path_follower.core.weights_file import SavedWeights, decode

_NEIGHBOURS = np.arange(-10, 10)  # commands about the one that arrived with a step
_BEGINNING = 1_000_000_000  # [ns] in which a recording may lack commands
_LATE = 100_000_000  # [ns] beyond the usual: a pose that was delivered long after it was published


@dataclass(frozen=True)
class Steps:
    """The control steps of a run.

    Attributes:
        stamp: Time of each [ns], shape (N,).
        pose: x, y, theta that it went by, shape (N, 3).
        arrival: When that was recorded [ns], shape (N,).

    """

    stamp: np.ndarray
    pose: FloatArray
    arrival: np.ndarray


@dataclass(frozen=True)
class Replay:
    """What `PathFollower` makes of a run.

    Attributes:
        follower: The follower after the run, of the last segment that was driven.
        settings: The settings after the run.
        route: The route after the run.
        transform: What brought its path into the odometry's frame, as in `Configuration`.
        steps: The control steps, N of them.
        recorded: The commands [v, w] in the bag, NaN where a step has none, shape (N, 2).
        outputs: What the follower gave, one for each step.
        cost: J at each step, shape (N,).
        saved_weights: Digest of the weights file that it started from, empty without one.

    """

    follower: PathFollower
    settings: Settings
    route: Route
    transform: tuple[float, ...]
    steps: Steps
    recorded: FloatArray
    outputs: list[FollowerOutput]
    cost: FloatArray
    saved_weights: str = ""

    @property
    def stamp(self) -> np.ndarray:
        """Return the time of each step [ns], shape (N,)."""
        return self.steps.stamp

    @property
    def pose(self) -> FloatArray:
        """Return the pose that each step went by, shape (N, 3)."""
        return self.steps.pose

    @property
    def answered(self) -> np.ndarray:
        """Return which steps have a recorded command, shape (N,)."""
        return np.asarray(np.isfinite(self.recorded).all(axis=1))

    @property
    def identical(self) -> np.ndarray:
        """Return for each step whether both commands are equal to the last bit, shape (N,)."""
        return np.asarray((self.replayed == self.recorded).all(axis=1))

    @property
    def replayed(self) -> FloatArray:
        """Return the follower's commands [v, w], shape (N, 2)."""
        return np.array([output.command for output in self.outputs])


def replay(run: Run, settings: Settings | None = None) -> Replay:
    """Replay a run with the steps, the paths and the changes of parameters that it had.

    A run of this package's controller holds the pose that each step went by. Of another one, or
    with older bags, each odometry message is a step.

    Args:
        run: The run.
        settings: What to replay it with; by default, what it was recorded with.

    Raises:
        FileError: The bag lacks odometry, path or configuration, or a pose is none that a robot
            can have.

    """
    steps = steps_of(run)
    if settings is None and "measured_pose" not in run.series:
        settings = _settings_of_odometry_steps(run)
    driver = RecordedDriver(run, settings)
    outputs: list[FollowerOutput] = []
    cost = []
    for pose, stamp in zip(steps.pose, steps.stamp.tolist(), strict=True):
        outputs.append(driver.step(pose, stamp))
        cost.append(float(driver.follower.cost))
        if driver.at_goal and "measured_pose" not in run.series:
            break  # from here on the node commands zero velocity
    count = len(outputs)
    steps = Steps(steps.stamp[:count], steps.pose[:count], steps.arrival[:count])
    commands = np.array([output.command for output in outputs])
    recorded = _recorded(run.series.get("cmd_vel"), steps, commands)
    return Replay(
        driver.follower,
        driver.settings,
        driver.route,
        driver.transform,
        steps,
        recorded,
        outputs,
        np.array(cost),
        driver.saved_weights,
    )


def steps_of(run: Run) -> Steps:
    """Return the control steps of a run.

    Raises:
        FileError: There are none, or they are of poses that are not finite.

    """
    series = run.series.get("measured_pose", run.series.get("odom"))
    if series is None:
        raise FileError("the bag has no messages on 'odom': nothing to replay")
    # The simulator repeats odometry that was not answered in time: the first of each stamp counts.
    stamps, first = np.unique(series.stamp, return_index=True)
    if series is run.series.get("odom") and "cmd_vel" in run.series:
        # Only what was answered was a step, where commands say what they answer.
        answered = np.isin(stamps, run.series["cmd_vel"].stamp)
        if answered.any():
            stamps, first = stamps[answered], first[answered]
    pose = series.values[first][:, :3]
    if not np.isfinite(pose).all():
        raise FileError("the bag has odometry that is not finite: it cannot be replayed")
    return Steps(stamps, pose, series.arrival[first])


def recorded_settings(run: Run) -> Settings:
    """Return the settings that the controller said last it runs with.

    Raises:
        FileError: The bag has none, or none that can be read.
        SettingsError: They are none of this version.

    """
    return parse_configuration(run.configuration).settings


class RecordedDriver:
    """Drives as the controller node did, from what it said about paths and parameters.

    Attributes:
        saved_weights: Digest of the weights file that it starts from, empty without one.

    """

    def __init__(self, run: Run, settings: Settings | None) -> None:
        """Take the paths and the changes of parameters; settings replace the recorded ones."""
        if not any(len(poses) for _, poses in run.paths):
            raise FileError("the bag has no path: nothing to replay")
        self._fixed = settings
        self._routes = RecordedRoutes(run, settings)
        self.transform: tuple[float, ...] = ()
        told = run.configurations if "measured_pose" in run.series else ()
        self._changes = iter([parse_configuration(text) for _, text in told])
        self._next = next(self._changes, None)
        if self._next is None and settings is None:
            raise FileError("the bag has no path_follower/configuration: replay it with --params")
        saved = _saved_weights(run, self._next)
        self.saved_weights = "" if saved is None else saved.digest
        self._driver = Driver(settings or self._upcoming.settings, saved)
        if self._next is None:
            self._driver.follow(self._routes.last(self._driver.settings))
        else:
            self._driver.learning_resets = self._next.learning_resets
            self._driver.restarts = self._next.restarts
            self._driver.stops = self._next.stops

    @property
    def _upcoming(self) -> Configuration:
        assert self._next is not None  # the caller knows
        return self._next

    @property
    def follower(self) -> PathFollower:
        """Return the follower of the present segment."""
        assert self._driver.follower is not None  # every step makes one that is missing
        return self._driver.follower

    @property
    def settings(self) -> Settings:
        """Return the present settings, or those that the first step will have."""
        return self._driver.settings

    @property
    def route(self) -> Route:
        """Return the present route."""
        assert self._driver.route is not None  # steps are taken on one
        return self._driver.route

    @property
    def at_goal(self) -> bool:
        """Return whether the target is at the end of an open route."""
        return self._driver.at_goal

    def step(self, pose: FloatArray, stamp: int) -> FollowerOutput:
        """Return what the follower gives for a pose (3,) at a time [ns].

        Raises:
            FileError: The pose is none that a robot can have.

        """
        while self._next is not None and self._next.after_step < stamp:
            self._change(self._next)
            self._next = next(self._changes, None)
        if self._driver.route is None:
            raise FileError("the bag has control steps from before the controller had a path")
        try:
            with np.errstate(all="ignore"):  # a damaged pose is told below, once
                output = self._driver.step(pose, stamp)
            sound = bool(np.isfinite(output.command).all())
        except (ArithmeticError, LookupError, ValueError):
            sound = False
        if not sound:  # where no robot ever was
            text = ", ".join(f"{value:g}" for value in pose)
            raise FileError(f"no command follows from the pose ({text}) at {stamp} ns")
        return output

    def _change(self, change: Configuration) -> None:
        """Take over a path, settings or a reset of learning, as the node did."""
        driver = self._driver
        if change.learning_resets != driver.learning_resets:
            driver.reset_learning()
            driver.learning_resets = change.learning_resets
        if change.stops != driver.stops:
            driver.stopped()
            driver.stops = change.stops
        if change.restarts != driver.restarts:
            driver.restart()
            driver.restarts = change.restarts
        route = self._routes.of(change)
        self.transform = change.transform
        if route is not driver.route:
            driver.follow(route)
        driver.change_settings(self._fixed or change.settings)


def _saved_weights(run: Run, first: Configuration | None) -> SavedWeights | None:
    """Return the weights that a controller started from, of what it said first.

    Raises:
        FileError: They are not in the bag, or damaged.

    """
    if first is None or not first.saved_weights or first.learning_resets:
        return None
    if not run.initial_weights:
        raise FileError(
            "the bag lacks the weights that the controller started from "
            "(path_follower/initial_weights): record that topic, too"
        )
    name = "path_follower/initial_weights in the bag"
    saved = decode(run.initial_weights, name)
    if saved.digest != first.saved_weights:
        raise FileError(f"{name} is not what the controller started from: the bag is damaged")
    return saved


def _settings_of_odometry_steps(run: Run) -> Settings:
    """Return the recorded settings of a run whose odometry messages were its steps.

    Raises:
        FileError: They were not.

    """
    settings = recorded_settings(run)
    if settings.controller.control_trigger != "odometry":
        raise FileError(
            "the bag does not say which pose each step went by (path_follower/measured_pose), and "
            "its steps were not those of the odometry: replay it with --params"
        )
    return settings


def _recorded(commands: Series | None, steps: Steps, replayed: FloatArray) -> FloatArray:
    """Return the recorded command of each step, NaN where there is none, shape (N, 2)."""
    found = np.full(replayed.shape, np.nan)
    if commands is None:
        return found
    if not np.array_equal(commands.stamp, commands.arrival):
        # The zero velocities of a stop can have the stamp of the step before or after them.
        stops = ~commands.values.any(axis=1)
        order = np.lexsort((stops, commands.stamp))
        stamps, first = np.unique(commands.stamp[order], return_index=True)
        _, in_steps, in_commands = np.intersect1d(steps.stamp, stamps, return_indices=True)
        found[in_steps] = commands.values[order[first[in_commands]]]
        return found
    # Without stamps: of those that arrived about then, the one that comes nearest. A recorder that
    # joins late gets the poses from before, all at once, but not the commands.
    place = np.searchsorted(commands.arrival, steps.arrival)[:, None] + _NEIGHBOURS
    near = commands.values[np.clip(place, 0, len(commands.stamp) - 1)]
    apart = np.abs(near - replayed[:, None]).sum(axis=2)
    delay = steps.arrival - steps.stamp
    usual = delay <= np.median(delay) + _LATE
    found[usual] = near[np.arange(len(near)), apart.argmin(axis=1)][usual]
    # Nor those before the first that it heard, which are then compared with others.
    same = np.flatnonzero((found == replayed).all(axis=1))
    early = steps.arrival < commands.arrival[0] + _BEGINNING
    if len(same):
        found[: same[0]][early[: same[0]]] = np.nan
    return found
