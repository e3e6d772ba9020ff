"""The cases: one per question, what it sends, who takes part, and what has to come out."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

Kind = Literal["flood", "roundtrip", "copy", "publisher dies", "reader dies"]


class Metric(NamedTuple):
    """How a figure is called and written."""

    text: str
    unit: str
    larger_is_better: bool = False


METRICS = {
    "rate": Metric("rate", "/s", True),
    "cpu_us": Metric("subscriber's CPU", "us/msg"),
    "rtt_p50_us": Metric("round trip p50", "us"),
    "rtt_p99_us": Metric("round trip p99", "us"),
    "known_ms": Metric("death known", "ms"),
    "grown_kb": Metric("memory grown", "kB"),
    "shm_files": Metric("shm files left", ""),
}


@dataclass(frozen=True)
class Contestant:
    """One way of doing a case's job."""

    name: str
    peer: str = ""
    """Key of `cortex.bench.peers.PEERS`; empty: no library, but copies of memory."""
    options: Mapping[str, Any] = field(default_factory=dict)
    kind: Kind = "flood"


@dataclass(frozen=True)
class Bar:
    """What has to come out: a metric of one contestant, alone or over that of the best of some others."""

    who: str
    against: tuple[str, ...]
    """Empty: the metric itself is compared."""
    wanted: Literal[">=", "<="]
    bound: float
    metric: str = "rate"


@dataclass(frozen=True)
class Case:
    """One named measurement."""

    name: str
    title: str
    floats: int
    contestants: tuple[Contestant, ...]
    bars: tuple[Bar, ...] = ()
    metrics: tuple[str, ...] = ("rate",)
    _: dataclasses.KW_ONLY
    subscribers: int = 1
    count: int = 0
    """Messages per repetition; 0: as many as the time allows."""
    repeats: int = 0
    """At most so many repetitions; 0: as many as asked for."""
    bound: float = 0.8
    """What rate or round trip have to be of another checkout's (the inverse where smaller is better)."""

    def beside(self, checkout: str) -> Case:
        """Return the case with each contestant of Cortex in Python also as another checkout has it."""
        ours = [c for c in self.contestants if c.peer == "cortex" and c.kind in ("flood", "roundtrip")]
        theirs = [
            dataclasses.replace(c, name=f"{c.name}, before", options={**c.options, "checkout": checkout})
            for c in ours
        ]
        bars = []
        for contestant in ours:
            metric = "rtt_p50_us" if contestant.kind == "roundtrip" else self.metrics[0]
            rivals = (f"{contestant.name}, before",)
            larger = METRICS[metric].larger_is_better
            bound = self.bound if larger else round(1.0 / self.bound, 2)
            bars.append(Bar(contestant.name, rivals, ">=" if larger else "<=", bound, metric))
        return dataclasses.replace(self, contestants=(*self.contestants, *theirs), bars=(*self.bars, *bars))


FLOATS = {"40": 10, "4k": 1_000, "39k": 9_750, "900k": 225_000, "23.7M": 5_925_000}
"""Payloads: their name, their number of float32."""
_LABELS = {"40": "40 B", "4k": "4 kB", "39k": "39 kB", "900k": "0.9 MB", "23.7M": "23.7 MB"}
_RTT = ("rtt_p50_us", "rtt_p99_us")
_RAW1, _RAW2, _RING = "pyzmq 1 frame", "pyzmq 2 frames, no copy", "copy into ring"


def _cortex(name: str = "cortex", peer: str = "cortex", kind: Kind = "flood", **options: Any) -> Contestant:
    return Contestant(name, peer, options, kind)


def _raw(frames: int, kind: Kind = "flood", **options: Any) -> Contestant:
    return Contestant(_RAW1 if frames == 1 else _RAW2, "pyzmq", {"frames": frames, **options}, kind)


_ROS = (Contestant("Cyclone DDS", "Cyclone DDS"), Contestant("rclpy", "rclpy"))
_COPY = Contestant(_RING, kind="copy")
_PING = _cortex(kind="roundtrip")


def _over(bound: float, *against: str, who: str = "cortex") -> Bar:
    return Bar(who, against, ">=", bound)


def _under(bound: float, *against: str, metric: str, who: str = "cortex") -> Bar:
    return Bar(who, against, "<=", bound, metric)


def _small(size: str, bound: float) -> Case:
    title = f"{_LABELS[size]}, typed, decoded to the message object in a callback"
    contestants = (_cortex(), _raw(1), *_ROS)
    return Case(f"typed-{size}", title, FLOATS[size], contestants, (_over(0.85, _RAW1),), bound=bound)


def _tcp(size: str) -> Case:
    frames = {"40": (1,), "4k": (1,), "23.7M": (2,)}.get(size, (1, 2))
    raw = [_raw(number, tcp="127.0.0.1") for number in frames]
    bar = _over(0.9, *(contestant.name for contestant in raw))
    contestants = (_cortex(tcp="127.0.0.1"), *raw)
    return Case(
        f"tcp-{size}", f"{_LABELS[size]} over tcp on loopback, callback", FLOATS[size], contestants, (bar,)
    )


def _memory(size: str) -> Case:
    ways = tuple(_cortex(how, how=how) for how in ("callback", "recv", "async"))
    title = f"memory of both sides over 10^6 messages of {_LABELS[size]}, by each way to receive"
    bounds = {"grown_kb": 1024.0, "shm_files": 0.0}
    bars = tuple(
        _under(bound, metric=metric, who=way.name) for way in ways for metric, bound in bounds.items()
    )
    metrics = ("rate", *bounds)
    return Case(f"memory-{size}", title, FLOATS[size], ways, bars, metrics, count=1_000_000, repeats=1)


def _threshold(kib: int) -> Case:
    """Compare both ways: `inline_max` is right if the frame carries more up to it, and less above."""
    inline, shared = 1 << 20, 64
    contestants = (
        _cortex("inline", inline_max=inline),
        _cortex("shared memory", inline_max=shared),
        _cortex("inline, round trip", kind="roundtrip", inline_max=inline),
        _cortex("shared memory, round trip", kind="roundtrip", inline_max=shared),
    )
    bar = Bar("shared memory", ("inline",), ">=" if kib > 16 else "<=", 1.0)
    title = f"{kib} KiB in the frame or in shared memory: the larger rate says what `inline_max` to take"
    return Case(f"threshold-{kib}k", title, 256 * kib, contestants, (bar,), ("rate", *_RTT))


CASES: tuple[Case, ...] = (
    _small("40", 2.0),
    _small("4k", 1.8),
    Case("medium", "39 kB through shared memory, callback", FLOATS["39k"],
         (_cortex(), _raw(1), _raw(2), *_ROS), (_over(2.0, _RAW1, _RAW2),)),
    Case("large", "0.9 MB through shared memory, callback", FLOATS["900k"],
         (_cortex(), _raw(1), _raw(2), _COPY), (_over(3.0, _RAW1, _RAW2), _over(0.7, _RING))),
    Case("huge", "23.7 MB through shared memory, as a view, callback", FLOATS["23.7M"],
         (_cortex(), _raw(2), _COPY),
         (_over(0.85, _RING), _over(1.8, _RAW2)), bound=1.0),
    Case("consume", "23.7 MB, the subscriber copies every byte out", FLOATS["23.7M"],
         (_cortex(consume=True), _raw(2, consume=True)), (_over(1.0, _RAW2),)),
    Case("loan", "23.7 MB, the producer writes into the slot", FLOATS["23.7M"], (_cortex(loan=True),),
         (_over(10_000.0),)),
    Case("roundtrip-40", "round trip, 40 B out, 40 B back", FLOATS["40"], (_PING, _raw(1, "roundtrip")),
         (_under(1.15, _RAW1, metric="rtt_p50_us"), _under(1.3, _RAW1, metric="rtt_p99_us")), _RTT,
         bound=1 / 1.05),
    Case("roundtrip-900k", "round trip, 0.9 MB out, 40 B back", FLOATS["900k"],
         (_PING, _raw(1, "roundtrip"), _raw(2, "roundtrip")),
         (_under(0.6, _RAW1, _RAW2, metric="rtt_p50_us"),), _RTT),
    *map(_tcp, FLOATS),
    Case("async", "40 B, async iterator beside the blocking ways to receive", FLOATS["40"],
         (_cortex("async iterator", how="async"), _cortex("recv", how="recv")),
         (_over(0.8, "recv", who="async iterator"),)),
    Case("fanout", "40 B to 8 subscribers, each in its own process, callback; the slowest one's rate",
         FLOATS["40"], (_cortex(), _raw(1)), (_over(0.8, _RAW1), _over(100_000.0)), subscribers=8),
    _memory("40"),
    _memory("39k"),
    Case("deaths", "from the kill of a process under load until the other side knows", FLOATS["40"],
         (_cortex("publisher", kind="publisher dies"),
          _cortex("reader", kind="reader dies", max_wait_s=30.0)),
         tuple(_under(10.0, metric="known_ms", who=who) for who in ("publisher", "reader")), ("known_ms",)),
    *map(_threshold, (1, 2, 4, 8, 16, 32, 64)),
    Case("receive", "40 B: what each way to receive costs", FLOATS["40"],
         tuple(_cortex(how, how=how) for how in ("callback", "iterator", "recv", "async")), (),
         ("rate", "cpu_us")),
)  # fmt: skip


def choose(names: list[str]) -> list[Case]:
    """Return the cases of these names, in the table's order; a name also stands for all `name-…`.

    Raises:
        ValueError: A name fits none.
    """

    def fits(case: Case, name: str) -> bool:
        return case.name == name or case.name.startswith(f"{name}-")

    for name in names:
        if not any(fits(case, name) for case in CASES):
            raise ValueError(f"unknown case {name!r}, known: {', '.join(case.name for case in CASES)}")
    return [case for case in CASES if not names or any(fits(case, name) for name in names)]
