"""What the command line says to wrong use, and without the extra."""

from __future__ import annotations

import dataclasses
import json
import sys

import pytest

import neurosim_core as ns
from neurosim_core.cli import main


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["learn", "eval"], "say which run: neurosim learn eval runs/hover"),
        (
            ["learn", "eval", "nowhere"],
            "nowhere is no run of training: it has no run.json; `neurosim learn hover` makes one",
        ),
        (["learn", "hover", "runs/hover"], "a folder is for `neurosim learn eval`; say --out"),
        (["learn", "juggle", "--out", "{folder}/new"], "unknown task kind 'juggle', known: ["),
        (["learn", "hover", "--out", "{folder}"], "holds a run: give --resume, or another --out"),
        (
            ["learn", "hover", "--out", "{folder}", "--resume", "--worlds", "4", "--student-iterations", "9"],
            "--resume goes on as the run was configured: leave out --worlds, --student-iterations",
        ),
        (["learn", "hover", "--scenes", "house.glb"], "learn hover makes no use of --scenes here"),
        (
            ["learn", "eval", "r", "--seed", "1", "--test", "x"],
            "learn eval makes no use of --seed, --test here",
        ),
        (["learn", "eval", "r", "--transfer", "--blind"], "learn eval makes no use of --blind here"),
        (["learn", "eval", "r.pt", "--worlds", "4"], "learn eval makes no use of --worlds here"),
        (["learn", "rate", "hover", "--surface", "time"], "learn rate makes no use of --surface here"),
        (["learn", "depth", "hover", "--fly-device", "cpu"], "learn depth makes no use of RUN here"),
        (
            ["learn", "hover", "--algorithm", "ppo", "--teacher-iterations", "3"],
            "learn hover makes no use of --teacher-iterations here",
        ),
        (
            ["learn", "hover", "--out", "{folder}", "--resume", "--algorithm", "ppo"],
            "--resume goes on as the run was configured: leave out --algorithm",
        ),
        (["deploy", "nobody"], "unknown policy 'nobody', known: "),
    ],
)
def test_wrong_use_is_said(arguments, message, tmp_path, capsys):
    pytest.importorskip("torch", reason="needs the extra learn")
    (tmp_path / "checkpoint.pt").touch()
    assert main([argument.format(folder=tmp_path) for argument in arguments]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["avoid"], "the task of the run in {folder} is hover, not avoid"),
        (["hover", "--seed", "4"], "the seed of the run in {folder} is 3, not 4"),
        (["hover", "--device", "cuda:0"], "the device of the run in {folder} is cpu, not cuda:0"),
    ],
)
def test_no_other_run_is_resumed_than_is_asked_for(arguments, message, tmp_path, capsys):
    pytest.importorskip("torch", reason="needs the extra learn")
    from neurosim_core.learn.train import default_config

    kept = dataclasses.asdict(default_config("hover", device="cpu", seed=3))
    (tmp_path / "run.json").write_text(json.dumps(kept))
    assert main(["learn", *arguments, "--out", str(tmp_path), "--resume"]) == 1
    assert message.format(folder=tmp_path) in capsys.readouterr().err


def test_without_the_extra_the_error_names_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ImportError, match=r"pip install -e '\.\[learn\]'"):
        ns.learn.make_env  # noqa: B018
    assert main(["learn", "hover"]) == 1
    assert "learning needs torch" in capsys.readouterr().err
