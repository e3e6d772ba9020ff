"""Messages about a run rather than the robot: its clock, its parameters, its log."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from cortex.message_types import Float64, Int64, UInt64, Unit, message


@message(name="cortex/Clock")
class Clock:
    """What time it is in a run, and outside of it; of fixed size."""

    stamp_ns: Annotated[int, Unit("ns")]
    """Simulation time [ns]."""
    wall_ns: Annotated[int, Unit("ns", frame="CLOCK_REALTIME")]
    """Wall-clock time at that moment, since 1970 [ns]."""
    real_time_factor: float = 1.0
    """How much faster than the wall clock the run is meant to go; 0: as fast as it can."""
    sequence: UInt64 = 0
    """Counts the messages of one clock from 0."""


@message(name="cortex/Text")
class Text:
    """Something to say, for people or as a free format."""

    text: str
    """UTF-8 text."""
    stamp_ns: Annotated[int, Unit("ns")] = 0
    """When it was said [ns]."""
    sequence: UInt64 = 0
    """Counts the texts of one sender from 0."""


@message(name="cortex/Parameter")
class Parameter:
    """A name and its value; exactly one of the other fields is set."""

    name: str
    """Dotted path, such as "camera.width"."""
    flag: bool | None = None
    """The value, if it is a bool."""
    integer: Int64 | None = None
    """The value, if it is an int."""
    number: Float64 | None = None
    """The value, if it is a float."""
    text: str | None = None
    """The value, if it is a str."""

    @property
    def value(self) -> bool | int | float | str | None:
        """The one value that is set; None if there is none."""
        given = (self.flag, self.integer, self.number, self.text)
        return next((value for value in given if value is not None), None)


@message(name="cortex/Parameters")
class Parameters:
    """Settings by name."""

    parameters: list[Parameter]
    """In no particular order; the last of one name counts."""
    stamp_ns: Annotated[int, Unit("ns")] = 0
    """From when on they hold [ns]."""
    sequence: UInt64 = 0
    """Counts the messages of one sender from 0."""

    @classmethod
    def of(cls, values: Mapping[str, bool | int | float | str], *, stamp_ns: int = 0) -> Parameters:
        """Return the message for a mapping of names to values.

        Raises:
            TypeError: A value is neither a bool, an int, a float nor a str.
        """
        kinds = {bool: "flag", int: "integer", float: "number", str: "text"}
        parameters = []
        for name, value in values.items():
            if type(value) not in kinds:
                raise TypeError(
                    f"parameter {name}: {value!r:.80} is neither a bool, an int, a float nor a str"
                )
            parameters.append(Parameter(name, **{kinds[type(value)]: value}))  # type: ignore[arg-type]
        return cls(parameters, stamp_ns)

    def to_dict(self) -> dict[str, bool | int | float | str | None]:
        """Return the values by name."""
        return {parameter.name: parameter.value for parameter in self.parameters}
