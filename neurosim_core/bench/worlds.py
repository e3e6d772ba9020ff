# mypy: disable-error-code="no-untyped-call,untyped-decorator,call-overload"
"""Many worlds stepped together against as many single simulations: renders, events and steps a second."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp

from neurosim_core.bench.h200 import HOUSE_TRIANGLES, is_enough
from neurosim_core.bench.report import Bar, Chapter, Plot, Table
from neurosim_core.config import load_config
from neurosim_core.simulation import Model, State, make_model, make_state, refit, step
from neurosim_core.worlds import Worlds, make_worlds

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RENDERS_PER_STEP = 8
CONTROL_HZ = 100.0
_BAR_COUNT, _BAR_PX, _BAR_RENDERS_PER_S = 1024, 128, 250_000.0
_ROUNDS = 3
_SINGLES_MAX = 4


@dataclass(frozen=True, kw_only=True)
class WorldsCase:
    """One size of a batch."""

    count: int
    """Worlds."""
    width: int
    height: int
    renders_per_s: float
    """Of all worlds, the best of the rounds."""
    steps_per_s: float
    """Control periods of all worlds a second, in the same round."""
    events_per_s: float
    """Of all worlds."""
    dropped: int
    """Events that did not fit in any step of the rounds."""
    alone_renders_per_s: float
    """Single simulations one after the other: renders a second, the best of the rounds in between."""
    cpu_ms: float
    """CPU time for each render of the batch [ms], the least of the rounds: hardly changed by other loads."""
    alone_cpu_ms: float
    """The same of single simulations [ms]."""
    phases_ms: dict[str, float]
    """Time of a step by part [ms], each waited for."""


@dataclass(frozen=True, kw_only=True)
class WorldsResult:
    """What `measure_worlds` found."""

    device: str
    scene: str
    triangles: int
    cases: tuple[WorldsCase, ...]


def measure_worlds(
    *,
    quick: bool = False,
    scene: Path | None = None,
    device: str = "auto",
    width: int | None = None,
    height: int | None = None,
    worlds: Sequence[int] | None = None,
    seconds: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> WorldsResult:
    """Turn on the spot in many worlds with one event camera each, and in single simulations beside it.

    Args:
        quick: Few and small worlds, and short.
        scene: A mesh file; None: the generated apartment.
        device: Where to compute.
        width: Columns of the event camera [px]; None: 64 and 128.
        height: Its rows [px]; None: as many.
        worlds: Sizes of batches; None: up to 128 on a CPU, up to 4096 on a CUDA device.
        seconds: About how long to measure each [s].
        progress: Told what is measured next.
    """
    model = make_model(load_config(_settings(scene, device, 32, 32)))
    on_cuda = wp.get_device(model.device).is_cuda
    sizes = [(width or height or 0, height or width or 0)] if width or height else [(64, 64), (128, 128)]
    counts = list(worlds or ([1, 16, 128, 1024, 4096] if on_cuda else [1, 16, 128]))
    if quick:
        sizes, counts = sizes[:1], list(worlds or [1, 4])
    budget_s = seconds or (0.3 if quick else 3.0)
    cases = []
    for (columns, rows), count in itertools.product(sizes, counts):
        progress(f"{count} worlds of {columns} x {rows} px")
        config = load_config(_settings(scene, device, columns, rows))
        cases.append(_measure_case(refit(model, config), count, columns, rows, budget_s / _ROUNDS))
    return WorldsResult(
        device=str(wp.get_device(model.device).name or model.device),
        scene=model.scene.name,
        triangles=len(model.scene.faces),
        cases=tuple(cases),
    )


def worlds_chapter(result: WorldsResult) -> Chapter:
    """Return what was measured as a chapter."""
    most = max(result.cases, key=lambda case: case.renders_per_s)
    ratios = [case.renders_per_s / case.alone_renders_per_s for case in result.cases]
    return Chapter(
        name="worlds",
        title="Many worlds together",
        summary=(
            f"On {result.device}, in {result.scene} of {result.triangles:,} triangles, {most.count:,} worlds "
            f"with an event camera of {most.width} x {most.height} px give {most.renders_per_s:,.0f} renders "
            f"a second in total. Stepped together, worlds are {min(ratios):.2f} to {max(ratios):.2f} times "
            "as fast as single simulations one after the other, which give the same bytes."
        ),
        command="neurosim bench worlds",
        bars=[_bar(result)],
        tables=[_table(result)],
        plots=[
            Plot(
                name="worlds",
                title="Renders a second of all worlds",
                draw=lambda figure: _draw(result, figure),
            )
        ],
    )


def _settings(scene: Path | None, device: str, width: int, height: int) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "device": device,
        "control": {"rate_hz": CONTROL_HZ},
        "vehicle": {"on_collision": "report"},
        "path": {"kind": "hover"},
        "sensors": {
            "front": {
                "kind": "event_camera",
                "lens": {"width": width, "height": height, "horizontal_fov_rad": 1.5},
                "sampling_rate_hz": CONTROL_HZ * RENDERS_PER_STEP,
                "packet_rate_hz": CONTROL_HZ,
            }
        },
    }
    if scene is not None:
        settings["scene"] = {"kind": "mesh", "file": str(scene.resolve())}
    return settings


def _measure_case(model: Model, count: int, width: int, height: int, budget_s: float) -> WorldsCase:
    worlds = make_worlds(model.config, count=count, models=[model])
    worlds.reset()
    turning = np.zeros((count, 4))
    turning[:, 3] = np.linspace(0.5, 1.5, count)  # yaw rates of their own: no two worlds see the same
    singles = [make_state(model) for _ in range(min(count, _SINGLES_MAX))]
    for _ in range(3):
        worlds.step(turning, mode="velocity")  # kernels, graphs
    _fly_singles(model, singles, turning, 0.0)
    together, alone = [], []
    for _ in range(_ROUNDS):
        together.append(_fly_worlds(worlds, turning, budget_s))
        alone.append(_fly_singles(model, singles, turning, budget_s))
    best = max(together, key=lambda pace: pace.steps_per_s)
    phases = [worlds.time_step(turning, mode="velocity") for _ in range(3)]
    return WorldsCase(
        count=count,
        width=width,
        height=height,
        renders_per_s=best.steps_per_s * RENDERS_PER_STEP,
        steps_per_s=best.steps_per_s,
        events_per_s=best.steps_per_s * best.events_per_step,
        dropped=sum(pace.dropped for pace in together),
        alone_renders_per_s=max(pace.steps_per_s for pace in alone) * RENDERS_PER_STEP,
        cpu_ms=1e3 * min(pace.cpu_s_per_step for pace in together) / RENDERS_PER_STEP,
        alone_cpu_ms=1e3 * min(pace.cpu_s_per_step for pace in alone) / RENDERS_PER_STEP,
        phases_ms={name: 1e3 * min(phase[name] for phase in phases) for name in phases[0]},
    )


class _Pace(NamedTuple):
    """What one round of steps took, for each step of one world."""

    steps_per_s: float
    cpu_s_per_step: float
    events_per_step: float = 0.0
    dropped: int = 0


@wp.kernel(enable_backward=False)
def _tally(
    # In:
    counts: wp.array[wp.int32],
    dropped: wp.array[wp.int32],
    # In/out:
    totals: wp.array[wp.int64],
) -> None:
    """Add the events of a step to those before: found and dropped."""
    world = wp.tid()
    wp.atomic_add(totals, 0, wp.int64(counts[world]))
    wp.atomic_add(totals, 1, wp.int64(dropped[world]))


def _fly_worlds(worlds: Worlds, commands: Any, budget_s: float) -> _Pace:
    """Step for about a time; events are added up on the device, which is not waited for."""
    step_s = sum(worlds.time_step(commands, mode="velocity").values())
    count = max(2, int(budget_s / step_s))  # known before: on CUDA a step is queued in no time
    totals: Any = wp.zeros(2, dtype=wp.int64, device=worlds.device)
    wp.load_module(device=worlds.device)
    begin, cpu_begin = time.perf_counter(), time.process_time()
    for _ in range(count):
        seen = worlds.step(commands, mode="velocity").events["front"]
        wp.launch(
            _tally,
            dim=worlds.count,
            inputs=[seen.counts, seen.dropped],
            outputs=[totals],
            device=worlds.device,
        )
    wp.synchronize_device(worlds.device)
    elapsed_s, cpu_s = time.perf_counter() - begin, time.process_time() - cpu_begin
    flown = count * worlds.count
    found, dropped = (int(total) for total in totals.numpy())
    return _Pace(flown / elapsed_s, cpu_s / flown, found / flown, dropped)


def _fly_singles(model: Model, singles: list[State], commands: Any, budget_s: float) -> _Pace:
    """Step single simulations that take turns for about a time."""
    begin, cpu_begin, flown = time.perf_counter(), time.process_time(), 0
    while flown < len(singles) or time.perf_counter() - begin < budget_s:
        index = flown % len(singles)
        step(model, singles[index], commands[index], mode="velocity")
        flown += 1
    return _Pace(flown / (time.perf_counter() - begin), (time.process_time() - cpu_begin) / flown)


def _bar(result: WorldsResult) -> Bar:
    promised = [c for c in result.cases if (c.count, c.width, c.height) == (_BAR_COUNT, _BAR_PX, _BAR_PX)]
    text = (
        f"{_BAR_COUNT:,} worlds of {_BAR_PX} x {_BAR_PX} event cameras in a house of 145,844 triangles give "
        f"at least {_BAR_RENDERS_PER_S:,.0f} renders a second in total, on an H200"
    )
    if not promised:
        return Bar(text=text, measured=f"not flown on {result.device}", met=None)
    found, dropped = promised[0].renders_per_s, promised[0].dropped
    measured = f"{found:,.0f} /s on {result.device}, best of {_ROUNDS} rounds, {dropped:,} events dropped"
    if result.triangles < HOUSE_TRIANGLES:
        return Bar(text=text, measured=f"needs --scene with the house; here {measured}", met=None)
    met = is_enough(result.device, found if dropped == 0 else 0.0, _BAR_RENDERS_PER_S)
    return Bar(
        text=text, measured=measured if met is not None else f"needs an H200; here {measured}", met=met
    )


def _table(result: WorldsResult) -> Table:
    return Table(
        name="worlds",
        title="Worlds that are stepped together",
        columns={
            "worlds": "worlds",
            "width_px": "width [px]",
            "height_px": "height [px]",
            "renders_per_s": "renders [1/s]",
            "steps_per_s": "steps [1/s]",
            "events_per_s": "events [1/s]",
            "dropped": "events dropped",
            "alone_renders_per_s": "renders of single simulations [1/s]",
            "ratio": "ratio",
            "cpu_ms": "CPU time a render [ms]",
            "alone_cpu_ms": "of single simulations [ms]",
            "flight_ms": "flight [ms]",
            "render_ms": "render [ms]",
            "events_ms": "events [ms]",
        },
        rows=[
            {
                "worlds": case.count,
                "width_px": case.width,
                "height_px": case.height,
                "renders_per_s": case.renders_per_s,
                "steps_per_s": case.steps_per_s,
                "events_per_s": case.events_per_s,
                "dropped": case.dropped,
                "alone_renders_per_s": case.alone_renders_per_s,
                "ratio": case.renders_per_s / case.alone_renders_per_s,
                "cpu_ms": case.cpu_ms,
                "alone_cpu_ms": case.alone_cpu_ms,
                **{f"{name}_ms": value for name, value in case.phases_ms.items()},
            }
            for case in result.cases
        ],
        note=(
            "All figures are of all worlds together; a step is 10 ms of flight with "
            f"{RENDERS_PER_STEP} renders. Best of three rounds, in turn with single simulations, of which "
            "four at most take turns. Times of the parts of a step of all worlds are waited for one by one, "
            "so on a CUDA device their sum is more than a step takes."
        ),
    )


def _draw(result: WorldsResult, figure: Figure) -> None:
    """Draw renders a second against the number of worlds, and those of single simulations."""
    from neurosim_core.bench.figures import COLORS, MARKERS, plain_ticks

    axes = figure.subplots()
    sizes = sorted({(case.width, case.height) for case in result.cases})
    for color, marker, size in zip(COLORS, MARKERS, sizes, strict=False):
        cases = [case for case in result.cases if (case.width, case.height) == size]
        counts = [case.count for case in cases]
        name = f"{size[0]} x {size[1]}"
        axes.plot(counts, [c.renders_per_s for c in cases], marker, ls="-", color=color, label=f"{name} px")
        axes.plot(
            counts,
            [c.alone_renders_per_s for c in cases],
            marker,
            ls=":",
            color=color,
            fillstyle="none",
            label=f"{name} px, single simulations",
        )
    axes.set(xscale="log", yscale="log", xlabel="worlds", ylabel="renders a second")
    counts = sorted({case.count for case in result.cases})
    axes.set_xticks(counts, [f"{count:,}" for count in counts])
    axes.minorticks_off()
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, high / 6.0), high)  # so wide that some of 1, 2 and 5 are on it
    plain_ticks(axes.yaxis)
    axes.legend()
