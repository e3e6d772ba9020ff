"""Several processes as one command: how they end, who is told, and that none is left. No simulator here."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from line_process import LineProcess
from processes import ROOT, SOON_S, processes_with, wait_for

SUPERVISOR = """
import json, sys
from rich.console import Console
from neurosim_core.live.up import Part, run_together
given = json.loads(sys.argv[1])
parts = [Part(**part) for part in given.pop("parts")]
sys.exit(run_together(parts, console=Console(highlight=False), **given))
"""
WAIT = """
import os, signal
def wait():
    try:
        print("ready", os.getpid())
        signal.pause()
    except KeyboardInterrupt:
        print("closed")
wait()
"""
"""Says that it is ready, and then that it was interrupted; twice, and it ends with a traceback."""
STUBBORN = "import os, signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n" + WAIT.replace(
    "signal.pause()", "signal.pause(); signal.pause()"
)
PARENT = "import subprocess, sys; subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(1e3)'])\n"
"""Begins with a child that would outlive it."""


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


@pytest.fixture
def marker(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A text in the environment of all processes of the test; none of them may be left."""
    text = f"NEUROSIM_TEST={uuid.uuid4().hex}"
    monkeypatch.setenv(*text.split("="))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    try:
        yield text
        wait_for(lambda: not processes_with(text))
    finally:
        for process in processes_with(text):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)


@pytest.fixture
def start(marker: str) -> Iterator[Callable[..., LineProcess]]:
    """Starts supervisors; they are gone at the end, with what they started."""
    with contextlib.ExitStack() as stack:

        def start(*parts: dict[str, Any], grace_s: float = 10.0) -> LineProcess:
            given = json.dumps({"parts": parts, "grace_s": grace_s})
            return stack.enter_context(LineProcess([sys.executable, "-c", SUPERVISOR, given]))

        yield start


@pytest.fixture
def run(start: Callable[..., LineProcess]) -> Callable[..., tuple[int, list[str]]]:
    """Runs parts until they end; returns the exit status and the lines that were printed."""

    def run(*parts: dict[str, Any]) -> tuple[int, list[str]]:
        supervisor = start(*parts)
        lines = supervisor.rest()
        return supervisor.process.returncode, lines

    return run


def part(name: str, code: str = WAIT, **options: Any) -> dict[str, Any]:
    return {"name": name, "command": python(code), **options}


def ready(*names: str) -> list[str]:
    return [f"{name}: ready" for name in names]


def test_lines_are_printed_as_they_are_or_behind_a_name(run):
    """Standard error too, unfinished and malformed lines too, and none is wrapped or taken for markup."""
    plain = "import sys; print('[bold]step 1[/bold]', 100 * '-'); print(); sys.stderr.write('warning')"
    strange = "import sys; sys.stdout.buffer.write(bytes([0x66, 0xff, 10])); print('\\x1b[31mred\\x1b[0m')"
    status, printed = run(
        part("simulator", plain, is_prefixed=False, at_its_end="go on"),
        part("viewer", strange, at_its_end="go on"),
    )
    assert status == 0
    said = [line for line in printed if "ended" not in line]
    assert [line for line in said if not line.startswith("viewer")] == [
        "[bold]step 1[/bold] " + 100 * "-",
        "",
        "warning",
    ]
    assert [line for line in said if line.startswith("viewer")] == ["viewer: f\ufffd", "viewer: red"]


def test_all_end_with_the_one_that_they_end_with(run):
    status, printed = run(
        part("simulator", "print('over')", is_prefixed=False),
        part("viewer", WAIT, at_its_end="go on"),
    )
    assert status == 0
    assert "over" in printed
    assert not [line for line in printed if "failed" in line or "killed" in line]


@pytest.mark.parametrize(
    ("code", "status", "said"),
    [
        ("import sys; sys.exit(3)", 3, "simulator failed with status 3; ending the others"),
        ("import os; os.kill(os.getpid(), 9)", 1, "simulator was killed by SIGKILL; ending the others"),
    ],
)
def test_its_failure_is_reported_and_is_that_of_all(run, code, status, said):
    found, printed = run(part("simulator", code), part("viewer", WAIT))
    assert found == status
    assert said in printed


def test_the_others_go_on_without_one_that_they_do_not_need(start):
    supervisor = start(
        part("simulator"),
        part(
            "viewer",
            "import sys; sys.exit(1)",
            at_its_end="go on",
            advice="the others go on",
        ),
    )
    supervisor.read_until("viewer failed with status 1; the others go on", *ready("simulator"))
    supervisor.interrupt()
    assert supervisor.rest() == ["simulator: closed"]


def test_one_may_end_when_its_job_is_done_but_not_fail(start):
    """As the controller in lockstep."""
    supervisor = start(part("simulator"), part("controller", "pass", at_its_end="end if it failed"))
    assert "controller has ended" in supervisor.read_until("controller has ended", *ready("simulator"))
    supervisor.interrupt()
    assert supervisor.rest() == ["simulator: closed"]


def test_its_failure_ends_the_others_if_they_need_it(run):
    controller = "import sys; sys.exit(7)"
    status, printed = run(
        part("simulator", WAIT),
        part("controller", controller, at_its_end="end if it failed"),
    )
    assert status == 7
    assert "controller failed with status 7; ending the others" in printed


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_interrupts_each_once_and_ends_all(start, number):
    names = ("simulator", "controller", "viewer")
    supervisor = start(*(part(name) for name in names))
    supervisor.read_until(*ready(*names))
    supervisor.process.send_signal(number)
    assert sorted(supervisor.rest()) == sorted(f"{name}: closed" for name in names)
    assert supervisor.process.returncode == 130


def test_that_a_part_was_interrupted_is_not_said(start):
    """The user has done it; the same words before that are passed on."""
    talking = WAIT.replace('print("ready", os.getpid())', 'print("neurosim: interrupted")').replace(
        'print("closed")', 'print("neurosim: interrupted"); print("closed")'
    )
    supervisor = start(part("controller", talking))
    supervisor.read_until("controller: neurosim: interrupted")
    supervisor.interrupt()
    assert supervisor.rest() == ["controller: closed"]


def test_the_terminal_cannot_interrupt_them_a_second_time(start):
    """They have sessions of their own, so that Ctrl-C goes to the supervisor alone."""
    supervisor = start(part("simulator"), part("viewer"))
    lines = supervisor.read_until(*ready("simulator", "viewer"))
    processes = [int(line.split()[-1]) for line in lines]
    assert [os.getsid(process) for process in processes] == processes
    supervisor.interrupt()
    supervisor.rest()


def test_who_does_not_end_in_time_is_killed(start):
    supervisor = start(part("simulator"), part("controller", STUBBORN), grace_s=3.0)
    supervisor.read_until(*ready("simulator", "controller"))
    begin_s = time.monotonic()
    supervisor.interrupt()
    lines = supervisor.rest()
    assert time.monotonic() - begin_s >= 3.0
    assert "simulator: closed" in lines
    assert [line for line in lines if "had not ended after" in line and line.startswith("controller")]
    assert len(lines) == 2


@pytest.mark.parametrize(("grace_s", "writes_file"), [(1000.0, False), (0.1, True)])
def test_a_second_signal_kills_at_once(start, grace_s, writes_file):
    """What writes a file has all the time until then."""
    stubborn = part("controller", STUBBORN, writes_file=writes_file)
    supervisor = start(part("simulator"), stubborn, grace_s=grace_s)
    supervisor.read_until(*ready("simulator", "controller"))
    supervisor.interrupt()
    supervisor.read_until("simulator: closed")
    time.sleep(0.5)  # the grace of others is over
    assert supervisor.process.poll() is None
    supervisor.interrupt()
    assert any(line.startswith("controller had not ended after") for line in supervisor.rest())
    assert supervisor.process.returncode == 130


def test_what_a_part_has_started_ends_with_it(start, marker):
    """A viewer's window, say; also while the others go on."""
    supervisor = start(
        part("simulator", PARENT + WAIT), part("viewer", PARENT, at_its_end="go on", advice="flying on")
    )
    supervisor.read_until("simulator: ready", "viewer has ended; flying on")
    left = 3  # supervisor, simulator and its child
    wait_for(lambda: len(processes_with(marker)) == left)
    supervisor.interrupt()
    supervisor.rest()


@pytest.mark.skipif(sys.platform != "linux", reason="needs the parent death signal of Linux")
def test_the_others_are_interrupted_when_the_supervisor_is_killed(start, tmp_path):
    closed = tmp_path / "closed"
    tidy = WAIT.replace('print("closed")', f"open({str(closed)!r}, 'w').close()")
    supervisor = start(part("simulator", tidy))
    supervisor.read_until("simulator: ready")
    supervisor.kill()
    wait_for(closed.exists)


@pytest.mark.skipif(sys.platform != "linux", reason="needs the parent death signal of Linux")
@pytest.mark.parametrize("count", [1, 2, 3])
def test_none_is_left_when_it_is_killed_while_they_start(start, marker, count):
    """Killed when so many processes exist."""
    supervisor = start(*(part(name) for name in ("simulator", "controller", "viewer")))
    wait_for(lambda: len(processes_with(marker)) > count, every_s=2e-4)
    supervisor.kill()


def test_all_end_as_they_should_when_the_console_is_gone(start, tmp_path):
    """As in `neurosim up | head -1`: a recording is closed all the same."""
    closed = tmp_path / "closed"
    talking = f"""
import itertools, time
try:
    for k in itertools.count(): print("step", k); time.sleep(0.01)
except KeyboardInterrupt:
    print("closing")
    open({str(closed)!r}, "w").close()
"""
    supervisor = start(part("simulator", talking), part("viewer"))
    supervisor.read_until("simulator: step 3", *ready("viewer"))
    supervisor.output.close()
    assert supervisor.process.wait(SOON_S) == 1
    assert closed.exists()


def test_a_command_that_cannot_be_started_is_a_failure(run):
    status, printed = run({"name": "simulator", "command": ["/no/such/program"]}, part("viewer", WAIT))
    assert status == 1
    assert any("/no/such/program" in line or "FileNotFoundError" in line for line in printed)
