"""Runs a case: its contestants in turn, again and again, each repetition in processes of its own.

What a machine does besides changes by the second, and from process to process: so repetitions are short,
their order is turned round each time, ratios are taken within each, and a bar that lies within the interval
of what was measured is measured again, up to a limit, whichever side of it the median is on.
"""

from __future__ import annotations

import contextlib
import statistics
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from cortex.bench import roles
from cortex.bench.cases import METRICS, Bar, Case, Contestant
from cortex.bench.children import Child, ChildFailed
from cortex.bench.copies import copy_alone, copy_in, copy_out, make_ring, slots_of
from cortex.bench.job import Job
from cortex.bench.spread import Spread
from cortex.bench.transports import missing

_SHM = Path("/dev/shm")
_GRACE_S = 120.0
_SLOWEST_HZ = 2_000.0
_PARENT_MAX = 40
"""Longest directory of temporary files [characters]: paths of sockets end at 107."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How long and how often to measure."""

    folder: Path
    """Private directory of the run."""
    repeats: int = 5
    repeats_max: int = 0
    """Up to which a bar is measured again that lies within the noise; 0: it is not."""
    seconds: float = 0.5
    count_max: int = 0
    """Bounds the messages of cases that count them; 0: no bound."""

    def __post_init__(self) -> None:
        if self.repeats < 1:
            raise ValueError(f"repeats must be >= 1, got {self.repeats}")
        if not 0.0 < self.seconds <= 600.0:  # also refuses nan
            raise ValueError(f"seconds must be > 0 and <= 600, got {self.seconds}")


@dataclass
class Outcome:
    """What one contestant did in all its repetitions."""

    contestant: Contestant
    repetitions: list[dict[str, Any]] = field(default_factory=list)
    """Reports, in order; one that failed has only the key ``error``."""
    absent: str = ""
    """Why it did not take part."""

    def values(self, metric: str) -> list[float]:
        """Return one figure per repetition that has it."""
        return [float(report[metric]) for report in self.repetitions if metric in report]

    def total(self, count: str) -> int:
        """Return the sum of a count over all repetitions."""
        return sum(int(report.get(count, 0)) for report in self.repetitions)

    @property
    def errors(self) -> list[str]:
        """What went wrong, one text for each repetition that failed."""
        return [str(report["error"]) for report in self.repetitions if "error" in report]

    @property
    def faults(self) -> str:
        """Losses, disorder and damage in words; empty if there were none."""
        counts = {
            "LOST": self.total("lost"),
            "OUT OF ORDER": self.total("misordered"),
            "CORRUPT": self.total("corrupt"),
        }
        parts = [f"{name} {count:,}" for name, count in counts.items() if count]
        if counts["LOST"]:
            parts[0] += f" ({100.0 * counts['LOST'] / max(1, self.total('sent')):.1f} %)"
        return ", ".join(parts)


@dataclass(frozen=True)
class Verdict:
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
        if self.measured is None:
            return f"not measured ({self.note})"
        value, bound = self.measured.median, self.bar.bound
        met = value >= bound if self.bar.wanted == ">=" else value <= bound
        if self.note:
            return f"missed ({self.note})"
        return "met" if met else "missed"

    @property
    def is_open(self) -> bool:
        """Whether the bar lies within the noise: more repetitions might give another verdict."""
        return self.measured is not None and not self.note and self.measured.leaves_open(self.bar.bound)


@dataclass
class CaseResult:
    """Everything about one case."""

    case: Case
    outcomes: dict[str, Outcome]

    def verdicts(self) -> list[Verdict]:
        """Return the case's bars with what was measured."""
        return [judge(bar, self.outcomes) for bar in self.case.bars]


def run_case(
    case: Case, settings: Settings, *, progress: Callable[[str], None] = lambda _: None
) -> CaseResult:
    """Measure all contestants of a case, interleaved: A B C, C B A, and so on.

    A repetition that fails is recorded, and the next one begins afresh.
    """
    outcomes = {c.name: Outcome(c, absent=_absent(c)) for c in case.contestants}
    result = CaseResult(case, outcomes)
    repeats = min(settings.repeats, case.repeats or settings.repeats)
    repeats_max = max(repeats, 0 if case.repeats else settings.repeats_max)
    for repetition in range(repeats_max):
        if repetition >= repeats and not any(verdict.is_open for verdict in result.verdicts()):
            break
        present = [outcome for outcome in outcomes.values() if not outcome.absent]
        for outcome in reversed(present) if repetition & 1 else present:
            progress(f"{case.name} {repetition + 1}/{repeats} {outcome.contestant.name}")
            outcome.repetitions.append(_repeat(case, outcome.contestant, settings))
    return result


def judge(bar: Bar, outcomes: dict[str, Outcome]) -> Verdict:
    """Compare: ratios are taken within each repetition, so that what slows the machine slows both sides."""
    who = outcomes[bar.who]
    values = who.values(bar.metric)
    if not values:
        return Verdict(bar, None, "", who.absent or next(iter(who.errors), "no figure"))
    note = who.faults or (f"{len(who.errors)} repetitions failed" if who.errors else "")
    if not bar.against:
        return Verdict(bar, Spread.of(values), "", note)
    rivals = [outcomes[name] for name in bar.against if outcomes[name].values(bar.metric)]
    if not rivals:
        rival = outcomes[bar.against[0]]
        return Verdict(
            bar, None, "", f"{rival.contestant.name}: {rival.absent or next(iter(rival.errors), '?')}"
        )
    pick = max if METRICS[bar.metric].larger_is_better else min
    best = pick(rivals, key=lambda rival: statistics.median(rival.values(bar.metric)))
    ratios = [
        float(ours[bar.metric]) / float(theirs[bar.metric])
        for ours, theirs in zip(who.repetitions, best.repetitions, strict=True)
        if bar.metric in ours and theirs.get(bar.metric)
    ]
    return Verdict(
        bar, Spread.of(ratios), best.contestant.name, note if ratios else "never both in one repetition"
    )


def _absent(contestant: Contestant) -> str:
    return "" if contestant.transport == "copy" else missing(contestant.transport)


def _repeat(case: Case, contestant: Contestant, settings: Settings) -> dict[str, Any]:
    """Do one repetition in a directory of its own; a failure becomes the report's ``error``."""
    count = min(case.count, settings.count_max) if settings.count_max else case.count
    with tempfile.TemporaryDirectory(dir=settings.folder, prefix="r") as folder:
        job = Job(
            transport=contestant.transport,
            floats=case.floats,
            seconds=settings.seconds,
            count=count,
            options=contestant.options,
            folder=Path(folder),
        )
        before = _shm_files()
        try:
            if contestant.kind == "flood":
                report = _flood(job, case.subscribers)
            elif contestant.kind == "roundtrip":
                report = _round_trips(job)
            elif contestant.kind == "copy":
                report = _copy(job)
            else:
                report = _copies_at_once(job)
        except ChildFailed as failure:
            return {"error": str(failure)}
        finally:
            left = _shm_files() - before
            _sweep(left)
        report["shm_files"] = len(left)
        return report


def _flood(job: Job, subscribers: int) -> dict[str, Any]:
    """One publisher, some subscribers; the slowest one's rate counts, and the losses of all."""
    child = partial(Child, log=job.folder / "log", deadline_s=_deadline_s(job))
    with ExitStack() as stack:
        publisher = stack.enter_context(child(roles.publish, job))
        job = replace(job, address=publisher.expect("ready")["address"])
        receivers = [stack.enter_context(child(roles.receive, job)) for _ in range(subscribers)]
        for receiver in receivers:
            receiver.expect("connected", beside=[publisher, *receivers])
        publisher.tell("go")
        sent = publisher.expect("sent", beside=receivers)
        reports = [receiver.expect("result", beside=[publisher]) for receiver in receivers]
        publisher.tell("stop")
        publisher.expect("closed")
    first = reports[0]
    total = {key: sum(report[key] for report in reports) for key in ("received", "misordered", "corrupt")}
    result: dict[str, Any] = {**total, "sent": sent["sent"] * subscribers}
    if "rate" in first:
        result["rate"] = min(report["rate"] for report in reports)
        result["lost"] = result["sent"] - result["received"]
        result["grown_kb"] = max([sent["grown_kb"], *(report["grown_kb"] for report in reports)])
        if total["received"]:
            result["cpu_us"] = 1e6 * sum(report["cpu_s"] for report in reports) / total["received"]
    return result | {key: value for key, value in first.items() if key.startswith("age_")}


def _round_trips(job: Job) -> dict[str, Any]:
    child = partial(Child, log=job.folder / "log", deadline_s=_deadline_s(job))
    with child(roles.ask, job) as client:
        job = replace(job, address=client.expect("ready")["address"])
        with child(roles.answer, job) as server:
            report = client.expect("result", beside=[server])
            server.expect("closed")
    return {key: value for key, value in report.items() if key != "event"}


def _copy(job: Job) -> dict[str, Any]:
    with Child(copy_alone, job, log=job.folder / "log", deadline_s=_deadline_s(job)) as copier:
        copier.expect("ready")
        copier.tell("go")
        return _without_event(copier.expect("result"))


def _copies_at_once(job: Job) -> dict[str, Any]:
    ring = make_ring(job.floats, slots_of(job.payload_bytes))
    child = partial(Child, job=job, log=job.folder / "log", deadline_s=_deadline_s(job))
    with child(partial(copy_in, ring=ring)) as writer, child(partial(copy_out, ring=ring)) as reader:
        for copier in (writer, reader):
            copier.expect("ready")
        for copier in (writer, reader):
            copier.tell("go")
        reports = [copier.expect("result") for copier in (writer, reader)]
    return _without_event(min(reports, key=lambda report: float(report["rate"])))


def _without_event(report: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in report.items() if key != "event"} | {"sent": report["received"]}


def _deadline_s(job: Job) -> float:
    return _GRACE_S + 4.0 * job.seconds + job.count / _SLOWEST_HZ


def _shm_files() -> set[Path]:
    return set(_SHM.glob("*")) if _SHM.is_dir() else set()


def _sweep(left: set[Path]) -> None:
    """Remove what a peer that was killed left behind: only names that the peers of this benchmark give."""
    for path in left:
        if path.name.startswith("iox2_") or path.suffix == ".zenoh":
            with contextlib.suppress(OSError):
                path.unlink()


@contextlib.contextmanager
def private_folder() -> Iterator[Path]:
    """Make the run's directory, with a path short enough for the sockets in it, and remove it afterwards."""
    parent = tempfile.gettempdir()
    with tempfile.TemporaryDirectory(
        prefix="cxb", dir=parent if len(parent) <= _PARENT_MAX else "/tmp"
    ) as folder:
        yield Path(folder)
