"""Simulated links: delay, order and bandwidth to the nanosecond; random numbers that stay where they are."""

from __future__ import annotations

import zlib
from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from neurosim_core.live.config import LinkConfig
from neurosim_core.live.links import Link

MS = 1_000_000
MASK = 2**64 - 1


def philox_words(key: tuple[int, int], counter: int) -> tuple[int, int]:
    """First two words of Philox 4x64-10, from the paper of Salmon et al. (2011)."""
    c0, c1, c2, c3 = counter, 0, 0, 0
    k0, k1 = key
    for _ in range(10):
        product_0, product_1 = c0 * 0xD2E7470EE14C6C93, c2 * 0xCA5A826395121157
        c0, c1, c2, c3 = (
            (product_1 >> 64) ^ c1 ^ k0,
            product_1 & MASK,
            (product_0 >> 64) ^ c3 ^ k1,
            product_0 & MASK,
        )
        k0, k1 = (k0 + 0x9E3779B97F4A7C15) & MASK, (k1 + 0xBB67AE8584CAA73B) & MASK
    return c0, c1


def drawn(seed: int, name: str, number: int) -> tuple[float, float]:
    """The two uniform numbers of a message: what decides about its jitter, and about its loss."""
    words = philox_words((seed, zlib.crc32(f"link/{name}".encode())), number + 1)
    return words[0] / 2**64, words[1] / 2**64


def by_brute_force(
    messages: list[tuple[int, int]],
    *,
    ns_per_byte: int,
    queue_ns: int,
    latency_ns: int,
    jitter_ns: list[int],
    lost: list[bool],
) -> list[int]:
    """Arrival of each message (sent [ns], size [bytes]) on a link that is played by the nanosecond."""
    arrival = [-1] * len(messages)
    queue: deque[int] = deque()
    left_ns = 0
    travelling: list[tuple[int, int]] = []  # (message, may arrive from)
    waiting = deque(range(len(messages)))
    now_ns = 0
    while waiting or queue or travelling:
        while waiting and messages[waiting[0]][0] == now_ns:
            if not queue:
                left_ns = messages[waiting[0]][1] * ns_per_byte
            backlog_ns = left_ns + sum(messages[k][1] * ns_per_byte for k in list(queue)[1:])
            if queue and backlog_ns > queue_ns:
                waiting.popleft()
            else:
                queue.append(waiting.popleft())
        while queue and left_ns == 0:
            done = queue.popleft()
            if not lost[done]:
                travelling.append((done, now_ns + latency_ns + jitter_ns[done]))
            left_ns = messages[queue[0]][1] * ns_per_byte if queue else 0
        while travelling and travelling[0][1] <= now_ns:  # the first holds up the others
            arrival[travelling.pop(0)[0]] = now_ns
        left_ns -= 1 if queue else 0
        now_ns += 1
    return arrival


@settings(max_examples=200, deadline=None)
@given(
    gaps_sizes=st.lists(st.tuples(st.integers(0, 40), st.integers(0, 9)), min_size=1, max_size=25),
    ns_per_byte=st.integers(1, 8).map(lambda power: 2**power),  # 1e9 / this is a float without rounding
    queue_ns=st.sampled_from([1, 100, 10**9]),
    latency_ns=st.integers(0, 50),
    jitter_ns=st.sampled_from([0, 1, 30, 200]),
    loss=st.sampled_from([0.0, 0.3, 1.0]),
    seed=st.integers(0, 2**64 - 1),
)
def test_arrivals_are_those_of_a_link_played_by_the_nanosecond(
    gaps_sizes, ns_per_byte, queue_ns, latency_ns, jitter_ns, loss, seed
):
    """Bandwidth, latency, jitter, loss and order together."""
    messages, now_ns = [], 0
    for gap_ns, size in gaps_sizes:
        now_ns += gap_ns
        messages.append((now_ns, size))
    config = LinkConfig(
        latency_s=latency_ns * 1e-9,
        jitter_s=jitter_ns * 1e-9,
        loss=loss,
        bandwidth_bytes_s=1e9 / ns_per_byte,
        queue_s=queue_ns * 1e-9,
    )
    link = Link(config, seed=seed, name="imu")
    found = [link.send(k, stamp_ns=t, size_bytes=size) for k, (t, size) in enumerate(messages)]
    uniform = [drawn(seed, "imu", k) for k in range(len(messages))]
    wanted = by_brute_force(
        messages,
        ns_per_byte=ns_per_byte,
        queue_ns=queue_ns,
        latency_ns=latency_ns,
        jitter_ns=[int(u * (jitter_ns + 1)) for u, _ in uniform],
        lost=[v < loss for _, v in uniform],
    )
    assert [d.delivered_ns for d in found] == wanted
    assert [(d.stamp_ns, d.size_bytes) for d in found] == messages
    assert [d.sequence for d in found] == list(range(len(messages)))
    assert {d.sensor for d in found} == {"imu_link"}
    assert link.lost_count == wanted.count(-1)
    assert link.due(max(wanted)) == [(t, k) for k, t in enumerate(wanted) if t >= 0]


def test_messages_come_out_when_they_are_due():
    link = Link(LinkConfig(latency_s=0.008), seed=0, name="command")
    assert link.next_due_ns is None
    first, second = object(), object()
    link.send(first, stamp_ns=0, size_bytes=48)
    link.send(second, stamp_ns=5 * MS, size_bytes=48)
    assert (link.next_due_ns, len(link)) == (8 * MS, 2)
    assert link.due(8 * MS - 1) == []
    assert link.due(8 * MS) == [(8 * MS, first)]
    assert link.due(8 * MS) == []
    assert link.next_due_ns == 13 * MS
    assert link.due(10**15) == [(13 * MS, second)]
    assert len(link) == 0


def test_a_link_without_settings_delivers_at_once():
    link = Link(LinkConfig(), seed=0, name="imu")
    for stamp_ns in (0, 0, 7):
        assert link.send(stamp_ns, stamp_ns=stamp_ns, size_bytes=10**9) is None
    assert link.due(7) == [(0, 0), (0, 0), (7, 7)]


@pytest.mark.parametrize(("rate", "numerator", "denominator"), [(3e9, 1, 3), (7e9, 1, 7), (0.3e9, 10, 3)])
def test_no_rounding_adds_up(rate, numerator, denominator):
    """The k-th of many messages sent together leaves at k times its own time, rounded up once."""
    link = Link(LinkConfig(bandwidth_bytes_s=rate, queue_s=1e6), seed=0, name="imu")
    for k in range(1, 20_001):
        delivered_ns = link.send(None, stamp_ns=0, size_bytes=1).delivered_ns
        assert delivered_ns == -(-k * numerator // denominator)


def test_times_are_exact_far_beyond_float64():
    """A year from the start, a nanosecond is still a nanosecond; a float64 knows 4 ns there."""
    year_ns = 365 * 86_400 * 10**9
    config = LinkConfig(latency_s=1e-9, jitter_s=1e-9, bandwidth_bytes_s=1e9)
    link = Link(config, seed=1, name="imu")
    for k in range(100):
        found = link.send(k, stamp_ns=year_ns + 100 * k + 1, size_bytes=3)
        assert type(found.delivered_ns) is int
        assert found.delivered_ns == year_ns + 100 * k + 5 + int(drawn(1, "imu", k)[0] * 2)


def send_many(
    config: LinkConfig, count: int, *, seed: int = 0, name: str = "imu", gap_ns: int = 10**12
) -> np.ndarray:
    """Delay of each message [ns], -1: lost; far apart, so that none holds up another."""
    link = Link(config, seed=seed, name=name)
    sent = [link.send(None, stamp_ns=gap_ns * k, size_bytes=100) for k in range(count)]
    return np.array([-1 if d.delivered_ns < 0 else d.delivered_ns - d.stamp_ns for d in sent])


def loss_is_plausible(lost: np.ndarray, loss: float) -> bool:
    """Whether a number of losses lies where a binomial one is in all but one of a million cases."""
    low, high = stats.binom(lost.size, loss).interval(1.0 - 1e-6)
    return bool(low <= lost.sum() <= high)


def test_loss_has_the_configured_probability():
    """Losses are Bernoulli(0.2), each on its own; a bias to 0.22 would be seen."""
    lost = send_many(LinkConfig(loss=0.2), 40_000) < 0
    assert loss_is_plausible(lost, 0.2)
    assert loss_is_plausible(lost[1:] & lost[:-1], 0.04)  # wider than binomial by 1.2: still < 1e-4 false
    assert not loss_is_plausible(send_many(LinkConfig(loss=0.22), 40_000) < 0, 0.2)


def jitter_is_plausible(delay_ns: np.ndarray, jitter_ns: int, cell_count: int) -> bool:
    """Whether delays are spread evenly over 0 .. jitter_ns (chi-square; one of a million is refused)."""
    if delay_ns.min() < 0 or delay_ns.max() > jitter_ns:
        return False
    counts = np.bincount(delay_ns * cell_count // (jitter_ns + 1), minlength=cell_count)
    return bool(stats.chisquare(counts).pvalue > 1e-6)


@pytest.mark.parametrize(("jitter_ns", "cell_count"), [(3, 4), (4 * MS - 1, 64)])
def test_jitter_is_uniform_and_reaches_both_ends(jitter_ns, cell_count):
    """Uniform over the whole nanoseconds from 0 to the setting; 3 % less would be seen."""
    config = LinkConfig(jitter_s=jitter_ns * 1e-9)
    delay_ns = send_many(config, 20_000)
    assert jitter_is_plausible(delay_ns, jitter_ns, cell_count)
    assert not jitter_is_plausible((delay_ns * 0.97).astype(int), jitter_ns, cell_count)


def test_loss_does_not_choose_by_jitter():
    """What survives a loss of one half is spread as evenly as all."""
    jitter_ns = 1023
    delay_ns = send_many(LinkConfig(loss=0.5, jitter_s=jitter_ns * 1e-9), 20_000)
    assert jitter_is_plausible(delay_ns[delay_ns >= 0], jitter_ns, 64)


def test_random_numbers_belong_to_the_message_not_to_the_order_of_calls():
    config = LinkConfig(loss=0.3, jitter_s=1e-3)
    alone = {name: send_many(config, 200, name=name) for name in ("imu", "rgb")}
    links = {name: Link(config, seed=0, name=name) for name in alone}
    together: dict[str, list[int]] = {"imu": [], "rgb": []}
    for k in range(200):
        for name in ("imu", "rgb") if k % 3 else ("rgb", "imu"):
            sent = links[name].send(None, stamp_ns=10**12 * k, size_bytes=k)
            together[name].append(-1 if sent.delivered_ns < 0 else sent.delivered_ns - sent.stamp_ns)
            links[name].due(10**12 * (k - 5))
    for name, delays in together.items():
        assert delays == alone[name].tolist()
    assert (alone["imu"] != alone["rgb"]).any()
    assert (alone["imu"] != send_many(config, 200, seed=1)).any()


def test_which_messages_are_lost_does_not_depend_on_other_settings():
    """So that a run with more latency or jitter can be compared with one without."""
    config = LinkConfig(loss=0.3)
    lost = send_many(config, 300) < 0
    other = config.model_copy(update={"jitter_s": 2e-3, "latency_s": 0.1, "bandwidth_bytes_s": 1e6})
    assert ((send_many(other, 300) < 0) == lost).all()
    more = send_many(config.model_copy(update={"loss": 0.5}), 300) < 0
    assert (more | ~lost).all()  # those that were lost, and more
    assert more.sum() > lost.sum()


def test_a_lost_message_occupies_the_link_and_holds_up_nobody():
    """With 1 byte a microsecond, the message behind a lost one of 1000 bytes arrives 1 ms later."""
    seed = next(s for s in range(100) if drawn(s, "imu", 0)[1] < 0.5 <= drawn(s, "imu", 1)[1])
    link = Link(LinkConfig(loss=0.5, bandwidth_bytes_s=1e6), seed=seed, name="imu")
    assert link.send(0, stamp_ns=0, size_bytes=1000).delivered_ns == -1
    assert link.send(1, stamp_ns=0, size_bytes=10).delivered_ns == MS + MS // 100
    assert (link.lost_count, len(link)) == (1, 1)

    slow_first = next(
        s
        for s in range(1000)
        if drawn(s, "imu", 0)[1] < 0.5 <= drawn(s, "imu", 1)[1]
        and drawn(s, "imu", 0)[0] > 0.9
        and drawn(s, "imu", 1)[0] < 0.1
    )
    link = Link(LinkConfig(loss=0.5, jitter_s=1e-3), seed=slow_first, name="imu")
    link.send(0, stamp_ns=0, size_bytes=1)
    assert link.send(1, stamp_ns=0, size_bytes=1).delivered_ns < MS // 10


def test_what_would_wait_too_long_is_lost_and_memory_is_bounded():
    """A stream of twice the bandwidth: every second message is lost, the others are 0.5 s late."""
    link = Link(LinkConfig(bandwidth_bytes_s=1e6, queue_s=0.5), seed=0, name="rgb")
    longest = 0
    for k in range(2000):
        sent = link.send(k, stamp_ns=k * 5 * MS, size_bytes=10_000)
        assert sent.delivered_ns == -1 or sent.delivered_ns - sent.stamp_ns <= 510 * MS
        longest = max(longest, len(link))
        link.due(k * 5 * MS)
    assert longest <= 52  # half a second and one, at 10 ms each
    assert link.lost_count == pytest.approx((2000 - 100) / 2, abs=2)  # after a second, the queue is full


def test_a_message_may_take_longer_than_the_longest_wait():
    link = Link(LinkConfig(bandwidth_bytes_s=1e6, queue_s=0.001), seed=0, name="rgb")
    assert link.send(0, stamp_ns=0, size_bytes=10_000).delivered_ns == 10 * MS
    assert link.send(1, stamp_ns=9 * MS - 1, size_bytes=10_000).delivered_ns == -1
    assert link.send(2, stamp_ns=9 * MS, size_bytes=10_000).delivered_ns == 20 * MS


def test_reset_begins_anew():
    config = LinkConfig(loss=0.2, jitter_s=1e-2, latency_s=1e-3, bandwidth_bytes_s=1e5)

    def fly(link: Link) -> list[int]:
        return [link.send(k, stamp_ns=MS * k, size_bytes=200).delivered_ns for k in range(3, 100)]

    link = Link(config, seed=5, name="rgb")
    first = fly(link)
    other = fly(Link(config, seed=6, name="rgb"))
    assert first != other
    link.reset(seed=6)
    assert (link.next_due_ns, link.lost_count, len(link)) == (None, 0, 0)
    assert fly(link) == other
    link.reset(seed=5)
    assert fly(link) == first


def test_settings_change_for_later_messages_only():
    link = Link(LinkConfig(latency_s=0.01, bandwidth_bytes_s=1e6), seed=0, name="command")
    assert link.send(0, stamp_ns=0, size_bytes=1000).delivered_ns == 11 * MS
    link.configure(LinkConfig(queue_s=0.0005))  # without a bandwidth nothing waits
    assert link.send(1, stamp_ns=0, size_bytes=1000).delivered_ns == 11 * MS  # behind the first
    assert link.send(2, stamp_ns=20 * MS, size_bytes=1000) is None
    link.configure(LinkConfig(bandwidth_bytes_s=0.5e6))
    assert link.send(3, stamp_ns=20 * MS, size_bytes=1000).delivered_ns == 22 * MS
    link.configure(LinkConfig(bandwidth_bytes_s=1e6))
    assert link.send(4, stamp_ns=20 * MS, size_bytes=1000).delivered_ns == 23 * MS
    assert link.due(20 * MS) == [(11 * MS, 0), (11 * MS, 1), (20 * MS, 2)]


def test_a_message_cannot_be_sent_before_an_earlier_one():
    link = Link(LinkConfig(), seed=0, name="imu")
    link.send(0, stamp_ns=10, size_bytes=1)
    with pytest.raises(ValueError, match=r"'imu'.*>= 10.*got 9"):
        link.send(1, stamp_ns=9, size_bytes=1)
