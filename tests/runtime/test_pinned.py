"""Memory of others that a CUDA device copies into."""

from __future__ import annotations

import ctypes
import mmap
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from neurosim_core.runtime import pinned
from neurosim_core.runtime.cuda import Fence, GraphCache, HostCopy
from neurosim_core.runtime.pinned import PinError, PinnedMapping


class Driver:
    """Takes the place of CUDA's driver; memory is known by where it is."""

    def __init__(self) -> None:
        self.code = 0
        self.pinned: dict[int, int] = {}

    def cuMemHostRegister_v2(self, address: ctypes.c_void_p, size: ctypes.c_size_t, flags: int) -> int:
        assert flags == 1
        if self.code == 0:
            assert address.value is not None
            self.pinned[address.value] = size.value
        return self.code

    def cuMemHostUnregister(self, address: ctypes.c_void_p) -> int:
        assert address.value is not None
        del self.pinned[address.value]
        return 0


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Driver:
    made = Driver()
    monkeypatch.setattr(pinned, "_driver", lambda: made)
    return made


@pytest.fixture
def memory() -> mmap.mmap:
    return mmap.mmap(-1, 5 * mmap.PAGESIZE)


def address_of(memory: mmap.mmap) -> int:
    return int(np.frombuffer(memory, np.uint8).ctypes.data)


def test_all_of_it_is_pinned_until_it_is_closed(memory, driver):
    made = PinnedMapping.made_count
    mapping = PinnedMapping(memory, "cpu")
    assert PinnedMapping.made_count == made + 1
    assert mapping.memory is memory
    assert driver.pinned == {address_of(memory): 5 * mmap.PAGESIZE}
    with pytest.raises(BufferError):  # it is kept mapped
        memory.close()
    mapping.close()
    assert driver.pinned == {}
    mapping.close()
    memory.close()


def test_an_error_leaves_nothing_behind(memory, driver):
    driver.code = 801
    with pytest.raises(PinError, match="801"):
        PinnedMapping(memory, "cpu")
    memory.close()


def test_without_a_driver(monkeypatch):
    def missing(name: str) -> Any:
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(pinned, "ctypes", SimpleNamespace(CDLL=missing))
    pinned._driver.cache_clear()
    with pytest.raises(PinError, match="cannot open"):
        pinned._driver()


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")
def test_what_is_mapped_and_pinned_anew_gets_what_is_copied():
    """Most often at the same address; graphs are told apart as those of pictures are."""
    graphs = GraphCache("cuda:0")
    array = wp.zeros((1, 1 << 16), dtype=wp.uint8, device="cuda:0")
    copy, there = HostCopy(array), Fence("cuda:0")
    for number in range(1, 13):
        memory = mmap.mmap(-1, 1 << 16)
        mapping = PinnedMapping(memory, "cuda:0")
        view = np.frombuffer(memory, np.uint8)
        for again in range(3):
            array.fill_(10 * number + again)
            key = PinnedMapping.made_count, view.ctypes.data
            graphs.run(key, lambda view=view: copy.fetch_into(view, 0))
            there.set()
            there.wait()
            assert (view == 10 * number + again).all()
        mapping.close()
        del view
        memory.close()


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")
def test_a_device_copies_into_it(memory):
    """At any offset, and only where it should."""
    rows = np.random.default_rng(0).integers(0, 256, size=(3, 1000), dtype=np.uint8)
    array = wp.array(rows, dtype=wp.uint8, device="cuda:0")
    view = np.frombuffer(memory, np.uint8)
    mapping = PinnedMapping(memory, "cuda:0")
    copy, there = HostCopy(array), Fence("cuda:0")
    for offset, row in ((64, 0), (4096 + 8, 2), (64, 1)):
        view[:] = 7
        copy.fetch_into(view[offset : offset + 1000], row)
        there.set()
        there.wait()
        assert (view[offset : offset + 1000] == rows[row]).all()
        assert (view[:offset] == 7).all()
        assert (view[offset + 1000 :] == 7).all()
    mapping.close()


def test_memory_is_let_go_whatever_the_device_says(memory, driver, monkeypatch, caplog):
    """A device that has failed says so again when it is waited for, and when memory is to be unpinned."""
    driver.cuMemHostUnregister = lambda address: driver.pinned.clear() or 700
    mapping = PinnedMapping(memory, "cpu")
    mapping.close()
    assert "700" in caplog.text
    mapping = PinnedMapping(memory, "cpu")

    def fail(device: Any) -> None:
        raise RuntimeError("CUDA error 700")

    monkeypatch.setattr(wp, "synchronize_device", fail)
    with pytest.raises(RuntimeError, match="700"):
        mapping.close()
    assert driver.pinned == {}
    assert mapping.memory is None
    mapping.close()
    memory.close()  # nobody keeps it
