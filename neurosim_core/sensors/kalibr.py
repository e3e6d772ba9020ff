"""Camera chains of Kalibr (camchain.yaml): read as settings of cameras, written from them.

In Kalibr the centre of the first pixel is at 0, here at 0.5. T_cam_imu takes coordinates of the IMU to
those of the camera; T_cn_cnm1 takes those of the camera before to those of this one.

Reference: Kalibr wiki, Supported models; Yaml formats.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # which imports its parts when they are used
import yaml
from numpy.typing import NDArray

from neurosim_core.frames import Q_FORWARD_OPTICAL, Mount
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.lenses import DoubleSphereConfig, EquidistantConfig, RadtanConfig
from neurosim_core.sensors.base import CameraConfig

_MODELS = {
    ("pinhole", "none"): "pinhole",
    ("pinhole", "radtan"): "radtan",
    ("pinhole", "equi"): "equidistant",
    ("pinhole", "equidistant"): "equidistant",
    ("ds", "none"): "double_sphere",
}


def read_camchain(file: str | Path, *, imu: Mount | None = None) -> dict[str, dict[str, Any]]:
    """Return lens and mount of each camera of a chain, as settings: {"cam0": {"lens": ..., "mount": ...}}.

    Without T_cam_imu, of a calibration without an IMU, the first camera looks forward from the origin of the
    body.

    Args:
        file: What Kalibr wrote (camchain.yaml, camchain-imucam.yaml).
        imu: Where the IMU of the calibration sits on the body; None: at its origin.

    Raises:
        ValueError: The file is no camera chain, or a model is unknown; the message names it.
    """
    try:
        text = Path(file).read_text(encoding="utf-8")
        chain = yaml.safe_load(re.sub(r"\A%YAML:.*", "", text))  # OpenCV's first line is none of YAML
    except (OSError, yaml.YAMLError) as error:
        raise ValueError(f"cannot read {file}: {error}") from None
    if not isinstance(chain, dict) or "cam0" not in chain:
        raise ValueError(f"{file} is no camera chain of Kalibr: it has no cam0")
    cameras: dict[str, dict[str, Any]] = {}
    T_BC = _pose(Mount().optical_quaternion(), (0.0, 0.0, 0.0))
    T_BI = _mount_pose(imu or Mount())
    for name in sorted((key for key in chain if str(key).startswith("cam")), key=lambda k: int(k[3:])):
        camera = chain[name]
        if "T_cam_imu" in camera:
            T_BC = T_BI @ np.linalg.inv(_matrix(camera["T_cam_imu"], f"{file}: {name}.T_cam_imu"))
        elif "T_cn_cnm1" in camera:
            T_BC = T_BC @ np.linalg.inv(_matrix(camera["T_cn_cnm1"], f"{file}: {name}.T_cn_cnm1"))
        rotations = scipy.spatial.transform.Rotation
        R_BS = rotations.from_matrix(T_BC[:3, :3]) * rotations.from_quat(Q_FORWARD_OPTICAL).inv()
        cameras[name] = {
            "lens": _read_lens(camera, f"{file}: {name}"),
            "mount": {"position_m": T_BC[:3, 3].tolist(), "rpy_rad": R_BS.as_euler("xyz").tolist()},
        }
    return cameras


def write_camchain(cameras: Mapping[str, CameraConfig], *, imu: Mount | None = None) -> str:
    """Return cameras as a camchain.yaml, with T_cam_imu and T_cn_cnm1.

    Args:
        cameras: By name, in the order of the chain; the name becomes the topic.
        imu: Where the IMU sits on the body; None: at its origin.

    Raises:
        ValueError: Kalibr has no model for a lens.
    """
    chain: dict[str, Any] = {}
    before: NDArray[Any] | None = None
    for index, (name, camera) in enumerate(cameras.items()):
        T_CB = np.linalg.inv(_pose(camera.mount.optical_quaternion(), camera.mount.position_m))
        entry: dict[str, Any] = {"T_cam_imu": (T_CB @ _mount_pose(imu or Mount())).tolist()}
        if before is not None:
            entry["T_cn_cnm1"] = (T_CB @ np.linalg.inv(before)).tolist()
        entry |= {
            "cam_overlaps": [other for other in range(len(cameras)) if other != index],
            **_write_lens(camera.lens, name),
            "resolution": [camera.lens.width, camera.lens.height],
            "rostopic": f"/{name}",
            "timeshift_cam_imu": 0.0,
        }
        chain[f"cam{index}"] = entry
        before = T_CB
    return yaml.safe_dump(chain, default_flow_style=None, sort_keys=False)


def _read_lens(camera: Mapping[str, Any], where: str) -> dict[str, Any]:
    missing = [key for key in ("camera_model", "intrinsics", "resolution") if key not in camera]
    if missing:
        raise ValueError(f"{where} lacks {', '.join(missing)}")
    model = (str(camera["camera_model"]), str(camera.get("distortion_model", "none")))
    if model not in _MODELS:
        known = ", ".join("-".join(pair) for pair in _MODELS)
        raise ValueError(f"{where} is of model {'-'.join(model)}, known: {known}")
    kind, numbers = _MODELS[model], [float(value) for value in camera["intrinsics"]]
    count = 6 if kind == "double_sphere" else 4
    if len(numbers) != count:
        raise ValueError(f"{where}.intrinsics must have {count} numbers, got {numbers}")
    width, height = (int(value) for value in camera["resolution"])
    fx, fy, cx, cy = numbers[-4:]
    lens = {"kind": kind, "width": width, "height": height}
    lens |= {"fx": fx, "fy": fy, "cx": cx + 0.5, "cy": cy + 0.5}
    if kind == "double_sphere":
        lens |= {"xi": numbers[0], "alpha": numbers[1]}
    elif kind != "pinhole":
        lens["distortion"] = [float(value) for value in camera["distortion_coeffs"]]
    return lens


def _write_lens(lens: Any, name: str) -> dict[str, Any]:
    if isinstance(lens, RadtanConfig) and len(lens.distortion) == 5 and lens.distortion[4] != 0.0:
        raise ValueError(f"{name}: radtan has four coefficients in Kalibr, got k3 = {lens.distortion[4]:g}")
    if not isinstance(lens, PinholeConfig | RadtanConfig | EquidistantConfig | DoubleSphereConfig):
        raise ValueError(f"{name}: Kalibr has no model for a lens of kind {lens.kind}")
    fx, fy, cx, cy = lens.intrinsics()
    numbers = [fx, fy, cx - 0.5, cy - 0.5]
    model = next(pair for pair, kind in _MODELS.items() if kind == lens.kind)
    coefficients: list[float] = []
    if isinstance(lens, DoubleSphereConfig):
        numbers = [lens.xi, lens.alpha, *numbers]
    elif isinstance(lens, RadtanConfig | EquidistantConfig):
        coefficients = list(lens.distortion[:4])
    return {
        "camera_model": model[0],
        "distortion_coeffs": coefficients,
        "distortion_model": model[1],
        "intrinsics": numbers,
    }


def _pose(quaternion: Any, position: Any) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3] = scipy.spatial.transform.Rotation.from_quat(quaternion).as_matrix()
    pose[:3, 3] = position
    return pose


def _mount_pose(mount: Mount) -> NDArray[np.float64]:
    return _pose(mount.rotation().as_quat(), mount.position_m)


def _matrix(rows: Any, where: str) -> NDArray[np.float64]:
    matrix = np.asarray(rows, dtype=np.float64)
    rigid = matrix.shape == (4, 4) and np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-4)
    if not rigid or not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"{where} must be a rigid 4 x 4 transform, got {matrix.tolist()}")
    return matrix
