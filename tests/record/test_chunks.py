"""Columns that are inflated here against the same columns read by HDF5."""

from __future__ import annotations

import numpy as np
import pytest

from neurosim_core.record import chunks
from neurosim_core.record.chunks import read_rows

h5py = pytest.importorskip("h5py")
pytest.importorskip("isal")
CHUNK = 64
GZIP = {"compression": "gzip", "shuffle": True}


@pytest.fixture
def inflated(monkeypatch):
    """Count the chunks that are inflated here."""
    sizes = []

    class Isal:
        error = chunks.import_isal().error

        @staticmethod
        def decompress(data, bufsize):
            sizes.append(bufsize)
            return true.decompress(data, bufsize=bufsize)

    true = chunks.import_isal()
    monkeypatch.setattr(chunks, "import_isal", lambda: Isal)
    return sizes


@pytest.mark.parametrize("dtype", ["<i8", ">i8", "<u2", ">u4", "u1"])
def test_rows_are_those_of_hdf5(tmp_path, inflated, dtype):
    limits = np.iinfo(dtype)
    values = np.random.default_rng(0).integers(
        limits.min, limits.max, 1000, np.dtype(dtype).newbyteorder("=")
    )
    with h5py.File(tmp_path / "a.h5", "w") as file:
        column = file.create_dataset("a", data=values.astype(dtype), chunks=(CHUNK,), **GZIP)
        for begin, end in [(0, 1000), (0, 64), (63, 65), (100, 101), (960, 1200), (5, 5), (1000, 1000)]:
            rows = read_rows(column, begin, end)
            assert rows.dtype == column.dtype
            assert np.array_equal(rows, values[begin:end])
    assert len(inflated) == 16 + 1 + 2 + 1 + 1  # nothing for an empty range


@pytest.mark.parametrize(
    "options",
    [{}, {"chunks": (CHUNK,)}, {"compression": "lzf", "shuffle": True}, {**GZIP, "fletcher32": True}],
)
def test_hdf5_reads_what_is_stored_otherwise(tmp_path, inflated, options):
    values = np.arange(1000)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        column = file.create_dataset("a", data=values, **options)
        assert np.array_equal(read_rows(column, 10, 500), values[10:500])
    assert not inflated


def test_chunks_that_were_never_written_are_filled_by_hdf5(tmp_path, inflated):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        column = file.create_dataset("a", (1000,), np.int64, chunks=(CHUNK,), fillvalue=7, **GZIP)
        column[:CHUNK] = 1
        assert read_rows(column, 60, 70).tolist() == [1] * 4 + [7] * 6


def test_damage_is_an_error(tmp_path):
    """Each byte of a chunk that is changed gives an error of HDF5, or what HDF5 reads there."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("a", data=np.arange(1000), chunks=(CHUNK,), **GZIP)
        place = file["a"].id.get_chunk_info(2)
    whole, refused = path.read_bytes(), 0
    for offset in range(place.byte_offset, place.byte_offset + place.size):
        path.write_bytes(whole[:offset] + bytes([whole[offset] ^ 0x55]) + whole[offset + 1 :])
        with h5py.File(path) as file:
            try:
                expected = file["a"][100:200]
            except OSError:
                refused += 1
                with pytest.raises(OSError, match="filter returned failure"):
                    read_rows(file["a"], 100, 200)
            else:
                assert np.array_equal(read_rows(file["a"], 100, 200), expected)
    assert refused > 0.9 * place.size
