"""The cases: one per question, what it sends, and who takes part."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

Kind = Literal["flood", "roundtrip"]


class Metric(NamedTuple):
    """How a figure is called and written."""

    text: str
    unit: str


METRICS = {
    "rate": Metric("rate", "/s"),
    "cpu_us": Metric("subscriber's CPU", "us/msg"),
    "rtt_p50_us": Metric("round trip p50", "us"),
    "rtt_p99_us": Metric("round trip p99", "us"),
}
BEFORE = ", before"
"""Ends the name of a contestant of another checkout."""


@dataclass(frozen=True)
class Contestant:
    """One way of doing a case's job."""

    name: str
    peer: str = ""
    """Key of `cortex.bench.peers.PEERS`; empty: no library, but copies of memory."""
    options: Mapping[str, Any] = field(default_factory=dict)
    kind: Kind = "flood"

    @property
    def metric(self) -> str:
        """The figure by which it is compared."""
        return "rtt_p50_us" if self.kind == "roundtrip" else "rate"


@dataclass(frozen=True)
class Case:
    """One named measurement; the first contestant is compared with the others."""

    name: str
    title: str
    floats: int
    contestants: tuple[Contestant, ...]
    metrics: tuple[str, ...] = ("rate",)
    subscribers: int = 1

    def beside(self, checkout: str) -> Case:
        """Return the case with each contestant of Cortex in Python also as another checkout has it."""
        theirs = [
            dataclasses.replace(c, name=c.name + BEFORE, options={**c.options, "checkout": checkout})
            for c in self.contestants
            if c.peer == "cortex"
        ]
        return dataclasses.replace(self, contestants=(*self.contestants, *theirs))

    def compared_with(self, contestant: Contestant) -> Contestant | None:
        """Return whose figure is divided by that of a contestant: that of this checkout, else the first."""
        now = contestant.name.removesuffix(BEFORE)
        rivals = [c for c in self.contestants if now != contestant.name and c.name == now]
        (first,) = rivals or self.contestants[:1]
        return first if first != contestant and first.kind == contestant.kind else None


FLOATS = {"40": 10, "4k": 1_000, "39k": 9_750, "900k": 225_000, "23.7M": 5_925_000}
"""Payloads: their name, their number of float32."""
_LABELS = {"40": "40 B", "4k": "4 kB", "39k": "39 kB", "900k": "0.9 MB", "23.7M": "23.7 MB"}
_RTT = ("rtt_p50_us", "rtt_p99_us")


def _cortex(name: str = "cortex", kind: Kind = "flood", **options: Any) -> Contestant:
    return Contestant(name, "cortex", options, kind)


def _raw(frames: int, kind: Kind = "flood", **options: Any) -> Contestant:
    name = "pyzmq 1 frame" if frames == 1 else "pyzmq 2 frames, no copy"
    return Contestant(name, "pyzmq", {"frames": frames, **options}, kind)


_ROS = (Contestant("Cyclone DDS", "Cyclone DDS"), Contestant("rclpy", "rclpy"))
_COPY = Contestant("copy into ring")
_PING = _cortex(kind="roundtrip")


def _small(size: str) -> Case:
    title = f"{_LABELS[size]}, typed, decoded to the message object in a callback"
    return Case(f"typed-{size}", title, FLOATS[size], (_cortex(), _raw(1), *_ROS))


def _tcp(size: str) -> Case:
    frames = {"40": (1,), "4k": (1,), "23.7M": (2,)}.get(size, (1, 2))
    contestants = (_cortex(tcp="127.0.0.1"), *(_raw(number, tcp="127.0.0.1") for number in frames))
    return Case(f"tcp-{size}", f"{_LABELS[size]} over tcp on loopback, callback", FLOATS[size], contestants)


def _threshold(kib: int) -> Case:
    """Compare both ways: `inline_max` is right if the frame carries more up to it, and less above."""
    ways = {"shared memory": 64, "inline": 1 << 20}
    contestants = (
        *(_cortex(name, inline_max=most) for name, most in ways.items()),
        *(_cortex(f"{name}, round trip", kind="roundtrip", inline_max=most) for name, most in ways.items()),
    )
    title = f"{kib} KiB in the frame or in shared memory: the larger rate says what `inline_max` to take"
    return Case(f"threshold-{kib}k", title, 256 * kib, contestants, ("rate", *_RTT))


CASES: tuple[Case, ...] = (
    _small("40"),
    _small("4k"),
    Case("medium", "39 kB through shared memory, callback", FLOATS["39k"],
         (_cortex(), _raw(1), _raw(2), *_ROS)),
    Case("large", "0.9 MB through shared memory, callback", FLOATS["900k"],
         (_cortex(), _raw(1), _raw(2), _COPY)),
    Case("huge", "23.7 MB through shared memory, as a view, callback", FLOATS["23.7M"],
         (_cortex(), _raw(2), _COPY)),
    Case("consume", "23.7 MB, the subscriber copies every byte out", FLOATS["23.7M"],
         (_cortex(consume=True), _raw(2, consume=True))),
    Case("loan", "23.7 MB, the producer writes into the slot", FLOATS["23.7M"], (_cortex(loan=True),)),
    Case("roundtrip-40", "round trip, 40 B out, 40 B back", FLOATS["40"],
         (_PING, _raw(1, "roundtrip")), _RTT),
    Case("roundtrip-900k", "round trip, 0.9 MB out, 40 B back", FLOATS["900k"],
         (_PING, _raw(1, "roundtrip"), _raw(2, "roundtrip")), _RTT),
    *map(_tcp, FLOATS),
    Case("fanout", "40 B to 8 subscribers, each in its own process, callback; the slowest one's rate",
         FLOATS["40"], (_cortex(), _raw(1)), subscribers=8),
    *map(_threshold, (1, 2, 4, 8, 16, 32, 64)),
    Case("receive", "40 B: what each way to receive costs", FLOATS["40"],
         tuple(_cortex(how, how=how) for how in ("callback", "iterator", "recv", "async")),
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
