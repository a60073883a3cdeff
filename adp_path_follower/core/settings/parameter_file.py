"""ROS parameter files: settings from YAML and ``NAME=VALUE``, and back to YAML."""

import textwrap
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path as FilePath
from typing import TypeVar

import yaml

from adp_path_follower.core.errors import FileError, SettingsError
from adp_path_follower.core.files import parse_yaml, read_text, read_yaml
from adp_path_follower.core.settings.schema import build, flatten, titled_fields, yaml_text

Tree = TypeVar("Tree")

# Parameters that every ROS 2 node has; they are no settings of ours.
ROS_NAMES = ("use_sim_time", "start_type_description_service")
ROS_PREFIXES = ("qos_overrides.",)


def load_settings(
    tree: type[Tree],
    node: str,
    file: FilePath | None = None,
    assignments: Iterable[str] = (),
    complete: Callable[[Mapping[str, object]], Mapping[str, object]] = dict,
) -> Tree:
    """Return a tree of settings from a parameter file and ``NAME=VALUE`` assignments, which win.

    Without a file the defaults count, of a file the node's sections; `complete` adds to the values
    of both. Raises FileError for a file that cannot be read or has none for this node,
    SettingsError for a setting that is unknown, of the wrong type or out of range.
    """
    given = read_parameters(file, node) if file is not None else {}
    for assignment in assignments:
        name, value = parse_assignment(assignment)
        given[name] = value
    try:
        return build(tree, complete(given))
    except SettingsError as error:
        raise SettingsError(f"{_place(file, str(error))}{error}") from None


def _place(file: FilePath | None, message: str) -> str:
    """Return file and line of the parameter that a message is about, empty if it is in none."""
    if file is None:
        return ""
    for number, line in enumerate(read_text(file).splitlines(), start=1):
        key = line.partition(":")[0].strip().strip("'\"")
        if key and f"setting '{key}'" in message:
            return f"file {file}, line {number}: "
    return ""


def parse_assignment(text: str) -> tuple[str, object]:
    """Return name and value of "NAME=VALUE"; SettingsError without "=", or if it is not YAML."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise SettingsError(f"'{text}' is not NAME=VALUE, as in max_linear_vel=0.5")
    try:
        return name.strip(), parse_yaml(value)
    except yaml.YAMLError:
        raise SettingsError(
            f"setting '{name.strip()}' has the value '{value}', which is not YAML"
        ) from None


def read_parameters(file: FilePath, node: str) -> dict[str, object]:
    """Return the parameters that a ROS parameter file gives a node, without ROS's own.

    The sections "/**", "/**/node", "node" and "/name/space/node" count, in their order. Raises
    FileError if the file cannot be read, or has no section for the node.
    """
    content = read_yaml(file)
    if not isinstance(content, Mapping):
        raise FileError(f"file {file} is no ROS parameter file: {_FORM.format(node=node)}")
    found: dict[str, object] = {}
    matched = False
    for key, section in content.items():
        if str(key).rsplit("/", 1)[-1] not in ("**", node):
            continue
        parameters = section.get("ros__parameters") if isinstance(section, Mapping) else None
        if not isinstance(parameters, Mapping):
            raise FileError(f"file {file}: '{key}' has no 'ros__parameters' with NAME: VALUE")
        matched = True
        found.update({str(name): value for name, value in parameters.items()})
    if not matched:
        raise FileError(f"file {file} has no parameters for '{node}': {_FORM.format(node=node)}")
    return own_parameters(found)


def own_parameters(parameters: Mapping[str, object]) -> dict[str, object]:
    """Return the parameters that are not ROS's own."""
    return {
        name: value
        for name, value in parameters.items()
        if name not in ROS_NAMES and not name.startswith(ROS_PREFIXES)
    }


def parameter_file_text(settings: object, node: str) -> str:
    """Return settings as a commented ROS parameter file."""
    lines = [f"/**/{node}:", "  ros__parameters:"]
    values = flatten(settings)
    for title, field in titled_fields(type(settings)):
        if title:
            lines += ["", f"    # --- {title} ---"]
        unit = f" [{field.spec.unit}]" if field.spec.unit else ""
        symbol = f"{field.spec.symbol}: " if field.spec.symbol else ""
        allowed = f" Allowed: {field.range_text}." if field.range_text else ""
        text = f"{symbol}{field.spec.doc}{unit}{allowed}"
        lines += textwrap.wrap(text, 94, initial_indent="    # ", subsequent_indent="    # ")
        lines.append(f"    {field.name}: {yaml_text(values[field.name])}")
    return "\n".join(lines) + "\n"


_FORM = "it must have '/**/{node}:' with 'ros__parameters:' and NAME: VALUE below"
