"""The command line of the benchmarks: help, wrong use, reports that grow, and what fails among others."""

from __future__ import annotations

import json
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from neurosim_core import cli
from neurosim_core.bench import commands
from neurosim_core.bench.commands import QUESTIONS, Question
from neurosim_core.bench.report import Chapter, Claim

NAMES = [question.name for question in QUESTIONS]


@pytest.fixture
def asked(monkeypatch):
    """Questions that are answered at once; returns the options that each was asked with."""
    told = {}

    def measure(self, options):
        options.progress("something")
        told[self.name] = options
        if self.name == "fails":
            raise ValueError("no events to divide by")
        if self.name == "stops":
            raise KeyboardInterrupt
        claim = Claim(f"{self.name} is good", "theory", "very", self.name != "low")
        return Chapter(name=self.name, title=self.name, summary="It is.", claims=[claim])

    def install(*names):
        questions = [Question(name=name, help=name, options=("device", "scene")) for name in names]
        monkeypatch.setattr(commands, "QUESTIONS", questions)
        return told

    monkeypatch.setattr(Question, "measure", measure)
    return install


def test_all_questions_have_a_module_and_help(capsys):
    for name in [*NAMES, "all"]:
        with pytest.raises(SystemExit) as end:
            cli.main(["bench", name, "--help"])
        assert end.value.code == 0
        said = " ".join(capsys.readouterr().out.split())
        assert said.startswith(f"usage: neurosim bench {name}")
        assert all(option in said for option in ("--out DIR", "--quick", "--json", "--resume", "--strict"))
    folder = Path(commands.__file__).parent
    assert all((folder / f"{name.replace('-', '_')}.py").exists() for name in NAMES)


def test_help_imports_nothing_heavy():
    code = (
        "import sys\nfrom neurosim_core import cli\n"
        "try: cli.main(['bench', 'render', '--help'])\nexcept SystemExit: pass\n"
        "print(sorted({'warp', 'numpy', 'scipy', 'matplotlib', 'rich', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_a_report_of_all_and_options_that_reach_it(asked, tmp_path, capsys):
    told = asked("one", "two")
    assert cli.main(["bench", "all", "--quick", "--device", "cpu", "--out", str(tmp_path / "r")]) == 0
    assert (told["two"].quick, told["two"].device, told["two"].scene) == (True, "cpu", None)
    assert {file.name for file in (tmp_path / "r").iterdir()} == {"one.json", "two.json", "report.html"}
    said = capsys.readouterr().out
    assert "met one is good: very (theory)" in said
    assert "claims: 0 missed, 2 met, 0 not measured here" in said


def test_each_chapter_is_left_as_soon_as_it_is_done(asked, tmp_path, capsys):
    asked("one", "stops", "two")
    assert cli.main(["bench", "all", "--out", str(tmp_path)]) == 130
    assert "interrupted; the same command with --resume goes on" in capsys.readouterr().out
    assert {file.name for file in tmp_path.iterdir()} == {"one.json", "report.html"}


def test_resuming_keeps_what_is_there(asked, tmp_path, capsys):
    told = asked("one")
    cli.main(["bench", "one", "--out", str(tmp_path)])
    told.clear()
    asked("one", "two")
    assert cli.main(["bench", "all", "--resume", "--out", str(tmp_path)]) == 0
    assert list(told) == ["two"]
    assert "one: kept from" in capsys.readouterr().out
    assert (tmp_path / "report.html").read_text().count("<section") == 1 + 2


@pytest.mark.parametrize(
    ("more", "measured"),
    [
        (["--resume"], ["1 m/s", "2 m/s", "2 m/s"]),
        (["--resume", "--quick"], ["1 m/s", "2 m/s", "1 m/s", "2 m/s"]),
        ([], ["1 m/s", "2 m/s", "1 m/s", "2 m/s"]),
    ],
)
def test_stages_that_an_interrupted_question_left(asked, tmp_path, monkeypatch, capsys, more, measured):
    """They are kept where a run with the same options is resumed."""
    begun = []

    def value_of(name):
        begun.append(name)
        if len(begun) == 2:
            raise KeyboardInterrupt
        return {"first": np.float64(name[0]), "none": np.nan}

    def measure(self, options):
        found = [options.stage(name, partial(value_of, name)) for name in ("1 m/s", "2 m/s")]
        return Chapter(name="one", title="", summary=f"{found[0]['first']:g} {found[1]['first']:g}")

    asked("one")
    monkeypatch.setattr(Question, "measure", measure)
    assert cli.main(["bench", "one", "--out", str(tmp_path)]) == 130
    assert cli.main(["bench", "one", "--out", str(tmp_path), *more]) == 0
    assert "claims" not in capsys.readouterr().out  # there are none
    assert begun == measured
    assert json.loads((tmp_path / "one.json").read_text())["summary"] == "1 2"
    assert {file.name for file in tmp_path.iterdir()} == {"one.json", "report.html"}


def test_what_fails_is_told_and_the_others_go_on(asked, tmp_path, capsys):
    told = asked("one", "fails", "two")
    assert cli.main(["bench", "all", "--out", str(tmp_path)]) == 1
    assert list(told) == ["one", "fails", "two"]
    assert "fails failed: ValueError: no events to divide by" in capsys.readouterr().out
    assert "in measure" in (tmp_path / "report.html").read_text()  # where it happened


def test_a_single_question_that_fails_leaves_nothing(asked, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked("fails")
    assert cli.main(["bench", "fails"]) == 1
    assert "no events to divide by" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_missed_claims_fail_only_where_asked(asked, tmp_path, capsys):
    asked("low")
    assert cli.main(["bench", "low", "--out", str(tmp_path)]) == 0
    assert "claims: 1 missed, 0 met" in capsys.readouterr().out
    assert cli.main(["bench", "low", "--strict", "--out", str(tmp_path)]) == 1


def test_json_is_all_that_is_printed(asked, tmp_path, capsys):
    asked("one", "two")
    assert cli.main(["bench", "all", "--json", "--out", str(tmp_path)]) == 0
    chapters = json.loads(capsys.readouterr().out)
    assert [chapter["name"] for chapter in chapters] == ["one", "two"]
    assert chapters[0]["facts"].keys() >= {"date", "command", "machine", "versions", "took"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["all", "--quickly"], "unrecognized arguments: --quickly"),
        (["pixel", "--scene", "a.glb"], "unrecognized arguments: --scene a.glb"),
        (["worlds", "--worlds", "1,b"], "takes whole numbers with commas between them, got '1,b'"),
        (["delay", "--mode", "fast"], "invalid choice: 'fast'"),
        (["nothing"], "invalid choice: 'nothing'"),
        ([], "the following arguments are required: WHAT"),
    ],
)
def test_wrong_use(arguments, said, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["bench", *arguments])
    assert end.value.code == 2
    assert said in capsys.readouterr().err
