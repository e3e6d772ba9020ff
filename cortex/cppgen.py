"""C++ structs for message types: what `cortex cpp module:Scan > scan.hpp` writes.

The header has one plain struct for each message and enum, and beside a struct a `cortex::Codec` with the
type's schema, fingerprint and the table by which its body is read and written. A header may be included
together with others that hold the same types.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

import cortex.messages
from cortex import layout, records
from cortex.message_types import is_message
from cortex.schema import (
    ANY_DTYPE,
    ArrayType,
    EnumType,
    Field,
    FieldType,
    ListType,
    OptionalType,
    Schema,
    fingerprint_of,
    schema_of,
)
from cortex.table import Kind, Row, Table

_SCALARS = {
    "bool": "bool",
    "float32": "float",
    "float64": "double",
    "str": "std::string",
    "bytes": "cortex::Array<std::uint8_t>",
} | {f"{sign}int{bits}": f"std::{sign}int{bits}_t" for sign in ("", "u") for bits in (8, 16, 32, 64)}
_ITEMS = _SCALARS | {
    "bool": "cortex::Bool",
    "float16": "cortex::Half",
    "complex64": "std::complex<float>",
    "complex128": "std::complex<double>",
}

_RESERVED_WORDS = """
alignas alignof and and_eq asm auto bitand bitor bool break case catch char char8_t char16_t char32_t class
co_await co_return co_yield compl concept const const_cast consteval constexpr constinit continue decltype
default delete do double dynamic_cast else enum explicit export extern false float for friend goto if inline
int long mutable namespace new noexcept not not_eq nullptr operator or or_eq private protected public
register reinterpret_cast requires return short signed sizeof static static_assert static_cast struct switch
template this thread_local throw true try typedef typeid typename union unsigned using virtual void volatile
wchar_t while xor xor_eq NULL EOF TRUE FALSE INFINITY NAN OVERFLOW UNDERFLOW DOMAIN SING PLOSS TLOSS HUGE
BUFSIZ RAND_MAX assert errno stdin stdout stderr unix linux i386 major minor makedev signals slots emit
"""
"""Keywords, and macros of the C library, of compilers and of Qt that turn up as names of fields."""
_RESERVED = frozenset(_RESERVED_WORDS.split())


def generate(types: Sequence[type | Schema], *, namespace: str | None = None) -> str:
    """Write the C++ header for message types and all that they contain.

    Args:
        types: Message classes or schemas.
        namespace: C++ namespace of every struct, such as `robot::messages`. By default it is what stands
            before the last part of a type's name: `robot/Scan` becomes `robot::Scan`, `Scan` is in none.

    Raises:
        ValueError: No types, a namespace that is none, or two different types of one C++ name.
        TypeError: A class that is no message.
    """
    if not types:
        raise ValueError("types must hold at least one message type")
    if namespace is not None and not re.fullmatch(r"[A-Za-z_]\w*(::[A-Za-z_]\w*)*", namespace, re.ASCII):
        raise ValueError(f"namespace must be names joined by '::', got {namespace!r}")
    generator = _Generator(namespace)
    for item in types:
        generator.message(item if isinstance(item, Schema) else schema_of(item))
    names = ", ".join(block.name for block in generator.blocks)
    standard = "array complex cstddef cstdint limits optional stdexcept string string_view utility vector"
    return "\n".join(
        [
            f"// Written by `cortex cpp`; do not edit. Types: {names}.",
            "#pragma once",
            "",
            *(f"#include <{header}>" for header in standard.split()),
            "",
            "#include <cortex/codec.hpp>",
            "",
            *(line for block in generator.blocks for line in block.guarded()),
        ]
    )


@dataclass(frozen=True)
class _Block:
    """The text of one struct or enum; `key` tells equal ones from others of the same name."""

    name: str
    key: str
    lines: tuple[str, ...]

    def guarded(self) -> Iterator[str]:
        macro = f"CORTEX_TYPE_{re.sub(r'[^A-Za-z0-9]+', '_', self.name)}_{self.key}"
        yield f"#ifndef {macro}"
        yield f"#define {macro}"
        yield from self.lines
        yield f"#endif  // {macro}"
        yield ""


@dataclass(frozen=True)
class _Member:
    """A field of a struct: its C++ name and type."""

    name: str
    cpp: str
    field: Field


def write_headers(folder: Path) -> None:
    """Write what the C++ client includes besides its own headers: control messages, and the standard ones.

    Args:
        folder: For the compiler's search path; they lie in `cortex` within it.
    """
    control = [item for item in vars(records).values() if isinstance(item, type) and is_message(item)]
    standard = [getattr(cortex.messages, name) for name in cortex.messages.__all__]
    (folder / "cortex").mkdir(parents=True, exist_ok=True)
    for name, types in (("records", control), ("messages", standard)):
        text = generate(types, namespace=f"cortex::{name}")
        (folder / f"cortex/{name}.hpp").write_text(text, encoding="utf-8")


class _Generator:
    """Collects blocks in an order in which each knows those that it uses."""

    def __init__(self, namespace: str | None) -> None:
        self._namespace = namespace
        self._members: dict[str, list[_Member]] = {}
        self.blocks: list[_Block] = []

    def _qualified(self, name: str) -> tuple[str, str, str]:
        """Namespace, identifier, and both together, of a type's name."""
        parts = [_identifier(part) for part in re.split(r"[./]+", name.strip("./"))]
        namespace = self._namespace if self._namespace is not None else "::".join(parts[:-1])
        return namespace, parts[-1], f"{namespace}::{parts[-1]}" if namespace else parts[-1]

    def _add(self, name: str, key: str, lines: Sequence[str]) -> None:
        self.blocks.append(_Block(name, key, tuple(lines)))

    def _is_known(self, name: str, key: str) -> bool:
        known = next((block for block in self.blocks if block.name == name), None)
        if known is not None and known.key != key:
            raise ValueError(f"two different types would both be {name} in C++; generate them apart")
        return known is not None

    def cpp(self, kind: FieldType) -> str:
        """The C++ type of a field."""
        if isinstance(kind, str):
            return _SCALARS[kind]
        if isinstance(kind, EnumType):
            return self.enumeration(kind)
        if isinstance(kind, ArrayType):
            return _array(kind)
        if isinstance(kind, OptionalType):
            return f"std::optional<{self.cpp(kind.item)}>"
        if isinstance(kind, ListType):
            return f"std::vector<{_ITEMS[kind.item] if kind.item == 'bool' else self.cpp(kind.item)}>"
        return self.message(kind)

    def enumeration(self, kind: EnumType) -> str:
        """Make the enum, return its C++ name."""
        namespace, name, qualified = self._qualified(kind.name)
        key = f"{fingerprint_of(repr(kind).encode()):016X}"
        if self._is_known(qualified, key):
            return f"::{qualified}"
        members: dict[str, int] = {}
        for member, value in kind.values:
            members[_identifier(member, members)] = value
        listed = (f"  {member} = {_int32(value)}," for member, value in members.items())
        self._add(qualified, key, _within(namespace, [f"enum class {name} : std::int32_t {{", *listed, "};"]))
        return f"::{qualified}"

    def message(self, schema: Schema) -> str:
        """Make the struct and its codec, return its C++ name."""
        namespace, name, qualified = self._qualified(schema.name)
        key = f"{schema.fingerprint:016X}"
        if self._is_known(qualified, key):
            return f"::{qualified}"
        members: list[_Member] = []
        for item in schema.fields:
            taken = [name, *(member.name for member in members)]
            members.append(_Member(_identifier(item.name, taken), self.cpp(item.type), item))
        self._members[f"::{qualified}"] = members
        lines = _within(namespace, _struct(name, members))
        self._add(qualified, key, lines + self._codec(schema, f"::{qualified}", members))
        return f"::{qualified}"

    def _codec(self, schema: Schema, cpp: str, members: list[_Member]) -> list[str]:
        stamp = members[schema.stamp_index] if schema.stamp_index >= 0 else None
        stamp_code = f"static_cast<std::int64_t>(message.{stamp.name})" if stamp else "0"
        return [
            "namespace cortex {",
            "template <>",
            f"struct Codec<{cpp}> {{",
            f"  static constexpr std::string_view name = {_literal(schema.name)};",
            f"  static constexpr std::uint64_t fingerprint = 0x{schema.fingerprint:016X}u;",
            f"  static constexpr std::string_view schema = {_literal(schema.to_json())};",
            f"  static constexpr bool fixed = {str(not layout.has_tail(schema)).lower()};",
            f"  static constexpr bool stamped = {str(stamp is not None).lower()};",
            "",
            f"  static std::int64_t stamp([[maybe_unused]] const {cpp}& message) noexcept {{",
            f"    return {stamp_code};",
            "  }",
            "",
            "  static constexpr const char* names[] = {",
            *(f"      {_literal(member.field.name)}," for member in members),
            "      nullptr};",
            "#pragma GCC diagnostic push",
            '#pragma GCC diagnostic ignored "-Winvalid-offsetof"',
            "  static constexpr CortexItem items[] = {",
            *(_row(row) for row in _StructTable(schema, cpp, self).rows),
            "  };",
            "#pragma GCC diagnostic pop",
            "};",
            "}  // namespace cortex",
        ]

    def members_of(self, cpp: str) -> list[_Member]:
        """Those of a struct that was made."""
        return self._members[cpp]


class _StructTable(Table):
    """The rows of a struct; what it is bound to is its C++ name."""

    def __init__(self, schema: Schema, cpp: str, generator: _Generator) -> None:
        self._generator = generator
        super().__init__(schema, cpp)

    def fields_of(self, schema: Schema, bound: str) -> Iterator[tuple[str, str]]:
        for member in self._generator.members_of(bound):
            inner = member.field.type
            while isinstance(inner, OptionalType | ListType):
                inner = inner.item
            of = self._generator.cpp(inner) if isinstance(inner, Schema) else ""
            yield f"offsetof({bound}, {member.name})", of

    def is_plain(self, kind: ArrayType) -> bool:
        return kind.is_fixed and not _is_large(kind)

    def object_of(self, kind: FieldType, bound: str) -> str:
        if isinstance(kind, Schema):
            return "nullptr"
        cpp = self._generator.cpp(kind)
        if isinstance(kind, ArrayType):
            return f"&detail::array_type<{cpp}>"
        inner = cpp[cpp.index("<") + 1 : -1]
        return f"&detail::{'optional' if isinstance(kind, OptionalType) else 'list'}_type<{inner}>"

    def dimension_of(self, size: int | str) -> str:
        return _literal(size) if isinstance(size, str) else "nullptr"


def _row(row: Row) -> str:
    kind, *numbers = (int(each) if isinstance(each, bool) else each for each in astuple(row))
    numbers[7] = numbers[7] or "nullptr"
    return f"      {{CORTEX_{Kind(kind).name}, {', '.join(map(str, numbers))}}},"


def _is_large(kind: ArrayType) -> bool:
    return kind.is_fixed and layout.fixed_bytes(kind) >= layout.LARGE_ARRAY_BYTES


def _struct(name: str, members: list[_Member]) -> Iterator[str]:
    yield f"struct {name} {{"
    for member in members:
        notes = []
        if isinstance(member.field.type, ArrayType):
            notes.append(f"[{', '.join(map(str, member.field.type.shape))}]")
        if member.field.unit:
            notes.append(_comment(member.field.unit))
        if member.field.frame:
            notes.append(f"frame {_comment(member.field.frame)}")
        yield f"  {member.cpp} {member.name}{{}};" + (f"  // {', '.join(notes)}" if notes else "")
    equal = " &&\n           ".join(f"a.{member.name} == b.{member.name}" for member in members) or "true"
    yield ""
    parameters = f"[[maybe_unused]] const {name}& a, [[maybe_unused]] const {name}& b"
    yield f"  friend bool operator==({parameters}) {{"
    yield f"    return {equal};"
    yield "  }"
    yield f"  friend bool operator!=(const {name}& a, const {name}& b) {{ return !(a == b); }}"
    yield "};"


def _array(kind: ArrayType) -> str:
    """The C++ type of an array: small ones of a fixed shape are values, the others may look into a frame."""
    rank = len(kind.shape)
    if kind.dtype == ANY_DTYPE:
        return f"cortex::AnyArray<{rank}>"
    cpp = _ITEMS[kind.dtype]
    if not kind.is_fixed or _is_large(kind):
        return f"cortex::Array<{cpp}, {rank}>"
    for extent in reversed(kind.shape or (1,)):
        cpp = f"std::array<{cpp}, {extent}>"
    return cpp


def _identifier(name: str, taken: Sequence[str] | dict[str, int] = ()) -> str:
    safe = re.sub(r"[^A-Za-z0-9_]", "_", name)
    if not safe or safe[0].isdigit():
        safe = "_" + safe
    while safe in _RESERVED or safe in taken:
        safe += "_"
    return safe


def _comment(text: str) -> str:
    """A unit or frame, made fit for a comment of one line."""
    plain = re.sub(r"[^\x20-\x7e\u00a0-\u1fff\u2030-\uffff]|\\", " ", text)
    return plain.replace("??", "? ?")  # a trigraph


def _within(namespace: str, lines: Iterable[str]) -> list[str]:
    if not namespace:
        return [*lines]
    return [f"namespace {namespace} {{", *lines, f"}}  // namespace {namespace}"]


def _literal(text: str) -> str:
    """A C++ string literal; what is not plain ASCII becomes octal escapes, which end after three digits."""
    out = []
    for byte in text.encode():
        char = chr(byte)
        if not 32 <= byte < 127:
            out.append(f"\\{byte:03o}")
        else:
            out.append(f"\\{char}" if char in '"\\?' else char)
    return '"' + "".join(out) + '"'


def _int32(value: int) -> str:
    return "std::numeric_limits<std::int32_t>::min()" if value == -(2**31) else str(value)
