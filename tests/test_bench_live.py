"""The benchmarks of the live stack, at tiny sizes: what they leave, what it says, and how they fail."""

from __future__ import annotations

import csv
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from processes import SOON_S, wait_for

from neurosim_core import cli
from neurosim_core.bench.closed_loop import loop_config, measure_loop
from neurosim_core.bench.processes import NeurosimProcess, ProcessEnded, own_runtime

SMALL = ["--device", "cpu", "--width", "64", "--height", "48", "--set", "scene.rooms=1"]


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as text:
        return list(csv.DictReader(text))


def looks_drawn(file: Path) -> bool:
    with Image.open(file) as picture:
        return min(picture.size) > 300 and np.asarray(picture.convert("L")).std() > 5.0


def test_closed_loop(tmp_path, capsys):
    out = tmp_path / "loop"
    assert (
        cli.main(["bench", "closed-loop", "--rates", "200", "--seconds", "0.5", "--out", str(out), *SMALL])
        == 0
    )
    assert {p.name for p in out.iterdir()} == {"closed-loop.csv", "closed-loop.png"}
    assert looks_drawn(out / "closed-loop.png")
    lockstep, streaming = rows_of(out / "closed-loop.csv")
    assert (lockstep["mode"], streaming["mode"]) == ("lockstep", "streaming")
    for row in (lockstep, streaming):
        figures = {name: float(value) for name, value in row.items() if name != "mode"}
        assert figures["requested_hz"] == 200.0
        assert figures["image_bytes"] == 64 * 48 * 3
        assert figures["image_count"] >= 10
        assert 0.0 < figures["transport_median_s"] <= figures["transport_p99_s"] < SOON_S
        assert (
            figures["transport_median_s"] < figures["latency_median_s"] <= figures["latency_p99_s"] < SOON_S
        )
        assert figures["transport_median_s"] < 1.0
        assert figures["received_hz"] > 0.1
        assert figures["unfelt_count"] < figures["image_count"]
    assert float(lockstep["unfelt_count"]) <= 2  # the last ones: nobody waited for their images
    assert float(streaming["received_hz"]) < 220.0  # no faster than real time
    said = capsys.readouterr().out
    for part in ("64x48", "synthetic renderer", "lockstep", "streaming", "transport of 0.01 MB", "Neurosim"):
        assert part in said


def test_streaming(tmp_path, capsys):
    out = tmp_path / "stream"
    command = ["bench", "streaming", "--seconds", "0.5", "--sampling-rate", "20", "--out", str(out), *SMALL]
    command += ["--set", "path.kind=hover"]  # quickly planned
    assert cli.main(command) == 0
    assert {p.name for p in out.iterdir()} == {"streaming.csv", "arrivals.csv", "streaming.png"}
    assert looks_drawn(out / "streaming.png")
    figures = {row["name"]: row["value"] for row in rows_of(out / "streaming.csv")}
    assert float(figures["sampling_rate_hz"]) == 20.0
    assert int(figures["imu_lost_count"]) == 0
    assert 0.01 < float(figures["real_time_factor"]) < 1.2
    assert 0.0 <= float(figures["jitter_median_s"]) <= float(figures["jitter_max_s"]) < SOON_S
    arrivals = np.loadtxt(out / "arrivals.csv", delimiter=",", skiprows=1)
    assert len(arrivals) == int(figures["imu_count"])
    assert (np.diff(arrivals[:, 0]) == 1e6).all()
    assert (np.diff(arrivals[:, 1]) > 0).all()
    assert "rendered at 20 Hz" in capsys.readouterr().out


def test_a_simulator_that_cannot_start_says_why():
    config = loop_config("lockstep", 100.0, device="cuda:77")
    with pytest.raises(ProcessEnded, match=r"(?s)`neurosim serve` ended with status 1; .*device 'cuda:77'"):
        measure_loop(config, seconds=0.1)


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["closed-loop", "--rates", "fast"], 2, "takes numbers with commas between them, got 'fast'"),
        (["closed-loop", "--rates", "100,0"], 1, "--rates: Input should be greater than 0, got 0.0"),
        (["closed-loop", "--seconds", "-1"], 1, "seconds must be > 0 and <= 3600, got -1.0"),
        (["closed-loop", "--set", "scene.rooms"], 1, "--set takes KEY=VALUE"),
        (["streaming", "--seconds", "nan", "--sampling-rate", "20"], 1, "nan"),
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
    script = tmp_path / "deaf.py"
    script.write_text("""
import signal
signal.signal(signal.SIGINT, signal.SIG_IGN)
print("deaf", flush=True)
signal.pause()
""")
    with NeurosimProcess("serve", log=tmp_path / "log", python=[sys.executable, str(script)]) as process:
        wait_for(lambda: "deaf" in process.last_words())
        process.check()
        assert process.resident_bytes() > 1_000_000
        with pytest.raises(
            TimeoutError, match=r"`neurosim serve` did not end within 0.01 s; it said:\n  deaf"
        ):
            process.wait(0.01)
    with pytest.raises(ProcessEnded, match=r"`neurosim serve` ended with status -9; it said:\n  deaf"):
        process.check()
    assert process.resident_bytes() == -1
    assert process.wait(SOON_S) == -9
