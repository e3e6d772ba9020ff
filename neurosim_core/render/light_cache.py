"""Baked light on disk: a scene that was lit before is lit at once.

Entries lie beside Warp's kernels (`warp.config.kernel_cache_dir`), named by what the light depends on. Those
that were used least recently are removed when all together grow beyond `SIZE_MAX`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp
from numpy.typing import NDArray

SIZE_MAX = 256 * 2**20
"""Bytes of all entries together."""
POINTS_MIN = 10_000
"""Scenes of fewer points are lit as fast as they are read."""


def cached_light(
    inputs: tuple[object, ...], count: int, compute: Callable[[], NDArray[np.float32]]
) -> NDArray[np.float32]:
    """Return what `compute` returned for the same inputs before, or call it and keep what it returns.

    Args:
        inputs: All that the light depends on: arrays by their bytes, the rest by its `repr`.
        count: Points that are lit, the length of the result.
        compute: Returns the light of each point.
    """
    if count < POINTS_MIN:
        return compute()
    digest = hashlib.blake2b(digest_size=16)
    for part in inputs:
        array = isinstance(part, np.ndarray)
        digest.update(np.ascontiguousarray(part).data if array else repr(part).encode())
    entry = Path(str(wp.config.kernel_cache_dir), "light", f"{digest.hexdigest()}.npy")
    with contextlib.suppress(OSError, ValueError, EOFError):  # not there, or damaged
        found: NDArray[np.float32] = np.load(entry)
        if len(found) == count:
            os.utime(entry)
            return found
    light = compute()
    with contextlib.suppress(OSError):  # a folder that cannot be written to, a full disk
        entry.parent.mkdir(parents=True, exist_ok=True)
        part_file = entry.with_suffix(f".{os.getpid()}")
        try:
            with part_file.open("wb") as file:
                np.save(file, light)
            part_file.replace(entry)
        finally:
            part_file.unlink(missing_ok=True)
        _remove_oldest(entry.parent)
    return light


def _remove_oldest(folder: Path) -> None:
    entries = sorted(((file.stat().st_mtime, file) for file in folder.glob("*.npy")), reverse=True)
    total = 0
    for _, file in entries:
        total += file.stat().st_size
        if total > SIZE_MAX:
            file.unlink(missing_ok=True)
