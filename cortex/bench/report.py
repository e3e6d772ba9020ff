"""The tables that people read, and the CSV."""

from __future__ import annotations

import csv
import importlib.metadata
import os
import platform
import textwrap
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import TextIO

import zmq

from cortex.bench.cases import METRICS, Case
from cortex.bench.measure import CaseResult, Outcome, Verdict
from cortex.bench.spread import Spread

WIDTH = 110
_LABELS = ("case", "contestant", "payload_bytes")
_COUNTS = ("sent", "received", "lost", "misordered", "corrupt")
_PEERS = ("numpy", "eclipse-zenoh", "iceoryx2", "lcm")


def header() -> list[str]:
    """Return what the figures depend on: date, machine, versions, load."""
    versions = [
        f"Python {platform.python_version()}",
        f"pyzmq {zmq.pyzmq_version()}",
        f"libzmq {zmq.zmq_version()}",
    ]
    for name in _PEERS:
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            versions.append(f"{name} not installed")
    load = " ".join(f"{value:.2f}" for value in os.getloadavg())
    return [
        f"cortex bench, {datetime.now().astimezone():%Y-%m-%d %H:%M %Z}",
        f"{os.cpu_count()} cores, {_processor()}, {platform.system()} {platform.release()}, load {load}",
        *textwrap.wrap(", ".join(versions), WIDTH),
    ]


def case_lines(result: CaseResult, *, quick: bool = False) -> Iterator[str]:
    """Yield the block of one case: what each contestant did, then the case's bars, not judged if `quick`."""
    case = result.case
    yield f"{case.name}: {case.title}"
    yield f"  message: {case.message}; payload {4 * case.floats:,} B"
    for outcome in result.outcomes.values():
        yield from _outcome_lines(case, outcome)
    for verdict in result.verdicts():
        word = _word(verdict, quick)
        yield _clip(f"  => {_measured(verdict):>13}  {_what(verdict)}; bar {_bound(verdict)}: {word}")


def summary_lines(results: list[CaseResult], *, quick: bool = False) -> Iterator[str]:
    """Yield the table of all bars; if `quick`, none is judged."""
    verdicts = [(result.case.name, verdict) for result in results for verdict in result.verdicts()]
    if not verdicts:
        return
    yield f"{'case':<17}{'what':<49}{'measured':>13}  {'bar':<14}verdict"
    yield "-" * WIDTH
    for name, verdict in verdicts:
        word = _word(verdict, quick).partition(" (")[0]  # the reason stands in the case's own block
        yield f"{name:<17}{_what(verdict)[:48]:<49}{_measured(verdict):>13}  {_bound(verdict):<14}{word}"
    words = [_word(verdict, quick) for _, verdict in verdicts]
    yield "-" * WIDTH
    if quick:
        unmeasured = len(words) - words.count("quick")
        yield f"a quick run judges nothing: {words.count('quick')} quick, {unmeasured} not measured"
        return
    met, missed = (sum(word.startswith(start) for word in words) for start in ("met", "missed"))
    yield f"{met} met, {missed} missed, {len(words) - met - missed} not measured"


def threshold_lines(results: list[CaseResult], *, quick: bool = False) -> Iterator[str]:
    """Yield the sweep of sizes that `inline_max` is chosen by, without the conclusion if `quick`.

    Nothing if it was not measured.
    """
    sweep = {
        4 * r.case.floats: _inline_and_shared(r) for r in results if r.case.name.startswith("threshold-")
    }
    if not sweep:
        return
    yield f"{'payload':>10}{'inline':>12}{'shared':>12}  shared / inline, rate   round trip p50"
    wins: list[int] = []
    for size, figures in sweep.items():
        if any(value is None for value in figures):
            yield f"{size:>10,}  not measured"
            continue
        inline, shared, inline_us, shared_us = (value or 0.0 for value in figures)
        ratio, rtt_ratio = shared / inline, shared_us / inline_us
        yield f"{size:>10,}{inline:>10,.0f}/s{shared:>10,.0f}/s{ratio:>18.2f}{rtt_ratio:>17.2f}"
        wins = [*wins, size] if ratio >= 1.0 else []
    if quick:
        return
    yield (
        f"shared memory carries more messages from {wins[0]:,} B on"
        if wins
        else "inline carries more throughout"
    )


def _inline_and_shared(result: CaseResult) -> list[float | None]:
    """Return the rates inline and shared, then the medians of their round trips."""
    names = [contestant.name for contestant in result.case.contestants]
    figures: list[float | None] = []
    for name, metric in zip(names, ("rate", "rate", "rtt_p50_us", "rtt_p50_us"), strict=True):
        spread = Spread.of(result.outcomes[name].values(metric))
        figures.append(None if spread is None else spread.median)
    return figures


def write_csv(path: Path, results: list[CaseResult]) -> None:
    """Write one line per case, contestant and metric, the single repetitions included."""
    with path.open("w", newline="") as file:
        _write_rows(file, results)


def _write_rows(file: TextIO, results: list[CaseResult]) -> None:
    writer = csv.writer(file)
    writer.writerow(
        [*_LABELS, "metric", "unit", "median", "low", "high", "repetitions", *_COUNTS, "error", "values"]
    )
    for result in results:
        for outcome in result.outcomes.values():
            for metric in result.case.metrics:
                values = outcome.values(metric)
                spread = Spread.of(values)
                if spread is None and not (outcome.absent or outcome.errors):
                    continue
                writer.writerow(
                    [
                        result.case.name,
                        outcome.contestant.name,
                        4 * result.case.floats,
                        metric,
                        METRICS[metric].unit,
                        "" if spread is None else f"{spread.median:.6g}",
                        "" if spread is None else f"{spread.low:.6g}",
                        "" if spread is None else f"{spread.high:.6g}",
                        len(values),
                        *(
                            outcome.total(count)
                            for count in ("sent", "received", "lost", "misordered", "corrupt")
                        ),
                        outcome.absent or "; ".join(outcome.errors),
                        " ".join(f"{value:.6g}" for value in values),
                    ]
                )


def _outcome_lines(case: Case, outcome: Outcome) -> Iterator[str]:
    cells = []
    for metric in case.metrics:
        spread = Spread.of(outcome.values(metric))
        if spread is not None:
            text = "" if metric == "rate" else f"{METRICS[metric].text} "
            cells.append(f"{text}{_figure(spread, METRICS[metric].unit)}")
    if outcome.absent:
        cells.append(outcome.absent)
    elif outcome.errors:
        cells.append(f"{len(outcome.errors)} of {len(outcome.repetitions)} failed: {outcome.errors[0]}")
    if outcome.faults:
        cells.append(outcome.faults)
    yield _clip(f"  {outcome.contestant.name:<26}{'   '.join(cells)}")


def _figure(spread: Spread, unit: str) -> str:
    percent = 100.0 * spread.half_width / spread.median if spread.median else 0.0
    return f"{_number(spread.median):>9} {unit:<3}± {percent:2.0f} %"


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def _word(verdict: Verdict, quick: bool) -> str:
    if quick and verdict.measured is not None:
        return "quick"
    return f"{verdict.word}, within noise" if verdict.is_open else verdict.word


def _what(verdict: Verdict) -> str:
    bar = verdict.bar
    if not bar.against:
        return f"{bar.who}, {METRICS[bar.metric].text}"
    rival = verdict.against or bar.against[0]
    metric = "" if bar.metric == "rate" else f", {METRICS[bar.metric].text}"
    return f"{bar.who} / {rival}{metric}"


def _measured(verdict: Verdict) -> str:
    spread = verdict.measured
    if spread is None:
        return "-"
    if verdict.bar.against:
        return f"{spread.median:.2f} ± {spread.half_width:.2f}"
    return f"{_number(spread.median)} {METRICS[verdict.bar.metric].unit}".strip()


def _bound(verdict: Verdict) -> str:
    bar = verdict.bar
    unit = "" if bar.against else f" {METRICS[bar.metric].unit}"
    return f"{bar.wanted} {_number(bar.bound)}{unit}".rstrip()


def _clip(line: str) -> str:
    line = line.rstrip()
    return line if len(line) <= WIDTH else f"{line[: WIDTH - 1]}…"


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
