"""Baked light on disk: a scene that was lit before is lit at once.

Entries lie beside Warp's kernels (`warp.config.kernel_cache_dir`), named by what the light depends on. Those
that were used least recently are removed when all together grow beyond `SIZE_MAX`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

SIZE_MAX = 256 * 2**20
"""Bytes of all entries together."""


def cached_arrays(
    inputs: tuple[object, ...], compute: Callable[[], dict[str, NDArray[Any]]]
) -> dict[str, NDArray[Any]]:
    """Return the arrays that `compute` returned for the same inputs before, or call it and keep them.

    Inputs are all that the result depends on: arrays count by their bytes, the rest by its `repr`.
    """
    digest = hashlib.blake2b(digest_size=16)
    for part in inputs:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype} {part.shape}".encode())
            digest.update(np.ascontiguousarray(part).data)
        else:
            digest.update(repr(part).encode())
    entry = Path(str(wp.config.kernel_cache_dir), "light", f"{digest.hexdigest()}.npz")
    with contextlib.suppress(OSError, ValueError, EOFError, zipfile.BadZipFile):  # not there, or damaged
        with entry.open("rb") as source, np.load(source) as kept:
            found = dict(kept)
        with contextlib.suppress(OSError):  # a cache that cannot be written to is read all the same
            os.utime(entry)
        return found
    made = compute()
    with contextlib.suppress(OSError):  # a folder that cannot be written to, a full disk
        entry.parent.mkdir(parents=True, exist_ok=True)
        part_file = entry.with_suffix(f".{os.getpid()}-{threading.get_ident()}")
        try:
            with part_file.open("wb") as file:
                np.savez(file, **cast(Any, made))
            part_file.replace(entry)
        finally:
            part_file.unlink(missing_ok=True)
        _remove_oldest(entry.parent)
    return made


def _remove_oldest(folder: Path) -> None:
    entries = sorted(((file.stat().st_mtime, file) for file in folder.glob("*")), reverse=True)
    total = 0
    for _, file in entries:
        total += file.stat().st_size
        if total > SIZE_MAX:
            file.unlink(missing_ok=True)
