"""Event surfaces against their definitions in float64; worlds have nothing to do with each other."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from neurosim_core.learn.surfaces import Counts, EventSurface, LeakySurface, TimeSurface, VoxelGrid

WIDTH, HEIGHT, STEP_US = 5, 4, 10_000


def draw_steps(seed: int, steps: int, worlds: int) -> list[list[np.ndarray]]:
    """Return t [us], x, y, polarity of random events, [step][world]."""
    rng = np.random.default_rng(seed)
    found = []
    for step in range(steps):
        rows = []
        for _ in range(worlds):
            count = int(rng.integers(0, 60))
            t = np.sort(rng.integers(step * STEP_US + 1, (step + 1) * STEP_US + 1, count))
            rows.append(
                np.stack([t, *(rng.integers(0, n, count) for n in (WIDTH, HEIGHT, 2))]).astype(np.int64)
            )
        found.append(rows)
    return found


def as_events(rows: list[np.ndarray]) -> SimpleNamespace:
    joined = np.concatenate(rows, axis=1)
    offsets = np.concatenate([[0], np.cumsum([r.shape[1] for r in rows])]).astype(np.int32)
    kinds = (("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("polarity", np.uint8))
    columns = {
        name: wp.array(joined[index].astype(kind), device="cpu") for index, (name, kind) in enumerate(kinds)
    }
    return SimpleNamespace(**columns, offsets=wp.array(offsets, device="cpu"))


def show(config, steps: list[list[np.ndarray]], forget: dict[int, list[int]] | None = None) -> np.ndarray:
    worlds = len(steps[0])
    surface = EventSurface(
        config, world_count=worlds, width=WIDTH, height=HEIGHT, step_s=1e-6 * STEP_US, device="cpu"
    )
    for step, rows in enumerate(steps):
        now = np.full(worlds, (step + 1) * STEP_US * 1000, np.int64)
        surface.update(as_events(rows), wp.array(now, device="cpu"))
        if forget and step in forget:
            surface.forget(wp.array(np.array(forget[step], np.int32), device="cpu"))
    return np.array(surface.array.numpy())


def oracle(config, steps: list[np.ndarray]) -> np.ndarray:
    """Return the surface of one world, event by event."""
    out = np.zeros((config.channel_count, HEIGHT, WIDTH))
    now = len(steps) * STEP_US
    if isinstance(config, (TimeSurface, LeakySurface)):
        for t, x, y, p in np.concatenate(steps, axis=1).T:
            for scale, tau_s in enumerate(config.tau_s):
                value = np.exp(-(now - t) / (1e6 * tau_s))
                if isinstance(config, TimeSurface):
                    out[2 * scale + p, y, x] = value
                else:
                    out[2 * scale + p, y, x] += value
        return out
    for t, x, y, p in steps[-1].T:
        if isinstance(config, Counts):
            out[p, y, x] += 1
        else:
            place = (config.bins - 1) * (1.0 - (now - t) / STEP_US)
            for b in range(config.bins):
                share = max(0.0, 1.0 - abs(place - b))
                if config.split:
                    out[b + p * config.bins, y, x] += share
                else:
                    out[b, y, x] += (2 * p - 1) * share
    return out


CONFIGS = [
    TimeSurface(),
    LeakySurface(tau_s=(0.01, 0.1)),
    Counts(),
    VoxelGrid(bins=5),
    VoxelGrid(bins=1),
    VoxelGrid(bins=3, split=True),
]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: f"{type(c).__name__}-{c.channel_count}")
def test_surfaces_are_what_they_are_defined_as(config):
    steps = draw_steps(0, 4, 3)
    seen = show(config, steps)
    assert np.abs(seen).max() > 0.5
    for world in range(3):
        expected = oracle(config, [rows[world] for rows in steps])
        np.testing.assert_allclose(seen[world], expected, atol=2e-3 if "Leaky" in str(config) else 2e-4)


@pytest.mark.parametrize("config", CONFIGS[:3], ids=lambda c: type(c).__name__)
def test_a_world_that_begins_anew_forgets_and_others_do_not(config):
    steps = draw_steps(1, 3, 2)
    seen = show(config, steps, forget={2: [0, 1]})
    assert not seen[1].any()
    np.testing.assert_array_equal(seen[0], show(config, steps)[0])


def test_the_neighbours_of_a_world_change_no_bit_of_it():
    steps = draw_steps(2, 3, 3)
    for config in CONFIGS:
        alone = show(config, [[rows[1]] for rows in steps])
        np.testing.assert_array_equal(show(config, steps)[1], alone[0])


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="tau_s must be"):
        TimeSurface(tau_s=())
    with pytest.raises(ValueError, match="dtype must be"):
        Counts(dtype="int8")
    with pytest.raises(ValueError, match="bins must be"):
        VoxelGrid(bins=0)


@pytest.mark.parametrize("config", CONFIGS, ids=lambda c: f"{type(c).__name__}-{c.channel_count}")
@pytest.mark.parametrize("dtype", ["float16", "uint8"])
def test_other_types_show_the_same_values_rounded(config, dtype):
    """Also after worlds began anew: what is remembered is not rounded."""
    steps, forget = draw_steps(3, 5, 3), {1: [0, 1, 0]}
    exact = show(config, steps, forget)
    expected = exact.astype(np.float16)
    if dtype == "uint8":
        gain, zero = config.uint8_levels
        expected = np.clip(np.rint(exact * np.float32(gain) + np.float32(zero)), 0, 255).astype(np.uint8)
    seen = show(dataclasses.replace(config, dtype=dtype), steps, forget)
    assert seen.dtype == dtype
    assert len(np.unique(seen)) > 3
    np.testing.assert_array_equal(seen, expected)


def test_in_uint8_nothing_is_the_level_of_zero_and_much_is_held():
    config = VoxelGrid(bins=1, dtype="uint8")
    assert (show(config, [[np.zeros((4, 0), np.int64)]]) == 128).all()
    steps = draw_steps(0, 1, 2)
    seen = show(config, steps, forget={0: [1, 0]})
    assert (seen[0] == 128).all()
    assert (seen[1] != 128).any()
    many = np.array([[5_000] * 20, [1] * 20, [2] * 20, [1] * 20])
    assert show(config, [[many]])[0, 0, 2, 1] == 255


def test_surfaces_are_those_of_tonic():
    """Its voxel grids last from the first event to the last, and leave out the moment at the end."""
    functional = pytest.importorskip("tonic", reason="tonic is not installed").functional
    size, steps = (WIDTH, HEIGHT, 2), [rows[0] for rows in draw_steps(5, 4, 1)]
    for step, rows in enumerate(steps):
        rows[0] = np.minimum(rows[0], (step + 1) * STEP_US - 1)  # its slices do not contain their end
    steps[0][0, 0] = 0
    all_events, last = (
        np.rec.fromarrays(list(rows), names=["t", "x", "y", "p"])
        for rows in (np.concatenate(steps, axis=1), steps[-1])
    )
    tau_us = 10_000
    expected = functional.to_timesurface_numpy(all_events, size, STEP_US, tau_us, include_incomplete=True)
    seen = show(TimeSurface(tau_s=(1e-6 * tau_us,)), [[rows] for rows in steps])
    np.testing.assert_allclose(seen[0], expected[-1], atol=2e-4)
    seen = show(Counts(), [[rows] for rows in steps])
    np.testing.assert_array_equal(seen[0], functional.to_frame_numpy(last, size, n_event_bins=1)[0])
    rows = steps[0]
    rows[0, -1] = STEP_US
    events = np.rec.fromarrays(list(rows), names=["t", "x", "y", "p"])
    seen = show(VoxelGrid(bins=6), [[rows]])
    grid = functional.to_voxel_grid_numpy(events, size, n_time_bins=5)
    np.testing.assert_allclose(seen[0, :5], grid[:, 0], atol=2e-4)
