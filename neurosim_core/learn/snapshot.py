# mypy: disable-error-code="attr-defined,no-untyped-call"
"""The state of an environment: what its objects hold on the device, and how far they are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
import warp as wp

from neurosim_core.learn.task import Task
from neurosim_core.runtime.cuda import RecordedLaunch

_LEFT_OUT = {  # what never changes, what each step writes before it reads it, and what is of this process
    "_scenes", "_model", "_schedule", "_routes", "_observations", "observation", "_status", "buffers",
    "slots", "pipeline", "results", "stack", "_frames", "pictures", "shared_pictures", "_offsets_ns",
    "_hosts",
}  # fmt: skip

Place = tuple[str, Any, str, Any]
"""A path, who is there, its attribute, and what that is: memory as a tensor, or a whole number."""


def state_of(env: Any) -> list[Place]:
    """Return all that a step of an environment may change, as it is now."""
    cameras = [pair for group in env.sim._state.groups for pair in group.frames.items()]
    sensors = env.sim.model.config.sensors
    forgetful = [name for name, sensor in sensors.items() if getattr(sensor, "remembers", False)]
    forgetful += [name for name, camera in cameras if camera.terms]
    if forgetful:
        raise ValueError(f"{', '.join(forgetful)}: noise and automatic exposure cannot be saved")
    wp.synchronize_device(env.sim.device)
    return list(find_state(env))


def put_state(places: list[Place], state: Mapping[str, Any]) -> None:
    """Put a state in the place of what there is."""
    here, there = (
        {path: getattr(value, "shape", None) for path, value in rows}
        for rows in ([(path, value) for path, _, _, value in places], state.items())
    )
    if here != there:
        path = min(path for path, _ in here.items() ^ there.items())
        raise ValueError(f"the state is of another kind of environment: they differ in {path}")
    for path, owner, name, value in places:
        if isinstance(value, torch.Tensor):
            value.copy_(state[path])
        elif value != state[path]:
            setattr(owner, name, state[path])


def find_state(owner: Any, path: str = "", seen: set[Any] | None = None) -> Iterator[Place]:
    """Yield all that a step may change of an object and of what it holds: numbers, and memory once."""
    seen = set() if seen is None else seen
    if id(owner) in seen:
        return
    seen.add(id(owner))
    rows = dict(enumerate(owner)) if isinstance(owner, list | tuple) else owner
    for name, value in (rows if isinstance(rows, dict) else vars(rows)).items():
        place = f"{path}.{name}" if path else str(name)
        if name in _LEFT_OUT:
            continue
        memory = _bytes_of(value) if isinstance(value, wp.array) else value
        if isinstance(memory, torch.Tensor):
            key = (memory.data_ptr(), memory.shape, memory.stride(), memory.dtype)
            if memory.numel() and key not in seen:
                seen.add(key)
                yield place, owner, name, memory
        elif isinstance(value, int) and hasattr(owner, "__dict__") and not hasattr(owner, "_ctype"):
            yield place, owner, name, value
        elif isinstance(value, dict | list | tuple | Task) or _is_own(value):
            yield from find_state(value, place, seen)


def _is_own(value: Any) -> bool:
    """Objects of the simulator, but launches, which name arrays of others; and structures of kernels."""
    if isinstance(value, RecordedLaunch):
        return False
    module = type(value).__module__
    return hasattr(value, "__dict__") and (module.startswith("neurosim_core.") or hasattr(value, "_ctype"))


def _bytes_of(array: Any) -> torch.Tensor:
    """Return the memory of an array; none of what holds addresses, which are of this process."""
    fields = getattr(array.dtype, "vars", {}).values()
    if not array.size or not array.is_contiguous or any(isinstance(f.type, wp.array) for f in fields):
        return torch.empty(0)
    size = array.size * wp.types.type_size_in_bytes(array.dtype)
    return wp.to_torch(wp.array(ptr=array.ptr, shape=size, dtype=wp.uint8, device=array.device))
