"""Depth, flow and the next events: metrics and losses by their formulas, and training from each source."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import neurosim_core as ns
from neurosim_core.cli import main
from neurosim_core.data.batch import Sample, collate
from neurosim_core.packets import EventArrays
from neurosim_core.record import RecordingWriter
from neurosim_core.record.header import RecordingHeader

torch = pytest.importorskip("torch", reason="needs the extra learn")

from neurosim_core.learn import dense_train, dense_worlds  # noqa: E402
from neurosim_core.learn.dense import DenseNet  # noqa: E402
from neurosim_core.learn.dense_train import (  # noqa: E402
    DenseConfig,
    ReplayBuffer,
    evaluate,
    held_out_windows,
    load_dense,
    train_dense,
    windows_of,
)
from neurosim_core.learn.dense_worlds import world_windows  # noqa: E402
from neurosim_core.learn.heads import HEADS, depth_loss  # noqa: E402


@pytest.fixture(autouse=True)
def _one_thread():
    """Threads of PyTorch that wait for each other are slow beside other tests."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def test_metrics_of_depth_are_those_of_the_formulas():
    random = np.random.default_rng(0)
    depth = random.uniform(0.5, 40.0, (3, 6, 8)).astype(np.float32)
    found = depth * np.exp(random.normal(0.1, 0.3, depth.shape)).astype(np.float32)
    depth[0, 0, :4] = np.inf
    depth[1, 1, 0] = 100.0  # beyond what counts
    head, seen = HEADS["depth"], torch.zeros(1)
    result = head.errors(
        sum(
            head.measure(torch.from_numpy(one).log(), torch.from_numpy(truth), seen)
            for one, truth in zip(found, depth, strict=True)
        )
    )
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


def test_the_loss_of_depth_halves_the_weight_of_a_wrong_scale_and_ignores_unknown_depth():
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
    net = DenseNet((0.0, 1.0), channels=4)
    torch.nn.init.normal_(net.out.weight, std=0.1)
    first, second = torch.randn(2, 1, 5, 21, 30)
    alone, _ = net(second)
    _, memory = net(first)
    after, _ = net(second, memory)
    assert alone.shape == (1, 2, 21, 30)
    assert (after - alone).abs().max() > 1e-4


def test_metrics_of_flow_and_of_future_events_are_those_of_the_formulas():
    random = np.random.default_rng(0)
    flow = random.normal(0.0, 3.0, (2, 2, 6, 8)).astype(np.float32)
    found = flow + random.normal(0.0, 2.5, flow.shape).astype(np.float32)
    flow[0, 0, 0, :3] = np.nan
    seen = (random.random((2, 1, 6, 8)) < 0.3).astype(np.float32)
    tensors = [torch.from_numpy(array) for array in (found, flow, seen)]
    sums = HEADS["flow"].measure(*tensors)
    off = np.linalg.norm(found - flow, axis=1)
    known, fired = np.isfinite(off), np.isfinite(off) & (seen[:, 0] > 0)
    expected = [f(off[k]) for k in (known, fired) for f in (np.mean, lambda o: np.mean(o > 3.0))]
    assert HEADS["flow"].errors(sums) == pytest.approx(expected, rel=1e-5)
    loss = HEADS["flow"].loss(*tensors[:2]).item()
    assert loss == pytest.approx(off[known].mean(), rel=1e-4)  # where errors are far above 0.001 px

    odds = random.normal(-1.0, 2.0, (2, 2, 6, 8))
    truth = (random.random(odds.shape) < 0.2).astype(np.float32)
    sums = HEADS["pretrain"].measure(torch.from_numpy(odds), torch.from_numpy(truth), tensors[2])
    chance = 1.0 / (1.0 + np.exp(-odds))
    bits = -np.log2(np.where(truth > 0, chance, 1.0 - chance)).mean()
    hit, said = ((chance > 0.5) & (truth > 0)).sum(), (chance > 0.5).sum()
    precision, recall = hit / said, hit / truth.sum()
    f1 = 2.0 / (1.0 / precision + 1.0 / recall)
    assert HEADS["pretrain"].errors(sums) == pytest.approx((bits, f1), rel=1e-6)


def window(number, source, value):
    events = EventArrays(np.zeros(0, np.int64), *(np.zeros(0, t) for t in (np.uint16, np.uint16, np.uint8)))
    depth = np.full((8, 8), value, np.float32) + np.arange(8, dtype=np.float32)
    return Sample(
        stamp_ns=50_000_000 * (number + 1), start_ns=50_000_000 * number, source=source, width=8, height=8,
        events=events, depth=depth, flow=None, rgb=None, imu=None, pose=None, dropped_count=0, lost_count=0,
    )  # fmt: skip


def test_a_pool_has_sequences_of_one_flight_without_gaps():
    buffer = ReplayBuffer(length=2, capacity=6)
    mixed = [window(0, "a", 100), window(0, "b", 200), window(1, "a", 101), window(1, "b", 201)]
    gap = [window(2, "a", 102), window(4, "a", 104), window(5, "a", 105)]
    for sample in (*mixed, *gap):
        buffer.add(windows_of(collate([sample]), HEADS["depth"], 1))
    assert (len(buffer), buffer.window_count) == (3, 7)
    voxel, depth = buffer.draw(64, np.random.default_rng(0))
    assert voxel.shape == (2, 64, 1, 8, 8)
    corners = {tuple(sorted((row[0].item(), row[-1].item()))) for row in depth[0, :, 0, 0]}
    assert corners == {(100, 107), (200, 207), (104, 111)}
    assert (depth[1] - depth[0] == 1).all()
    mirrored = depth[0, :, 0, 0, 0] > depth[0, :, 0, 0, -1]
    assert 10 < mirrored.sum() < 54
    for number in range(6, 14):  # the oldest go
        buffer.add(windows_of(collate([window(number, "a", number)]), HEADS["depth"], 1))
    assert len(buffer) == 3
    assert buffer.draw(64, np.random.default_rng(0))[1].max() <= 20


def test_a_mirrored_flow_goes_the_other_way():
    buffer = ReplayBuffer(length=1, capacity=1, mirrored=HEADS["flow"].mirrored)
    sample = window(0, "a", 0)
    flow = np.stack([np.full((8, 8), 2.0), np.full((8, 8), 3.0)], -1).astype(np.float32)
    buffer.add(windows_of(collate([replace(sample, flow=flow)]), HEADS["flow"], 1))
    _, drawn = buffer.draw(64, np.random.default_rng(0))
    assert {tuple(pair) for pair in drawn[0, :, :, 0, 0].tolist()} == {(2.0, 3.0), (-2.0, 3.0)}


def settings(scene, side=1.0, **more):
    """Return a short flight to one side, along slats that are brighter and darker and not all as far."""
    lens = {"width": 16, "height": 16, "horizontal_fov_rad": 1.5}
    frames = [{"time_s": t, "position_m": [0.0, side * 2.5 * (t - 0.4), 0.1]} for t in (0.0, 0.4, 0.8)]
    return {
        "duration_s": 0.6, "device": "cpu", "scene": scene, "seed": 0,
        "path": {"kind": "poses", "keyframes": frames}, "render": {"lighting": {"mode": "unshadowed"}},
        "sensors": {
            "events": {"kind": "event_camera", "lens": lens, "sampling_rate_hz": 100},
            "depth": {"kind": "depth", "lens": lens, "rate_hz": 20},
            "flow": {"kind": "optical_flow", "lens": lens, "rate_hz": 20, "occlusion": False},
        },
        **more,
    }  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    slats = [trimesh.creation.box((0.1, 20.0, 20.0), trimesh.transformations.translation_matrix([4.0, 0, 0]))]
    for number in range(16):
        place = trimesh.transformations.translation_matrix([1.5 + number % 2, 0.8 * (number - 7.5), 0.0])
        slats.append(trimesh.creation.box((0.1, 0.4, 4.0), place))
        slats[-1].visual.face_colors = [80 + 50 * (number % 4)] * 3
    file = tmp_path_factory.mktemp("slats") / "slats.ply"
    trimesh.util.concatenate(slats).export(file)
    return {"kind": "mesh", "file": str(file), "up_axis": "z", "unit_m": 1.0}


@pytest.fixture(scope="module")
def flights(tmp_path_factory, scene):
    """Recordings of two flights, one to each side."""
    folder = tmp_path_factory.mktemp("flights")
    for side in (1, -1):
        header = RecordingHeader(config_yaml="", seed=0, version="0")
        with RecordingWriter(folder / f"{side}.h5", header) as writer:
            for packet in ns.run(settings(scene, side)):
                writer.write(packet)
    return folder


@pytest.mark.parametrize("task", HEADS)
def test_training_from_files_learns_and_can_be_loaded(tmp_path, flights, task, capsys):
    steps = 240 if task == "flow" else 120  # flow first finds that nothing moves, and stays there for a while
    config = DenseConfig(task=task, steps=steps, batch=4, channels=8, rate=1e-2)
    errors = train_dense(tmp_path, config, data=flights, test=flights)
    for blind in ("events zeroed", "mean of each pixel"):
        assert errors["network"][0] < 0.7 * errors[blind][0]
    told = json.loads((tmp_path / f"{task}.json").read_text())
    assert told["steps"] == steps
    assert told["training windows"] == (20 if task == "pretrain" else 24)  # of whole sequences
    net, loaded = load_dense(tmp_path / f"{task}.pt")
    assert (loaded.task, loaded.channels) == (task, 8)
    tested = held_out_windows(loaded, flights)
    assert evaluate(net, tested, loaded.head) == errors["network"]
    assert main(["learn", "eval", str(tmp_path / f"{task}.pt"), "--test", str(flights)]) == 0
    assert capsys.readouterr().out == f"{errors['network']}\n"


def test_a_network_is_tested_at_another_size_and_kept_if_that_fails(tmp_path, flights, scene):
    sensors = settings(scene)["sensors"]
    for sensor in sensors.values():
        sensor["lens"]["width"] = 24
    with RecordingWriter(
        tmp_path / "wide.h5", RecordingHeader(config_yaml="", seed=0, version="0")
    ) as writer:
        for packet in ns.run(settings(scene, sensors=sensors)):
            writer.write(packet)
    config = DenseConfig(steps=1, batch=1, channels=4)
    errors = train_dense(tmp_path / "run", config, data=flights, test=tmp_path / "wide.h5")
    assert 0.0 < errors["mean of each pixel"].abs_rel < 1.0
    with pytest.raises(FileNotFoundError):
        train_dense(tmp_path / "none", config, data=flights, test=tmp_path / "nothing.h5")
    assert not (tmp_path / "none").exists()
    (tmp_path / "events.csv").write_text("t,x,y,p\n0,0,0,1\n900000,15,15,1\n")
    with pytest.raises(ValueError, match="has no sensor for depth"):
        train_dense(tmp_path / "kept", config, data=flights, test=tmp_path / "events.csv")
    load_dense(tmp_path / "kept" / "depth.pt")


def test_worlds_give_the_windows_of_runs(scene):
    """Voxels and ground truth of worlds on their device are those that are cut from their packets."""
    config = settings(scene, seed=3)
    truth = [
        windows_of(b, HEADS["flow"], 5) for b in ns.data.Stream(config, batch=1, fields=["events", "flow"])
    ]
    worlds = world_windows(config, HEADS["flow"], worlds=2, bins=5, window_s=0.05)
    for expected, found in zip(truth, worlds, strict=False):
        assert list(found.stamp_ns) == expected.stamp_ns * 2
        # the share of an event in a bin is float32 there
        torch.testing.assert_close(found.voxel[:1], expected.voxel, atol=1e-3, rtol=0.0)
        assert torch.equal(found.target[:1], expected.target)
    assert len(truth) == 12
    with pytest.raises(ValueError, match="whole periods"):
        next(world_windows(config, HEADS["flow"], worlds=2, bins=5, window_s=0.0505))


def test_worlds_draw_thresholds_and_render_as_often_as_is_said(scene):
    """On one path worlds see the same but for their thresholds; fewer renders see nearly the same events."""
    config, options = settings(scene, seed=3), {"worlds": 2, "bins": 5, "window_s": 0.05}
    totals = {}
    for renders, spread in ((None, 0.0), (2, 0.0), (2, 0.25)):
        flown = world_windows(config, HEADS["pretrain"], renders=renders, threshold_spread=spread, **options)
        voxels = []
        for found in itertools.islice(flown, 4):
            voxels.append(found.voxel.clone())
            assert torch.equal(found.target.sum((1, 2, 3)) > 0, found.voxel.abs().sum((1, 2, 3)) > 0)
        one, other = torch.stack(voxels, 1)
        assert torch.equal(one, other) == (spread == 0.0)
        totals[renders, spread] = one.abs().sum().item()
    assert totals[2, 0.0] == pytest.approx(
        totals[None, 0.0], rel=0.2
    )  # what flickers within 25 ms is not seen


def test_worlds_fly_on_when_their_windows_have_been_seen(tmp_path, flights, scene, monkeypatch):
    monkeypatch.setattr(dense_train, "flight_settings", lambda *_, **__: settings(scene))
    config = DenseConfig(task="flow", steps=3, batch=1, channels=4, reuse=0.25)
    train_dense(tmp_path, config, worlds=2, test=flights)
    told = json.loads((tmp_path / "flow.json").read_text())
    assert told["training windows"] == 32  # the last step begins when 8 were seen: a quarter of them


def test_worlds_of_another_device_fly_meanwhile(tmp_path, flights, scene, monkeypatch):
    """Training waits until no window has been seen too often; what ends the flights ends it."""
    monkeypatch.setattr(dense_train, "flight_settings", lambda *_, **__: settings(scene))
    # `cpu:0` is another name to PyTorch, not to us
    config = DenseConfig(
        task="flow", steps=3, batch=1, channels=4, reuse=0.25, device="cpu:0", fly_device="cpu"
    )
    train_dense(tmp_path, config, worlds=2, test=flights)
    told = json.loads((tmp_path / "flow.json").read_text())
    assert told["training windows"] >= 32
    assert 0.0 < told["share of the time without data"] < 1.0

    windows = dense_worlds.world_windows

    def breaks(*arguments, **options):
        yield from itertools.islice(windows(*arguments, **options), 5)
        raise OSError("the other device is gone")

    monkeypatch.setattr(dense_worlds, "world_windows", breaks)
    with pytest.raises(OSError, match="device is gone"):
        train_dense(tmp_path, config, worlds=2, test=flights)
    with pytest.raises(ValueError, match=r"fly_device.*needs worlds"):
        train_dense(tmp_path, config, data=flights)


def test_a_backbone_is_taken_from_torch_and_from_onnx(tmp_path):
    torch.manual_seed(0)
    trained, file = DenseNet((-2.0, -2.0), channels=4), tmp_path / "other.pt"
    torch.save(trained.state_dict(), file)
    onnx = pytest.importorskip("onnx", reason="needs the extra learn")
    weights = [onnx.numpy_helper.from_array(v.numpy(), name) for name, v in trained.state_dict().items()]
    graph = onnx.helper.make_graph([], "net", [], [], weights)
    onnx.save(onnx.helper.make_model(graph), str(tmp_path / "other.onnx"))
    for name in ("other.pt", "other.onnx"):
        net = DenseNet((0.5,), channels=4)
        net.take_backbone(tmp_path / name)
        assert net.out.bias.tolist() == [0.5]
        for own, other in zip(net.up.parameters(), trained.up.parameters(), strict=True):
            assert torch.equal(own, other)
    with pytest.raises(ValueError, match=r"5 bins and 8 channels: \d+ of \d+ weights are missing"):
        DenseNet((0.5,), channels=8).take_backbone(file)


def test_training_from_a_live_process(tmp_path, flights, runtime):
    """A process flies and streams over Cortex while the network learns, and ends with it."""
    config = DenseConfig(steps=3, batch=1, channels=4, size_px=16)
    errors = train_dense(tmp_path, config, live=1, test=flights)
    assert errors["network"].abs_rel > 0.0
    told = json.loads((tmp_path / "depth.json").read_text())
    assert told["training windows"] >= 4
    assert told["test windows"] == 24


def test_wrong_use_says_what_to_give(tmp_path, flights):
    with pytest.raises(ValueError, match="--data DIR, --live N, or --worlds N"):
        train_dense(tmp_path, DenseConfig())
    with pytest.raises(ValueError, match="no 100 consecutive windows"):
        train_dense(tmp_path, DenseConfig(sequence=100), data=flights)
    torch.save({"weights": 1}, tmp_path / "other.pt")
    with pytest.raises(ValueError, match="no network of `neurosim learn depth or flow or pretrain`"):
        load_dense(tmp_path / "other.pt")
