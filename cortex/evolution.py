"""Types that change: fields appended as optional, and what sets two structures apart.

A subscriber takes messages of a publisher whose type has the same name and fields, and further optional
fields at the end, on either side: what the publisher does not have is None, what the subscriber does not know
is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import zip_longest
from typing import Any

from cortex.codec import Codec
from cortex.schema import Field, OptionalType, Schema, attach_schema, describe_field, type_from_schema
from cortex.structure import make_class


def is_evolved(ours: Schema, theirs: Schema) -> bool:
    """Tell whether two structures differ, but only by optional fields that one of them has at its end."""
    count = min(len(ours.fields), len(theirs.fields))
    further = ours.fields[count:] + theirs.fields[count:]
    same = ours.name == theirs.name and ours.fields[:count] == theirs.fields[:count]
    return same and count > 0 and bool(further) and all(isinstance(f.type, OptionalType) for f in further)


def differences(old: Schema, new: Schema) -> Iterator[str]:
    """Yield what sets two structures apart, one line for each."""
    if old.name != new.name:
        yield f"name: {old.name} -> {new.name}"
    names = {field.name for field in old.fields} & {field.name for field in new.fields}
    for position, (before, after) in enumerate(zip_longest(old.fields, new.fields)):
        if before is not None and before == after:
            continue
        if before is not None and after is not None and before.name == after.name:
            yield f"field {position}: {_show(before)} -> {_show(after)}"
            continue
        for sign, field in (("-", before), ("+", after)):
            if field is not None:
                moved = " (at another place)" if field.name in names else ""
                yield f"field {position}: {sign} {_show(field)}{moved}"


def _show(field: Field) -> str:
    return " ".join(describe_field(field).split())


class EvolvedCodec:
    """Reads bodies of a publisher's structure as messages of our type; `is_evolved` must hold."""

    fixed_size = None

    def __init__(self, theirs: Schema, ours: type) -> None:
        self.type = ours
        self.schema = theirs
        self.fingerprint = theirs.fingerprint
        own: Schema = ours.__cortex_schema__  # type: ignore[attr-defined]
        self._common = [field.name for field in own.fields[: len(theirs.fields)]]
        self._absent = {field.name: None for field in own.fields[len(theirs.fields) :]}
        # As their class, but with our classes for the messages and enums in it.
        bindings = (
            ours.__cortex_bindings__[: len(theirs.fields)]  # type: ignore[attr-defined]
            + type_from_schema(theirs).__cortex_bindings__[len(self._common) :]  # type: ignore[attr-defined]
        )
        names = [field.name for field in theirs.fields]
        mixed = make_class(ours.__name__, names)
        attach_schema(mixed, theirs, bindings)
        self._codec = Codec(mixed)
        self.stamp_of = self._codec.stamp_of

    def decode(self, buffer: Any, offset: int = 0, size: int | None = None) -> Any:
        """As `Codec.decode`."""
        message = self._codec.decode(buffer, offset, size)
        return self.type(**{name: getattr(message, name) for name in self._common}, **self._absent)
