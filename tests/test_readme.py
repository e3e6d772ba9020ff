"""Every command and example of the README runs."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh
import yaml

from neurosim_core import cli, load_config

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BIN = Path(sys.executable).parent


def named(kind: str, language: str, text: str = README) -> dict[str, str]:
    pattern = rf"<!-- {kind}: (\w+) -->\s*```{language}\n(.*?)```"
    return dict(re.findall(pattern, text, flags=re.DOTALL))


def commands(block: str) -> list[str]:
    """Lines of a list of commands, without the remarks."""
    (body,) = re.findall(rf"<!-- commands: {block} -->\s*```\n(.*?)```", README, flags=re.DOTALL)
    return re.findall(r"^(neurosim [^#\n]*?)\s*#", body, flags=re.MULTILINE)


def shell(command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(BIN), os.environ["PATH"]])
    return subprocess.run(
        ["bash", "-c", command],
        cwd=cwd,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        timeout=600,
    )


def test_the_readme_is_short():
    assert len(README.splitlines()) < 150


def test_the_readme_is_finished():
    for image in re.findall(r"!\[[^]]*\]\(([^)]+)\)", README):
        assert (ROOT / image).is_file()
    assert not re.search(r"FIGURE|TODO|TBD|XXX", README)


def test_ci_runs_the_test_command():
    spec = importlib.util.spec_from_file_location("readme_command", ROOT / ".ci" / "readme_command.py")
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    commands = module.readme_commands()
    assert set(commands) == {"run", "tests"}
    assert all(c.startswith("python3 -m venv .venv && .venv/bin/pip install -e") for c in commands.values())
    assert "readme_command.py tests" in (ROOT / ".ci" / "run").read_text()


def test_the_run_command(tmp_path):
    """The last part of the command, for 0.3 s; what is before it has installed this environment."""
    command = named("command", "bash")["run"].rsplit("&&", 1)[-1].strip()
    assert command == ".venv/bin/neurosim run"
    done = shell("neurosim run --duration 0.3", tmp_path)
    assert done.returncode == 0, done.stderr
    assert {p.name for p in (tmp_path / "flight").iterdir()} == {
        "config.yaml", "flight.h5", "flight.rrd", "overview.png"
    }  # fmt: skip
    reading = named("reading", "python")["flight"].replace("1.0, 1.1", "0.1, 0.2")
    reading += "print(len(events.t), len(rates), len(packets))"
    read = subprocess.run(
        [sys.executable, "-W", "error", "-c", reading], cwd=tmp_path, capture_output=True, text=True
    )
    assert read.returncode == 0, read.stderr
    events, rates, packets = map(int, read.stdout.split())
    assert events > 1000
    assert (rates, packets) == (121, 7 + 61)


EXAMPLES = named("example", "python")
for page in ("simulator.md", "worlds.md", "data.md"):
    EXAMPLES |= named("example", "python", (ROOT / "docs" / page).read_text(encoding="utf-8"))


SETTINGS = named("settings", "yaml", (ROOT / "docs" / "sensors.md").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_examples(name, tmp_path, monkeypatch, capsys):
    """Each as a program of its own would run, in this process: it finds nothing of the others.

    Flights of a second end after a fifth of it.
    """
    monkeypatch.chdir(tmp_path)
    exec(
        compile(EXAMPLES[name].replace('"duration_s": 1.0', '"duration_s": 0.2'), name, "exec"),
        {"__name__": "__main__"},
    )
    count = int(capsys.readouterr().out.splitlines()[-1].split()[0])
    assert count == 5 * 64 * 48 if name == "parts" else count > 1000


@pytest.mark.parametrize("name", sorted(SETTINGS))
def test_settings_of_the_documentation(name):
    """They are read, and each sets something that is off by default."""
    config = load_config(yaml.safe_load(SETTINGS[name]))
    assert config != load_config({"duration_s": config.duration_s})


def test_the_other_commands(tmp_path, monkeypatch, capsys):
    """The list under "What else there is", shortened where a flight would take long; all in this process.

    An empty room stands for house.glb.
    """
    listed = commands("alone")
    assert len(listed) == 8
    small = (
        " --duration 0.05 --set render.lighting.mode=unshadowed --set sensors.events.kind=event_camera"
        " --set 'sensors.events.lens={width: 32, height: 24, horizontal_fov_rad: 1.5}'"
    )
    room = trimesh.creation.box(extents=(6.0, 5.0, 2.7))
    room.invert()
    room.export(tmp_path / "house.glb")
    monkeypatch.chdir(tmp_path)

    def run(command: str) -> str:
        assert cli.main(shlex.split(command)[1:]) == 0, f"{command}: {capsys.readouterr().err}"
        return capsys.readouterr().out

    for command in listed:
        if re.search(
            "convert|neurosim scene|bench all", command
        ):  # in tests/convert, tests/scene, tests/bench
            assert cli._parser().parse_args(command.split()[1:]).command is not None
        elif "print-config" in command:
            command, _, file = command.partition(" > ")
            (tmp_path / file).write_text(run(command), encoding="utf-8")
        elif command.startswith("neurosim run"):
            run(command + small)
        elif "view" in command:
            run(command + " --save again.rrd")  # the flight of the command before
        else:
            run(command + " --width 64 --height 48 --steps 32")


def test_the_commands_of_the_tutorials_are_commands():
    """What takes minutes runs by night (`.ci/long tutorials`); here, that nothing is misspelt."""
    count = 0
    for page in (ROOT / "docs" / "tutorials").glob("*.md"):
        text = page.read_text(encoding="utf-8")
        blocks = re.findall(r"^```(\w*)\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
        shown = "\n".join(body for language, body in blocks if language in ("", "bash"))
        for line in re.findall(r"^(?:\w+=\S+ )*neurosim ([^#>&\n]*)", shown, flags=re.MULTILINE):
            words = [word for word in shlex.split(line) if not word.startswith("$")]
            assert cli._parser().parse_args(words).command is not None, (page, line)
            count += 1
    assert count >= 25


def test_the_commands_of_the_live_stack():
    """They go on until they are stopped, and are flown in tests/live; here, that they are commands."""
    listed = commands("live")
    assert {line.split()[1] for line in listed} == {"up", "serve", "fly", "view", "call", "bench"}
    for line in listed:
        assert cli._parser().parse_args(line.split()[1:]).command is not None
