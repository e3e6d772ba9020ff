"""What is rendered for the studies of events, rendering, throughput and worlds, and what is said of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from small_room import room_scene

from neurosim_core.bench import events, events_space, render, throughput, worlds
from neurosim_core.bench.engine import (
    PinholeConfig,
    RenderConfig,
    ShiftedLens,
    View,
    camera_poses,
    upload_scene,
)
from neurosim_core.bench.events_space import thin_structures
from neurosim_core.bench.naive_events import NaiveEventCamera
from neurosim_core.bench.options import Options

LENS = PinholeConfig(width=24, height=18, horizontal_fov_rad=1.5)


@pytest.mark.slow
def test_events_in_time_and_space():
    """More renders and more rays are nearer to the reference; the floor is nearest."""
    chapter = events.measure(Options(quick=True, device="cpu", width=24, samples=(1, 8)))
    in_time, in_space = (table.rows for table in chapter.tables)
    fixed = [row["distance per event"] for row in in_time if row["scheme"] == "fixed"]
    assert fixed == sorted(fixed, reverse=True)
    for row in in_time:  # found = reference - missing + spurious
        balance = row["events more or fewer [%]"] + row["missing [%]"] - row["spurious [%]"]
        assert balance == pytest.approx(0.0, abs=1e-9)
    assert len(in_space) == 12
    for begin in range(0, 12, 4):
        floor, one, eight, default = in_space[begin : begin + 4]
        assert "pattern" in floor["rays per pixel"]
        assert default["rays per pixel"] == "adaptive (default)"
        shares = [row["spurious, 20 ms [%]"] + row["missed, 20 ms [%]"] for row in (floor, eight, one)]
        assert shares == sorted(shares)
        assert default["spurious, 20 ms [%]"] < one["spurious, 20 ms [%]"]
        assert one["spurious, 1 ms [%]"] >= one["spurious, 5 ms [%]"] >= one["spurious, 20 ms [%]"]


def test_claims_on_aliasing_see_what_is_beyond_limit_and_floor():
    case = {"scene": "s", "motion": "m", "pixels": "346x260"}
    names = [f"{kind}, {w} ms [%]" for kind in ("spurious", "missed") for w in (5, 20)]
    floor = {**case, "rays per pixel": "64, another pattern", **dict.fromkeys(names, 1.0)}
    row = {**case, "rays per pixel": "1 (default)", **dict.fromkeys(names, 4.0)}
    beyond = {**row, "missed, 20 ms [%]": 6.0}
    noisy = {**floor, "missed, 20 ms [%]": 3.5}
    for rows, met in (((floor, row), True), ((floor, beyond), False), ((noisy, beyond), True)):
        assert [claim.met for claim in events_space.space_claims(rows)] == [met]


def test_samples_out_of_range_are_refused():
    with pytest.raises(ValueError, match=r"samples must be in \[1, 64\], got \[0, 4\]"):
        events.measure(Options(device="cpu", samples=(0, 4)))


def test_render_study_and_its_claims(monkeypatch):
    """Rays and filters keep errors small; a default that is no better than one ray is seen."""
    monkeypatch.setattr(
        render.engine, "free_views", lambda *_, **__: (np.array([[0.0, 0.0, 1.2]]), np.zeros(1))
    )
    chapter = render.measure(Options(quick=True, device="cpu", samples=(1, 4)))
    rows = chapter.tables[0].rows
    room = {(r["filter"], r["rays per pixel"]): r["RMS error"] for r in rows if "apartment" in r["scene"]}
    assert room["trilinear", 4] < room["trilinear", 1] < room["nearest", 1]
    assert [claim.met for claim in chapter.claims] == [True, True]
    coarse = [{**row, "RMS error": 1.0} for row in rows]
    assert [claim.met for claim in render._chapter(coarse, "cpu", "96x72").claims] == [False, False]


def test_a_shifted_lens_sees_the_same_picture_by_other_rays():
    scene = thin_structures()
    poses = camera_poses(np.array([[0.013, 0.007, 0.0]]), Rotation.from_euler("z", [0.1]))
    found = []
    for lens, count in ((LENS, 64), (ShiftedLens(LENS, (0.382, 0.618)), 64), (LENS, 1)):
        config = RenderConfig(samples_per_pixel=count, exposure=1.0)
        found.append(
            View(upload_scene(scene, config, device="cpu"), lens, count=1).render(poses).numpy().copy()
        )
    other, coarse = (np.sqrt(np.mean((picture - found[0]) ** 2)) for picture in found[1:])
    assert 0.0 < other < 0.2 * coarse


def test_naive_events_follow_their_rule(device):
    """One event for each pixel beyond a threshold, and the new value as reference: a loop in NumPy."""
    frames = np.random.default_rng(1).normal(scale=0.3, size=(6, 5, 7)).cumsum(axis=0).astype(np.float32)
    camera = NaiveEventCamera(width=7, height=5, threshold_on=0.2, threshold_off=0.25, device=device)
    on_device = wp.array(frames, dtype=float, device=device)
    camera.reset(on_device[0])
    level = frames[0].copy()
    for number in range(1, 6):
        change = frames[number] - level
        fired = (change >= np.float32(0.2)) | (change <= -np.float32(0.25))
        found = camera.events(camera.feed(on_device[number], 1000 * number))
        places = set(zip(found.y.tolist(), found.x.tolist(), strict=True))
        assert places == set(zip(*(index.tolist() for index in np.nonzero(fired)), strict=True))
        assert (found.polarity == (change[found.y, found.x] > 0.0)).all()
        assert (found.t == 1000 * number).all()
        level[fired] = frames[number][fired]


@pytest.mark.slow
def test_throughput_study(tmp_path):
    scene = Path(room_scene(tmp_path)["file"])
    chapter = throughput.measure(Options(quick=True, device="cpu", samples=(1,), scene=scene))
    steps, parts = (table.rows for table in chapter.tables)
    assert all(row["slowest"] <= row["whole steps/s"] <= row["fastest"] for row in steps)
    assert all(row["us per frame"] > 0.0 for row in parts)
    assert chapter.claims[0].met is None  # it is of a CUDA device


def test_worlds_study():
    chapter = worlds.measure(Options(quick=True, device="cpu", width=16, worlds=(1, 2), seconds=0.05))
    rows = chapter.tables[0].rows
    assert [(row["pixels"], row["worlds"]) for row in rows] == [("16x16", 1), ("16x16", 2)]
    assert all(row["renders/s"] == pytest.approx(8.0 * row["steps/s"]) for row in rows)
    assert all(row["ratio"] == pytest.approx(row["renders/s"] / row["renders/s, single"]) for row in rows)
