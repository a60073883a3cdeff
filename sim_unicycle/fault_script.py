"""Fault scripts: simulator parameters that change at set times."""

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from adp_path_follower.core.errors import FileError, SettingsError
from adp_path_follower.core.files import read_yaml
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.schema import (
    Value,
    build,
    checked,
    flatten,
    setting_fields,
    update,
)
from adp_path_follower.resources import shipped_file
from sim_unicycle.settings import MessageFaultSettings, PlantSettings, SimulatorSettings

_FIELDS = {field.name: field for field in setting_fields(SimulatorSettings)}
_CHANGEABLE = tuple(name for name, field in _FIELDS.items() if not field.spec.read_only)
_TIMES = ("at", "for", "every")
_ROUNDING = 1e-9  # [s]
_SHORT = 0.002  # of a run


@dataclass(frozen=True)
class FaultEntry:
    """Parameters that hold for a time."""

    at: float  # when it begins [s]
    duration: float  # how long it lasts [s]; infinite for the rest of the run
    every: float  # after which time it begins again [s]; infinite for never
    values: Mapping[str, Value]  # name: value of the parameters

    def holds(self, time: float) -> bool:
        """Return whether it holds at a time [s]."""
        elapsed = time - self.at + _ROUNDING
        if elapsed < 0.0:
            return False
        if math.isfinite(self.every):
            elapsed %= self.every
        return elapsed < self.duration


class FaultScript:
    """Entries of a script; where two hold at once, the later one in the list wins."""

    def __init__(self, entries: tuple[FaultEntry, ...] = ()) -> None:
        self.entries = entries
        self._known: tuple[SimulatorSettings, tuple[FaultEntry, ...], SimulatorSettings] | None
        self._known = None

    def __repr__(self) -> str:
        """Return all entries."""
        return f"FaultScript({self.entries})"

    def settings_at(self, settings: SimulatorSettings, time: float) -> SimulatorSettings:
        """Return settings with the changes at a time [s]; SettingsError if they do not fit."""
        if not self.entries:
            return settings
        holding = tuple(entry for entry in self.entries if entry.holds(time))
        if not holding:
            return settings
        if self._known is None or self._known[0] is not settings or self._known[1] != holding:
            changes = {name: value for entry in holding for name, value in entry.values.items()}
            self._known = settings, holding, update(settings, changes)
        return self._known[2]

    def spans(self, end: float) -> FloatArray:
        """Return from and until when [s] entries hold, before the end; shape (N, 2).

        Pauses that are too short for a picture of all of it are left out.
        """
        spans = []
        for entry in self.entries:
            begin, lasts, again = entry.at, entry.duration, entry.every
            if again - lasts < _SHORT * end:
                lasts = again = math.inf
            while begin < end:
                spans.append((begin, min(begin + lasts, end)))
                begin += again  # infinite for an entry that does not begin again
        return np.array(spans).reshape(-1, 2)

    def changes_messages(self) -> str:
        """Return a parameter of the script that is about messages, empty if there is none."""
        names = {item.name for item in fields(MessageFaultSettings)}
        return next((name for entry in self.entries for name in entry.values if name in names), "")


def read_fault_script(name: str) -> FaultScript:
    """Return the script in a file, or with the name of one in config/faults; "" gives none.

    Raises FileError without such a file, SettingsError for a wrong entry; the message names it.
    """
    if not name:
        return FaultScript()
    file = shipped_file("faults", name, "fault script")
    content = read_yaml(file)
    if not isinstance(content, Mapping) or list(content) != ["faults"]:
        raise FileError(f"file {file} is no fault script: it must have one key, 'faults', a list")
    entries = content["faults"]
    if not isinstance(entries, list) or not entries:
        raise FileError(
            f"file {file}: 'faults' must be a list of entries with 'at', and NAME: VALUE"
        )
    found = []
    for number, entry in enumerate(entries, start=1):
        try:
            found.append(_entry(entry))
        except SettingsError as error:
            raise SettingsError(f"file {file}, entry {number}: {error}") from None
    return FaultScript(tuple(found))


def without_nodes(settings: SimulatorSettings) -> tuple[PlantSettings, FaultScript]:
    """Return the plant and the faults; FileError or SettingsError for what only nodes can do."""
    script = read_fault_script(settings.simulation.fault_script)
    message_fault = script.changes_messages()
    if message_fault:
        raise SettingsError(
            f"fault_script changes '{message_fault}', but there are no messages here: give it to "
            "adp demo"
        )
    values, plain = flatten(settings), flatten(SimulatorSettings())
    for field in _FIELDS.values():
        taken = field.group == "plant" or field.name == "fault_script"
        if not taken and values[field.name] != plain[field.name]:
            raise SettingsError(
                f"setting '{field.name}' is of the simulator node, which does not run here: leave "
                "it out, or use adp demo"
            )
    return settings.plant, script


def _entry(entry: object) -> FaultEntry:
    if not isinstance(entry, Mapping):
        raise SettingsError(f"{entry!r} is no mapping: write 'at: SECONDS' and NAME: VALUE")
    if "at" not in entry:
        raise SettingsError("'at' is missing: say when it begins, in seconds")
    at = _seconds("at", entry["at"], zero=True)
    duration = _seconds("for", entry["for"]) if "for" in entry else math.inf
    every = _seconds("every", entry["every"]) if "every" in entry else math.inf
    if math.isfinite(every) and not duration < every:
        raise SettingsError(f"'every' is {every:g} s, but must be longer than 'for'")
    values = {}
    for key, value in entry.items():
        if key in _TIMES:
            continue
        field = _FIELDS.get(str(key))
        if field is None:
            near = difflib.get_close_matches(str(key), (*_CHANGEABLE, *_TIMES), n=1)
            hint = f"did you mean '{near[0]}'?" if near else "`adp docs parameters` lists them"
            raise SettingsError(f"'{key}' is no parameter of the simulator; {hint}")
        if field.spec.read_only:
            raise SettingsError(f"'{key}' cannot change while running: {field.spec.read_only}")
        values[field.name] = checked(field, value)
    if not values:
        raise SettingsError("it changes nothing: give NAME: VALUE of a parameter of the simulator")
    build(SimulatorSettings, values)  # whether they fit each other
    return FaultEntry(at, duration, every, values)


def _seconds(key: str, value: object, *, zero: bool = False) -> float:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not (0.0 < value < 1e9 or (zero and value == 0)):  # type: ignore[operator]
        least = "of at least 0" if zero else "above 0"
        raise SettingsError(f"'{key}' is {value!r}, but must be a number {least} [s]")
    return float(value)  # type: ignore[arg-type]
