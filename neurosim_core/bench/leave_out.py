"""What a scene does not need is left out: kernels, memory, libraries and time of runs, small and large.

Each case flies in a process of its own, where launches, allocations and imports are counted
(`leave_out_probe`). Kernels that leave terms out are compared with ones that have them with coefficients of
zero.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neurosim_core.bench.leave_out_cases import make_cases, plain_room, textured_room
from neurosim_core.bench.leave_out_chapter import leave_out_chapter
from neurosim_core.bench.leave_out_probe import Probe
from neurosim_core.bench.leave_out_result import EQUAL_BAR, Difference, LeaveOutResult

__all__ = ["leave_out_chapter", "measure_leave_out"]

_TIMEOUT_S = 600.0


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
        cases = make_cases(*rooms, quick)
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
