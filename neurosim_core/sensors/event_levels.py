# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,empty-body,assignment"
"""Levels of log radiance that a pixel compares its samples with, and the 64-bit keys of crossings.

A pixel holds the log radiance it was reset to (`base`), and how many levels it crossed upwards and downwards
since. The reference level is a function of these counts, with `on` and `off` the thresholds,

    L_ref = base + up * on - down * off     (float64)

so nothing accumulates: after any number of events it has the rounding of one evaluation. Where both sums
agree within that rounding, the level is the base itself.

The tie rule (stated in `EventCamera`) is in `_bound`: the float32 that a sample must reach, for each level.

Crossing times are rounded to 2^-10 ns, then written as a key that sorts in the order of the packets:

    time [us] | late | row | col | polarity | nanoseconds after the microsecond, rounded up (0 .. 1000)

Rounded down to the microsecond, a crossing gets its time; rounded up to the nanosecond, it is compared
exactly with the stamps of windows. `event_kernels.prepare` sets `late` on events that share the microsecond
of a window's end but come after it, so that windows are contiguous in the sorted keys.
"""

import warp as wp

from neurosim_core.native_code import read_native

wp.set_module_options({"enable_backward": False})

SUB_BITS = 11
"""Bits of a key below the column: polarity and nanoseconds."""
COLUMN_SHIFT = wp.constant(wp.int64(SUB_BITS))

_HALF_ULP = wp.constant(wp.float64(2.0**-24))
"""Of a float32 in [1, 2)."""
_ROUNDING = wp.constant(wp.float64(2.0**-50))
"""Bound of the relative error of the sums in a level."""
_STEP_ROUNDING = wp.constant(wp.float64(2.0**-23))
"""Relative error of k C computed in float32: half an ulp for C, and half an ulp for the product."""
_TICKS_PER_NS = wp.constant(wp.float64(1024.0))
_US = wp.constant(wp.int64(1000))


@wp.struct
class KeyLayout:
    """How many bits of a key are below what it says of a pixel."""

    width: wp.int32  # Of the sensor [px]
    column_shift: wp.int32  # Below the column; what is below it as well is its cause (`event_noise_model`)
    row_shift: wp.int32
    time_shift: wp.int32  # Below the microseconds


def make_layout(width: int, height: int, *, cause_bits: int = 0) -> KeyLayout:
    """Return the layout of the keys of a sensor."""
    layout = KeyLayout()
    layout.width = width
    layout.column_shift = SUB_BITS + cause_bits
    layout.row_shift = layout.column_shift + (width - 1).bit_length()
    layout.time_shift = layout.row_shift + (height - 1).bit_length() + 1
    return layout


@wp.struct
class Levels:
    """What the levels of a pixel are counted from, and how far they are apart; see above."""

    base: wp.float64
    on: wp.float64
    off: wp.float64


@wp.func
def levels_from(base: wp.float64, on: wp.float64, off: wp.float64) -> Levels:
    """Return the levels of a pixel, from the log radiance of the reset and its thresholds."""
    levels = Levels()
    levels.base = base
    levels.on = on
    levels.off = off
    return levels


@wp.func_native(read_native(__file__, "product"))
def _product(a: wp.float64, b: wp.float64) -> wp.float64:
    """Return a product, on CUDA not joined with a sum: a level has the same bits wherever it is asked."""
    ...


@wp.func
def level_at(levels: Levels, up: wp.int32, down: wp.int32) -> wp.float64:
    """Return the level after so many crossings upwards and downwards."""
    rise = _product(wp.float64(up), levels.on)
    fall = _product(wp.float64(down), levels.off)
    step = rise - fall
    if wp.abs(step) <= _ROUNDING * (rise + fall):
        return levels.base
    return levels.base + step


@wp.func
def _half_ulp(base: wp.float32) -> wp.float64:
    """Return half the distance from a float32 to the next larger in magnitude; 0 below 2^-126."""
    return wp.float64(wp.cast(wp.cast(base, wp.int32) & 0x7F800000, wp.float32)) * _HALF_ULP


@wp.func
def _bound(level: wp.float64, base: wp.float64, direction: wp.float64) -> wp.float32:
    """Return the float32 at which a sample reaches a level from below (direction 1) or above (-1)."""
    if level == base:
        return wp.float32(base)
    slack = wp.max(_half_ulp(wp.float32(base)), _STEP_ROUNDING * wp.abs(level - base))
    return wp.float32(level - direction * slack)


@wp.func
def reach_down(levels: Levels, up: wp.int32, down: wp.int32) -> wp.float32:
    """Return the largest sample that reaches the level below."""
    return _bound(level_at(levels, up, down + 1), levels.base, wp.float64(-1.0))


@wp.func
def reach_up(levels: Levels, up: wp.int32, down: wp.int32) -> wp.float32:
    """Return the least sample that reaches the level above."""
    return _bound(level_at(levels, up + 1, down), levels.base, wp.float64(1.0))


@wp.func
def quiet_range(levels: Levels, up: wp.int32, down: wp.int32) -> wp.vec2:
    """Return the samples that reach the level below and the level above; between them a pixel is quiet."""
    return wp.vec2(reach_down(levels, up, down), reach_up(levels, up, down))


@wp.func
def key_after(
    elapsed_ns: wp.float64, start_ns: wp.int64, place: wp.int64, time_shift: wp.int32, polarity: wp.int32
) -> wp.int64:
    """Return the key of an event some time, rounded to 2^-10 ns, after a stamp."""
    ticks = wp.int64(wp.rint(elapsed_ns * _TICKS_PER_NS))
    ticks = wp.max(ticks, wp.int64(1))  # an interval does not hold its start: that is the window before
    whole_ns = ticks >> wp.int64(10)
    down_ns = start_ns + whole_ns
    up_ns = down_ns
    if ticks > (whole_ns << wp.int64(10)):
        up_ns += wp.int64(1)
    time_us = down_ns // _US
    sub_ns = up_ns - time_us * _US
    return (time_us << wp.int64(time_shift)) | place | wp.int64(polarity << 10) | sub_ns


@wp.func
def place_of(pixel: wp.int32, row: wp.int32, layout: KeyLayout) -> wp.int64:
    """Return the bits of a key that say which pixel it is."""
    column = wp.int64(pixel - row * layout.width)
    return (wp.int64(row) << wp.int64(layout.row_shift)) | (column << wp.int64(layout.column_shift))


@wp.func
def rise(sample: wp.float32, levels: Levels, up: wp.int32, down: wp.int32) -> wp.int32:
    """Return `up` when a sample that has reached the level above has crossed all that it reaches."""
    least = up + 1
    if sample < reach_up(levels, least, down):
        return least
    level = level_at(levels, least, down)
    found = least + wp.int32((wp.float64(sample) - level) / levels.on)  # but for rounding
    while sample >= reach_up(levels, found, down):
        found += 1
    while found > least and sample < reach_up(levels, found - 1, down):
        found -= 1
    return found


@wp.func
def fall(sample: wp.float32, levels: Levels, up: wp.int32, down: wp.int32) -> wp.int32:
    """Return `down` when a sample that has reached the level below has crossed all that it reaches."""
    least = down + 1
    if sample > reach_down(levels, up, least):
        return least
    level = level_at(levels, up, least)
    found = least + wp.int32((level - wp.float64(sample)) / levels.off)
    while sample <= reach_down(levels, up, found):
        found += 1
    while found > least and sample > reach_down(levels, up, found - 1):
        found -= 1
    return found


@wp.func
def key_of_level(
    event: wp.int32,
    levels: Levels,
    up: wp.int32,
    down: wp.int32,
    last: wp.float32,
    sample: wp.float32,
    start_ns: wp.int64,
    end_ns: wp.int64,
    place: wp.int64,
    time_shift: wp.int32,
) -> wp.int64:
    """Return the key of one of the events between two samples, from `up` and `down` at the first of them.

    It is where the line from (start_ns, last) to (end_ns, sample) crosses a level.
    """
    polarity = wp.where(sample > last, 1, 0)
    level = level_at(levels, up + (event + 1) * polarity, down + (event + 1) * (1 - polarity))
    begin = wp.float64(last)
    fraction = wp.min((level - begin) / (wp.float64(sample) - begin), wp.float64(1.0))
    return key_after(wp.float64(end_ns - start_ns) * fraction, start_ns, place, time_shift, polarity)
