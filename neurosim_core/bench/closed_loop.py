"""The closed loop between processes: how long a command takes to be seen, and how many images a second come.

For each rate a simulator and a controller, two processes, fly twice. *Lockstep*: the simulator waits for each
command, so the time from command to image is what Cortex, the dynamics and the renderer take. *Streaming*:
time passes at the pace of the wall clock, as long as the machine keeps up with the rate that was asked for.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import rich.table
from numpy.typing import NDArray
from rich.console import Console

from neurosim_core.bench.loop_trace import (
    LoopTrace,
    answered_commands,
    felt_at_once,
    felt_commands,
    loop_latency_ns,
    received_hz,
    transport_ns,
)
from neurosim_core.bench.machine import StealTime, describe_machine
from neurosim_core.bench.processes import NeurosimProcess, own_runtime
from neurosim_core.bench.report import Plot, Table, save_files
from neurosim_core.config import SimulationConfig, load_config, to_yaml
from neurosim_core.live.probe import ProbeError, answer_images
from neurosim_core.overrides import set_options

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LoopMode = Literal["lockstep", "streaming"]

TRANSPORT_BAR_S = (0.2e-3, 0.5e-3)
"""What the median and the 99th percentile of the transport are to stay under [s]."""
_SPIN_S = 1e-3
"""In lockstep the controller looks for an image for so long before it sleeps [s]; if that is not enough, it
sleeps at once."""
_CAMERA = "camera"
_OPTIONS = {
    f"sensors.{_CAMERA}.lens.width": "--width",
    f"sensors.{_CAMERA}.lens.height": "--height",
    "device": "--device",
    f"sensors.{_CAMERA}.rate_hz": "--rates",
    "control.rate_hz": "--rates",
}
"""What the command line calls the keys of its settings, for error messages."""


@dataclass(frozen=True, kw_only=True)
class LoopResult:
    """What was measured at one rate; times are wall-clock, and nan where nothing could be measured."""

    mode: LoopMode
    requested_hz: float
    """Commands and images a second of simulated time [Hz]."""
    received_hz: float
    """Images a second that the controller got [Hz]."""
    image_count: int
    image_bytes: int
    latency_median_s: float
    """From sending a command to having the first image that felt it [s]."""
    latency_p99_s: float
    transport_median_s: float
    """From publishing an image to having it in the controller's hands [s]."""
    transport_p99_s: float
    lost_count: int
    """Images that never arrived."""
    overtaken_count: int
    """Images that gave way to newer ones before the controller looked."""
    unfelt_count: int
    """Commands sent that no image showed: a newer one took their place, or the measurement was over."""


def loop_config(
    mode: LoopMode,
    rate_hz: float,
    *,
    renderer: str = "synthetic",
    width: int = 640,
    height: int = 480,
    device: str = "auto",
    scene: Path | None = None,
    settings: Mapping[str, Any] | None = None,
) -> SimulationConfig:
    """Return the settings of a loop: one RGB camera, at the rate of the commands.

    Args:
        mode: Whether the simulator waits for commands.
        rate_hz: Of commands and images [Hz].
        renderer: Who draws the images.
        width: Columns of an image [px].
        height: Rows [px].
        device: Where to compute.
        scene: A mesh file; None: the generated apartment.
        settings: Further ones, by dotted key.

    Raises:
        ValueError: Something is out of range.
    """
    lens = {"width": width, "height": height, "horizontal_fov_rad": 1.5}
    base: dict[str, Any] = {
        "device": device,
        "renderer": renderer,
        "instants_per_launch": 1,
        "path": {"kind": "hover"},
        "vehicle": {"on_collision": "report"},
        "control": {"rate_hz": rate_hz},
        "sensors": {_CAMERA: {"kind": "rgb", "rate_hz": rate_hz, "lens": lens}},
        "live": {"mode": mode, "command_timeout_s": 60.0, "fail_safe": "hold"},
    }
    if scene is not None:
        base["scene"] = {"kind": "mesh", "file": str(scene.resolve())}
    return load_config(base, overrides=settings, options=_OPTIONS | set_options(settings))


def measure_loop(
    config: SimulationConfig,
    *,
    seconds: float,
    warm_up_s: float | None = None,
    python: Sequence[str] = (sys.executable,),
) -> LoopResult:
    """Start a simulator, close the loop over Cortex, and measure.

    Args:
        config: `loop_config`.
        seconds: How long to measure [wall-clock s].
        warm_up_s: How long to fly before that [wall-clock s]; None: half as long, at most 1 s.
        python: How to start the interpreter of the simulator, such as under a profiler.

    Raises:
        ProcessEnded: The simulator ended.
        ProbeError: It was silent.
    """
    _check_seconds(seconds)
    airframe = config.vehicle.airframe()
    hover_rad_s = airframe.hover_rotor_speed_rad_s
    with own_runtime() as folder:
        file = folder / "loop.yaml"
        file.write_text(to_yaml(config), encoding="utf-8")
        with NeurosimProcess("serve", str(file), log=folder / "serve.log", python=python) as simulator:
            try:
                trace = answer_images(
                    vehicle=next(iter(config.vehicles)),
                    camera=_CAMERA,
                    hover_rad_s=hover_rad_s,
                    rotor_count=airframe.rotor_count,
                    seconds=seconds,
                    warm_up_s=min(0.5 * seconds, 1.0) if warm_up_s is None else warm_up_s,
                    watch_rotors=not _obeys_at_once(config),
                    check=simulator.check,
                    spin_s=_SPIN_S if config.live.mode == "lockstep" else 0.0,
                )
            except ProbeError as error:
                raise ProbeError(f"{error}; the simulator: {simulator.last_words()}") from None
    return summarise(
        trace,
        mode=config.live.mode,
        requested_hz=config.control.rate_hz,
        hover_rad_s=hover_rad_s,
        motor_time_constant_s=airframe.motor_time_constant_s,
        at_once=_obeys_at_once(config),
    )


def _obeys_at_once(config: SimulationConfig) -> bool:
    """Whether every command holds from the state on that it answers."""
    return config.live.mode == "lockstep" and config.live.command_every == 1 and not config.links


def _check_seconds(seconds: float) -> None:
    if not 0.0 < seconds <= 3600.0:  # also refuses nan
        raise ValueError(f"seconds must be > 0 and <= 3600, got {seconds}")


def summarise(
    trace: LoopTrace,
    *,
    mode: LoopMode,
    requested_hz: float,
    hover_rad_s: float,
    motor_time_constant_s: float,
    at_once: bool,
) -> LoopResult:
    """Return the figures of a trace.

    Args:
        trace: What was seen.
        mode: Of the simulator.
        requested_hz: Commands and images a second of simulated time [Hz].
        hover_rad_s: As in `felt_commands`.
        motor_time_constant_s: As in `felt_commands`.
        at_once: Whether commands hold from the state on that they answer; the warm-up has to show it.

    Raises:
        RuntimeError: It does not.
    """
    felt = felt_commands(trace, hover_rad_s=hover_rad_s, motor_time_constant_s=motor_time_constant_s)
    stamp_ns = trace.rotor_stamp_ns[1:]
    if at_once:
        if not felt_at_once(trace, felt):
            raise RuntimeError("the simulator does not obey commands in lockstep: nothing was measured")
        felt, stamp_ns = answered_commands(trace), trace.image_stamp_ns[1:]
    latency_s = 1e-9 * loop_latency_ns(trace, felt, stamp_ns)
    transport_s = 1e-9 * transport_ns(trace)
    return LoopResult(
        mode=mode,
        requested_hz=requested_hz,
        received_hz=received_hz(trace),
        image_count=len(trace.received_ns) - trace.begin,
        image_bytes=trace.image_bytes,
        latency_median_s=_quantile(latency_s, 0.5),
        latency_p99_s=_quantile(latency_s, 0.99),
        transport_median_s=_quantile(transport_s, 0.5),
        transport_p99_s=_quantile(transport_s, 0.99),
        lost_count=trace.lost_count,
        overtaken_count=trace.overtaken_count,
        unfelt_count=len(trace.sent_ns) - len(np.unique(felt[felt >= 0])),
    )


def _quantile(values: NDArray[np.floating[Any]], share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else float("nan")


def sweep(
    configs: Sequence[SimulationConfig],
    *,
    seconds: float,
    on_case: Callable[[LoopMode, float], None] | None = None,
) -> list[LoopResult]:
    """Measure one loop after the other.

    Args:
        configs: `loop_config` of each.
        seconds: How long to measure each [wall-clock s].
        on_case: Told mode and rate [Hz] of what is measured next.
    """
    results = []
    for config in configs:
        if on_case is not None:
            on_case(config.live.mode, config.control.rate_hz)
        results.append(measure_loop(config, seconds=seconds))
    return results


def print_sweep(results: Sequence[LoopResult], console: Console) -> None:
    """Print a sweep as a table, and what its transport is to be judged by."""
    table = rich.table.Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("mode")
    for name in (
        "requested\n[Hz]",
        "received\n[Hz]",
        "loop\n[ms]",
        "its p99\n[ms]",
        "transport\n[ms]",
        "its p99\n[ms]",
        "lost",
        "over-\ntaken",
    ):
        table.add_column(name, justify="right")
    for r in results:
        times_s = (r.latency_median_s, r.latency_p99_s, r.transport_median_s, r.transport_p99_s)
        table.add_row(
            r.mode,
            f"{r.requested_hz:g}",
            f"{r.received_hz:.0f}",
            *(f"{1e3 * time_s:.3f}" for time_s in times_s),
            f"{r.lost_count}",
            f"{r.overtaken_count}",
        )
    console.print(table, highlight=False)
    worst = [max(r.transport_median_s for r in results), max(r.transport_p99_s for r in results)]
    met = all(value < bar for value, bar in zip(worst, TRANSPORT_BAR_S, strict=True))
    console.print(
        f"transport of {results[0].image_bytes / 1e6:.2f} MB at every rate: median {_ms(worst[0])} or less, "
        f"p99 {_ms(worst[1])} or less; bar {_ms(TRANSPORT_BAR_S[0])} and {_ms(TRANSPORT_BAR_S[1])}: "
        + ("met" if met else "missed"),
        highlight=False,
        soft_wrap=True,
    )


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3f} ms"


def _table(results: Sequence[LoopResult]) -> Table:
    """Return one row for each rate and mode; times in seconds."""
    names = [field.name for field in dataclasses.fields(LoopResult)]
    return Table(
        name="closed-loop",
        title="closed loop",
        columns={name: name for name in names},
        rows=[dataclasses.asdict(result) for result in results],
    )


def _draw(results: Sequence[LoopResult], figure: Figure) -> None:
    """Draw latency against rate, and received against requested rate."""
    figure.set_size_inches(11.0, 5.0)
    left, right = figure.subplots(1, 2)
    rates = np.array(sorted({r.requested_hz for r in results}))
    for mode, marker in (("lockstep", "o"), ("streaming", "s")):
        chosen = [r for r in results if r.mode == mode]
        if not chosen:
            continue
        x = [r.requested_hz for r in chosen]
        median, p99 = ([1e3 * t for t in times] for times in zip(*_latencies(chosen), strict=True))
        transport = [1e3 * r.transport_median_s for r in chosen]
        (line,) = left.plot(x, median, marker=marker, label=f"command to image, {mode}")
        style: dict[str, Any] = {"color": line.get_color(), "marker": ""}
        left.plot(x, p99, ":", label="its 99th percentile", **style)
        left.plot(x, transport, "--", label="of which transport", **style)
        right.plot(x, [r.received_hz for r in chosen], marker=marker, label=mode)
    left.plot(rates, 1e3 / rates, color="0.7", marker="", label="one period")
    right.plot(rates, rates, color="0.7", marker="", label="as requested")
    left.set(xlabel="controller and image rate [Hz]", ylabel="wall-clock time [ms]", title="(i) latency")
    right.set(xlabel="requested [Hz]", ylabel="images received a second", title="(ii) rate")
    for axes in (left, right):
        axes.set(xscale="log", yscale="log")
        axes.legend()
    left.set_ylim(top=8.0 * left.get_ylim()[1])  # room for the legend


def _latencies(results: Sequence[LoopResult]) -> list[tuple[float, float]]:
    return [(r.latency_median_s, r.latency_p99_s) for r in results]


def bench_closed_loop(
    out: Path, console: Console, *, rates_hz: Sequence[float], seconds: float = 3.0, **options: Any
) -> list[LoopResult]:
    """Measure, print, and leave closed-loop.csv and closed-loop.png.

    Args:
        out: Folder, made if need be; files of these names are replaced.
        console: Where to print.
        rates_hz: Of commands and images [Hz].
        seconds: How long to measure each rate in each mode [wall-clock s].
        options: As for `loop_config`.
    """
    modes: tuple[LoopMode, ...] = ("lockstep", "streaming")
    configs = [loop_config(mode, rate_hz, **options) for mode in modes for rate_hz in rates_hz]
    _check_seconds(seconds)
    out.mkdir(parents=True, exist_ok=True)
    config = configs[0]
    lens = config.sensors[_CAMERA].lens  # type: ignore[union-attr]
    where = "the generated apartment" if config.scene.kind == "apartment" else Path(config.scene.file).name
    title = f"closed loop, RGB {lens.width}x{lens.height}, {config.renderer} renderer, hover in {where}"
    notes = describe_machine(None if config.device == "auto" else config.device)
    steal_time = StealTime()
    with console.status("closed loop") as status:
        results = sweep(
            configs,
            seconds=seconds,
            on_case=lambda mode, rate_hz: status.update(f"closed loop: {mode}, {rate_hz:g} Hz"),
        )
    notes += steal_time.notes()
    console.print("\n".join([title, *notes]), highlight=False, soft_wrap=True)
    print_sweep(results, console)
    plot = Plot(name="closed-loop", title=title, draw=lambda figure: _draw(results, figure))
    save_files(out, console, tables=[_table(results)], plots=[plot], notes=notes)
    return results
