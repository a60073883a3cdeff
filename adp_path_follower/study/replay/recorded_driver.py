"""Drive as a recorded controller did, on the routes that it made of the paths in a bag."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from adp_path_follower.bags.reader import Run
from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.driving.output import Counts, FollowerOutput
from adp_path_follower.core.errors import AdpError, FileError, SettingsError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.weights_file import SavedWeights, decode
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.path.route import Route
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.schema import setting_fields, update
from adp_path_follower.messages.configuration import (
    NO_STEP,
    Configuration,
    configuration_text,
    parse_configuration,
)


class RecordedRoutes:
    """Finds the route of a digest by the paths and settings that are in the bag."""

    def __init__(
        self, run: Run, fixed: Settings | None = None, overlay: Mapping[str, object] | None = None
    ) -> None:
        """Take a run; the rest is what to prepare its routes with, as in `RecordedDriver`."""
        self._poses = [poses for _, poses in run.paths]
        self._frames = run.path_frames or ("",) * len(run.paths)
        self._fixed, self._overlay = fixed, overlay or {}
        names = {field.name for field in setting_fields(Settings) if field.group == "path"}
        self._laid = names.intersection(self._overlay)
        configurations = _configurations(run)
        self._times = [time for time, _ in configurations]
        self._changes = [change for _, change in configurations]
        self._known = _path_settings(self._changes)
        self._prepared: dict[tuple[int, PathSettings], Route | None] = {}
        self._found: dict[str, tuple[int, Route]] = {}

    def last(self, settings: Settings) -> Route:
        """Return the route of the last path; raise PathError if it cannot be followed."""
        poses = [poses for poses in self._poses if len(poses)]
        return _route(poses[-1], settings.path)

    def in_force(self) -> list[tuple[int, Route, str]]:
        """Return since which arrival [ns] the controller followed which routes, in which frame."""
        found: list[tuple[int, Route, str]] = []
        last = ""
        for time, change in zip(self._times, self._changes, strict=True):
            if change.path_digest in ("", last):
                continue
            try:
                route = self.of(change)
            except FileError:  # its path is not in the bag
                return []
            if route is not None:
                last = change.path_digest
                found.append((time, route, self._frames[self._found[last][0]]))
        return found

    def followed(self, number: int) -> Route | None:
        """Return the route that the controller made of a path of the run, None if it made none."""
        for change in self._changes:
            route = self._made(number, change.settings.path)
            if route is not None and change.path_digest == route.digest():
                return route
        return None

    def of(self, change: Configuration) -> Route | None:
        """Return the route that a configuration names, None without; FileError if it is missing."""
        if not change.path_digest:
            return None
        if change.path_digest not in self._found:
            number, prepared, route = self._search(change)
            wanted = self._wanted(change.settings, prepared)
            if wanted != prepared:
                route = _route(self._poses[number], wanted)
            self._found[change.path_digest] = number, route
        return self._found[change.path_digest][1]

    def _wanted(self, settings: Settings, prepared: PathSettings) -> PathSettings:
        """Return what to prepare a path with that was prepared before these settings."""
        if self._fixed is not None:
            return update(self._fixed, self._overlay).path
        if not self._laid:
            return prepared
        laid = update(settings, self._overlay).path
        return replace(prepared, **{name: getattr(laid, name) for name in self._laid})

    def _search(self, change: Configuration) -> tuple[int, PathSettings, Route]:
        for settings in self._known:
            for number in range(len(self._poses)):
                route = self._made(number, settings)
                if route is not None and route.digest() == change.path_digest:
                    return number, settings, route
        raise FileError(
            f"the bag has not the path {change.path_digest} that the controller followed"
        )

    def _made(self, number: int, settings: PathSettings) -> Route | None:
        """Return the route of a path, None if it was rejected."""
        key = number, settings
        if key not in self._prepared:
            try:
                self._prepared[key] = _route(self._poses[number], settings)
            except AdpError:
                self._prepared[key] = None
        return self._prepared[key]


def _route(poses: FloatArray, settings: PathSettings) -> Route:
    return prepare(poses[:, :2], settings, poses[:, 2])


def _configurations(run: Run) -> list[tuple[int, Configuration]]:
    """Return arrival and content of the configurations that this version understands."""
    found = []
    for time, text in run.configurations:
        try:
            change = parse_configuration(text)
            _ = change.settings
        except AdpError:
            continue
        found.append((time, change))
    return found


def _path_settings(changes: list[Configuration]) -> list[PathSettings]:
    """Return all settings of paths in configurations, and those of versions without any.

    The path of a goal is open, whatever they say.
    """
    exact = replace(PathSettings(), path_tolerance=0.0)
    given = dict.fromkeys([*(change.settings.path for change in changes), exact])
    opened = [replace(item, path_closed="open") for item in given if item.path_closed == "auto"]
    return list(dict.fromkeys([*given, *opened]))


NO_SETTINGS = (
    "the bag does not say with which settings a controller of this package ran "
    "(path_follower/configuration): give some by --params"
)


def recorded_settings(run: Run) -> Settings:
    """Return the last recorded settings; FileError without, SettingsError of another version."""
    if not run.configurations:
        raise FileError(NO_SETTINGS)
    return parse_configuration(run.configuration).settings


class RecordedDriver(Driver):
    """Drives as the controller node did, from what it said about paths and parameters."""

    def __init__(
        self, run: Run, settings: Settings | None, overlay: Mapping[str, object] | None = None
    ) -> None:
        """Take paths, changes, `settings` and `overlay` as `replay`, whose errors it raises."""
        if not any(len(poses) for _, poses in run.paths):
            wanted = "name a topic of nav_msgs/msg/Path by --path"
            raise FileError(f"the bag has no path: {wanted}{run.causes}")
        self._fixed, self._overlay = settings, overlay or {}
        self._routes = RecordedRoutes(run, settings, self._overlay)
        # Number of a step, and what a controller that drives like this says before it.
        self.configurations: list[tuple[int, str]] = []
        self.outputs: list[FollowerOutput] = []  # of all steps so far
        self.costs: list[float] = []  # J at each of them
        self._last = NO_STEP
        told = run.configurations if "measured_pose" in run.series else ()
        self._changes = iter([parse_configuration(text) for _, text in told])
        self._next = next(self._changes, None)
        if self._next is None and settings is None:
            raise FileError(NO_SETTINGS)
        saved = _saved_weights(run, self._next)
        self._saved_weights = "" if saved is None else saved.digest
        counts = Counts() if self._next is None else self._next.counts
        super().__init__(self._wanted(self._next), saved, counts=counts)
        if self._next is None:
            self.follow(self._routes.last(self.settings))

    def _wanted(self, recorded: Configuration | None) -> Settings:
        """Return the settings to drive with where these were recorded."""
        settings = self._fixed
        if settings is None:
            assert recorded is not None  # a driver without fixed settings is not made without
            settings = recorded.settings
        return update(settings, self._overlay) if self._overlay else settings

    def taken(
        self, pose: FloatArray, time: int, motion: FloatArray | None = None
    ) -> FollowerOutput | None:
        """Return the output for a pose and motion (3,) at a time [ns], None if settings forbid any.

        Raises FileError for an impossible pose, SettingsError where the settings are not recorded.
        """
        changed = not self.outputs
        while self._next is not None and self._next.after_step < time:
            self._change(self._next)
            self._next = next(self._changes, None)
            changed = True
        if self.route is None:
            raise FileError("the bag has control steps from before the controller had a path")
        if changed:
            said = configuration_text(
                self.settings,
                self.route,
                after_step=self._last,
                counts=self.counts,
                saved_weights=self._saved_weights,
            )
            self.configurations.append((len(self.outputs), said))
        try:
            with np.errstate(all="ignore"):  # a damaged pose raises below, once
                known = motion if motion is not None and np.isfinite(motion).all() else None
                output = self.step(pose, time, known)
            sound = bool(np.isfinite(output.command).all())
            if not sound and self._was_reset_after(time):  # and the robot told to stop
                output, sound = replace(output, command=np.zeros(2)), True
        except SettingsError:  # as in the node, which told the robot to stop
            if self._fixed is not None or self._overlay:
                raise
            self._last = time
            return None
        except (ArithmeticError, LookupError, ValueError):
            sound = False
        if not sound:  # where no robot ever was
            text = ", ".join(f"{value:g}" for value in pose)
            raise FileError(f"no command follows from the pose ({text}) at {time} ns")
        self._last = time
        self.outputs.append(output)
        assert self.follower is not None  # the step has made one
        self.costs.append(float(self.follower.cost))
        return output

    def _was_reset_after(self, time: int) -> bool:
        """Return whether the node reset learning after the step at a time [ns]."""
        change, resets = self._next, self.counts.learning_resets
        if change is None or change.after_step != time:
            return False
        return change.counts.learning_resets != resets

    def _change(self, change: Configuration) -> None:
        """Take over a path, settings or a reset of learning, as the node did."""
        self.catch_up(change.counts)
        route = self._routes.of(change)
        if route is not self.route:
            self.follow(route)
        self.take_over(self.prepared(self._wanted(change)))


def _saved_weights(run: Run, first: Configuration | None) -> SavedWeights | None:
    """Return the weights that a controller started from; FileError if missing or damaged."""
    if first is None or not first.saved_weights or first.counts.learning_resets:
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
