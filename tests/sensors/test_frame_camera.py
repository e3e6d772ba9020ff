"""Frames of a camera: curves and filters against RGB, noise against its law, exposure against its loop."""

from __future__ import annotations

import numpy as np
import pytest
from small_room import room_scene

import neurosim_core as ns
from neurosim_core.packets import Image

LENS = {"width": 64, "height": 48, "horizontal_fov_rad": 1.4}
STILL = [{"time_s": t, "position_m": [0.0, 0.0, 1.2]} for t in (0.0, 2.0)]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return room_scene(tmp_path_factory.mktemp("room"))


def fly(scene, sensors, **more):
    config = {
        "scene": scene, "duration_s": 0.1, "device": "cpu", "path": {"kind": "poses", "keyframes": STILL},
        "render": {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1}, "sensors": sensors, **more,
    }  # fmt: skip
    found = {}
    for packet in ns.run(config):
        if isinstance(packet, Image):
            found.setdefault(packet.sensor, []).append(packet)
    return found


def camera(**more):
    return {"kind": "frame_camera", "lens": LENS, "rate_hz": 20, **more}


def linear(code):
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def test_without_flaws_it_is_the_rgb_camera_in_any_format(scene):
    sensors = {
        "rgb": {**camera(), "kind": "rgb"},
        "same": camera(),
        "linear": camera(curve="linear", bits=16),
        "dark": camera(curve="linear", bits=12, gain=0.5),
        "gamma": camera(curve=2.0, bits=16),
        "mono": camera(color="mono", curve="linear", bits=16),
        "bayer": camera(color="bayer_grbg", curve="linear", bits=16),
    }
    found = {name: packets[0] for name, packets in fly(scene, sensors).items()}
    rgb = found["rgb"].data
    np.testing.assert_array_equal(found["same"].data, rgb)
    light = found["linear"].data / 65535.0
    assert light.std() > 0.01
    np.testing.assert_allclose(light, linear(rgb / 255.0), atol=1.5 / 255.0)  # RGB is rounded, slope < 2.3
    assert (found["dark"].data % 16 == 0).all()
    np.testing.assert_allclose(found["dark"].data / 16 / 4095, 0.5 * light, atol=0.5 / 4095 + 1e-5)
    np.testing.assert_allclose((found["gamma"].data / 65535.0) ** 2, light, atol=1e-4)
    luma = light @ [0.2126, 0.7152, 0.0722]
    np.testing.assert_allclose(found["mono"].data / 65535.0, luma, atol=2e-5)
    bayer = found["bayer"].data / 65535.0
    for row, col, channel in ((0, 0, 1), (0, 1, 0), (1, 0, 2), (1, 1, 1)):
        np.testing.assert_allclose(bayer[row::2, col::2], light[row::2, col::2, channel], atol=2e-5)
    encodings = {name: (p.encoding, p.data.dtype.name) for name, p in found.items()}
    assert encodings["same"] == ("rgb8", "uint8")
    assert encodings["dark"] == ("rgb16", "uint16")
    assert encodings["bayer"] == ("bayer_grbg16", "uint16")


def test_noise_has_the_variance_of_its_electrons(scene):
    """Differences of frames: variance = electrons + read noise^2, in units of the full well."""
    quiet = {"color": "mono", "curve": "linear", "bits": 16, "full_well_e": 2000.0, "rate_hz": 200}
    sensors = {"exact": camera(**quiet), "noisy": camera(**quiet, shot_noise=True, read_noise_e=15.0)}
    found = fly(scene, sensors)
    exact = found["exact"][0].data / 65535.0 * 2000.0
    frames = np.array([p.data for p in found["noisy"]]) / 65535.0 * 2000.0
    inside = (exact > 100.0) & (exact < 1600.0)
    z = (frames - exact)[:, inside] / np.sqrt(exact[inside] + 15.0**2)
    assert z.size > 20000
    assert abs(z.mean()) < 5.0 / np.sqrt(z.size)
    assert abs(z.var() - 1.0) < 5.0 * np.sqrt(2.0 / z.size)  # leaving out read noise: -0.2
    again = fly(scene, sensors, instants_per_launch=1)["noisy"]
    assert [p.data.tobytes() for p in again] == [p.data.tobytes() for p in found["noisy"]]
    other = fly(scene, sensors, seed=7)["noisy"]
    assert other[0].data.tobytes() != found["noisy"][0].data.tobytes()


def test_exposure_follows_the_light_with_its_lag(scene):
    """The geometric mean of the first frame is the target; then a body moves in, and the gain follows."""
    lag_s, target = 0.05, 0.2
    auto = {"target": target, "lag_s": lag_s}
    body = {
        "shape": {"kind": "box", "size_m": [0.1, 3.0, 3.0]},
        "surface": {"kind": "plain", "color": [0.02, 0.02, 0.02]},
        "motion": {"position_m": [0.9, -4.0, 1.2], "velocity_m_s": [0.0, 80.0, 0.0]},
    }
    sensors = {
        "auto": camera(color="mono", curve="linear", bits=16, rate_hz=100, auto_exposure=auto),
        "fixed": camera(color="mono", curve="linear", bits=16, rate_hz=100, gain=0.25),
    }
    found = fly(scene, sensors, bodies={"box": body})
    light = np.array([p.data for p in found["fixed"]]) / 65535.0 / 0.25
    frames = np.array([p.data for p in found["auto"]]) / 65535.0
    mean = np.log(np.maximum(light, 1e-4)).mean(axis=(1, 2))
    log_gain = np.log(target) - mean[0]
    changes = 0
    for k in range(len(frames)):
        unsaturated = (light[k] > 0.01) & (frames[k] < 0.99)
        gain = np.median(frames[k][unsaturated] / light[k][unsaturated])
        assert np.log(gain) == pytest.approx(log_gain, abs=0.02)
        step = (1.0 - np.exp(-0.01 / lag_s)) * (np.log(target) - mean[k] - log_gain) if k else 0.0
        changes += abs(step) > 0.05
        log_gain += step
    assert changes > 0
    again = fly(scene, sensors, bodies={"box": body}, instants_per_launch=1)["auto"]
    assert [p.data.tobytes() for p in again] == [p.data.tobytes() for p in found["auto"]]


def test_worlds_take_the_frames_of_single_runs_and_begin_anew(scene):
    sensor = camera(shot_noise=True, auto_exposure={"lag_s": 0.1})
    config = {
        "scene": scene, "duration_s": 0.1, "device": "cpu", "path": {"kind": "poses", "keyframes": STILL},
        "render": {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1}, "sensors": {"frame": sensor},
        "control": {"rate_hz": 100.0}, "seed": 3,
    }  # fmt: skip
    alone = [p.data for p in ns.run(config) if isinstance(p, Image)]
    worlds = ns.Simulation(config, worlds=2)
    for _ in range(2):
        seen = worlds.reset(seed=[3, 4])
        np.testing.assert_array_equal(seen.images["frame"].numpy()[0], alone[0])
        for _ in range(5):
            seen = worlds.step()
        pictures = seen.images["frame"].numpy()
        np.testing.assert_array_equal(pictures[0], alone[1])
        assert (pictures[0] != pictures[1]).any()
