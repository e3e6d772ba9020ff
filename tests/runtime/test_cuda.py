"""GraphCache replay what they were given, copies hold what they fetched; on a CPU both cost nothing."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import warp as wp

from neurosim_core.runtime import cuda
from neurosim_core.runtime.cuda import (
    BufferPool,
    Fence,
    GraphCache,
    HostCopy,
    Launches,
    RecordedLaunch,
    make_stream,
    size_class,
    use_stream,
)


@wp.kernel
def _add(step: float, values: wp.array[float]) -> None:
    values[wp.tid()] += step


@pytest.mark.parametrize("capacity", [1, 2, 64])
def test_replays_do_what_the_launches_do(device, monkeypatch, capacity):
    """Keys that alternate, come late or are forgotten meanwhile: the sum of all steps, every time."""
    monkeypatch.setattr(cuda, "_GRAPH_COUNT_MAX", capacity)
    values = wp.zeros(3, dtype=float, device=device)
    graphs = GraphCache(device)
    calls = []

    def launch(step: float) -> None:
        calls.append(step)
        for _ in range(2):
            wp.launch(_add, dim=3, inputs=[step, values], device=device)

    steps = [1.0, 2.0, 1.0, 1.0, 4.0, 2.0, 1.0, 2.0, 2.0, 1.0]
    with use_stream(make_stream(device)):
        for step in steps:
            graphs.run(step, lambda step=step: launch(step))
        np.testing.assert_array_equal(values.numpy(), np.full(3, 2 * sum(steps)))
    if device == "cpu":
        assert calls == steps
    elif capacity > 2:
        assert calls == [1.0, 2.0, 1.0, 4.0, 2.0]  # once to launch and once to record


def test_launches_that_follow_each_other_are_one_graph(device):
    """Those without a key are launched alone, in order."""
    values = wp.ones(3, dtype=float, device=device)
    graphs, calls = GraphCache(device), []

    def launches(step: float, key: str | None) -> Launches:
        def launch() -> None:
            calls.append(step)
            wp.launch(_add, dim=3, inputs=[step, values], device=device)

        return Launches(key, launch)

    with use_stream(make_stream(device)):
        for round_count in range(1, 5):
            graphs.run_all([launches(1.0, "a"), launches(2.0, "b"), launches(4.0, None), launches(8.0, "a")])
            np.testing.assert_array_equal(values.numpy(), np.full(3, 1.0 + 15.0 * round_count))
    if device == "cpu":
        assert calls == 4 * [1.0, 2.0, 4.0, 8.0]
    else:
        assert calls == 2 * [1.0, 2.0, 4.0, 8.0] + 2 * [4.0]


def test_a_relaunch_takes_other_arguments_each_time(device):
    """Numbers, arrays and threads: what was launched before keeps what it was launched with."""
    values = [wp.zeros(count, dtype=float, device=device) for count in (3, 5)]
    add = RecordedLaunch(_add, device)
    with use_stream(make_stream(device)):
        for dim, step, index in [(3, 1.0, 0), (2, 4.0, 0), (5, 2.0, 1), (1, 8.0, 1), (3, 16.0, 0)]:
            add.launch(dim, [step, values[index]])
        np.testing.assert_array_equal(values[0].numpy(), [21.0, 21.0, 17.0])
        np.testing.assert_array_equal(values[1].numpy(), [10.0, 2.0, 2.0, 2.0, 2.0])


def test_a_copy_holds_the_rows_that_were_fetched(device):
    array = wp.array(np.arange(24, dtype=np.float64).reshape(4, 2, 3), dtype=wp.vec3d, device=device)
    copy, done = HostCopy(array), Fence(device)
    with use_stream(make_stream(device, high_priority=True)):
        copy.fetch(1, 2)
        done.set()
        array.zero_()
    done.wait()
    rows = copy.rows(1, 2)
    if device != "cpu":  # there the copy is the array
        np.testing.assert_array_equal(rows, np.arange(6, 18).reshape(2, 2, 3))
    array.fill_(7.0)
    copy.fetch(0, 4)
    wp.synchronize_device(device)
    np.testing.assert_array_equal(copy.rows(3, 1), np.full((1, 2, 3), 7.0))
    assert not np.shares_memory(copy.rows(0, 4), copy.rows(0, 4))
    assert rows.shape == (2, 2, 3)


def test_a_stream_can_wait_for_another(device):
    """A long chain of launches on one stream, read on a second one behind its milestone."""
    values = wp.zeros(1 << 20, dtype=float, device=device)
    first, second, done = make_stream(device), make_stream(device), Fence(device)
    with use_stream(first):
        for _ in range(50):
            wp.launch(_add, dim=values.shape[0], inputs=[1.0, values], device=device)
        done.set()
    out = wp.zeros_like(values)
    with use_stream(second):
        done.wait_on_stream()
        wp.copy(out, values)
        assert (out.numpy() == 50.0).all()


def test_a_block_comes_back_when_its_last_view_is_gone(device):
    blocks = BufferPool(device)
    first = blocks.acquire(100)
    address = first.array.ptr
    rows = blocks.hand_out(first, 100)
    rows[:] = 7
    view = rows[3:80].view(np.uint8)[5:]
    del rows, first
    second = blocks.acquire(100)
    assert second.array.ptr != address  # the view is still read
    second.rows()[:] = 1
    assert view.tolist() == [7] * 72
    taken = second.array.ptr
    blocks.hand_out(second, 100)
    del view, second
    gc.collect()
    assert {blocks.acquire(90).array.ptr for _ in range(2)} == {address, taken}
    assert blocks.acquire(200).array.shape[0] >= 400  # room for more from the first of a size on


def test_who_keeps_too_much_gets_copies(device, monkeypatch):
    monkeypatch.setattr(cuda, "_POOLED_BYTES_MAX", 1300)
    blocks = BufferPool(device)
    kept = []
    for number in range(6):
        block = blocks.acquire(100)
        block.rows()[:] = number
        kept.append(blocks.hand_out(block, 100))
    assert [rows.tolist() for rows in kept] == [[number] * 100 for number in range(6)]
    assert [rows.flags.owndata for rows in kept] == [False] * 5 + [True]
    kept.clear()
    gc.collect()
    assert not blocks.hand_out(blocks.acquire(100), 100).flags.owndata


def test_who_reads_one_after_the_other_gets_no_copies_of_large_blocks(device, monkeypatch):
    monkeypatch.setattr(cuda, "_POOLED_BYTES_MAX", 50)
    blocks = BufferPool(device)
    rows = None
    for _ in range(5):
        rows = blocks.hand_out(blocks.acquire(100), 100)  # the one before is let go afterwards
        assert not rows.flags.owndata
    assert blocks.made_count == 2
    kept = [rows, *(blocks.hand_out(blocks.acquire(100), 100) for _ in range(3))]
    assert [rows.flags.owndata for rows in kept] == [False] * 3 + [True]


def test_blocks_that_were_reserved_serve_all_sizes_below(device):
    blocks = BufferPool(device)
    blocks.reserve(1000, 3)
    made_count = blocks.made_count
    assert made_count == 3
    for size in (1, 999, 17, 1000, 500):
        views = [blocks.hand_out(blocks.acquire(size), size) for _ in range(3)]
        assert [view.shape for view in views] == [(size,)] * 3
        del views
        gc.collect()
    assert blocks.made_count == made_count
    taken = [blocks.acquire(10) for _ in range(4)]  # one more than there are
    assert len({block.array.ptr for block in taken}) == 4
    assert blocks.made_count == made_count + 1


def test_a_size_class_is_seldom_much_larger():
    classes = [size_class(size) for size in range(1, 5000)]
    assert all(size <= known <= 1.5 * size for size, known in enumerate(classes, 1))
    assert len(set(classes)) < 26
