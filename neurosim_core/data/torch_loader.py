"""Batches in PyTorch: a DataLoader whose workers read recordings."""

from __future__ import annotations

import inspect
import pickle
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import is_dataclass
from typing import Any

import numpy as np

from neurosim_core.data.arguments import refuse_unknown
from neurosim_core.data.batch import Batch
from neurosim_core.data.stream import Position, Stream
from neurosim_core.install import need


class _Batches:
    """The batches of a stream by epoch and number, as workers are asked for them."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream

    def __getitem__(self, place: Position) -> Any:
        return as_tensors(self._stream.read(*place))


class Loader:
    """Yields the batches of a `Stream` as PyTorch tensors, in the same order with any number of workers.

    A loop over it reads one epoch. Workers are forked if the simulator is not loaded in the process, else
    spawned: `transform` must then be a function of a module. Workers send tensors in shared memory.

    Args:
        source: Recordings; without workers any source of `Stream`.
        workers: Number of reading processes.
        transform: Function of a batch, called in the worker; the loader yields its result, such as
            `(batch.events.voxel(5), batch.depth)`, with tensors in place of arrays.
        pin_memory: Yield tensors in pinned memory, for asynchronous copies to a CUDA device.
        device: Yield tensors on this device; the next batch is copied while one is in use. None: on the host.
        options: Other arguments of `Stream`.

    Raises:
        ImportError: PyTorch is not installed.
        ValueError: See `Stream`; or workers are spawned, and `transform` cannot be pickled.
    """

    def __init__(
        self,
        source: Any,
        *,
        workers: int = 0,
        transform: Callable[[Batch], Any] | None = None,
        pin_memory: bool = False,
        device: Any = None,
        **options: Any,
    ) -> None:
        torch = _import_torch()
        known = [name for name in inspect.signature(Stream).parameters if name not in ("source", "transform")]
        refuse_unknown("Loader", options, ["workers", *known])
        self.stream = Stream(source, transform=transform, **options)
        self._device = device
        self._position = Position(0, 0)
        self._places: list[Position] = []
        """The batches of the present epoch."""
        self._pins = (pin_memory or device is not None) and torch.cuda.is_available()
        more: dict[str, Any] = {}
        if workers:
            if not self.stream.is_recorded:
                raise ValueError("workers are for recordings: with a source that simulates, set workers=0")
            method = "spawn" if "warp" in sys.modules or sys.platform != "linux" else "fork"
            if method == "spawn":
                _require_sendable(transform)
            more = {"multiprocessing_context": method, "persistent_workers": True}
        self._loader = torch.utils.data.DataLoader(
            _Batches(self.stream),
            batch_size=None,
            sampler=self._places,
            num_workers=workers,
            pin_memory=self._pins,
            **more,
        )

    def __len__(self) -> int:
        return len(self.stream)

    @property
    def skipped_count(self) -> int:
        """See `Stream.skipped_count`."""
        return self.stream.skipped_count

    def __iter__(self) -> Iterator[Any]:
        begin = self._position
        batches: Iterable[Any] = self._simulated()
        if self.stream.is_recorded:
            self._places[:] = (Position(begin.epoch, number) for number in range(begin.batch, len(self)))
            batches = self._loader
        held: list[Any] = []
        for number, batch in enumerate(batches, begin.batch):
            if self._device is not None:
                batch = _each_tensor(lambda tensor: tensor.to(self._device, non_blocking=True), batch)
            held.append(batch)
            if len(held) > (self._device is not None):
                self._position = Position(begin.epoch, number + 1 - (len(held) - 1))
                yield held.pop(0)
        for batch in held:
            yield batch
        self._position = Position(begin.epoch + 1, 0)

    def _simulated(self) -> Iterator[Any]:
        for batch in map(as_tensors, self.stream):
            yield _each_tensor(lambda tensor: tensor.pin_memory(), batch) if self._pins else batch

    def state_dict(self) -> dict[str, int]:
        """Return where the loader is, for `load_state_dict`: behind the batch that was yielded last."""
        return self._position._asdict()

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Let the next loop begin where a loader with the same arguments was."""
        if not self.stream.is_recorded:
            raise ValueError("only recordings can be read from the middle on")
        self._position = Position(int(state["epoch"]), int(state["batch"]))


def as_tensors(value: Any) -> Any:
    """Return a value with tensors in place of the arrays in it: of dataclasses, tuples, lists and dicts."""
    torch = _import_torch()
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value if value.flags.writeable else value.copy())
    return _map(as_tensors, value)


def _each_tensor(change: Callable[[Any], Any], value: Any) -> Any:
    if hasattr(value, "pin_memory"):
        return change(value)
    return _map(lambda item: _each_tensor(change, item), value)


def _map(change: Callable[[Any], Any], value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return type(value)(**{name: change(item) for name, item in vars(value).items()})
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(change(item) for item in value))
    if isinstance(value, tuple | list):
        return type(value)(change(item) for item in value)
    return {key: change(item) for key, item in value.items()} if isinstance(value, dict) else value


def _require_sendable(transform: Any) -> None:
    try:
        pickle.dumps(transform)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            "the simulator is loaded in this process, so that workers are spawned, and transform must be a "
            f"function of a module: {error}"
        ) from None


def _import_torch() -> Any:
    return need("loaders need PyTorch", "learn", "torch", "torch.utils.data")
