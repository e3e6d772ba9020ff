"""A device that is late: what is launched runs when somebody waits for it, streams in any allowed order.

It stands for a GPU where there is none. Everything is computed on the CPU, from what is in memory when its
turn comes: who overwrites what a launch is still going to read, or reads what is not yet there, gets wrong
results. Sequences that come again are replayed with the arguments they were recorded with, like CUDA graphs.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.runtime import cuda, pipeline
from neurosim_core.sensors import event_keys, event_noise, event_pixels, event_readout, events

_MODULES = (cuda, events, event_keys, event_noise, event_pixels, event_readout)


class LateStream:
    """Operations that wait for their turn."""

    def __init__(self) -> None:
        self.waiting: deque[tuple[Any, Callable[[], None]]] = deque()


class _Point:
    """A place in a stream."""

    passed = False

    def run(self) -> None:
        self.passed = True


class LateDevice(str):
    """Takes the place of a CUDA device; to Warp itself it is the CPU, which a string can be."""

    is_cuda, is_cpu = True, False

    def __new__(cls, rng: np.random.Generator, eagerness: float) -> LateDevice:
        """Make one whose streams go on by themselves with some probability at each launch."""
        device = super().__new__(cls, "cpu")
        device.rng, device.eagerness = rng, eagerness
        device.stream = LateStream()
        device.streams = [device.stream]
        device.recording = None
        device.replayed_count = 0
        return device

    def add(self, operation: Callable[[], None], after: _Point | None = None) -> None:
        """Have an operation run on the present stream when what is before it, and a point, has passed."""
        if self.recording is not None:
            assert after is None
            self.recording.append(operation)
            return
        self.stream.waiting.append((after, operation))
        while self.rng.random() < self.eagerness and self._step():
            pass

    def _step(self) -> bool:
        ready = [
            stream
            for stream in self.streams
            if stream.waiting and (stream.waiting[0][0] is None or stream.waiting[0][0].passed)
        ]
        if not ready:
            return False
        _, operation = ready[self.rng.integers(len(ready))].waiting.popleft()
        operation()
        return True

    def run_until(self, done: Callable[[], bool]) -> None:
        """Let streams go on until something holds."""
        while not done():
            assert self._step(), "waits for what never comes"

    def flush(self) -> None:
        """Let all streams end."""
        self.run_until(lambda: not any(stream.waiting for stream in self.streams))

    @contextlib.contextmanager
    def on(self, stream: LateStream | None) -> Iterator[None]:
        """Launch what follows on a stream, after what the present stream holds."""
        before = self.stream
        if stream is not None and stream is not before:
            point = _Point()
            self.add(point.run)
            self.stream = stream
            self.add(lambda: None, after=point)
        yield
        self.stream = before

    def make_stream(self, device: Any, *, high_priority: bool = False) -> LateStream:
        """Return a new stream."""
        stream = LateStream()
        self.streams.append(stream)
        return stream


def _packed(value: Any) -> Any:
    """Return a parameter of a launch as it is now: Warp packs structs when it launches."""
    if not hasattr(value, "_cls"):
        return value
    packed = value._cls()
    packed.assign(value)
    return packed


class _LateWarp:
    """Warp, with what it launches put off."""

    def __init__(self, device: LateDevice) -> None:
        self._device = device
        self.utils = self

    def __getattr__(self, name: str) -> Any:
        return getattr(wp, name)

    def get_device(self, name: Any = None) -> LateDevice:
        return self._device

    def empty(self, *args: Any, pinned: bool = False, **kwargs: Any) -> Any:
        return wp.empty(*args, **kwargs)

    def copy(self, *args: Any, **kwargs: Any) -> None:
        self._device.add(lambda: wp.copy(*args, **kwargs))

    def launch(self, *args: Any, device: Any, **kwargs: Any) -> None:
        if isinstance(device, LateDevice):
            for given in (kwargs.get("inputs", []), kwargs.get("outputs", [])):
                given[:] = map(_packed, given)
            self._device.add(lambda: wp.launch(*args, device=device, **kwargs))
        else:  # a launch of the host, as the arbiter's
            wp.launch(*args, device=device, **kwargs)

    def radix_sort_pairs(self, keys: Any, values: Any, count: int, **kwargs: Any) -> None:
        if min(keys.size, values.size) < 2 * count:  # which only a CUDA device minds
            raise RuntimeError(f"{keys.size} keys and {values.size} values are not twice {count}")
        self._device.add(lambda: wp.utils.radix_sort_pairs(keys, values, count, **kwargs))


class _LateFence:
    """A point in a stream, for `cuda.Fence`; no wait is launched where that launches none."""

    def __init__(self, device: LateDevice) -> None:
        self._device = device
        self._point = _Point()
        self._point.passed = True
        self._behind: LateStream | None = None

    def set(self) -> None:
        self._point = _Point()
        self._behind = self._device.stream
        self._device.add(self._point.run)

    def wait(self) -> None:
        point = self._point
        self._device.run_until(lambda: point.passed)

    def wait_on_stream(self) -> None:
        if self._device.stream is not self._behind:
            self._behind = self._device.stream
            self._device.add(lambda: None, after=self._point)


class _LateGraphCache:
    """Records sequences and replays them, for `cuda.GraphCache`."""

    run_all = cuda.GraphCache.run_all

    def __init__(self, device: LateDevice) -> None:
        self._device = device
        self._graphs: dict[Any, list[Callable[[], None]] | None] = {}

    def run(self, key: Any, launch: Callable[[], Any]) -> None:
        if key is None:
            launch()
            return
        if key not in self._graphs:
            self._graphs[key] = None
            launch()
            return
        if self._graphs[key] is None:
            self._device.recording = recording = []
            launch()
            self._device.recording = None
            self._graphs[key] = recording
        else:
            self._device.replayed_count += 1
        for operation in self._graphs[key] or ():
            self._device.add(operation)


def install_pipeline(monkeypatch: Any, device: LateDevice) -> None:
    """Let pipelines that are made from now on launch on the device; launches call its `add`."""
    monkeypatch.setattr(pipeline, "Fence", lambda _: _LateFence(device))
    monkeypatch.setattr(pipeline, "GraphCache", lambda _: _LateGraphCache(device))
    monkeypatch.setattr(pipeline, "make_stream", device.make_stream)
    monkeypatch.setattr(pipeline, "use_stream", device.on)


def install(monkeypatch: Any, device: LateDevice) -> None:
    """Let event cameras that are made from now on work on the device."""

    def after_all(function: Any) -> Any:
        def call(*args: Any) -> Any:
            device.flush()
            result = function(*args)
            device.flush()
            return result

        return call

    def host_input(self: Any, array: Any) -> None:
        self.array, self._copied, self._host = array, True, wp.empty_like(array)
        self.rows = self._host.numpy()

    def host_copy(self: Any, array: Any) -> None:
        self._array, self._copied, self._host = array, True, wp.empty_like(array)
        self._rows = self._host.numpy()
        self._row_size = array.size // array.shape[0] if array.size else 0
        self._places = {}

    # arbiters begin at once, from arrays that are ready
    monkeypatch.setattr(event_readout.Readout, "reset", after_all(event_readout.Readout.reset))
    numpy, zero, fill = wp.array.numpy, wp.array.zero_, wp.array.fill_

    def late_numpy(array: Any) -> Any:
        if device.recording is None:
            point = _Point()
            device.add(point.run)
            device.run_until(lambda: point.passed)  # as on CUDA, other streams may go on
        return numpy(array)

    def relaunch(self: Any, dim: int, arguments: Any) -> None:
        device.add(lambda: wp.launch(self._kernel, dim=dim, inputs=arguments, device=self._device))

    late = _LateWarp(device)
    for module in _MODULES:
        monkeypatch.setattr(module, "wp", late)
        if module is not cuda:
            monkeypatch.setattr(module, "Fence", lambda _: _LateFence(device), raising=False)
            monkeypatch.setattr(module, "GraphCache", lambda _: _LateGraphCache(device), raising=False)
    monkeypatch.setattr(events, "use_stream", device.on)
    monkeypatch.setattr(events, "make_stream", device.make_stream)
    monkeypatch.setattr(cuda.RecordedLaunch, "launch", relaunch)
    monkeypatch.setattr(cuda.HostInput, "__init__", host_input)
    monkeypatch.setattr(cuda.HostCopy, "__init__", host_copy)
    monkeypatch.setattr(wp.array, "numpy", late_numpy)
    monkeypatch.setattr(wp.array, "zero_", lambda array: device.add(lambda: zero(array)))
    monkeypatch.setattr(wp.array, "fill_", lambda array, value: device.add(lambda: fill(array, value)))
