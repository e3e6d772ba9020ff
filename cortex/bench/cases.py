"""The cases: one per bar, what it sends, who takes part, and what has to come out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Kind = Literal["flood", "roundtrip", "copy", "copies at once"]

SIZES = {"40": 10, "4k": 1_000, "39k": 9_750, "900k": 225_000, "23.7M": 5_925_000}
"""Payloads: their name, their number of float32."""

_LABELS = {"40": "40 B", "4k": "4 kB", "39k": "39 kB", "900k": "0.9 MB", "23.7M": "23.7 MB"}

_SAMPLE = "stamp_ns: int64, data: float32[n]"

_AGE_COUNT = 30_000
"""Messages at 10 kHz, of which somebody who works 2 ms on each uses over 1,000: p99 means something."""


@dataclass(frozen=True)
class Contestant:
    """One way of doing a case's job."""

    name: str
    transport: str
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

    @property
    def text(self) -> str:
        """The bar in words."""
        best = self.against[0] if len(self.against) == 1 else f"the best of ({', '.join(self.against)})"
        what = f"{self.who} / {best}" if self.against else self.who
        unit = "" if self.against else f" {METRICS[self.metric].unit}"
        return f"{what}, {METRICS[self.metric].text} {self.wanted} {self.bound:,g}{unit}".rstrip()


@dataclass(frozen=True)
class Metric:
    """How a figure is called and written."""

    text: str
    unit: str
    larger_is_better: bool


METRICS = {
    "rate": Metric("rate", "/s", True),
    "cpu_us": Metric("subscriber's CPU", "us/msg", False),
    "rtt_p50_us": Metric("round trip p50", "us", False),
    "rtt_p99_us": Metric("round trip p99", "us", False),
    "age_p50_us": Metric("age p50", "us", False),
    "age_p99_us": Metric("age p99", "us", False),
    "grown_kb": Metric("memory grown", "kB", False),
    "shm_files": Metric("shm files left", "", False),
}


@dataclass(frozen=True)
class Case:
    """One named measurement."""

    name: str
    title: str
    message: str
    """The type of what is sent, in words."""
    floats: int
    contestants: tuple[Contestant, ...]
    bars: tuple[Bar, ...] = ()
    metrics: tuple[str, ...] = ("rate",)
    subscribers: int = 1
    count: int = 0
    """Messages per repetition; 0: as many as the time allows."""
    repeats: int = 0
    """At most so many repetitions; 0: as many as asked for."""


def _cortex(
    name: str = "cortex", *, transport: str = "cortex", kind: Kind = "flood", **options: Any
) -> Contestant:
    return Contestant(name, transport, options, kind)


def _pyzmq(name: str, *, kind: Kind = "flood", transport: str = "pyzmq", **options: Any) -> Contestant:
    return Contestant(name, transport, options, kind)


_ONE = _pyzmq("pyzmq 1 frame", frames=1)
_TWO = _pyzmq("pyzmq 2 frames, no copy", frames=2)
_ZENOH = Contestant("zenoh shm", "zenoh")
_ICEORYX = Contestant("iceoryx2 event", "iceoryx2")
_LCM = Contestant("LCM", "lcm")
_PRIVATE = Contestant("copy, private", "copy", kind="copy")
_RING = Contestant("copy into ring", "copy", {"ring": True}, kind="copy")
_AT_ONCE = Contestant("copy in + copy out", "copy", kind="copies at once")


def _small(name: str, size: str) -> Case:
    return Case(
        name,
        f"{_LABELS[size]}, typed, decoded to the message object in a callback",
        _SAMPLE,
        SIZES[size],
        (_cortex(), _ONE, _ZENOH, _LCM),
        (Bar("cortex", (_ONE.name,), ">=", 0.85),),
    )


def _batch(name: str, size: str, bound: float) -> Case:
    return Case(
        name,
        f"{_LABELS[size]}, type of fixed size, recv_batch as an array of structures",
        f"stamp_ns: int64, data: float32[{SIZES[size]}]",
        SIZES[size],
        (_cortex(fixed=True, how="batch"), _ONE),
        (Bar("cortex", (_ONE.name,), ">=", bound),),
    )


def _tcp(size: str) -> Case:
    one, two = _pyzmq(_ONE.name, frames=1, tcp=True), _pyzmq(_TWO.name, frames=2, tcp=True)
    raw = (two,) if size == "23.7M" else (one, two) if size in ("39k", "900k") else (one,)
    return Case(
        f"tcp-{size}",
        f"{_LABELS[size]} over tcp on loopback, callback",
        _SAMPLE,
        SIZES[size],
        (_cortex(tcp=True), *raw),
        (Bar("cortex", tuple(contestant.name for contestant in raw), ">=", 0.9),),
    )


def _latest(name: str, *, busy: bool) -> Case:
    def paced(contestant: str, transport: str, **options: Any) -> Contestant:
        return Contestant(contestant, transport, {"rate_hz": 10_000, "busy": busy, **options})

    return Case(
        name,
        f"age of a datum at use, publisher at 10 kHz, 2 ms of {'busy work' if busy else 'sleep'} on each",
        "stamp_ns: int64, sequence: int64, data: float32[n]",
        SIZES["40"],
        (
            paced("cortex recv", "cortex-latest", how="recv"),
            paced("cortex callback", "cortex-latest", how="callback"),
            paced("pyzmq CONFLATE", "pyzmq-latest"),
        ),
        tuple(Bar(who, (), "<=", 1000.0, "age_p99_us") for who in ("cortex recv", "cortex callback")),
        metrics=("age_p50_us", "age_p99_us"),
        count=_AGE_COUNT,
    )


def _memory(name: str, size: str) -> Case:
    ways = tuple(_cortex(how, how=how) for how in ("callback", "recv", "async"))
    return Case(
        name,
        f"memory of both sides over 10^6 messages of {_LABELS[size]}, by each way to receive",
        _SAMPLE,
        SIZES[size],
        ways,
        tuple(
            Bar(way.name, (), "<=", bound, metric)
            for way in ways
            for metric, bound in (("grown_kb", 1024.0), ("shm_files", 0.0))
        ),
        metrics=("rate", "grown_kb", "shm_files"),
        count=1_000_000,
        repeats=1,
    )


_HOWS = ("callback", "iterator", "recv", "async")
_SWEEP = (256, 512, 1024, 2048, 4096, 8192, 16384)


def _threshold(floats: int) -> Case:
    size = f"{4 * floats // 1024} KiB"
    inline: dict[str, Any] = {"inline_max": 1 << 20}
    shared: dict[str, Any] = {"inline_max": 64}
    return Case(
        f"threshold-{4 * floats // 1024}k",
        f"{size} in the frame or in shared memory: the larger rate says where `inline_max` belongs",
        _SAMPLE,
        floats,
        (
            _cortex("inline", **inline),
            _cortex("shared memory", **shared),
            _cortex("inline, round trip", kind="roundtrip", **inline),
            _cortex("shared memory, round trip", kind="roundtrip", **shared),
        ),
        metrics=("rate", "rtt_p50_us", "rtt_p99_us"),
    )


_HUGE = SIZES["23.7M"]
_RTT_ONE = _pyzmq(_ONE.name, kind="roundtrip", frames=1)
_RTT_TWO = _pyzmq(_TWO.name, kind="roundtrip", frames=2)
_RTT = ("rtt_p50_us", "rtt_p99_us")

CASES: tuple[Case, ...] = (
    _small("typed-40", "40"),
    _small("typed-4k", "4k"),
    _batch("batch-40", "40", 1.25),
    _batch("batch-4k", "4k", 1.5),
    Case(
        "medium",
        "39 kB through shared memory, callback",
        _SAMPLE,
        SIZES["39k"],
        (_cortex(), _ONE, _TWO, _ZENOH, _ICEORYX),
        (Bar("cortex", (_ONE.name, _TWO.name), ">=", 2.0),),
    ),
    Case(
        "large",
        "0.9 MB through shared memory, callback",
        _SAMPLE,
        SIZES["900k"],
        (_cortex(), _ONE, _TWO, _ZENOH, _ICEORYX, _PRIVATE, _RING),
        (
            Bar("cortex", (_ONE.name, _TWO.name), ">=", 3.0),
            Bar("cortex", (_RING.name,), ">=", 0.7),
        ),
    ),
    Case(
        "huge",
        "23.7 MB through shared memory, as a view, callback",
        _SAMPLE,
        _HUGE,
        (_cortex(), _TWO, _ZENOH, _ICEORYX, _PRIVATE, _RING),
        (
            Bar("cortex", (_RING.name,), ">=", 0.85),
            Bar("cortex", (_TWO.name,), ">=", 1.8),
            Bar("cortex", (_ICEORYX.name,), ">=", 0.95),
        ),
    ),
    Case(
        "consume",
        "23.7 MB, the subscriber copies every byte out",
        _SAMPLE,
        _HUGE,
        (
            _cortex(consume=True),
            _pyzmq(_TWO.name, frames=2, consume=True),
            Contestant(_ICEORYX.name, "iceoryx2", {"consume": True}),
            _AT_ONCE,
        ),
        (Bar("cortex", (_AT_ONCE.name,), ">=", 0.85),),
    ),
    Case(
        "loan",
        "23.7 MB, the producer writes into the slot",
        _SAMPLE,
        _HUGE,
        (_cortex(loan=True),),
        (Bar("cortex", (), ">=", 10_000.0),),
    ),
    Case(
        "roundtrip-40",
        "round trip, 40 B out, 40 B back",
        _SAMPLE,
        SIZES["40"],
        (_cortex(kind="roundtrip"), _RTT_ONE),
        (
            Bar("cortex", (_ONE.name,), "<=", 1.15, "rtt_p50_us"),
            Bar("cortex", (_ONE.name,), "<=", 1.3, "rtt_p99_us"),
        ),
        metrics=_RTT,
    ),
    Case(
        "roundtrip-900k",
        "round trip, 0.9 MB out, 40 B back",
        _SAMPLE,
        SIZES["900k"],
        (_cortex(kind="roundtrip"), _RTT_ONE, _RTT_TWO),
        (Bar("cortex", (_ONE.name, _TWO.name), "<=", 0.6, "rtt_p50_us"),),
        metrics=_RTT,
    ),
    *(_tcp(size) for size in SIZES),
    Case(
        "async",
        "40 B, async iterator beside the blocking ways to receive",
        _SAMPLE,
        SIZES["40"],
        (_cortex("async iterator", how="async"), _cortex("recv", how="recv")),
        (Bar("async iterator", ("recv",), ">=", 0.8),),
    ),
    Case(
        "fanout",
        "40 B to 8 subscribers, each in its own process, callback; the slowest one's rate",
        _SAMPLE,
        SIZES["40"],
        (_cortex(), _ONE),
        (Bar("cortex", (_ONE.name,), ">=", 0.8), Bar("cortex", (), ">=", 100_000.0)),
        subscribers=8,
    ),
    _latest("latest-busy", busy=True),
    _latest("latest-asleep", busy=False),
    *(
        Case(
            f"cpp-{size}",
            f"{_LABELS[size]}, Python publisher, C++ subscriber beside the Python one (callback)",
            _SAMPLE,
            SIZES[size],
            (_cortex("C++ subscriber", transport="cortex-cpp"), _cortex("Python subscriber")),
            (Bar("C++ subscriber", ("Python subscriber",), ">=", 1.0),),
        )
        for size in ("40", "900k")
    ),
    _memory("memory-40", "40"),
    _memory("memory-39k", "39k"),
    *(_threshold(floats) for floats in _SWEEP),
    Case(
        "receive",
        "40 B: what each way to receive costs",
        _SAMPLE,
        SIZES["40"],
        tuple(_cortex(how, how=how) for how in _HOWS),
        metrics=("rate", "cpu_us"),
    ),
)


def choose(names: list[str]) -> list[Case]:
    """Return the cases of these names, in the table's order; a name also stands for all `name-…`.

    Raises:
        ValueError: A name fits none.
    """
    for name in names:
        if not any(_fits(case, name) for case in CASES):
            raise ValueError(f"unknown case {name!r}, known: {', '.join(case.name for case in CASES)}")
    return [case for case in CASES if not names or any(_fits(case, name) for name in names)]


def _fits(case: Case, name: str) -> bool:
    return case.name == name or case.name.startswith(f"{name}-")
