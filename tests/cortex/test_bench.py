"""The benchmark counts right, judges right, prints a table, never hangs; what it measures is not tested."""

from __future__ import annotations

import contextlib
import csv
import io
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
from processes import SOON_S, children_of, gone, wait_for

from cortex.bench.cases import CASES, Bar, Case, Contestant, choose
from cortex.bench.command import main
from cortex.bench.measure import Report, Settings, Spread, judge, run_case
from cortex.bench.peers import PEERS
from cortex.bench.processes import Child, ChildFailed
from cortex.bench.report import print_case
from cortex.bench.tally import END, WARM, Finished, Tally, make_payloads

ROOT = Path(__file__).resolve().parents[2]
FLOATS = 10


def fed(
    sequences: list[int], *, floats: int = FLOATS, swap: tuple[int, ...] = (), consume: bool = False
) -> Any:
    """Return the report of a tally of sequences with their payloads, those in ``swap`` with another's."""
    tally = Tally(floats, lambda: None)
    handle = tally.handler(consume=consume)
    payloads = make_payloads(floats)
    for sequence in sequences:
        handle(sequence, payloads[(sequence + (sequence in swap)) & 1])
    with pytest.raises(Finished):
        handle(END, payloads[0])
    return tally.report


@pytest.mark.parametrize("consume", [False, True])
def test_tally_counts_every_message_between_the_markers(consume):
    report = fed([WARM, WARM, *range(200)], consume=consume)
    assert (report["received"], report["lost"], report["misordered"], report["corrupt"]) == (200, 0, 0, 0)
    assert report["rate"] > 0.0


def test_tally_counts_gaps_and_disorder():
    report = fed([WARM, 0, 1, 4, 5, 3, 6])
    assert report["lost"] == 2  # 2 and 3 were missing when 4 came
    assert report["misordered"] == 1  # 3 came after 5
    assert report["received"] == 5


def test_tally_sees_a_payload_that_is_not_the_message_s_own():
    assert fed([*range(200)], swap=(64, 65))["corrupt"] == 1  # of small ones every 64th is looked at
    assert fed([*range(20)], floats=10_000, swap=(7, 9))["corrupt"] == 2  # of large ones each


@pytest.mark.parametrize("at", [0, 5_000, 9_999])
def test_tally_sees_a_torn_payload(at):
    tally = Tally(10_000, lambda: None)
    torn = make_payloads(10_000)[0].copy()
    torn[at] = 2.0
    tally.handler()(0, torn)
    assert tally.report["corrupt"] == 1


def _fails(_pipe: Any, job: str) -> None:
    raise ValueError(f"no {job} here")


def _dies(_pipe: Any, _job: None) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _hangs(pipe: Any, _job: None) -> None:
    helper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    pipe.send([os.getpid(), helper.pid])
    helper.wait()


@pytest.mark.parametrize(
    ("role", "text"), [(_fails, "ValueError: no socket here"), (_dies, "died with status -9")]
)
@pytest.mark.parametrize("beside", [False, True])
def test_child_that_fails_is_noticed(role, text, beside):
    """Also when another one's report is waited for."""
    with Child(role, "socket", deadline_s=SOON_S) as child, Child(_hangs, None, deadline_s=SOON_S) as other:
        other.expect()
        waited_for = other if beside else child
        with pytest.raises(ChildFailed, match=text):
            waited_for.expect([child])


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks processes up in /proc")
def test_child_that_hangs_is_killed_with_all_that_it_started():
    with Child(_hangs, None, deadline_s=1.0) as child:
        pids = child.expect()
        with pytest.raises(ChildFailed, match="deadline passed"):
            child.expect()
    wait_for(lambda: all(gone(pid) for pid in pids))


def rates(*values: float, **more: object) -> list[Report]:
    return [{"rate": value, "sent": 10, "lost": 0, **more} for value in values]


def test_ratio_is_taken_within_each_repetition():
    """A machine that is twice as slow in the second repetition changes no ratio."""
    outcomes = {"a": rates(90.0, 45.0, 80.0), "b": rates(100.0, 50.0, 100.0)}
    verdict = judge(Bar("a", ("b",), ">=", 0.85), outcomes)
    assert verdict.measured == Spread(*map(pytest.approx, (0.9, 0.85, 0.9)))
    assert verdict.word == "met"
    assert judge(Bar("a", ("b",), ">=", 0.91), outcomes).word == "missed"
    assert judge(Bar("a", ("b",), "<=", 0.91), outcomes).word == "met"


def test_the_best_rival_counts():
    outcomes = {"a": rates(100.0), "b": rates(50.0), "c": rates(80.0)}
    verdict = judge(Bar("a", ("b", "c"), ">=", 2.0), outcomes)
    assert (verdict.against, verdict.word) == ("c", "missed")
    latencies = {name: [{"rtt_p50_us": value}] for name, value in (("a", 6.0), ("b", 8.0), ("c", 20.0))}
    verdict = judge(Bar("a", ("b", "c"), "<=", 0.8, "rtt_p50_us"), latencies)
    assert (verdict.against, verdict.word) == ("b", "met")


def test_losses_and_failures_spoil_a_figure_that_would_do():
    bar = Bar("a", ("b",), ">=", 0.5)
    rival = {"b": rates(10.0, 10.0)}
    assert judge(bar, rival | {"a": rates(10.0, 10.0, lost=1)}).word == "missed (LOST 2 of 20)"
    assert judge(bar, rival | {"a": rates(10.0, 10.0, corrupt=3)}).word == "missed (CORRUPT 6 of 20)"
    half = [{"rate": 10.0}, {"error": "died"}]
    assert judge(bar, rival | {"a": half}).word == "missed (1 of 2 failed: died)"


def test_what_is_not_there_is_neither_met_nor_missed():
    bar = Bar("a", ("b",), ">=", 0.5)
    absent = {"a": rates(10.0), "b": [{"absent": "not installed"}]}
    assert judge(bar, absent).word == "not measured (b: not installed)"
    failed = {"a": [{"error": "died"}], "b": rates(10.0)}
    assert judge(bar, failed).word == "not measured (1 of 1 failed: died)"


def test_every_bar_names_contestants_and_metrics_of_its_case():
    for case in CASES:
        names = [contestant.name for contestant in case.contestants]
        assert len(set(names)) == len(names), case.name
        for bar in case.bars:
            assert {bar.who, *bar.against} <= set(names), case.name
            assert bar.metric in case.metrics, case.name
    assert len({case.name for case in CASES}) == len(CASES)


def test_cases_are_chosen_by_name_or_family():
    assert [case.name for case in choose(["huge", "typed"])] == ["typed-40", "typed-4k", "huge"]
    assert choose([]) == list(CASES)
    with pytest.raises(ValueError, match="unknown case 'hug'"):
        choose(["hug"])


def test_a_peer_that_is_not_installed_is_reported(monkeypatch):
    monkeypatch.setattr("cortex.bench.measure.missing", lambda transport: "not installed")
    case = Case("x", "title", 10, (Contestant("a peer", "Cyclone DDS"),))
    result = run_case(case, Settings())
    assert result.reports == {"a peer": [{"absent": "not installed"}]}
    assert "not installed" in printed(print_case, result)


def test_another_checkout_is_measured_beside_each_way_of_cortex():
    """The rate bounds from below, a time from above."""
    batch, latency = (choose([name])[0].beside("/there") for name in ("typed-40", "roundtrip-40"))
    assert batch.contestants[-1] == Contestant("cortex, before", "cortex", {"checkout": "/there"})
    assert batch.bars[-1] == Bar("cortex", ("cortex, before",), ">=", 2.0)
    assert latency.bars[-1] == Bar("cortex", ("cortex, before",), "<=", 1.05, "rtt_p50_us")
    for case in (case.beside("/there") for case in CASES):
        assert all(bar.metric in case.metrics for bar in case.bars), case.name


def printed(function: Any, results: Any, **options: Any) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as output:
        function(results, **options)
    return output.getvalue()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["no-such-case"], "unknown case 'no-such-case'"), (["--repeats", "0"], "repeats >= 1")]
    + [(["--seconds", value], "0 < seconds <= 600") for value in ("0", "-1", "nan", "1e9")],
)
def test_wrong_arguments_are_refused(arguments, said, capsys):
    assert main(arguments) == 2
    assert said in capsys.readouterr().err


# The real thing, tiny.

OPTIONAL = {name for name, peer in PEERS.items() if peer.needs}
TINY = ["typed-40", "medium", "large", "consume", "loan", "roundtrip-40", "tcp-39k", "async", "fanout"]
TINY += ["memory-40", "deaths", "threshold-64k", "receive"]
"""One of the cases that differ by the size of their messages only."""
BENCH = [sys.executable, "-m", "cortex", "bench"]


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory):
    """One repetition of every case, a few milliseconds each, in a process that has no ZeroMQ context yet."""
    path = tmp_path_factory.mktemp("bench") / "out.csv"
    before = set(Path("/dev/shm").glob("cortex*"))
    command = [*BENCH, *TINY, "--quick", "--repeats", "1", "--seconds", "0.02", "--csv", path]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600.0, check=False)
    assert done.returncode == 0, done.stderr
    assert not set(Path("/dev/shm").glob("cortex*")) - before
    with path.open() as file:
        return done.stdout, list(csv.DictReader(file))


@pytest.mark.parametrize("name", TINY)
def test_case(tiny_run, name):
    """Every contestant of the case has all its figures, and what is reliable lost nothing."""
    (case,) = choose([name])
    rows = {row["contestant"]: row for row in tiny_run[1] if row["case"] == name}
    for contestant in case.contestants:
        row = rows[contestant.name]
        if contestant.peer in OPTIONAL and (row["absent"] or row.get("error")):  # said in words
            continue
        assert not row.get("error"), contestant.name
        # Memory may shrink: the ring that one with more room has replaced is let go. On a busy machine a
        # publisher that is held up may go on before its reader is killed.
        signed = ("grown_kb", "known_ms")
        figures = [row[metric] for metric in case.metrics if row[metric] and metric not in signed]
        assert figures or any(row[metric] for metric in signed), contestant.name
        assert min(map(float, figures), default=0.0) >= 0.0, contestant.name
        faults = {row[count] for count in ("lost", "misordered", "corrupt")}
        assert faults <= {"0", ""}, contestant.name
        if row["rate"]:
            assert int(row["received"]) == int(row["sent"]) > 0, contestant.name


def test_tiny_run_prints_every_bar(tiny_run):
    text = tiny_run[0]
    counts = [int(part.split()[0]) for part in text.strip().splitlines()[-1].split(", ")]
    assert sum(counts) == sum(len(case.bars) for case in choose(TINY))
    assert max(len(line) for line in text.splitlines()) <= 120


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks processes up in /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_run_that_is_ended_leaves_no_process(number):
    command = [*BENCH, "typed-40", "--seconds", "300"]
    with tempfile.TemporaryDirectory(prefix="tb", dir="/tmp") as folder:  # paths of sockets are short
        environment = os.environ | {"TMPDIR": folder}
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env=environment) as bench:
            wait_for(lambda: len(children_of(bench.pid)) >= 3)  # the registry, a publisher, a subscriber
            children = children_of(bench.pid)
            bench.send_signal(number)
            text, _ = bench.communicate(timeout=SOON_S)
        if number == signal.SIGINT:
            assert bench.returncode == 0
            assert "interrupted; what was measured until then:" in text
            assert not os.listdir(folder), "files are left"
        wait_for(lambda: all(gone(pid) for pid in children))
