"""Recording in a thread: nothing is lost where the disk is slow, and nothing hangs where it fails."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live_rig import make_config, models_of
from processes import SOON_S

from neurosim_core.nodes import recorder as recorder_module
from neurosim_core.nodes.recorder import Recorder, open_folders
from neurosim_core.packets import ImuSample
from neurosim_core.record import Flight, FlightWriter


def imu(number: int) -> ImuSample:
    return ImuSample(
        sensor="imu",
        stamp_ns=number * 1000,
        sequence=number,
        specific_force=np.full(3, float(number)),
        angular_rate=np.zeros(3),
    )


def make_recorder(folder: Path) -> Recorder:
    recorder = Recorder({"drone": folder}, models_of(make_config()))
    recorder.begin({"drone": 11}, replace=True)
    return recorder


def stamps(file: Path) -> list[int]:
    with Flight(file) as flight:
        return [packet.stamp_ns for packet in flight.packets()]


def test_a_slow_disk_holds_up_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The queue holds two packets; the third waits until one is written."""
    monkeypatch.setattr(recorder_module, "QUEUE_BYTES", 100)
    gate = threading.Semaphore(0)
    write = FlightWriter.write

    def slow(self: FlightWriter, packet: Any) -> None:
        assert gate.acquire(timeout=SOON_S)
        write(self, packet)

    monkeypatch.setattr(FlightWriter, "write", slow)
    recorder = make_recorder(tmp_path)
    written = []

    def fill() -> None:
        for number in range(6):
            recorder.write("drone", imu(number))
            written.append(number)

    filler = threading.Thread(target=fill)
    filler.start()
    deadline_s = time.monotonic() + SOON_S
    while len(written) < 3 and time.monotonic() < deadline_s:  # one at the writer, two in the queue
        filler.join(0.01)
    filler.join(0.05)
    assert len(written) == 3
    gate.release(6)
    filler.join(SOON_S)
    recorder.close()
    assert stamps(tmp_path / "flight.h5") == [0, 1000, 2000, 3000, 4000, 5000]


def test_a_disk_that_fails_is_told_and_hangs_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(recorder_module, "QUEUE_BYTES", 100)

    def fail(self: FlightWriter, packet: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(FlightWriter, "write", fail)
    recorder = make_recorder(tmp_path)
    with pytest.raises(OSError, match="no space left"):
        all(recorder.write("drone", imu(number)) is None for number in range(100))
    with pytest.raises(OSError, match="no space left"):
        recorder.close()
    recorder.close()


def test_what_waits_is_written_before_it_closes(tmp_path: Path):
    recorder = make_recorder(tmp_path)
    for number in range(1000):
        recorder.write("drone", imu(number))
    recorder.close()
    assert stamps(tmp_path / "flight.h5") == [1000 * number for number in range(1000)]
    with Flight(tmp_path / "flight.h5") as flight:
        assert flight.header.seed == 11


def test_several_vehicles_have_folders_of_their_own(tmp_path: Path):
    assert open_folders(tmp_path, ["drone"], overwrite=False) == {"drone": tmp_path}
    folders = open_folders(tmp_path, ["red", "blue"], overwrite=False)
    assert folders == {"red": tmp_path / "red", "blue": tmp_path / "blue"}
    (tmp_path / "blue").mkdir()
    (tmp_path / "blue" / "flight.h5").touch()
    with pytest.raises(FileExistsError, match="blue already holds a flight"):
        open_folders(tmp_path, ["red", "blue"], overwrite=False)
    assert open_folders(tmp_path, ["red", "blue"], overwrite=True) == folders
