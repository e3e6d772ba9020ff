"""Windows of events: which events they have, what stands at their ends, and what networks see of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import yaml
from recorded_flights import HEIGHT, WIDTH, write_flight

import neurosim_core as ns
from neurosim_core import data
from neurosim_core.data.batch import FIELDS
from neurosim_core.data.sources import RunSource, WorldsSource, fields_of
from neurosim_core.data.windows import WindowConfig
from neurosim_core.io.transfer import transfer
from neurosim_core.packets import EventArrays
from neurosim_core.record import Recording, RecordingHeader, RecordingWriter


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    path = tmp_path_factory.mktemp("flight") / "flight.h5"
    return path, write_flight(path)


def all_samples(source, **options):
    return [(batch, row) for batch in data.Stream(source, batch=3, **options) for row in range(len(batch))]


def test_events_are_those_after_the_start_up_to_the_end(flight):
    path, events = flight
    windows = all_samples(path)
    assert len(windows) == 20
    for number, (batch, row) in enumerate(windows):
        found, start_us = batch.events.of(row), 50_000 * number
        chosen = events.rows((events.t > start_us) & (events.t <= start_us + 50_000))
        assert all(np.array_equal(a, b) for a, b in zip(found, chosen, strict=True))
        assert (batch.start_ns[row], batch.stamp_ns[row]) == (start_us * 1000, (start_us + 50_000) * 1000)
        assert batch.dropped_count[row] == sum((5 * number + k) % 3 for k in range(1, 6))


def test_ground_truth_is_that_of_the_end(flight):
    path, _ = flight
    with Recording(path) as recording:
        depth, position = recording.column("depth", "data"), recording.column("odometry", "position")
        force = recording.column("imu", "specific_force")
    for number, (batch, row) in enumerate(all_samples(path)):
        assert np.array_equal(batch.depth[row], depth[number])
        assert np.array_equal(batch.pose[row, :3], position[5 * number + 4])
        rows = batch.imu[batch.imu_offsets[row] : batch.imu_offsets[row + 1]]
        assert np.allclose(rows[:, 0], 0.05 * number + np.array([0.01, 0.02, 0.03, 0.04, 0.05]), atol=1e-12)
        assert np.array_equal(rows[:, 1:4], force[5 * number : 5 * number + 5])
        assert batch.rgb.shape == (len(batch), HEIGHT, WIDTH, 3)


def test_windows_that_overlap_and_windows_without_ground_truth(flight):
    path, events = flight
    stream = data.Stream(path, window_s=0.03, stride_s=0.01, fields=["events", "depth"])
    batches = [*stream]
    stamps = np.concatenate([batch.stamp_ns for batch in batches])
    assert (stamps % 50_000_000 == 0).all()
    assert len(stamps) == 20
    assert stream.skipped_count == 98 - 20  # ends at 30, 40, ..., 1000 ms
    first = batches[0].events.of(0)
    assert np.array_equal(first.t, events.t[(events.t > 20_000) & (events.t <= 50_000)])
    with pytest.raises(ValueError, match=r"no packet of depth is stamped at the end .* 0\.021"):
        data.Stream(path, window_s=0.021, fields=["events", "depth"])


def test_what_is_asked_for_wrongly(flight):
    path, _ = flight
    with pytest.raises(ValueError, match="has no sensor for flow; its sensors are "):
        data.Stream(path, fields=["flow"])
    with pytest.raises(ValueError, match="unknown field 'normals', known: events, "):
        data.Stream(path, fields=["normals"])
    with pytest.raises(ValueError, match="has no sensor 'left' for depth"):
        data.Stream(path, sensors={"depth": "left"})
    with pytest.raises(ValueError, match="whole microseconds"):
        data.Stream(path, window_s=1.5e-6)
    with pytest.raises(FileNotFoundError, match="no file or folder"):
        data.Stream(path.parent / "none")


def test_voxels_against_a_loop(flight):
    """Each event in turn, as eq. (1-2) of Zhu et al. (2019) read."""
    path, _ = flight
    batch = next(iter(data.Stream(path, batch=2)))
    for bins in (1, 2, 5):
        expected = np.zeros((2, bins, HEIGHT, WIDTH))
        for window in range(2):
            for t, x, y, p in zip(*batch.events.of(window), strict=True):
                moment = (bins - 1) * (t - 50_000 * window) / 50_000
                for b in range(bins):
                    weight = max(0.0, 1.0 - abs(b - moment)) if bins > 1 else 1.0
                    expected[window, b, y, x] += (2.0 * p - 1.0) * weight
        voxel = batch.events.voxel(bins)
        assert voxel.dtype == np.float32
        assert np.abs(voxel - expected).max() < 1e-5  # float32 of numbers up to 30


def test_surfaces_and_counts_against_a_loop(flight):
    path, _ = flight
    batch = next(iter(data.Stream(path, batch=2)))
    surface, count = np.zeros((2, 4, HEIGHT, WIDTH)), np.zeros((2, 2, HEIGHT, WIDTH))
    for window in range(2):
        for t, x, y, p in zip(*batch.events.of(window), strict=True):
            age_s = (50_000 * (window + 1) - t) * 1e-6
            surface[window, p, y, x], surface[window, 2 + p, y, x] = (
                np.exp(-age_s / 0.01),
                np.exp(-age_s / 0.05),
            )
            count[window, p, y, x] += 1
    assert np.abs(batch.events.surface((0.01, 0.05)) - surface).max() < 1e-6  # float32 of numbers up to 1
    assert np.array_equal(batch.events.counts(), count)


@pytest.mark.parametrize("name", ["a.raw", "a.dat", "a.csv", "a.npz", "mvsec.h5", "a.mcap"])
def test_any_event_file_is_a_source(name, flight, tmp_path):
    path, events = flight
    transfer(path, tmp_path / name, size=(WIDTH, HEIGHT))
    batches = [*data.Stream(tmp_path / name, fields=["events"], batch=4)]
    found = [batch.events.raw for batch in batches]
    has_pictures = name in ("mvsec.h5", "a.mcap")  # with them, time is from the whole second before
    begin = events.t[0] - (events.t[0] % 1_000_000 if has_pictures else 0)
    ends = 50_000 * len(np.concatenate([batch.stamp_ns for batch in batches]))
    expected = events.t[(events.t > begin) & (events.t - begin <= ends)] - begin
    assert np.array_equal(np.concatenate([part.t for part in found]), expected)


LENS = {"width": 32, "height": 24, "horizontal_fov_rad": 1.5}
CONFIG = {
    "duration_s": 0.2,
    "device": "cpu",
    "scene": {"kind": "apartment", "rooms": 1},
    "render": {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1},
    "sensors": {
        "cam": {"kind": "event_camera", "lens": LENS},
        "depth": {"kind": "depth", "rate_hz": 20.0, "lens": LENS},
        "imu": {"kind": "imu", "rate_hz": 200.0, "accelerometer_noise_density": 0.01},
        "odometry": {"kind": "odometry", "rate_hz": 200.0},
    },
}  # fmt: skip


def same(one: data.Sample, two: data.Sample) -> None:
    assert (one.stamp_ns, one.start_ns) == (two.stamp_ns, two.start_ns)
    assert (one.dropped_count, one.lost_count) == (two.dropped_count, two.lost_count)
    for name in ("depth", "imu", "pose"):
        assert np.array_equal(getattr(one, name), getattr(two, name)), name
    assert isinstance(one.events, EventArrays)
    assert all(np.array_equal(a, b) for a, b in zip(one.events, two.events, strict=True))


@pytest.mark.parametrize("labels", [[], ["depth"]])
def test_a_run_and_its_recording_give_the_same(labels, tmp_path):
    flow = {"kind": "optical_flow", "rate_hz": 20.0, "lens": LENS}
    camera = {**CONFIG["sensors"]["cam"], "labels": labels}
    config = ns.load_config({**CONFIG, "sensors": {**CONFIG["sensors"], "cam": camera, "flow": flow}})
    with RecordingWriter(tmp_path / "a.h5", RecordingHeader(config_yaml="", seed=0, version="0")) as out:
        for packet in ns.run(config):
            out.write(packet)
    recorded = data.Dataset(tmp_path / "a.h5").read(0, 4)
    assert sum(len(sample.events.t) for sample in recorded) > 500
    samples = [*RunSource(config).samples(WindowConfig())]
    assert len(samples) == 4
    for one, two in zip(samples, recorded, strict=True):
        same(one, two)
        assert one.flow.shape == (24, 32, 2)
        assert np.array_equal(one.flow, two.flow, equal_nan=True)


def test_what_a_sensor_gives_is_what_its_recording_gives(tmp_path):
    """Of every kind; ranges are depth and estimates are poses in a run, and in worlds, as in a recording."""
    cameras = {"lens": LENS, "rate_hz": 20.0}
    sensors: dict[str, Any] = {}
    for kind, cls in ns.registry.kinds("sensor").items():
        if not cls.__module__.startswith("neurosim_core.") or kind == "event_camera":
            continue
        settings = {name: value for name, value in cameras.items() if name in cls.model_fields}
        sensors[kind] = {"kind": kind, **(settings if "lens" in settings and kind != "lidar" else {})}
    sensors["grey"] = {"kind": "frame_camera", "color": "mono", **cameras}
    sensors["raw"] = {"kind": "frame_camera", "bits": 12, **cameras}
    config = ns.load_config({**CONFIG, "sensors": {"cam": CONFIG["sensors"]["cam"], **sensors}})
    given = fields_of(config)
    assert {name: field for name, field in given.items() if field is not None} == {
        "cam": "events", "depth": "depth", "range": "depth", "rgb": "rgb", "frame_camera": "rgb",
        "grey": "rgb", "optical_flow": "flow", "imu": "imu", "odometry": "pose", "state_estimate": "pose",
    }  # fmt: skip
    with RecordingWriter(tmp_path / "a.h5", RecordingHeader(config_yaml="", seed=0, version="0")) as out:
        for packet in ns.run(config):
            out.write(packet)
    for name, field in given.items():
        for other in FIELDS:
            if other == field:
                data.Dataset(tmp_path / "a.h5", sensors={other: name})
            else:
                with pytest.raises(ValueError, match=f"has no sensor '{name}' for {other}"):
                    data.Dataset(tmp_path / "a.h5", sensors={other: name})
    chosen = {"depth": "range", "rgb": "grey", "pose": "state_estimate"}
    recorded = data.Dataset(tmp_path / "a.h5", sensors=chosen).read(0, 4)
    del sensors["log_radiance"]  # of single runs
    worlds = ns.load_config({**CONFIG, "sensors": {"cam": CONFIG["sensors"]["cam"], **sensors}})
    for source in (RunSource(config), WorldsSource(ns.Simulation(worlds, worlds=1))):
        for one, two in zip(source.samples(WindowConfig(sensors=chosen)), recorded, strict=True):
            for field in chosen:
                assert np.array_equal(getattr(one, field), getattr(two, field)), (source, field)
            assert one.rgb.shape == (24, 32)


def test_batches_of_worlds():
    flow = {"kind": "optical_flow", "rate_hz": 20.0, "lens": LENS}
    config = ns.load_config({**CONFIG, "sensors": {**CONFIG["sensors"], "flow": flow}})
    batches = [*data.Stream(ns.Simulation(config, worlds=3), batch=3)]
    assert [batch.source for batch in batches] == [("world 0", "world 1", "world 2")] * 4
    assert batches[0].events.voxel(5).shape == (3, 5, 24, 32)
    alone = [*RunSource(config).samples(WindowConfig())]
    for batch, sample in zip(batches, alone, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(batch.events.of(0), sample.events, strict=True))
        assert np.array_equal(batch.depth[0], sample.depth)
        assert np.array_equal(batch.pose[0], sample.pose)
        assert np.array_equal(batch.flow[0], sample.flow, equal_nan=True)
        assert np.isfinite(sample.flow).mean() > 0.5


def test_windows_may_end_at_ground_truth(tmp_path):
    """Depth comes every 40 ms, windows of 50 ms overlap: those that begin before the flight are not there."""
    events = write_flight(tmp_path / "a.h5", duration_s=0.4, depth_hz=25.0)
    found = data.Dataset(tmp_path / "a.h5", window_s=0.05, ends="depth")
    assert [sample.stamp_ns for sample in found] == [40_000_000 * k for k in range(2, 11)]
    for sample in found:
        end_us = sample.stamp_ns // 1000
        inside = (events.t > end_us - 50_000) & (events.t <= end_us)
        assert np.array_equal(sample.events.t, events.t[inside])
        assert sample.depth is not None
    with pytest.raises(ValueError, match="ends must be one of depth, flow, rgb, pose, got 'imu'"):
        data.Dataset(tmp_path / "a.h5", ends="imu")
    with pytest.raises(ValueError, match="ends is 'depth', which is not in fields"):
        data.Dataset(tmp_path / "a.h5", ends="depth", fields=["events"])
    with pytest.raises(ValueError, match="no sensor for flow"):
        data.Dataset(tmp_path / "a.h5", ends="flow")


def test_windows_that_are_too_long_or_mostly_without_truth_are_said(tmp_path, caplog):
    write_flight(tmp_path / "a.h5", duration_s=0.4, depth_hz=25.0)
    said = r"window_s = 50 fits into no flight, the longest has 0\.4 s of events; if these .* write 0\.05"
    with pytest.raises(ValueError, match=said):
        data.Dataset(tmp_path / "a.h5", window_s=50)
    found = data.Dataset(tmp_path / "a.h5", window_s=0.03, fields=["events", "depth"])
    assert (len(found), found.skipped_count) == (3, 10)
    assert "10 of 13 windows are skipped" in caplog.text


def test_settings_may_be_named_by_their_file(tmp_path):
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(CONFIG))
    assert [len(batch.source) for batch in data.Stream(tmp_path / "a.yaml", batch=2)] == [2, 2]
