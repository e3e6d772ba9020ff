"""The command line of the benchmarks: help, wrong use, reports, and what fails among others."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from neurosim_core import cli
from neurosim_core.bench import commands
from neurosim_core.bench.commands import STUDIES, Study
from neurosim_core.bench.report import Bar, Chapter

NAMES = ("dynamics", "events", "pixel", "render", "throughput", "shared-walk", "worlds", "leave-out")


def chapter_of(name, quick):
    return Chapter(
        name=name,
        title=f"About {name}",
        summary="quickly" if quick else "slowly",
        command=f"neurosim bench {name}",
        bars=[Bar(text=f"{name} is good", measured="very", met=True)],
    )


def fail(_options, _progress):
    raise ZeroDivisionError("no <events> to divide by")


def interrupt(_options, _progress):
    raise KeyboardInterrupt


@pytest.fixture
def studies(monkeypatch):
    """Stand-ins that answer at once; their names say which fail."""
    told = []

    def study(name, chapter=None):
        def measure(options, progress):
            progress("something")
            told.append(name)
            return chapter_of(name, options["quick"])

        return Study(name=name, help="", description=f"It is about {name}.", chapter=chapter or measure)

    def install(*chosen):
        monkeypatch.setattr(
            commands, "STUDIES", tuple(study(n, {"fails": fail, "stops": interrupt}.get(n)) for n in chosen)
        )
        return told

    return install


def test_the_studies_of_the_report():
    assert tuple(study.name for study in STUDIES) == NAMES


@pytest.mark.parametrize("name", [*NAMES, "all", "step", "closed-loop", "streaming", "delay"])
def test_every_question_has_help(name, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["bench", name, "--help"])
    assert end.value.code == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.startswith(f"usage: neurosim bench {name}")
    if name in (*NAMES, "all"):
        folder = "report" if name == "all" else name
        assert f"--out DIR where to leave files (./{folder})" in said
        assert "--quick" in said
        assert "--strict exit with status 1 if a bar is missed" in said


def test_help_is_fast():
    """Neither Warp nor NumPy, nor any benchmark, is imported for it."""
    code = (
        "import sys\nfrom neurosim_core import cli\n"
        "try: cli.main(['bench', 'render', '--help'])\nexcept SystemExit: pass\n"
        "heavy = {'warp', 'numpy', 'scipy', 'matplotlib', 'rich', 'pydantic', 'neurosim_core.bench.render'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_one_report_of_all(studies, tmp_path, capsys):
    told = studies("one", "two")
    assert cli.main(["bench", "all", "--quick", "--out", str(tmp_path / "r")]) == 0
    assert told == ["one", "two"]
    text = (tmp_path / "r" / "report.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (.*)$", text, re.M) == ["About one", "About two"]
    assert "quickly" in text
    said = capsys.readouterr().out
    assert "met one is good: very" in said
    assert re.search(r"left in .*report.html", " ".join(said.split()))


def missed(name):
    def measure(options, progress):
        bars = [Bar(text="it is", measured="not", met=False), Bar(text="it was", measured="?", met=None)]
        return replace(chapter_of(name, options["quick"]), bars=bars)

    return Study(name=name, help="", description="", chapter=measure)


@pytest.mark.parametrize("what", ["low", "all"])
def test_bars_that_are_missed_are_counted_and_fail_only_where_asked(what, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(commands, "STUDIES", (missed("low"),))
    assert cli.main(["bench", what, "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "bars: 1 missed, 0 met, 1 not measured here"
    assert cli.main(["bench", what, "--strict", "--out", str(tmp_path)]) == 1
    assert "**This could not" not in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_strict_is_content_where_all_bars_are_met(studies, tmp_path, capsys):
    studies("one", "two")
    assert cli.main(["bench", "all", "--strict", "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "bars: 0 missed, 2 met"


def test_a_chapter_says_with_which_options_it_was_measured(monkeypatch, tmp_path):
    """Those that it names itself are not said twice; names of files are quoted for a shell."""

    def study(name, said):
        def measure(_options, _progress):
            return replace(chapter_of(name, True), command=f"neurosim bench {name}{said}")

        options = frozenset({"device", "scene", "width"})
        return Study(name=name, help="", description="", chapter=measure, options=options)

    def fails(name):
        return replace(study(name, ""), chapter=fail)

    monkeypatch.setattr(
        commands,
        "STUDIES",
        (study("one", ""), study("two", " --quick --device cpu --width 64"), fails("bad")),
    )
    given = ["--quick", "--device", "cpu", "--scene", "my house.glb"]
    assert cli.main(["bench", "all", *given, "--out", str(tmp_path)]) == 1
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert re.findall(r"^`(neurosim .*)`$", text, re.M) == [
        "neurosim bench one --device cpu --quick --scene 'my house.glb'",
        "neurosim bench two --quick --device cpu --width 64 --scene 'my house.glb'",
        "neurosim bench bad --device cpu --quick --scene 'my house.glb'",
    ]


def test_what_fails_is_told_and_the_others_go_on(studies, tmp_path, capsys):
    told = studies("one", "fails", "two")
    assert cli.main(["bench", "all", "--out", str(tmp_path)]) == 1
    assert told == ["one", "two"]
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("<section") == 1 + 3
    assert "ZeroDivisionError: no &lt;events&gt; to divide by" in page
    assert re.search(r"2 met</b>, <b class=\"missed\">1 missed", page)
    assert "in fail" in page  # where it happened
    assert "fails failed: ZeroDivisionError: no <events> to divide by" in capsys.readouterr().out


def test_an_interruption_keeps_what_was_measured(studies, tmp_path):
    told = studies("one", "stops", "two")
    assert cli.main(["bench", "all", "--out", str(tmp_path)]) == 130
    assert told == ["one"]
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (.*)$", text, re.M) == ["About one"]


def test_a_single_study_that_fails(studies, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    studies("one", "fails")
    assert cli.main(["bench", "fails"]) == 1
    assert "neurosim: no <events> to divide by" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert cli.main(["bench", "one"]) == 0
    assert (tmp_path / "one" / "report.html").exists()


def test_each_study_calls_its_module(monkeypatch):
    """What the parser promises is there: each study's module has its two functions."""
    import importlib

    for name in NAMES:
        key = name.replace("-", "_")
        module = importlib.import_module(f"neurosim_core.bench.{key}")
        original = getattr(module, f"measure_{key}")
        seen = {}

        def measure(seen=seen, **options):
            seen.update(options)
            return "a result"

        monkeypatch.setattr(module, f"measure_{key}", measure)
        monkeypatch.setattr(module, f"{key}_chapter", lambda result, name=name: chapter_of(name, result))
        study = next(study for study in STUDIES if study.name == name)
        options = {"quick": True, **{option: f"its {option}" for option in study.options}}
        assert study.chapter(options, print).summary == "quickly"
        assert seen.items() >= options.items()
        assert seen.keys() <= inspect.signature(original).parameters.keys()


def test_options_reach_those_who_take_them(monkeypatch, tmp_path):
    told = {}

    def study(name, *options):
        def measure(given, _progress):
            told[name] = given
            return chapter_of(name, given["quick"])

        return Study(name=name, help="", description="", chapter=measure, options=frozenset(options))

    monkeypatch.setattr(commands, "STUDIES", (study("one"), study("two", "device", "scene")))
    out = ["--out", str(tmp_path)]
    assert cli.main(["bench", "all", "--device", "cpu", *out]) == 0
    assert told == {"one": {"quick": False}, "two": {"quick": False, "device": "cpu"}}
    assert cli.main(["bench", "two", "--scene", "a.glb", "--quick", *out]) == 0
    assert told["two"] == {"quick": True, "scene": Path("a.glb")}
    with pytest.raises(SystemExit):
        cli.main(["bench", "one", "--device", "cpu", *out])


def test_a_scene_that_no_chapter_takes_is_told(monkeypatch, tmp_path, capsys):
    def study(name, then=""):
        options = frozenset() if then else frozenset({"device", "scene"})
        chapter = lambda given, _: chapter_of(name, given["quick"])  # noqa: E731
        return Study(name=name, help="", description="", chapter=chapter, options=options, then=then)

    monkeypatch.setattr(commands, "STUDIES", (study("one", then="two"), study("two")))
    asked = ["bench", "one", "--scene", "a.glb", "--out", str(tmp_path)]
    assert cli.main(asked) == 0
    assert "--scene is not used" in capsys.readouterr().out
    assert cli.main([*asked, "--device", "cpu"]) == 0
    assert "not used" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["all", "--quickly", "--fast"], "unrecognized arguments: --quickly --fast"),
        (["all", "too", "much"], "unrecognized arguments: too much"),
        (["render", "--out"], "--out: expected one argument"),
        (["nothing"], "invalid choice: 'nothing'"),
        ([], "the following arguments are required: WHAT"),
    ],
)
def test_wrong_use(arguments, said, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["bench", *arguments])
    assert end.value.code == 2
    assert said in capsys.readouterr().err


def test_a_folder_that_cannot_be_made(studies, tmp_path, capsys):
    studies("one")
    (tmp_path / "taken").write_text("a file")
    assert cli.main(["bench", "one", "--out", str(tmp_path / "taken")]) == 1
    assert "taken" in capsys.readouterr().err


def test_studies_are_frozen():
    with pytest.raises(AttributeError):
        STUDIES[0].name = "other"
    assert replace(STUDIES[0], name="other").help == STUDIES[0].help
