"""The closed loop between processes: how long a command takes to be seen, and how many images a second come.

For each rate a simulator and a controller, two processes, fly twice. *Lockstep*: the simulator waits for
each command, which holds from the state on that it answers; the time from command to image is what Cortex,
the dynamics and the renderer take. *Streaming*: time passes at the pace of the wall clock, as long as the
machine keeps up.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from neurosim_core.bench import engine
from neurosim_core.bench.options import Options
from neurosim_core.bench.processes import NeurosimProcess, own_runtime
from neurosim_core.bench.report import Chapter, Claim, Plot, Row, Series, Table, panel

RATES_HZ = (100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0)
TRANSPORT_MS = 0.5
"""What the transport of an image may take in the median."""
_CAMERA = "camera"


def measure(options: Options) -> Chapter:
    """Start simulators, close the loop over Cortex, and measure."""
    seconds = (0.5 if options.quick else 3.0) if options.seconds is None else options.seconds
    if not 0.0 < seconds <= 3600.0:  # also refuses nan
        raise ValueError(f"seconds must be > 0 and <= 3600, got {seconds}")
    rates = options.rates or ((100.0, 1000.0) if options.quick else RATES_HZ)
    width, height = options.width or 640, options.height or 480
    names = engine.option_names(_CAMERA, rate_hz="--rates") | {"control.rate_hz": "--rates"}
    names |= engine.set_options(options.settings)
    configs = []
    for mode, rate_hz in itertools.product(("lockstep", "streaming"), rates):
        lens = {"width": width, "height": height, "horizontal_fov_rad": 1.5}
        case: dict[str, Any] = {
            "device": options.device,
            "renderer": options.renderer,
            "instants_per_launch": 1,
            "path": {"kind": "hover"},
            "vehicle": {"on_collision": "report"},
            "control": {"rate_hz": rate_hz},
            "sensors": {_CAMERA: {"kind": "rgb", "rate_hz": rate_hz, "lens": lens}},
            "live": {"mode": mode, "command_timeout_s": 60.0, "fail_safe": "hold"},
            **engine.scene_settings(options.scene),
        }
        configs.append(engine.load_config(case, overrides=options.settings, options=names))
    rows = []
    for config in configs:  # all are checked before the first is flown
        options.progress(f"{config.live.mode}, {config.control.rate_hz:g} Hz")
        rows.append(measure_loop(config, seconds=seconds))
    return _chapter(rows, f"RGB {width}x{height}, {options.renderer} renderer")


def measure_loop(config: engine.SimulationConfig, *, seconds: float) -> Row:
    """Fly a simulator from this process, and return a row of what was measured; times are wall-clock."""
    airframe = config.vehicle.airframe()
    with (
        own_runtime() as folder,
        NeurosimProcess("serve", config, log=folder / "serve.log") as simulator,
        simulator.with_output(),
    ):
        trace = engine.answer_images(
            vehicle=next(iter(config.vehicles)),
            camera=_CAMERA,
            speed_rad_s=np.full(airframe.rotor_count, airframe.hover_rotor_speed_rad_s),
            seconds=seconds,
            warm_up_s=min(0.5 * seconds, 1.0),
            check=simulator.check,
            spin_s=1e-3 if config.live.mode == "lockstep" else 0.0,
        )
    transport_s = 1e-9 * (trace.received_ns - trace.published_ns)
    row: Row = {"mode": config.live.mode, "requested [Hz]": config.control.rate_hz}
    row["received [Hz]"] = 1e9 * (len(trace.received_ns) - 1) / float(np.ptp(trace.received_ns))
    if config.live.mode == "lockstep":
        # the last command that answers an earlier stamp is the one that an image shows
        shown = np.searchsorted(trace.answered_ns, trace.image_stamp_ns) - 1
        latency_s = 1e-9 * (trace.received_ns - trace.sent_ns[shown])[shown >= 0]
        row["command to image [ms]"], row["99 % [ms]"] = 1e3 * np.quantile(latency_s, [0.5, 0.99])
    row["transport [ms]"], row["its 99 % [ms]"] = 1e3 * np.quantile(transport_s, [0.5, 0.99])
    row |= {"images": len(trace.received_ns), "bytes": trace.image_bytes}
    return {**row, "lost": trace.lost_count, "overtaken": trace.overtaken_count}


def _chapter(rows: list[Row], title: str) -> Chapter:
    worst_ms = max(row["transport [ms]"] for row in rows)
    lockstep = [row for row in rows if row["mode"] == "lockstep"]
    fastest = max(lockstep, key=lambda row: row["received [Hz]"])
    rates = sorted({row["requested [Hz]"] for row in rows})
    x = "requested [Hz]"
    periods = Series(label="one period", x=rates, y=[1e3 / rate for rate in rates], style="dashed")
    asked = Series(label="as requested", x=rates, y=rates, style="dashed")
    timed = [{**row, "what": f"transport, {row['mode']}", "[ms]": row["transport [ms]"]} for row in rows]
    whole = "command to image"
    timed += [{**row, "what": f"{whole}, lockstep", "[ms]": row[f"{whole} [ms]"]} for row in lockstep]
    panels = [
        panel(timed, x, "[ms]", by="what", title="latency", log="xy", series=[periods]),
        panel(rows, x, "received [Hz]", by="mode", title="rate", log="xy", series=[asked]),
    ]
    return Chapter(
        name="closed-loop",
        title="The closed loop between processes",
        summary=f"{title}, hover. In lockstep the first image that shows a command comes "
        f"{fastest['command to image [ms]']:.3f} ms after it (median), and {fastest['received [Hz]']:,.0f} "
        "images a second come.",
        claims=[
            Claim(f"the transport of an image takes at most {TRANSPORT_MS:g} ms in the median at every rate",
                  "half the period of a 1 kHz loop; Neurosim paper, arXiv 2602.15018: whole loop < 0.7 ms",
                  f"{worst_ms:.3f} ms at most", worst_ms <= TRANSPORT_MS),
            Claim("no image is lost in lockstep",
                  "the simulator waits for the command that answers each image",
                  f"{sum(row['lost'] for row in lockstep)} lost",
                  not any(row["lost"] for row in lockstep)),
        ],
        tables=[Table("closed-loop", title, rows, "Wall-clock times. Overtaken: newer images came first.")],
        plots=[Plot("closed-loop", title, panels, 2)],
    )  # fmt: skip
