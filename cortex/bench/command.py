"""The command line: `cortex bench [case …]`."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from cortex.bench import peer_cortex  # noqa: F401  # here, so that its children need not
from cortex.bench.cases import choose
from cortex.bench.measure import CaseResult, Settings, run_case
from cortex.bench.peers import import_cortex, runtime_dir
from cortex.bench.processes import Child
from cortex.bench.report import print_case, print_header, print_summary, write_csv
from cortex.places import NETWORK_VARIABLES

_QUICK_SECONDS = 0.05
_QUICK_REPEATS = 2
_QUICK_COUNT = 5_000
_REGISTRY_START_S = 10.0
_PARENT_MAX = 40
"""Longest directory of temporary files [characters]: paths of sockets end at 107."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark; return the exit status (2: wrong arguments)."""
    parser = argparse.ArgumentParser("cortex bench", description="Cortex beside its peers on this machine.")
    add = parser.add_argument
    cases = "cases to run, all by default; `tcp` stands for every `tcp-…`; a wrong name lists them"
    add("case", nargs="*", help=cases)
    add("--repeats", type=int, default=9, help="repetitions of each contestant (9)")
    add("--seconds", type=float, default=0.3, help="length of each repetition (0.3)")
    against = "measure Cortex of this checkout (built) beside ours"
    add("--against", type=Path, metavar="CHECKOUT", help=against)
    add("--quick", action="store_true", help="tiny runs: shows that it works, measures nothing")
    add("--csv", type=Path, metavar="FILE", help="write every figure there, too")
    options = parser.parse_args(arguments)
    try:
        results = _run(options)
    except ValueError as error:
        print(f"cortex bench: {error}", file=sys.stderr)
        return 2
    if options.csv is not None:
        write_csv(options.csv, results)
    return 0


def _run(options: argparse.Namespace) -> list[CaseResult]:
    cases = choose(options.case)
    if options.against is not None:
        cases = [case.beside(str(options.against.resolve())) for case in cases]
    repeats, seconds = options.repeats, options.seconds
    if repeats < 1 or not 0.0 < seconds <= 600.0:  # also refuses nan
        raise ValueError(f"wants repeats >= 1 and 0 < seconds <= 600, got {repeats}, {seconds}")
    settings = Settings(repeats, seconds)
    if options.quick:
        settings = Settings(min(repeats, _QUICK_REPEATS), min(seconds, _QUICK_SECONDS), _QUICK_COUNT)
    results: list[CaseResult] = []
    with ExitStack() as stack:
        _make_place(stack, options.against)
        print_header()
        print(
            f"{settings.repeats} repetitions of {settings.seconds:g} s, interleaved; "
            "median ± half of what lies between the quartiles\n"
        )
        try:
            for case in cases:
                results.append(run_case(case, settings))
                print_case(results[-1])
        except KeyboardInterrupt:
            print("interrupted; what was measured until then:\n")
    print_summary(results, judged=not options.quick)
    return results


def _make_place(stack: ExitStack, checkout: Path | None) -> None:
    """Keep the run to itself: a directory and a registry of its own, and one of the other checkout."""
    parent = tempfile.gettempdir()
    short = parent if len(parent) <= _PARENT_MAX else "/tmp"
    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="cxb", dir=short))
    os.environ["CORTEX_BENCH_DIR"] = folder
    for name in NETWORK_VARIABLES:
        os.environ.pop(name, None)
    for name in ("", str(checkout.resolve())) if checkout else ("",):
        place = runtime_dir(name)
        place.mkdir(mode=0o700)
        registry = stack.enter_context(Child(_serve_registry, name, deadline_s=_REGISTRY_START_S))
        stack.callback(registry.kill)
        # A node that finds no registry would start another, which we could not end.
        deadline = time.monotonic() + _REGISTRY_START_S
        while not list(place.glob("*/registry")):
            if time.monotonic() > deadline:
                raise RuntimeError(f"no registry within {_REGISTRY_START_S} s")
            time.sleep(0.005)
    os.environ["CORTEX_RUNTIME_DIR"] = str(runtime_dir())


def _serve_registry(_pipe: Any, checkout: str) -> None:
    os.environ["CORTEX_RUNTIME_DIR"] = str(runtime_dir(checkout))
    if checkout:
        import_cortex(checkout)
    importlib.import_module("cortex.discovery").main(["--embedded", "--linger", "3600"])
