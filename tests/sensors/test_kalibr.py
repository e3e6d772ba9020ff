"""Camera chains: what is written is read back, and transforms say what Kalibr means by them."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from neurosim_core import load_config
from neurosim_core.frames import Mount
from neurosim_core.sensors.kalibr import read_camchain, write_camchain
from neurosim_core.sensors.rgb import RgbSensorConfig

SIZE = {"width": 64, "height": 48, "fx": 45.0, "fy": 44.0, "cx": 31.3, "cy": 24.9}
LENSES = [
    {"kind": "pinhole", **SIZE},
    {"kind": "radtan", **SIZE, "distortion": (-0.28, 0.07, 1.9e-3, -7e-4)},
    {"kind": "equidistant", **SIZE, "distortion": (-0.013, 0.021, -0.012, 0.0025)},
    {"kind": "double_sphere", **SIZE, "xi": 0.3, "alpha": 0.4},
]
IMU = Mount(position_m=(0.01, 0.02, -0.03), rpy_rad=(0.1, -0.2, 0.3))


def test_what_is_written_is_read_back(tmp_path):
    cameras = {
        f"eye{k}": RgbSensorConfig(
            lens=lens, mount=Mount(position_m=(0.1, 0.05 * k, 0.0), rpy_rad=(0.0, 0.1 * k, -0.2))
        )
        for k, lens in enumerate(LENSES)
    }
    file = tmp_path / "camchain.yaml"
    file.write_text(write_camchain(cameras, imu=IMU), encoding="utf-8")
    read = read_camchain(file, imu=IMU)
    assert list(read) == ["cam0", "cam1", "cam2", "cam3"]
    for camera, settings in zip(cameras.values(), read.values(), strict=True):
        again = RgbSensorConfig(**settings)
        for key, value in camera.lens.model_dump(exclude={"kind"}).items():
            expected = getattr(again.lens, key)
            assert expected == (None if value is None else pytest.approx(value)), key
        np.testing.assert_allclose(again.mount.position_m, camera.mount.position_m, atol=1e-12)
        np.testing.assert_allclose(again.mount.rpy_rad, camera.mount.rpy_rad, atol=1e-12)


def test_a_chain_says_what_kalibr_means(tmp_path):
    """A stereo pair: the right camera is 0.11 m to the right, so points are 0.11 m further left."""
    config = load_config({"sensors": {"eye": {"kind": "rgb", "lens": SIZE, "stereo": {"baseline_m": 0.11}}}})
    assert list(config.sensors) == ["eye_left", "eye_right"]
    chain = yaml.safe_load(write_camchain(config.sensors))
    expected = np.eye(4)
    expected[0, 3] = -0.11
    np.testing.assert_allclose(chain["cam1"]["T_cn_cnm1"], expected, atol=1e-12)
    assert chain["cam0"]["intrinsics"] == pytest.approx([45.0, 44.0, 30.8, 24.4])
    # a point ahead of the body, 2 m along x and 0.3 m to its left, in the left camera
    mount = config.sensors["eye_left"].mount
    seen = np.array(chain["cam0"]["T_cam_imu"]) @ [2.0, 0.3, 0.0, 1.0]
    np.testing.assert_allclose(
        seen[:3],
        [-(0.3 - mount.position_m[1]), mount.position_m[2], 2.0 - mount.position_m[0]],
        atol=1e-12,
    )


def test_a_chain_without_imu_begins_with_a_camera_that_looks_forward(tmp_path):
    """cam1 of a pair turned by 0.1 rad about the camera's y axis."""
    R = Rotation.from_euler("y", 0.1)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.as_matrix(), [-0.2, 0.0, 0.0]
    camera = {"camera_model": "pinhole", "distortion_model": "equi", "resolution": [64, 48]}
    camera |= {"intrinsics": [45, 44, 31, 24], "distortion_coeffs": [0, 0, 0, 0]}
    file = tmp_path / "camchain.yaml"
    file.write_text(yaml.safe_dump({"cam0": camera, "cam1": {**camera, "T_cn_cnm1": T.tolist()}}))
    read = read_camchain(file)
    assert read["cam0"]["mount"]["rpy_rad"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    # p_C0 of cam1's origin is R^T (0.2, 0, 0): to the right, in B to -y
    p = R.inv().apply([0.2, 0.0, 0.0])
    assert read["cam1"]["mount"]["position_m"] == pytest.approx([p[2], -p[0], -p[1]], abs=1e-12)


def test_what_is_no_chain_is_refused(tmp_path):
    file = tmp_path / "camchain.yaml"
    file.write_text("cam0: {camera_model: omni, intrinsics: [1, 2, 3, 4, 5], resolution: [4, 4]}")
    with pytest.raises(ValueError, match="model omni-none, known: pinhole-none, pinhole-radtan"):
        read_camchain(file)
    file.write_text("sensors: {}")
    with pytest.raises(ValueError, match="has no cam0"):
        read_camchain(file)
    lens = {"kind": "rational", **SIZE, "distortion": (0.0,) * 8}
    with pytest.raises(ValueError, match="no model for a lens of kind rational"):
        write_camchain({"a": RgbSensorConfig(lens=lens)})


def test_names_of_a_pair_must_be_free():
    sensors = {"eye": {"kind": "rgb", "stereo": {"baseline_m": 0.1}}, "eye_left": {"kind": "depth"}}
    with pytest.raises(ValueError, match="makes a camera 'eye_left'"):
        load_config({"sensors": sensors})


def test_chains_as_others_write_them(tmp_path):
    """OpenCV's first line, which YAML does not know, and another name of one model."""
    camera = RgbSensorConfig(lens=LENSES[2])
    text = write_camchain({"eye": camera})
    assert "equi\n" in text
    file = tmp_path / "kalibr_imucam_chain.yaml"
    file.write_text("%YAML:1.0 # as OpenVINS has it\n\n" + text.replace("equi\n", "equidistant\n"))
    again = RgbSensorConfig(**read_camchain(file)["cam0"])
    assert again.lens.distortion == pytest.approx(camera.lens.distortion)
