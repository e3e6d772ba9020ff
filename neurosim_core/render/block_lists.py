# mypy: disable-error-code="assignment,empty-body,valid-type"
"""What the kernels of antialiasing on CUDA leave to each other, and how many threads they have."""

# No `from __future__ import annotations`: Warp needs the annotations of structs as objects.

from typing import Any

import warp as wp

from neurosim_core.native_code import read_native

INSTANTS = wp.constant(4)
"""Instants of a pixel in a block that shows one surface, of a thread."""
COVER_BOUNDS = (64, 12)
"""Threads of a block, and blocks of a multiprocessor."""
_RAY_THREADS = 5120
"""Threads of a multiprocessor: far more than run at a time, since some take longer than others."""


@wp.struct
class BlockLists:
    """Blocks of 4 x 4 pixels that a kernel leaves to another one; threads 16 n to 16 n + 15 are block n."""

    uneven: wp.array[wp.vec3i]
    """Those that show several surfaces in one of two consecutive instants: four times the tile, and which of
    its blocks; the first instant; a bit for each of the two."""
    unresolved: wp.array[wp.vec2i]
    """Those with pixels that have to be rendered by rays, and a bit for each of these."""
    count: wp.array[int]  # Length of the two lists, and how many entries of the first are taken
    threads: int  # Threads of the kernel that goes through the second one


def make_lists(block_count: int, device: Any) -> BlockLists:
    """Return empty lists for at most so many blocks."""
    lists = BlockLists()
    lists.uneven = wp.zeros(block_count, dtype=wp.vec3i, device=device)
    lists.unresolved = wp.zeros(block_count, dtype=wp.vec2i, device=device)
    lists.count = wp.zeros(3, dtype=int, device=device)
    lists.threads = _RAY_THREADS * max(1, wp.get_device(device).sm_count)
    return lists


def thread_counts(lists: BlockLists, pixel_count: int, instant_count: int) -> tuple[int, int, int]:
    """Return the threads of the three kernels, for so many pixels of all instants of all worlds."""
    even = pixel_count // instant_count * -(-instant_count // INSTANTS)
    cover = lists.threads // _RAY_THREADS * COVER_BOUNDS[0] * COVER_BOUNDS[1]
    return even, cover, lists.threads


@wp.func_native(read_native(__file__, "next_entry"))
def next_entry(count: wp.array[int], counter: int) -> int:
    """Return the next number that a counter gives to a warp."""
    ...


@wp.func_native(read_native(__file__, "leaves_room", BLOCKS=COVER_BOUNDS[1]))
def leaves_room() -> wp.bool:
    """Return whether a block of the kernel of uneven blocks ends before all is done.

    So a multiprocessor is left to what comes and goes: the flight is ahead of the renderer, and a kernel of a
    vehicle needs more registers than full multiprocessors have.
    """
    ...
