"""Values of ROS parameters, as messages hold them."""

from __future__ import annotations

from typing import Any

import numpy as np

from cortex_ros2_bridge.msgs import message_class

_KINDS: tuple[tuple[int, str, type, bool], ...] = (
    (1, "bool_value", bool, False),
    (2, "integer_value", int, False),
    (3, "double_value", float, False),
    (4, "string_value", str, False),
    (6, "bool_array_value", bool, True),
    (7, "integer_array_value", int, True),
    (8, "double_array_value", float, True),
    (9, "string_array_value", str, True),
)
"""As in rcl_interfaces/ParameterType: number, field of ParameterValue, type, whether it is an array."""


def kind_of(value: Any) -> tuple[int, str]:
    """Return the type of a value as rcl_interfaces/ParameterType, and the field that holds it."""
    one = value[0] if isinstance(value, list) and value else "" if isinstance(value, list) else value
    for number, field, kind, is_array in _KINDS:
        if is_array == isinstance(value, list) and type(one) is kind:
            return number, field
    return 0, ""


def message_of(value: Any) -> Any:
    """Return a value as rcl_interfaces/ParameterValue."""
    message = message_class("rcl_interfaces/msg/ParameterValue")()
    message.type, field = kind_of(value)
    if field:
        setattr(message, field, value)
    return message


def value_of(message: Any) -> Any:
    """Return the value in a rcl_interfaces/ParameterValue; None if there is none."""
    for number, field, _, _ in _KINDS:
        if number == message.type:
            value = getattr(message, field)
            return value.tolist() if isinstance(value, np.ndarray) else value
    return None
