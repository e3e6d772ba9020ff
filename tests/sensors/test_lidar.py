"""LiDAR: sweeps in flight against planes, one time for all rays, noise against its distributions, worlds."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation
from small_room import LENGTH_M, WIDTH_M, room_scene

import neurosim_core as ns
from neurosim_core.live.messages import to_message, to_packet
from neurosim_core.packets import Odometry, PointCloud
from neurosim_core.record.hdf5 import RecordingWriter
from neurosim_core.record.header import RecordingHeader, describe_sensors
from neurosim_core.record.recording import Recording
from neurosim_core.sensors.lidar import LidarConfig, lidar_presets
from neurosim_core.sensors.lidar_scans import PatternScan, SpinningScan
from neurosim_core.settings_file import ConfigError

FALSE_ALARM = 1e-6
RINGS = tuple(float(e) for e in np.linspace(-0.2, 0.2, 5))
SCAN = {"kind": "spinning", "elevations_rad": RINGS, "columns": 360}
ALONG_WALL = [
    {"time_s": 0.0, "position_m": [-3.0, 0.5, 1.2]},
    {"time_s": 0.2, "position_m": [-1.0, 0.6, 1.3], "rpy_rad": [0.1, 0.05, 0.5]},
    {"time_s": 0.4, "position_m": [1.5, 0.4, 1.2], "rpy_rad": [0.0, 0.1, 0.9]},
]
STILL = [{"time_s": 0.0, "position_m": [0.0, 0.0, 1.2]}, {"time_s": 1.0, "position_m": [0.0, 0.0, 1.2]}]


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    """Return settings of a rig in a small room."""
    scene = room_scene(tmp_path_factory.mktemp("room"))

    def make(sensors, frames=ALONG_WALL, **more):
        path = {"kind": "poses", "keyframes": frames}
        return {"scene": scene, "duration_s": 0.25, "device": "cpu", "path": path, "sensors": sensors, **more}

    return make


def lidar(**more):
    return {"kind": "lidar", "scan": SCAN, "mount": {"position_m": [0.1, 0.0, 0.05]}, **more}


def packets(config, kind=PointCloud):
    found = {}
    for packet in ns.run(config):
        if isinstance(packet, kind):
            found.setdefault(packet.sensor, {})[packet.stamp_ns] = packet
    return found


def in_world(points, odometry, mount_m=(0.1, 0.0, 0.05)):
    R = Rotation.from_quat(odometry.orientation)
    return odometry.position + R.apply(points.astype(np.float64) + mount_m)


def off_wall(world):
    """Distance of points from the walls y = +-3 and x = +-4 that they belong to; nan: they are elsewhere."""
    far = np.abs([world[:, 0] / LENGTH_M, world[:, 1] / WIDTH_M])
    side = np.abs(
        np.where(far[0] > far[1], np.abs(world[:, 0]) - LENGTH_M / 2, np.abs(world[:, 1]) - WIDTH_M / 2)
    )
    return np.where((world[:, 2] > 1.0) & (world[:, 2] < 2.8), side, np.nan)


def test_a_deskewed_sweep_along_a_wall_lies_on_it(settings):
    """At 11 m/s and 3 rad/s walls are flat to 1 mm; as they are seen, they are not, by more than 20 cm."""
    sensors = {"skewed": lidar(), "flat": lidar(deskew=True), "odometry": {"kind": "odometry", "rate_hz": 10}}
    config = settings(sensors)
    truth = packets(config, Odometry)["odometry"]
    found = packets(config)
    for stamp_ns in (100_000_000, 200_000_000):
        flat, skewed = found["flat"][stamp_ns], found["skewed"][stamp_ns]
        assert len(flat.points) == 5 * 360
        assert np.nanmax(off_wall(in_world(flat.points, truth[stamp_ns]))) < 1e-3
        assert np.nanmax(off_wall(in_world(skewed.points, truth[stamp_ns]))) > 0.2
        np.testing.assert_array_equal(flat.intensity, skewed.intensity)


def test_one_time_for_all_rays_gives_the_same_ranges(settings):
    """A rig that stands still, swept or not: the same bytes; and `sweep_s: 0` sees the pose at the stamp."""
    sensors = {"swept": lidar(), "at_once": lidar(sweep_s=0.0)}
    still = packets(settings(sensors, STILL))
    for stamp_ns in (0, 100_000_000):
        swept, at_once = still["swept"][stamp_ns], still["at_once"][stamp_ns]
        assert swept.points.tobytes() == at_once.points.tobytes()
        assert swept.start_ns == stamp_ns - 100_000_000 * 359 // 360
        assert at_once.start_ns == stamp_ns
        assert not at_once.t.any()
    sensors = {"at_once": lidar(sweep_s=0.0), "odometry": {"kind": "odometry", "rate_hz": 10}}
    moving, truth = packets(settings(sensors)), packets(settings(sensors), Odometry)["odometry"]
    world = in_world(moving["at_once"][200_000_000].points, truth[200_000_000])
    assert np.nanmax(off_wall(world)) < 1e-5 * LENGTH_M  # float32 poses and rays


def test_points_come_in_the_order_of_time_with_their_rings(settings):
    found = packets(settings({"lidar": lidar()}, STILL))["lidar"][100_000_000]
    assert (np.diff(found.t.astype(np.int64)) >= 0).all()
    assert found.t[-1] == found.stamp_ns - found.start_ns
    np.testing.assert_array_equal(found.ring[:10], [0, 1, 2, 3, 4, 0, 1, 2, 3, 4])
    x, y, z = found.points.T
    elevation = np.arctan2(z, np.hypot(x, y))
    np.testing.assert_allclose(elevation, np.array(RINGS)[found.ring], atol=1e-6)
    # clockwise from behind: after a quarter of a turn it looks to the left
    quarter = found.points[5 * 90 : 5 * 91]
    assert (quarter[:, 1] > 0.0).all()
    assert np.abs(quarter[:, 0]).max() < 1e-5


def test_a_body_is_seen_where_it_is_at_the_time_of_the_ray(settings):
    """A box crosses at 4 m/s what is left of the sensor: seen a quarter of a sweep after the first ray."""
    bodies = {
        "box": {
            "shape": {"kind": "box", "size_m": [0.4, 0.4, 0.4]},
            "motion": {"position_m": [0.1, 1.5, 1.25], "velocity_m_s": [0.0, -4.0, 0.0]},
        }
    }
    found = packets(settings({"lidar": lidar()}, STILL, bodies=bodies))["lidar"][200_000_000]
    left = np.flatnonzero((found.ring == 2) & (np.abs(found.points[:, 0]) < 0.01) & (found.points[:, 1] > 0))
    t_s = 1e-9 * (found.start_ns + found.t[left].astype(float))
    expected = 1.5 - 4.0 * t_s - 0.2
    assert 1e-9 * found.t[left][0] == pytest.approx(0.025, abs=1e-3)
    np.testing.assert_allclose(found.points[left, 1], expected, atol=1e-5)


def test_intensity_is_the_signal_of_a_lambertian_surface(settings):
    """On the wall y = 3 the cosine is that with y: albedo y / r^3."""
    found = packets(settings({"lidar": lidar()}, STILL))["lidar"][0]
    r = np.linalg.norm(found.points, axis=1)
    y = found.points[:, 1]
    wall = np.isclose(y, WIDTH_M / 2, atol=1e-4) & (np.abs(found.points[:, 0]) < 3.0)
    albedo = found.intensity[wall] * r[wall] ** 2 / (y[wall] / r[wall])
    assert wall.sum() > 100
    np.testing.assert_allclose(albedo, albedo[0], rtol=1e-4)
    assert 0.1 < albedo[0] <= 1.0


def noisy(**errors):
    sensors = {"lidar": lidar(rate_hz=100, sweep_s=0.0, **errors), "exact": lidar(rate_hz=100, sweep_s=0.0)}
    return sensors


def test_range_noise_has_its_standard_deviation(settings):
    found = packets(settings(noisy(range_noise_m=0.02, range_noise_ratio=0.01), STILL))
    z = []
    for stamp_ns, exact in found["exact"].items():
        r = np.linalg.norm(exact.points.astype(float), axis=1)
        error = np.linalg.norm(found["lidar"][stamp_ns].points.astype(float), axis=1) - r
        z.append(error / np.hypot(0.02, 0.01 * r))
    z = np.concatenate(z)
    low, high = stats.chi2(len(z)).interval(1.0 - FALSE_ALARM)
    assert low < (z**2).sum() < high
    assert not low < (1.05**2 * z**2).sum() < high  # a bias of 5 % would be seen
    assert abs(z.mean()) * np.sqrt(len(z)) < 5.0
    first, second = z[:1800], z[1800:3600]
    assert abs(np.corrcoef(first, second)[0, 1]) < 5.0 / np.sqrt(1800)


def test_rays_are_lost_by_albedo_incidence_and_range(settings):
    """Each comes back with the probability Phi(ln(signal / least) / s)."""
    detection = {"range_m": 4.0, "reflectivity": 0.5, "speckle": 0.5}
    found = packets(settings(noisy(detection=detection, dropout_probability=0.2), STILL))
    seen = sum(len(packet.points) for packet in found["lidar"].values())
    expected = variance = 0.0
    for exact in found["exact"].values():
        p = 0.8 * stats.norm.cdf(np.log(exact.intensity / (0.5 / 16.0)) / 0.5)
        expected, variance = expected + p.sum(), variance + (p * (1.0 - p)).sum()
    assert abs(seen - expected) < stats.norm.isf(FALSE_ALARM / 2) * np.sqrt(variance)
    assert 0.1 < seen / sum(len(packet.points) for packet in found["exact"].values()) < 0.75


def test_ranges_have_limits_and_a_resolution(settings):
    config = lidar(range_min_m=2.0, range_max_m=3.5, range_resolution_m=0.25, sweep_s=0.0)
    found = packets(settings({"lidar": config}, STILL))["lidar"][0]
    r = np.linalg.norm(found.points.astype(float), axis=1)
    np.testing.assert_allclose(r, 0.25 * np.rint(r / 0.25), rtol=1e-6)
    assert sorted(set(np.rint(r / 0.25))) == [12, 13, 14]


def test_worlds_see_what_single_runs_see(settings):
    errors = {"range_noise_m": 0.05, "detection": {"range_m": 5.0, "reflectivity": 0.5}, "deskew": True}
    config = settings({"lidar": lidar(**errors)}, control={"rate_hz": 100.0})
    alone = packets({**config, "seed": 7})["lidar"]
    worlds = ns.Simulation(config, worlds=3, seeds=[5, 6, 7])
    seen = worlds.reset()
    maker = LidarConfig.model_validate(lidar(**errors))
    for _ in range(10):
        seen = worlds.step()
    pictures = seen.images["lidar"].numpy()
    assert pictures.shape == (3, 5, 360, 4)
    packet = maker.packet(pictures[2], stamp_ns=100_000_000)
    assert packet.points.tobytes() == alone[100_000_000].points.tobytes()
    assert pictures[1].tobytes() != pictures[2].tobytes()


def test_batches_change_no_byte(settings):
    errors = {"range_noise_m": 0.05, "deskew": True, "rate_hz": 20}
    many = packets(settings({"lidar": lidar(**errors)}))["lidar"]
    few = packets(settings({"lidar": lidar(**errors)}, instants_per_launch=1))["lidar"]
    assert len(many) == 6
    assert [p.points.tobytes() for p in many.values()] == [p.points.tobytes() for p in few.values()]


def test_a_pattern_comes_from_a_file(settings, tmp_path):
    rows = np.stack([np.linspace(0.0, 0.05, 101), np.linspace(-0.5, 0.5, 101), np.full(101, 0.1)], axis=-1)
    np.save(tmp_path / "rays.npy", rows)
    text = tmp_path / "rays.csv"
    text.write_text("t,azimuth,elevation\n" + "\n".join(",".join(map(repr, row)) for row in rows.tolist()))
    for file in (tmp_path / "rays.npy", text):
        sensor = lidar(scan={"kind": "pattern", "file": str(file)})
        found = packets(settings({"lidar": sensor}, STILL))["lidar"][0]
        azimuth = np.arctan2(found.points[:, 1], found.points[:, 0])
        np.testing.assert_allclose(azimuth, rows[:, 1], atol=1e-6)
        np.testing.assert_allclose(found.t, 1e9 * rows[:, 0], atol=1.0)
        assert found.start_ns == -50_000_000
    rows[50, 0] = 0.0
    np.save(tmp_path / "rays_back.npy", rows)
    with pytest.raises(ConfigError, match="the time of ray 50 is before that of the ray before"):
        PatternScan(file=tmp_path / "rays_back.npy")


@pytest.mark.parametrize("name", sorted(lidar_presets()))
def test_presets_are_valid_and_give_way_to_single_keys(name):
    config = LidarConfig.model_validate({"preset": name, "range_noise_m": 0.5})
    assert config.range_noise_m == 0.5
    assert config.range_max_m == lidar_presets()[name]["range_max_m"]
    assert json.loads(config.model_dump_json())["scan"]["kind"] == lidar_presets()[name]["scan"]["kind"]
    assert config.scan.ray_table().shape == (config.scan.height, config.scan.width, 3)
    assert config.span_s < 1.0 / config.rate_hz


def test_a_rosette_stays_within_its_field_of_view():
    scan = LidarConfig.model_validate({"preset": "livox_mid40"}).scan
    x = scan.ray_table().reshape(-1, 3)[:, 2]
    angles = np.arccos(np.clip(x, -1.0, 1.0))
    assert 0.33 < angles.max() < np.radians(19.2) + 1e-3
    assert angles.min() < 0.02


def test_wrong_settings_are_refused():
    with pytest.raises(ConfigError, match="unknown preset 'velodyne', known: velodyne_vlp16"):
        LidarConfig(preset="velodyne")
    with pytest.raises(ConfigError, match=r"a sweep takes 0\.2 s, longer than 1 / rate_hz = 0\.1"):
        LidarConfig(sweep_s=0.2)
    with pytest.raises(ConfigError, match="range_min_m must be below range_max_m = 1"):
        LidarConfig(range_min_m=2.0, range_max_m=1.0)
    scan = SpinningScan(elevations_rad=(0.0,), columns=4)
    assert LidarConfig(scan=scan).span_s == pytest.approx(0.075)


def test_clouds_are_recorded_and_sent(settings, tmp_path):
    found = packets(settings({"lidar": lidar(range_max_m=3.2)}, STILL))["lidar"]
    message = to_message(found[0], frame_id="drone/lidar")
    assert (message.frame_id, message.deskewed, message.start_ns) == ("drone/lidar", False, found[0].start_ns)
    sensors = describe_sensors({"lidar": LidarConfig.model_validate(lidar())})
    header = RecordingHeader(config_yaml="", seed=0, version="", sensors=sensors)
    with RecordingWriter(tmp_path / "flight.h5", header) as writer:
        for packet in found.values():
            writer.write(packet)
    with Recording(tmp_path / "flight.h5") as recording:
        read = list(recording.packets())
    for packet, other in [(found[0], to_packet(message, "lidar")), *zip(found.values(), read, strict=True)]:
        assert (packet.stamp_ns, packet.start_ns) == (other.stamp_ns, other.start_ns)
        for name in ("points", "intensity", "ring", "t"):
            np.testing.assert_array_equal(getattr(packet, name), getattr(other, name))
