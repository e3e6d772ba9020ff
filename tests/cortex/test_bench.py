"""The benchmark counts right, judges right, prints a table, never hangs; what it measures is not tested."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from processes import SOON_S, wait_for
from scipy import stats

from cortex.bench.age import percentiles
from cortex.bench.cases import CASES, METRICS, Bar, Case, Contestant, choose
from cortex.bench.children import Channel, Child, ChildFailed
from cortex.bench.command import main
from cortex.bench.copies import make_ring, slots_of
from cortex.bench.measure import CaseResult, Outcome, Settings, judge, run_case
from cortex.bench.report import WIDTH, case_lines, header, summary_lines, threshold_lines, write_csv
from cortex.bench.spread import Spread
from cortex.bench.tally import END, WARM, Finished, Tally, make_payloads

ROOT = Path(__file__).resolve().parents[2]
FLOATS = 10


# What a subscriber counts.


def fed(sequences: list[int], *, floats: int = FLOATS, swap: tuple[int, ...] = ()) -> Tally:
    """Return a tally that was handed sequences with their payloads, those in ``swap`` with another's."""
    tally = Tally(floats, connected=lambda: None, finish=lambda: None)
    handle = tally.handler()
    payloads = make_payloads(floats)
    for sequence in sequences:
        handle(sequence, payloads[(sequence + (sequence in swap)) & 1])
    return tally


def test_tally_counts_every_message_between_the_markers():
    report = fed([WARM, WARM, *range(200), END, END]).report()
    assert (report["received"], report["lost"], report["misordered"], report["corrupt"]) == (200, 0, 0, 0)
    assert report["rate"] > 0.0


def test_tally_counts_gaps_and_disorder():
    report = fed([WARM, 0, 1, 4, 5, 3, 6, END]).report()
    assert report["lost"] == 2  # 2 and 3 were missing when 4 came
    assert report["misordered"] == 1  # 3 came after 5
    assert report["received"] == 5


def test_tally_sees_a_payload_that_is_not_the_message_s_own():
    assert (
        fed([*range(200), END], swap=(64, 65)).report()["corrupt"] == 1
    )  # of small ones every 64th is looked at
    assert fed([*range(20), END], floats=10_000, swap=(7, 9)).report()["corrupt"] == 2  # of large ones each


@pytest.mark.parametrize("at", [0, 5_000, 9_999])
def test_tally_sees_a_torn_payload(at: int):
    tally = Tally(10_000, connected=lambda: None, finish=lambda: None)
    torn = make_payloads(10_000)[0].copy()
    torn[at] = 2.0
    tally.handler()(0, torn)
    assert tally.report()["corrupt"] == 1


def test_tally_tells_of_the_first_and_the_last_message():
    told: list[str] = []

    def finish() -> None:
        told.append("end")
        raise Finished

    handle = Tally(FLOATS, connected=lambda: told.append("connected"), finish=finish).handler()
    data = make_payloads(FLOATS)[0]
    handle(WARM, data)
    handle(WARM, data)
    handle(0, data)
    with pytest.raises(Finished):
        handle(END, data)
    assert told == ["connected", "end"]


def batches(*groups: list[int]) -> dict[str, object]:
    """Return the report of a tally that was handed these sequences as arrays of records."""
    dtype = np.dtype([("stamp_ns", np.int64), ("data", np.float32, (FLOATS,))])
    tally = Tally(FLOATS, connected=lambda: None, finish=lambda: None)
    handle = tally.batch_handler()
    for group in groups:
        records = np.zeros(len(group), dtype)
        records["stamp_ns"] = group
        records["data"] = [[1.0 + (sequence & 1)] * FLOATS for sequence in group]
        handle(records)
    return tally.report()


def test_batches_are_counted_as_single_messages_are():
    report = batches([WARM], [WARM, 0, 1], [2, 3, 4], [5], [6, 7, END])
    assert (report["received"], report["lost"], report["misordered"], report["corrupt"]) == (8, 0, 0, 0)


def test_batches_with_gaps_and_disorder():
    assert batches([0, 1, 2], [5, 6], [END])["lost"] == 2
    assert batches([0, 1, 2], [3, 5, 4, 6], [END])["misordered"] == 1


def test_copying_handler_copies_and_counts():
    tally = Tally(FLOATS, connected=lambda: None, finish=lambda: None)
    handle = tally.copying_handler()
    for sequence, payload in enumerate(make_payloads(FLOATS)):
        handle(sequence, payload)
    handle(END, make_payloads(FLOATS)[0])
    assert tally.report()["received"] == 2
    assert tally.report()["corrupt"] == 0


def test_percentiles():
    figures = percentiles(list(range(1_000, 101_000, 1_000)), "rtt")
    assert figures == {"rtt_p50_us": 51.0, "rtt_p99_us": 100.0}
    assert percentiles([], "rtt") == {}


def test_ring_slots_do_not_overlap():
    ring = make_ring(1000, 3)
    for k, slot in enumerate(ring):
        slot[:] = k
    assert [sorted(set(slot.tolist())) for slot in ring] == [[0.0], [1.0], [2.0]]
    assert [slots_of(size) for size in (40, 900_000, 23_700_000)] == [64, 4, 4]


# Children.


def _fails(_channel: Channel, job: str) -> None:
    raise ValueError(f"no {job} here")


def _dies(_channel: Channel, _job: None) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _hangs(channel: Channel, _job: None) -> None:
    helper = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    channel.tell("started", pids=[os.getpid(), helper.pid])
    helper.wait()


def _echoes(channel: Channel, _job: None) -> None:
    channel.tell("told", heard=channel.wait(SOON_S))


def _closes(channel: Channel, _job: None) -> None:
    channel.tell("closed")


def _is_slow(channel: Channel, _job: None) -> None:
    time.sleep(0.3)
    channel.tell("result", rate=1.0)


def gone(pid: int) -> bool:
    """Return whether a process has ended (a zombie has)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def test_child_and_parent_talk(tmp_path: Path):
    with Child(_echoes, None, log=tmp_path / "log", deadline_s=SOON_S) as child:
        child.tell("go", size=3)
        assert child.expect("told")["heard"] == {"event": "go", "size": 3}


def test_child_that_raises_says_so(tmp_path: Path):
    child = Child(_fails, "socket", log=tmp_path / "log", deadline_s=SOON_S)
    with child, pytest.raises(ChildFailed, match="ValueError: no socket here"):
        child.expect("ready")


def test_child_that_is_killed_is_noticed(tmp_path: Path):
    child = Child(_dies, None, log=tmp_path / "log", deadline_s=SOON_S)
    with child, pytest.raises(ChildFailed, match="died before 'ready'"):
        child.expect("ready")


def test_child_may_end_before_the_one_that_is_waited_for(tmp_path: Path):
    """A server that was told to end is gone before its client has said what it measured."""
    slow = Child(_is_slow, None, log=tmp_path / "log", deadline_s=SOON_S)
    with slow, Child(_closes, None, log=tmp_path / "log", deadline_s=SOON_S) as server:
        assert slow.expect("result", beside=[server])["rate"] == 1.0
        server.expect("closed")


def test_child_beside_that_dies_is_noticed(tmp_path: Path):
    slow = Child(_hangs, None, log=tmp_path / "log", deadline_s=SOON_S)
    server = Child(_dies, None, log=tmp_path / "log", deadline_s=SOON_S)
    with slow, server, pytest.raises(ChildFailed, match="died before 'result'"):
        slow.expect("result", beside=[server])


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks processes up in /proc")
def test_child_that_hangs_is_killed_with_all_that_it_started(tmp_path: Path):
    child = Child(_hangs, None, log=tmp_path / "log", deadline_s=SOON_S)
    with child:
        pids = child.expect("started")["pids"]
        child._deadline = time.monotonic() + 0.1
        with pytest.raises(ChildFailed, match="deadline passed"):
            child.expect("ready")
    wait_for(lambda: all(gone(pid) for pid in pids))


# Judging.


@pytest.mark.parametrize("count", [1, 2, 5, 8, 9, 12, 20, 36])
def test_the_interval_of_a_median_is_that_of_the_binomial(count: int):
    """As few figures lie outside as `scipy` says that 2.5 % on each side allow."""
    spread = Spread.of([float(k) for k in range(count, 0, -1)])
    assert spread is not None
    outside = max(0, int(stats.binom(count, 0.5).ppf(0.025)) - 1)
    assert (spread.low, spread.high) == (1.0 + outside, count - outside)
    assert spread.median == (count + 1) / 2.0


def test_an_interval_holds_the_median_as_often_as_it_says():
    """Of a skewed distribution; 2,000 draws: 5 standard errors are 2.4 %."""
    draws = np.random.default_rng(0).exponential(size=(2_000, 9))
    spreads = [Spread.of(row) for row in draws.tolist()]
    held = sum(spread.low <= np.log(2.0) <= spread.high for spread in spreads if spread) / 2_000
    assert held == pytest.approx(1.0 - 2.0 * stats.binom(9, 0.5).cdf(1), abs=0.024)


@pytest.mark.parametrize(
    ("rates_found", "repetitions"),
    [([1.0, 1.2], 2), ([0.7, 0.8], 2), ([0.8, 1.0], 8), ([0.8, 1.0, 0.9], 8), ([1.0, 0.8], 8)],
)
def test_only_a_bar_within_the_noise_is_measured_again(
    rates_found: list[float], repetitions: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Met or missed so far: both alike."""
    order: list[str] = []
    found = {"a": cycle(rates_found), "b": cycle([1.0])}

    def repeat(case: Case, contestant: Contestant, settings: Settings) -> dict[str, float]:
        order.append(contestant.name)
        return {"rate": next(found[contestant.name])}

    monkeypatch.setattr("cortex.bench.measure._repeat", repeat)
    case = Case(
        "x", "", "", 10, (Contestant("a", "pyzmq"), Contestant("b", "pyzmq")), (Bar("a", ("b",), ">=", 0.9),)
    )
    run_case(case, Settings(folder=tmp_path, repeats=2, repeats_max=8))
    assert order == (["a", "b", "b", "a"] * repetitions)[: 2 * repetitions]


def outcome(name: str, *reports: dict[str, object], absent: str = "") -> Outcome:
    return Outcome(Contestant(name, "pyzmq"), list(reports), absent)


def rates(name: str, *values: float, **more: object) -> Outcome:
    return outcome(name, *({"rate": value, "sent": 10, "lost": 0, **more} for value in values))


def test_ratio_is_taken_within_each_repetition():
    """A machine that is twice as slow in the second repetition changes no ratio."""
    outcomes = {"a": rates("a", 90.0, 45.0, 80.0), "b": rates("b", 100.0, 50.0, 100.0)}
    verdict = judge(Bar("a", ("b",), ">=", 0.85), outcomes)
    assert verdict.measured == Spread(*map(pytest.approx, (0.9, 0.8, 0.9)), 3)
    assert verdict.word == "met"
    assert judge(Bar("a", ("b",), ">=", 0.91), outcomes).word == "missed"
    assert judge(Bar("a", ("b",), "<=", 0.91), outcomes).word == "met"


def test_the_best_rival_counts():
    outcomes = {"a": rates("a", 100.0), "b": rates("b", 50.0), "c": rates("c", 80.0)}
    verdict = judge(Bar("a", ("b", "c"), ">=", 2.0), outcomes)
    assert (verdict.against, verdict.word) == ("c", "missed")
    latencies = {
        name: outcome(name, {"rtt_p50_us": value}) for name, value in (("a", 6.0), ("b", 8.0), ("c", 20.0))
    }
    verdict = judge(Bar("a", ("b", "c"), "<=", 0.8, "rtt_p50_us"), latencies)
    assert (verdict.against, verdict.word) == ("b", "met")


def test_losses_and_failures_spoil_a_figure_that_would_do():
    bar = Bar("a", ("b",), ">=", 0.5)
    rival = {"b": rates("b", 10.0, 10.0)}
    assert judge(bar, rival | {"a": rates("a", 10.0, 10.0, lost=1)}).word == "missed (LOST 2 (10.0 %))"
    assert judge(bar, rival | {"a": rates("a", 10.0, 10.0, corrupt=3)}).word == "missed (CORRUPT 6)"
    half = outcome("a", {"rate": 10.0}, {"error": "died"})
    assert judge(bar, rival | {"a": half}).word == "missed (1 repetitions failed)"


def test_what_is_not_there_is_neither_met_nor_missed():
    bar = Bar("a", ("b",), ">=", 0.5)
    absent = {"a": rates("a", 10.0), "b": outcome("b", absent="not installed")}
    assert judge(bar, absent).word == "not measured (b: not installed)"
    failed = {"a": outcome("a", {"error": "died"}), "b": rates("b", 10.0)}
    assert judge(bar, failed).word == "not measured (died)"


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


def test_a_peer_that_is_not_installed_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("cortex.bench.measure.missing", lambda transport: "not installed")
    case = Case("x", "title", "message", 10, (Contestant("LCM", "lcm"),))
    result = run_case(case, Settings(folder=tmp_path))
    assert not result.outcomes["LCM"].repetitions
    assert "not installed" in "\n".join(case_lines(result))


def test_settings_refuse_nonsense(tmp_path: Path):
    for seconds in (0.0, -1.0, float("nan"), 1e9):
        with pytest.raises(ValueError, match="seconds"):
            Settings(folder=tmp_path, seconds=seconds)
    with pytest.raises(ValueError, match="repeats"):
        Settings(folder=tmp_path, repeats=0)


# Tables.


def results() -> list[CaseResult]:
    contestants = (Contestant("cortex", "cortex"), Contestant("a peer with a very long name " * 4, "pyzmq"))
    bars = (Bar("cortex", (contestants[1].name,), ">=", 0.85), Bar("cortex", (), ">=", 1e6))
    case = Case("typed-40", "a title", "a type", 10, contestants, bars)
    outcomes = {
        "cortex": rates("cortex", 900_000.0, 880_000.0),
        contestants[1].name: outcome(
            contestants[1].name, {"rate": 1e6, "sent": 5, "lost": 5}, {"error": "x" * 300}
        ),
    }
    return [CaseResult(case, outcomes)]


def test_tables_are_no_wider_than_a_page():
    lines = [*header(), *case_lines(results()[0]), *summary_lines(results())]
    assert max(len(line) for line in lines) <= WIDTH


def test_summary_says_met_or_missed_and_counts():
    text = "\n".join(summary_lines(results()))
    assert "0.90 ± 0.00" in text
    assert "1 met, 1 missed, 0 not measured" in text


def test_a_quick_run_judges_nothing():
    lines = [*case_lines(results()[0], quick=True), *summary_lines(results(), quick=True)]
    lines += threshold_lines(sweep(0.8, 1.1), quick=True)
    text = "\n".join(lines)
    assert "a quick run judges nothing: 2 quick, 0 not measured" in text
    assert not any(word in text for word in (" met", "missed", "carries more"))


def sweep(*ratios: float) -> list[CaseResult]:
    """Return results of the first threshold cases: shared memory so many times as fast as inline."""
    found = []
    for case, ratio in zip(choose(["threshold"]), ratios, strict=False):
        names = [contestant.name for contestant in case.contestants]
        reports = ({"rate": 100.0}, {"rate": 100.0 * ratio}, {"rtt_p50_us": 50.0}, {"rtt_p50_us": 60.0})
        outcomes = {name: outcome(name, report) for name, report in zip(names, reports, strict=True)}
        found.append(CaseResult(case, outcomes))
    return found


@pytest.mark.parametrize(
    ("ratios", "words"),
    [
        ((0.8, 0.9, 1.1, 1.2), "from 4,096 B on"),
        ((0.8, 1.1, 0.9, 1.2), "from 8,192 B on"),  # one lucky size in between does not count
        ((1.1, 0.9), "inline carries more throughout"),
    ],
)
def test_threshold_is_where_shared_memory_stays_ahead(ratios: tuple[float, ...], words: str):
    assert words in "\n".join(threshold_lines(sweep(*ratios)))


def test_csv_holds_every_repetition(tmp_path: Path):
    write_csv(tmp_path / "out.csv", results())
    with (tmp_path / "out.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["median"] for row in rows] == ["890000", "1e+06"]
    assert rows[0]["values"] == "900000 880000"
    assert rows[1]["lost"] == "5"
    assert rows[1]["error"] == "x" * 300


def test_list_names_every_case_and_bar(capsys: pytest.CaptureFixture[str]):
    assert main(["--list"]) == 0
    text = capsys.readouterr().out
    assert all(case.name in text and all(bar.text in text for bar in case.bars) for case in CASES)


def test_wrong_arguments_are_refused(capsys: pytest.CaptureFixture[str]):
    assert main(["no-such-case"]) == 2
    assert "unknown case 'no-such-case'" in capsys.readouterr().err


# The real thing, tiny.

PEERS = ("zenoh", "iceoryx2", "lcm")
OPTIONAL = (*PEERS, "cortex-cpp")
TINY = [case.name for case in CASES if not case.name.startswith("threshold-")] + ["threshold-64k"]


@pytest.fixture(scope="module")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, list[dict[str, str]]]:
    """One repetition of every case, a few milliseconds each, in a process that has no ZeroMQ context yet."""
    path = tmp_path_factory.mktemp("bench") / "out.csv"
    before = set(Path("/dev/shm").glob("*")) if Path("/dev/shm").is_dir() else set()
    command = [sys.executable, "-m", "cortex.bench", *TINY, "--quick", "--repeats", "1", "--seconds", "0.02"]
    done = subprocess.run(
        [*command, "--csv", str(path)], cwd=ROOT, capture_output=True, text=True, timeout=600.0, check=False
    )
    assert done.returncode == 0, done.stderr
    after = set(Path("/dev/shm").glob("*")) if Path("/dev/shm").is_dir() else set()
    assert not {path.name for path in after - before if path.name.startswith(("cortex", "iox2_"))}
    with path.open() as file:
        return done.stdout, list(csv.DictReader(file))


@pytest.mark.parametrize("name", TINY)
def test_case(tiny_run: tuple[str, list[dict[str, str]]], name: str):
    """Every contestant of the case has a figure, and what is reliable lost nothing."""
    (case,) = choose([name])
    rows = {(row["contestant"], row["metric"]): row for row in tiny_run[1] if row["case"] == name}
    for contestant in case.contestants:
        measured = [row for (who, _), row in rows.items() if who == contestant.name]
        assert measured, f"{contestant.name} left no trace"
        for row in measured:
            if contestant.transport in OPTIONAL and row["error"]:  # cannot run here: said in words
                continue
            assert row["error"] == "", contestant.name
            assert float(row["median"]) >= 0.0
            assert row["misordered"] == row["corrupt"] == "0", contestant.name
            if contestant.transport not in PEERS:  # what they lose is theirs to explain; here it is counted
                assert row["lost"] == "0", contestant.name
            if row["metric"] == "rate":
                assert int(row["received"]) == int(row["sent"]) - int(row["lost"]) > 0, contestant.name


def test_tiny_run_prints_every_bar(tiny_run: tuple[str, list[dict[str, str]]]):
    text = tiny_run[0]
    bars = sum(len(case.bars) for case in choose(TINY))
    quick, unmeasured = (
        int(part.split()[0]) for part in text.strip().splitlines()[-1].partition(": ")[2].split(", ")
    )
    assert quick + unmeasured == bars
    assert max(len(line) for line in text.splitlines()) <= WIDTH


def test_metrics_have_a_text():
    assert all(metric.text for metric in METRICS.values())


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks processes up in /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_run_that_is_ended_leaves_no_process(short_folder: Path, number: signal.Signals):
    command = [sys.executable, "-m", "cortex.bench", "typed-40", "--seconds", "300"]
    environment = {**os.environ, "TMPDIR": str(short_folder)}
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env=environment) as bench:
        wait_for(lambda: len(children_of(bench.pid)) >= 3)  # the registry, a publisher, a subscriber
        children = children_of(bench.pid)
        bench.send_signal(number)
        text, _ = bench.communicate(timeout=SOON_S)
    registry = [pid for name, pid in children.items() if "cortex.discovery" in name]
    if number == signal.SIGINT:
        assert bench.returncode == 0
        assert "interrupted; what was measured until then:" in text
        assert not list(short_folder.iterdir()), "files are left"
    else:  # nobody is left to end the registry: it does so itself, a minute after the last node
        for pid in registry:
            os.kill(pid, signal.SIGTERM)
    wait_for(lambda: all(gone(pid) for pid in children.values()))


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """Return a directory for temporary files whose path leaves room for the names of sockets."""
    with tempfile.TemporaryDirectory(prefix="tb", dir="/tmp") as folder:
        yield Path(folder)


def children_of(parent: int) -> dict[str, int]:
    """Return the children of a process, by command line and number."""
    found = {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if int((path / "stat").read_text().rpartition(")")[2].split()[1]) == parent:
                found[f"{(path / 'cmdline').read_text()} {path.name}"] = int(path.name)
        except (FileNotFoundError, ProcessLookupError):
            continue
    return found
