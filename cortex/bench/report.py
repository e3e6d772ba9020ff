"""The tables that people read, and the CSV."""

from __future__ import annotations

import csv
import importlib.metadata
import os
import platform
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

import zmq

from cortex.bench.cases import METRICS, Case, Contestant
from cortex.bench.measure import Results, Spread, faults_of, ratio_of, spread_of, values_of
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


def print_case(case: Case, results: Results) -> None:
    """Print what each contestant of a case did."""
    print(f"{case.name}: {case.title}; payload {4 * case.floats:,} B")
    rows = []
    for contestant in case.contestants:
        reports = results[contestant.name]
        cells = (_cell(spread_of(values_of(reports, metric)), metric) for metric in case.metrics)
        rows.append((contestant.name, *cells, _ratio(case, contestant, results), faults_of(reports)))
    head = ("", *(METRICS[metric].text for metric in case.metrics), f"{case.contestants[0].name} / it", "<")
    for line in table(head, rows):
        print(line)
    print(flush=True)


def write_csv(path: Path, results: Mapping[str, Results]) -> None:
    """Write a line for each repetition of each contestant; one that did not take part has one line."""
    lines = [
        {"case": case, "contestant": name, "repetition": number, **report}
        for case, contestants in results.items()
        for name, reports in contestants.items()
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


def _ratio(case: Case, contestant: Contestant, results: Results) -> str:
    ours = case.compared_with(contestant)
    if ours is None:
        return ""
    spread = ratio_of(results[ours.name], results[contestant.name], contestant.metric)
    return "" if spread is None else f"{spread.median:.2f} ± {(spread.high - spread.low) / 2:.2f}"


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
