"""A flight in real time between processes: how punctual an IMU at 1 kHz is beside an event camera.

Three processes: simulator, controller (`neurosim fly`), and this one, which listens.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from neurosim_core.bench import engine
from neurosim_core.bench.options import Options
from neurosim_core.bench.processes import NeurosimProcess, own_runtime
from neurosim_core.bench.report import Chapter, Claim, Panel, Plot, Row, Series, Table

_IMU, _CAMERA, _IMU_RATE_HZ = "imu", "events", 1000.0
_GROWTH_MAX_MIB = 4.0
_SETTLED_S = 10.0


def measure(options: Options) -> Chapter:
    """Fly in real time, and listen."""
    seconds = (5.0 if options.quick else 60.0) if options.seconds is None else options.seconds
    if not 0.0 < seconds <= 86_400.0:  # also refuses nan
        raise ValueError(f"seconds must be > 0 and <= 86400, got {seconds}")
    width, height = options.width or 346, options.height or 260
    rate_hz = options.sampling_rate or (25.0 if engine.find_device(options.device) == "cpu" else 500.0)
    lens = {"width": width, "height": height, "horizontal_fov_rad": 1.5}
    base: dict[str, Any] = {
        "duration_s": seconds + 5.0,
        "device": options.device,
        "vehicle": {"on_collision": "report"},
        "sensors": {
            _IMU: {"kind": "imu", "rate_hz": _IMU_RATE_HZ},
            _CAMERA: {"kind": "event_camera", "lens": lens, "sampling_rate_hz": rate_hz},
        },
        "live": {"mode": "streaming", "real_time_factor": 1.0},
        **engine.scene_settings(options.scene),
    }
    names = engine.option_names(_CAMERA, sampling_rate_hz="--sampling-rate")
    names |= engine.set_options(options.settings)
    config = engine.load_config(base, overrides=options.settings, options=names)
    options.progress(f"streaming for {seconds:g} s, {rate_hz:g} renders a second")
    vehicle = next(iter(config.vehicles))
    with (
        own_runtime() as folder,
        NeurosimProcess("serve", config, log=folder / "serve.log") as simulator,
        engine.StreamProbe(vehicle=vehicle, imu=_IMU, camera=_CAMERA) as probe,
        NeurosimProcess("fly", config, log=folder / "fly.log") as controller,
    ):

        def check() -> None:
            simulator.check()
            controller.check()

        with simulator.with_output():
            trace = probe.listen(
                seconds, resident=lambda: [p.resident_bytes() for p in (simulator, controller)], check=check
            )
    return summarise(trace, rate_hz, f"{width}x{height}")


def summarise(trace: Any, rate_hz: float, pixels: str) -> Chapter:
    """Return the chapter on a trace (`StreamTrace`) of an event camera that was rendered at a rate [Hz]."""
    late_ms = 1e-6 * (trace.imu_received_ns - trace.imu_stamp_ns)
    late_ms = late_ms - np.median(late_ms)  # against a clock that is set so that half of the samples are late
    jitter_ms = np.abs(late_ms)
    elapsed_s = 1e-9 * float(np.ptp(trace.imu_received_ns))
    settled = int(np.searchsorted(trace.resident_s, min(_SETTLED_S, 0.5 * trace.resident_s[-1])))
    grown_mib = (trace.resident_bytes[-1] - trace.resident_bytes[settled]) / 2**20
    status = trace.status
    left_out = sum(sensor.dropped_count for sensor in status.sensors if sensor.name == _CAMERA)
    lost = {"IMU samples lost": trace.imu_lost_count, "event packets lost": trace.packet_lost_count}
    lost |= {"events dropped": trace.event_dropped_count, "renders left out": left_out}
    figures: Row = {
        "renders a second [Hz]": rate_hz,
        "listened [s]": elapsed_s,
        "real-time factor": 1e-9 * float(np.ptp(trace.imu_stamp_ns)) / elapsed_s,
        "IMU samples": len(late_ms),
        "jitter, median [ms]": float(np.median(jitter_ms)),
        "jitter, 99 % [ms]": float(np.quantile(jitter_ms, 0.99)),
        "jitter, largest [ms]": float(jitter_ms.max()),
        "events": trace.event_count,
        **lost,
        "control periods that were too long": status.overrun_count,
        "time held back [s]": 1e-9 * status.slipped_ns,
        "memory grown, simulator [MiB]": float(grown_mib[0]),
        "memory grown, controller [MiB]": float(grown_mib[1]),
    }
    since_s = 1e-9 * (trace.imu_received_ns - trace.imu_received_ns[0])
    some = slice(None, None, max(1, len(late_ms) // 5000))
    period_ms, late = 1e3 / _IMU_RATE_HZ, figures["jitter, 99 % [ms]"]
    above, shares = np.sort(jitter_ms)[::-1][some], np.arange(1, len(jitter_ms) + 1)[some] / len(jitter_ms)
    lateness = Series(label="lateness", x=since_s[some].tolist(), y=late_ms[some].tolist())
    jitter = Series(label="jitter", x=above.tolist(), y=shares.tolist())
    memory = [
        Series(label=name, x=trace.resident_s.tolist(), y=(held / 2**20).tolist())
        for name, held in zip(("simulator", "controller"), trace.resident_bytes.T, strict=True)
    ]
    wall, period = "wall-clock time [s]", {"period of the IMU": period_ms}
    panels = [
        Panel(title="each sample", x_label=wall, y_label="lateness [ms]", series=[lateness]),
        Panel(x_label="jitter [ms]", y_label="share above", series=[jitter], log="xy", x_lines=period),
        Panel(title="memory", x_label=wall, y_label="resident [MiB]", series=memory, y_min=0.0),
    ]
    return Chapter(
        name="streaming",
        title="A flight in real time between processes",
        summary=f"IMU at 1 kHz beside an event camera of {pixels}, rendered at {rate_hz:g} Hz: real-time "
        f"factor {figures['real-time factor']:.5f} over {elapsed_s:.0f} s; 99 % of the IMU's samples are at "
        f"most {late:.3f} ms early or late.",
        claims=[
            Claim("99 % of the IMU's samples are less than a period early or late",
                  "the period of the IMU, 1 ms", f"{late:.3f} ms", late < period_ms),
            Claim("nothing is lost", "sequence numbers of the messages",
                  ", ".join(f"{name}: {count}" for name, count in lost.items()), not any(lost.values())),
            Claim(f"no process grows by more than {_GROWTH_MAX_MIB:g} MiB after it has settled",
                  "resident memory, as the system reports it",
                  f"{grown_mib[0]:.2f} and {grown_mib[1]:.2f} MiB",
                  bool((grown_mib < _GROWTH_MAX_MIB).all())),
        ],
        tables=[Table("streaming", "Figures", [{"figure": k, "value": v} for k, v in figures.items()])],
        plots=[Plot("streaming", "An IMU at 1 kHz in real time", panels)],
    )  # fmt: skip
