"""The command `cortex`, run as people run it."""

from __future__ import annotations

import io
import json
import math
import os
import re
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
from c_module import needs_native
from hypothesis import given
from hypothesis import strategies as st
from peer import Number, Scan
from processes import ROOT, SOON_S, Beside, wait_for

from cortex import Array, Node, Publisher, Unit, keep_last, reliable
from cortex.cli import main
from cortex.codec import RawMessage
from cortex.commands import watch
from cortex.commands.text import bytes_of, message_lines, number_of, plain, rate, seconds, to_plain
from cortex.log import Recorder, open_log, player
from cortex.message_types import message
from cortex.schema import schema_of

MakeNode = Callable[..., Node]
PROMPTLY_S = 30.0
"""How soon a command must end after Ctrl-C, on a machine that does a lot besides."""


class Mode(Enum):
    SLOW = 0
    FAST = 1


# Outside of a class, where nobody takes the names of dtypes and dimensions for those of types.
Position = Annotated[Array[np.float64, 3], Unit("m", frame="world")]
Ranges = Annotated[Array["float32", "n"], Unit("m")]
Field = Array["complex64", "k"]
_SCAN_TYPES = (("Scan", Scan), ("Number", Number))


@message
class Pose:
    position: Position


@message
class Everything:
    stamp_ns: int
    speed: Annotated[float, Unit("m/s")]
    mode: Mode
    label: str
    blob: bytes
    ok: bool
    pose: Pose
    last: Pose | None
    track: list[Pose]
    ids: list[int]
    ranges: Ranges
    field: Field


def everything(size: int = 1000, label: str = "a\x1b[31mb") -> Everything:
    ranges = np.linspace(0.0, 1.0, size, dtype=np.float32)
    pose = Pose(np.array([1.0, 2.5, -3.0]))
    field = np.array([1 + 2j], np.complex64)
    return Everything(
        7, 1.5, Mode.FAST, label, b"\0\1", True, pose, None, [pose, pose], [1, 2], ranges, field
    )


def start(*arguments, columns=120, environment=None, **options) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": str(columns), **(environment or {})}
    command = [sys.executable, "-m", "cortex", *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    _children.append(subprocess.Popen(command, env=environment, **pipes, **options))
    return _children[-1]


_children: list[subprocess.Popen[str]] = []


@pytest.fixture(autouse=True)
def no_child_left():
    """End what a test that failed has left running."""
    yield
    while _children:
        with _children.pop() as child:
            child.kill()


def finish(child: subprocess.Popen[str], timeout_s: float = SOON_S) -> tuple[int, str, str]:
    """Wait for a command: status, output, complaints."""
    output, errors = child.communicate(timeout=timeout_s)
    return child.returncode, output, errors


def cortex(*arguments, columns=120, **options) -> tuple[int, str, str]:
    """Run a command that ends by itself: in this process, if it needs no directory, environment or log."""
    if options or arguments[0] == "discovery":
        return finish(start(*arguments, columns=columns, **options))
    output, errors = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, signals_kept():
        patch.setenv("COLUMNS", str(columns))
        with redirect_stdout(output), redirect_stderr(errors):
            status = main([str(argument) for argument in arguments])
    return status, output.getvalue(), errors.getvalue()


@contextmanager
def signals_kept() -> Iterator[None]:
    """`main` takes the signals over, which pytest wants back."""
    kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    path = list(sys.path)
    try:
        yield
    finally:
        sys.path[:] = path
        for number, handler in kept.items():
            signal.signal(number, handler)


def interrupt(child: subprocess.Popen[str], number: int = signal.SIGINT) -> tuple[int, str, str]:
    child.send_signal(number)
    return finish(child, PROMPTLY_S)


@contextmanager
def publishing(publisher: Publisher[Number], period_s: float) -> Iterator[None]:
    """Publish numbers regularly, from a thread."""
    done = threading.Event()

    def run() -> None:
        began_s = time.monotonic()
        for number in range(10**9):
            publisher.publish(Number(time.time_ns(), number))
            if done.wait(max(0.0, began_s + (number + 1) * period_s - time.monotonic())):
                return

    with Beside(run):
        try:
            yield
        finally:
            done.set()


def column(output: str, name: str, line: int = -1) -> str:
    """What stands under a title, the columns being separated by two blanks or more."""
    lines = output.splitlines()
    titles, cells = (re.split(r" {2,}", text.strip()) for text in (lines[0], lines[line]))
    return cells[titles.index(name)]


def test_where_nothing_runs_it_says_what_to_do(runtime):
    for command in ("topics", "nodes"):
        status, output, errors = cortex(command)
        assert (status, output) == (0, "")
        assert "no node is running in domain 0" in errors
        assert "--registry" in errors
    assert not list(runtime.glob("*/registry*"))  # looking has started nothing


def test_topics_and_nodes_are_listed(make_node):
    robot, viewer = make_node("robot"), make_node("viewer")
    robot.publisher("/number", Number)
    robot.publisher("/scan", Scan)
    viewer.subscriber("/scan", Scan)
    viewer.subscriber("/scan", None)
    viewer.subscriber("/command", Number)
    wait_for(lambda: len(viewer.topics()) == len(robot.topics()) == 3)
    wait_for(lambda: cortex("topics")[1].count("/") == 3)  # the registry has heard of all, too
    status, output, errors = cortex("topics")
    assert [line.split() for line in output.splitlines()] == [
        ["topic", "type", "publishers", "subscribers"],
        ["/command", "Number", "viewer"],
        ["/number", "Number", "robot"],
        ["/scan", "Scan", "robot", "viewer", "(2)"],
    ]
    assert (status, errors) == (0, "")
    status, output, _ = cortex("nodes")
    assert status == 0
    assert [line.split() for line in output.splitlines()[1:]] == [
        ["robot", str(os.getpid()), "2", "0", "0", "this", "host", "(ipc)"],
        ["viewer", str(os.getpid()), "0", "3", "0", "this", "host", "(ipc)"],
    ]


def whole_info(topic: str, **options: int) -> tuple[int, str, str]:
    """Return what `cortex info --once` prints when all nodes have answered; a busy machine may need more."""
    answers = (cortex("info", topic, "--once", **options) for _ in range(10))
    return next(answer for answer in answers if "did not answer" not in answer[1])


def test_two_types_on_one_topic_are_told_apart(make_node):
    one, other = make_node("one"), make_node("other")
    one.publisher("/scan", Scan)
    other.publisher("/scan", Number)
    other.subscriber("/scan", None)
    wait_for(lambda: cortex("topics")[1].count("other") == 3)
    marks = [f"{name} {schema_of(kind).fingerprint:016x}"[: len(name) + 9] for name, kind in _SCAN_TYPES]
    _, output, errors = cortex("topics")
    assert all(f"/scan  {mark}" in output for mark in marks)
    assert "published with different types" in errors
    _, output, _ = whole_info("/scan")
    assert {f"one  {marks[0]}", f"other  {marks[1]}", "other  any  keep_last(64)"} <= set(output.splitlines())


def test_info_shows_counters_policies_and_the_type(make_node):
    robot, viewer = make_node("robot"), make_node("viewer")
    publisher = robot.publisher("/scan", Scan, latch=True)
    received: list[Scan] = []
    viewer.subscriber("/scan", Scan, received.append, policy=reliable(8))
    viewer.subscriber("/scan", Scan, policy=keep_last(2))
    assert publisher.wait_for_subscribers(2, SOON_S)
    for i in range(1234):
        publisher.publish(Scan(i, np.ones(3, np.float32)))
    wait_for(lambda: len(received) == 1234)
    wait_for(lambda: cortex("topics")[1].count("viewer (2)"))
    status, output, errors = whole_info("/scan", columns=80)
    assert (status, errors) == (0, "")
    lines = output.splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in output
    assert lines[0] == "/scan"
    assert lines[4] == "robot  latched"
    assert lines[5].split() == ["1,234", "0", "Hz", "0", "B/s", "2", "0", "0"]
    assert lines[9] == "viewer  reliable(depth=8, timeout_s=1)"
    assert lines[10].split()[:7] == ["1,234", "0", "Hz", "0", "0", "0", "0"]
    assert lines[10].split()[8] in ("us", "ms")  # the delay
    assert lines[11] == "viewer  keep_last(2)"
    assert "  ranges    float32[n]" in lines
    status, output, errors = cortex("info", "/nothing", "--once")
    assert (status, output) == (1, "")
    assert errors == "cortex info: there is no topic /nothing; there are /scan\n"


def test_top_shows_all_topics_with_rates_and_losses(make_node):
    robot, viewer = make_node("robot"), make_node("viewer")
    publisher = robot.publisher("/number", Number)
    robot.publisher("/scan", Scan)
    viewer.subscriber("/number", Number, lambda _: None)
    viewer.subscriber("/*/imu", Scan)
    assert publisher.wait_for_subscribers(1, SOON_S)
    with publishing(publisher, 0.01):
        wait_for(lambda: cortex("topics")[1].count("/") == 4)

        def is_right() -> bool:
            """A machine that stands still makes some rates wrong."""
            status, output, errors = cortex("top", "--once", columns=200)
            assert (status, errors) == (0, "")
            rows = {line.split()[0]: line.split() for line in output.splitlines()}
            assert list(rows) == ["topic", "/*/imu", "/number", "/scan"]
            assert rows["/scan"][1:3] == ["1", "0"]
            assert rows["/number"][6:10] == ["1", "0", "0", "0"]  # one subscriber; nothing lost
            return float(rows["/number"][2]) == pytest.approx(100.0, rel=0.3)

        wait_for(is_right)


@needs_native
def test_doctor_finds_nothing_wrong_here_and_says_what_is(tmp_path):
    environment = {"XDG_CONFIG_HOME": str(tmp_path)}
    status, output, _ = cortex("doctor", environment=environment)
    assert status == 0, output
    assert output.count("ok  ") == 7
    assert "shared memory" in output.splitlines()[-1]
    status, output, _ = cortex("doctor", environment={**environment, "CORTEX_KEYS": str(tmp_path / "none")})
    assert (status, output.count("WRONG"), output.count("none, so no node can start")) == (1, 1, 1)
    status, output, _ = cortex("doctor", environment={**environment, "CORTEX_PURE_PYTHON": "1"})
    assert status == 1
    assert "WRONG  C module: CORTEX_PURE_PYTHON leaves it out" in output
    with tempfile.TemporaryDirectory(prefix="ctx-", dir="/tmp") as opened:  # paths of sockets are short
        Path(opened).chmod(0o755)
        open_to_all = {**environment, "CORTEX_RUNTIME_DIR": opened}
        status, output, _ = cortex("doctor", environment=open_to_all)
    assert status == 1
    assert "chmod 700" in output.splitlines()[0]


def test_doctor_says_what_a_machine_without_a_compiler_lacks(tmp_path):
    code = (
        "import sys; sys.modules['cortex._native'] = None\n"  # no such module
        "from cortex.cli import main; sys.exit(main(['doctor']))"
    )
    environment = {**os.environ, "XDG_CONFIG_HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 1
    assert "Install a C compiler and Python's headers, then `pip install -e .` again\n" in done.stdout


def test_types_are_compared(make_node, tmp_path):
    make_node().publisher("/number", Number)
    wait_for(lambda: "/number" in cortex("topics")[1])
    (tmp_path / "robot.py").write_text(
        "from cortex import message\n"
        "@message(name='Number')\nclass Grown:\n    stamp_ns: int\n    value: int\n    note: str | None\n"
        "@message(name='Number')\nclass Other:\n    stamp_ns: int\n    value: float\n"
    )
    status, output, _ = cortex("schema", "diff", "/number", "robot:Grown", cwd=tmp_path)
    assert (status, output.splitlines()[0]) == (0, "field 2: + note optional str")
    assert "compatible" in output.splitlines()[1]
    status, output, _ = cortex("schema", "diff", "robot:Other", "/number", cwd=tmp_path)
    assert (status, output.splitlines()[0]) == (1, "field 1: value float64 -> value int64")
    assert cortex("schema", "diff", "/number", "/number")[0] == 0
    status, _, errors = cortex("schema", "diff", "/number", "/none")
    assert status == 1
    assert "there are /number" in errors


def test_echo_fits_the_terminal(make_node):
    publisher = make_node("robot").publisher("/all", Everything, latch=True)
    publisher.publish(everything())
    status, output, errors = cortex("echo", "/all", "-n", 1, columns=72)
    assert (status, errors) == (0, "")
    lines = output.splitlines()
    assert lines[0].startswith("--- /all  #0  4.")
    assert max(map(len, lines)) <= 72
    shown = "\n".join(lines[1:])
    assert "speed: 1.5  m/s" in shown
    assert "mode: FAST" in shown
    assert "label: 'a\\x1b[31mb'" in shown  # a terminal obeys nothing that came over the network
    assert "last: none" in shown
    assert "  - 1:\n    position: float64[3]  1 2.5 -3  m" in shown
    assert "ids: [1, 2]" in shown
    (ranges,) = [line for line in lines if line.startswith("ranges")]
    assert ranges.startswith("ranges: float32[1000]  0 0.001001 ")
    assert ranges.endswith(" … 1  m")
    status, output, _ = cortex("echo", "/all", "-n", 1, "--no-arrays")
    assert "ranges: float32[1000]  m" in output.splitlines()
    status, output, _ = cortex("echo", "/all", "-n", 1, "--full")
    assert len(output) > 8000
    assert "…" not in output


def test_echo_as_json_holds_everything(make_node):
    publisher = make_node("robot").publisher("/all", Everything, latch=True)
    publisher.publish(everything(3))
    status, output, _ = cortex("echo", "/all", "-n", 1, "--json")
    assert status == 0
    facts = json.loads(output)
    assert (facts["topic"], facts["sequence"], facts["source"]) == ("/all", 0, f"{publisher.source:016x}")
    assert facts["message"] == {
        "stamp_ns": 7, "speed": 1.5, "mode": "FAST", "label": "a\x1b[31mb", "blob": "AAE=", "ok": True,
        "pose": {"position": [1.0, 2.5, -3.0]}, "last": None, "track": [{"position": [1.0, 2.5, -3.0]}] * 2,
        "ids": [1, 2], "ranges": [0.0, 0.5, 1.0], "field": [[1.0, 2.0]],
    }  # fmt: skip


def test_rate_bandwidth_and_delay_are_measured(make_node):
    """100 messages of 16 bytes each second; a machine that stands still for a while is asked again."""
    publisher = make_node("robot").publisher("/number", Number)

    def is_right() -> bool:
        measured, stamped = map(
            finish, (start("hz", "/number", "-n", 1), start("delay", "/number", "--stamp", "-n", 1))
        )
        output = measured[1]
        assert measured[2] == ""
        assert len(output.splitlines()) == 2
        assert max(map(len, (output + stamped[1]).splitlines())) <= 79
        assert (column(output, "lost"), column(output, "size")) == ("0", "16 B")
        values = (column(output, "max"), column(output, "delay p50"), column(stamped[1], "delay p50"))
        longest_s, delay_s, age_s = (
            float(value) * {"us": 1e-6, "ms": 1e-3, "s": 1.0}[unit] for value, unit in map(str.split, values)
        )
        assert min(delay_s, age_s) > 0.0
        return (
            float(column(output, "rate").split()[0]) == pytest.approx(100.0, rel=0.3)
            and column(output, "bandwidth").endswith(" kB/s")
            and float(column(output, "bandwidth").split()[0]) == pytest.approx(1.6, rel=0.3)
            and 0.01 <= longest_s < 0.5
            and max(delay_s, age_s) < 0.5
        )

    with publishing(publisher, 0.01):
        wait_for(is_right)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_record_until_told_to_stop_then_play(make_node, tmp_path, number):
    path = tmp_path / "run.mcap"
    robot = make_node("robot")
    publisher = robot.publisher("/number", Number)
    child = start("record", "-o", path, "--all")
    assert publisher.wait_for_subscribers(timeout_s=SOON_S)
    for i in range(50):
        publisher.publish(Number(i, i))
    wait_for(lambda: path.stat().st_size > 2500)
    status, output, errors = interrupt(child, number)
    assert status == 0
    assert errors == f"recording into {path}; Ctrl-C ends it\n"
    assert output.splitlines()[1].split()[:3] == ["/number", "50", "800"]
    with open_log(path) as log:
        assert (log.cut, log.message_count) == ("", 50)
    publisher.close()
    subscriber = robot.subscriber("/again", Number, policy=reliable(100))
    wait_for(lambda: "/again" in cortex("topics")[1])  # play waits for the subscribers that it is told of
    status, output, errors = cortex("play", path, "--remap", "/number:=/again", "--rate", "max")
    assert (status, output, errors) == (0, "", "50 messages played\n")
    assert [subscriber.recv(SOON_S) for _ in range(50)] == [Number(i, i) for i in range(50)]
    status, output, _ = cortex("play", path, "--info")
    assert status == 0
    assert output.splitlines()[1].split() == ["/number", "Number", "50", "robot"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_before_recording_has_begun_leaves_a_whole_file(runtime, tmp_path, monkeypatch, number):
    def interrupted(*arguments: Any, **options: Any) -> Recorder:
        recorder = Recorder(*arguments, **options)
        signal.raise_signal(number)
        return recorder

    monkeypatch.setattr("cortex.commands.files.Recorder", interrupted)
    path = tmp_path / "run.mcap"
    status, output, errors = cortex("record", "-o", path, "--all")
    assert (status, output.count("0 messages in")) == (1, 1)
    assert errors.endswith("\ncortex record: nothing was recorded: no message of any topic has come\n")
    with open_log(path) as log:
        assert (log.cut, log.message_count) == ("", 0)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_command_though_what_it_interrupts_swallows_exceptions(
    make_node, tmp_path, monkeypatch, number
):
    """As imports may do: not all messages are shown that there are, nor is a log played to its end."""

    def swallowing(function: Callable[..., Any]) -> Callable[..., Any]:
        def interrupted(*arguments: Any, **options: Any) -> Any:
            with suppress(BaseException):
                signal.raise_signal(number)
            return function(*arguments, **options)

        return interrupted

    path, robot = tmp_path / "run.mcap", make_node("robot")
    subscriber = robot.subscriber("/played", Number)
    publisher = robot.publisher("/number", Number)

    def publish_two() -> None:
        assert publisher.wait_for_subscribers(timeout_s=SOON_S)
        for i in range(2):
            publisher.publish(Number(i, i))

    with Recorder(robot, path, ["/number"]) as recorder:
        publish_two()
        wait_for(lambda: recorder.stats.written == 2)
    wait_for(lambda: publisher.subscriber_count == 0)
    monkeypatch.setattr(watch, "message_lines", swallowing(message_lines))
    with Beside(publish_two):
        status, output, _ = cortex("echo", "/number", "-n", 2)
    assert (status, output.count("---")) == ({signal.SIGINT: 0, signal.SIGTERM: 143}[number], 1)
    monkeypatch.setattr(player, "RawMessage", swallowing(RawMessage))
    assert cortex("play", path, "--remap", "/number:=/played")[0] == 128 + number
    assert subscriber.recv(SOON_S) == Number(0, 0)
    with pytest.raises(TimeoutError):
        subscriber.recv(0.1)


def test_a_file_is_not_overwritten_unless_told(runtime, tmp_path):
    path = tmp_path / "run.mcap"
    path.write_text("precious")
    status, output, errors = cortex("record", "-o", path, "/number")
    assert (status, output) == (1, "")
    assert errors == f"cortex record: {path} exists: choose another name, or --force to overwrite it\n"
    assert path.read_text() == "precious"
    status, _, errors = cortex(
        "record", "-o", path, "/number", "--force", "--duration", 0.1, "--registry", "off"
    )
    assert status == 1
    assert errors.endswith("cortex record: nothing was recorded: no message of /number has come\n")
    with open_log(path) as log:
        assert log.message_count == 0


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ("play {}/missing", "cortex play: {}/missing: No such file or directory"),
        ("play {}/text", "cortex play: {}/text: not an MCAP file"),
        ("play {}/run.mcap /b --registry off", "cortex play: {}/run.mcap has no topic /b; it has /number"),
        ("play {}/run.mcap --start 9 --registry off", "cortex play: no message from 9 s to the end; {}/run"),
        ("topics --keys {}/none", "cortex topics: {}/none/key.secret does not exist: make keys with "),
        ("topics --domain 233", "cortex topics: domain must be an integer from 0 to 232, got 233"),
        ("cpp test_command:Mode", "cortex cpp: Mode is an enum, which comes with the messages that use it"),
        ("topics --registry off --listen 0.0.0.0", "cortex topics: plain tcp on tcp://0.0.0.0:0 would be"),
        ("cpp peer:Missing", "cortex cpp: peer has no message type Missing; it has "),
        ("cpp no_such_module:Scan", "cortex cpp: there is no module no_such_module here or on the "),
    ],
)
def test_errors_are_one_line(runtime, tmp_path, arguments, complaint, capsys):
    from test_log import write_numbers

    write_numbers(tmp_path / "run.mcap", range(5))
    (tmp_path / "text").write_text("no recording")
    with signals_kept():
        assert main(arguments.format(tmp_path).split()) == 1
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors.startswith(complaint.format(tmp_path))
    assert errors.count("\n") == 1
    assert "=True" not in errors


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ("fly", "invalid choice: 'fly'"),
        ("echo scan", "got 'scan'"),
        ("hz /scan --window 0", "must be a number > 0, got '0'"),
        ("echo /scan -n -3", "must be an integer > 0, got '-3'"),
        ("play x.mcap --rate fast", "must be a number > 0, or \"max\", got 'fast'"),
        ("record /scan", "-o"),
        ("record -o x.mcap", "say which topics to record, or --all"),
        ("record -o x.mcap --all /scan", "leave out /scan"),
        ("cpp Scan", "a type is named like robot.messages:Scan, got 'Scan'"),
        ("cpp", "name message types"),
        ("cpp --include-dir a:B", "--include-dir takes no type"),
        ("keys old", "invalid choice: 'old'"),
    ],
)
def test_wrong_use_is_told_from_failure(arguments, complaint, capsys):
    with signals_kept():
        try:
            status = main(arguments.split())
        except SystemExit as exit_of_the_parser:
            status = exit_of_the_parser.code
    assert status == 2
    assert complaint in capsys.readouterr().err


COMMANDS = "topics nodes top info echo hz record play keys doctor schema cpp bench discovery"


@pytest.mark.parametrize("command", ["", *COMMANDS.split()])
def test_every_command_has_help(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as end, signals_kept():
        main([*command.split(), "--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: cortex {command}".rstrip())
    assert max(map(len, text.splitlines())) <= 80


def test_help_loads_no_sockets():
    code = "import sys, cortex.cli; assert not {'zmq', 'numpy', 'cortex.node'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=SOON_S, cwd=ROOT)


def test_keys_are_made_once(tmp_path):
    folder = tmp_path / "keys"
    status, output, errors = cortex("keys", "new", "--dir", folder)
    assert status == 0
    assert output.strip() == (folder / "key.public").read_text().strip()
    assert stat.S_IMODE((folder / "key.secret").stat().st_mode) == 0o600
    assert errors.count("authorized_keys") == 2
    assert len(errors.splitlines()) == 4
    secret = (folder / "key.secret").read_text()
    assert secret.strip() not in output + errors
    status, output, errors = cortex("keys", "new", "--dir", folder)
    assert (status, output) == (1, "")
    assert "exists" in errors
    assert (folder / "key.secret").read_text() == secret


def test_discovery_serves_until_interrupted(runtime, make_node):
    child = start("discovery")
    wait_for(lambda: (runtime / "0" / "registry").exists())
    make_node("robot").publisher("/number", Number)
    wait_for(lambda: "/number" in cortex("topics")[1])
    status, output, errors = cortex("discovery")
    assert (status, output) == (1, "")
    assert errors.startswith(f"cortex discovery: another registry (process {child.pid}) serves domain 0")
    status, _, errors = interrupt(child)
    assert status == 0
    assert errors.startswith("cortex discovery: the registry of domain 0 serves this host only\n")


@pytest.mark.parametrize(
    ("show", "values", "expected"),
    [
        (seconds, (0.0, 123e-9, 9.99996e-3, 0.999999, math.nan), "0 ns|123.0 ns|10.00 ms|1.000 s|-"),
        (seconds, (12345.0,), "12,345 s"),
        (bytes_of, (16, 999.99, 23.7e6), "16 B|1.000 kB|23.70 MB"),
        (rate, (99.98, 123456.0), "99.98 Hz|123.5 kHz"),
        (lambda count: number_of(count, "topic"), (1, 2345), "1 topic|2,345 topics"),
    ],
)
def test_numbers_have_units(show, values, expected):
    assert [show(value) for value in values] == expected.split("|")


def test_names_of_others_command_no_terminal():
    assert plain("robot") == "robot"
    assert plain("a\x1b[31m\n\x9b1mü\u202e") == "a\\x1b[31m\\x0a\\x9b1mü\\x202e"


@given(
    columns=st.integers(20, 200),
    size=st.integers(0, 300),
    label=st.text(max_size=300),
    arrays=st.sampled_from(["none", "short"]),
)
def test_no_line_is_longer_than_the_terminal(columns, size, label, arrays):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", str(columns))
        shown = everything(size, label.encode(errors="ignore").decode())
        lines = list(message_lines(schema_of(Everything), shown, arrays=arrays))
    assert all(len(line) <= columns and line.isprintable() for line in lines)


def test_json_has_no_numbers_that_json_does_not_know():
    shown = everything()
    odd = Scan(1, np.array([math.nan, math.inf, 1.0], np.float32))
    assert to_plain(schema_of(Scan), odd) == {"stamp_ns": 1, "ranges": ["nan", "inf", 1.0]}
    json.dumps(to_plain(schema_of(Everything), shown), allow_nan=False)


README = (ROOT / "cortex" / "README.md").read_text(encoding="utf-8")
EXAMPLES = dict(re.findall(r"<!-- example: (\w+) -->\s*```python\n(.*?)```", README, flags=re.DOTALL))
SHOWN = {"minute": "mean 2.25 m", "loan": "(480, 640, 3)", "service": "Done(stamp_ns=0)"}
"""What each example prints, among other things."""


def test_every_example_is_run():
    assert set(EXAMPLES) == set(SHOWN)
    assert README.count("```python") == len(EXAMPLES)


@pytest.mark.parametrize("name", sorted(SHOWN))
def test_an_example(name, runtime, tmp_path):
    path = tmp_path / "example.py"
    path.write_text(EXAMPLES[name], encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-W", "error", path], capture_output=True, text=True, timeout=300.0, check=False
    )
    assert done.returncode == 0, done.stderr
    assert SHOWN[name] in done.stdout
    assert not done.stderr


def test_commands_exist():
    """Every `cortex …` of the README names a command of the program."""
    listed = set(re.findall(r"^cortex (\w+)", README, flags=re.MULTILINE))
    assert listed
    assert listed <= set(COMMANDS.split())
