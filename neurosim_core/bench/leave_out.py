"""Runs pay only for what they use: kernels, memory, libraries and time of small and large runs.

Each case flies in a process of its own; what it holds and has imported is counted there when it has flown.
"""

from __future__ import annotations

import gc
import itertools
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import warp as wp

from neurosim_core.bench.options import Options
from neurosim_core.bench.report import Chapter, Claim, Plot, Row, Table, panel

_SCENE_LIBRARIES = ("trimesh", "PIL", "networkx", "embreex", "pyrender", "OpenGL")
_LIBRARIES = (*_SCENE_LIBRARIES, "h5py", "mcap", "matplotlib", "rerun", "zmq", "cortex", "scipy", "torch")
"""Libraries that a run may or may not need; the first ones are for scenes."""
_HEIGHT_PX, _WIDTH_PX = 47, 61
"""Prime, and of no other array: what has them is a picture."""
_TIMEOUT_S = 600.0


def measure(options: Options) -> Chapter:
    """Fly the cases one after the other, on the CPU: what is counted does not depend on the device."""
    rows, quick = [], options.quick
    for title, config in cases(quick).items():
        options.progress(title)
        rows.append({"run": title, **run_case(config, seconds=0.2 if quick else 1.0)})
    return _chapter(rows)


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
        "all sensors": {"sensors": {"events": events, **pictures, **inertial}},
        "all sensors and terms": {"sensors": everything, "vehicle": {"parameters": terms}, "bodies": ball},
    }
    for config in chosen.values():
        config |= {"device": "cpu", "path": {"kind": "circle", "radius_m": 0.3}}
        config["scene"] = {"kind": "apartment", **({"rooms": 1} if quick else {})}
        config["vehicle"] = {**config.get("vehicle", {}), "on_collision": "report"}
    return chosen


def run_case(config: dict[str, Any], *, seconds: float) -> Row:
    """Fly in a fresh process and return what was counted there in some seconds, after as many before."""
    with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
        return fresh.submit(_fly, config, seconds).result(_TIMEOUT_S)


def _fly(config: dict[str, Any], seconds: float) -> Row:
    """Fly, and return what was counted; for a process that does nothing else."""
    from warp._src.context import user_modules

    wp.config.log_level = wp.LOG_WARNING
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
    arrays: list[Any] = [thing for thing in gc.get_objects() if isinstance(thing, wp.array)]
    arrays = [array for array in arrays if getattr(array, "_allocator", None) is not None]  # own their memory
    return {
        "arrays": len(arrays),
        "their size [MiB]": sum(array.capacity for array in arrays) / 2**20,
        "pictures": sum((_HEIGHT_PX, _WIDTH_PX) in itertools.pairwise(array.shape) for array in arrays),
        "modules of kernels": sum(bool(module.execs) for module in user_modules.values()),
        "most memory [MiB]": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "set-up [s of CPU]": setup_s,
        "CPU per simulated s [ms]": 1e3 * cpu_s / (1e-9 * (last_ns - flown_ns)),
        "libraries": ", ".join(name for name in _LIBRARIES if name in sys.modules) or "none",
    }


def _chapter(rows: list[Row]) -> Chapter:
    least, most = rows[0], rows[-1]
    imported = [name for name in _SCENE_LIBRARIES if name in least["libraries"].split(", ")]
    cpu, setup = "CPU per simulated s [ms]", "set-up [s of CPU]"
    headings = (cpu, "modules of kernels", "their size [MiB]")
    drawn = [panel([{**row, "": y} for row in rows], "run", y, by="", y_min=0.0) for y in headings]
    return Chapter(
        name="leave-out",
        title="What a scene does not need is left out",
        summary=f"A flight with an IMU alone takes {least[cpu]:,.0f} ms of CPU time for a simulated second, "
        f"one with every sensor and term {most[cpu]:,.0f} ms; set-up takes {least[setup]:.1f} and "
        f"{most[setup]:.1f} s.",
        claims=[
            Claim("a run with an IMU only allocates no picture", "arrays of Warp in the process of the run",
                  f"{least['pictures']} of {least['arrays']} arrays; {most['pictures']} with all sensors",
                  least["pictures"] == 0 < most["pictures"]),
            Claim("a run with an IMU only imports no library for scenes", "modules of the process of the run",
                  ", ".join(imported) or f"none of {', '.join(_SCENE_LIBRARIES)}", not imported),
        ],
        tables=[Table("leave-out", "Kernels, memory, libraries and time", rows, "Each run in a process.")],
        plots=[Plot("leave-out", "What runs take, few parts to many", drawn, 1)],
    )  # fmt: skip
