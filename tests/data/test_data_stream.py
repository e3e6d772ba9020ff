"""The order of windows: shuffled, shared by ranks and workers, continued in the middle, and never a hang."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recorded_flights import write_flight

from neurosim_core import data


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flights")
    for seed in range(4):
        write_flight(folder / f"{seed}" / "flight.h5", seed=seed, duration_s=0.6)
    return folder


def keys(batches) -> list[tuple[str, int]]:
    return [
        (s, int(n)) for batch in batches for s, n in zip(batch.source, batch.stamp_ns.tolist(), strict=True)
    ]


def order(folder, **options) -> list[tuple[str, int]]:
    return keys(data.Stream(folder, batch=8, fields=["events"], **options))


def test_every_window_once(folder):
    plain = order(folder)
    assert len(plain) == len(set(plain)) == 48
    assert plain == sorted(plain)
    assert len(data.Stream(folder, batch=8)) == 6
    assert len(data.Dataset(folder)) == 48


def test_shuffling_depends_on_the_seed_and_the_epoch_alone(folder):
    stream = data.Stream(folder, batch=8, fields=["events"], shuffle=True, seed=3)
    first, second = keys(stream), keys(stream)
    assert sorted(first) == sorted(second) == order(folder)
    assert first != second != order(folder)
    again = data.Stream(folder, batch=8, fields=["events"], shuffle=True, seed=3)
    assert (keys(again), keys(again)) == (first, second)
    assert order(folder, shuffle=True, seed=4) != first


def test_sequences_stay_together(folder):
    found = np.array([n for _, n in order(folder, shuffle=True, sequence=4)]).reshape(-1, 4)
    assert (np.diff(found, axis=1) == 50_000_000).all()
    assert len(set(found[:, 0].tolist())) == 3  # sequences begin at the first, fifth and ninth window
    assert len(order(folder, sequence=8)) == 4 * 8  # four windows at the end of each flight are left out


def test_ranks_share_the_windows(folder):
    ranks = [order(folder, shuffle=True, rank=r, ranks=5) for r in range(5)]
    assert [len(rank) for rank in ranks] == [9] * 5
    assert len({key for rank in ranks for key in rank}) == 45


def test_resuming_in_the_middle(folder):
    options = {"batch": 5, "fields": ["events"], "shuffle": True}
    whole = data.Stream(folder, **options)
    expected = [keys([batch]) for _ in range(2) for batch in whole]
    stream = data.Stream(folder, **options)
    found = []
    for number, batch in enumerate(stream):
        found.append(keys([batch]))
        if number == 3:
            break
    again = data.Stream(folder, **options)
    again.load_state_dict(stream.state_dict())
    found += [keys([batch]) for batch in again] + [keys([batch]) for batch in again]
    assert found == expected


def test_wrong_arguments(folder):
    with pytest.raises(ValueError, match="multiple of sequence"):
        data.Stream(folder, batch=8, sequence=3)
    with pytest.raises(ValueError, match="rank must be in"):
        data.Stream(folder, rank=2, ranks=2)
    with pytest.raises(IndexError, match="48 windows"):
        data.Dataset(folder)[48]


def voxels(batch):
    return batch.events.voxel(3), batch.stamp_ns


def test_a_loader_gives_what_the_stream_gives(folder):
    torch = pytest.importorskip("torch")
    options = {"batch": 8, "fields": ["events"], "shuffle": True, "transform": voxels}
    stream = data.Stream(folder, **options)
    expected = [[*stream], [*stream]]
    loader = data.Loader(folder, **options)
    for epoch in expected:
        found = [*loader]
        assert len(found) == len(loader) == len(epoch)
        for (voxel, stamp), (wanted, wanted_stamp) in zip(found, epoch, strict=True):
            assert isinstance(voxel, torch.Tensor)
            assert np.array_equal(voxel.numpy(), wanted)
            assert np.array_equal(stamp.numpy(), wanted_stamp)
    resumed = data.Loader(folder, **options)
    resumed.load_state_dict({"epoch": 1, "batch": 4})
    assert np.array_equal(next(iter(resumed))[0].numpy(), expected[1][4][0])


def test_unknown_arguments_of_a_loader_are_answered_by_it(folder):
    pytest.importorskip("torch")
    with pytest.raises(TypeError, match="Loader has no argument 'worker'; did you mean 'workers'"):
        data.Loader(folder, worker=2)


def test_whole_batches_as_tensors(folder):
    torch = pytest.importorskip("torch")
    batch = next(iter(data.Loader(folder, batch=4)))
    assert isinstance(batch, data.Batch)
    assert batch.depth.shape == (4, 16, 24)
    assert batch.depth.dtype == torch.float32
    assert batch.events.raw.t.dtype == torch.int64
    arrays = next(iter(data.Stream(folder, batch=4))).events
    for found, wanted in (
        (batch.events.voxel(5), arrays.voxel(5)),
        (batch.events.voxel(1), arrays.voxel(1)),
        (batch.events.surface(), arrays.surface()),
        (batch.events.counts(), arrays.counts()),
    ):
        assert isinstance(found, torch.Tensor)
        assert np.array_equal(found.numpy(), wanted)


def test_the_training_step_of_the_tutorial_trains(folder, monkeypatch, capsys):
    pytest.importorskip("torch")
    page = (Path(__file__).resolve().parents[2] / "docs/tutorials/data-set.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(import torch\n.*?)```", page, flags=re.DOTALL)
    monkeypatch.chdir(folder.parent)
    code = code.replace('"data"', repr(folder.name)).replace("workers=2", "workers=0")
    exec(compile(code, "data-set.md", "exec"), {"__name__": "__main__"})
    assert re.fullmatch(r"6 batches, loss of the last \d+\.\d{3}\n", capsys.readouterr().out)


SCRIPT = """
import sys
import neurosim_core as ns
from torch.utils.data import DataLoader
from neurosim_core import data

def total(batch):
    return int(batch.events.counts().sum())

if __name__ == "__main__":
    expected = [total(batch) for batch in data.Stream(sys.argv[1], batch=8)]
    config = {"duration_s": 0.01, "device": "cpu", "renderer": "synthetic", "path": {"kind": "hover"},
              "scene": {"kind": "apartment", "rooms": 1},
              "render": {"lighting": {"mode": "unshadowed"}, "samples_per_pixel": 1}}
    assert list(ns.run(config))  # Warp has been started
    loader = data.Loader(sys.argv[1], batch=8, workers=2, transform=total)
    assert [*loader] == [*loader] == expected
    loader.load_state_dict({"epoch": 2, "batch": 3})
    assert [*loader] == expected[3:]
    try:
        data.Loader(sys.argv[1], workers=1, transform=lambda batch: 0)
    except ValueError as error:
        assert "function of a module" in str(error)
    plain = DataLoader(data.Dataset(sys.argv[1]), batch_size=8, num_workers=2, collate_fn=data.collate,
                       multiprocessing_context="fork")
    assert [total(batch) for batch in plain] == expected  # they read, and touch no device
    print("all the same")
"""


def test_workers_beside_a_simulator(folder, tmp_path):
    """Spawned by default; forked ones that only read recordings work, too."""
    pytest.importorskip("torch")
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "script.py"), str(folder)],
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.stdout.splitlines()[-1:] == ["all the same"], done.stderr
