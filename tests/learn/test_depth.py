"""Depth from events: metrics and loss against their formulas, memory, and training from files and live."""

from __future__ import annotations

import json

import numpy as np
import pytest
from small_room import room_scene

import neurosim_core as ns
from neurosim_core.data.batch import Sample, collate
from neurosim_core.packets import EventArrays
from neurosim_core.record import RecordingWriter
from neurosim_core.record.header import RecordingHeader

torch = pytest.importorskip("torch", reason="needs the extra learn")

from neurosim_core.learn.depth import DepthNet, ErrorSums, depth_loss  # noqa: E402
from neurosim_core.learn.depth_train import (  # noqa: E402
    DepthConfig,
    WindowPool,
    evaluate,
    held_out_windows,
    load_depth,
    train_depth,
)


@pytest.fixture(autouse=True)
def _one_thread():
    """Threads of PyTorch that wait for each other are slow beside other tests."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_metrics_are_those_of_the_formulas():
    random = np.random.default_rng(0)
    depth = random.uniform(0.5, 40.0, (3, 6, 8)).astype(np.float32)
    found = depth * np.exp(random.normal(0.1, 0.3, depth.shape)).astype(np.float32)
    depth[0, 0, :4] = np.inf
    depth[1, 1, 0] = 100.0  # beyond what counts
    sums = ErrorSums()
    sums.add(torch.from_numpy(found[:1]).log(), torch.from_numpy(depth[:1]))
    sums.add(torch.from_numpy(found[1:]).log(), torch.from_numpy(depth[1:]))
    result = sums.result()
    known = depth < 80.0
    d, f = depth[known].astype(np.float64), found[known].astype(np.float64)
    error = np.log(f / d)
    assert result.abs_rel == pytest.approx(np.mean(np.abs(f - d) / d), rel=1e-5)
    assert result.rmse_log == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-5)
    each = [np.var(np.log(b[k] / a[k])) for a, b, k in zip(depth, found, known, strict=True)]
    assert result.si_log == pytest.approx(np.mean(each), rel=1e-5)
    ratio = np.maximum(f / d, d / f)
    assert result.delta == pytest.approx([np.mean(ratio < 1.25**k) for k in (1, 2, 3)])
    assert result.mean_m == pytest.approx([np.abs(f - d)[d < cut].mean() for cut in (10, 20, 30)], rel=1e-5)


def test_the_loss_halves_the_weight_of_a_wrong_scale_and_ignores_unknown_depth():
    depth = torch.full((2, 16, 16), 3.0)
    depth[:, 4:8] = float("inf")
    wrong = depth.clone()
    wrong[torch.isinf(wrong)] = 1.0
    assert depth_loss(wrong.log(), depth).item() == pytest.approx(0.0, abs=1e-12)
    assert depth_loss(wrong.log() + 0.5, depth).item() == pytest.approx(0.5 * 0.5**2, rel=1e-5)
    ramp = wrong.log() + 0.1 * torch.arange(16.0)
    # at the scales 1, 2, 4 and 8 neighbours differ by as much; the variance of a ramp of n steps
    gradients = 0.25 / 4 * 0.1 * (1 + 2 + 4 + 8)
    error = 0.1 * np.arange(16)
    expected = np.mean(error**2) - 0.5 * np.mean(error) ** 2 + gradients
    assert depth_loss(ramp, depth).item() == pytest.approx(expected, rel=1e-4)


def test_the_network_takes_any_size_and_remembers():
    torch.manual_seed(0)
    net = DepthNet(channels=4)
    torch.nn.init.normal_(net.out.weight, std=0.1)
    first, second = torch.randn(2, 1, 5, 21, 30)
    alone, _ = net(second)
    _, memory = net(first)
    after, _ = net(second, memory)
    assert alone.shape == (1, 21, 30)
    assert (after - alone).abs().max() > 1e-4


def window(number, source, value):
    events = EventArrays(np.zeros(0, np.int64), *(np.zeros(0, t) for t in (np.uint16, np.uint16, np.uint8)))
    depth = np.full((8, 8), value, np.float32) + np.arange(8, dtype=np.float32)
    return Sample(
        stamp_ns=50_000_000 * (number + 1), start_ns=50_000_000 * number, source=source, width=8, height=8,
        events=events, depth=depth, flow=None, rgb=None, imu=None, pose=None, dropped_count=0, lost_count=0,
    )  # fmt: skip


def test_a_pool_has_sequences_of_one_flight_without_gaps():
    pool = WindowPool(length=2, room=6, bins=1)
    mixed = [window(0, "a", 100), window(0, "b", 200), window(1, "a", 101), window(1, "b", 201)]
    gap = [window(2, "a", 102), window(4, "a", 104), window(5, "a", 105)]
    for sample in (*mixed, *gap):
        pool.add(collate([sample]))
    assert (len(pool), pool.window_count) == (3, 7)
    voxel, depth = pool.draw(64, np.random.default_rng(0))
    assert voxel.shape == (2, 64, 1, 8, 8)
    corners = {tuple(sorted((row[0].item(), row[-1].item()))) for row in depth[0, :, 0]}
    assert corners == {(100, 107), (200, 207), (104, 111)}
    assert (depth[1] - depth[0] == 1).all()
    mirrored = depth[0, :, 0, 0] > depth[0, :, 0, -1]
    assert 10 < mirrored.sum() < 54
    for number in range(6, 14):  # the oldest go
        pool.add(collate([window(number, "a", number)]))
    assert len(pool) == 3
    assert pool.draw(64, np.random.default_rng(0))[1].max() <= 20


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """Recordings of two short flights along a wall that comes nearer."""
    folder = tmp_path_factory.mktemp("flights")
    lens = {"width": 16, "height": 16, "horizontal_fov_rad": 1.5}
    scene = room_scene(tmp_path_factory.mktemp("room"))
    for number in range(2):
        frames = [{"time_s": t, "position_m": [0.5 * t, 0.2 * t, 1.2]} for t in (0.0, 0.4, 0.8)]
        config = {
            "duration_s": 0.6, "device": "cpu", "scene": scene,
            "path": {"kind": "poses", "keyframes": frames}, "render": {"lighting": {"mode": "unshadowed"}},
            "sensors": {
                "events": {"kind": "event_camera", "lens": lens, "sampling_rate_hz": 100},
                "depth": {"kind": "depth", "lens": lens, "rate_hz": 20},
            },
        }  # fmt: skip
        header = RecordingHeader(config_yaml="", seed=0, version="0")
        with RecordingWriter(folder / f"{number}.h5", header) as writer:
            for packet in ns.run(config):
                writer.write(packet)
    return folder


def test_training_from_files_learns_and_can_be_loaded(tmp_path, flights):
    config = DepthConfig(steps=60, batch=2, channels=4, rate=1e-2)
    errors = train_depth(tmp_path, config, data=flights, test=flights)
    torch.manual_seed(0)
    untrained = evaluate(DepthNet(channels=4), list(held_out_windows(config, flights)))
    assert errors["network"].abs_rel < 0.7 * untrained.abs_rel
    told = json.loads((tmp_path / "depth.json").read_text())
    assert told["steps"] == 60
    assert told["training windows"] == 24
    net = load_depth(tmp_path / "depth.pt")
    voxel = torch.randn(1, 5, 16, 16)
    assert torch.equal(net(voxel)[0], load_depth(tmp_path / "depth.pt")(voxel)[0])


def test_training_from_a_live_process(tmp_path, flights, runtime):
    """A process flies and streams over Cortex while the network learns, and ends with it."""
    config = DepthConfig(steps=3, batch=1, channels=4, size_px=16)
    errors = train_depth(tmp_path, config, live=1, test=flights)
    assert errors["network"].abs_rel > 0.0
    told = json.loads((tmp_path / "depth.json").read_text())
    assert told["training windows"] >= 4
    assert told["test windows"] == 24


def test_wrong_use_says_what_to_give(tmp_path, flights):
    with pytest.raises(ValueError, match="--data DIR, or --live N"):
        train_depth(tmp_path, DepthConfig())
    config = DepthConfig(sequence=100)
    with pytest.raises(ValueError, match="no 100 consecutive windows"):
        train_depth(tmp_path, config, data=flights)
