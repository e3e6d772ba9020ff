"""Types of ROS messages for Cyclone DDS, made at run time from their definitions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cyclonedds import idl
from rosbags.interfaces import Nodetype

from cortex_ros2_bridge.backend.names import dds_type_of
from cortex_ros2_bridge.typestore import check_type, typestore

types: Any = idl.types
"""Types of fields; mypy does not see that they take parameters."""
_structs: dict[tuple[str, str, bool], Any] = {}


def idl_struct(type_name: str, distro: str, header: Mapping[str, Any] | None = None) -> Any:
    """Return the class of cyclonedds for a message, as a distribution defines it.

    Fields of a `header`, always the same ones for a type, go before its own.

    Raises:
        ValueError: The type is unknown, or has a field for which DDS has no type.
    """
    key = type_name, distro, header is not None
    if key not in _structs:
        check_type(type_name, distro)
        definition = typestore(distro).fielddefs[type_name][1]
        fields = {name: _field(description, distro) for name, description in definition}
        name = dds_type_of(type_name)
        _structs[key] = idl.make_idl_struct(
            name.rpartition("::")[2], name.replace("::", "."), {**(header or {}), **fields}
        )
    return _structs[key]


def _field(description: Any, distro: str) -> Any:
    kind, detail = description
    if kind == Nodetype.BASE:
        base, bound = detail
        if base == "string":
            return types.bounded_str[bound] if bound else str
        if base not in (*_SCALARS, "bool"):
            raise ValueError(f"fields of type {base} are not supported")
        return bool if base == "bool" else getattr(types, _SCALARS[base])
    if kind == Nodetype.NAME:
        return idl_struct(detail, distro)
    element, count = detail
    inner = _field(element, distro)
    if kind == Nodetype.ARRAY:
        return types.array[inner, count]
    return types.sequence[inner, count] if count else types.sequence[inner]


_SCALARS = {
    **{name: name for name in ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")},
    "float32": "float32",
    "float64": "float64",
    "byte": "byte",
    "octet": "byte",
    "char": "uint8",  # so rosidl has it
}
"""Types in .msg files, and what rosidl makes of them in IDL: nodes that compare types accept no other."""
