"""Pictures of events against their closed form, and windows against brute force."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim_core.packets import EventArrays
from neurosim_core.view.pictures import (
    BACKGROUND_SRGB,
    OFF_SRGB,
    ON_SRGB,
    EventWindow,
    event_classes,
    event_picture,
)


def make(rows: list[tuple[int, int, int, int]]) -> EventArrays:
    """Events from rows of t [us], x, y, polarity."""
    t, x, y, p = (np.array(column) for column in zip(*rows, strict=True)) if rows else (np.zeros(0),) * 4
    return EventArrays(t.astype(np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8))


def test_no_event_is_background():
    picture = event_picture(make([]), width=3, height=2)
    assert picture.shape == (2, 3, 3)
    assert (picture == BACKGROUND_SRGB).all()


def test_hue_is_the_last_event_and_strength_the_count():
    """A pixel with n events covers 1 - 0.4^n of the white, up to n = 4."""
    rows = [(1, 0, 0, 1)]
    rows += [(t, 1, 0, 0) for t in (1, 2)]
    rows += [(1, 2, 1, 0), (2, 2, 1, 0), (3, 2, 1, 1)]  # darker twice, then brighter
    rows += [(t, 0, 1, t % 2) for t in range(100)]  # ends brighter
    picture = event_picture(make(sorted(rows)), width=3, height=2)

    def shade(color: tuple[int, int, int], count: int) -> list[int]:
        return [round(255 - (1.0 - 0.4**count) * (255 - c)) for c in color]

    assert picture[0, 0].tolist() == shade(ON_SRGB, 1)
    assert picture[0, 1].tolist() == shade(OFF_SRGB, 2)
    assert picture[1, 2].tolist() == shade(ON_SRGB, 3)
    assert picture[1, 0].tolist() == shade(ON_SRGB, 4)
    assert picture[0, 2].tolist() == list(BACKGROUND_SRGB)


@settings(deadline=None, max_examples=50)
@given(
    st.lists(
        st.tuples(st.integers(0, 50), st.integers(0, 4), st.integers(0, 3), st.integers(0, 1)), max_size=60
    )
)
def test_classes_match_brute_force(rows):
    rows = sorted(rows)
    wanted = np.zeros((4, 5), dtype=np.uint8)
    for y in range(4):
        for x in range(5):
            mine = [p for _, ex, ey, p in rows if (ex, ey) == (x, y)]
            if mine:
                wanted[y, x] = min(len(mine), 4) + 4 * mine[-1]
    assert (event_classes(make(rows), width=5, height=4) == wanted).all()


@settings(deadline=None, max_examples=50)
@given(
    times=st.lists(st.integers(1, 100_000) | st.integers(1, 100).map(lambda ms: 1000 * ms), max_size=80),
    ends_ms=st.sets(st.integers(1, 99), max_size=12),
    length_ms=st.integers(1, 40),
)
def test_windows_do_not_depend_on_packets(times, ends_ms, length_ms):
    """However a stream is cut into packets, window k holds the events of (k length, (k + 1) length]."""
    times = sorted(times)
    collector = EventWindow(length_ns=length_ms * 1_000_000)
    found = []
    start_ms = 0
    for end_ms in [*sorted(ends_ms), 100]:
        rows = [(t, 0, 0, 1) for t in times if start_ms * 1000 < t <= end_ms * 1000]
        found += collector.add(make(rows), start_ns=start_ms * 1_000_000, stamp_ns=end_ms * 1_000_000)
        start_ms = end_ms
    length_us = length_ms * 1000
    assert [end_ns for end_ns, _ in found] == [
        (k + 1) * length_ms * 1_000_000 for k in range(100 // length_ms)
    ]
    for k, (_, events) in enumerate(found):
        assert events.t.tolist() == [t for t in times if k * length_us < t <= (k + 1) * length_us]


def test_reset_and_loss_begin_a_new_window():
    collector = EventWindow(length_ns=20_000_000)
    late = make([(5_000_000 + k, 0, 0, 1) for k in range(10)])
    assert collector.add(late, start_ns=5_000_000_000, stamp_ns=5_010_000_000) == []
    first = make([(1, 0, 0, 1)])
    assert (
        collector.add(first, start_ns=0, stamp_ns=10_000_000) == []
    )  # back at the start: not 250 windows, none old
    [(end_ns, events)] = collector.add(make([]), start_ns=10_000_000, stamp_ns=20_000_000)
    assert (end_ns, events.t.tolist()) == (20_000_000, [1])
    assert (
        collector.add(make([]), start_ns=10**18, stamp_ns=10**18 + 1) == []
    )  # a long gap makes no empty windows
