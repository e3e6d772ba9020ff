"""The figures of a stream: lateness, loss, growth, and the size of the camera."""

from __future__ import annotations

import csv
import dataclasses
import io
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from neurosim_core.bench import streaming
from neurosim_core.bench.chapter import save_table
from neurosim_core.live.probe import StreamTrace

MS = 1_000_000
MIB = 1 << 20


def heard(late_ns, **changes):
    """Return what is heard of an IMU at 1 kHz whose samples come so late, on a clock 5 s ahead."""
    late_ns = np.asarray(late_ns, dtype=np.int64)
    stamps = np.arange(len(late_ns)) * MS
    seconds = np.arange(0.0, len(late_ns) / 1000.0, 1.0)
    trace = StreamTrace(
        imu_stamp_ns=stamps,
        imu_received_ns=stamps + 5_000_000_000 + late_ns,
        imu_lost_count=0,
        packet_count=10,
        event_count=1000,
        packet_lost_count=0,
        event_dropped_count=0,
        status=SimpleNamespace(
            overrun_count=3,
            slipped_ns=2 * MS,
            sensors=[
                SimpleNamespace(name="imu", dropped_count=99),
                SimpleNamespace(name="events", dropped_count=0),
            ],
        ),
        resident_bytes=np.full((len(seconds), 2), 100 * MIB),
        resident_s=seconds,
    )
    return dataclasses.replace(trace, **changes)


def printed(result):
    out = io.StringIO()
    streaming.print_stream(result, Console(file=out, width=120))
    return out.getvalue()


def test_jitter_is_measured_from_the_usual_arrival():
    """All come 0.3 ms late, which is no jitter; every fifth 2 ms later than that, and one a little early."""
    late = np.full(20_000, 0.3 * MS)
    late[::5] += 2 * MS
    late[7] -= 0.9 * MS
    result = streaming.summarise(heard(late))
    assert result.jitter_median_s == 0.0
    assert result.jitter_p99_s == pytest.approx(2e-3)
    assert streaming.lateness_s(heard(late))[7] == pytest.approx(-0.9e-3)
    assert result.interval_max_s == pytest.approx(3e-3)
    assert result.real_time_factor == pytest.approx(1.0, abs=2e-4)  # the first sample was 2 ms late
    assert "p99 < 1.000 ms: missed" in printed(result)


def test_what_comes_early_is_jitter_too():
    late = np.zeros(5000)
    late[3000] = -0.9 * MS
    assert streaming.summarise(heard(late)).jitter_max_s == pytest.approx(0.9e-3)


def test_drift_is_jitter_too():
    """10 ms are lost in 10 s, evenly: the two ends are 5 ms from the middle."""
    result = streaming.summarise(heard(np.arange(10_000) * 1000))
    assert result.jitter_max_s == pytest.approx(5e-3, rel=1e-3)
    assert result.jitter_median_s == pytest.approx(2.5e-3, rel=1e-3)
    assert result.real_time_factor == pytest.approx(1.0 / 1.001, rel=1e-6)


def test_a_perfect_stream_meets_every_bar():
    result = streaming.summarise(heard(np.zeros(20_000)))
    assert (result.overrun_count, result.slipped_s) == (3, pytest.approx(2e-3))
    assert result.frame_dropped_count == 0  # that of the camera, not of the IMU
    assert printed(result).count(": met") == 4
    assert "missed" not in printed(result)


@pytest.mark.parametrize("what", ["imu_lost_count", "packet_lost_count", "event_dropped_count"])
def test_every_loss_misses_the_bar(what):
    assert "0: missed" in printed(streaming.summarise(heard(np.zeros(2000), **{what: 1})))


def test_a_render_that_was_left_out_is_a_loss():
    trace = heard(np.zeros(2000))
    trace.status.sensors[1].dropped_count = 1
    assert "0: missed" in printed(streaming.summarise(trace))


def test_growth_counts_from_ten_seconds_on():
    seconds = np.arange(31.0)
    simulator = np.where(seconds < 9.5, 50, 100) * MIB  # what comes until then is the beginning
    controller = (100 + (seconds > 20) * 5) * MIB
    memory = np.stack([simulator, controller], axis=1)
    result = streaming.summarise(heard(np.zeros(30_000), resident_bytes=memory, resident_s=seconds))
    assert result.grown_bytes == {"simulator": 0, "controller": 5 * MIB}
    assert "grown by 5.00 MiB since it settled" in printed(result)
    unknown = heard(np.zeros(30_000), resident_bytes=np.full((31, 2), -1), resident_s=seconds)
    assert streaming.summarise(unknown).grown_bytes == {"simulator": None, "controller": None}
    assert printed(streaming.summarise(unknown)).count("not known") == 2


@pytest.mark.parametrize(
    ("renders_hz", "chosen"), [(10_000.0, 1000.0), (600.0, 100.0), (250.0, 50.0), (3.0, 5.0)]
)
def test_the_camera_is_sized_to_the_machine(monkeypatch, renders_hz, chosen):
    """At most a quarter of what it can do, and the slowest there is on a machine that can do nothing."""
    asked = {}
    monkeypatch.setattr(
        streaming, "measure_steps", lambda **given: asked.update(given) or SimpleNamespace(median=renders_hz)
    )
    calibration = streaming.calibrate(width=346, height=260, device="cpu", scene=None)
    assert calibration.sampling_rate_hz == chosen
    assert (asked["width"], asked["height"], asked["device"]) == (346, 260, "cpu")
    share = f"{100 * chosen / renders_hz:.0f} % of the {renders_hz:.0f} /s"
    assert share in str(calibration)


def test_the_csv_has_every_figure(tmp_path):
    result = streaming.summarise(heard(np.zeros(2000)))
    calibration = streaming.Calibration(renders_hz=200.0, sampling_rate_hz=50.0)
    with save_table(streaming.stream_table(result, calibration), tmp_path).open(newline="") as file:
        rows = {row["name"]: (row["value"], row["unit"]) for row in csv.DictReader(file)}
    names = {f.name for f in dataclasses.fields(result)} - {"grown_bytes"}
    assert set(rows) == names | {
        "renders_hz", "sampling_rate_hz", "simulator_grown_bytes", "controller_grown_bytes",
    }  # fmt: skip
    assert rows["sampling_rate_hz"] == ("50.0", "Hz")
    assert rows["jitter_p99_s"] == ("0.0", "s")
    assert rows["imu_count"] == ("2000", "")
    assert rows["simulator_grown_bytes"] == ("0", "B")
