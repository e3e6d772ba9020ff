"""Launches of kernels that use all cores of a CPU.

Warp runs a CPU kernel on the calling thread. The call releases the interpreter lock, so a pool of threads
runs slices of one launch. The first parameter of such a kernel is the index of its first thread.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

import warp as wp

Part = TypeVar("Part")

_SLICES_PER_CORE = 8  # uneven slices even out; a slice costs about 20 us of Python


_most: int | None = None


def core_count() -> int:
    """Return how many cores this process may use."""
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return here if _most is None else min(here, _most)


def limit_cores(count: int) -> None:
    """Use at most so many cores in this process, which works beside others of its kind."""
    global _most
    _most = max(1, count)


def single_threaded_blas() -> dict[str, str]:
    """Return the environment of a process that works beside others.

    SciPy's optimiser of a path has matrices so small that threads of BLAS cost ten times what they compute.
    """
    return {"OPENBLAS_NUM_THREADS": "1", **os.environ}


@cache
def _pool(thread_count: int) -> ThreadPoolExecutor:
    """Return the threads that share a launch."""
    return ThreadPoolExecutor(thread_count, thread_name_prefix="neurosim-render")


def share(work: Callable[[Part], object], parts: Sequence[Part]) -> None:
    """Do all parts of a work side by side, the first of them in this thread."""
    others = [_pool(core_count()).submit(work, part) for part in parts[1:]]
    work(parts[0])
    for other in others:
        other.result()


def kernel_variant(name: str, *terms: str) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator of a kernel with a module of its own: `name`, and what is compiled in."""
    module = wp.get_module(f"{name}." + ("_".join(terms).replace(" ", "_") or "exact"))
    decorator: Callable[[Callable[..., Any]], Any] = wp.kernel(module=module, enable_backward=False)
    return decorator


def launch_split(
    kernel: wp.Kernel,
    *,
    dim: int,
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    device: str,
    thread_count: int | None = None,
    multiple: int = 64,
) -> None:
    """Launch a kernel of one dimension: on CUDA as one launch, on the CPU in slices on all cores.

    The call returns when a CPU has finished; it does not wait for a CUDA device. The first parameter of the
    kernel is the index of its first thread, before inputs and outputs; threads must not depend on each other.
    Slices begin at multiples of `multiple`.
    """
    threads = thread_count or core_count()
    slice_size = -(-dim // (multiple * threads * _SLICES_PER_CORE)) * multiple
    if not wp.get_device(device).is_cpu or threads == 1 or slice_size >= dim:
        wp.launch(kernel, dim=dim, inputs=[0, *inputs], outputs=list(outputs), device=device, block_dim=64)
        return
    wp.load_module(kernel.module, device=device)  # not in the pool: a kernel must be compiled once

    def run(first: int) -> None:
        size = min(slice_size, dim - first)
        wp.launch(
            kernel, dim=size, inputs=[first, *inputs], outputs=list(outputs), device=device, block_dim=64
        )

    for _ in _pool(threads).map(run, range(0, dim, slice_size)):
        pass
