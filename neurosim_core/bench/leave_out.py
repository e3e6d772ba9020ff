"""What a scene does not need is left out: kernels, memory, libraries and time of runs, small and large.

Each case flies in a process of its own, where launches, allocations and imports are counted
(`leave_out_probe`). Kernels that leave terms out are compared with ones that have them with coefficients of
zero.
"""

from __future__ import annotations

import base64
import json
import math
import statistics
import struct
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from neurosim_core.bench.figures import COLORS
from neurosim_core.bench.leave_out_probe import LIBRARIES, Probe
from neurosim_core.bench.report import Bar, Chapter, Plot, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EQUAL_BAR = 1e-12
"""Largest difference of what reduced kernels compute in float64."""

_TIMEOUT_S = 600.0
_ROOM_M = (8.0, 6.0, 3.0)
_SAMPLER = (
    "sample_texture",
    "sample_finest",
    "sample_nearest",
    "shade_textured_packet",
    "see_textured_packet",
)
_RGB = "_to_srgb"
_IMU, _IMU_FILE = "imu", "imu-file"
_EVENTS, _EVENTS_PLAIN = "events", "events-plain"
_ALL, _ALL_PLAIN, _ALL_FILE = "all", "all-plain", "all-file"


@dataclass(frozen=True, kw_only=True)
class Case:
    """A run that is measured."""

    name: str
    title: str
    config: Mapping[str, Any]
    full: str
    """Name of a case that computes everything, in the same scene where there is one."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """How far a reduced kernel is from the full one with coefficients of zero."""

    kernel: str
    reduced: str
    """Terms of the reduced kernel."""
    full: str
    """Terms of the full one."""
    largest: float
    """Largest difference of any number that they compute."""
    precision: str
    """In which they compute."""
    bar: float
    """The largest difference that is allowed."""


@dataclass(frozen=True, kw_only=True)
class LeaveOutResult:
    """What `measure_leave_out` found."""

    quick: bool
    cases: tuple[Case, ...]
    probes: Mapping[str, Probe]
    """What was counted in each case, by its name."""
    differences: tuple[Difference, ...]


def measure_leave_out(
    *, quick: bool = False, progress: Callable[[str], None] | None = None
) -> LeaveOutResult:
    """Fly the cases, one after the other, on the CPU.

    What is counted does not depend on the device.

    Args:
        quick: Few cases, short flights, one room.
        progress: Told what is measured next.

    Raises:
        RuntimeError: A run failed; the message has what it said.
    """
    tell = progress or (lambda _: None)
    with tempfile.TemporaryDirectory(prefix="neurosim-") as folder:
        rooms = Path(folder) / "plain.gltf", Path(folder) / "textured.gltf"
        rooms[0].write_text(plain_room(), encoding="utf-8")
        rooms[1].write_text(textured_room(), encoding="utf-8")
        cases = _cases(*rooms, quick)
        probes = {}
        for case in cases:
            tell(case.title)
            seconds, repetitions = (0.05, 3) if quick else (0.5, 7)
            probes[case.name] = run_probe(case.config, seconds=seconds, repetitions=repetitions)
    tell("reduced against full kernels")
    return LeaveOutResult(
        quick=quick,
        cases=cases,
        probes=probes,
        differences=(*dynamics_differences(), imu_difference(), radiance_difference(), pixel_difference()),
    )


def run_probe(config: Mapping[str, Any], *, seconds: float, repetitions: int = 1) -> Probe:
    """Fly in a fresh process and return what was counted there.

    Args:
        config: Settings.
        seconds: Simulated time that is measured [s].
        repetitions: How often the flight is timed.

    Raises:
        RuntimeError: The run failed.
    """
    done = subprocess.run(
        [sys.executable, "-m", "neurosim_core.bench.leave_out_probe"],
        input=json.dumps({"config": config, "seconds": seconds, "repetitions": repetitions}),
        capture_output=True,
        text=True,
        check=False,
        timeout=_TIMEOUT_S,
    )
    if done.returncode != 0:
        raise RuntimeError(f"a run ended with status {done.returncode}: {done.stderr.strip()[-2000:]}")
    return Probe(**json.loads(done.stdout.splitlines()[-1]))


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


def _cases(plain_file: Path, textured_file: Path, quick: bool) -> tuple[Case, ...]:
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

    def case(name: str, title: str, scene: Any, sensors: Any, full: str = _ALL, **settings: Any) -> Case:
        config = {
            "device": "cpu",
            "scene": scene,
            "path": {"kind": "circle", "radius_m": 0.3},
            "vehicle": {"on_collision": "report"},
            "sensors": sensors,
            **settings,
        }
        return Case(name=name, title=title, config=config, full=full)

    of_plain = _ALL if quick else _ALL_PLAIN  # which does not fly in a quick study
    everything = {"events": events, **pictures, **inertial}
    cases = (
        case(_IMU, "IMU only, apartment", apartment, {"imu": {"kind": "imu"}}),
        case(_IMU_FILE, "IMU only, textured room", textured, {"imu": {"kind": "imu"}}, _ALL_FILE),
        case(_EVENTS_PLAIN, "events only, plain room", plain, {"events": events}, of_plain),
        case(_EVENTS, "events only, apartment", apartment, {"events": events}),
        case("pictures", "RGB and depth, apartment", apartment, pictures),
        case("sensors", "all sensors, apartment", apartment, everything),
        case(_ALL_PLAIN, "everything, plain room", plain, full=_ALL_PLAIN, **_all_terms(everything)),
        case(_ALL_FILE, "everything, textured room", textured, full=_ALL_FILE, **_all_terms(everything)),
        case(_ALL, "everything, apartment", apartment, **_all_terms(everything)),
    )
    quick_names = (_IMU, _IMU_FILE, _EVENTS_PLAIN, _EVENTS, _ALL_FILE, _ALL)
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


def dynamics_differences() -> tuple[Difference, ...]:
    """Return how far vehicles without optional terms are from ones that have them all, with zeros.

    Both fly 1 s under the same random commands, which toss them about.
    """
    from neurosim_core.vehicle import Multirotor, preset
    from neurosim_core.vehicle.multirotor import TERMS

    zeros = {
        "rotor_drag_kg": 0.0,
        "rotor_inflow_kg": 0.0,
        "translational_lift_kg_m": 0.0,
        "parasitic_drag_kg_m": (0.0, 0.0, 0.0),
        "motor_time_constant_s": 0.0,
    }
    found = []
    for name, config in (
        ("bare", preset("hummingbird", **zeros)),
        ("hummingbird", preset("hummingbird")),
    ):
        reduced, full = (Multirotor(config, terms=terms) for terms in (None, TERMS))
        largest = 0.0
        rng = np.random.default_rng(9)
        for vehicle in (reduced, full):
            vehicle.reset(position=[0.0, 0.0, 1.4])
        for _ in range(100):
            command = config.hover_rotor_speed_rad_s * rng.uniform(0.9, 1.1, (1, config.rotor_count))
            for vehicle in (reduced, full):
                vehicle.step(command, 10_000_000)
            pairs = zip(reduced.state, full.state, strict=True)
            largest = max(largest, *(float(np.abs(a - b).max()) for a, b in pairs))
        found.append(
            Difference(
                kernel=f"dynamics, {name}",
                reduced=", ".join(reduced.terms) or "none",
                full="all",
                largest=largest,
                precision="float64",
                bar=EQUAL_BAR,
            )
        )
    return tuple(found)


def imu_difference() -> Difference:
    """Return how far an IMU without errors is from one that computes them all, with zeros.

    Both are carried about for 1 s under random commands; noise of density 0 and without limits.
    """
    from neurosim_core.frames import Mount
    from neurosim_core.sensors.imu import TERMS, Imu, ImuConfig
    from neurosim_core.vehicle import Multirotor, preset

    airframe = preset("hummingbird")
    vehicle = Multirotor(airframe)
    config = ImuConfig(mount=Mount(position_m=(0.1, -0.05, 0.02), rpy_rad=(0.1, 0.2, 0.3)))
    reduced, full = (Imu(config, vehicle, terms=terms) for terms in (None, TERMS))
    vehicle.reset(position=[0.0, 0.0, 1.4])
    rng = np.random.default_rng(9)
    largest = 0.0
    for _ in range(400):
        speeds = airframe.hover_rotor_speed_rad_s * rng.uniform(0.9, 1.1, (1, airframe.rotor_count))
        vehicle.step(speeds, 2_500_000)
        pairs = zip(reduced.sample(), full.sample(), strict=True)
        largest = max(largest, *(float(np.abs(a - b).max()) for a, b in pairs))
    return Difference(
        kernel="IMU",
        reduced=", ".join(reduced.terms) or "none",
        full="all",
        largest=largest,
        precision="float64",
        bar=EQUAL_BAR,
    )


def pixel_difference() -> Difference:
    """Return how far ideal pixels are from ones that compute every departure from the ideal, with zeros.

    They see pictures whose log radiance wanders at random, by 0.3 a picture. The difference is that of the
    stamps, and infinite where an event is missing or of another pixel or polarity.
    """
    from neurosim_core.sensors.event_config import EventCameraConfig
    from neurosim_core.sensors.event_noise_model import TERMS
    from neurosim_core.sensors.events import EventCamera

    height, width = 48, 64
    steps = np.random.default_rng(9).normal(scale=0.3, size=(20, height, width))
    frames = steps.cumsum(axis=0).astype(np.float32)
    zeros = tuple(term for term in TERMS if term != "stochastic")  # which is a law of its own, without zeros
    found = []
    for terms in (None, zeros):
        camera = EventCamera(EventCameraConfig(), width=width, height=height, terms=terms)
        camera.reset(frames[0])
        found.append(camera.feed(frames[1:], np.arange(1, len(frames)) * 1_700_123).numpy())
    reduced, full = found
    same = all(np.array_equal(getattr(reduced, key), getattr(full, key)) for key in ("x", "y", "polarity"))
    return Difference(
        kernel=f"pixels, {len(reduced.t):,} events",
        reduced="none",
        full=", ".join(zeros),
        largest=float(np.abs(reduced.t - full.t).max()) if same else math.inf,
        precision="stamps of 1 us",
        bar=0.0,
    )


def radiance_difference() -> Difference:
    """Return how far radiance without texture and emission is from that with both compiled in, and unused."""
    from neurosim_core.bench.render import checkerboard_floor, first_pictures
    from neurosim_core.scene.scene import Material

    textured = checkerboard_floor(0.1)
    grey = Material(name="grey", base_color=(0.5, 0.4, 0.3))
    glowing = Material(name="glowing", emission=(1.0, 1.0, 1.0))
    plain = replace(textured, materials=(grey,))
    unused = replace(textured, materials=(grey, glowing, textured.materials[0]))  # all faces are of the first
    reduced, full = first_pictures(plain), first_pictures(unused)
    return Difference(
        kernel="radiance",
        reduced="none",
        full="textured, emissive",
        largest=float(np.abs(reduced - full).max()),
        precision="float32",
        bar=0.0,
    )


def leave_out_chapter(result: LeaveOutResult) -> Chapter:
    """Return the answer in words, tables and a plot."""
    return Chapter(
        name="leave-out",
        title="What a scene does not need is left out",
        summary=_summary(result),
        command=f"neurosim bench leave-out{' --quick' if result.quick else ''}",
        bars=_bars(result),
        tables=[_count_table(result), _term_table(result), _library_table(result), _difference_table(result)],
        plots=[
            Plot(
                name="leave-out",
                title="What runs take, few parts to many",
                draw=lambda figure: _draw(result, figure),
            )
        ],
    )


def _summary(result: LeaveOutResult) -> str:
    least, most = result.probes[_IMU], result.probes[_ALL]
    worst = max(d.largest for d in result.differences if d.precision == "float64")
    return (
        "Each case flew in a process of its own, on the CPU, with launches, allocations and imports counted "
        "as they happened. For a simulated second (sensors and control included) a flight with an IMU alone "
        f"takes {1e3 * _best_s(least):,.0f} ms of CPU time, one with every sensor and term "
        f"{1e3 * _best_s(most):,.0f} ms, {_best_s(most) / _best_s(least):,.0f} times as much; set-up takes "
        f"{least.setup_s:.1f} s and {most.setup_s:.1f} s, Warp's arrays {least.array_bytes / 2**20:.1f} MiB "
        f"and {most.array_bytes / 2**20:.1f} MiB. Dynamics and IMUs without the terms that they do not need "
        f"differ from the full ones with zeros by {worst:.1e} at most."
    )


def _best_s(probe: Probe) -> float:
    """Return CPU time per simulated second [s], the best of the repetitions."""
    return min(probe.flight_s)


def _bars(result: LeaveOutResult) -> list[Bar]:
    imu, events, plain = (result.probes[name] for name in (_IMU, _EVENTS, _EVENTS_PLAIN))
    blind = [
        (case.title, result.probes[case.name]) for case in result.cases if case.name in (_IMU, _IMU_FILE)
    ]
    imported = [f"{name} ({title})" for title, probe in blind for name in _scene_libraries(probe)]
    needed = _scene_libraries(result.probes[_ALL_FILE])
    pictures, texels = (sum(getattr(p, k) for _, p in blind) for k in ("picture_count", "texture_bytes"))
    rgb = [name for name, probe in ((_EVENTS, events), (_EVENTS_PLAIN, plain)) if _computes_rgb(probe)]
    sampled = [name for name in _SAMPLER if name in plain.shader_functions]
    return [
        Bar(
            text="a run with an IMU only allocates no image",
            measured=f"{pictures} of {imu.array_count} arrays, {texels} bytes of texture",
            met=pictures == texels == 0,
        ),
        Bar(
            text="a run with an IMU only imports no library for scenes: apartment, glTF",
            measured=(", ".join(imported) or f"none of {', '.join(LIBRARIES['scene'])}")
            + f"; to look at the same file takes {', '.join(needed) or 'none'}",
            met=not imported and bool(needed),
        ),
        Bar(
            text="a run with events only computes no RGB",
            measured=f"computed in: {', '.join(rgb)}" if rgb else "not in the code of its kernels",
            met=not rgb,
        ),
        Bar(
            text="a scene without textures compiles no sampler",
            measured=", ".join(sampled)
            or "not in the code of its kernels; the apartment's has "
            + ", ".join(name for name in _SAMPLER if name in events.shader_functions),
            met=not sampled and any(name in events.shader_functions for name in _SAMPLER),
        ),
        Bar(
            text=f"reduced kernels equal the full ones with coefficients of zero: {EQUAL_BAR:g} in float64, "
            "else exactly",
            measured="; ".join(f"{d.kernel} {d.largest:.1e}" for d in result.differences),
            met=all(d.largest <= d.bar for d in result.differences),
        ),
    ]


def _scene_libraries(probe: Probe) -> list[str]:
    """Return the libraries for scenes that a run has imported."""
    return [name for name in LIBRARIES["scene"] if name in probe.libraries] + ["Embree"] * probe.embree


def _computes_rgb(probe: Probe) -> bool:
    """Whether a ray caster turns light into colours, or any cast is asked for them."""
    return _RGB in probe.shader_functions or any("rgb" in terms for terms in probe.terms.values())


def _count_table(result: LeaveOutResult) -> Table:
    return Table(
        name="leave-out",
        title="Launches, memory and time",
        columns={
            "case": "run",
            "kernels": "kernels",
            "launch_count": "launches",
            "launches_per_s": "launches per simulated second",
            "array_count": "arrays",
            "array_mib": "their size [MiB]",
            "picture_mib": "of pictures [MiB]",
            "texture_mib": "texels on the host [MiB]",
            "flight_allocations_per_s": "allocations per s in flight",
            "resident_mib": "most memory of the process [MiB]",
            "setup_s": "set-up [s of CPU]",
            "cpu_ms": "CPU time per simulated second, best [ms]",
            "cpu_median_ms": "median [ms]",
            "full_cpu_ms": "with everything on, best [ms]",
        },
        rows=[
            {
                "case": case.title,
                "kernels": len(probe.kernels),
                "launch_count": probe.launch_count,
                "launches_per_s": probe.launches_per_s,
                "array_count": probe.array_count,
                "array_mib": probe.array_bytes / 2**20,
                "picture_mib": probe.picture_bytes / 2**20,
                "texture_mib": probe.texture_bytes / 2**20,
                "flight_allocations_per_s": probe.flight_allocations_per_s,
                "resident_mib": probe.resident_bytes / 2**20,
                "setup_s": probe.setup_s,
                "cpu_ms": 1e3 * _best_s(probe),
                "cpu_median_ms": 1e3 * statistics.median(probe.flight_s),
                "full_cpu_ms": 1e3 * _best_s(result.probes[case.full]),
            }
            for case, probe in _rows(result)
        ],
        note="On the CPU, in a process for each run. Slices of one launch count once. Arrays are those that "
        "Warp allocates in the set-up, in flight those of its second half; pictures are arrays with the rows "
        "and columns of a camera. CPU time is that of all threads, with all that sensors and control take: "
        f"best and median of {len(result.probes[_IMU].flight_s)} flights in one process.",
    )


def _term_table(result: LeaveOutResult) -> Table:
    return Table(
        name="leave-out-terms",
        title="Terms that are compiled in",
        columns={"case": "run", "part": "part", "terms": "terms"},
        rows=[
            {"case": case.title, "part": part, "terms": ", ".join(terms) or "none"}
            for case, probe in _rows(result)
            for part, terms in probe.terms.items()
        ],
    )


def _library_table(result: LeaveOutResult) -> Table:
    return Table(
        name="leave-out-libraries",
        title="Libraries that are imported",
        columns={"case": "run", **{kind: kind for kind in LIBRARIES}, "embree": "Embree loaded"},
        rows=[
            {
                "case": case.title,
                "embree": probe.embree,
                **{
                    kind: ", ".join(name for name in names if name in probe.libraries) or "none"
                    for kind, names in LIBRARIES.items()
                },
            }
            for case, probe in _rows(result)
        ],
        note="Of " + ", ".join(name for names in LIBRARIES.values() for name in names) + ". Rooms are read "
        "from glTF; files of other formats are read by trimesh, also where nobody looks.",
    )


def _difference_table(result: LeaveOutResult) -> Table:
    return Table(
        name="leave-out-differences",
        title="Reduced kernels against full ones with coefficients of zero",
        columns={
            "kernel": "kernel",
            "reduced": "terms of the reduced one",
            "full": "of the full one",
            "precision": "precision",
            "largest": "largest difference",
            "bar": "allowed",
        },
        rows=[vars(difference) for difference in result.differences],
        note="Dynamics and IMU: a second under random commands; positions, velocities, attitudes and rates; "
        "specific forces and rates. Pixels: pictures that wander at random; every event, to its stamp.",
    )


def _rows(result: LeaveOutResult) -> list[tuple[Case, Probe]]:
    return [(case, result.probes[case.name]) for case in result.cases]


def _draw(result: LeaveOutResult, figure: Figure) -> None:
    """Draw time, launches and memory of each run beside each other."""
    panels = figure.subplots(1, 3, sharey=True)
    titles = [case.title for case in result.cases]
    figures = (
        ("CPU time per simulated second [ms]", [1e3 * _best_s(probe) for _, probe in _rows(result)]),
        ("launches per simulated second", [probe.launches_per_s for _, probe in _rows(result)]),
        ("Warp arrays [MiB]", [probe.array_bytes / 2**20 for _, probe in _rows(result)]),
    )
    for axes, color, (label, values) in zip(panels, COLORS, figures, strict=False):
        axes.plot(values, np.arange(len(titles)), "o", color=color)  # on a log axis, bars have no length
        for row, value in enumerate(values):
            text = f"{value:,.3g}" if value < 1e3 else f"{value:,.0f}"
            axes.annotate(text, (value, row), (8, 0), textcoords="offset points", va="center")
        axes.set(xscale="log", xlabel=label, xlim=(0.5 * min(values), 8.0 * max(values)))
        axes.grid(visible=False, axis="y")
    panels[0].set_yticks(np.arange(len(titles)), titles)
    panels[0].invert_yaxis()
