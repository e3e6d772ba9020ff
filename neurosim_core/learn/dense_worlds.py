"""Windows of many worlds that fly together: voxels and what is true stay on the device."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Generator, Iterator, Mapping
from typing import Any

import numpy as np
import warp as wp

from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.learn.dense_flights import PathPlanner
from neurosim_core.learn.dense_train import Windows
from neurosim_core.learn.heads import Head
from neurosim_core.learn.surfaces import Counts, EventSurface, SurfaceConfig, VoxelGrid
from neurosim_core.sim.model import Model, make_model, refit
from neurosim_core.sim.simulation import Simulation

_SCENES = 8
_PATHS_MAX = 64
"""Most paths that are flown at a time; further worlds share them."""
_CONTROL_HZ = 80.0
"""About how often the controller acts where renders are rarer."""


def world_windows(
    settings: Mapping[str, Any],
    head: Head,
    *,
    worlds: int,
    bins: int,
    window_s: float,
    renders: int | None = None,
    threshold_spread: float = 0.0,
) -> Generator[Windows]:
    """Yield the windows of all worlds, one of each at a time, for ever; the next overwrites their tensors.

    Generated scenes are eight, of the seeds from that of the settings on. When a flight is over, all worlds
    fly other paths with other thresholds, and one of these scenes has been replaced by the next. Other
    processes plan these paths while the worlds fly; close the generator to end them. `window_s`: length of a
    window [s]. `renders`: of the event camera in a window; None: as the settings say. `threshold_spread`:
    each world draws its thresholds up to this share above the nominal ones, or below.
    """
    base = load_config(dict(settings) if renders is None else _with_renders(settings, renders / window_s))
    steps = round(window_s * base.control.rate_hz)
    if steps < 1 or abs(steps / base.control.rate_hz - window_s) > 1e-9:
        raise ValueError(f"windows must be whole periods of control.rate_hz, got {window_s} s")
    window_ns, first = round(1e9 * window_s), int(settings["seed"])
    camera: Any = base.sensors["events"]
    surfaces: list[SurfaceConfig] = [VoxelGrid(bins=bins), *([Counts()] if head.field == "events" else [])]
    drawn = [
        EventSurface(
            config, world_count=worlds, width=camera.lens.width, height=camera.lens.height, step_s=window_s,
            device=base.device,
        )
        for config in surfaces
    ]  # fmt: skip
    end_ns: Any = wp.zeros(worlds, dtype=wp.int64, device=base.device)
    for number, flown in enumerate(_flights(base, first, worlds, threshold_spread)):
        names = [f"{number} {world}" for world in range(worlds)]
        for start_ns in range(0, flown.model.duration_ns - window_ns + 1, window_ns):
            stamp_ns = start_ns + window_ns
            end_ns.fill_(stamp_ns)
            for _ in range(steps):
                observation = flown.rollout(1)
                for surface in drawn:
                    surface.add(observation.frames["events"], end_ns)
            for surface in drawn:
                surface.show(end_ns)
            value = drawn[1].array if len(drawn) > 1 else observation.images[head.field]
            target = head.target(wp.to_torch(value))
            stamps = [start_ns] * worlds, [stamp_ns] * worlds
            yield Windows(names, *stamps, wp.to_torch(drawn[0].array), target)


def _with_renders(settings: Mapping[str, Any], rate_hz: float) -> dict[str, Any]:
    sensors = dict(settings["sensors"])
    sensors["events"] = {**sensors["events"], "sampling_rate_hz": rate_hz}
    control = {"rate_hz": rate_hz * max(1, round(_CONTROL_HZ / rate_hz))}
    return {**settings, "sensors": sensors, "control": control}


def _flights(base: SimulationConfig, first: int, worlds: int, spread: float) -> Iterator[Simulation]:
    """Yield worlds at the begin of their next flight, for ever."""
    count = _SCENES if hasattr(base.scene, "seed") else 1
    scenes: list[Model] = []

    def paths_of(number: int) -> list[SimulationConfig]:
        """Return the settings that each path of a flight is planned by."""
        configs = []
        for k in range(min(worlds, _PATHS_MAX)):
            path = base.path.model_copy(update={"seed": first + number * _PATHS_MAX + k})
            seed = {"seed": first + number + k % count} if count > 1 else {}
            scene = base.scene.model_copy(update=seed)
            configs.append(base.model_copy(update={"scene": scene, "path": path}))
        return configs

    with PathPlanner() as planner:
        planner.begin(paths_of(0))
        for number in itertools.count():
            configs = paths_of(number)
            scenes += [make_model(config) for config in configs[len(scenes) : count]]
            paths = planner.result()
            planner.begin(paths_of(number + 1))
            models = [
                refit(dataclasses.replace(scenes[k % len(scenes)], path=path), config)
                for k, (config, path) in enumerate(zip(configs, paths, strict=True))
            ]
            yield _simulate(base, models, worlds, first + number * _PATHS_MAX, spread)
            del scenes[: count > 1]


def _simulate(
    base: SimulationConfig, models: list[Model], worlds: int, seed: int, spread: float
) -> Simulation:
    """Return worlds at the begin of the paths of these models."""
    pixel = getattr(base.sensors["events"], "pixel")  # noqa: B009 (of any event camera)
    drawn = (1.0 + spread) ** np.random.default_rng(seed).uniform(-1.0, 1.0, (2, worlds))
    parameters = {
        f"events.{name}": getattr(pixel, name) * factor
        for name, factor in zip(("threshold_on", "threshold_off"), drawn, strict=True)
    }
    # Voxels and counts are sums: the order of events does not matter.
    flown = Simulation(
        base,
        worlds=worlds,
        models=models,
        seeds=seed,
        parameters=parameters if spread else None,
        sorted=False,
    )
    flown.reset()
    return flown
