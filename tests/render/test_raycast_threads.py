"""How often threads of the ray caster take a turn."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from neurosim_core.render.raycast import turn_count

LARGEST = 2**31 - 1


@wp.kernel(enable_backward=False)
def _count_turns(begins: wp.array[int], end: int, step: int, count_out: wp.array[int]) -> None:
    thread = wp.tid()
    count_out[thread] = turn_count(begins[thread], end, step)


@pytest.mark.parametrize("step", [1, 7, 84_480, LARGEST])
@pytest.mark.parametrize("end", [0, 1, 1000, 84_480, 84_481, LARGEST - 84_480, LARGEST - 1, LARGEST])
def test_turns_are_counted_up_to_the_largest_index(device, end, step):
    """As many as Python's range has, whose integers do not overflow."""
    begins = sorted({k for k in (0, 1, 999, 1000, 84_479, end - 1, end, LARGEST) if k >= 0})
    counts = wp.zeros(len(begins), dtype=int, device=device)
    wp.launch(
        _count_turns,
        dim=len(begins),
        inputs=[wp.array(np.array(begins, np.int32), dtype=int, device=device), end, step],
        outputs=[counts],
        device=device,
    )
    np.testing.assert_array_equal(counts.numpy(), [len(range(begin, end, step)) for begin in begins])
