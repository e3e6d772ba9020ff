"""iceoryx2: shared memory without overflow, the subscriber woken by an event; the payload is a view."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from cortex.bench.job import Job, Sender
from cortex.bench.tally import Floats, Tally

_HEADER_BYTES = 64


def sender(job: Job) -> Sender:
    """Open the service and its event."""
    return _Sender(job)


class _Sender:
    def __init__(self, job: Job) -> None:
        self._iox = iox = importlib.import_module("iceoryx2")
        self.address: Mapping[str, Any] = {}
        self._node = iox.NodeBuilder.new().create(iox.ServiceType.Ipc)
        data, event = _services(iox, self._node, job)
        self._size = _HEADER_BYTES + job.payload_bytes
        self._publisher = (
            data.publisher_builder()
            .initial_max_slice_len(self._size)
            .backpressure_strategy(iox.BackpressureStrategy.RetryUntilDelivered)
            .create()
        )
        self._notifier = event.notifier_builder().create()
        self._services = (data, event)

    def send(self, sequence: int, data: Floats) -> None:
        sample = self._publisher.loan_slice_uninit(self._size)
        address = sample.payload_ptr
        ctypes.c_int64.from_address(address).value = sequence
        raw: Any = (ctypes.c_float * len(data)).from_address(address + _HEADER_BYTES)
        np.copyto(np.frombuffer(raw, np.float32), data)
        sample.assume_init().send()
        with contextlib.suppress(self._iox.NotifierNotifyError):  # its queue is full: the listener is awake
            self._notifier.notify()

    def report(self) -> dict[str, Any]:
        return {}

    def close(self) -> None:
        self._notifier.delete()
        self._publisher.delete()
        del self._services, self._node


def receive(job: Job, connected: Callable[[], None]) -> dict[str, Any]:
    """Count the messages of one flood: wait for the event, then take all there are."""
    done: list[bool] = []
    tally = Tally(job.floats, connected=connected, finish=lambda: done.append(True))
    handle = tally.copying_handler() if job.options.get("consume") else tally.handler()
    iox = importlib.import_module("iceoryx2")
    node = iox.NodeBuilder.new().create(iox.ServiceType.Ipc)
    data, event = _services(iox, node, job)
    subscriber = data.subscriber_builder().buffer_size(_buffer(job)).create()
    listener = event.listener_builder().create()
    pause = iox.Duration.from_millis(50)  # so that an event that went astray costs time, and no more
    raw_type = ctypes.c_float * job.floats
    while not done:
        listener.timed_wait(pause)
        while (sample := subscriber.receive()) is not None:
            address = sample.payload_ptr
            raw: Any = raw_type.from_address(address + _HEADER_BYTES)
            handle(ctypes.c_int64.from_address(address).value, np.frombuffer(raw, np.float32))
            sample.delete()
    subscriber.delete()
    listener.delete()
    return tally.report()


def _buffer(job: Job) -> int:
    return max(4, min(64, 4_000_000 // job.payload_bytes))


def _services(iox: Any, node: Any, job: Job) -> tuple[Any, Any]:
    name = iox.ServiceName.new(f"cortex-bench/{job.folder}")
    data = (
        node.service_builder(name)
        .publish_subscribe(iox.Slice[ctypes.c_uint8])
        .enable_safe_overflow(False)
        .history_size(0)
        .max_publishers(1)
        .max_subscribers(1)
        .subscriber_max_buffer_size(_buffer(job))
        .subscriber_max_borrowed_samples(2)
        .payload_alignment(iox.Alignment.new(64))
        .open_or_create()
    )
    return data, node.service_builder(name).event().open_or_create()
