"""The messages that the benchmark sends."""

from cortex.message import Array, message


@message(name="bench/Sample")
class Sample:
    """A stamp and an array of any length; the stamp counts the messages."""

    stamp_ns: int
    data: Array["float32", "n"]


@message(name="bench/Sample10")
class Sample10:
    """The same with 40 bytes of array, known beforehand."""

    stamp_ns: int
    data: Array["float32", 10]


@message(name="bench/Sample1000")
class Sample1000:
    """The same with 4 kB of array, known beforehand."""

    stamp_ns: int
    data: Array["float32", 1000]


@message(name="bench/Reading")
class Reading:
    """A datum whose age matters: stamped with CLOCK_MONOTONIC."""

    stamp_ns: int
    sequence: int
    data: Array["float32", "n"]


FIXED = {10: Sample10, 1000: Sample1000}
"""Types of fixed size by their number of items."""
