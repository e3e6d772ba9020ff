"""`neurosim dataset`: whole, killed and continued, grown, and refused where something else is."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from neurosim_core import cli, data
from neurosim_core.record import Recording

LENS = {"width": 24, "height": 18, "horizontal_fov_rad": 1.5}
SETTINGS = {
    "duration_s": 0.2,
    "device": "cpu",
    "renderer": "synthetic",
    "scene": {"kind": "apartment", "rooms": 1},
    "path": {"kind": "tour"},
    "sensors": {
        "events": {"kind": "event_camera", "lens": LENS},
        "depth": {"kind": "depth", "rate_hz": 50.0, "lens": LENS},
        "odometry": {"kind": "odometry", "rate_hz": 100.0},
    },
}


def command(folder: Path, *more: str) -> list[str]:
    settings = folder.parent.parent / "house.yaml"
    settings.write_text(yaml.safe_dump(SETTINGS))
    return [
        "dataset",
        str(settings),
        "--flights",
        "4",
        "--flights-per-scene",
        "2",
        "--out",
        folder.name,
        *more,
    ]


def checksums(folder: Path) -> dict[str, str]:
    lines = (folder / "SHA256SUMS").read_text().splitlines()
    return {name: digest for digest, name in (line.split("  ") for line in lines)}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "one" / "data"
    folder.parent.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder.parent)
        patch.setattr(sys, "argv", ["neurosim", *command(folder, "--workers", "0")])
        assert cli.main(sys.argv[1:]) == 0
    return folder


def test_what_is_in_it(whole):
    files = checksums(whole)
    assert {
        "README.md",
        "sheet.png",
        "dataset.yaml",
        "flights/00003.h5",
        "flights/00003.json",
    } <= files.keys()
    for name, digest in files.items():
        assert hashlib.sha256((whole / name).read_bytes()).hexdigest() == digest
    card = (whole / "README.md").read_text()
    assert "neurosim dataset" in card
    assert "--workers" not in card
    assert "| flights | 4, 0.8 s in all" in card
    assert "| depth | median " in card
    assert "a generated scene `scene.seed + k // 2`" in card
    stream = data.Stream(whole, window_s=0.02, shuffle=True, fields=["events", "depth"])
    assert sum(len(batch) for batch in stream) == 40
    starts = []
    for number in range(4):
        with Recording(whole / f"flights/0000{number}.h5") as recording:
            assert recording.clean
            assert recording.header.seed == number
            starts.append((recording.header.scene, *recording.column("odometry", "position")[0].tolist()))
    assert len({start[1:] for start in starts}) == 4
    depths = [data.Dataset(path, fields=["depth"])[1].depth for path in sorted(whole.rglob("*.h5"))]
    assert not np.array_equal(depths[0], depths[1])


def test_killed_and_continued(whole, tmp_path):
    """Killed after its first flight, with its workers; continued, it is the same to the byte."""
    folder = tmp_path / "made" / "data"
    folder.parent.mkdir()
    words = [sys.executable, "-m", "neurosim_core", *command(folder, "--workers", "2")]
    root = Path(cli.__file__).resolve().parents[1]
    env = {**os.environ, "PYTHONPATH": str(root)}
    killed = subprocess.Popen(words, cwd=folder.parent, env=env, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 120.0
    while not [*folder.glob("flights/*.h5")] and killed.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert not (folder / "SHA256SUMS").exists()
    done = subprocess.run(words, cwd=folder.parent, env=env, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    one, two = checksums(whole), checksums(folder)
    for name in ("README.md",):  # says which settings file it was made from, which lies elsewhere
        del one[name], two[name]
    assert one == two


def test_it_can_grow(whole, tmp_path, monkeypatch):
    """More flights are added; those that are there stay as they are."""
    monkeypatch.chdir(whole.parent)
    before = checksums(whole)
    words = command(whole, "--workers", "0")
    words[words.index("--flights") + 1] = "5"
    words += ["--webdataset", str(tmp_path / "shards")]
    assert cli.main(words) == 0
    windows, shards = data.Dataset(whole), data.Dataset(tmp_path / "shards")
    assert [one.stamp_ns for one in windows] == [one.stamp_ns for one in shards] != []
    assert cli.main(words) == 1  # these shards are there
    after = checksums(whole)
    assert {name: after[name] for name in before if name.startswith("flights")} == {
        name: digest for name, digest in before.items() if name.startswith("flights")
    }
    assert "flights/00004.h5" in after


def test_other_settings_are_refused(whole, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(whole.parent)
    assert cli.main(command(whole, "--set", "duration_s=0.3")) == 1
    assert "holds a data set of other settings" in capsys.readouterr().err
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    assert cli.main(["dataset", "--flights", "1", "--out", str(tmp_path / "full")]) == 1
    assert "is not empty, and holds no data set" in capsys.readouterr().err
