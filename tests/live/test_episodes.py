"""When a run has begun again, told from streams that come on ways of their own."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim_core.live.episodes import Episodes

MS = 1_000_000


def test_the_first_stream_that_goes_back_begins_the_next_run():
    episodes = Episodes()
    for k in range(100):
        assert episodes.sort("odometry", k * 10 * MS, k) == "present"
        assert episodes.sort("rgb", k * 10 * MS, k) == "present"
    assert episodes.sort("odometry", 0, 0) == "next"
    assert episodes.newest_ns == 0
    assert episodes.sort("rgb", 1000 * MS, 100) == "past"
    assert episodes.sort("odometry", 10 * MS, 1) == "present"
    assert episodes.sort("rgb", 0, 0) == "present"
    assert episodes.sort("rgb", 10 * MS, 1) == "present"


def test_a_leftover_that_looks_new_does_not_begin_another_run():
    """A short run: its last picture is not ahead of the new one's first stamps."""
    episodes = Episodes()
    assert episodes.sort("odometry", 60 * MS, 6) == "present"
    assert episodes.sort("rgb", 0, 0) == "present"
    assert episodes.sort("odometry", 0, 0) == "next"
    assert episodes.sort("rgb", 50 * MS, 1) == "present"  # cannot be told
    assert episodes.sort("rgb", 0, 0) == "present"
    assert episodes.sort("odometry", 10 * MS, 1) == "present"


def test_a_leftover_of_a_stream_that_is_new_here_does_not_either():
    episodes = Episodes()
    assert episodes.sort("odometry", 60 * MS, 6) == "present"
    assert episodes.sort("odometry", 0, 0) == "next"
    assert episodes.sort("rgb", 50 * MS, 1) == "present"
    assert episodes.sort("rgb", 0, 0) == "present"


def test_a_message_again_is_no_new_run():
    """What is latched is sent again to those who connect again."""
    episodes = Episodes()
    assert episodes.sort("odometry", 60 * MS, 6) == "present"
    assert episodes.sort("odometry", 60 * MS, 6) == "present"


def test_a_run_that_begins_later_is_told_by_its_numbers():
    episodes = Episodes()
    assert episodes.sort("odometry", 5 * MS, 7) == "present"
    assert episodes.sort("odometry", 50 * MS, 1) == "next"


def test_a_stream_that_is_far_ahead_is_believed_after_a_second():
    """A sensor whose clock is off, and that was silent in the run before."""
    episodes = Episodes()
    episodes.sort("imu", 5000 * MS, 0)
    episodes.sort("odometry", 100 * MS, 10)
    episodes.sort("odometry", 0, 0)
    assert episodes.sort("imu", 5010 * MS, 1) == "past"
    episodes.sort("odometry", 1000 * MS, 100)
    assert episodes.sort("imu", 6000 * MS, 2) == "present"


@settings(deadline=None)
@given(
    runs=st.lists(st.integers(4, 200), min_size=1, max_size=6),
    lag=st.integers(0, 3),
)
def test_runs_are_counted(runs: list[int], lag: int):
    """Streams that lag behind by some messages: as many runs as there were."""
    order = [(run, k) for run, length in enumerate(runs) for k in range(length)]
    episodes, count = Episodes(), 1
    for index in range(len(order) + lag):
        for stream, behind in (("odometry", 0), ("rgb", lag)):
            if 0 <= index - behind < len(order):
                _, k = order[index - behind]
                count += episodes.sort(stream, k * 10 * MS, k) == "next"
    assert count == len(runs)
