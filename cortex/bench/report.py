"""The tables that people read, and the CSV."""

from __future__ import annotations

import csv
import importlib.metadata
import os
import platform
from datetime import datetime
from pathlib import Path

import zmq

from cortex.bench.cases import METRICS, Bar
from cortex.bench.measure import CaseResult, Spread, Verdict, faults_of, spread_of, values_of
from cortex.commands.text import table

_PEERS = ("pyzmq", "numpy", "cyclonedds", "rclpy")


def print_header() -> None:
    """Print what the figures depend on: date, machine, versions, load."""
    versions = [f"Python {platform.python_version()}", f"libzmq {zmq.zmq_version()}"]
    for name in _PEERS:
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            versions.append(f"{name} not installed")
    load = " ".join(f"{value:.2f}" for value in os.getloadavg())
    print(f"cortex bench, {datetime.now().astimezone():%Y-%m-%d %H:%M %Z}")
    print(f"{os.cpu_count()} cores, {_processor()}, {platform.system()} {platform.release()}, load {load}")
    print(", ".join(versions))


def print_case(result: CaseResult) -> None:
    """Print what each contestant of a case did."""
    case = result.case
    print(f"{case.name}: {case.title}; payload {4 * case.floats:,} B")
    rows = []
    for name, reports in result.reports.items():
        cells = (_cell(spread_of(values_of(reports, metric)), metric) for metric in case.metrics)
        rows.append((name, *cells, faults_of(reports)))
    for line in table(("", *(METRICS[metric].text for metric in case.metrics), "<"), rows):
        print(line)
    print(flush=True)


def print_summary(results: list[CaseResult], *, judged: bool) -> None:
    """Print the table of all bars, and how many are met."""
    words, rows = [], []
    for result in results:
        for verdict in result.verdicts():
            words.append(_word(verdict, judged).partition(" (")[0])  # the reason stands above
            what, measured = _what(verdict.bar, verdict.against), _measured(verdict)
            rows.append((result.case.name, what, measured, _bound(verdict.bar), words[-1]))
    if words:
        for line in table(("case", "<what", "measured", "<bar", "<verdict"), rows):
            print(line)
    known = ("met", "missed", "not measured", "not judged")
    counts = {word: sum(each.startswith(word) for each in words) for word in known}
    print(", ".join(f"{count} {word}" for word, count in counts.items() if count))


def write_csv(path: Path, results: list[CaseResult]) -> None:
    """Write a line for each repetition of each contestant; one that did not take part has one line."""
    lines = [
        {"case": result.case.name, "contestant": name, "repetition": number, **report}
        for result in results
        for name, reports in result.reports.items()
        for number, report in enumerate(reports)
    ]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for line in lines for key in line)))
        writer.writeheader()
        writer.writerows(lines)


def _cell(spread: Spread | None, metric: str) -> str:
    if spread is None:
        return ""
    percent = 50.0 * (spread.high - spread.low) / spread.median if spread.median else 0.0
    return f"{_number(spread.median)} {METRICS[metric].unit} ± {percent:.0f} %"


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def _word(verdict: Verdict, judged: bool) -> str:
    if not judged and verdict.measured is not None:
        return "not judged"
    return f"{verdict.word}, within noise" if verdict.is_open else verdict.word


def _what(bar: Bar, best: str = "") -> str:
    against = f" / {best or ' or '.join(bar.against)}" if bar.against else ""
    return f"{bar.who}{against}, {METRICS[bar.metric].text}"


def _measured(verdict: Verdict) -> str:
    spread = verdict.measured
    if spread is None:
        return "-"
    if verdict.bar.against:
        return f"{spread.median:.2f} ± {(spread.high - spread.low) / 2:.2f}"
    return f"{_number(spread.median)} {METRICS[verdict.bar.metric].unit}".strip()


def _bound(bar: Bar) -> str:
    unit = "" if bar.against else METRICS[bar.metric].unit
    return f"{bar.wanted} {_number(bar.bound)} {unit}".rstrip()


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
