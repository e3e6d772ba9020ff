"""`neurosim compare`: its numbers against closed forms, and its page."""

from __future__ import annotations

import contextlib
import shutil

import h5py
import numpy as np
import pytest
from PIL import Image

from neurosim_core import cli
from neurosim_core.data.compare import INTERVAL_EDGES_US, measure_events
from neurosim_core.io import create_events
from neurosim_core.packets import EventArrays


def write(path, t, x, y, polarity, size=(32, 24)):
    with contextlib.closing(create_events(path, width=size[0], height=size[1])) as writer:
        for index in np.array_split(np.arange(len(t)), 3):  # counted across blocks
            writer.write(EventArrays(t, x, y, polarity).rows(index))
    return path


def poisson(path, *, rate_hz=50.0, duration_s=4.0, on_share=0.25, seed=0):
    """Each pixel fires by itself, at a constant rate."""
    rng = np.random.default_rng(seed)
    count = rng.poisson(rate_hz * duration_s * 32 * 24)
    t = np.sort(rng.integers(0, round(duration_s * 1e6), count))
    x, y = rng.integers(0, 32, count).astype(np.uint16), rng.integers(0, 24, count).astype(np.uint16)
    return write(path, t, x, y, (rng.random(count) < on_share).astype(np.uint8))


def test_noise_has_the_statistics_of_a_poisson_process(tmp_path):
    """153,600 events: intervals are exponential, the spectrum is flat."""
    stats = measure_events(poisson(tmp_path / "a.h5"))
    # Six standard deviations of a Poisson count, of a binomial share, and of a bin of the rate.
    assert abs(stats.event_count - 153_600) < 6.0 * np.sqrt(153_600)
    assert abs(stats.on_share - 0.25) < 6.0 * np.sqrt(0.25 * 0.75 / 153_600)
    assert abs(stats.rate_hz[:-1] - 38_400.0).max() < 6.0 * np.sqrt(384.0) * 100.0
    assert stats.median_interval_us == pytest.approx(
        np.log(2.0) / 50.0 * 1e6, rel=0.02
    )  # within a bin: linear
    expected = np.diff(-np.exp(-50e-6 * INTERVAL_EDGES_US))
    share = stats.intervals / stats.intervals.sum()
    assert abs(share - expected).max() < 0.005  # those that reach beyond the end, 1 in 200, are missing
    assert stats.spectrum.sum() == pytest.approx(1.0)
    assert stats.spectrum[1:].max() < 2.0 * stats.spectrum[1:].min()
    assert (stats.width, stats.height, stats.silent_share) == (32, 24, 0.0)


def test_a_grating_has_its_frequency(tmp_path):
    """Every fourth column fires: 0.25 cycles/px."""
    x = np.tile(np.arange(0, 32, 4), 24)
    y = np.repeat(np.arange(24), 8)
    t = np.repeat(np.arange(10) * 20_000, len(x))
    columns = (np.tile(c, 10) for c in (x, y))
    path = write(tmp_path / "a.npz", t, *(c.astype(np.uint16) for c in columns), np.ones(len(t), np.uint8))
    stats = measure_events(path)
    assert abs(stats.frequency[np.argmax(stats.spectrum)] - 0.25) < 0.03  # one ring
    assert stats.silent_share == 0.75
    assert stats.median_interval_us == pytest.approx(20_000, rel=0.15)  # one bin
    assert stats.intervals.sum() == 9 * len(x)


def test_the_page(tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    one, two = poisson(tmp_path / "a.raw"), poisson(tmp_path / "b.dat", rate_hz=20.0, on_share=0.5)
    assert cli.main(["compare", str(one), str(two), "--out", str(tmp_path / "page.png")]) == 0
    text = capsys.readouterr().out
    assert "a.raw" in text
    assert "32x24" in text
    for heading in text.splitlines()[0].split()[-3:]:
        assert f"{heading}: " in text  # says what it is
    assert cli.main(["compare", str(tmp_path), "--out", str(tmp_path / "folder.png")]) == 0
    assert capsys.readouterr().out.splitlines()[:-1] == text.splitlines()[:-1]  # a folder is its files
    monkeypatch.setenv("COLUMNS", "500")  # or long paths would be folded
    again = tmp_path / "again" / "a.raw"
    again.parent.mkdir()
    shutil.copy(one, again)
    assert cli.main(["compare", str(one), str(again), str(two), "--out", str(tmp_path / "named.png")]) == 0
    names = [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:4]]
    assert names == [str(one), str(again), "b.dat"]  # those of one name by their paths
    picture = np.asarray(Image.open(tmp_path / "page.png").convert("L"))
    assert picture.shape == (900, 1400)
    assert (picture < 200).mean() > 0.02  # it is not empty


def test_files_with_hardly_any_events(tmp_path, caplog):
    """The smallest sensor that has their pixels has no frequencies to speak of."""
    pytest.importorskip("matplotlib")
    for name, text in (("none.csv", "t,x,y,p\n"), ("one.csv", "t,x,y,p\n5,0,0,1\n")):
        (tmp_path / name).write_text(text)
    # What else is in folders of others.
    (tmp_path / "imu.txt").write_text("0.001 0.12 -9.8 0.3 0.01 0.0 0.2\n")
    (tmp_path / "readme.txt").write_text("Events of a walk through the house.\n")
    (tmp_path / "times.txt").write_text("1\n2\n")
    np.savez(tmp_path / "labels.npz", labels=np.zeros(3))
    with h5py.File(tmp_path / "poses.h5", "w") as file:
        file["poses"] = np.eye(4)
    assert cli.main(["compare", str(tmp_path), "--out", str(tmp_path / "page.png")]) == 0
    assert measure_events(tmp_path / "one.csv").event_count == 1
    assert caplog.text.count("it is left out") == 5
