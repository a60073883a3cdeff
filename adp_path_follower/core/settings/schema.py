"""Settings as frozen dataclasses: one declaration gives type, default, unit, range and text.

A settings *tree* is a frozen dataclass whose fields are *groups*: frozen dataclasses whose fields
are made by `setting`. Names are unique over the tree, so a YAML file, a ROS parameter list and
``--set NAME=VALUE`` are all flat. Files, ROS descriptors and the parameter table read the same
declaration, so they cannot disagree.
"""

import dataclasses
import difflib
import functools
import math
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import yaml

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.registry import Registry

Value = bool | int | float | str | tuple[float, ...] | tuple[int, ...] | tuple[str, ...]
Tree = TypeVar("Tree")

POSITIVE = 1e-9  # as the lowest value of a setting: it must be above zero


@dataclass(frozen=True)
class Spec:
    """Describe one setting: what the dataclass field itself does not say."""

    doc: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    registry: Registry[Any] | None = None  # whose names are choices, too
    lengths: tuple[int, ...] = ()
    read_only: str = ""
    symbol: str = ""


@dataclass(frozen=True)
class SettingField:
    """One setting of a tree, as files, ROS and the docs see it."""

    group: str
    name: str
    kind: type
    item_kind: type | None
    default: Value
    spec: Spec

    @property
    def type_name(self) -> str:
        """Return the type in words, e.g. "list of numbers"."""
        words = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}
        plural = {int: "integers", float: "numbers", str: "texts"}
        if self.item_kind is not None:
            return f"list of {plural[self.item_kind]}"
        return words[self.kind]

    @property
    def range_text(self) -> str:
        """Return the allowed values in words, empty where anything of the type will do."""
        spec = self.spec
        if spec.choices:
            own = ", or registered by a plugin" if spec.registry is not None else ""
            return f"one of {', '.join(spec.choices)}{own}"
        parts = []
        if spec.lengths:
            parts.append(" or ".join(str(n) for n in spec.lengths) + " values")
        if spec.low == POSITIVE:
            parts.append("above 0")
        elif spec.low > -math.inf:
            parts.append(f"at least {spec.low:g}")
        if spec.high < math.inf:
            parts.append(f"at most {spec.high:g}")
        return ", ".join(parts)

    @property
    def allowed(self) -> str:
        """Return type and allowed values in words."""
        if self.spec.choices:
            own = [] if self.spec.registry is None else list(self.spec.registry.parts())
            return self.range_text + (f" ({', '.join(own)})" if own else "")
        article = "a " if self.item_kind is not None else ""
        return ", ".join(filter(None, [article + self.type_name, self.range_text]))


def setting(default: Any, doc: str, **spec: Any) -> Any:
    """Declare a setting: a dataclass field with its default, doc and `Spec` keywords.

    The type of a list of fixed length says it, as `tuple[float, float]` does.
    """
    return dataclasses.field(default=default, metadata={"spec": Spec(doc=doc, **spec)})


def limit(doc: str, **spec: Any) -> Any:
    """Declare a limit above zero; by default it is infinite, which is none."""
    return setting(math.inf, doc, low=POSITIVE, **spec)


@functools.cache  # as they are slow to look up, and settings are made by the thousand in sweeps
def _hints(owner: Any) -> dict[str, Any]:
    return typing.get_type_hints(owner)


def setting_fields(tree: Any) -> tuple[SettingField, ...]:
    """Return every setting of a tree (a class), in order of declaration."""
    return _fields_of(tree)


@functools.cache
def _fields_of(tree: Any) -> tuple[SettingField, ...]:
    found = []
    for group_name, group in _hints(tree).items():
        hints = _hints(group)
        for field in dataclasses.fields(group):
            hint, spec = hints[field.name], field.metadata["spec"]
            items = typing.get_args(hint)  # of a list, else none
            if items and items[-1] is not Ellipsis:
                spec = dataclasses.replace(spec, lengths=(len(items),))
            found.append(
                SettingField(
                    group=group_name,
                    name=field.name,
                    kind=tuple if items else hint,
                    item_kind=items[0] if items else None,
                    default=typing.cast("Any", field.default),
                    spec=spec,
                )
            )
    names = [field.name for field in found]
    if len(set(names)) != len(names):
        raise TypeError(f"setting names of {tree.__name__} must be unique")
    return tuple(found)


def build(tree: type[Tree], values: Mapping[str, object]) -> Tree:
    """Return the settings tree with these values, the rest at their defaults.

    Raises SettingsError for an unknown name, a wrong type, a value out of range, or values that do
    not fit each other; the message names setting, value and what is allowed.
    """
    fields = {field.name: field for field in setting_fields(tree)}
    grouped: dict[str, dict[str, Value]] = {field.group: {} for field in fields.values()}
    for name, value in values.items():
        if name not in fields:
            raise SettingsError(unknown_name(name, fields))
        field = fields[name]
        grouped[field.group][name] = checked(field, value)
    hints = _hints(typing.cast("Any", tree))  # a class, which mypy takes for unhashable
    return tree(**{group: hints[group](**found) for group, found in grouped.items()})


def update(current: Tree, values: Mapping[str, object]) -> Tree:
    """Return the settings with some values replaced, checked like `build` does."""
    return build(type(current), {**flatten(current), **values})


def flatten(tree: object) -> dict[str, Value]:
    """Return all settings of a tree as name: value."""
    return {
        field.name: getattr(getattr(tree, field.group), field.name)
        for field in setting_fields(type(tree))
    }


def unknown_name(name: str, known: Sequence[str] | Mapping[str, object]) -> str:
    """Return the sentence that rejects an unknown setting and proposes the nearest known one."""
    near = difflib.get_close_matches(name, list(known), n=1)
    hint = f"; did you mean '{near[0]}'?" if near else "; `adp parameters` lists all of them"
    return f"unknown setting '{name}'{hint}"


def checked(field: SettingField, value: object) -> Value:
    """Return the value in the setting's own type; SettingsError for a wrong type or range."""
    try:
        if field.item_kind is None:
            item: Value = _checked_item(field.kind, field.spec, value)
            return item
        if hasattr(value, "tolist"):  # ROS hands over an array.array, Python code a numpy array
            value = value.tolist()
        if not isinstance(value, list | tuple):
            raise ValueError
        if field.spec.lengths and len(value) not in field.spec.lengths:
            raise ValueError
        return tuple(_checked_item(field.item_kind, field.spec, item) for item in value)
    except ValueError:
        shown = list(value) if isinstance(value, tuple) else value
        unit = f" [{field.spec.unit}]" if field.spec.unit else ""
        raise SettingsError(
            f"setting '{field.name}' is {shown!r}, but must be {field.allowed}{unit}"
        ) from None


def _checked_item(kind: type, spec: Spec, value: object) -> Any:
    """Return one value in its type, or raise ValueError."""
    # bool is an int to Python, but `true` for a speed is a mistake.
    if isinstance(value, bool) is not (kind is bool):
        raise ValueError
    if kind is float and isinstance(value, int) and abs(value) < 2**53:
        value = float(value)
    if not isinstance(value, kind) or not _is_choice(spec, value):
        raise ValueError
    if isinstance(value, int | float) and not spec.low <= value <= spec.high:  # rejects NaN too
        raise ValueError
    return value


_SIGNS = {"at least ": "≥", "at most ": "≤", "above ": ">", "one of ": ""}


def _is_choice(spec: Spec, value: object) -> bool:
    if not spec.choices or value in spec.choices:
        return True
    return spec.registry is not None and spec.registry.find(str(value)) is not None


def describe_table(tree: type) -> str:
    """Return the settings of a tree as Markdown lists, one for each group."""
    lines: list[str] = []
    for title, field in titled_fields(tree):
        if title:
            lines += ["", f"### {title}", ""]
        spec = field.spec
        symbol = f" {spec.symbol}" if spec.symbol else ""
        default = f"`{yaml_text(field.default)}` {spec.unit}".strip()
        allowed = field.range_text
        for words, sign in _SIGNS.items():
            allowed = allowed.replace(words, sign)
        allowed = "; ".join(filter(None, [allowed, "fixed" * bool(spec.read_only)]))
        limits = f" ({allowed})" if allowed else ""
        lines.append(f"- `{field.name}`{symbol} = {default}{limits}: {spec.doc}")
    return "\n".join(lines).strip() + "\n"


def yaml_text(value: Value) -> str:
    """Return a value as YAML that the ROS parameter parser reads with the same type.

    That parser rejects lists that mix integers and floats, and takes ``1`` for an integer, so a
    float always carries its point.
    """
    if isinstance(value, tuple):
        return "[" + ", ".join(yaml_text(item) for item in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        if math.isinf(value):
            return ".inf" if value > 0 else "-.inf"
        text = repr(value)
        return text if "e" not in text or "." in text else text.replace("e", ".0e")
    if isinstance(value, str):
        return yaml.safe_dump(value, default_style='"', width=math.inf, allow_unicode=True).strip()
    return str(value)


def titled_fields(tree: type) -> Iterator[tuple[str, SettingField]]:
    """Yield a tree's settings, the first of a group with the title that its docstring gives it."""
    before = ""
    for field in setting_fields(tree):
        title = (_hints(tree)[field.group].__doc__ or "").splitlines()[0].rstrip(".")
        yield title * (field.group != before), field
        before = field.group
