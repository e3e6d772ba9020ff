# mypy: disable-error-code="index,attr-defined,misc,no-untyped-call,arg-type,operator,call-overload,type-arg"
# mypy: disable-error-code="untyped-decorator,empty-body"
"""An event camera as many simulators have it, to measure ours against: one event per pixel and frame.

A pixel whose log radiance has changed by a threshold since its last event fires one event, stamped at the
frame, and takes its new log radiance as reference: what exceeds the threshold is forgotten. An atomic
counter gives the events of a warp their places, in no order. For each frame the host launches, waits for the
device and reads the count. This is no part of the simulator.
"""

import warp as wp

from neurosim_core.bench.engine import EventArrays

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned active = __activemask();
    const unsigned firing = __ballot_sync(active, fires);
    if (firing == 0) return 0;
    const int lane = threadIdx.x & 31, leader = __ffs(firing) - 1;
    int start = 0;
    if (lane == leader) start = atomicAdd(count.data, __popc(firing));
    return __shfl_sync(active, start, leader) + __popc(firing & ((1u << lane) - 1));
#else
    return fires ? count.data[0]++ : 0;
#endif
""")
def _take_place(fires: bool, count: wp.array[int]) -> int:
    """Return the place of a pixel's event if it fires; all pixels come here."""
    ...


@wp.kernel
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
    fires = change >= threshold_on or change <= -threshold_off
    place = _take_place(fires, count)
    if fires:
        x_out[place] = wp.uint16(col)
        y_out[place] = wp.uint16(row)
        t_out[place] = stamp_us
        polarity_out[place] = wp.uint8(wp.where(change > 0.0, 1, 0))
        reference[row, col] = value


class NaiveEventCamera:
    """Takes one frame of log radiance at a time, and leaves its events on the device.

    Args:
        width: Columns [px].
        height: Rows [px].
        threshold_on: Step of log radiance upwards.
        threshold_off: Step of log radiance downwards.
        device: Where to compute.
    """

    def __init__(
        self, *, width: int, height: int, threshold_on: float, threshold_off: float, device: str
    ) -> None:
        self._thresholds = threshold_on, threshold_off
        self._reference = wp.empty((height, width), dtype=float, device=device)
        self._count = wp.empty(1, dtype=int, device=device)
        kinds = (wp.uint16, wp.uint16, wp.int64, wp.uint8)
        self._columns = [wp.empty(width * height, dtype=kind, device=device) for kind in kinds]

    def reset(self, log_radiance: wp.array) -> None:
        """Take a frame as reference, shape [H, W]."""
        wp.copy(self._reference, log_radiance)

    def feed(self, log_radiance: wp.array, stamp_us: int) -> int:
        """Find the events of a frame, shape [H, W], and return how many; waits for the device."""
        self._count.zero_()
        wp.launch(
            _compare,
            dim=self._reference.shape,
            inputs=[*self._thresholds, log_radiance, stamp_us, self._reference, self._count],
            outputs=self._columns,
            device=self._reference.device,
        )
        return int(self._count.numpy()[0])

    def events(self, count: int) -> EventArrays:
        """Return the events of the last frame, of which there are `count`."""
        x, y, t, polarity = (column.numpy()[:count].copy() for column in self._columns)
        return EventArrays(t=t, x=x, y=y, polarity=polarity)
