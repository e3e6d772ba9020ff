"""The runs of `neurosim bench leave-out`: their settings, and the rooms as files that some fly in."""

from __future__ import annotations

import base64
import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

IMU, IMU_FILE = "imu", "imu-file"
EVENTS, EVENTS_PLAIN = "events", "events-plain"
ALL, ALL_PLAIN, ALL_FILE = "all", "all-plain", "all-file"

_ROOM_M = (8.0, 6.0, 3.0)


@dataclass(frozen=True, kw_only=True)
class Case:
    """A run that is measured."""

    name: str
    title: str
    config: Mapping[str, Any]
    full: str
    """Name of a case that computes everything, in the same scene where there is one."""


def plain_room() -> str:
    """Return an empty room around the origin as glTF, in one colour, without textures."""
    return json.dumps(_room())


def textured_room() -> str:
    """Return that room as glTF with a picture on its walls, a PNG in the file."""
    room = _room()
    primitive = room["meshes"][0]["primitives"][0]
    primitive["attributes"]["TEXCOORD_0"] = primitive["attributes"]["POSITION"] + 1
    # a metre to a repetition, and on no wall are both coordinates the same
    positions = np.array(_CORNERS_M)
    uv = np.stack([positions[:, 0] + positions[:, 1], positions[:, 2] + positions[:, 1]], axis=1)
    _append(room, uv.astype("<f4"), type="VEC2")
    picture = 255 - 160 * (np.add.outer(np.arange(64) // 8, np.arange(64) // 8) % 2)
    room["images"] = [{"uri": _data_uri(_png(picture.astype(np.uint8)), "image/png"), "name": "checks"}]
    room["textures"] = [{"source": 0}]
    room["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    primitive["material"] = 0
    return json.dumps(room)


_CORNERS_M = tuple(
    (x, y, z)
    for z in (0.0, _ROOM_M[2])
    for y in (-0.5 * _ROOM_M[1], 0.5 * _ROOM_M[1])
    for x in (-0.5 * _ROOM_M[0], 0.5 * _ROOM_M[0])
)


def _room() -> dict[str, Any]:
    """Return an empty room as the tree of a glTF file."""
    quads = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    # glTF is y up: (x, y, z) of the world is (x, z, -y) of the file
    positions = np.array([(x, z, -y) for x, y, z in _CORNERS_M], dtype="<f4")
    room: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "room"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 0}]}],
        "accessors": [],
        "bufferViews": [],
        "buffers": [],
    }
    _append(room, np.array(faces, dtype="<u2").reshape(-1), type="SCALAR")
    _append(
        room, positions, type="VEC3", min=positions.min(axis=0).tolist(), max=positions.max(axis=0).tolist()
    )
    return room


def _append(tree: dict[str, Any], array: NDArray[Any], **accessor: Any) -> None:
    """Add an array to the tree of a glTF file, as an accessor with a buffer of its own."""
    index, data = len(tree["buffers"]), array.tobytes()
    component = {"<u2": 5123, "<f4": 5126}[array.dtype.str]
    tree["buffers"].append({"byteLength": len(data), "uri": _data_uri(data, "application/octet-stream")})
    tree["bufferViews"].append({"buffer": index, "byteOffset": 0, "byteLength": len(data)})
    tree["accessors"].append(
        {"bufferView": index, "componentType": component, "count": len(array), **accessor}
    )


def _data_uri(data: bytes, kind: str) -> str:
    return f"data:{kind};base64," + base64.b64encode(data).decode("ascii")


def _png(grey: NDArray[np.uint8]) -> bytes:
    """Return a picture [H, W] as PNG (ISO/IEC 15948), without the library whose absence is shown here."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = grey.shape
    rows = np.pad(grey, ((0, 0), (1, 0)))  # each begins with its filter, 0: none
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(rows.tobytes()))
        + chunk(b"IEND", b"")
    )


def make_cases(plain_file: Path, textured_file: Path, quick: bool) -> tuple[Case, ...]:
    """Return the runs that are compared; some are in rooms of files."""
    # 61 and 47 are prime and of no other array: what has them is a picture
    lens = {"width": 61, "height": 47, "horizontal_fov_rad": 1.5}
    events = {"kind": "event_camera", "lens": lens}
    pictures = {kind: {"kind": kind, "lens": lens} for kind in ("rgb", "depth")}
    inertial = {"imu": {"kind": "imu"}, "odometry": {"kind": "odometry"}}
    apartment = {"kind": "apartment", **({"rooms": 1} if quick else {})}
    plain, textured = (
        {"kind": "mesh", "file": str(file), "inside_m": [0.0, 0.0, 1.4]}
        for file in (plain_file, textured_file)
    )

    def case(name: str, title: str, scene: Any, sensors: Any, full: str = ALL, **settings: Any) -> Case:
        config = {
            "device": "cpu",
            "scene": scene,
            "path": {"kind": "circle", "radius_m": 0.3},
            "vehicle": {"on_collision": "report"},
            "sensors": sensors,
            **settings,
        }
        return Case(name=name, title=title, config=config, full=full)

    of_plain = ALL if quick else ALL_PLAIN  # which does not fly in a quick study
    everything = {"events": events, **pictures, **inertial}
    cases = (
        case(IMU, "IMU only, apartment", apartment, {"imu": {"kind": "imu"}}),
        case(IMU_FILE, "IMU only, textured room", textured, {"imu": {"kind": "imu"}}, ALL_FILE),
        case(EVENTS_PLAIN, "events only, plain room", plain, {"events": events}, of_plain),
        case(EVENTS, "events only, apartment", apartment, {"events": events}),
        case("pictures", "RGB and depth, apartment", apartment, pictures),
        case("sensors", "all sensors, apartment", apartment, everything),
        case(ALL_PLAIN, "everything, plain room", plain, full=ALL_PLAIN, **_all_terms(everything)),
        case(ALL_FILE, "everything, textured room", textured, full=ALL_FILE, **_all_terms(everything)),
        case(ALL, "everything, apartment", apartment, **_all_terms(everything)),
    )
    quick_names = (IMU, IMU_FILE, EVENTS_PLAIN, EVENTS, ALL_FILE, ALL)
    return tuple(c for c in cases if c.name in quick_names) if quick else cases


def _all_terms(sensors: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings under which all terms of vehicle, IMU, pixels and renderer are computed."""
    noise = {
        "accelerometer_noise_density": 1e-3,
        "accelerometer_random_walk": 1e-4,
        "accelerometer_bias_instability_m_s2": 1e-3,
        "accelerometer_range_m_s2": 160.0,
        "accelerometer_resolution_m_s2": 1e-3,
    }
    return {
        "sensors": {
            **sensors,
            "imu": {**sensors["imu"], **noise},
            "events": {**sensors["events"], "pixel": {"preset": "davis346"}},
        },
        "vehicle": {
            "on_collision": "report",
            "parameters": {
                "motor_time_constant_scale": [1.0, 1.1, 1.2, 1.3],
                "flapping_kg_m": 1e-6,
                "wind_m_s": [0.3, 0.1, 0.0],
                "gusts": [{"velocity_m_s": [0.2, 0.0, 0.1], "start_s": 0.0, "rise_s": 0.1}],
                "turbulence": {"wind_20ft_m_s": 1.0},
                "ground": {"rotor_radius_m": 0.1},
                "inertia_kg_m2": [[3.65e-3, 1e-5, 0.0], [1e-5, 3.68e-3, 0.0], [0.0, 0.0, 7.03e-3]],
            },
        },
        "bodies": {"ball": {"shape": {"kind": "sphere"}, "motion": {"position_m": [0.0, 0.0, 0.3]}}},
    }
