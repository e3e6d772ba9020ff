"""The C++ code that reads and writes the bodies of messages, for `cppgen`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from cortex.layout import ITEM_ALIGNMENT, LARGE_ARRAY_BYTES, fixed_bytes, measure, stride_of
from cortex.schema import ANY_DTYPE, ArrayType, EnumType, FieldType, ListType, OptionalType


@dataclass
class Code:
    """Lines of one function, with the named dimensions that it uses."""

    error: str
    """What it throws."""
    lines: list[str] = field(default_factory=list)
    dimensions: list[str] = field(default_factory=list)

    def whole(self, pad: str) -> list[str]:
        """The lines, after the declarations of the dimensions: one name has one size within this code."""
        declared = [f"{pad}Dimension<{self.error}> dimension_{d}({literal(d)});" for d in self.dimensions]
        return declared + self.lines


class BodyWriter:
    """Writes the lines for the fields of messages.

    Args:
        cpp: Gives the C++ type of a field.
    """

    def __init__(self, cpp: Callable[[FieldType], str]) -> None:
        self._cpp = cpp

    def read(self, code: Code, kind: FieldType, value: str, at: str, where: str, depth: int) -> None:
        """Lines that read a field at `at` into the lvalue `value`."""
        pad = "  " * depth
        if isinstance(kind, str):
            code.lines.append(f"{pad}reader.{_call(kind)}({at}, {value});")
        elif isinstance(kind, EnumType):
            code.lines.append(f"{pad}reader.enumeration({at}, {value});")
        elif isinstance(kind, ArrayType):
            if kind.is_fixed:
                shape = f", {_shape(kind)}" if is_large(kind) else ""
                code.lines.append(f"{pad}reader.fixed({at}, {value}{shape});")
            else:
                code.lines.append(f"{pad}reader.{_call(kind)}({at}, {value});")
                _check_dimensions(code, kind, value, where, pad)
        elif isinstance(kind, OptionalType):
            code.lines += [
                f"{pad}if (reader.present({at})) {{",
                f"{pad}  auto& item{depth} = {value}.emplace();",
            ]
            inner = f"{at} + {measure(kind.item)[1]}"
            self.read(code, kind.item, f"item{depth}", inner, where, depth + 1)
            code.lines += [f"{pad}}} else {{", f"{pad}  {value}.reset();", f"{pad}}}"]
        elif isinstance(kind, ListType):
            stride = stride_of(kind.item)
            code.lines += [
                f"{pad}{{",
                f"{pad}  const auto list{depth} = reader.list({at}, {stride});",
                f"{pad}  {value}.clear();",
                f"{pad}  {value}.reserve(list{depth}.count);",
                f"{pad}  for (std::size_t k{depth} = 0; k{depth} < list{depth}.count; ++k{depth}) {{",
                f"{pad}    {self._cpp(kind.item)} item{depth}{{}};",
            ]
            each = Code(code.error)
            inner = f"list{depth}.at + k{depth} * {stride}"
            self.read(each, kind.item, f"item{depth}", inner, where, depth + 2)
            code.lines += each.whole(f"{pad}    ")
            code.lines += [f"{pad}    {value}.push_back(std::move(item{depth}));", f"{pad}  }}", f"{pad}}}"]
        else:
            code.lines.append(f"{pad}Codec<{self._cpp(kind)}>::decode(reader, {at}, {value});")

    def write(self, code: Code, kind: FieldType, value: str, at: str, where: str, depth: int) -> None:
        """Lines that write `value` at `at`."""
        pad = "  " * depth
        if isinstance(kind, str):
            code.lines.append(f"{pad}sink.{_call(kind)}({at}, {value});")
        elif isinstance(kind, EnumType):
            code.lines.append(f"{pad}sink.enumeration({at}, {value});")
        elif isinstance(kind, ArrayType):
            if not kind.is_fixed or is_large(kind):
                _check_dimensions(code, kind, value, where, pad)
            code.lines.append(f"{pad}sink.{'fixed' if kind.is_fixed else _call(kind)}({at}, {value});")
        elif isinstance(kind, OptionalType):
            self._write_optional(code, kind, value, at, where, depth)
        elif isinstance(kind, ListType):
            (size, alignment), stride = measure(kind.item), stride_of(kind.item)
            start_at = max(ITEM_ALIGNMENT, alignment)
            code.lines += [
                f"{pad}{{",
                f"{pad}  const std::size_t start{depth} =",
                f"{pad}      sink.list({at}, {value}.size(), {stride}, {start_at});",
                f"{pad}  for (std::size_t k{depth} = 0; k{depth} < {value}.size(); ++k{depth}) {{",
                f"{pad}    const auto& item{depth} = {value}[k{depth}];",
            ]
            each = Code(code.error)
            inner = f"start{depth} + k{depth} * {stride}"
            self.write(each, kind.item, f"item{depth}", inner, where, depth + 2)
            code.lines += each.whole(f"{pad}    ")
            if stride > size:
                code.lines.append(f"{pad}    sink.zero({inner} + {size}, {stride - size});")
            code.lines += [f"{pad}  }}", f"{pad}}}"]
        else:
            code.lines.append(f"{pad}Codec<{self._cpp(kind)}>::encode(sink, {at}, {value});")

    def _write_optional(
        self, code: Code, kind: OptionalType, value: str, at: str, where: str, depth: int
    ) -> None:
        pad = "  " * depth
        whole = measure(kind)[0]
        size, alignment = measure(kind.item)
        code.lines += [f"{pad}if ({value}.has_value()) {{", f"{pad}  sink.scalar({at}, std::uint8_t{{1}});"]
        if alignment > 1:
            code.lines.append(f"{pad}  sink.zero({at} + 1, {alignment - 1});")
        self.write(code, kind.item, f"(*{value})", f"{at} + {alignment}", where, depth + 1)
        if whole > alignment + size:
            code.lines.append(f"{pad}  sink.zero({at} + {alignment + size}, {whole - alignment - size});")
        code.lines += [f"{pad}}} else {{", f"{pad}  sink.zero({at}, {whole});", f"{pad}}}"]


def _check_dimensions(code: Code, kind: ArrayType, value: str, where: str, pad: str) -> None:
    for index, extent in enumerate(kind.shape):
        actual = f"{value}.shape()[{index}]"
        if isinstance(extent, int):
            code.lines.append(f"{pad}check_extent<{code.error}>({actual}, {extent}u, {where});")
        else:
            if extent not in code.dimensions:
                code.dimensions.append(extent)
            code.lines.append(f"{pad}dimension_{extent}({actual}, {where});")


def place(code: Code, name: str, kind: FieldType, value: str, offset: int) -> None:
    """Lines that give a loan's array its place."""
    if not isinstance(kind, ArrayType):
        return
    if kind.is_fixed:
        if is_large(kind):
            code.lines.append(f"    placer.fixed({offset}, {value}, {_shape(kind)});")
        return
    extents = ", ".join(
        f"Placer::Extent{{nullptr, {extent}u}}"
        if isinstance(extent, int)
        else f"Placer::Extent{{{literal(extent)}, 0}}"
        for extent in kind.shape
    )
    if kind.dtype == ANY_DTYPE:
        code.lines.append(f"    placer.any({literal(name)}, {value}, {{{extents}}});")
    else:
        code.lines.append(f"    placer.array({value}, {{{extents}}});")


def _call(kind: str | ArrayType) -> str:
    """The method of `Reader`, `Measure` and `Writer` for a type."""
    if isinstance(kind, ArrayType):
        return "any" if kind.dtype == ANY_DTYPE else "array"
    return {"str": "text", "bytes": "bytes"}.get(kind, "scalar")


def is_large(kind: ArrayType) -> bool:
    """Whether an array of a fixed shape is so large that C++ has it as a view."""
    return kind.is_fixed and fixed_bytes(kind) >= LARGE_ARRAY_BYTES


def literal(text: str) -> str:
    """A C++ string literal; what is not plain ASCII becomes octal escapes, which end after three digits."""
    out = []
    for byte in text.encode():
        char = chr(byte)
        if not 32 <= byte < 127:
            out.append(f"\\{byte:03o}")
        else:
            out.append(f"\\{char}" if char in '"\\?' else char)
    return '"' + "".join(out) + '"'


def _shape(kind: ArrayType) -> str:
    return "{" + ", ".join(f"{extent}u" for extent in kind.shape) + "}"
