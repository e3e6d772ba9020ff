"""Keys of many worlds in order, and what becomes of those that do not fit."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from neurosim_core.sensors import event_kernels as scan
from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.event_worlds import WorldEventCamera
from neurosim_core.sensors.events import EventCamera


@given(
    counts=st.lists(st.integers(0, 70), min_size=1, max_size=4),
    spread=st.sampled_from([2, 1000, 2**62]),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_network_sorts_any_number_of_keys(counts, spread, seed):
    """The network that a block of a CUDA device sorts with, here in one thread; the rest is not touched."""
    keys = np.random.default_rng(seed).integers(0, spread, (len(counts), 80))
    expected = np.array(keys)
    for world, count in enumerate(counts):
        expected[world, :count].sort()
    counters = np.array([[count, 0, 0] for count in counts])
    array = wp.array(keys, dtype=wp.int64, device="cpu")
    wp.launch(
        scan.sort_keys,
        dim=(len(counts), 1),
        inputs=[wp.array(counters, dtype=wp.int64, device="cpu"), array],
        device="cpu",
    )
    np.testing.assert_array_equal(array.numpy(), expected)


@pytest.mark.parametrize("count", [0, 1, 4095, 4096, 4097, 6000])
def test_many_keys(count, device):
    keys = np.random.default_rng(0).integers(0, 2**60, (2, 6001))
    array = wp.array(keys, dtype=wp.int64, device=device)
    lanes = 256 if device != "cpu" else 1
    counters = wp.array([[count, 0, 0], [5, 0, 0]], dtype=wp.int64, device=device)
    wp.launch(
        scan.sort_keys, dim=(2, lanes), block_dim=256, inputs=[counters, array], device=device
    )  # fmt: skip
    for row, given_row, n in zip(array.numpy(), keys, (count, 5), strict=True):
        np.testing.assert_array_equal(row, [*np.sort(given_row[:n]), *given_row[n:]])


@pytest.mark.parametrize("world_count", [1, 63, 64, 65, 1000, 4096])
def test_where_the_events_of_each_world_begin(world_count, device):
    counts = np.random.default_rng(world_count).integers(0, 500, world_count)
    counters = np.stack([counts, counts + 7, counts + 9], axis=1)
    array = wp.array(counters, dtype=wp.int64, device=device)
    sections = wp.zeros(-(-world_count // 64), dtype=wp.int64, device=device)
    offsets = wp.zeros(world_count + 1, dtype=wp.int32, device=device)
    found = wp.zeros(world_count, dtype=wp.int32, device=device)
    wp.launch(scan.add_up_sections, dim=sections.shape, inputs=[array], outputs=[sections], device=device)
    wp.launch(
        scan.add_up, dim=offsets.shape, inputs=[array, sections], outputs=[offsets, found], device=device
    )
    np.testing.assert_array_equal(offsets.numpy(), [0, *np.cumsum(counts)])
    np.testing.assert_array_equal(found.numpy(), counts)


def test_values_that_are_no_radiance_are_counted(device):
    """A single camera refuses them; a world holds its pixels, counts, and says where the first is."""
    frames = np.zeros((2, 3, 6), np.float32)
    frames[1, 1, 4] = np.nan
    frames[1, 2, 2] = np.inf
    array = wp.array(frames, dtype=wp.float32, device=device)
    camera = WorldEventCamera(
        [EventCameraConfig()] * 2,
        width=3,
        height=2,
        instant_count=3,
        device=device,
        capacity=100,
        sensor="e",
        seeds=[0, 1],
        clock_ns=wp.zeros(2, dtype=wp.int64, device=device),
    )
    camera.begin(array, 0, wp.ones(2, dtype=wp.int32, device=device))
    camera.plan(array, [1000, 2000, 3000], 0).launch()
    assert camera.results.counters.numpy().tolist() == [[0, 0, 0], [0, 2, 3 * 6 - (1 * 6 + 4)]]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1001.0])
def test_a_reference_that_is_no_radiance_is_counted_and_zero(device, value):
    """No level can be reached from it: the pixel begins at 0, and the rest of its world as it is."""
    frames = np.full((2, 3, 6), 0.25, np.float32)
    camera = WorldEventCamera(
        [EventCameraConfig(threshold_on=0.2, threshold_off=0.2)] * 2,
        width=3,
        height=2,
        instant_count=3,
        device=device,
        capacity=100,
        sensor="e",
        seeds=[0, 1],
        clock_ns=wp.zeros(2, dtype=wp.int64, device=device),
    )
    frames[1, 0, 4] = value
    array = wp.array(frames, dtype=wp.float32, device=device)
    camera.begin(array, 0, wp.ones(2, dtype=wp.int32, device=device))
    assert camera.results.counters.numpy().tolist() == [[0, 0, 0], [0, 1, 6 - 4]]
    camera.plan(array, [1000, 2000, 3000], 0).launch()
    t, x, y, polarity = camera.results.numpy(1)
    assert len(camera.results.numpy(0)[0]) == 0
    assert [(int(x[0]), int(y[0]), int(polarity[0]))] * len(t) == [(1, 1, 1)]


def test_stamps_do_not_depend_on_the_clock(device):
    """A world that has flown for long gives the events of one that has just begun, later."""
    rng = np.random.default_rng(0)
    frames = np.cumsum(rng.normal(0.0, 0.1, (5, 48)), axis=0).astype(np.float32)
    array = wp.array(np.repeat(frames[None], 3, axis=0), dtype=wp.float32, device=device)
    config = EventCameraConfig()
    starts_ns = np.array([0, 1_234_567, 3_600 * 10**9 + 999])
    camera = WorldEventCamera(
        [config] * 3,
        width=8,
        height=6,
        instant_count=5,
        device=device,
        capacity=500,
        sensor="e",
        seeds=[0, 1, 2],
        clock_ns=wp.array(starts_ns, dtype=wp.int64, device=device),
    )
    camera.begin(array, 0, wp.ones(3, dtype=wp.int32, device=device))
    offsets = (0, 2_000_500, 4_001_000, 7_500_000, 7_501_001, 9_000_000)
    camera.plan(array, offsets[1:], 0).launch()
    for world, start_ns in enumerate(starts_ns):
        alone = EventCamera(config, width=8, height=6, device="cpu")
        alone.reset(frames[0].reshape(6, 8), int(start_ns))
        stack = np.concatenate([frames, frames[-1:]])[:5].reshape(5, 6, 8)
        expected = alone.feed(stack, start_ns + np.array(offsets[1:])).numpy()
        for column, other in zip(camera.results.numpy(world), expected, strict=True):
            np.testing.assert_array_equal(column, other)
        assert len(expected.t) > 20
