"""Recordings of a live run: files, folders, settings that change, and a disk that fails."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from live_rig import make_config, models_of

from neurosim_core.config import load_config
from neurosim_core.live.recorder import Recorder, open_folders
from neurosim_core.live.services import change_parameters
from neurosim_core.packets import ImuSample
from neurosim_core.record import Recording
from neurosim_core.record.process import RecordingProcess


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
    with Recording(file) as flight:
        return [packet.stamp_ns for packet in flight.packets()]


def test_a_disk_that_fails_is_told_and_hangs_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fail(self: RecordingProcess, packet: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(RecordingProcess, "write", fail)
    recorder = make_recorder(tmp_path)
    with pytest.raises(OSError, match="no space left"):
        recorder.write("drone", imu(0))
    recorder.close()


def test_a_reset_completes_the_file_before_it(tmp_path: Path):
    recorder = make_recorder(tmp_path)
    recorder.write("drone", imu(0))
    recorder.begin({"drone": 12}, replace=False)
    with Recording(tmp_path / "flight.h5") as flight:
        assert flight.clean
    recorder.close()


def test_what_waits_is_written_before_it_closes(tmp_path: Path):
    recorder = make_recorder(tmp_path)
    for number in range(1000):
        recorder.write("drone", imu(number))
    recorder.close()
    assert stamps(tmp_path / "flight.h5") == [1000 * number for number in range(1000)]
    with Recording(tmp_path / "flight.h5") as flight:
        assert flight.header.seed == 11


def test_files_say_which_settings_hold_and_which_were_changed(tmp_path: Path):
    """What changes while a file is open is a line beside it; the file after that begins with it."""
    config = make_config()
    recorder = make_recorder(tmp_path)
    recorder.write("drone", imu(0))
    offset = change_parameters(config, {"links.imu.clock_offset_s": 0.003})
    recorder.change(offset, stamp_ns=335_000_000)
    recorder.change(change_parameters(offset, {"live.fail_safe": "cut"}), stamp_ns=400_000_000)
    recorder.begin({"drone": 12}, replace=False)
    recorder.write("drone", imu(0))
    recorder.close()
    with Recording(tmp_path / "flight.h5") as flight:
        first = load_config(yaml.safe_load(flight.header.config_yaml))
    with Recording(tmp_path / "flight-2.h5") as flight:
        second = load_config(yaml.safe_load(flight.header.config_yaml))
    assert "imu" not in first.links
    assert (second.links["imu"].clock_offset_s, second.live.fail_safe, second.seed) == (0.003, "cut", 12)
    lines = [json.loads(line) for line in (tmp_path / "settings.jsonl").read_text().splitlines()]
    at = {"file": "flight.h5", "stamp_ns": 335_000_000}
    assert {**at, "key": "links.imu.clock_offset_s", "value": 0.003, "before": None} in lines
    assert lines[-1] == {
        "file": "flight.h5",
        "stamp_ns": 400_000_000,
        "key": "live.fail_safe",
        "value": "cut",
        "before": "hover",
    }


def test_a_file_that_is_replaced_begins_with_what_was_changed(tmp_path: Path):
    recorder = make_recorder(tmp_path)
    recorder.write("drone", imu(0))
    recorder.change(change_parameters(make_config(), {"live.fail_safe": "cut"}), stamp_ns=0)
    assert (tmp_path / "settings.jsonl").read_text()
    recorder.begin({"drone": 11}, replace=True)
    recorder.write("drone", imu(0))
    recorder.close()
    assert not (tmp_path / "settings.jsonl").read_text()
    with Recording(tmp_path / "flight.h5") as flight:
        assert load_config(yaml.safe_load(flight.header.config_yaml)).live.fail_safe == "cut"


def test_several_vehicles_have_folders_of_their_own(tmp_path: Path):
    assert open_folders(tmp_path, ["drone"], overwrite=False) == {"drone": tmp_path}
    folders = open_folders(tmp_path, ["red", "blue"], overwrite=False)
    assert folders == {"red": tmp_path / "red", "blue": tmp_path / "blue"}
    (tmp_path / "blue").mkdir()
    (tmp_path / "blue" / "flight.h5").touch()
    with pytest.raises(FileExistsError, match="blue already holds a flight"):
        open_folders(tmp_path, ["red", "blue"], overwrite=False)
    assert open_folders(tmp_path, ["red", "blue"], overwrite=True) == folders
