"""Shards of WebDataset: the same windows as those of the recording; and tonic, which takes windows."""

from __future__ import annotations

import hashlib
import importlib.util
import io
import json
import subprocess
import sys
import tarfile

import numpy as np
import pytest
from recorded_flights import HEIGHT, WIDTH, write_flight

from neurosim_core import data


@pytest.fixture
def flights(tmp_path):
    for number in range(2):
        write_flight(tmp_path / "flights" / f"{number}.h5", duration_s=0.4, seed=number)
    return tmp_path / "flights"


def digests(folder):
    return [hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())]


def test_shards_give_the_windows_of_the_recordings(flights, tmp_path):
    windows = data.Dataset(flights)
    shards = data.write_shards(windows, tmp_path / "shards", windows=7)
    assert [path.name for path in shards] == [f"windows-{n:06d}.tar" for n in range(3)]
    data.write_shards(iter(windows), tmp_path / "again", windows=7)
    assert digests(tmp_path / "shards") == digests(tmp_path / "again")
    found = data.Dataset(tmp_path / "shards")
    assert len(found) == len(windows) == 16
    for one, two in zip(windows, found, strict=True):
        assert (one.stamp_ns, one.start_ns, one.source) == (two.stamp_ns, two.start_ns, two.source)
        assert (one.dropped_count, two.lost_count) == (two.dropped_count, one.lost_count)
        assert all(np.array_equal(a, b) for a, b in zip(one.events, two.events, strict=True))
        for field in ("depth", "rgb", "imu", "pose"):
            assert np.array_equal(getattr(one, field), getattr(two, field)), field
    options = {"batch": 4, "shuffle": True, "sequence": 2, "fields": ["events", "depth"]}
    batches = [*data.Stream(tmp_path / "shards", **options)]
    assert sum(len(batch) for batch in batches) == 14  # of 7, 7 and 2 windows, in pairs
    assert batches[0].rgb is None


def by_others(library, code, *arguments):
    """What a library of others prints, in a process of its own: it may warn, and leave files open."""
    if importlib.util.find_spec(library) is None:
        pytest.skip(f"{library} is not installed")
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


READ_SHARDS = """
import json, sys
import webdataset
found = [
    [s["json"]["stamp_ns"], s["events.npz"]["t"].tolist(), s["depth.npy"].tolist()]
    for s in webdataset.WebDataset(sys.argv[1:], shardshuffle=False).decode()
]
print(json.dumps(found))
"""


def test_the_library_webdataset_reads_shards(flights, tmp_path):
    windows = data.Dataset(flights)
    shards = data.write_shards(windows, tmp_path / "shards", windows=10)
    samples = by_others("webdataset", READ_SHARDS, *shards)
    assert len(samples) == len(windows)
    for one, (stamp_ns, t, depth) in zip(windows, samples, strict=True):
        assert stamp_ns == one.stamp_ns
        assert np.array_equal(t, one.events.t)
        assert np.array_equal(np.float32(depth), one.depth)


def test_what_is_wrong_with_shards(flights, tmp_path):
    windows = data.Dataset(flights, fields=["events", "depth"])
    (shard,) = data.write_shards(windows, tmp_path / "shards")
    with pytest.raises(FileExistsError, match="is there already"):
        data.write_shards(windows, tmp_path / "shards")
    with pytest.raises(ValueError, match="at least 1, got 0"):
        data.write_shards(windows, tmp_path / "none", windows=0)
    assert not [*tmp_path.glob(".*")]
    with pytest.raises(ValueError, match=r"has windows of 0\.05 s, not 0\.1 s"):
        data.Dataset(shard, window_s=0.1)
    with pytest.raises(ValueError, match=r"window 0 has no rgb\.npy"):
        data.Dataset(shard, fields=["rgb"])
    whole = shard.read_bytes()
    shard.write_bytes(b"no archive" * 100)
    with pytest.raises(ValueError, match="not a readable shard"):
        data.Dataset(shard)
    with tarfile.open(fileobj=io.BytesIO(whole)) as tar:
        offset = tar.getmember("00000003.events.npz").offset_data
    shard.write_bytes(whole[:offset] + bytes(200) + whole[offset + 200 :])
    damaged = data.Dataset(shard)
    assert damaged[2].depth.shape == (HEIGHT, WIDTH)
    with pytest.raises(ValueError, match=r"events\.npz of window 3 is damaged"):
        damaged[3]


FRAME_OF_TONIC = """
import json, sys
import numpy as np
from tonic import transforms
from neurosim_core import data
sample = data.Dataset(sys.argv[1])[0]
t, x, y, polarity = sample.events
events = np.rec.fromarrays([x, y, t, polarity], names="x,y,t,p")
print(json.dumps(transforms.ToImage((sample.width, sample.height, 2))(events).tolist()))
"""


def test_transforms_of_tonic_take_it(flights):
    counts = by_others("tonic", FRAME_OF_TONIC, flights)
    _, x, y, polarity = data.Dataset(flights)[0].events
    expected = np.zeros((2, HEIGHT, WIDTH), int)
    np.add.at(expected, (polarity, y, x), 1)
    assert np.array_equal(counts, expected)
