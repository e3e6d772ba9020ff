"""The command line: `cortex bench [case …]`."""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from cortex.bench.cases import CASES, Case, choose
from cortex.bench.measure import CaseResult, Settings, private_folder, run_case
from cortex.bench.report import case_lines, header, summary_lines, threshold_lines, write_csv

_AGAIN = 4
"""So many times as many repetitions are made at most, where a bar lies within the noise."""
_QUICK_SECONDS = 0.05
_QUICK_REPEATS = 2
_QUICK_COUNT = 5_000
_REGISTRY_START_S = 10.0
_REGISTRY_LINGER_S = 60.0
"""The registry ends itself so long after the last node, should this process be killed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `cortex bench`."""
    parser.add_argument(
        "case", nargs="*", help="cases to run, all by default; `tcp` stands for every `tcp-…`"
    )
    parser.add_argument(
        "--repeats",
        type=int,
        default=9,
        help=f"repetitions of each contestant (9), {_AGAIN} times as many where a bar lies within the noise",
    )
    parser.add_argument("--seconds", type=float, default=0.3, help="length of each repetition (0.3)")
    parser.add_argument(
        "--quick", action="store_true", help="tiny runs: shows that it works, measures nothing"
    )
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write every figure there, too")
    parser.add_argument("--list", action="store_true", help="name the cases and their bars")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return the exit status (2: wrong arguments)."""
    parser = argparse.ArgumentParser("cortex bench", description="Cortex beside its peers on this machine.")
    add_arguments(parser)
    return run(parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Run what the parsed options ask for; return the exit status."""
    try:
        cases = choose(options.case)
        if options.list:
            _list(cases)
            return 0
        with private_folder() as folder, _own_registry(folder):
            settings = Settings(
                folder=folder,
                repeats=min(options.repeats, _QUICK_REPEATS) if options.quick else options.repeats,
                repeats_max=0 if options.quick else _AGAIN * options.repeats,
                seconds=min(options.seconds, _QUICK_SECONDS) if options.quick else options.seconds,
                count_max=_QUICK_COUNT if options.quick else 0,
            )
            results = _run_all(cases, settings, quick=options.quick)
    except ValueError as error:
        print(f"cortex bench: {error}", file=sys.stderr)
        return 2
    if options.csv is not None:
        write_csv(options.csv, results)
    return 0


def _run_all(cases: list[Case], settings: Settings, *, quick: bool) -> list[CaseResult]:
    print("\n".join(header()))
    print(
        f"{settings.repeats} repetitions of {settings.seconds:g} s, interleaved, up to "
        f"{max(settings.repeats, settings.repeats_max)} where a bar lies within the noise;\n"
        "median ± half of its 95 % interval\n"
    )
    results: list[CaseResult] = []
    try:
        for case in cases:
            results.append(run_case(case, settings, progress=_progress))
            _progress("")
            print("\n".join(case_lines(results[-1], quick=quick)), end="\n\n", flush=True)
    except KeyboardInterrupt:
        _progress("")
        print("interrupted; what was measured until then:", end="\n\n")
    for table in (threshold_lines(results, quick=quick), summary_lines(results, quick=quick)):
        if text := "\n".join(table):
            print(text, end="\n\n")
    return results


@contextlib.contextmanager
def _own_registry(folder: Path) -> Iterator[None]:
    """Keep the run to itself: other nodes of this host neither see it nor are disturbed by it."""
    saved = os.environ.get("CORTEX_RUNTIME_DIR")
    (folder / "rt").mkdir(mode=0o700)
    os.environ["CORTEX_RUNTIME_DIR"] = str(folder / "rt")
    os.environ["CORTEX_BENCH_DIR"] = str(folder)
    command = [sys.executable, "-m", "cortex.discovery", "--embedded", "--linger", str(_REGISTRY_LINGER_S)]
    root = str(Path(__file__).parents[2])
    path = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
    with open(folder / "registry.log", "ab") as log:
        registry = subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, "PYTHONPATH": path})
    try:
        _await_socket(folder)
        yield
    finally:
        registry.terminate()
        try:
            registry.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            registry.kill()
            registry.wait()
        if saved is None:
            del os.environ["CORTEX_RUNTIME_DIR"]
        else:
            os.environ["CORTEX_RUNTIME_DIR"] = saved


def _await_socket(folder: Path) -> None:
    """Wait until the registry answers: a node that finds none would start another, which we could not end."""
    deadline = time.monotonic() + _REGISTRY_START_S
    while not list((folder / "rt").glob("*/registry")):
        if time.monotonic() > deadline:
            raise RuntimeError(
                f"no registry within {_REGISTRY_START_S} s: {(folder / 'registry.log').read_text()}"
            )
        time.sleep(0.005)


def _progress(text: str) -> None:
    """Show what runs now, on a terminal only."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)


def _list(cases: list[Case]) -> None:
    for case in cases:
        print(f"{case.name:<18}{case.title}")
        for bar in case.bars:
            print(f"{'':<18}  {bar.text}")


__all__ = ["CASES", "add_arguments", "main", "run"]
