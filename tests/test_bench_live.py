"""The benchmarks of the live stack, at tiny sizes: what they leave, what it says, and how they fail."""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from processes import SOON_S, wait_for

from neurosim_core import cli
from neurosim_core.bench import closed_loop
from neurosim_core.bench.delay import predicted_settings
from neurosim_core.bench.options import Options
from neurosim_core.bench.processes import NeurosimProcess, ProcessEnded, own_runtime
from neurosim_core.bench.report import read_chapter
from neurosim_core.bench.streaming import summarise

SMALL = ["--device", "cpu", "--width", "64", "--height", "48", "--set", "scene.rooms=1"]
PAGE = {"report.html"}


def test_closed_loop(tmp_path):
    out = tmp_path / "loop"
    assert (
        cli.main(["bench", "closed-loop", "--rates", "200", "--seconds", "0.5", "--out", str(out), *SMALL])
        == 0
    )
    assert {p.name for p in out.iterdir()} == {f"closed-loop.{end}" for end in ("csv", "png", "json")} | PAGE
    lockstep, streaming = read_chapter(out, "closed-loop").tables[0].rows
    assert (lockstep["mode"], streaming["mode"]) == ("lockstep", "streaming")
    for row in (lockstep, streaming):
        assert row["requested [Hz]"] == 200.0
        assert row["bytes"] == 64 * 48 * 3
        assert row["images"] >= 10
        assert 0.0 < row["transport [ms]"] <= row["its 99 % [ms]"] < 1e3 * SOON_S
    assert lockstep["transport [ms]"] < lockstep["command to image [ms]"] <= lockstep["99 % [ms]"]
    assert lockstep["lost"] == 0
    assert "command to image [ms]" not in streaming
    assert streaming["received [Hz]"] < 220.0  # no faster than real time


def test_streaming(tmp_path):
    out = tmp_path / "stream"
    command = ["bench", "streaming", "--seconds", "0.5", "--sampling-rate", "20", "--out", str(out), *SMALL]
    command += ["--set", "path.kind=hover"]  # quickly planned
    assert cli.main(command) == 0
    assert {p.name for p in out.iterdir()} == {f"streaming.{end}" for end in ("csv", "png", "json")} | PAGE
    figures = {row["figure"]: row["value"] for row in read_chapter(out, "streaming").tables[0].rows}
    assert figures["renders a second [Hz]"] == 20.0
    assert figures["IMU samples lost"] == 0
    assert 0.01 < figures["real-time factor"] < 1.2
    assert 0.0 <= figures["jitter, median [ms]"] <= figures["jitter, largest [ms]"] < 1e3 * SOON_S
    assert figures["IMU samples"] > 100


def trace(late_ns=0, lost=0, grown=0):
    """Return what a listener would have noted of 3 s with an IMU at 1 kHz; 2 % of the samples are late."""
    stamps = np.arange(3000) * 1_000_000
    received = stamps + 5_000_000 + np.where(np.arange(3000) % 50 == 7, late_ns, 0)
    sensors = [SimpleNamespace(name="events", dropped_count=0)]
    return SimpleNamespace(
        imu_stamp_ns=stamps, imu_received_ns=received, imu_lost_count=lost, packet_count=3, event_count=9,
        packet_lost_count=0, event_dropped_count=0, resident_s=np.array([0.0, 1.0, 2.0, 3.0]),
        resident_bytes=np.array([[0, 0], [8, 8], [8, 8], [8 + grown, 8]]),
        status=SimpleNamespace(sensors=sensors, overrun_count=0, slipped_ns=0),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("fault", "met"),
    [
        ({}, [True, True, True]),
        ({"late_ns": 2_000_000}, [False, True, True]),
        ({"lost": 1}, [True, False, True]),
        ({"grown": 8 << 20}, [True, True, False]),
    ],
)
def test_claims_on_a_stream_see_planted_faults(fault, met):
    assert [claim.met for claim in summarise(trace(**fault), 20.0, "64x48").claims] == met


def test_lockstep_asks_as_rarely_and_delays_as_long():
    """At 200 Hz, 20 ms are 4 control periods; with what else it takes, a command misses the fourth."""
    settings = predicted_settings(0.02, control_rate_hz=200.0, transport_s=5e-4)
    assert settings.pop("links.command.latency_s") == pytest.approx(0.0205, abs=1e-12)
    assert settings == {"live.mode": "lockstep", "live.command_every": 4}
    assert predicted_settings(0.0, control_rate_hz=200.0, transport_s=5e-4)["live.command_every"] == 1


def test_a_simulator_that_cannot_start_says_why(tmp_path):
    said = r"(?s)`neurosim serve` ended with status 1; .*device 'cuda:77'"
    with pytest.raises(ProcessEnded, match=said):
        closed_loop.measure(Options(device="cuda:77", rates=(100.0,), seconds=0.1))


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["closed-loop", "--rates", "fast"], 2, "takes numbers with commas between them, got 'fast'"),
        (["closed-loop", "--rates", "100,0"], 1, "--rates: Input should be greater than 0, got 0.0"),
        (["closed-loop", "--seconds", "-1"], 1, "seconds must be > 0 and <= 3600, got -1.0"),
        (["closed-loop", "--set", "scene.rooms"], 1, "--set takes KEY=VALUE"),
        (["streaming", "--seconds", "nan", "--sampling-rate", "20"], 1, "nan"),
        (["delay", "--delays", "-1"], 1, "delays must be from 0 to less than 10 s, got [-1.0]"),
        (["delay", "--tours", "0"], 1, "tours must be > 0, got 0"),
        (["sprint"], 2, "invalid choice: 'sprint'"),
    ],
)
def test_wrong_use(tmp_path, capsys, monkeypatch, arguments, status, said):
    monkeypatch.chdir(tmp_path)
    try:
        code = cli.main(["bench", *arguments])
    except SystemExit as end:
        code = end.code
    assert code == status
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())  # refused before anything was begun


def test_the_runtime_of_a_benchmark_is_its_own(monkeypatch):
    monkeypatch.setenv("CORTEX_RUNTIME_DIR", "/somewhere/else")
    with own_runtime() as folder:
        assert os.environ["CORTEX_RUNTIME_DIR"] == str(folder / "cortex")
    assert os.environ["CORTEX_RUNTIME_DIR"] == "/somewhere/else"
    assert not folder.exists()
    monkeypatch.delenv("CORTEX_RUNTIME_DIR")
    with own_runtime():
        pass
    assert "CORTEX_RUNTIME_DIR" not in os.environ


def test_a_process_that_does_not_end_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr("neurosim_core.bench.processes._STOP_S", 0.2)
    started = subprocess.Popen
    deaf = lambda command, **options: started([sys.executable, str(script)], **options)  # noqa: E731
    monkeypatch.setattr("neurosim_core.bench.processes.subprocess.Popen", deaf)
    script = tmp_path / "deaf.py"
    script.write_text("""
import signal
signal.signal(signal.SIGINT, signal.SIG_IGN)
print("deaf", flush=True)
signal.pause()
""")
    with NeurosimProcess("serve", None, log=tmp_path / "log") as process:
        wait_for(lambda: "deaf" in process.last_lines())
        process.check()
        assert process.resident_bytes() > 1_000_000
        with pytest.raises(
            TimeoutError, match=r"`neurosim serve` did not end within 0.01 s; it said:\n  deaf"
        ):
            process.wait(0.01)
    with pytest.raises(ProcessEnded, match=r"`neurosim serve` ended with status -9; it said:\n  deaf"):
        process.check()
    assert process.resident_bytes() == -1
    with pytest.raises(ProcessEnded):
        process.wait(SOON_S)
