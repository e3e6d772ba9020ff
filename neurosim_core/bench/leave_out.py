"""What a scene does not need is left out: kernels, memory, libraries and time of runs, small and large.

Each case flies in a process of its own, where launches, allocations and imports are counted
(`leave_out_probe`). Kernels that leave terms out are compared with ones that have them with coefficients of
zero.
"""

from __future__ import annotations

import base64
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neurosim_core.bench.figures import COLORS
from neurosim_core.bench.leave_out_probe import LIBRARIES, Probe
from neurosim_core.bench.report import Bar, Chapter, Plot, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EQUAL_BAR = 1e-12
"""Largest difference of what reduced kernels compute in float64."""

_TIMEOUT_S = 600.0
_ROOM_M = (8.0, 6.0, 3.0)
_SAMPLER = ("sample_texture", "sample_finest", "sample_nearest")
_RGB = "_to_srgb"
_IMU, _EVENTS_PLAIN, _EVENTS, _ALL_PLAIN, _ALL = "imu", "events-plain", "events", "all-plain", "all"


@dataclass(frozen=True, kw_only=True)
class Case:
    """A run that is measured."""

    name: str
    title: str
    config: Mapping[str, Any]
    full: str
    """Name of the case that computes everything in the same scene."""


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
        room = Path(folder) / "room.gltf"
        room.write_text(plain_room(), encoding="utf-8")
        cases = _cases(room, quick)
        probes = {}
        for case in cases:
            tell(case.title)
            probes[case.name] = run_probe(case.config, seconds=0.05 if quick else 0.5)
    tell("reduced against full kernels")
    return LeaveOutResult(
        quick=quick,
        cases=cases,
        probes=probes,
        differences=(*dynamics_differences(), radiance_difference()),
    )


def run_probe(config: Mapping[str, Any], *, seconds: float) -> Probe:
    """Fly in a fresh process and return what was counted there.

    Args:
        config: Settings.
        seconds: Simulated time that is measured [s].

    Raises:
        RuntimeError: The run failed.
    """
    done = subprocess.run(
        [sys.executable, "-m", "neurosim_core.bench.leave_out_probe"],
        input=json.dumps({"config": config, "seconds": seconds}),
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
    half_x, half_y, height = 0.5 * _ROOM_M[0], 0.5 * _ROOM_M[1], _ROOM_M[2]
    corners = [(x, y, z) for z in (0.0, height) for y in (-half_y, half_y) for x in (-half_x, half_x)]
    quads = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    # glTF is y up: (x, y, z) of the world is (x, z, -y) of the file
    positions = np.array([(x, z, -y) for x, y, z in corners], dtype="<f4")
    indices = np.array(faces, dtype="<u2").reshape(-1)
    data = indices.tobytes() + positions.tobytes()
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": indices.nbytes},
        {"buffer": 0, "byteOffset": indices.nbytes, "byteLength": positions.nbytes},
    ]
    accessors = [
        {"bufferView": 0, "componentType": 5123, "count": indices.size, "type": "SCALAR"},
        {
            "bufferView": 1,
            "componentType": 5126,
            "count": len(positions),
            "type": "VEC3",
            "min": positions.min(axis=0).tolist(),
            "max": positions.max(axis=0).tolist(),
        },
    ]
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode("ascii")
    primitive = {"attributes": {"POSITION": 1}, "indices": 0}
    return json.dumps(
        {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "name": "room"}],
            "meshes": [{"primitives": [primitive]}],
            "accessors": accessors,
            "bufferViews": views,
            "buffers": [{"byteLength": len(data), "uri": uri}],
        }
    )


def _cases(room: Path, quick: bool) -> tuple[Case, ...]:
    """Return the runs that are compared."""
    # 61 and 47 are prime and of no other array: what has them is a picture
    lens = {"width": 61, "height": 47, "horizontal_fov_rad": 1.5}
    events = {"kind": "event_camera", "lens": lens}
    pictures = {kind: {"kind": kind, "lens": lens} for kind in ("rgb", "depth")}
    inertial = {"imu": {"kind": "imu"}, "odometry": {"kind": "odometry"}}
    apartment = {"kind": "apartment", **({"rooms": 1} if quick else {})}
    plain = {"kind": "mesh", "file": str(room), "inside_m": [0.0, 0.0, 1.4]}

    def case(name: str, title: str, scene: Any, sensors: Any, **settings: Any) -> Case:
        config = {
            "device": "cpu",
            "scene": scene,
            "path": {"kind": "circle", "radius_m": 0.3},
            "vehicle": {"on_collision": "report"},
            "sensors": sensors,
            **settings,
        }
        return Case(
            name=name, title=title, config=config, full=_ALL_PLAIN if scene is plain and not quick else _ALL
        )

    everything = {"events": events, **pictures, **inertial}
    cases = (
        case(_IMU, "IMU only, apartment", apartment, {"imu": {"kind": "imu"}}),
        case(_EVENTS_PLAIN, "events only, plain room", plain, {"events": events}),
        case(_EVENTS, "events only, apartment", apartment, {"events": events}),
        case("pictures", "RGB and depth, apartment", apartment, pictures),
        case("sensors", "all sensors, apartment", apartment, everything),
        case(_ALL_PLAIN, "everything, plain room", plain, **_all_terms(everything)),
        case(_ALL, "everything, apartment", apartment, **_all_terms(everything)),
    )
    quick_names = (_IMU, _EVENTS_PLAIN, _EVENTS, _ALL)
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
            )
        )
    return tuple(found)


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
        "as they happened. Per step of the integration (1 ms; sensors and control included) a flight with an "
        f"IMU alone takes {1e6 * least.step_s:.0f} us of CPU time, one with every sensor and term "
        f"{1e6 * most.step_s:,.0f} us, {most.step_s / least.step_s:,.0f} times as much; set-up takes "
        f"{least.setup_s:.1f} s and {most.setup_s:.1f} s, Warp's arrays {least.array_bytes / 2**20:.1f} MiB "
        f"and {most.array_bytes / 2**20:.1f} MiB. Dynamics without the terms that a vehicle does not need "
        f"differ from the full ones with zeros by {worst:.1e} at most."
    )


def _bars(result: LeaveOutResult) -> list[Bar]:
    imu, events, plain = (result.probes[name] for name in (_IMU, _EVENTS, _EVENTS_PLAIN))
    imported = [name for name in LIBRARIES["scene"] if name in imu.libraries] + ["Embree"] * imu.embree
    rgb = [name for name, probe in ((_EVENTS, events), (_EVENTS_PLAIN, plain)) if _computes_rgb(probe)]
    sampled = [name for name in _SAMPLER if name in plain.shader_functions]
    worst = max(d.largest for d in result.differences if d.precision == "float64")
    radiance = max(d.largest for d in result.differences if d.precision == "float32")
    return [
        Bar(
            text="a run with an IMU only allocates no image",
            measured=f"{imu.picture_count} of {imu.array_count} arrays, {imu.texture_bytes} bytes of texture",
            met=imu.picture_count == 0 and imu.texture_bytes == 0,
        ),
        Bar(
            text="a run with an IMU only imports no library for scenes",
            measured=", ".join(imported) or f"none of {', '.join(LIBRARIES['scene'])}",
            met=not imported,
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
            text=f"reduced kernels equal the full ones with coefficients of zero: {EQUAL_BAR:g} in float64",
            measured=f"dynamics {worst:.1e}; radiance (float32) {radiance:.1e}",
            met=worst <= EQUAL_BAR and radiance == 0.0,
        ),
    ]


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
            "step_us": "CPU time per step [us]",
            "full_step_us": "with everything on [us]",
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
                "step_us": 1e6 * probe.step_s,
                "full_step_us": 1e6 * result.probes[case.full].step_s,
            }
            for case, probe in _rows(result)
        ],
        note="On the CPU, in a process for each run. Slices of one launch count once. Arrays are those that "
        "Warp allocates in the set-up, in flight those of its second half; pictures are arrays with the rows "
        "and columns of a camera. A step is one of the integration, 1 ms, with all that sensors and control "
        "take. CPU time is that of all threads.",
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
        note="Of " + ", ".join(name for names in LIBRARIES.values() for name in names) + ".",
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
        },
        rows=[vars(difference) for difference in result.differences],
        note="Dynamics: a second under random commands; positions, velocities, attitudes and rates.",
    )


def _rows(result: LeaveOutResult) -> list[tuple[Case, Probe]]:
    return [(case, result.probes[case.name]) for case in result.cases]


def _draw(result: LeaveOutResult, figure: Figure) -> None:
    """Draw time, launches and memory of each run beside each other."""
    panels = figure.subplots(1, 3, sharey=True)
    titles = [case.title for case in result.cases]
    figures = (
        ("CPU time per step [us]", [1e6 * probe.step_s for _, probe in _rows(result)]),
        ("launches per simulated second", [probe.launches_per_s for _, probe in _rows(result)]),
        ("Warp arrays [MiB]", [probe.array_bytes / 2**20 for _, probe in _rows(result)]),
    )
    for axes, color, (label, values) in zip(panels, COLORS, figures, strict=False):
        bars = axes.barh(np.arange(len(titles)), values, color=color)
        axes.bar_label(
            bars, [f"{value:,.3g}" if value < 1e3 else f"{value:,.0f}" for value in values], padding=3
        )
        axes.set(xscale="log", xlabel=label, xlim=(0.5 * min(values), 8.0 * max(values)))
        axes.grid(visible=False, axis="y")
    panels[0].set_yticks(np.arange(len(titles)), titles)
    panels[0].invert_yaxis()
