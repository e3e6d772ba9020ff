"""How fast whole steps are, where their time goes, and how far that is from what the device can do.

Everything is measured on one device in one run. A row that fails says why, and the next one is measured.
"""

from __future__ import annotations

import dataclasses
import gc
import hashlib
import logging
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.bench import frame_loops
from neurosim_core.bench import throughput_stages as stages
from neurosim_core.bench.machine import processor
from neurosim_core.bench.step import flight_settings, fly_blind, time_steps
from neurosim_core.bench.throughput_chapter import throughput_chapter
from neurosim_core.bench.throughput_result import (
    ADAPTIVE,
    BARE_CAST,
    EXACT,
    LOOP,
    LOOP_AT_ONCE,
    PHYSICS_ALONE,
    RAYS_ALONE,
    READ_ALONE,
    RENDER_ALONE,
    SCAN,
    SCAN_ALONE,
    Agreement,
    Comparison,
    Part,
    Roofline,
    Split,
    StepRow,
    Study,
    ThroughputResult,
)
from neurosim_core.bench.throughput_scene import hall
from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.packets import Events
from neurosim_core.render.launch import core_count
from neurosim_core.render.renderer import upload_scene
from neurosim_core.render.scene_arrays import SceneArrays
from neurosim_core.simulation import Model, make_model, make_state, refit, run_model

__all__ = ["measure_throughput", "throughput_chapter"]

_log = logging.getLogger(__name__)
_T = TypeVar("_T")

RATE_HZ = 1000.0
"""Steps per simulated second [Hz]."""
MAX_DISPLACEMENT_PX = 0.5
"""Of adaptive rows [px]."""
_BEGIN_S = 1.0
"""From here on the flight is looked at: it begins at rest [s]."""


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """What is measured, and for how long."""

    resolutions: tuple[tuple[int, int], ...]
    launches: tuple[int, ...]
    launch_size: tuple[int, int]
    triangles: tuple[int, ...]
    instants: int
    warm_up_batches: int
    repetitions: int
    repetition_s: float
    alone_s: float
    split_batches: int
    megabytes: int
    loud_size: tuple[int, int]
    small: int
    """Width of the pictures that are compared byte by byte [px]."""
    duration_s: float


_VGA, _HD = (640, 480), (1280, 720)
_ON_CUDA = _Plan(
    resolutions=((128, 128), (346, 260), _VGA, _HD),
    launches=(1, 4, 16, 32, 64),
    launch_size=_VGA,
    triangles=(20_000, 100_000, 500_000, 2_000_000),
    instants=32,
    warm_up_batches=64,  # each pattern of launches is launched, then recorded, then replayed
    repetitions=5,
    repetition_s=0.4,
    alone_s=0.4,
    split_batches=100,
    megabytes=512,
    loud_size=_VGA,
    small=128,
    duration_s=40.0,
)
_ON_CPU = dataclasses.replace(
    _ON_CUDA,
    launch_size=(346, 260),
    launches=(1, 4, 16, 64),
    triangles=(20_000, 100_000, 500_000),
    instants=16,
    warm_up_batches=1,
    repetitions=3,
    repetition_s=0.8,
    split_batches=6,
    megabytes=128,
    loud_size=(346, 260),
    duration_s=12.0,
)
_QUICK = dataclasses.replace(
    _ON_CPU,
    resolutions=((48, 32), (96, 64)),
    launches=(1, 4),
    launch_size=(48, 32),
    triangles=(2_000, 8_000),
    instants=4,
    warm_up_batches=1,
    repetitions=2,
    repetition_s=0.05,
    alone_s=0.05,
    split_batches=3,
    megabytes=16,
    loud_size=(48, 32),
    small=48,
    duration_s=3.0,
)


def measure_throughput(
    *,
    quick: bool = False,
    device: str = "auto",
    scene: Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> ThroughputResult:
    """Measure all of it: about two minutes on a CPU, and less than six on a large GPU.

    Args:
        quick: Tiny pictures and scenes; the figures mean nothing.
        device: Where to compute.
        scene: What to fly in; None: the generated apartment, and no bar of the house is judged.
        progress: Told what is measured next.

    Raises:
        ValueError: The device is not there, or the scene cannot be used.
    """
    tell = progress or (lambda _: None)
    device = ("cuda:0" if wp.get_cuda_device_count() else "cpu") if device == "auto" else device
    plan = _QUICK if quick else _ON_CUDA if wp.get_device(device).is_cuda else _ON_CPU
    return _Study(plan, device, scene, tell).measure(quick)


class _Study:
    """One run: the models that its rows share, and what to tell."""

    def __init__(self, plan: _Plan, device: str, scene: Path | None, tell: Callable[[str], None]) -> None:
        self._plan = plan
        self._device = device
        self._scene = scene
        self._tell = tell
        tell("the scene, its light and the path")
        self._hall: Model | None = None
        """The first hall, and the path that is flown in all of them."""
        self._base = make_model(load_config(self._settings(plan.resolutions[0], plan.instants)))

    @property
    def _is_cuda(self) -> bool:
        return bool(wp.get_device(self._device).is_cuda)

    def _settings(
        self,
        size: tuple[int, int],
        instants: int,
        *,
        max_displacement_px: float | None = None,
        render: dict[str, Any] | None = None,
    ) -> dict[str, Any]:
        settings = flight_settings(
            width=size[0],
            height=size[1],
            rate_hz=RATE_HZ,
            instants=instants,
            duration_s=self._plan.duration_s,
            device=self._device,
            scene=self._scene,
            max_displacement_px=max_displacement_px,
        )
        settings["render"].update(render or {})
        if self._scene is None and self._plan is _QUICK:
            settings["scene"] = {"kind": "apartment", "rooms": 1}
        return settings

    def _model(self, size: tuple[int, int], instants: int, **options: Any) -> Model:
        return refit(self._base, load_config(self._settings(size, instants, **options)))

    def measure(self, quick: bool) -> ThroughputResult:
        """Measure one thing after the other."""
        plan = self._plan
        rows = [*self._resolutions(), *self._launches(), *self._triangles()]
        self._tell("where the time goes")
        split, split_failure = self._try(self._split)
        sizes = dict.fromkeys((plan.launch_size, plan.loud_size))
        views = {size: self._try(partial(self._views, size)) for size in sizes}
        roofline, scan = self._roofline(*views[plan.launch_size], rows)
        self._tell("one render and one scan per call")
        loops, loop_failure = self._with(
            views[plan.launch_size], lambda seen: frame_loops.compare_loops(seen, seconds=plan.alone_s)
        )
        self._tell("events to the host")
        events_per_s, events_failure = self._with(
            views[plan.loud_size], lambda seen: stages.events_to_host_per_s(seen, seconds=plan.alone_s)
        )
        return ThroughputResult(
            device=str(wp.get_device(self._device).name) if self._is_cuda else processor(),
            is_cuda=self._is_cuda,
            quick=quick,
            core_count=core_count(),
            scene=self._base.scene.name,
            scene_triangles=len(self._base.scene.faces),
            is_house=self._scene is not None,
            rate_hz=RATE_HZ,
            max_displacement_px=MAX_DISPLACEMENT_PX,
            rows=tuple(rows),
            split=split,
            split_failure=split_failure,
            roofline=roofline,
            scan=scan,
            loop=loops[0] if loops else Comparison(name=LOOP, failure=loop_failure),
            loop_at_once=loops[1] if loops else Comparison(name=LOOP_AT_ONCE, failure=loop_failure),
            events_per_s=events_per_s,
            events_failure=events_failure,
            agreements=tuple(self._agreements()),
        )

    def _try(self, measure: Callable[[], _T]) -> tuple[_T | None, str]:
        """Return what was measured, or why it was not: nothing ends the run."""
        try:
            return measure(), ""
        except Exception as error:  # whatever it is, its row says so
            _log.warning("not measured: %s", error, exc_info=_log.isEnabledFor(logging.DEBUG))
            return None, " ".join("".join(traceback.format_exception_only(error)).split())
        finally:
            gc.collect()  # states refer to themselves, and hold memory of the device

    def _with(
        self, views: tuple[stages.Views | None, str], measure: Callable[[stages.Views], _T]
    ) -> tuple[_T | None, str]:
        seen, failure = views
        return (None, failure) if seen is None else self._try(lambda: measure(seen))

    def _views(self, size: tuple[int, int]) -> stages.Views:
        return stages.Views(self._model(size, self._plan.instants), _BEGIN_S)

    def _row(self, study: Study, mode: str, make: Callable[[], Model], **facts: Any) -> StepRow:
        """Return a row of whole steps; a model that cannot be made or flown is a row that says why."""
        plan = self._plan
        instants = facts["instants"]
        steps_left = int((plan.duration_s - _BEGIN_S) * RATE_HZ) - (plan.warm_up_batches + 8) * instants
        times, failure = self._try(
            lambda: time_steps(
                make(),
                warm_up_count=plan.warm_up_batches * instants,
                step_count=steps_left // plan.repetitions - 8 * instants,  # adaptive batches are longer
                repetitions=plan.repetitions,
                repetition_s=plan.repetition_s,
                begin_s=_BEGIN_S,
            )
        )
        if times is None:
            return StepRow(study=study, mode=mode, failure=failure, **facts)
        return StepRow(
            study=study,
            mode=mode,
            **{**facts, "scene": times.scene, "triangles": times.triangles},
            steps_per_s=times.median,
            slowest_per_s=min(times.steps_per_s),
            fastest_per_s=max(times.steps_per_s),
            renders_per_step=times.renders_per_step,
            events_per_step=times.events_per_step,
            real_time_factor=times.real_time_factor,
        )

    def _resolutions(self) -> Iterator[StepRow]:
        plan = self._plan
        modes: dict[str, dict[str, Any]] = {EXACT: {}, ADAPTIVE: {"max_displacement_px": MAX_DISPLACEMENT_PX}}
        for mode, options in modes.items():
            for size in plan.resolutions:
                self._tell(f"whole steps, {mode}, {size[0]}x{size[1]}")
                yield self._row(
                    "resolution", mode, partial(self._model, size, plan.instants, **options),
                    scene=self._base.scene.name, width=size[0], height=size[1], instants=plan.instants,
                )  # fmt: skip
        if not self._is_cuda:
            return
        for size in plan.resolutions:
            self._tell(f"whole steps, {RAYS_ALONE}, {size[0]}x{size[1]}")
            yield self._row(
                "resolution", RAYS_ALONE, partial(self._without_walks, size),
                scene=self._base.scene.name, width=size[0], height=size[1], instants=plan.instants,
            )  # fmt: skip

    def _without_walks(self, size: tuple[int, int]) -> Model:
        """Return the model whose rays share no walks; light stays as it is."""
        config = load_config(self._settings(size, self._plan.instants, render={"candidate_lists": None}))
        arrays = cast(SceneArrays, self._base.scene_on_device)
        lit = dataclasses.replace(arrays, config=config.render)
        return refit(dataclasses.replace(self._base, config=config, scene_on_device=lit), config)

    def _launches(self) -> Iterator[StepRow]:
        size = self._plan.launch_size
        for instants in self._plan.launches:
            self._tell(f"whole steps, {instants} renders per launch")
            yield self._row(
                "launch", EXACT, partial(self._model, size, instants),
                scene=self._base.scene.name, width=size[0], height=size[1], instants=instants,
            )  # fmt: skip

    def _triangles(self) -> Iterator[StepRow]:
        """Fly on one path through a hall that is cut into more and more triangles."""
        size, instants = self._plan.launch_size, self._plan.instants
        config = load_config(self._settings(size, instants))
        for count in self._plan.triangles:
            self._tell(f"whole steps in a hall of {count:,} triangles")

            def make(count: int = count) -> Model:
                scene = hall(count)
                if self._hall is None:
                    self._hall = make_model(config, scene=scene)
                    return self._hall
                uploaded = upload_scene(scene, config.render, device=self._device)
                return dataclasses.replace(self._hall, scene=scene, scene_on_device=uploaded)

            yield self._row(
                "triangles", EXACT, make,
                scene="hall", width=size[0], height=size[1], instants=instants, triangles=count,
            )  # fmt: skip

    def _split(self) -> Split:
        model = self._model(self._plan.launch_size, self._plan.instants)
        return stages.measure_split(model, batch_count=self._plan.split_batches, begin_s=_BEGIN_S)

    def _roofline(
        self, seen: stages.Views | None, failure: str, rows: list[StepRow]
    ) -> tuple[Roofline, Comparison]:
        """Return each part alone beside the whole step, and our scan beside the naive one."""
        plan, views = self._plan, (seen, failure)
        seconds = plan.alone_s
        scan_events: list[float] = []

        def scan(views: stages.Views) -> Part:
            part, events = stages.scan_alone(views, seconds=seconds)
            scan_events.append(events)
            return part

        parts = []
        for name, measure in (
            (BARE_CAST, lambda v: stages.cast_alone(v, seconds=seconds)),
            (RENDER_ALONE, lambda v: stages.render_alone(v, seconds=seconds)),
            (SCAN_ALONE, scan),
            (READ_ALONE, lambda v: stages.read_alone(v, seconds=seconds)),
            (PHYSICS_ALONE, lambda v: stages.physics_alone(v.model, seconds=seconds)),
        ):
            self._tell(f"{name} alone")
            part, why = self._with(views, measure)
            parts.append(part or Part(name=name, failure=why))
        self._tell("copies")
        copy, _ = self._try(
            lambda: stages.copy_gigabytes_per_s(self._device, megabytes=plan.megabytes, seconds=seconds)
        )
        host = None
        if self._is_cuda:
            host, _ = self._try(
                lambda: stages.host_gigabytes_per_s(self._device, megabytes=plan.megabytes, seconds=seconds)
            )
        width, height = plan.launch_size
        same = (row for row in rows if row.study == "launch" and row.instants == plan.instants)
        steps_per_s = next((row.steps_per_s for row in same), None)
        roofline = Roofline(
            width=width,
            height=height,
            instants=plan.instants,
            step_us=None if steps_per_s is None else 1e6 / steps_per_s,
            parts=tuple(parts),
            copy_gigabytes_per_s=copy,
            host_gigabytes_per_s=host,
        )
        self._tell("the naive event camera")
        scan_us = next((part.per_step_us for part in parts if part.name == SCAN_ALONE), None)
        if scan_us is None:
            return roofline, Comparison(name=SCAN, failure="our scan was not measured")
        compared, why = self._with(
            views, lambda v: stages.compare_scans(v, 1e6 / scan_us, scan_events[0], seconds=seconds)
        )
        return roofline, compared or Comparison(
            name=SCAN, ours_per_s=1e6 / scan_us, ours_events=scan_events[0], failure=why
        )

    def _agreements(self) -> Iterator[Agreement]:
        """Compare a flight with itself, and with another traversal or device."""
        self._tell("the same flight twice")
        yield self._compare("the same flight again", self._device, {}, same_bytes=True)
        other = "cpu" if self._is_cuda else self._device
        if self._is_cuda or self._uses_embree:
            self._tell("the same flight elsewhere")
            what = "CPU against GPU" if self._is_cuda else "rays by Embree against rays by Warp"
            render = {"cpu_traversal": "warp"} if not self._is_cuda else {}
            yield self._compare(what, other, render, same_bytes=False)

    @property
    def _uses_embree(self) -> bool:
        return bool(getattr(getattr(self._base.scene_on_device, "terms", None), "embree", 0))

    def _compare(self, what: str, other: str, render: dict[str, Any], *, same_bytes: bool) -> Agreement:
        def compare() -> Agreement:
            if self._hall is None:
                raise RuntimeError("there is no hall to fly in")
            size = (self._plan.small, 3 * self._plan.small // 4)
            settings = self._settings(size, self._plan.instants)
            again = load_config({**settings, "device": other, "render": {**settings["render"], **render}})
            seen = [
                _seen(refit(self._hall, load_config(settings))),
                _seen(self._twin(self._hall, other, again)),
            ]
            difference = np.abs(seen[0].log_radiance.astype(np.float64) - seen[1].log_radiance)
            return Agreement(
                what=what,
                same=seen[0].digest == seen[1].digest if same_bytes else None,
                event_counts=(seen[0].event_count, seen[1].event_count),
                rms=float(np.sqrt(np.mean(difference**2))),
                largest=float(difference.max()),
                beyond_share=float(np.mean(difference > 1e-3)),
            )

        found, failure = self._try(compare)
        return found or Agreement(what=what, failure=failure)

    def _twin(self, model: Model, device: str, config: SimulationConfig) -> Model:
        """Return the model of the same flight, its scene uploaded anew, and on another device if need be."""
        if device != self._device:
            return dataclasses.replace(make_model(config, scene=model.scene), path=model.path)
        uploaded = upload_scene(model.scene, config.render, device=device)
        return refit(dataclasses.replace(model, scene_on_device=uploaded), config)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    digest: str
    event_count: int
    log_radiance: NDArray[np.float32]
    """Of the last launch, shape [K, H, W]."""


def _seen(model: Model) -> _Seen:
    """Fly for a little, and return what came of it."""
    state = make_state(model)
    fly_blind(model, state, _BEGIN_S)
    digest, count = hashlib.sha256(), 0
    packets = run_model(model, state)
    for _ in range(8):
        packet = next(packets)
        assert isinstance(packet, Events)
        for column in packet.numpy():
            digest.update(np.ascontiguousarray(column).tobytes())
        count += len(packet.numpy().t)
    (seeing,) = state.casts
    batch = seeing.renderers[(state.looked_count - 1) % len(state.lanes)].log_radiance
    return _Seen(digest=digest.hexdigest(), event_count=count, log_radiance=batch.numpy())
