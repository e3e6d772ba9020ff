# mypy: disable-error-code="index,attr-defined,misc,no-untyped-call,arg-type,operator,untyped-decorator"
# mypy: disable-error-code="call-overload,union-attr"
"""Rays that share a walk through the tree: whether anything is seen otherwise, what is saved, and where not.

The claim is that nothing is: so pictures are compared bit by bit, and events one by one, with rays that each
walk by themselves, in a slow and in a fast part of a flight.
"""

# No `from __future__ import annotations`: Warp needs the annotations of kernels as objects.

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.bench.chapter import Bar, Chapter, Table
from neurosim_core.bench.event_matching import match_events
from neurosim_core.bench.flown import SLOW_SHARE, Flown, fly
from neurosim_core.clock import Rate
from neurosim_core.config import load_config
from neurosim_core.packets import EventArrays
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.candidate_data import UNRESOLVED, CandidateListData
from neurosim_core.render.candidate_intersection import candidate_intersector
from neurosim_core.render.config import CandidateListConfig, LightingConfig, RenderConfig
from neurosim_core.render.embree import EmbreeError
from neurosim_core.render.ray_intersection import FAR_M
from neurosim_core.render.scene_arrays import SceneArrays, upload_scene
from neurosim_core.render.warp_renderer import WarpRenderer
from neurosim_core.sensors.events import EventCamera, EventCameraConfig
from neurosim_core.sensors.rig import EventSensorConfig

_K = 16
_FAST_SHARE = SLOW_SHARE + 0.03
_PARTS = {"slow": 0.3, "fast": _FAST_SHARE}
"""Parts of the flight, and the share of it at which each begins."""


@dataclass(frozen=True, kw_only=True)
class WalkCost:
    """What shared walks did in a part of a flight."""

    part: str
    """`slow`: a drift; `fast`: a roll of 640 degrees a second."""
    instants: int
    """Instants that share a walk."""
    list_mean: float
    """Triangles of a list, of those that are not too long."""
    too_long: float
    """Share of the tiles whose list is too long."""
    asked: float
    """Share of the rays that walk by themselves after all, those of such tiles included."""
    differing_count: int
    """Pixels whose log radiance has other bits than with rays that each walk by themselves."""
    pixel_count: int
    """Pixels that were compared."""
    event_count: int
    """Events with rays that each walk by themselves."""
    other_event_count: int
    """Events that are missing, and events that are there in addition."""
    walk_s: float
    """Time of the walks, per render [s]."""
    together_s: float
    """Time of a render, walk included [s]."""
    alone_s: float
    """The same where each ray walks by itself [s]."""
    embree_s: float
    """The same by Embree [s]; nan on CUDA and where it is not installed."""


@dataclass(frozen=True, kw_only=True)
class WalkResult:
    """What `measure_shared_walk` found."""

    device: str
    quick: bool
    scene: str
    triangle_count: int
    """As cast: light is baked, so large ones are split."""
    width: int
    height: int
    costs: tuple[WalkCost, ...]


_find_face = candidate_intersector(1)


@wp.kernel(enable_backward=False)
def _count_asked(
    # Model:
    mesh: wp.uint64,
    rays: wp.array2d[wp.vec4],
    width: int,
    height: int,
    # In:
    instant_count: int,
    p_WC: wp.array[wp.vec3],
    q_WC: wp.array[wp.quat],
    data: CandidateListData,
    # Out:
    asked_out: wp.array[int],
) -> None:
    index = wp.tid()
    in_tile = index % 64
    instant = (index // 64) % instant_count
    tile = index // 64 // instant_count
    tile_columns = (width + 7) // 8
    col = (tile % tile_columns) * 8 + in_tile % 8
    row = (tile // tile_columns) * 8 + in_tile // 8
    outside = col >= width or row >= height
    ray_C = rays[0, wp.min(row, height - 1) * width + wp.min(col, width - 1)]
    walk = instant // data.instants
    found = _find_face(
        mesh,
        data.faces,
        (walk * data.bounds.shape[0] + tile) * data.limit,
        data.count[walk, tile],
        data.reach[walk, tile],
        FAR_M,
        data.bounds[tile],
        p_WC,
        q_WC,
        instant,
        1,
        wp.vec3(ray_C[0], ray_C[1], ray_C[2]),
    )
    if found[0] == wp.static(UNRESOLVED) and not outside:
        wp.atomic_add(asked_out, instant, 1)


class _Eye:
    """A renderer and the poses of a part of a flight."""

    def __init__(self, flown: Flown, arrays: SceneArrays, lens: PinholeConfig) -> None:
        self._flown, self.arrays, self.device = flown, arrays, arrays.device
        self.renderer = WarpRenderer(arrays, lens, outputs=("log_radiance",), instant_count=_K)
        self.p_WC = wp.zeros(_K, dtype=wp.vec3, device=self.device)
        self.q_WC = wp.zeros(_K, dtype=wp.quat, device=self.device)
        self._no_image = wp.full(_K, value=-1, dtype=int, device=self.device)

    def place(self, first: int) -> None:
        """Go to the K ticks from `first` on."""
        mount = EventSensorConfig().mount
        self._flown.trace.camera_poses(
            wp.array(np.arange(first, first + _K, dtype=np.int32), dtype=int, device=self.device),
            count=_K,
            p_BC=wp.vec3d(*mount.position_m),
            q_BC=wp.quatd(*mount.optical_quaternion()),
            p_WC=self.p_WC,
            q_WC=self.q_WC,
        )

    def look(self) -> NDArray[np.float32]:
        """Render, and return a copy of log radiance."""
        self.renderer.render(self.p_WC, self.q_WC, self._no_image, instant_count=_K)
        log_radiance: Any = self.renderer.log_radiance
        return np.array(log_radiance.numpy())

    def seconds(self, launch: Callable[[], object]) -> float:
        """Return how long a launch takes [s]."""
        wp.synchronize_device(self.device)
        begin = time.perf_counter()
        launch()
        wp.synchronize_device(self.device)
        return time.perf_counter() - begin

    def time_renders(self, repetitions: int) -> float:
        """Return the time of a render [s], the best of some."""
        render = self.renderer.render
        return (
            min(
                self.seconds(lambda: render(self.p_WC, self.q_WC, self._no_image, instant_count=_K))
                for _ in range(repetitions)
            )
            / _K
        )


def measure_shared_walk(
    *,
    quick: bool = False,
    scene: Path | None = None,
    device: str = "auto",
    width: int | None = None,
    height: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> WalkResult:
    """Look at two parts of a flight with and without shared walks.

    Args:
        quick: A small picture, a short look, few settings.
        scene: A mesh file; None: the generated apartment.
        device: Where to render.
        width: Columns of the camera [px]; None: 346, if quick 64.
        height: Rows of the camera [px]; None: 260, if quick 48.
        progress: Told what is measured next.
    """
    tell = progress or (lambda _: None)
    lens = PinholeConfig(
        width=width or (64 if quick else 346), height=height or (48 if quick else 260), horizontal_fov_rad=1.5
    )
    tell("the flight")
    settings: dict[str, Any] = {"duration_s": 0.8 if quick else 4.0, "device": device}
    if scene is not None:
        settings["scene"] = {"kind": "mesh", "file": str(scene.resolve())}
    elif quick:
        settings["scene"] = {"kind": "apartment", "rooms": 1}
    flown = fly(load_config(settings), Rate(1000.0))
    tell("the light")
    eyes = _eyes(flown, lens, (1, 16) if quick else (1, 2, 4, 8, 16), quick)
    costs = []
    for part, share in _PARTS.items():
        first = int(share * len(flown.stamps_ns))
        begins = range(first, first + (1 if quick else 4) * _K, _K)
        tell(f"each ray alone in the {part} part")
        alone = _look(flown, eyes["alone"], begins)
        for instants in (key for key in eyes if isinstance(key, int)):
            tell(f"{instants} instants in the {part} part")
            costs.append(_measure(flown, eyes, part, instants, begins, alone))
    return WalkResult(
        device=str(wp.get_device(flown.model.device).name),
        quick=quick,
        scene=flown.model.scene.name,
        triangle_count=eyes["alone"].arrays.mesh.indices.shape[0] // 3,
        width=lens.width,
        height=lens.height,
        costs=tuple(costs),
    )


def _eyes(flown: Flown, lens: PinholeConfig, instants: tuple[int, ...], quick: bool) -> dict[str | int, _Eye]:
    """Return renderers: alone, by Embree if it is there, and of so many instants to a walk."""
    light = LightingConfig(mode="unshadowed" if quick else "baked", ambient_ray_count=4, shadow_ray_count=1)
    plain = RenderConfig(lighting=light, exposure=1.0)
    configs: dict[str | int, dict[str, Any]] = {"alone": {"cpu_traversal": "warp", "candidate_lists": None}}
    if wp.get_device(flown.model.device).is_cpu:
        configs["embree"] = {"cpu_traversal": "embree"}
    configs |= {count: {"candidate_lists": CandidateListConfig(instants=count)} for count in instants}
    eyes: dict[str | int, _Eye] = {}
    for name, changes in configs.items():
        try:
            arrays = upload_scene(flown.model.scene, plain.model_copy(update=changes), flown.model.device)
        except EmbreeError:
            continue
        eyes[name] = _Eye(flown, arrays, lens)
    return eyes


class _Seen(NamedTuple):
    """What a camera saw of a part of a flight."""

    log_radiance: NDArray[np.float32]
    """Shape [launch, K, H, W]."""
    events: EventArrays
    list_lengths: NDArray[np.int32]
    """Of all launches; empty if each ray walks by itself."""
    asked: float
    """Share of the rays whose lists do not tell."""
    walk_s: float
    """Time of the walks, per render [s]."""


def _look(flown: Flown, eye: _Eye, begins: Sequence[int]) -> _Seen:
    """Render the launches that begin at some ticks, and find the events."""
    _, height, width = eye.renderer.log_radiance.shape
    camera = EventCamera(EventCameraConfig(), width=width, height=height, device=eye.device)
    packets: list[EventArrays] = []
    frames, lengths, asked, walk_s = [], [], [0.0], [0.0]
    for first in begins:
        eye.place(first)
        frames.append(eye.look())
        stamps_ns = flown.stamps_ns[first : first + _K].tolist()
        seen = int(not packets)  # by `reset`
        if seen:
            camera.reset(frames[0][0], stamps_ns[0])
        packets.append(camera.feed(frames[-1][seen:], stamps_ns[seen:]).numpy())
        if eye.renderer.candidates is not None:
            lengths.append(eye.renderer.candidates.data.count.numpy().reshape(-1).copy())
            asked.append(_asked(eye, eye.renderer.candidates.data))
            walk_s.append(_time_walk(eye))
    events = EventArrays(*(np.concatenate(column) for column in zip(*packets, strict=True)))
    known = np.concatenate([np.zeros(0, np.int32), *lengths])
    return _Seen(
        np.stack(frames), events, known, float(np.mean(asked[1:] or asked)), min(walk_s[1:] or walk_s)
    )


def _measure(
    flown: Flown, eyes: dict[str | int, _Eye], part: str, instants: int, begins: Sequence[int], alone: _Seen
) -> WalkCost:
    together = _look(flown, eyes[instants], begins)
    matching = match_events(alone.events, together.events, tolerance_us=0)
    times = {}
    for name in ("alone", instants, "embree"):
        if name in eyes:
            eyes[name].place(begins[0])
            times[name] = eyes[name].time_renders(3)
    lengths = together.list_lengths
    return WalkCost(
        part=part,
        instants=instants,
        list_mean=float(lengths[lengths >= 0].mean()) if (lengths >= 0).any() else 0.0,
        too_long=float((lengths < 0).mean()),
        asked=together.asked,
        differing_count=int((alone.log_radiance != together.log_radiance).sum()),
        pixel_count=alone.log_radiance.size,
        event_count=len(alone.events.t),
        other_event_count=len(matching.missing) + len(matching.spurious),
        walk_s=together.walk_s,
        together_s=times[instants],
        alone_s=times["alone"],
        embree_s=times.get("embree", float("nan")),
    )


def _asked(eye: _Eye, data: CandidateListData) -> float:
    """Return the share of the rays of the last look whose lists do not tell."""
    _, height, width = eye.renderer.log_radiance.shape
    counts = wp.zeros(_K, dtype=int, device=eye.device)
    wp.launch(
        _count_asked,
        dim=data.bounds.shape[0] * _K * 64,
        inputs=[
            eye.arrays.mesh.id,
            eye.renderer.rays,
            width,
            height,
            _K,
            eye.p_WC,
            eye.q_WC,
            data,
        ],
        outputs=[counts],
        device=eye.device,
        block_dim=64,
    )
    return float(counts.numpy().sum() / (_K * width * height))


def _time_walk(eye: _Eye) -> float:
    """Return the time of the walk, per render [s]."""
    launch = eye.renderer.candidates.update
    return eye.seconds(lambda: launch(eye.renderer.rays, eye.p_WC, eye.q_WC, instant_count=_K)) / _K


def shared_walk_chapter(result: WalkResult) -> Chapter:
    """Return the answer in words and a table."""
    pixels, differing = (sum(getattr(c, n) for c in result.costs) for n in ("pixel_count", "differing_count"))
    events, others = (sum(getattr(c, n) for c in result.costs) for n in ("event_count", "other_event_count"))
    best = {
        part: min((c for c in result.costs if c.part == part), key=lambda c: c.together_s) for part in _PARTS
    }
    lines = [
        f"- {part} part: {c.alone_s / c.together_s:.1f} times the speed of rays that each walk by themselves "
        f"({1e3 * c.together_s:.2f} ms instead of {1e3 * c.alone_s:.2f}), with {c.instants} instants to a "
        f"walk; {c.asked:.2%} of the rays walk by themselves after all."
        for part, c in best.items()
    ]
    return Chapter(
        name="shared-walk",
        title="Rays that share a walk through the tree",
        summary="\n".join(
            [
                f"{result.scene}, {result.triangle_count:,} triangles, {result.width}x{result.height} px at "
                f"1 kHz, on {result.device}. Log radiance only.",
                "",
                *lines,
            ]
        ),
        command=f"neurosim bench shared-walk{' --quick' if result.quick else ''}",
        bars=[
            Bar(
                text="the same bits and the same events as where each ray walks by itself",
                measured=f"{differing:,} of {pixels:,} pixels differ, and {others:,} of {events:,} events",
                met=differing == 0 and others == 0,
            )
        ],
        tables=[_table(result)],
    )


def _table(result: WalkResult) -> Table:
    return Table(
        name="shared-walk",
        title="Shared walks by the number of instants that share one",
        columns={
            "part": "part of the flight",
            "instants": "instants",
            "list_mean": "triangles listed",
            "too_long": "lists too long [%]",
            "asked": "rays alone [%]",
            "differing_count": "pixels that differ",
            "other_event_count": "events that differ",
            "event_count": "events",
            "walk_ms": "walk [ms]",
            "together_ms": "render [ms]",
            "alone_ms": "each ray alone [ms]",
            "embree_ms": "Embree [ms]",
        },
        rows=[
            {
                "part": c.part,
                "instants": c.instants,
                "list_mean": c.list_mean,
                "too_long": 100.0 * c.too_long,
                "asked": 100.0 * c.asked,
                "differing_count": c.differing_count,
                "other_event_count": c.other_event_count,
                "event_count": c.event_count,
                **{f"{n}_ms": 1e3 * getattr(c, f"{n}_s") for n in ("walk", "together", "alone", "embree")},
            }
            for c in result.costs
        ],
        note="Slow: a drift of 0.13 m/s; fast: a roll of 640 degrees a second. Times are those of one "
        "render, best of three; the walk is part of the render.",
    )
