"""What a scene does not need is left out: kernels, memory, libraries and time of runs, small and large.

Each case flies in a process of its own (`python -m neurosim_core.bench.leave_out`); what it holds and has
imported is counted there when it has flown. Kernels that leave terms out are compared with ones that have
them with coefficients of zero.
"""

from __future__ import annotations

import gc
import itertools
import json
import math
import resource
import subprocess
import sys
import time
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.bench.options import Options, Progress, silent
from neurosim_core.bench.report import Chapter, Claim, Panel, Plot, Row, Series, Table, cell

_SCENE_LIBRARIES = ("trimesh", "PIL", "networkx", "embreex", "pyrender", "OpenGL")
LIBRARIES = (*_SCENE_LIBRARIES, "h5py", "mcap", "matplotlib", "rerun", "zmq", "cortex", "scipy", "torch")
"""Libraries that a run may or may not need; the first ones are for scenes."""
_HEIGHT_PX, _WIDTH_PX = 47, 61
"""Prime, and of no other array: what has them is a picture."""
_TIMEOUT_S = 600.0


def measure(options: Options, progress: Progress = silent) -> Chapter:
    """Fly the cases one after the other, on the CPU: what is counted does not depend on the device."""
    rows, quick = [], options.quick
    for title, config in cases(quick).items():
        progress(title)
        rows.append({"run": title, **run_case(config, seconds=0.2 if quick else 1.0)})
    progress("reduced against full kernels")
    differences = [*_vehicle_rows(quick), _imu_row(), _pixel_row()]
    return _chapter(rows, differences)


def cases(quick: bool) -> dict[str, dict[str, Any]]:
    """Return the settings of the runs, from an IMU alone to everything."""
    lens = {"width": _WIDTH_PX, "height": _HEIGHT_PX, "horizontal_fov_rad": 1.5}
    events = {"kind": "event_camera", "lens": lens}
    pictures = {kind: {"kind": kind, "lens": lens} for kind in ("rgb", "depth")}
    inertial = {"imu": {"kind": "imu"}, "odometry": {"kind": "odometry"}}
    everything = {
        "events": {**events, "pixel": {"preset": "davis346"}},
        **pictures,
        "imu": {"kind": "imu", "accelerometer_noise_density": 1e-3, "accelerometer_random_walk": 1e-4},
        "odometry": {"kind": "odometry"},
    }
    terms = {
        "motor_time_constant_scale": [1.0, 1.1, 1.2, 1.3],
        "flapping_kg_m": 1e-6,
        "wind_m_s": [0.3, 0.1, 0.0],
        "gusts": [{"velocity_m_s": [0.2, 0.0, 0.1], "start_s": 0.0, "rise_s": 0.1}],
        "turbulence": {"wind_20ft_m_s": 1.0},
        "ground": {"rotor_radius_m": 0.1},
    }
    ball = {"ball": {"shape": {"kind": "sphere"}, "motion": {"position_m": [0.0, 0.0, 0.3]}}}
    chosen: dict[str, dict[str, Any]] = {
        "IMU only": {"sensors": {"imu": {"kind": "imu"}}},
        "events only": {"sensors": {"events": events}},
        "RGB and depth": {"sensors": pictures},
        "all sensors": {"sensors": {"events": events, **pictures, **inertial}},
        "all sensors and terms": {"sensors": everything, "vehicle": {"parameters": terms}, "bodies": ball},
    }
    for config in chosen.values():
        config |= {"device": "cpu", "path": {"kind": "circle", "radius_m": 0.3}}
        config["scene"] = {"kind": "apartment", **({"rooms": 1} if quick else {})}
        config["vehicle"] = {**config.get("vehicle", {}), "on_collision": "report"}
    return chosen


def run_case(config: dict[str, Any], *, seconds: float) -> Row:
    """Fly in a fresh process and return what was counted there.

    Args:
        config: Settings.
        seconds: Simulated time that is measured, after as much that is not [s].

    Raises:
        RuntimeError: The run failed.
    """
    done = subprocess.run(
        [sys.executable, "-m", "neurosim_core.bench.leave_out"],
        input=json.dumps({"config": config, "seconds": seconds}),
        capture_output=True,
        text=True,
        check=False,
        timeout=_TIMEOUT_S,
    )
    if done.returncode != 0:
        raise RuntimeError(f"a run ended with status {done.returncode}: {done.stderr.strip()[-2000:]}")
    row: Row = json.loads(done.stdout.splitlines()[-1])
    return row


# In the process of a run


def _held_arrays() -> list[Any]:
    """Return the Warp arrays of this process that own their memory."""
    objects = (thing for thing in gc.get_objects() if isinstance(thing, wp.array))
    return [array for array in objects if getattr(array, "_allocator", None) is not None]


def _fly(config: dict[str, Any], seconds: float) -> Row:
    """Fly, and return what was counted; for a process that does nothing else."""
    from warp._src.context import user_modules

    begin_s = time.process_time()  # what else runs on the machine does not count

    from neurosim_core.config import load_config
    from neurosim_core.sim.model import make_model
    from neurosim_core.sim.rollout import run_model
    from neurosim_core.sim.state import make_state

    model = make_model(load_config({**config, "duration_s": 2.0 * seconds}))
    state = make_state(model)
    setup_s = time.process_time() - begin_s
    flown_ns, flight_s, halfway = 0, 0.0, False
    for packet in run_model(model, state):
        if not halfway and packet.stamp_ns >= 1e9 * seconds:
            halfway, flown_ns, flight_s = True, packet.stamp_ns, time.process_time()
        last_ns = packet.stamp_ns
    cpu_s = time.process_time() - flight_s
    arrays = _held_arrays()
    return {
        "arrays": len(arrays),
        "their size [MiB]": sum(array.capacity for array in arrays) / 2**20,
        "pictures": sum((_HEIGHT_PX, _WIDTH_PX) in itertools.pairwise(array.shape) for array in arrays),
        "modules of kernels": sum(bool(module.execs) for module in user_modules.values()),
        "most memory [MiB]": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "set-up [s of CPU]": setup_s,
        "CPU per simulated s [ms]": 1e3 * cpu_s / (1e-9 * (last_ns - flown_ns)),
        "libraries": ", ".join(name for name in LIBRARIES if name in sys.modules) or "none",
    }


# Reduced and full kernels


def _vehicle_rows(quick: bool) -> list[Row]:
    """Compare vehicles without optional terms with ones that have them all, with zeros: states and speed."""
    from neurosim_core.bench.dynamics_long import best_rate
    from neurosim_core.bench.engine import TERMS, Multirotor, preset

    rows = []
    for name in ("hummingbird", "crazyflie", "racer"):
        config = preset(name)
        vehicles = [Multirotor(config), Multirotor(config, terms=TERMS)]
        rng, largest = np.random.default_rng(9), 0.0
        for _ in range(100):
            command = config.hover_rotor_speed_rad_s * rng.uniform(0.9, 1.1, (1, config.rotor_count))
            for vehicle in vehicles:
                vehicle.step(command, 10_000_000)
            pairs = zip(vehicles[0].state, vehicles[1].state, strict=True)
            largest = max(largest, *(float(np.abs(a - b).max()) for a, b in pairs))
        reduced, full = (best_rate(v, 100, repetitions=3, cpu_s=0.05 if quick else 0.3) for v in vehicles)
        row: Row = {"kernel": f"vehicle, {name}", "terms": ", ".join(vehicles[0].terms) or "none"}
        rows.append({**row, "largest difference": largest, "allowed": 1e-12, "times as fast": reduced / full})
    return rows


def _imu_row() -> Row:
    """Compare an IMU without errors with one that computes them all, with zeros."""
    from neurosim_core.bench.engine import IMU_TERMS, Imu, ImuSensorConfig, Mount, Multirotor, preset

    airframe = preset("hummingbird")
    vehicle = Multirotor(airframe)
    config = ImuSensorConfig(mount=Mount(position_m=(0.1, -0.05, 0.02), rpy_rad=(0.1, 0.2, 0.3)))
    reduced, full = (Imu(config, vehicle, terms=terms) for terms in (None, IMU_TERMS))
    rng, largest = np.random.default_rng(9), 0.0
    for _ in range(400):
        speeds = airframe.hover_rotor_speed_rad_s * rng.uniform(0.9, 1.1, (1, airframe.rotor_count))
        vehicle.step(speeds, 2_500_000)
        pairs = zip(reduced.sample(), full.sample(), strict=True)
        largest = max(largest, *(float(np.abs(a - b).max()) for a, b in pairs))
    terms = ", ".join(reduced.terms) or "none"
    return {"kernel": "IMU", "terms": terms, "largest difference": largest, "allowed": 1e-12}


def _pixel_row() -> Row:
    """Compare ideal pixels with ones that compute every departure from the ideal, with zeros: stamps [us].

    Log radiance wanders at random. The difference is infinite where an event is missing or of another pixel.
    """
    from neurosim_core.bench.engine import PIXEL_TERMS, EventCamera, EventCameraConfig

    frames = np.random.default_rng(9).normal(scale=0.3, size=(20, 48, 64)).cumsum(axis=0).astype(np.float32)
    own_law = ("stochastic", "jitter")  # without zeros that are the ideal law to the bit
    zeros = tuple(term for term in PIXEL_TERMS if term not in own_law)
    found = []
    for terms in (None, zeros):
        camera = EventCamera(EventCameraConfig(), width=64, height=48, terms=terms)
        camera.reset(frames[0])
        found.append(camera.feed(frames[1:], np.arange(1, len(frames)) * 1_700_123).numpy())
    reduced, full = found
    same = all(np.array_equal(getattr(reduced, key), getattr(full, key)) for key in ("x", "y", "polarity"))
    largest = float(np.abs(reduced.t - full.t).max()) if same else math.inf
    return {
        "kernel": f"pixels, {len(reduced.t):,} events",
        "terms": "none",
        "largest difference": largest,
        "allowed": 0.0,
    }


def _chapter(rows: list[Row], differences: list[Row]) -> Chapter:
    least, most = rows[0], rows[-1]
    imported = [name for name in _SCENE_LIBRARIES if name in least["libraries"].split(", ")]
    cpu, setup = "CPU per simulated s [ms]", "set-up [s of CPU]"
    places = list(range(len(rows)))
    panels = []
    for heading in (cpu, "modules of kernels", "their size [MiB]"):
        values = [row[heading] for row in rows]
        series = Series(label="runs", x=values, y=places, style="points", names=list(map(cell, values)))
        ticks = {row["run"]: place for place, row in enumerate(rows)}
        panels.append(Panel(x_label=heading, series=[series], x_scale="log", y_ticks=ticks))
    return Chapter(
        name="leave-out",
        title="What a scene does not need is left out",
        summary=f"A flight with an IMU alone takes {least[cpu]:,.0f} ms of CPU time for a simulated second, "
        f"one with every sensor and term {most[cpu]:,.0f} ms; set-up takes {least[setup]:.1f} and "
        f"{most[setup]:.1f} s.",
        claims=[
            Claim(
                "a run with an IMU only allocates no picture",
                "arrays of Warp in the process of the run",
                f"{least['pictures']} of {least['arrays']} arrays; {most['pictures']} with all sensors",
                least["pictures"] == 0 < most["pictures"],
            ),
            Claim(
                "a run with an IMU only imports no library for scenes",
                "modules of the process of the run",
                ", ".join(imported) or f"none of {', '.join(_SCENE_LIBRARIES)}",
                not imported,
            ),
            Claim(
                "reduced kernels equal the full ones with coefficients of zero: to 1e-12, and to the stamp",
                "the equations: a term with coefficient 0 adds 0",
                "; ".join(f"{row['kernel']} {cell(row['largest difference'])}" for row in differences),
                all(row["largest difference"] <= row["allowed"] for row in differences),
            ),
        ],
        tables=[
            Table("leave-out", "Kernels, memory, libraries and time", rows, "On the CPU, each in a process."),
            Table("leave-out-differences", "Reduced kernels against full ones with zeros", differences),
        ],
        plots=[Plot("leave-out", "What runs take, few parts to many", panels)],
    )


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_WARNING
    request = json.load(sys.stdin)
    print(json.dumps(_fly(request["config"], request["seconds"])))
