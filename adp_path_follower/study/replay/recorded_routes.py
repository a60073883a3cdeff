"""The routes that a controller made of the paths in a bag."""

from collections.abc import Mapping
from dataclasses import replace

from adp_path_follower.bags.reader import Run
from adp_path_follower.core.errors import AdpError, FileError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.path.route import Route
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.schema import setting_fields, update
from adp_path_follower.messages.configuration import Configuration, parse_configuration


class RecordedRoutes:
    """Finds the route of a digest by the paths and settings that are in the bag."""

    def __init__(
        self,
        run: Run,
        fixed: Settings | None = None,
        overlay: Mapping[str, object] | None = None,
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
