"""Events in x, y and time, and as a surface."""

from __future__ import annotations

import numpy as np

from neurosim_core.packets import EventArrays
from neurosim_core.view.event_views import SURFACE_PALETTE, EventViews


def events(t: np.ndarray) -> EventArrays:
    count = len(t)
    x = (np.arange(count) % 64).astype(np.uint16)
    return EventArrays(t.astype(np.int64), x, np.full(count, 7, np.uint16), (x % 2).astype(np.uint8))


def test_events_lie_at_their_pixel_and_behind_now():
    """Five windows of 20 ms are as deep as the camera is wide: 64 px for 100 ms."""
    cloud = EventViews(width=64, height=8, window_ns=20_000_000, compress=True)
    cloud.points(events(np.array([5_000])), 20_000_000)
    points, colors = cloud.points(events(np.array([30_000, 40_000])), 40_000_000)
    np.testing.assert_allclose(points, [[0, -22.4, -7], [0, -6.4, -7], [1, 0, -7]], rtol=1e-6)
    assert colors[1].argmax() == 2  # darker: blue
    assert colors[2].argmax() == 0  # brighter: red


def test_the_number_of_points_is_bounded():
    cloud = EventViews(width=64, height=8, window_ns=20_000_000, compress=True)
    for k in range(8):
        window = events(np.linspace(k * 20_000, (k + 1) * 20_000, 9_999))
        points, _ = cloud.points(window, (k + 1) * 20_000_000)
    assert 3_000 < len(points) <= 4_000
    assert points[:, 1].min() >= -64.0


def test_the_last_event_of_a_pixel_fades():
    """An age of tau leaves 1 / e of the brightness, in steps of an eighth; a later event makes it new."""
    views = EventViews(width=64, height=8, window_ns=20_000_000, compress=True)  # tau: 50 ms
    drawn = views.surface(events(np.array([10_000, 60_000])), 60_000_000)
    old, new = SURFACE_PALETTE[drawn[7, :2]].astype(int)
    assert old.argmax() == 2  # darker: blue
    assert new.argmax() == 0  # brighter: orange
    assert abs(old.max() / 255 - np.exp(-1.0)) <= 1 / 16
    assert new.max() == 255
    assert np.count_nonzero(drawn) == 2
    again = views.surface(events(np.array([110_000])), 110_000_000)
    assert (again[7, 0], again[7, 1]) == (drawn[7, 0] + 5, drawn[7, 1] - 5)  # 3 of 8, and 8
    assert not views.surface(events(np.zeros(0)), 5_000_000).any()  # time has begun again
