"""Runs a case: its contestants in turn, again and again, each repetition in processes of its own.

What a machine does besides changes by the second, and from process to process: so repetitions are short,
their order is turned round each time, and ratios are taken within each.
"""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cortex.bench import roles
from cortex.bench.cases import Case, Contestant
from cortex.bench.peers import Job, missing
from cortex.bench.processes import Child, ChildFailed

_GRACE_S = 120.0


Report = dict[str, Any]
"""What one repetition gave: a figure by metric, counts; `error` or `absent` if it gave none."""


class Settings(NamedTuple):
    """How long and how often to measure."""

    repeats: int = 5
    seconds: float = 0.5


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


def ratio_of(ours: list[Report], theirs: list[Report], metric: str) -> Spread | None:
    """Divide within each repetition, so that what slows the machine slows both sides."""
    pairs = zip(ours, theirs, strict=False)
    return spread_of(
        [own[metric] / other[metric] for own, other in pairs if metric in own and other.get(metric)]
    )


Results = dict[str, list[Report]]
"""What the contestants of a case did, by name, one report for each repetition."""


def run_case(case: Case, settings: Settings) -> Results:
    """Measure all contestants of a case, interleaved: A B C, C B A, and so on.

    A repetition that fails is recorded, and the next one begins afresh.
    """
    absent = {c.name: [{"absent": missing(c.peer)}] if missing(c.peer) else [] for c in case.contestants}
    results: Results = dict(absent)
    present = [contestant for contestant in case.contestants if not absent[contestant.name]]
    for repetition in range(settings.repeats):
        for contestant in reversed(present) if repetition & 1 else present:
            results[contestant.name].append(_repeat(case, contestant, settings))
    return results


def _repeat(case: Case, contestant: Contestant, settings: Settings) -> Report:
    with tempfile.TemporaryDirectory(dir=os.environ["CORTEX_BENCH_DIR"], prefix="r") as folder:
        job = Job(
            peer=contestant.peer,
            floats=case.floats,
            seconds=settings.seconds,
            options=contestant.options,
            folder=Path(folder),
            port=_free_port(),
        )
        child = partial(Child, deadline_s=_GRACE_S + 4.0 * job.seconds)
        try:
            if not contestant.peer:
                return _copies(job, child)
            if contestant.kind == "roundtrip":
                return _round_trips(job, child)
            return _flood(job, child, subscribers=case.subscribers)
        except ChildFailed as failure:
            return {"error": str(failure)}


def _flood(job: Job, child: Callable[..., Child], *, subscribers: int) -> Report:
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
    result["cpu_us"] = 1e6 * sum(report["cpu_s"] for report in reports) / max(1, result["received"])
    return result


def _round_trips(job: Job, child: Callable[..., Child]) -> Report:
    with child(roles.ask, job) as client, child(roles.answer, job) as server:
        report: Report = client.expect([server])
        server.expect()
        return report


def _copies(job: Job, child: Callable[..., Child]) -> Report:
    with child(roles.copy, job) as copier:
        copier.expect()
        copier.tell("go")
        report: Report = copier.expect()
        return report


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
