"""A settings tree as ROS parameters."""

from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.settings.parameter_file import own_parameters
from adp_path_follower.core.settings.schema import (
    SettingField,
    build,
    checked,
    flatten,
    setting_fields,
    update,
)

Tree = TypeVar("Tree")


def declare_settings(
    node: Node,
    tree: type[Tree],
    complete: Callable[[Mapping[str, object]], Mapping[str, object]] = dict,
) -> Tree:
    """Declare every setting of a tree as a parameter; SettingsError for a wrong or unknown one.

    `complete` adds to the values that were given. The node must have
    ``automatically_declare_parameters_from_overrides=True`` to see unknown names.
    """
    given = own_values(list(node.get_parameters_by_prefix("").values()))
    settings = build(tree, complete(given))
    values = flatten(settings)
    for field in setting_fields(tree):
        if node.has_parameter(field.name):
            node.undeclare_parameter(field.name)
        node.declare_parameter(
            field.name, _ros_value(values[field.name]), descriptor(field), ignore_override=True
        )
    return settings


class LiveSettings(Generic[Tree]):
    """Parameters that change while a node runs: checked as a set, then taken over at once.

    ROS asks first whether it may change some parameters, and tells when it has. A change that
    another callback rejects must leave the node as it was, so the change is prepared when ROS asks,
    and taken over when it tells.
    """

    def __init__(
        self, node: Node, settings: Tree, prepare: Callable[[Tree], Callable[[], None]]
    ) -> None:
        """Take part in a node's changes; `prepare` returns what takes one over, else AdpError."""
        self._node, self._settings, self._prepare = node, settings, prepare
        self._fields = {field.name: field for field in setting_fields(type(settings))}
        self._prepared: tuple[Tree, Callable[[], None]] | None = None
        node.add_pre_set_parameters_callback(lambda changes: [*map(self._typed, changes)])
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take_over)

    def _typed(self, parameter: Parameter) -> Parameter:
        """Return a parameter typed as its setting: `ros2 param load` sends 1.0e-06 as a text."""
        field = self._fields.get(parameter.name)
        if field is None or float not in (field.kind, field.item_kind):
            return parameter
        value: Any = parameter.value
        try:
            if parameter.type_ is Parameter.Type.STRING and field.kind is float:
                value = float(value)
            elif parameter.type_ not in (Parameter.Type.INTEGER, Parameter.Type.INTEGER_ARRAY):
                return parameter
            return Parameter(parameter.name, value=_ros_value(checked(field, value)))
        except ValueError:  # it is rejected in a moment, with all others
            pass
        return parameter

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        """Reject a change with one sentence, or prepare it."""
        self._prepared = None
        try:
            settings = update(self._settings, own_values(parameters))
            if settings != self._settings:
                self._prepared = settings, self._prepare(settings)
        except AdpError as error:
            self._describe_present(parameters)
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _describe_present(self, parameters: list[Parameter]) -> None:
        """Let descriptions keep the types of the values that stay; rclpy has changed them."""
        for name in {parameter.name for parameter in parameters}:
            present = self._node.get_parameter(name)
            self._node.describe_parameter(name).type = present.type_.value

    def _take_over(self, parameters: list[Parameter]) -> None:
        if self._prepared is not None:
            self._settings, take_over = self._prepared
            self._prepared = None
            take_over()


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
