"""Runs a case: its contestants in turn, again and again, each repetition in processes of its own.

What a machine does besides changes by the second, and from process to process: so repetitions are short,
their order is turned round each time, ratios are taken within each, and a bar that lies between the quartiles
of what was measured is said to.
"""

from __future__ import annotations

import os
import socket
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cortex.bench import roles
from cortex.bench.cases import METRICS, Bar, Case, Contestant
from cortex.bench.peers import Job, missing
from cortex.bench.processes import Child, ChildFailed

_SHM = Path("/dev/shm")
_GRACE_S = 120.0
_SLOWEST_HZ = 2_000.0
_LOADED_S = 0.3
"""So long after the beginning of a flood a process is killed [s]."""


Report = dict[str, Any]
"""What one repetition gave: a figure by metric, counts; `error` or `absent` if it gave none."""


class Settings(NamedTuple):
    """How long and how often to measure."""

    repeats: int = 5
    seconds: float = 0.5
    count_max: int = 0
    """Bounds the messages of cases that count them; 0: no bound."""


class Spread(NamedTuple):
    """A median, and the quartiles around it."""

    median: float
    low: float
    high: float


def spread_of(values: list[float]) -> Spread | None:
    """Return the spread of some figures; None if there are none."""
    return Spread(*map(float, np.quantile(values, [0.5, 0.25, 0.75]))) if values else None


def values_of(reports: list[Report], metric: str) -> list[float]:
    """Return one figure per repetition that has it."""
    return [float(report[metric]) for report in reports if metric in report]


def faults_of(reports: list[Report]) -> str:
    """Return what spoils a contestant's figures, in words; empty if nothing does."""
    errors = [str(report["error"]) for report in reports if "error" in report]
    parts = [str(report["absent"]) for report in reports if "absent" in report]
    parts += [f"{len(errors)} of {len(reports)} failed: {errors[0]}"] if errors else []
    for count, word in {"lost": "LOST", "misordered": "OUT OF ORDER", "corrupt": "CORRUPT"}.items():
        if total := sum(values_of(reports, count)):
            parts.append(f"{word} {total:,.0f} of {sum(values_of(reports, 'sent')):,.0f}")
    return ", ".join(parts)


class Verdict(NamedTuple):
    """A bar and what was measured."""

    bar: Bar
    measured: Spread | None
    against: str
    """Name of the best of those it is measured against."""
    note: str
    """Why there is nothing to judge, or what spoils a figure that would do."""

    @property
    def word(self) -> str:
        """Met, missed, or not measured."""
        if self.measured is None or self.note:
            return f"{'missed' if self.measured else 'not measured'} ({self.note})"
        value, bound = self.measured.median, self.bar.bound
        return "met" if (value >= bound if self.bar.wanted == ">=" else value <= bound) else "missed"

    @property
    def is_open(self) -> bool:
        """Whether the bar lies between the quartiles: more repetitions might give another verdict."""
        found = None if self.note else self.measured
        return found is not None and found.low < self.bar.bound < found.high


def judge(bar: Bar, results: dict[str, list[Report]]) -> Verdict:
    """Compare: ratios are taken within each repetition, so that what slows the machine slows both sides."""
    ours, metric = results[bar.who], bar.metric
    values, note = values_of(ours, metric), faults_of(ours)
    if not bar.against or not values:
        return Verdict(bar, spread_of(values), "", note)
    rivals = [name for name in bar.against if values_of(results[name], metric)]
    if not rivals:
        return Verdict(bar, None, "", f"{bar.against[0]}: {faults_of(results[bar.against[0]])}")
    pick = max if METRICS[metric].larger_is_better else min
    best = pick(rivals, key=lambda name: float(np.median(values_of(results[name], metric))))
    pairs = zip(ours, results[best], strict=True)
    ratios = [own[metric] / other[metric] for own, other in pairs if metric in own and other.get(metric)]
    return Verdict(bar, spread_of(ratios), best, note if ratios else "never both in one repetition")


@dataclass
class CaseResult:
    """What the contestants of a case did, by name, one report for each repetition."""

    case: Case
    reports: dict[str, list[Report]]

    def verdicts(self) -> list[Verdict]:
        """Return the case's bars with what was measured."""
        return [judge(bar, self.reports) for bar in self.case.bars]


def run_case(case: Case, settings: Settings) -> CaseResult:
    """Measure all contestants of a case, interleaved: A B C, C B A, and so on.

    A repetition that fails is recorded, and the next one begins afresh.
    """
    repeats = min(settings.repeats, case.repeats or settings.repeats)
    absent = {c.name: [{"absent": missing(c.peer)}] if missing(c.peer) else [] for c in case.contestants}
    result = CaseResult(case, absent)
    present = [contestant for contestant in case.contestants if not absent[contestant.name]]
    for repetition in range(repeats):
        for contestant in reversed(present) if repetition & 1 else present:
            result.reports[contestant.name].append(_repeat(case, contestant, settings))
    return result


def _repeat(case: Case, contestant: Contestant, settings: Settings) -> dict[str, Any]:
    runs: dict[str, Callable[..., dict[str, Any]]] = {
        "flood": partial(_flood, subscribers=case.subscribers),
        "roundtrip": _round_trips,
        "copy": _copies,
        "publisher dies": partial(_dies, reader_dies=False),
        "reader dies": partial(_dies, reader_dies=True),
    }
    with tempfile.TemporaryDirectory(dir=os.environ["CORTEX_BENCH_DIR"], prefix="r") as folder:
        job = Job(
            peer=contestant.peer,
            floats=case.floats,
            seconds=settings.seconds,
            count=min(case.count, settings.count_max) if settings.count_max else case.count,
            options=contestant.options,
            folder=Path(folder),
            port=_free_port(),
        )
        deadline_s = _GRACE_S + 4.0 * job.seconds + job.count / _SLOWEST_HZ
        before = set(_SHM.glob("*"))
        try:
            report = runs[contestant.kind](job, partial(Child, deadline_s=deadline_s))
        except ChildFailed as failure:
            return {"error": str(failure)}
        return {**report, "shm_files": len(set(_SHM.glob("*")) - before)}


def _flood(job: Job, child: Callable[..., Child], *, subscribers: int) -> dict[str, Any]:
    """One publisher, some subscribers; the slowest one's rate counts, and the losses of all."""
    with ExitStack() as stack:
        publisher = stack.enter_context(child(roles.publish, job))
        receivers = [stack.enter_context(child(roles.receive, job)) for _ in range(subscribers)]
        for receiver in receivers:
            receiver.expect([publisher, *receivers])
        publisher.tell("go")
        sent = publisher.expect(receivers)
        reports = [receiver.expect([publisher, *receivers]) for receiver in receivers]
        publisher.tell("stop")
        publisher.expect()
    total = {key: sum(report[key] for report in reports) for key in ("received", "misordered", "corrupt")}
    result = {**reports[0], **total, "sent": sent["sent"] * subscribers}
    result["rate"] = min(report["rate"] for report in reports)
    result["lost"] = result["sent"] - result["received"]
    result["grown_kb"] = max(sent["grown_kb"], *(report["grown_kb"] for report in reports))
    result["cpu_us"] = 1e6 * sum(report["cpu_s"] for report in reports) / max(1, result["received"])
    return result


def _round_trips(job: Job, child: Callable[..., Child]) -> Any:
    with child(roles.ask, job) as client, child(roles.answer, job) as server:
        report = client.expect([server])
        server.expect()
        return report


def _dies(job: Job, child: Callable[..., Child], *, reader_dies: bool) -> dict[str, float]:
    """Kill one side under load; how long the other takes to know."""
    job = replace(job, seconds=_GRACE_S)
    sender, receiver = (
        (roles.publish_until_freed, roles.stop_reading) if reader_dies else (roles.publish, roles.await_death)
    )
    with child(sender, job) as publisher, child(receiver, job) as reader:
        reader.expect([publisher])
        publisher.tell("go")
        time.sleep(_LOADED_S)
        killed, other = (reader, publisher) if reader_dies else (publisher, reader)
        killed_ns = killed.kill()
        return {"known_ms": (other.expect() - killed_ns) / 1e6}


def _copies(job: Job, child: Callable[..., Child]) -> Any:
    with child(roles.copy, job) as copier:
        copier.expect()
        copier.tell("go")
        return copier.expect()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
