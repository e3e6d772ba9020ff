# mypy: disable-error-code="attr-defined,no-untyped-call,method-assign"
"""What one run launches, allocates and imports, counted in a process of its own.

`python -m neurosim_core.bench.leave_out_probe` reads a request as JSON from its standard input, flies, and
prints the counts as JSON. Warp's launches and allocators are wrapped before anything else is imported: what
is reported is what happened, not what was declared.
"""

from __future__ import annotations

import itertools
import json
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import warp as wp

if TYPE_CHECKING:
    from neurosim_core.packets import Packet
    from neurosim_core.simulation import Model, State

LIBRARIES = {
    "scene": ("trimesh", "PIL", "networkx", "embreex", "pyrender", "OpenGL"),
    "files and viewers": ("h5py", "mcap", "matplotlib", "rerun"),
    "network": ("zmq", "cortex"),
    "mathematics": ("scipy", "torch"),
}
"""Libraries that a run may or may not need, by what they are for."""


@dataclass(frozen=True, kw_only=True)
class Probe:
    """What was counted in one run."""

    terms: dict[str, list[str]]
    """Terms that are compiled in, by kernel."""
    kernels: list[str]
    """Names of the kernels that were launched in flight."""
    shader_functions: list[str]
    """Functions in the code of the ray casters that were launched."""
    launch_count: int
    """Launches in all, set-up included; slices of one launch count once."""
    launches_per_s: float
    """Launches per simulated second, in flight."""
    array_count: int
    """Allocations of the set-up."""
    array_bytes: int
    """Bytes that they held together."""
    picture_count: int
    """Allocations, set-up and flight, of arrays with the rows and columns of a camera."""
    picture_bytes: int
    texture_bytes: int
    """Texels that were painted or decoded, on the host."""
    flight_allocations_per_s: float
    """Allocations per simulated second, in flight."""
    resident_bytes: int
    """The most memory that the process held."""
    libraries: list[str]
    """Libraries (of `LIBRARIES`) that were imported."""
    embree: bool
    """Embree's library was loaded."""
    flight_s: list[float]
    """CPU time of all threads per simulated second in flight, all sensors included; each repetition [s]."""
    setup_s: float
    """CPU time from the settings to the first step [s]."""


@dataclass
class _Counts:
    """What has been launched and allocated so far."""

    launches: Counter[str] = field(default_factory=Counter)
    kernels: dict[str, Any] = field(default_factory=dict)
    allocation_count: int = 0
    allocated_bytes: int = 0
    picture_count: int = 0
    picture_bytes: int = 0

    def note_launch(self, kernel: Any, inputs: Any = None) -> None:
        arguments = kernel.adj.args
        if inputs and arguments and arguments[0].label == "first" and inputs[0] != 0:
            return  # a later slice of the same launch
        self.launches[kernel.key] += 1
        self.kernels[f"{kernel.key} {id(kernel)}"] = kernel


def watch(picture_shapes: set[tuple[int, int]]) -> _Counts:
    """Count launches and allocations of this process from now on.

    Args:
        picture_shapes: Rows and columns of cameras: arrays with these are pictures.
    """
    counts = _Counts()
    _watch_launches(counts)
    _watch_allocations(counts)
    _watch_arrays(counts, picture_shapes)
    return counts


def _watch_launches(counts: _Counts) -> None:
    launch, replay = wp.launch, wp.Launch.launch

    def counted_launch(kernel: Any, *args: Any, **options: Any) -> Any:
        if not options.get("record_cmd"):
            inputs = options.get("inputs", args[1] if len(args) > 1 else None)
            counts.note_launch(kernel, inputs)
        return launch(kernel, *args, **options)

    def counted_replay(self: Any, *args: Any, **options: Any) -> Any:
        counts.note_launch(self.kernel)
        return replay(self, *args, **options)

    wp.launch, wp.Launch.launch = counted_launch, counted_replay


def _watch_allocations(counts: _Counts) -> None:
    from warp._src import context

    def counted(allocate: Callable[[Any, int], int]) -> Callable[[Any, int], int]:
        def wrapped(self: Any, size_in_bytes: int) -> int:
            counts.allocation_count += 1
            counts.allocated_bytes += size_in_bytes
            return allocate(self, size_in_bytes)

        return wrapped

    for name in ("CpuDefaultAllocator", "CpuPinnedAllocator", "CudaDefaultAllocator", "CudaMempoolAllocator"):
        allocator = getattr(context, name)
        allocator.allocate = counted(allocator.allocate)


def _watch_arrays(counts: _Counts, picture_shapes: set[tuple[int, int]]) -> None:
    make = wp.array.__init__

    def counted(self: Any, *args: Any, **options: Any) -> None:
        before = counts.allocation_count
        make(self, *args, **options)
        if counts.allocation_count > before and _is_picture(self.shape, picture_shapes):
            counts.picture_count += 1
            counts.picture_bytes += self.capacity

    wp.array.__init__ = counted


def _is_picture(shape: tuple[int, ...], picture_shapes: set[tuple[int, int]]) -> bool:
    return any(pair in picture_shapes for pair in itertools.pairwise(shape)) or any(
        rows * columns in shape for rows, columns in picture_shapes
    )


def probe(config: dict[str, Any], seconds: float, repetitions: int) -> Probe:
    """Fly, and return what was counted; for a process that does nothing else.

    Args:
        config: Settings.
        seconds: Simulated time that is measured, after as much that is not [s].
        repetitions: How often the flight is timed; the first is counted as well.
    """
    lenses = [sensor["lens"] for sensor in config["sensors"].values() if "lens" in sensor]
    counts = watch(
        {(260, 346), *((lens["height"], lens["width"]) for lens in lenses)}
    )  # also the default lens
    begin = time.process_time()  # whatever else runs on the machine does not count

    from neurosim_core.config import load_config
    from neurosim_core.simulation import make_model, make_state

    model = make_model(load_config({**config, "duration_s": 2.0 * seconds}))
    state = make_state(model)
    setup_s = time.process_time() - begin
    arrays = counts.allocation_count, counts.allocated_bytes
    packets = _first_half(model, state, seconds)
    launched, allocated = counts.launches.copy(), counts.allocation_count
    flown_s, elapsed_s = _second_half(state, packets)
    in_flight, allocated = counts.launches - launched, counts.allocation_count - allocated
    launch_count = sum(counts.launches.values())
    pictures = counts.picture_count, counts.picture_bytes
    resident_bytes = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    flights = [elapsed_s / flown_s]
    for _ in range(repetitions - 1):
        again = make_state(model)
        flown_s, elapsed_s = _second_half(again, _first_half(model, again, seconds))
        flights.append(elapsed_s / flown_s)
    return Probe(
        terms=_terms(model, state),
        kernels=sorted(in_flight),
        shader_functions=_shader_functions(counts),
        launch_count=launch_count,
        launches_per_s=sum(in_flight.values()) / flown_s,
        array_count=arrays[0],
        array_bytes=arrays[1],
        picture_count=pictures[0],
        picture_bytes=pictures[1],
        texture_bytes=_texture_bytes(model),
        flight_allocations_per_s=allocated / flown_s,
        resident_bytes=resident_bytes,
        libraries=[name for names in LIBRARIES.values() for name in names if name in sys.modules],
        embree=_embree_loaded(),
        flight_s=flights,
        setup_s=setup_s,
    )


def _first_half(model: Model, state: State, seconds: float) -> Iterator[Packet]:
    """Fly for some seconds; return what flies on."""
    from neurosim_core.simulation import run_model

    packets = run_model(model, state)
    half_ns = int(1e9 * seconds)
    for _ in itertools.takewhile(lambda _: state.stamp_ns < half_ns, packets):
        pass
    return packets


def _second_half(state: State, packets: Iterator[Packet]) -> tuple[float, float]:
    """Fly to the end; return the simulated time and the CPU time of all threads that it took [s]."""
    stamp_ns, begin = state.stamp_ns, time.process_time()
    for _ in packets:
        pass
    return 1e-9 * (state.stamp_ns - stamp_ns), time.process_time() - begin


def _terms(model: Model, state: State) -> dict[str, list[str]]:
    """What each kernel computes beyond what every run needs."""
    from neurosim_core.sensors.cast import render_terms

    terms = {"dynamics": list(state.vehicle.terms)}
    terms |= {name: list(imu.terms) for name, imu in state.imus.items()}
    for cast, seeing in zip(model.casts, state.casts, strict=True):
        terms[", ".join(cast.names)] = [*sorted(cast.outputs), *render_terms(seeing)]
        terms |= {f"pixel of {name}": list(e.camera.terms) for name, e in seeing.events.items()}
    return terms


def _shader_functions(counts: _Counts) -> list[str]:
    """Return the functions that the code of the ray casters calls, as Warp generates it."""
    from warp._src.context import ModuleBuilder

    casters = {id(k.module): k.module for k in counts.kernels.values() if "raycast" in k.key}
    builders = (ModuleBuilder(module, module.options) for module in casters.values())
    return sorted({function.key for builder in builders for function in builder.functions})


def _texture_bytes(model: Model) -> int:
    textures = {id(m.texture): m.texture for m in model.scene.materials if m.texture is not None}
    return sum(texture.srgb.nbytes for texture in textures.values() if texture.painted)


def _embree_loaded() -> bool:
    try:
        with open("/proc/self/maps", encoding="utf-8") as maps:
            return any("embree" in line for line in maps)
    except OSError:
        return "embreex" in sys.modules


def main() -> int:
    """Answer the request on the standard input; return the exit status."""
    wp.config.log_level = wp.LOG_WARNING
    request = json.load(sys.stdin)
    print(json.dumps(asdict(probe(**request))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
