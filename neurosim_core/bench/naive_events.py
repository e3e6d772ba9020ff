# mypy: disable-error-code="index,attr-defined,misc,no-untyped-call,arg-type,operator,call-overload,type-arg"
# mypy: disable-error-code="untyped-decorator,empty-body"
"""An event camera as many simulators have it, to measure ours against: one event per pixel and frame.

Each pixel keeps an upper and a lower bound of log radiance. A frame above the upper bound gives one bright
event, one below the lower bound one dark event, stamped with the time of the frame; the bounds are then set
around the new value, so what exceeded the threshold is forgotten. A frame in between draws the bounds after
it: the upper is at most the new value plus the threshold, the lower at least the new value minus it. So small
swings are events as well once they span a threshold from peak to peak. An atomic counter gives the events of
a warp their places, in no order. For each frame the host clears it, launches, waits for the device, and reads
it.

This is no part of the simulator. Nobody should want these events.
"""

import warp as wp
from numpy.typing import NDArray

from neurosim_core.runtime.cuda import RecordedLaunch

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
    width: int,
    # In:
    log_radiance: wp.array2d[float],
    stamp_us: wp.int64,
    # In/out:
    upper: wp.array[float],
    lower: wp.array[float],
    count: wp.array[int],
    # Out:
    x_out: wp.array[wp.uint16],
    y_out: wp.array[wp.uint16],
    t_out: wp.array[wp.int64],
    polarity_out: wp.array[wp.uint8],
) -> None:
    pixel = wp.tid()
    value = log_radiance[pixel // width, pixel % width]
    above = upper[pixel]
    below = lower[pixel]
    fires = value > above or value < below
    place = _take_place(fires, count)
    if fires:
        x_out[place] = wp.uint16(pixel % width)
        y_out[place] = wp.uint16(pixel // width)
        t_out[place] = stamp_us
        polarity_out[place] = wp.uint8(wp.where(value > above, 1, 0))
        upper[pixel] = value + threshold_on
        lower[pixel] = value - threshold_off
    else:
        upper[pixel] = wp.min(above, value + threshold_on)
        lower[pixel] = wp.max(below, value - threshold_off)


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
        self._width = width
        self._pixel_count = width * height
        self._thresholds = threshold_on, threshold_off
        self._device = wp.get_device(device)

        def empty(dtype: type, count: int = self._pixel_count) -> wp.array:
            return wp.empty(count, dtype=dtype, device=self._device)

        self._upper, self._lower = empty(float), empty(float)
        self._count = empty(int, 1)
        self._columns = [empty(wp.uint16), empty(wp.uint16), empty(wp.int64), empty(wp.uint8)]
        self._compare = RecordedLaunch(_compare, self._device)

    def reset(self, log_radiance: wp.array) -> None:
        """Set the bounds around a frame, shape [H, W]."""
        values = log_radiance.numpy().reshape(-1)
        self._upper.assign(values + self._thresholds[0])
        self._lower.assign(values - self._thresholds[1])

    def feed(self, log_radiance: wp.array, stamp_us: int) -> int:
        """Find the events of a frame, shape [H, W], and return how many; waits for the device."""
        self._count.zero_()
        state = [self._upper, self._lower, self._count]
        arguments = [*self._thresholds, self._width, log_radiance, stamp_us, *state, *self._columns]
        self._compare.launch(self._pixel_count, arguments)
        wp.synchronize_device(self._device)
        return int(self._count.numpy()[0])

    def events(self, count: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Return x, y, t [us] and polarity of the last frame's events, of which there are `count`."""
        x, y, t, polarity = (column.numpy()[:count] for column in self._columns)
        return x, y, t, polarity
