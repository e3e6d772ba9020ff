"""A flight in real time between processes: how punctual an IMU at 1 kHz is beside an event camera.

Three processes: simulator, controller (`neurosim fly`), and this one, which listens. How often the event
camera is rendered is chosen by what the machine can do, which is measured first.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rich.table
from numpy.typing import NDArray
from rich.console import Console

from neurosim_core.bench.machine import StealTime, describe_machine
from neurosim_core.bench.processes import NeurosimProcess, own_runtime
from neurosim_core.bench.report import Plot, Table, save_files
from neurosim_core.bench.step import measure_steps
from neurosim_core.config import SimulationConfig, load_config, to_yaml
from neurosim_core.live.probe import ProbeError, StreamProbe, StreamTrace
from neurosim_core.overrides import set_options

if TYPE_CHECKING:
    from matplotlib.figure import Figure

JITTER_BAR_S = 1e-3
"""What the 99th percentile of the jitter is to stay under [s]."""
GROWTH_BAR_BYTES = 4 << 20
"""Memory that a process may come to hold without being said to grow: what its allocator keeps back."""
RENDER_SHARE = 0.25
"""How much of the machine's renders the event camera takes: the rest is for everybody else, and a live run
renders on one core less than the machine has, so that others are in time."""
_SAMPLING_RATES_HZ = (1000.0, 500.0, 250.0, 200.0, 100.0, 50.0, 25.0, 20.0, 10.0, 5.0)
"""Those that are chosen from; each divides the IMU's."""
_CALIBRATION_RATE_HZ = 100.0
_IMU, _CAMERA = "imu", "events"
_OPTIONS = {
    f"sensors.{_CAMERA}.lens.width": "--width",
    f"sensors.{_CAMERA}.lens.height": "--height",
    "device": "--device",
    f"sensors.{_CAMERA}.sampling_rate_hz": "--sampling-rate",
}
"""What the command line calls the keys of its settings, for error messages."""
_IMU_RATE_HZ = 1000.0
_SETTLED_S = 10.0
"""When memory is looked at first: everything has been used once."""
_WATCHED = ("simulator", "controller")


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """What the event camera was sized by."""

    renders_hz: float | None
    """Whole steps of the simulation that this machine does in a second, with the same camera [Hz]; None: the
    rate was given, and nothing was measured."""
    sampling_rate_hz: float
    """How often it is rendered [Hz]."""

    def __str__(self) -> str:
        rate = f"{self.sampling_rate_hz:g} Hz"
        if self.renders_hz is None:
            return rate
        share = 100.0 * self.sampling_rate_hz / self.renders_hz
        return f"{rate}, {share:.0f} % of the {self.renders_hz:.0f} /s that this machine can do"


@dataclass(frozen=True, kw_only=True)
class StreamResult:
    """What was measured; times are wall-clock."""

    seconds: float
    """How long was listened [s]."""
    imu_count: int
    imu_lost_count: int
    real_time_factor: float
    """Simulated over wall-clock time."""
    jitter_median_s: float
    """How far arrivals of the IMU are from where a perfect clock has them, early or late [s]."""
    jitter_p99_s: float
    jitter_max_s: float
    interval_median_s: float
    """Between two arrivals [s]."""
    interval_p99_s: float
    interval_max_s: float
    packet_count: int
    """Packets of events."""
    packet_lost_count: int
    event_count: int
    event_dropped_count: int
    """Events that did not fit into the simulator's buffer."""
    frame_dropped_count: int
    """Renders that the simulator left out."""
    overrun_count: int
    """Control periods that took longer than they had."""
    slipped_s: float
    """By how much the simulator held time back [s]."""
    grown_bytes: Mapping[str, int | None]
    """What each process came to hold after it had settled; None: not known."""


def calibrate(
    *, width: int, height: int, device: str, scene: Path | None, share: float = RENDER_SHARE
) -> Calibration:
    """Choose how often the event camera is rendered: by a short flight in this process.

    Args:
        width: Columns [px].
        height: Rows [px].
        device: Where to compute.
        scene: A mesh file; None: the generated apartment.
        share: Of the renders that the machine can do, in (0, 1].
    """
    times = measure_steps(
        scene=scene,
        device=device,
        width=width,
        height=height,
        rate_hz=_CALIBRATION_RATE_HZ,  # fewer renders see more events each
        instants=1,
        step_count=32,
        repetitions=3,
    )
    fitting = [rate for rate in _SAMPLING_RATES_HZ if rate <= share * times.median]
    return Calibration(renders_hz=times.median, sampling_rate_hz=(fitting or _SAMPLING_RATES_HZ[-1:])[0])


def stream_config(
    sampling_rate_hz: float,
    *,
    seconds: float,
    width: int = 346,
    height: int = 260,
    device: str = "auto",
    scene: Path | None = None,
    settings: Mapping[str, Any] | None = None,
) -> SimulationConfig:
    """Return the settings of the flight: real time, an IMU at 1 kHz, one event camera.

    Args:
        sampling_rate_hz: How often the event camera is rendered [Hz].
        seconds: How long to listen [s]; the path is a little longer.
        width: Columns of the event camera [px].
        height: Rows [px].
        device: Where to compute.
        scene: A mesh file; None: the generated apartment.
        settings: Further ones, by dotted key.

    Raises:
        ValueError: Something is out of range.
    """
    if not 0.0 < seconds <= 86_400.0:  # also refuses nan
        raise ValueError(f"seconds must be > 0 and <= 86400, got {seconds}")
    lens = {"width": width, "height": height, "horizontal_fov_rad": 1.5}
    camera = {"kind": "event_camera", "lens": lens, "sampling_rate_hz": sampling_rate_hz}
    base: dict[str, Any] = {
        "duration_s": seconds + 5.0,
        "device": device,
        "vehicle": {"on_collision": "report"},
        "sensors": {_IMU: {"kind": "imu", "rate_hz": _IMU_RATE_HZ}, _CAMERA: camera},
        "live": {"mode": "streaming", "real_time_factor": 1.0},
    }
    if scene is not None:
        base["scene"] = {"kind": "mesh", "file": str(scene.resolve())}
    return load_config(base, overrides=settings, options=_OPTIONS | set_options(settings))


def measure_stream(config: SimulationConfig, *, seconds: float) -> StreamTrace:
    """Fly, and note what comes.

    Args:
        config: `stream_config`.
        seconds: How long to listen, from the first sample of the IMU on [wall-clock s].

    Raises:
        ProcessEnded: Simulator or controller ended.
        ProbeError: The simulator was silent.
    """
    vehicle = next(iter(config.vehicles))
    with own_runtime() as folder:
        file = folder / "stream.yaml"
        file.write_text(to_yaml(config), encoding="utf-8")
        with (
            NeurosimProcess("serve", str(file), log=folder / "serve.log") as simulator,
            StreamProbe(vehicle=vehicle, imu=_IMU, camera=_CAMERA) as probe,
            NeurosimProcess("fly", str(file), log=folder / "fly.log") as controller,
        ):
            processes = (simulator, controller)

            def check() -> None:
                for process in processes:
                    process.check()

            try:
                return probe.listen(
                    seconds, resident=lambda: [p.resident_bytes() for p in processes], check=check
                )
            except ProbeError as error:
                raise ProbeError(f"{error}; the simulator: {simulator.last_words()}") from None


def lateness_s(trace: StreamTrace) -> NDArray[np.float64]:
    """Return how late each sample of the IMU came, against a perfect clock [s], shape [samples].

    The clock is set so that half of the samples are late.
    """
    late_ns = trace.imu_received_ns - trace.imu_stamp_ns
    return np.asarray(1e-9 * (late_ns - np.median(late_ns)))


def summarise(trace: StreamTrace) -> StreamResult:
    """Return the figures of a trace."""
    jitter_s = np.abs(lateness_s(trace))
    received_ns, stamp_ns = trace.imu_received_ns, trace.imu_stamp_ns
    interval_s = 1e-9 * np.diff(received_ns)
    elapsed_s = float(1e-9 * (received_ns[-1] - received_ns[0]))
    status = trace.status
    return StreamResult(
        seconds=elapsed_s,
        imu_count=len(received_ns),
        imu_lost_count=trace.imu_lost_count,
        real_time_factor=float(1e-9 * (stamp_ns[-1] - stamp_ns[0])) / elapsed_s,
        jitter_median_s=float(np.quantile(jitter_s, 0.5)),
        jitter_p99_s=float(np.quantile(jitter_s, 0.99)),
        jitter_max_s=float(jitter_s.max()),
        interval_median_s=float(np.quantile(interval_s, 0.5)),
        interval_p99_s=float(np.quantile(interval_s, 0.99)),
        interval_max_s=float(interval_s.max()),
        packet_count=trace.packet_count,
        packet_lost_count=trace.packet_lost_count,
        event_count=trace.event_count,
        event_dropped_count=trace.event_dropped_count,
        frame_dropped_count=sum(s.dropped_count for s in status.sensors if s.name == _CAMERA),
        overrun_count=status.overrun_count,
        slipped_s=1e-9 * status.slipped_ns,
        grown_bytes=_growth(trace),
    )


def _growth(trace: StreamTrace) -> dict[str, int | None]:
    """What each process came to hold from 10 s on, or from half-way on in a shorter run."""
    settled = min(_SETTLED_S, 0.5 * float(trace.resident_s[-1]))
    row = int(np.searchsorted(trace.resident_s, settled))
    first, last = trace.resident_bytes[row], trace.resident_bytes[-1]
    return {
        name: None if min(a, b) < 0 else int(b - a) for name, a, b in zip(_WATCHED, first, last, strict=True)
    }


def print_stream(result: StreamResult, console: Console) -> None:
    """Print the figures as a table, with their bars."""
    r = result
    lost = r.imu_lost_count + r.packet_lost_count + r.event_dropped_count + r.frame_dropped_count
    table = rich.table.Table(box=None, pad_edge=False, header_style="bold")
    for name in ("", "measured", "bar"):
        table.add_column(name)
    table.add_row("real-time factor", f"{r.real_time_factor:.5f} over {r.seconds:.1f} s")
    table.add_row(
        "jitter of the IMU",
        f"median {_ms(r.jitter_median_s)}, p99 {_ms(r.jitter_p99_s)}, max {_ms(r.jitter_max_s)}",
        f"p99 < {_ms(JITTER_BAR_S)}: {_verdict(r.jitter_p99_s < JITTER_BAR_S)}",
    )
    table.add_row(
        "time between samples",
        f"median {_ms(r.interval_median_s)}, p99 {_ms(r.interval_p99_s)}, max {_ms(r.interval_max_s)}",
    )
    table.add_row(
        "received",
        f"{r.imu_count:,} samples of the IMU\n{r.event_count:,} events in {r.packet_count:,} packets",
    )
    table.add_row(
        "lost",
        f"{r.imu_lost_count} samples, {r.packet_lost_count} packets\n"
        f"{r.event_dropped_count} events, {r.frame_dropped_count} renders",
        f"0: {_verdict(lost == 0)}",
    )
    table.add_row("overruns", f"{r.overrun_count} control periods; time was held back by {r.slipped_s:.3f} s")
    for name, grown in r.grown_bytes.items():
        table.add_row(
            f"memory, {name}",
            "not known" if grown is None else f"grown by {grown / 2**20:.2f} MiB since it settled",
            f"< {GROWTH_BAR_BYTES / 2**20:g} MiB: {_verdict(grown is not None and grown < GROWTH_BAR_BYTES)}",
        )
    console.print(table, highlight=False)


def _verdict(met: bool) -> str:
    return "met" if met else "missed"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3f} ms"


def stream_table(result: StreamResult, calibration: Calibration) -> Table:
    """Return one row for each figure: name, value, unit."""
    rows: list[tuple[str, Any, str]] = [
        ("renders_hz", calibration.renders_hz, "Hz"),
        ("sampling_rate_hz", calibration.sampling_rate_hz, "Hz"),
    ]
    for field in dataclasses.fields(result):
        if field.name != "grown_bytes":
            unit = "s" if field.name.endswith(("_s", "seconds")) else ""
            rows.append((field.name, getattr(result, field.name), unit))
    rows += [(f"{name}_grown_bytes", grown, "B") for name, grown in result.grown_bytes.items()]
    return Table(
        name="streaming",
        title="streaming",
        columns={"name": "name", "value": "value", "unit": "unit"},
        rows=[{"name": name, "value": value, "unit": unit} for name, value, unit in rows],
    )


def _arrivals(trace: StreamTrace) -> Table:
    """Return when each sample of the IMU was taken and received [ns]."""
    received_ns = trace.imu_received_ns - trace.imu_received_ns[0]
    return Table(
        name="arrivals",
        title="samples of the IMU",
        columns={"stamp_ns": "stamp [ns]", "received_ns": "received [ns]"},
        rows=[
            {"stamp_ns": stamp, "received_ns": received}
            for stamp, received in zip(trace.imu_stamp_ns.tolist(), received_ns.tolist(), strict=True)
        ],
    )


def _draw(trace: StreamTrace, figure: Figure) -> None:
    """Draw how late each sample of the IMU came, how often how much, and the memory."""
    figure.set_size_inches(14.0, 5.0)
    left, middle, right = figure.subplots(1, 3)
    late_ms = 1e3 * lateness_s(trace)
    since_s = 1e-9 * (trace.imu_received_ns - trace.imu_received_ns[0])
    left.plot(since_s, late_ms, ls="", marker=",")
    left.set(xlabel="wall-clock time [s]", ylabel="lateness [ms]", title="(i) each sample of the IMU")
    jitter_ms = np.sort(np.abs(late_ms))[::-1]
    middle.plot(jitter_ms, (np.arange(len(jitter_ms)) + 1) / len(jitter_ms), marker="")
    middle.axvline(1e3 * JITTER_BAR_S, color="0.7", label="bar of the 99th percentile")
    middle.axhline(0.01, color="0.7", ls=":")
    middle.set(xscale="log", yscale="log", xlabel="jitter [ms]", ylabel="share above", title="(ii) jitter")
    middle.set_xlim(left=1e-3)
    middle.legend()
    for name, resident in zip(_WATCHED, trace.resident_bytes.T, strict=True):
        right.plot(trace.resident_s, resident / 2**20, label=name, marker="")
    right.set(xlabel="wall-clock time [s]", ylabel="resident [MiB]", title="(iii) memory", ylim=(0, None))
    right.legend()


def bench_streaming(
    out: Path,
    console: Console,
    *,
    seconds: float = 60.0,
    width: int = 346,
    height: int = 260,
    device: str = "auto",
    scene: Path | None = None,
    sampling_rate_hz: float | None = None,
    settings: Mapping[str, Any] | None = None,
) -> StreamResult:
    """Measure, print, and leave streaming.csv, arrivals.csv and streaming.png.

    Args:
        out: Folder, made if need be; files of these names are replaced.
        console: Where to print.
        seconds: How long to listen [wall-clock s].
        width: Columns of the event camera [px].
        height: Rows [px].
        device: Where to compute.
        scene: A mesh file; None: the generated apartment.
        sampling_rate_hz: How often to render the event camera [Hz]; None: what this machine can do.
        settings: Further ones, by dotted key.
    """
    shape: dict[str, Any] = {"width": width, "height": height, "device": device, "scene": scene}
    stream_config(
        _SAMPLING_RATES_HZ[0], seconds=seconds, settings=settings, **shape
    )  # refuses before it works
    out.mkdir(parents=True, exist_ok=True)
    notes = describe_machine(None if device == "auto" else device)
    with console.status("how fast does this machine render?") as status:
        if sampling_rate_hz is None:
            calibration = calibrate(**shape)
        else:
            calibration = Calibration(renders_hz=None, sampling_rate_hz=sampling_rate_hz)
        config = stream_config(calibration.sampling_rate_hz, seconds=seconds, settings=settings, **shape)
        status.update(f"streaming for {seconds:g} s")
        steal_time = StealTime()
        trace = measure_stream(config, seconds=seconds)
    notes += steal_time.notes()
    result = summarise(trace)
    title = (
        f"streaming at factor 1, IMU at {_IMU_RATE_HZ:g} Hz, event camera {width}x{height} rendered at "
        f"{calibration}"
    )
    console.print("\n".join([title, *notes]), highlight=False, soft_wrap=True)
    print_stream(result, console)
    plot = Plot(name="streaming", title=title, draw=lambda figure: _draw(trace, figure))
    tables = [stream_table(result, calibration), _arrivals(trace)]
    save_files(out, console, tables=tables, plots=[plot], notes=notes)
    return result
