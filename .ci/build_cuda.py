"""Build every kernel for CUDA, ahead of time and without a GPU, so that one that does not build fails CI.

Kernels that are made to measure exist once something asks for them: a short flight with every sensor, all
command modes and the pieces that a run does not use by itself are asked for here.
"""

from __future__ import annotations

import gc
import importlib
import inspect
import pkgutil
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import warp as wp

import neurosim_core
from neurosim_core import run
from neurosim_core.control import MODES, Controller, mode_kernel
from neurosim_core.render.antialias import antialiasing_kernels
from neurosim_core.render.candidate_lists import frustum_search_kernel
from neurosim_core.render.kernel_data import BLOCK, RenderTerms
from neurosim_core.render.outputs import OUTPUTS
from neurosim_core.render.raycast import fallback_kernel, raycast_kernel
from neurosim_core.sensors.event_noise_model import TERMS
from neurosim_core.sensors.event_noise_pixel import make_begin, signal_terms
from neurosim_core.sensors.event_noise_scan import make_noisy_scan
from neurosim_core.sensors.imu import TERMS as IMU_TERMS
from neurosim_core.sensors.imu import make_kernel as make_imu
from neurosim_core.sim.trace import record_state
from neurosim_core.trajectory.shapes import HoverConfig, hover
from neurosim_core.vehicle import TERMS as VEHICLE_TERMS
from neurosim_core.vehicle import Multirotor, preset
from neurosim_core.vehicle.aerodynamics import AIR_TERMS
from neurosim_core.vehicle.integrator import make_flight

ARCHITECTURES = (80, 90)
LENS = {"width": 32, "height": 24, "horizontal_fov_rad": 1.5}
SENSORS = {
    "events": {"kind": "event_camera", "lens": LENS, "sampling_rate_hz": 100, "packet_rate_hz": 100},
    "rgb": {"kind": "rgb", "lens": LENS},
    "depth": {"kind": "depth", "lens": LENS},
    "flow": {"kind": "optical_flow", "lens": LENS},
    "corners": {"kind": "corners", "lens": LENS},
    "labelled": {
        "kind": "event_camera",
        "lens": LENS,
        "sampling_rate_hz": 100,
        "packet_rate_hz": 100,
        "labels": ["depth", "flow", "instance", "semantic"],
    },
    "exact_imu": {"kind": "imu"},
    "noisy_imu": {
        "kind": "imu",
        "accelerometer_noise_density": 1e-3,
        "accelerometer_random_walk": 1e-4,
        "accelerometer_bias_instability_m_s2": 1e-3,
        "accelerometer_range_m_s2": 160.0,
        "accelerometer_resolution_m_s2": 1e-3,
    },
}
LEARN = {"torch", "gymnasium", "rsl_rl", "skrl", "stable_baselines3", "tensordict"}
"""Libraries of which the CUDA build needs none."""


def make_kernels() -> None:
    """Ask for the kernels that are made to measure."""
    for found in pkgutil.walk_packages(neurosim_core.__path__, "neurosim_core."):
        if not found.name.endswith("__main__"):
            try:
                importlib.import_module(found.name)
            except ModuleNotFoundError as error:  # those of the extra `learn` have no kernels
                if (error.name or "").split(".")[0] not in LEARN:
                    raise
    scene = {"kind": "apartment", "rooms": 1}
    for lighting in ("baked", "unshadowed"):
        for _ in run({"duration_s": 0.02, "device": "cpu", "scene": scene, "sensors": SENSORS,
                      "render": {"lighting": {"mode": lighting}}}):  # fmt: skip
            pass
    everything = RenderTerms(textured=True, emissive=True, baked=True, supersampled=True)
    for terms in (
        everything,
        everything._replace(finest_level=True),
        everything._replace(finest_level=True, nearest_texel=True),
        everything._replace(bodies=True),
        everything._replace(bodies=True, timed=True),
        everything._replace(bodies=True, baked=False),
        everything._replace(worlds=True, bodies=True),
        everything._replace(worlds=True, world_scenes=True, world_lenses=True),
        everything._replace(candidate_group=4, bodies=True),
        everything._replace(candidate_group=4, worlds=True, supersampled=False),
    ):
        raycast_kernel(OUTPUTS, terms)
        fallback_kernel(OUTPUTS, terms)
        antialiasing_kernels(OUTPUTS, terms, is_cuda=True)
    quads, worlds = (
        everything._replace(quads=True),
        {"worlds": True, "world_scenes": True, "world_lenses": True},
    )
    for terms in (quads, quads._replace(bodies=True, timed=True, **worlds)):
        raycast_kernel(("log_radiance", "rgb"), terms)
    frustum_search_kernel(BLOCK)
    for pixel in ([], TERMS[:-1], TERMS, *([term] for term in TERMS)):
        make_noisy_scan(frozenset(pixel))
    make_begin(signal_terms(TERMS))
    for errors in ((), IMU_TERMS):
        make_imu(frozenset(errors))
    make_flight(frozenset(VEHICLE_TERMS), record_state)
    mode_kernel("path", frozenset(AIR_TERMS))
    for name in ("crazyflie", "hummingbird", "racer"):
        vehicle = Multirotor(preset(name), device="cpu")
        vehicle.advance(1_000_000)
        for mode in MODES:
            paths = hover(HoverConfig(), position=[0.0, 0.0, 1.0]) if mode == "path" else None
            Controller(mode, vehicle.config, device="cpu", paths=paths).update(vehicle.arrays)


def build(module: wp.Module) -> tuple[str, float]:
    """Build one module for all architectures; raise if that fails."""
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(module, arch=list(ARCHITECTURES), module_dir=folder)
        made = [path for path in Path(folder).rglob("*") if path.suffix in (".ptx", ".cubin")]
        if len(made) < len(ARCHITECTURES):
            raise RuntimeError(f"{module.name}: expected {len(ARCHITECTURES)} binaries, got {len(made)}")
    return module.name, time.perf_counter() - begin


def is_on_cpu(kernel: wp.Kernel) -> bool:
    """Return whether a kernel casts rays by Embree, as only CPUs do, in native code of their compiler."""
    terms = inspect.getclosurevars(kernel.func).nonlocals.get("terms")
    return isinstance(terms, RenderTerms) and bool(terms.embree)


def main() -> int:
    """Build all modules of the package; return the exit status."""
    wp.config.log_level = wp.LOG_WARNING
    make_kernels()
    kernels = [thing for thing in gc.get_objects() if isinstance(thing, wp.Kernel)]
    ours = [kernel for kernel in kernels if kernel.func.__module__.startswith("neurosim_core")]
    modules = {kernel.module.name: kernel.module for kernel in ours if not is_on_cpu(kernel)}
    failed = 0
    with ThreadPoolExecutor(2) as pool:
        longest_first = sorted(modules, key=lambda name: (".integrator." not in name, name))
        jobs = {name: pool.submit(build, modules[name]) for name in longest_first}
    for name, job in jobs.items():
        error = job.exception()
        failed += error is not None
        print(f"{name}: {error or f'{job.result()[1]:.1f} s'}")
    print(f"{len(modules) - failed} modules built for {ARCHITECTURES}, {failed} failed")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
