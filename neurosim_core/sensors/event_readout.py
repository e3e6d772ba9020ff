# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,call-overload,assignment,return-value"
"""The arbiter that reads events out of the pixels: a queue with one server.

`event`: events are read in the order in which they come, and the bus is busy for 1 / bandwidth with each. An
event is stamped when its transfer begins, so an idle bus changes no stamp.

`row`: rows wait in the order of their oldest event. The first is latched when the bus is free: all its events
that have come until then get that stamp, and the bus is busy for row_s + n / bandwidth.

At most `queue_length` events wait; one that finds the queue full is lost. With a handshake a pixel is in
reset until its event is read, and what it would have fired meanwhile is lost; its next level counts from the
last all the same. Without, a pixel does not wait. A refractory time begins at the crossing.

Stamps may be late, by a normal number for each event that is at least 0.

It is a sequence by its nature, so one thread of the CPU does it, also for a camera on a GPU, where one thread
takes half a microsecond for each event: keys come, in the order of time to the nanosecond, then row, column
and polarity, and go back. What is read depends only on what has come before, so not on when it is asked for.

Reference: Boahen (2000), Point-to-point connectivity between neuromorphic chips using address events, for
arbitrated queues; Finateu et al. (2020) for a readout by rows.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.clock import NS_PER_US
from neurosim_core.random import mix_seed, normal2, random_bits, stream_id
from neurosim_core.sensors.event_config import ReadoutConfig
from neurosim_core.sensors.event_levels import SUB_BITS, KeyLayout

wp.set_module_options({"enable_backward": False})

_TICKS_PER_NS = 1024
_TICK_BITS = wp.constant(wp.int64(10))
_TICK_MASK = wp.constant(wp.int64(_TICKS_PER_NS - 1))
_SUB_MASK = wp.constant(wp.int64(1023))
_SUB_SHIFT = wp.constant(wp.int64(SUB_BITS - 1))
_US = wp.constant(wp.int64(NS_PER_US))
_ONE = wp.constant(wp.int64(1))
_WAITS = wp.constant(wp.int64(2**62))
"""An event of the pixel waits, nobody knows how long."""

# places in `counters`: events read, events that wait, events lost; first row that waits, rows that wait;
# first free place for an event
_READ = wp.constant(0)
_WAITING = wp.constant(1)
_DROPPED = wp.constant(2)
_FIRST_ROW = wp.constant(3)
_ROW_COUNT = wp.constant(4)
_FREE_NODE = wp.constant(5)
_COUNTERS = 6


@wp.struct
class _Bus:
    """Parameters and what the arbiter remembers; times in 2^-10 ns since the reset."""

    event_ticks: wp.int64
    row_ticks: wp.int64
    queue_length: wp.int32
    layout: KeyLayout
    latency_ticks: wp.float64
    jitter_ticks: wp.float64
    seed: wp.uint64
    stream: wp.uint32
    free: wp.array[wp.int64]  # When the bus is free, shape [1]
    ready: wp.array[wp.int64]
    """With a handshake: when the event of a pixel is read, shape [pixel]; else empty."""
    # by rows only
    place: wp.array[wp.int64]  # Row, column and polarity of events that wait, shape [queue_length]
    following: wp.array[wp.int32]  # The next event of the same row, or the next free place
    head: wp.array[wp.int32]  # First event of each row; -1: none
    tail: wp.array[wp.int32]
    asked: wp.array[wp.int64]  # When the first event of each row came
    rows: wp.array[wp.int32]  # Rows in the order in which they are read, a ring


@wp.func
def _key_at(ticks: wp.int64, origin_ns: wp.int64, place: wp.int64, time_shift: wp.int32) -> wp.int64:
    """Return the key of an event read at a time; the origin is that of the keys, since the reset."""
    down_ns = (ticks >> _TICK_BITS) - origin_ns
    up_ns = down_ns
    if (ticks & _TICK_MASK) != wp.int64(0):
        up_ns += _ONE
    time_us = down_ns // _US
    return (time_us << wp.int64(time_shift)) | place | (up_ns - time_us * _US)


@wp.func
def _stamped(bus: _Bus, ticks: wp.int64, place: wp.int64) -> wp.int64:
    """Return when an event is stamped that is read at a time."""
    if bus.latency_ticks == wp.float64(0.0) and bus.jitter_ticks == wp.float64(0.0):
        return ticks
    normal = normal2(random_bits(bus.seed, bus.stream, ticks, wp.int32(place >> wp.int64(SUB_BITS - 1))))
    late = bus.latency_ticks + bus.jitter_ticks * normal[0]
    return ticks + wp.int64(wp.max(late, wp.float64(0.0)))


@wp.func
def _in_reset(bus: _Bus, came: wp.int64, place: wp.int64) -> wp.bool:
    """Return whether the pixel of an event still waits for another to be read."""
    if bus.ready.shape[0] == 0:
        return False
    return came < bus.ready[wp.int32(place >> wp.int64(bus.layout.column_shift))]


@wp.func
def _set_ready(bus: _Bus, ticks: wp.int64, place: wp.int64) -> None:
    if bus.ready.shape[0] > 0:
        bus.ready[wp.int32(place >> wp.int64(bus.layout.column_shift))] = ticks


@wp.func
def _arrival_ns(key: wp.int64, time_shift: wp.int32) -> wp.int64:
    """Return the time of a key of `by_nanosecond`, from the keys' origin."""
    sub_ns = (key >> (wp.int64(time_shift - 1) - _SUB_SHIFT)) & _SUB_MASK
    return (key >> wp.int64(time_shift)) * _US + sub_ns


@wp.func
def _place(key: wp.int64, time_shift: wp.int32) -> wp.int64:
    """Return row, column and polarity of a key of `by_nanosecond`, where a key of an event has them."""
    mask = (_ONE << (wp.int64(time_shift - 1) - _SUB_SHIFT)) - _ONE
    return (key & mask) << _SUB_SHIFT


@wp.kernel
def _read_events(
    # Model:
    bus: _Bus,
    # In:
    arrivals: wp.array[wp.int64],
    count: wp.int32,
    origin_ns: wp.int64,
    # Out:
    keys_out: wp.array[wp.int64],
    dropped_ns_out: wp.array[wp.int64],
    counters: wp.array[wp.int32],
) -> None:
    """Read events one by one; the time at which each will be read is known when it comes.

    `arrivals` are sorted keys of `by_nanosecond`, with their origin from the reset [ns]; of lost events the
    time is noted, from the keys' origin [ns].
    """
    free = bus.free[0]
    read = wp.int32(0)
    dropped = wp.int32(0)
    for event in range(count):
        key = arrivals[event]
        arrival_ns = _arrival_ns(key, bus.layout.time_shift)
        came = (arrival_ns + origin_ns) << _TICK_BITS
        waiting = wp.int64(0)
        if free > came:  # those that begin later, one every event_ticks, the last at free - event_ticks
            waiting = (free - came + bus.event_ticks - _ONE) // bus.event_ticks - _ONE
        place = _place(key, bus.layout.time_shift)
        if waiting >= wp.int64(bus.queue_length) or _in_reset(bus, came, place):
            dropped_ns_out[dropped] = arrival_ns
            dropped += 1
        else:
            begin = wp.max(free, came)
            free = begin + bus.event_ticks
            _set_ready(bus, begin, place)
            keys_out[read] = _key_at(_stamped(bus, begin, place), origin_ns, place, bus.layout.time_shift)
            read += 1
    bus.free[0] = free
    counters[_READ] = read
    counters[_DROPPED] = dropped


@wp.func
def _serve(
    bus: _Bus,
    before: wp.int64,
    origin_ns: wp.int64,
    keys_out: wp.array[wp.int64],
    counters: wp.array[wp.int32],
) -> None:
    """Latch the rows whose turn comes before a time."""
    while counters[_ROW_COUNT] > 0:
        row = bus.rows[counters[_FIRST_ROW]]
        begin = wp.max(bus.free[0], bus.asked[row])
        if begin >= before:
            break
        node = bus.head[row]
        count = wp.int32(0)
        while node >= 0:
            stamp = _stamped(bus, begin, bus.place[node])
            keys_out[counters[_READ]] = _key_at(stamp, origin_ns, bus.place[node], bus.layout.time_shift)
            _set_ready(bus, begin, bus.place[node])
            counters[_READ] = counters[_READ] + 1
            following = bus.following[node]
            bus.following[node] = counters[_FREE_NODE]
            counters[_FREE_NODE] = node
            node = following
            count += 1
        bus.head[row] = -1
        bus.free[0] = begin + bus.row_ticks + wp.int64(count) * bus.event_ticks
        counters[_WAITING] = counters[_WAITING] - count
        counters[_ROW_COUNT] = counters[_ROW_COUNT] - 1
        counters[_FIRST_ROW] = (counters[_FIRST_ROW] + 1) % bus.rows.shape[0]


@wp.kernel
def _read_rows(
    # Model:
    bus: _Bus,
    # In:
    arrivals: wp.array[wp.int64],
    count: wp.int32,
    origin_ns: wp.int64,
    now_ns: wp.int64,
    # Out:
    keys_out: wp.array[wp.int64],
    dropped_ns_out: wp.array[wp.int64],
    counters: wp.array[wp.int32],
) -> None:
    """Read rows until a time, `now_ns` since the reset, after which nothing is known; see `_read_events`."""
    counters[_READ] = 0
    counters[_DROPPED] = 0
    for event in range(count):
        key = arrivals[event]
        arrival_ns = _arrival_ns(key, bus.layout.time_shift)
        came = (arrival_ns + origin_ns) << _TICK_BITS
        _serve(bus, came, origin_ns, keys_out, counters)
        place = _place(key, bus.layout.time_shift)
        if counters[_WAITING] >= bus.queue_length or _in_reset(bus, came, place):
            dropped_ns_out[counters[_DROPPED]] = arrival_ns
            counters[_DROPPED] = counters[_DROPPED] + 1
        else:
            _set_ready(bus, _WAITS, place)
            row = wp.int32(place >> wp.int64(bus.layout.row_shift))
            node = counters[_FREE_NODE]
            counters[_FREE_NODE] = bus.following[node]
            counters[_WAITING] = counters[_WAITING] + 1
            bus.place[node] = place
            bus.following[node] = -1
            if bus.head[row] < 0:
                bus.head[row] = node
                bus.asked[row] = came
                row_count = bus.rows.shape[0]
                bus.rows[(counters[_FIRST_ROW] + counters[_ROW_COUNT]) % row_count] = row
                counters[_ROW_COUNT] = counters[_ROW_COUNT] + 1
            else:
                bus.following[bus.tail[row]] = node
            bus.tail[row] = node
    _serve(bus, (now_ns << _TICK_BITS) + _ONE, origin_ns, keys_out, counters)


@wp.kernel
def by_nanosecond(
    # In:
    keys: wp.array[wp.int64],
    first: wp.int32,
    time_shift: wp.int32,
    # Out:
    keys_out: wp.array[wp.int64],
) -> None:
    """Write keys that sort by the nanosecond: time [us] | nanoseconds | row | col | polarity."""
    event = wp.tid()
    key = keys[first + event]
    low_bits = (_ONE << wp.int64(time_shift - 1)) - _ONE  # without `late`
    place = (key & low_bits) >> _SUB_SHIFT
    time = (key >> wp.int64(time_shift)) << wp.int64(time_shift)
    keys_out[event] = time | ((key & _SUB_MASK) << (wp.int64(time_shift - 1) - _SUB_SHIFT)) | place


class Readout:
    """The arbiter of one event camera and the events that wait for it.

    Args:
        config: Its parameters.
        height: Rows of the sensor [px].
        layout: Of the keys.
        seed: Seed of the run, for late stamps.
        sensor: Name of the camera, likewise.

    Attributes:
        waiting_count: Events that wait now.
    """

    def __init__(
        self,
        config: ReadoutConfig,
        *,
        height: int,
        layout: KeyLayout,
        seed: int,
        sensor: str,
    ) -> None:
        self._rowwise = config.kind == "row"
        self._layout = layout
        bus = _Bus()
        bus.layout = layout
        bus.event_ticks = max(1, round(1e9 * _TICKS_PER_NS / config.bandwidth_hz))
        bus.row_ticks = round(config.row_s * 1e9 * _TICKS_PER_NS)
        bus.queue_length = config.queue_length
        bus.latency_ticks = config.latency_s * 1e9 * _TICKS_PER_NS
        bus.jitter_ticks = config.jitter_s * 1e9 * _TICKS_PER_NS
        self._seed, bus.stream = seed, stream_id(f"{sensor}/events/late")
        bus.free = wp.zeros(1, dtype=wp.int64, device="cpu")
        pixels = height << (layout.row_shift - layout.column_shift) if config.handshake else 0
        bus.ready = wp.zeros(pixels, dtype=wp.int64, device="cpu")
        places = config.queue_length if self._rowwise else 0
        rows = height if self._rowwise else 0
        bus.place = wp.empty(places, dtype=wp.int64, device="cpu")
        bus.following = wp.empty(places, dtype=wp.int32, device="cpu")
        bus.asked = wp.empty(rows, dtype=wp.int64, device="cpu")
        bus.head, bus.tail, bus.rows = (wp.empty(rows, dtype=wp.int32, device="cpu") for _ in range(3))
        self._bus = bus
        self._counters = wp.zeros(_COUNTERS, dtype=wp.int32, device="cpu")
        self._reset_ns = 0
        self.waiting_count = 0
        wp.load_module(_read_rows.module, device="cpu")

    def reset(self, stamp_ns: int) -> None:
        """Forget all events and be free from a stamp on [ns]."""
        self._reset_ns = stamp_ns
        self._bus.seed = mix_seed(self._seed, stamp_ns)
        self._bus.free.zero_()
        self._bus.ready.zero_()
        self._counters.zero_()
        self._bus.head.fill_(-1)
        if self._rowwise:
            following = self._bus.following.numpy()
            following[:] = np.arange(1, len(following) + 1)
            following[-1] = -1
        self.waiting_count = 0

    def read(
        self, arrivals: NDArray[np.int64], *, origin_us: int, now_ns: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the keys of events that are read, and when events that are lost had happened [ns].

        Args:
            arrivals: Sorted keys of `by_nanosecond`, of events that have happened since the last call.
            origin_us: Origin of the time of keys [us].
            now_ns: All events until then have happened [ns].
        """
        count, origin_ns = len(arrivals), origin_us * NS_PER_US
        read, lost_ns = np.empty(count + self.waiting_count, np.int64), np.empty(count, np.int64)
        now = [now_ns - self._reset_ns] if self._rowwise else []
        wp.launch(
            _read_rows if self._rowwise else _read_events,
            dim=1,
            inputs=[self._bus, arrivals, count, origin_ns - self._reset_ns, *now],
            outputs=[read, lost_ns, self._counters],
            device="cpu",
        )
        read_count, self.waiting_count, lost_count = (int(n) for n in self._counters.numpy()[:3])
        return read[:read_count], lost_ns[:lost_count] + origin_ns
