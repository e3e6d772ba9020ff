"""Message types: frozen dataclasses whose annotations say what goes over the wire.

    @message
    class Scan:
        stamp_ns: int
        ranges: Annotated[Array["float32", "beams"], Unit("m", frame="lidar")]
        mode: Mode = Mode.FAST

Fields are `bool`, `int` (int64), `float` (float64), the sized numbers of this module, `str`, `bytes`, enums
of integers, `Array`, other messages, `list[T]` and `T | None`.
"""

from __future__ import annotations

import dataclasses
import inspect
import sys
import types
import typing
from collections.abc import Callable, Mapping
from enum import Enum, Flag
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, Union, overload

import numpy as np

from cortex import schema
from cortex.compiled import native
from cortex.schema import Unit as Unit
from cortex.structure import finish_class

_T = TypeVar("_T")
_HASTENED_FIELDS_MAX = 64


@dataclasses.dataclass(frozen=True)
class _Scalar:
    """Marks an int or a float with its type on the wire."""

    name: str


Int8 = Annotated[int, _Scalar("int8")]
Int16 = Annotated[int, _Scalar("int16")]
Int32 = Annotated[int, _Scalar("int32")]
Int64 = Annotated[int, _Scalar("int64")]
UInt8 = Annotated[int, _Scalar("uint8")]
UInt16 = Annotated[int, _Scalar("uint16")]
UInt32 = Annotated[int, _Scalar("uint32")]
UInt64 = Annotated[int, _Scalar("uint64")]
Float32 = Annotated[float, _Scalar("float32")]
Float64 = Annotated[float, _Scalar("float64")]

if TYPE_CHECKING:
    from typing_extensions import dataclass_transform

    Array: Any  # strings in the brackets are no forward references; arrays and tensors are both welcome
else:

    class Array:
        """Annotation of an array field: the dtype, then one size or name for each dimension.

        `Array["float32", "n"]`, `Array["uint8", "height", "width", 3]`, `Array[np.float64, 3]`; `"any"`
        leaves the dtype open. Dimensions of one name have one size within a message. With integers only,
        the array lies in the fixed block of the message.
        """

        def __class_getitem__(cls, parameters: Any) -> Any:
            dtype, *shape = parameters if isinstance(parameters, tuple) else (parameters,)
            return Annotated[np.ndarray, schema.ArrayType(_dtype_name(dtype), tuple(shape))]

    def dataclass_transform(**_: Any) -> Callable[[_T], _T]:  # noqa: D103
        return lambda decorated: decorated


@overload
@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def message(cls: type[_T], /, *, name: str | None = ...) -> type[_T]: ...


@overload
@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def message(cls: None = ..., /, *, name: str | None = ...) -> Callable[[type[_T]], type[_T]]: ...


def message(cls: Any = None, /, *, name: str | None = None) -> Any:
    """Make a class a message type: a frozen dataclass with slots, a schema and a fingerprint.

    Messages compare by value, arrays included, and so are not hashable. `copy()` returns a deep copy with
    writable arrays (`copy.deepcopy` does the same, and type checkers know it). Decoding does not run
    `__init__` or `__post_init__`.

    Args:
        cls: Class with annotated fields.
        name: Name of the type on the wire; the class name by default. It is part of the fingerprint, the
            module is not.

    Raises:
        SchemaError: A field's annotation has no place in a message.
        TypeError: As `dataclasses.dataclass` does.
    """
    scope = sys._getframe(1).f_locals
    if cls is None:
        return lambda decorated: _make_message(decorated, name, scope)
    return _make_message(cls, name, scope)


def is_message(value: object) -> bool:
    """Whether a value is a message or a message type."""
    kind = value if isinstance(value, type) else type(value)
    return "__cortex_schema__" in vars(kind)


def _make_message(cls: type, name: str | None, scope: Mapping[str, Any]) -> type[Any]:
    for key in inspect.get_annotations(cls):
        if isinstance(vars(cls).get(key), np.ndarray):  # dataclasses refuse the other mutable ones
            raise TypeError(
                f"{cls.__name__}.{key}: a mutable default would be shared; use field(default_factory=...)"
            )
    hints = _resolve_hints(cls, scope)
    own_init = "__init__" in vars(cls)
    decorated: type[Any] = dataclasses.dataclass(frozen=True, slots=True, eq=False, repr=False)(cls)
    names = tuple(field.name for field in dataclasses.fields(decorated))
    if "copy" in names:
        raise schema.SchemaError(f"{cls.__name__}.copy: the name is that of a method of every message")
    fields, bindings = [], []
    for field_name in names:
        where = f"{cls.__name__}.{field_name}"
        try:
            kind, bound, unit = _read_hint(hints[field_name], where)
            fields.append(schema.Field(field_name, kind, *(unit or ("", ""))))
        except schema.SchemaError as error:
            if str(error).startswith(where):
                raise
            raise schema.SchemaError(f"{where}: {error}") from error
        bindings.append(bound)
    schema.attach_schema(decorated, schema.Schema(name or cls.__name__, tuple(fields)), tuple(bindings))
    finish_class(decorated, names, _plain_init(names))
    if not own_init:
        _hasten(decorated)
    return decorated


def _hasten(cls: type[Any]) -> None:
    """Let C do the work of a generated `__init__` that sets all fields from arguments, and nothing else."""
    fields = dataclasses.fields(cls)
    arguments = list(inspect.signature(cls.__init__).parameters.values())[1:]
    plain = (
        native is not None
        and type(cls) is type
        and not hasattr(cls, "__post_init__")
        and not any("__new__" in vars(base) for base in cls.__mro__[:-1])
        and [argument.name for argument in arguments] == [field.name for field in fields]
        and all(argument.kind is argument.POSITIONAL_OR_KEYWORD for argument in arguments)
        and len(fields) <= _HASTENED_FIELDS_MAX
    )
    if plain:
        names = tuple(sys.intern(field.name) for field in fields)
        native.hasten(cls, names, tuple(field.default for field in fields), dataclasses.MISSING)


def _plain_init(names: tuple[str, ...]) -> Callable[..., None]:
    # dataclasses writes `self.a = a` for each field, which runs at full speed on the shell.
    plain = dataclasses.make_dataclass("_Plain", [(name, Any) for name in names], eq=False, repr=False)
    return typing.cast("Callable[..., None]", plain.__init__)  # type: ignore[misc]


def _resolve_hints(cls: type, scope: Mapping[str, Any]) -> dict[str, Any]:
    try:
        return typing.get_type_hints(cls, localns=dict(scope), include_extras=True)
    except NameError as error:
        raise schema.SchemaError(
            f"{cls.__name__}: an annotation cannot be resolved: {error}. A message cannot contain itself, "
            "and the types of its fields must be defined before it"
        ) from error


def _dtype_name(dtype: Any) -> str:
    if isinstance(dtype, str) and dtype == schema.ANY_DTYPE:
        return dtype
    try:
        resolved = np.dtype(dtype)
    except TypeError as error:
        raise schema.SchemaError(f"array dtype {dtype!r} is unknown") from error
    if not resolved.isnative:
        raise schema.SchemaError(f"array dtype {dtype!r}: the byte order of messages is always little-endian")
    return str(resolved.name)


_Reading = tuple[schema.FieldType, Any, "tuple[str, str] | None"]


def _read_hint(hint: Any, where: str) -> _Reading:
    origin = typing.get_origin(hint)
    if origin is Annotated:
        return _read_annotated(hint, where)
    if origin is Union or origin is types.UnionType:
        items = [item for item in typing.get_args(hint) if item is not types.NoneType]
        if len(items) != 1 or len(typing.get_args(hint)) != 2:
            raise schema.SchemaError(f"{where}: {hint} is a union; only T | None is allowed")
        kind, bound, unit = _read_hint(items[0], where)
        return schema.OptionalType(kind), bound, unit
    if origin is list:
        kind, bound, unit = _read_hint(typing.get_args(hint)[0], where)
        return schema.ListType(kind), bound, unit
    plain = {bool: "bool", int: "int64", float: "float64", str: "str", bytes: "bytes"}
    if isinstance(hint, type):
        if hint in plain:
            return plain[hint], None, None
        if issubclass(hint, Enum):
            return _read_enum(hint, where), hint, None
        if "__cortex_schema__" in vars(hint):
            return hint.__cortex_schema__, hint, None  # type: ignore[attr-defined]
    raise schema.SchemaError(
        f"{where}: {hint!r} cannot be a field; allowed are bool, int, float, sized numbers such as Int32, "
        "str, bytes, enums of integers, Array[dtype, *shape], message types, list[T] and T | None"
    )


def _read_annotated(hint: Any, where: str) -> _Reading:
    base, *metadata = typing.get_args(hint)
    kinds = [item for item in metadata if isinstance(item, (_Scalar, schema.ArrayType))]
    units = [(item.unit, item.frame) for item in metadata if isinstance(item, Unit)]
    if len(kinds) > 1:
        raise schema.SchemaError(f"{where}: more than one type in {hint}")
    if not kinds:
        kind, bound, unit = _read_hint(base, where)
    elif isinstance(kinds[0], _Scalar):
        kind, bound, unit = kinds[0].name, None, None
    else:
        kind, bound, unit = kinds[0], None, None
    units += [unit] if unit else []
    if len(units) > 1:
        raise schema.SchemaError(f"{where}: more than one unit: {units}")
    return kind, bound, units[0] if units else None


def _read_enum(hint: type[Enum], where: str) -> schema.EnumType:
    values = tuple((name, member.value) for name, member in hint.__members__.items())
    if issubclass(hint, Flag) or any(type(value) is not int for _, value in values):
        raise schema.SchemaError(f"{where}: {hint.__name__} must be an enum (no Flag) of integers")
    return schema.EnumType(hint.__name__, values)
