"""Tests marked `alone` share the machine with no other test of the run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

SUPPORT = Path(__file__).parent / "support"
INI = """
[pytest]
markers = alone
"""
TESTS = """
import json
import os
import time

import pytest

def span(kind):
    begin_ns = time.monotonic_ns()
    time.sleep(0.02)
    line = json.dumps([kind, os.getpid(), begin_ns, time.monotonic_ns()])
    with open("spans", "a") as file:
        print(line, file=file)

@pytest.fixture
def slow():
    span("alone")
    yield
    span("alone")

@pytest.mark.alone
@pytest.mark.parametrize("number", range(5))
def test_alone(slow, number):
    span("alone")

@pytest.mark.parametrize("number", range(10))
def test_with_others(number):
    span("shared")

@pytest.mark.alone
@pytest.mark.skipif(not DIES, reason="nothing dies")
def test_death():
    if not os.path.exists("died"):
        open("died", "w").close()
        os._exit(1)  # its lock ends with it
"""


def run(folder: Path) -> tuple[str, list[tuple[str, int, int, int]]]:
    """Run two files of tests in two processes; what was said, and each test's kind, process and times."""
    (folder / "pytest.ini").write_text(INI)
    for name in "ab":
        (folder / f"test_{name}.py").write_text(TESTS.replace("DIES", str(name == "b")))
    command = [sys.executable, "-m", "pytest", "-p", "xdist", "-n", "2", "--dist", "loadfile", "-p", "alone"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(
        [*command, f"--basetemp={folder / 'temporary'}"],
        cwd=folder,
        env={**environment, "PYTHONPATH": str(SUPPORT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    lines = (folder / "spans").read_text().splitlines()
    return done.stdout + done.stderr, [tuple(json.loads(line)) for line in lines]


def overlap(one: tuple[str, int, int, int], other: tuple[str, int, int, int]) -> bool:
    return one[1] != other[1] and one[2] < other[3] and other[2] < one[3]


def test_nothing_runs_beside_a_test_that_is_alone(tmp_path):
    """Its fixtures are alone, too; a process that dies in one lets the others go on."""
    said, spans = run(tmp_path)
    assert "crashed while running 'test_b.py::test_death'" in said
    assert "31 passed" in said, said
    assert len(spans) == 2 * (5 * 3 + 10)
    alone = [span for span in spans if span[0] == "alone"]
    assert not [(one, other) for one in alone for other in spans if overlap(one, other)]
