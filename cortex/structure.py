"""Message classes as Python objects: frozen, slotted, compared by value, copied deeply."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, TypeVar

import numpy as np

_T = TypeVar("_T")

_MAX_SHOWN_ITEMS = 8
_MAX_SHOWN_TEXT = 64


def make_class(name: str, field_names: Sequence[str]) -> type[Any]:
    """Build a frozen class with slots for field names that came over the wire, without generating code.

    Args:
        name: Name of the class.
        field_names: Valid identifiers; keywords are fine.
    """
    names = tuple(field_names)

    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        for field, value in _match_arguments(name, names, args, kwargs):
            object.__setattr__(self, field, value)

    def shell_init(self: Any, *args: Any) -> None:
        for field, value in zip(names, args, strict=True):
            setattr(self, field, value)

    namespace: dict[str, Any] = {
        "__slots__": names,
        "__annotations__": dict.fromkeys(names, object),
        "__module__": __name__,
        "__doc__": f"The message type {name}, made from a schema.",
        "__init__": init,
        "__setattr__": _refuse_set,
        "__delattr__": _refuse_delete,
        "__getstate__": _get_state,
        "__setstate__": _set_state,
    }
    created: type[Any] = dataclasses.dataclass(init=False, repr=False, eq=False)(type(name, (), namespace))
    finish_class(created, names, shell_init)
    return created


def finish_class(cls: type, names: tuple[str, ...], shell_init: Callable[..., None]) -> None:
    """Give a frozen slotted dataclass what every message has: equality, repr, `copy` and a shell.

    The shell, `__cortex_shell__`, is a subclass of the same layout that may be written to. Filling a shell
    and then changing its class is several times faster than `object.__setattr__` for each field.
    """
    methods: dict[str, Any] = {"__eq__": _equal, "__hash__": None, "__repr__": _show}
    for name, method in methods.items():
        if name not in vars(cls) or name == "__hash__":
            setattr(cls, name, method)
    if "copy" not in names:
        cls.copy = copy_message  # type: ignore[attr-defined]
    namespace = {
        "__slots__": (),
        "__init__": shell_init,
        # Both must go back to those of `object`: only then does CPython store attributes without a call.
        "__setattr__": object.__setattr__,
        "__delattr__": object.__delattr__,
    }
    cls.__cortex_names__ = names  # type: ignore[attr-defined]
    cls.__cortex_shell__ = type(cls.__name__, (cls,), namespace)  # type: ignore[attr-defined]


def new_message(cls: type[_T], values: Sequence[Any]) -> _T:
    """Build a message from the values of all its fields, without running `__init__` or `__post_init__`."""
    message: _T = cls.__cortex_shell__(*values)  # type: ignore[attr-defined]
    message.__class__ = cls
    return message


def is_tensor(value: Any) -> bool:
    """Whether a value is a torch tensor; never imports torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def copy_message(self: Any) -> Any:
    """Return a deep copy of a message that owns its arrays; they are writable and row-major."""
    return new_message(type(self), [_copy_value(getattr(self, name)) for name in self.__cortex_names__])


def _copy_value(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return np.array(value, order="C")
    if isinstance(value, (list, tuple)):
        return [_copy_value(item) for item in value]
    if is_tensor(value):
        return value.detach().clone()
    return copy_message(value) if hasattr(value, "__cortex_names__") else value


def _equal(self: Any, other: Any) -> Any:
    if type(other) is not type(self):
        return NotImplemented
    return all(_same(getattr(self, name), getattr(other, name)) for name in self.__cortex_names__)


def _same(left: Any, right: Any) -> bool:
    if is_tensor(left):
        left = left.detach().cpu().numpy()
    if is_tensor(right):
        right = right.detach().cpu().numpy()
    if isinstance(left, np.ndarray) or isinstance(right, np.ndarray):
        if not (isinstance(left, np.ndarray) and isinstance(right, np.ndarray)):
            return False
        return left.dtype == right.dtype and bool(np.array_equal(left, right))
    if isinstance(left, (list, tuple)) and isinstance(right, (list, tuple)):
        return len(left) == len(right) and all(map(_same, left, right))
    return bool(left == right)


def _show(self: Any) -> str:
    fields = ", ".join(f"{name}={_show_value(getattr(self, name))}" for name in self.__cortex_names__)
    return f"{type(self).__name__}({fields})"


def _show_value(value: Any) -> str:
    if isinstance(value, np.ndarray):
        head = f"{value.dtype}[{', '.join(map(str, value.shape))}]"
        if value.size > _MAX_SHOWN_ITEMS:
            return head
        return f"{head}({', '.join(str(item) for item in value.ravel().tolist())})"
    if is_tensor(value):
        return f"tensor {value.dtype}[{', '.join(map(str, value.shape))}]"
    if isinstance(value, (str, bytes)) and len(value) > _MAX_SHOWN_TEXT:
        return f"{value[:_MAX_SHOWN_TEXT]!r}... ({len(value)})"
    if isinstance(value, (list, tuple)):
        shown = ", ".join(_show_value(item) for item in value[:_MAX_SHOWN_ITEMS])
        more = f", ... ({len(value)})" if len(value) > _MAX_SHOWN_ITEMS else ""
        return f"[{shown}{more}]"
    return repr(value)


def _match_arguments(
    name: str, names: tuple[str, ...], args: tuple[Any, ...], kwargs: dict[str, Any]
) -> list[tuple[str, Any]]:
    if len(args) > len(names):
        raise TypeError(f"{name} has {len(names)} fields, {len(args)} positional arguments were given")
    given = dict(zip(names, args, strict=False))
    unknown = [key for key in kwargs if key not in names or key in given]
    if unknown:
        raise TypeError(f"{name}: arguments {unknown} are unknown or given twice, allowed are {list(names)}")
    given.update(kwargs)
    missing = [key for key in names if key not in given]
    if missing:
        raise TypeError(f"{name}: no values for the fields {missing}")
    return list(given.items())


def _refuse_set(self: Any, name: str, value: Any) -> NoReturn:
    raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")


def _refuse_delete(self: Any, name: str) -> NoReturn:
    raise dataclasses.FrozenInstanceError(f"cannot delete field {name!r}")


def _get_state(self: Any) -> list[Any]:
    return [getattr(self, name) for name in self.__cortex_names__]


def _set_state(self: Any, state: list[Any]) -> None:
    for name, value in zip(self.__cortex_names__, state, strict=True):
        object.__setattr__(self, name, value)
