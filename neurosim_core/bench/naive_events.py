# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,no-untyped-call,type-arg"
# mypy: disable-error-code="untyped-decorator"
"""An event camera as many simulators have it, to measure ours against: one event per pixel and frame.

A pixel whose log radiance has changed by a threshold since its last event fires one event, stamped at the
frame, and takes its new log radiance as reference: what exceeds the threshold is forgotten. An atomic
counter gives the events their places, in no order. For each frame the host waits and reads the count.
"""

import warp as wp

from neurosim_core.bench.engine import EventArrays


@wp.kernel(enable_backward=False)
def _compare(
    # Model:
    threshold_on: float,
    threshold_off: float,
    # In:
    log_radiance: wp.array2d[float],
    stamp_us: wp.int64,
    # In/out:
    reference: wp.array2d[float],
    count: wp.array[int],
    # Out:
    x_out: wp.array[wp.uint16],
    y_out: wp.array[wp.uint16],
    t_out: wp.array[wp.int64],
    polarity_out: wp.array[wp.uint8],
) -> None:
    row, col = wp.tid()
    value = log_radiance[row, col]
    change = value - reference[row, col]
    if change >= threshold_on or change <= -threshold_off:
        place = wp.atomic_add(count, 0, 1)
        x_out[place] = wp.uint16(col)
        y_out[place] = wp.uint16(row)
        t_out[place] = stamp_us
        polarity_out[place] = wp.uint8(wp.where(change > 0.0, 1, 0))
        reference[row, col] = value


class NaiveEventCamera:
    """Takes one frame of log radiance at a time, shape [H, W], and leaves its events on the device."""

    def __init__(
        self, *, width: int, height: int, threshold_on: float, threshold_off: float, device: str
    ) -> None:
        self._thresholds = threshold_on, threshold_off
        self._reference = wp.empty((height, width), dtype=float, device=device)
        self._count = wp.empty(1, dtype=int, device=device)
        kinds = (wp.uint16, wp.uint16, wp.int64, wp.uint8)
        self._columns = [wp.empty(width * height, dtype=kind, device=device) for kind in kinds]

    def reset(self, log_radiance: wp.array) -> None:
        """Take a frame as reference."""
        wp.copy(self._reference, log_radiance)

    def feed(self, log_radiance: wp.array, stamp_us: int) -> int:
        """Find the events of a frame, and return how many; waits for the device."""
        self._count.zero_()
        inputs = [*self._thresholds, log_radiance, stamp_us, self._reference, self._count]
        size, device = self._reference.shape, self._reference.device
        wp.launch(_compare, dim=size, inputs=inputs, outputs=self._columns, device=device)
        return int(self._count.numpy()[0])

    def events(self, count: int) -> EventArrays:
        """Return the events of the last frame, of which there are `count`."""
        x, y, t, polarity = (column.numpy()[:count].copy() for column in self._columns)
        return EventArrays(t=t, x=x, y=y, polarity=polarity)
