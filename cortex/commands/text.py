"""Text for people: numbers with units, tables, and messages that fit the terminal."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from typing import Any

import numpy as np

from cortex.schema import ArrayType, Field, FieldType, ListType, OptionalType, Schema

WIDTH_UNKNOWN = 120
_LIST_ITEMS_MAX = 8
_DETAIL_DIGITS = 6


def terminal_width() -> int:
    """Columns of the terminal."""
    return shutil.get_terminal_size((WIDTH_UNKNOWN, 24)).columns


def seconds(value_s: float) -> str:
    """A time with a unit that suits it, such as `12.3 ms`."""
    if math.isnan(value_s):
        return "-"
    for limit, factor, unit in ((1e-6, 1e9, "ns"), (1e-3, 1e6, "us"), (1.0, 1e3, "ms")):
        if abs(value_s) < limit * 0.99995:
            return f"{_digits(value_s * factor)} {unit}"
    return f"{_digits(value_s)} s"


def bytes_of(value: float) -> str:
    """A number of bytes with a unit that suits it, such as `1.2 MB`."""
    if math.isnan(value):
        return "-"
    for factor, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if abs(value) >= factor * 0.99995:
            return f"{_digits(value / factor)} {unit}"
    return f"{value:.0f} B"


def rate(value_hz: float) -> str:
    """A rate, such as `99.98 Hz`."""
    if math.isnan(value_hz):
        return "-"
    return f"{value_hz / 1e3:.1f} kHz" if value_hz >= 9999.5 else f"{_digits(value_hz)} Hz"


def _digits(value: float) -> str:
    if value == round(value) and abs(value) < 10.0:
        return f"{value:.0f}"
    return f"{value:,.0f}" if abs(value) >= 999.95 else f"{value:#.4g}"


def number_of(count: int, what: str) -> str:
    """A number of things, such as `1 topic` or `2,345 messages`."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def plain(text: str) -> str:
    """A text of somebody else without anything that a terminal would obey."""
    return "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in text)


def shorten(text: str, width: int) -> str:
    """Cut a text that is too long, and show that it was cut."""
    return text if len(text) <= width else text[: max(0, width - 1)] + "…"


def table(head: Sequence[str], rows: Sequence[Sequence[str]], *, folded: bool = False) -> Iterator[str]:
    """Lines of a table with aligned columns, the first to the left and the others to the right.

    A head that begins with "<" is that of a further column aligned to the left. Nothing is cut: in a table
    that is `folded`, or too wide for the terminal, the first column of each row has a line of its own.
    """
    shown = [tuple(title.lstrip("<") for title in head), *rows]
    widths = [max(len(row[i]) for row in shown) for i in range(len(head))]
    if sum(widths) + 2 * (len(widths) - 1) > terminal_width():
        folded = True
    for row in shown:
        cells = [
            cell.ljust(width) if title.startswith("<") else cell.rjust(width)
            for cell, width, title in zip(row[1:], widths[1:], head[1:], strict=True)
        ]
        if folded:
            yield row[0]
        yield "  ".join(["" if folded else row[0].ljust(widths[0]), *cells]).rstrip()


def message_lines(schema: Schema, message: Any, *, arrays: str = "short") -> Iterator[str]:
    """A message as lines of `field: value`, nested ones indented.

    Args:
        schema: Its structure.
        message: The message.
        arrays: "none" shows dtype and shape, "short" what fits into the line, "full" everything.
    """
    width = terminal_width()
    for field in schema.fields:
        for line in _field_lines(field, field.type, getattr(message, field.name), field.name, "", arrays):
            yield line if arrays == "full" else shorten(line, width)


def _field_lines(
    field: Field, kind: FieldType, value: Any, name: str, indent: str, arrays: str
) -> Iterator[str]:
    start, unit = f"{indent}{name}: ", f"  {plain(field.unit)}" if field.unit else ""
    if isinstance(kind, OptionalType) and value is not None:
        kind = kind.item
    if isinstance(kind, Schema):
        yield start.rstrip()
        for inner in kind.fields:
            of_inner = getattr(value, inner.name), inner.name, indent + "  ", arrays
            yield from _field_lines(inner, inner.type, *of_inner)
    elif isinstance(kind, ListType):
        yield from _list_lines(field, kind, value, start, unit, arrays)
    elif isinstance(kind, ArrayType):
        yield from _array_lines(value, start, unit, arrays)
    else:
        yield f"{start}{_scalar(value, arrays)}{unit if value is not None else ''}"


def _list_lines(
    field: Field, kind: ListType, value: Sequence[Any], start: str, unit: str, arrays: str
) -> Iterator[str]:
    inner = kind.item.item if isinstance(kind.item, OptionalType) else kind.item
    shown = value if arrays == "full" else value[:_LIST_ITEMS_MAX]
    more = f" … {len(value)} in all" if len(shown) < len(value) else ""
    if isinstance(inner, (Schema, ArrayType, ListType)) and value:
        indent = " " * (len(start) - len(start.lstrip()) + 2)
        yield start.rstrip()
        for index, item in enumerate(shown):
            yield from _field_lines(field, kind.item, item, f"- {index}", indent, arrays)
        yield from (indent + more for _ in more[:1])
    else:
        yield f"{start}[{', '.join(_scalar(item, arrays) for item in shown)}{more}]{unit}"


def _array_lines(value: np.ndarray, start: str, unit: str, arrays: str) -> Iterator[str]:
    head = f"{start}{value.dtype}[{', '.join(map(str, value.shape))}]"
    if arrays == "short" and value.size:
        head += f"  {_items(value, terminal_width() - len(head) - len(unit) - 2)}"
    yield head + unit
    if arrays == "full" and value.size:
        indent = " " * (len(start) - len(start.lstrip()) + 2)
        text = np.array2string(value, threshold=sys.maxsize, max_line_width=terminal_width() - len(indent))
        yield from (indent + line for line in text.splitlines())


def _items(array: np.ndarray, room: int) -> str:
    """As many items as fit, the last one among them."""
    flat = array.reshape(-1)
    head = " ".join(_number(item) for item in flat[: max(1, room // 2 + 1)].tolist())
    if flat.size <= room // 2 + 1 and len(head) <= room:
        return head
    last = f"… {_number(flat[-1].item())}"
    return f"{head[: max(0, room - len(last))].rpartition(' ')[0]} {last}".lstrip()


def _number(value: Any) -> str:
    return f"{value:.{_DETAIL_DIGITS}g}" if isinstance(value, (float, complex)) else str(value)


def _scalar(value: Any, arrays: str) -> str:
    if isinstance(value, Enum):
        return value.name
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (str, bytes)):
        limit = terminal_width()
        cut = arrays != "full" and len(value) > limit
        return f"{value[:limit]!r}… {len(value)} in all" if cut else repr(value)
    return repr(value)


def to_plain(schema: Schema, message: Any, *, arrays: bool = True) -> dict[str, Any]:
    """A message as what JSON can hold.

    Enums become names, bytes their base64, arrays nested lists (or, without `arrays`, dtype and shape),
    complex numbers pairs, and numbers that JSON does not have (nan, inf) their names as text.
    """
    return {
        field.name: _plain_value(field.type, getattr(message, field.name), arrays) for field in schema.fields
    }


def _plain_value(kind: FieldType, value: Any, arrays: bool) -> Any:
    if value is None:
        return None
    if isinstance(kind, OptionalType):
        return _plain_value(kind.item, value, arrays)
    if isinstance(kind, Schema):
        return to_plain(kind, value, arrays=arrays)
    if isinstance(kind, ListType):
        return [_plain_value(kind.item, item, arrays) for item in value]
    if isinstance(kind, ArrayType):
        if not arrays:
            return f"{value.dtype}[{', '.join(map(str, value.shape))}]"
        if np.iscomplexobj(value):
            value = np.stack([value.real, value.imag], axis=-1)
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            return _each(value.tolist(), _finite)
        return value.tolist()
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, bytes):
        import base64

        return base64.b64encode(value).decode()
    return _finite(value)


def _each(items: Any, function: Callable[[Any], Any]) -> Any:
    return [_each(item, function) for item in items] if isinstance(items, list) else function(items)


def _finite(value: Any) -> Any:
    return value if not isinstance(value, float) or math.isfinite(value) else str(value)
