# mypy: disable-error-code="attr-defined,type-arg"
"""CUDA from the host: streams, graphs of repeated launches, copies that need no wait.

On a CPU a launch returns when it has finished, and all of this does nothing.

Streams wait for CUDA's default stream and make it wait for them. Warp frees device memory on that stream, so
an array that is freed between two launches holds up both: what runs ahead of the host keeps its buffers.
"""

from __future__ import annotations

import ctypes
import itertools
import weakref
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

_GRAPH_COUNT_MAX = 512
"""Most graphs that are kept. Steps whose sensors do not divide the control clock come in many patterns, each
in two states of the pixels and, of a camera that has one stack under way, with two buffers of keys; batches
that are streamed take turns among slots: each combination is a graph. With fewer places than a cycle has,
each would be given up before it comes again."""

_RECORDED_COUNT_MAX = 256
"""Most launches of one kernel, by key, that stay recorded."""

_PLACES_MAX = 64
"""Most addresses that copies of one array go to and that are remembered."""

_POOLED_BYTES_MAX = 256 << 20
"""Most memory of one kind that readers hold in more than a few blocks: pages that are pinned are nobody
else's."""

_POOLED_COUNT_MIN = 3
"""So many blocks readers may hold however large they are: who reads one after the other holds two."""


class Launches(NamedTuple):
    """Some launches, which may be recorded in a graph."""

    key: Hashable | None
    """Same key, same launches and arguments; None: they do not come again, or more than launches is done."""
    launch: Callable[[], object]
    """Launches them on the current stream; returns what a graph of them must keep."""


def size_class(size: int) -> int:
    """Return the least of 2^n and 3 * 2^n that is not below a size, at least 1: few sizes serve for many."""
    power = 1 << max(0, size - 1).bit_length()
    return power // 4 * 3 if power >= 4 and size <= power // 4 * 3 else power


def make_stream(device: Any, *, high_priority: bool = False) -> wp.Stream | None:
    """Return a new stream; None on a CPU. With high priority its launches go before others that wait."""
    place = wp.get_device(device)
    return wp.Stream(place, priority=-1 if high_priority else 0) if place.is_cuda else None


class _On:
    """Makes a stream the current one; `wp.ScopedStream` also sets the device, and takes twice as long."""

    def __init__(self, stream: wp.Stream) -> None:
        self._stream = stream

    def __enter__(self) -> None:
        self._before = self._stream.device.stream
        self._stream.device.set_stream(self._stream, sync=True)

    def __exit__(self, *_: object) -> None:
        self._stream.device.set_stream(self._before, sync=False)


def use_stream(stream: wp.Stream | None) -> AbstractContextManager[Any]:
    """Launch the kernels of a block on a stream, behind all launches of the current one; None: there."""
    return nullcontext() if stream is None else _On(stream)


class Fence:
    """A point in a stream that the host or another stream can wait for."""

    def __init__(self, device: Any) -> None:
        self._device = wp.get_device(device)
        self._event = wp.Event(self._device) if self._device.is_cuda else None
        self._behind: wp.Stream | None = None
        """A stream whose launches come after it anyway."""

    def set(self) -> None:
        """Record it behind all launches of the current stream."""
        if self._event is not None:
            self._behind = self._device.stream
            self._behind.record_event(self._event)

    def wait(self) -> None:
        """Block the host until the device has reached the fence."""
        if self._event is not None:
            wp.synchronize_event(self._event)

    def wait_on_stream(self) -> None:
        """Make the current stream wait until the device has reached the fence."""
        if self._event is not None and self._device.stream is not self._behind:
            self._behind = self._device.stream
            self._behind.wait_event(self._event)


class GraphCache:
    """Replays repeated sequences of launches as CUDA graphs. The launches must not allocate or wait.

    Attributes:
        dropped_count: Number of keys that were evicted from the cache of 512 graphs.
    """

    def __init__(self, device: Any) -> None:
        self._device = wp.get_device(device)
        self._graphs: dict[Hashable, tuple[Any, Any]] = {}
        self.dropped_count = 0

    def run(self, key: Hashable | None, launch: Callable[[], object]) -> None:
        """Do what `launch` does, on the current stream; see `Launches`.

        What has a key is called the first time, which compiles and warms up, and the second time to record
        it. What it returns is kept as long as the graph: arrays that nothing else holds.
        """
        if key is None or self._device.is_cpu:
            launch()
            return
        graph, kept = self._graphs.pop(key, (None, None))
        if graph is None:
            launch()
            graph = False
        else:
            if graph is False:
                with wp.ScopedCapture(self._device) as capture:
                    kept = launch()
                graph = capture.graph
            wp.capture_launch(graph)
        if len(self._graphs) >= _GRAPH_COUNT_MAX:
            del self._graphs[next(iter(self._graphs))]
            self.dropped_count += 1
        self._graphs[key] = (graph, kept)  # at the end: the one that was not used for longest goes first

    def run_all(self, launches: Sequence[Launches]) -> None:
        """Launch one after the other, as few graphs: those that follow each other and have keys are one."""
        for has_key, neighbours in itertools.groupby(launches, key=lambda each: each.key is not None):
            keys, calls = zip(*neighbours, strict=True)
            self.run(keys if has_key else None, partial(_call_all, calls))


def _call_all(calls: Sequence[Callable[[], object]]) -> list[object]:
    return [call() for call in calls]


class RecordedLaunch:
    """A launch that comes again, perhaps with other arguments.

    It is recorded, since to check and pack the arguments takes Warp longer than most kernels run.

    Args:
        kernel: Its parameters are numbers, arrays and structs.
        device: Where to launch.
        block_dim: Threads of a block on CUDA.
    """

    def __init__(self, kernel: wp.Kernel, device: Any, *, block_dim: int = 256) -> None:
        self._kernel = kernel
        self._block_dim = block_dim
        self._device = wp.get_device(device)
        self._recorded: dict[Hashable, tuple[Any, Any, Sequence[Any]]] = {}

    def launch(
        self, dim: int | tuple[int, ...], arguments: Sequence[Any], *, key: Hashable | None = None
    ) -> None:
        """Launch `dim` threads, at least one, with all arguments of the kernel.

        What is as it was the last time with the same key costs nothing: pass the same arrays, and round `dim`
        up.
        """
        recorded, last_dim, last_arguments = self._recorded.get(key, (None, None, ()))
        if recorded is None:
            if len(self._recorded) >= _RECORDED_COUNT_MAX:
                self._recorded.clear()
            recorded = wp.launch(
                self._kernel,
                dim=dim,
                inputs=list(arguments),
                device=self._device,
                block_dim=self._block_dim,
                record_cmd=True,
            )
        else:
            if dim != last_dim:
                recorded.set_dim(dim)
            for index, (value, last) in enumerate(zip(arguments, last_arguments, strict=True)):
                if value is not last:
                    packed = value.__ctype__() if hasattr(value, "__ctype__") else value
                    recorded.set_param_at_index_from_ctype(index, packed)
        recorded.launch()
        self._recorded[key] = (recorded, dim, arguments)


class HostInput:
    """A device array that the host writes, through pinned memory on CUDA, so that a graph can hold the copy.

    Args:
        array: Contiguous.

    Attributes:
        array: The array on the device.
        rows: What is uploaded, as NumPy; on a CPU the array itself. To be left alone until the device has
            come past the `upload`.
    """

    def __init__(self, array: Any) -> None:
        self.array = array
        self._copied = array.device.is_cuda
        self._host = wp.empty_like(array, device="cpu", pinned=True) if self._copied else array
        self.rows: NDArray[Any] = self._host.numpy()

    def upload(self) -> None:
        """Launch the copy to the device."""
        if self._copied:
            wp.copy(self.array, self._host)


class HostCopy:
    """The copy of a device array in pinned memory of the host; on a CPU the array itself.

    Args:
        array: Contiguous, with at least one axis.
    """

    def __init__(self, array: Any) -> None:
        self._array = array
        self._copied = array.device.is_cuda
        self._host = wp.empty_like(array, device="cpu", pinned=True) if self._copied else array
        self._rows: NDArray[Any] = self._host.numpy()
        self._row_size = array.size // array.shape[0] if array.size else 0
        self._places: dict[int, Any] = {}
        """Memory of others by address: the same few come again and again."""

    def mapped(self) -> Any:
        """Return the memory of the host as an array that kernels on the device write; on a CPU the array."""
        if not self._copied:
            return self._array
        host = self._host
        return wp.array(ptr=host.ptr, dtype=host.dtype, shape=host.shape, device=self._array.device)

    def fetch(self, first: int, count: int) -> None:
        """Launch the copy of `count` rows of the array."""
        if self._copied and count > 0:
            offset, size = first * self._row_size, count * self._row_size
            wp.copy(self._host, self._array, dest_offset=offset, src_offset=offset, count=size)

    def fetch_into(self, buffer: NDArray[Any], row: int) -> None:
        """Launch the copy of one row into memory of the caller's; on a CPU it is done at once.

        The buffer is contiguous, like a row; on CUDA pinned, and left alone until the device has come past
        this.
        """
        address = buffer.__array_interface__["data"][0]
        place = self._places.get(address)
        if place is None:
            if len(self._places) >= _PLACES_MAX:
                self._places.clear()
            place = wp.array(ptr=address, dtype=self._array.dtype, shape=(self._row_size,), device="cpu")
            self._places[address] = place
        wp.copy(place, self._array, src_offset=row * self._row_size, count=self._row_size)

    def rows(self, first: int, count: int) -> NDArray[Any]:
        """Return rows that were fetched, in memory of their own; waits for nothing."""
        return np.array(self.view(first, count))

    def view(self, first: int, count: int) -> NDArray[Any]:
        """Return rows that were fetched, where they are: valid until they are fetched again."""
        return self._rows[first : first + count]


class PooledBuffer:
    """Memory of the host that the device copies to, pinned on CUDA, and that its readers hold."""

    def __init__(self, size: int, device: Any) -> None:
        self.size = size
        self.array = wp.empty(size, dtype=wp.uint8, device="cpu", pinned=wp.get_device(device).is_cuda)

    def rows(self) -> NDArray[np.uint8]:
        """Return all of it; as a new array, which lives as long as it or a view of it is held."""
        memory: Any = (ctypes.c_uint8 * self.size).from_address(self.array.ptr)
        return np.frombuffer(memory, dtype=np.uint8)


class BufferPool:
    """Blocks that go round: who gets one may keep it, and it comes back when its last view is gone.

    So nothing is copied for those who read and forget. Who keeps more than 256 MB and three blocks, of any
    size, gets copies. Blocks come in few sizes and stay: to pin memory takes milliseconds, in which the
    device stands still.

    Args:
        device: What copies to them.

    Attributes:
        made_count: Blocks that were made.
    """

    def __init__(self, device: Any) -> None:
        self._device = device
        self._free: dict[int, deque[PooledBuffer]] = {}
        """By size."""
        self.made_count = 0
        self._made_bytes = 0

    def reserve(self, size: int, count: int) -> None:
        """Have so many blocks of at least so many bytes that nobody reads."""
        size = size_class(size)
        free = self._free.setdefault(size, deque())
        while len(free) < count:
            free.append(self._make(size))

    def acquire(self, size: int) -> PooledBuffer:
        """Return a block of at least so many bytes that nobody reads: the least that has come back.

        A new one is for twice as many.
        """
        for known in sorted(self._free):
            if known >= size and self._free[known]:
                block = self._free[known].popleft()  # the one that came back first
                break
        else:
            block = self._make(size_class(2 * size))
        return block

    def hand_out(self, block: PooledBuffer, size: int) -> NDArray[np.uint8]:
        """Return the first bytes of a block for the caller to keep, or a copy; the block is not theirs."""
        free = self._free[block.size]
        out_bytes = self._made_bytes - sum(known * len(blocks) for known, blocks in self._free.items())
        out_count = self.made_count - sum(map(len, self._free.values()))
        if out_bytes > _POOLED_BYTES_MAX and out_count > _POOLED_COUNT_MIN:  # with this one
            rows = np.array(block.rows()[:size])
            free.append(block)
            return rows
        rows = block.rows()
        weakref.finalize(rows, free.append, block).atexit = False
        return rows[:size]

    def _make(self, size: int) -> PooledBuffer:
        self.made_count += 1
        self._made_bytes += size
        self._free.setdefault(size, deque())
        return PooledBuffer(size, self._device)
