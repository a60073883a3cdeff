"""A settings tree as ROS parameters."""

from __future__ import annotations

from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from adp_path_follower.core.parameter_file import own_parameters
from adp_path_follower.core.schema import SettingField, build, flatten, setting_fields, update

Tree = TypeVar("Tree")


def declare_settings(node: Node, tree: type[Tree]) -> Tree:
    """Declare every setting of a tree as a parameter and return the settings.

    The node must have been made with ``automatically_declare_parameters_from_overrides=True``,
    so that names in a parameter file that are no settings are seen, and refused.

    Raises:
        SettingsError: A parameter given to the node is unknown, of the wrong type or out of
            range.

    """
    given = own_values(list(node.get_parameters_by_prefix("").values()))
    settings = build(tree, given)
    values = flatten(settings)
    for field in setting_fields(tree):
        if node.has_parameter(field.name):
            node.undeclare_parameter(field.name)
        node.declare_parameter(
            field.name, _ros_value(values[field.name]), descriptor(field), ignore_override=True
        )
    return settings


def changed_settings(current: Tree, parameters: list[Parameter]) -> Tree:
    """Return the settings after a change of parameters.

    Raises:
        SettingsError: A value is of the wrong type, out of range, or does not fit the others.

    """
    return update(current, own_values(parameters))


def own_values(parameters: list[Parameter]) -> dict[str, object]:
    """Return name: value of the parameters that are not ROS's own."""
    return own_parameters({parameter.name: parameter.value for parameter in parameters})


def descriptor(field: SettingField) -> ParameterDescriptor:
    """Return the ROS parameter descriptor of a setting."""
    spec = field.spec
    result = ParameterDescriptor(
        name=field.name,
        description=" ".join(filter(None, [spec.doc, f"[{spec.unit}]" if spec.unit else ""])),
        additional_constraints="; ".join(
            filter(None, [field.range_text, f"read-only: {spec.read_only}" * bool(spec.read_only)])
        ),
        read_only=bool(spec.read_only),
        # So that `1` is accepted where `1.0` is meant; types are checked by the settings.
        dynamic_typing=True,
    )
    bounded = spec.low > -float("inf") or spec.high < float("inf")
    if field.kind is float and bounded:
        result.floating_point_range = [FloatingPointRange(from_value=spec.low, to_value=spec.high)]
    if field.kind is int and bounded:
        result.integer_range = [IntegerRange(from_value=int(spec.low), to_value=int(spec.high))]
    return result


def _ros_value(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
