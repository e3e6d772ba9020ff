"""What is wrong with a message that could not be encoded: slow, and only run after the fast path failed."""

from __future__ import annotations

import struct
from enum import Enum
from typing import Any

from cortex.encoder import as_array, shared_names
from cortex.layout import SCALAR_CODES, array_dtype
from cortex.schema import ArrayType, EnumType, FieldType, ListType, OptionalType, Schema


def explain(schema: Schema, cls: type, message: Any, error: Exception) -> Exception:
    """Return an exception that names the field, its value and what is allowed.

    Args:
        schema: What was to be encoded.
        cls: Its class.
        message: The message that failed.
        error: How it failed; returned as it is if nothing is wrong with any field.
    """
    try:
        _check_message(schema, cls, message, schema.name)
    except (TypeError, ValueError) as reason:
        return reason
    return error


def _check_message(schema: Schema, cls: type, message: Any, where: str) -> None:
    if type(message) is not cls:
        raise TypeError(f"{where}: got {type(message).__name__}, expected {cls.__name__}")
    scope: dict[str, int] = {}
    shared = shared_names([field.type for field in schema.fields])
    bindings = cls.__cortex_bindings__
    for field, bound in zip(schema.fields, bindings, strict=True):
        _check(field.type, bound, getattr(message, field.name), f"{where}.{field.name}", scope, shared)


def _check(
    kind: FieldType, bound: Any, value: Any, where: str, scope: dict[str, int], shared: frozenset[str]
) -> None:
    if isinstance(kind, OptionalType):
        if value is not None:
            _check(kind.item, bound, value, where, scope, shared)
    elif isinstance(kind, ListType):
        if not isinstance(value, (list, tuple)):
            raise TypeError(f"{where}: {value!r:.80} is no list")
        for index, item in enumerate(value):
            _check(kind.item, bound, item, f"{where}[{index}]", {}, shared_names([kind.item]))
    elif isinstance(kind, Schema):
        _check_message(kind, bound, value, where)
    elif isinstance(kind, EnumType):
        _check_enum(bound, value, where)
    elif isinstance(kind, ArrayType):
        _check_array(kind, value, where, scope, shared)
    else:
        _check_scalar(kind, value, where)


def _check_enum(bound: type[Enum], value: Any, where: str) -> None:
    if type(value) is not bound:
        allowed = ", ".join(str(member) for member in bound)
        what = f"the {type(value).__name__} {value!r:.80} is no {bound.__name__}"
        raise TypeError(f"{where}: {what}; use {bound.__name__}(value), allowed are {allowed}")


def _check_array(
    kind: ArrayType, value: Any, where: str, scope: dict[str, int], shared: frozenset[str]
) -> None:
    try:
        array = as_array(value, None if kind.dtype == "any" else array_dtype(kind))
    except TypeError as error:
        raise TypeError(f"{where}: {error}") from error
    expected = f"[{', '.join(str(size) for size in kind.shape)}]"
    if array.ndim != len(kind.shape):
        raise ValueError(f"{where}: shape {list(array.shape)}, expected {expected}")
    for actual, size in zip(array.shape, kind.shape, strict=True):
        if isinstance(size, int) and actual != size:
            raise ValueError(f"{where}: shape {list(array.shape)}, expected {expected}")
        if isinstance(size, str) and size in shared and scope.setdefault(size, actual) != actual:
            raise ValueError(
                f"{where}: dimension {size} is {actual}, but {scope[size]} in an earlier field of the message"
            )


def _check_scalar(kind: str, value: Any, where: str) -> None:
    if kind == "str":
        if not isinstance(value, str):
            raise TypeError(f"{where}: {value!r:.80} is no str")
        try:
            value.encode()
        except UnicodeEncodeError as error:
            raise ValueError(f"{where}: {value!r:.80} cannot be encoded as UTF-8: {error.reason}") from error
    elif kind == "bytes":
        if not isinstance(value, bytes):
            raise TypeError(f"{where}: {value!r:.80} is no bytes object")
    elif kind == "bool":
        try:
            known = value in (False, True)
        except ValueError:  # an array has no truth value
            known = False
        if not known:
            raise TypeError(f"{where}: {value!r:.80} is no bool")
    else:
        _check_number(kind, value, where)


def _check_number(kind: str, value: Any, where: str) -> None:
    is_number = hasattr(value, "__index__") or (kind.startswith("float") and hasattr(value, "__float__"))
    if not is_number:
        raise TypeError(f"{where}: {value!r:.80} is no number for {kind}")
    try:
        struct.pack(f"<{SCALAR_CODES[kind]}", value)
    except (struct.error, OverflowError) as error:
        raise ValueError(f"{where}: {value!r:.80} is out of the range of {kind}") from error
