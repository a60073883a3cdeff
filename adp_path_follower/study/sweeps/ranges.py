"""Variations of a setting: listed values, or a range of numbers."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import (
    SettingField,
    Value,
    checked,
    setting_fields,
    unknown_name,
    yaml_text,
)
from adp_path_follower.study.sweeps.conditions import errors_in

OWN = "own"
_AT_END = 0.02  # of a range: its end
_OWN_FACTOR = 10.0  # a setting's own range goes from a tenth to ten times its value
_RANGE_FORM = "a range is {low: 0.1, high: 10.0} or {low: 0.1, high: 10.0, log: true}"


@dataclass(frozen=True)
class Listed:
    """Values of a setting that are all tried."""

    field: SettingField
    values: tuple[Value, ...]

    @property
    def name(self) -> str:
        """Return the setting's name."""
        return self.field.name

    @functools.cached_property
    def distribution(self) -> CategoricalDistribution:
        """Return the values as Optuna has them: as texts."""
        return CategoricalDistribution([yaml_text(value) for value in self.values])

    def parameter(self, value: Value) -> str | None:
        """Return a value as Optuna has it, None if it is not listed."""
        return yaml_text(value) if value in self.values else None

    def value(self, parameter: object) -> Value:
        """Return the value that Optuna has as a parameter."""
        return self.values[self.distribution.choices.index(str(parameter))]

    def before(self, value: Value) -> Value:
        """Return what is varied of a setting's value: all of it."""
        return value


@dataclass(frozen=True)
class Range:
    """A range of a setting, or of one number of a list."""

    field: SettingField  # the setting
    item: int | None  # place in the list; None for a setting that is one number
    low: float  # lowest value
    high: float  # highest value
    log: bool  # whether the logarithm of the value is varied evenly

    @property
    def name(self) -> str:
        """Return the setting's name; with its place in a list, as in "state_cost[1]"."""
        return self.field.name if self.item is None else f"{self.field.name}[{self.item}]"

    @property
    def integer(self) -> bool:
        """Return whether its values are whole numbers."""
        return (self.field.item_kind or self.field.kind) is int

    @functools.cached_property
    def distribution(self) -> IntDistribution | FloatDistribution:
        """Return the range as Optuna has it."""
        if self.integer:
            return IntDistribution(int(self.low), int(self.high), log=self.log)
        return FloatDistribution(self.low, self.high, log=self.log)

    def parameter(self, value: Value) -> float | None:
        """Return a setting's value as Optuna has it, None if it is out of range."""
        number = self.before(value)
        return number if self.low <= number <= self.high else None

    def value(self, parameter: float) -> float:
        """Return the value that Optuna has as a parameter."""
        return int(parameter) if self.integer else float(parameter)

    def before(self, value: Value) -> float:
        """Return the number that is varied of a setting's value."""
        number = value[self.item] if isinstance(value, tuple) and self.item is not None else value
        assert isinstance(number, int | float)  # others have no range
        return number

    def is_at_end(self, value: Value) -> bool:
        """Return whether a setting's value is at one of the ends of its range."""
        ends = np.array([self.low, self.high, self.before(value)])
        low, high, here = np.log(ends) if self.log else ends
        return bool(min(here - low, high - here) < _AT_END * (high - low))

    def at(self, share: float) -> float:
        """Return the value at a share in [0, 1) of the range."""
        low, high = self.low, self.high + self.integer
        value = low * (high / low) ** share if self.log else low + share * (high - low)
        return min(int(value) if self.integer else float(value), self.high)


Variation = Listed | Range


def read_variations(
    entries: Mapping[str, object], base: Mapping[str, Value], *, own: bool = False
) -> tuple[Variation, ...]:
    """Return the variations of the `settings` section of a request.

    For a list of numbers, `low` and `high` may be lists, and each number varies by itself. `base`
    has the values of all settings before; `own` allows the text "own" for the range of `own_range`.
    Raises SettingsError for an unknown setting, an empty range, or values that the setting rejects.
    """
    fields = {field.name: field for field in setting_fields(Settings)}
    found: list[Variation] = []
    with errors_in("settings"):
        for name, given in entries.items():
            if name not in fields:
                raise SettingsError(unknown_name(name, fields))
            if own and given == OWN:
                found += own_range(fields[name], base[name])
            elif isinstance(given, Mapping):
                found += _ranges(fields[name], given, base[name])
            else:
                found.append(_listed(fields[name], given))
    return tuple(found)


def own_range(field: SettingField, value: Value) -> list[Variation]:
    """Return a setting's choices, or a tenth to ten times its value within limits, all for 0.

    Raises SettingsError if that is infinite, or if the setting is a text.
    """
    if field.kind is bool:
        return [Listed(field, (False, True))]
    if field.spec.choices:
        return [Listed(field, tuple(field.spec.choices))]
    if field.kind is str:
        raise SettingsError(f"setting '{field.name}' is a text: list the values to try")
    items = value if isinstance(value, tuple) else (value,)
    found: list[Variation] = []
    for place, number in enumerate(items):
        assert isinstance(number, int | float)  # no other kinds are left
        item = place if isinstance(value, tuple) else None
        low, high, log = field.spec.low, field.spec.high, False
        if math.isfinite(number) and number != 0.0:
            ends = sorted((number / _OWN_FACTOR, number * _OWN_FACTOR))
            low, high, log = max(low, ends[0]), min(high, ends[1]), number > 0.0
        if not (math.isfinite(low) and math.isfinite(high)):
            raise SettingsError(
                f"setting '{field.name}' is {number:g}, which has no range of its own: give "
                "{low: ..., high: ...}"
            )
        if (field.item_kind or field.kind) is int:
            low, high = math.ceil(low), math.floor(high)
        found.append(Range(field, item, low, high, log))
    return found


def settings_values(values: Mapping[str, Value], base: Mapping[str, Value]) -> dict[str, Value]:
    """Return values by setting, where numbers of a list are put into their list in `base`."""
    found: dict[str, Value] = {}
    for name, value in values.items():
        setting, bracket, place = name.partition("[")
        if not bracket:
            found[setting] = value
            continue
        items = list(found.get(setting, base[setting]))  # type: ignore[arg-type]  # it is a list
        items[int(place[:-1])] = value
        found[setting] = tuple(items)  # type: ignore[assignment]  # numbers of one kind
    return found


def _listed(field: SettingField, given: object) -> Listed:
    if not isinstance(given, list):
        raise SettingsError(
            f"setting '{field.name}' is {given!r}, but must be a list of values to try, or a "
            f"range: {_RANGE_FORM}"
        )
    if not given:
        raise SettingsError(f"setting '{field.name}' has an empty list: give a value to try")
    values = tuple(checked(field, value) for value in given)
    if len(set(values)) < len(values):
        raise SettingsError(f"setting '{field.name}' lists a value twice: {given}")
    return Listed(field, values)


def _ranges(field: SettingField, given: Mapping[str, object], value: Value) -> list[Variation]:
    """Return the range of a number, or the ranges of the numbers of a list."""
    unknown = sorted(set(map(str, given)) - {"low", "high", "log"})
    if unknown or not {"low", "high"} <= set(given):
        raise SettingsError(f"setting '{field.name}' is {dict(given)}, but {_RANGE_FORM}")
    log = given.get("log", False)
    if not isinstance(log, bool):
        raise SettingsError(f"setting '{field.name}' has log: {log}, but must be true or false")
    if (field.item_kind or field.kind) not in (int, float):
        raise SettingsError(
            f"setting '{field.name}' is {field.type_name} and has no range: list the values to try"
        )
    numbers = value if isinstance(value, tuple) else (value,)
    ends: list[tuple[Value, ...]] = []
    for end in ("low", "high"):
        if field.item_kind is None:
            ends.append((checked(field, given[end]),))
        else:
            same = [given[end]] * len(numbers)  # for all numbers of the list
            found = checked(field, given[end] if isinstance(given[end], list) else same)
            assert isinstance(found, tuple)  # the setting is a list
            ends.append(found)
    lows, highs = ends
    if not len(lows) == len(highs) == len(numbers):
        raise SettingsError(
            f"setting '{field.name}' has {len(numbers)} values, but its range has {len(lows)} for "
            f"low and {len(highs)} for high"
        )
    places = [None] if field.item_kind is None else range(len(numbers))
    return [_range(field, *item, log) for item in zip(places, lows, highs, strict=True)]


def _range(field: SettingField, item: int | None, low: Value, high: Value, log: bool) -> Range:
    assert isinstance(low, int | float)  # checked by the setting's own type
    assert isinstance(high, int | float)
    found = Range(field, item, low, high, log)
    if not low < high:
        raise SettingsError(
            f"setting '{found.name}' has an empty range: low is {low:g} and high is {high:g}, but "
            "low must be below high"
        )
    if not (math.isfinite(low) and math.isfinite(high)):
        raise SettingsError(f"setting '{found.name}' has an infinite range: give finite numbers")
    if log and low <= 0.0:
        raise SettingsError(
            f"setting '{found.name}' has log: true, but low is {low:g}: it must be above 0"
        )
    return found
