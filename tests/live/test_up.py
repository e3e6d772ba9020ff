"""`neurosim up`: which processes it runs, with which settings, and what it makes of the end of each."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.live import up as up_module
from neurosim_core.live.up import Part


@pytest.fixture
def up(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[dict[str, Part], SimulationConfig]]:
    """Calls `up` without running anything; returns its parts by name, and the settings that they read."""

    def up(config: SimulationConfig, **options: Any) -> tuple[dict[str, Part], SimulationConfig]:
        seen: dict[str, Any] = {}

        def run_together(parts: Sequence[Part], **_: Any) -> int:
            seen["parts"] = {part.name: part for part in parts}
            files = {part.command[4] for part in parts if part.name != "viewer"}
            (file,) = files  # they read the same
            seen["config"] = load_config(file)
            seen["folder"] = Path(file).parent
            return 7

        monkeypatch.setattr(up_module, "run_together", run_together)
        defaults = {"viewer": "none", "record": None, "overwrite": False}
        assert up_module.up(config, **{**defaults, **options}) == 7
        assert not seen["folder"].exists()
        return seen["parts"], seen["config"]

    return up


def arguments(part: Part, *, after: int = 3) -> list[str]:
    """What a part is told; all run this Python's neurosim."""
    assert list(part.command[:3]) == [sys.executable, "-m", "neurosim_core"]
    return list(part.command[after:])


def test_simulator_and_controller_read_the_same_resolved_settings(up):
    config = load_config({"seed": 4, "live": {"mode": "lockstep"}}, overrides={"sensors.imu.rate_hz": 500.0})
    parts, read = up(config)
    assert read == config
    assert list(parts) == ["simulator", "controller"]
    assert (arguments(parts["simulator"])[0], arguments(parts["controller"])[0]) == ("serve", "fly")
    assert arguments(parts["simulator"], after=5) == arguments(parts["controller"], after=5) == []


def test_a_relative_scene_file_is_meant_from_here(up, tmp_path, monkeypatch):
    """Not from the folder of the settings file that is written for the others."""
    monkeypatch.chdir(tmp_path)
    _, read = up(load_config({"scene": {"kind": "mesh", "file": "house.glb"}}))
    assert read.scene.file == tmp_path / "house.glb"
    _, read = up(load_config({"scene": {"kind": "mesh", "file": "/data/house.glb"}}))
    assert read.scene.file == Path("/data/house.glb")


def test_only_the_simulator_records(up):
    parts, _ = up(SimulationConfig(), record=Path("flight"), overwrite=True, viewer="live.rrd")
    assert arguments(parts["simulator"], after=5) == ["--record", "flight", "--overwrite"]
    assert arguments(parts["controller"], after=5) == []
    assert arguments(parts["viewer"]) == ["view", "--save", "live.rrd"]
    assert [part.name for part in parts.values() if part.writes_file] == ["simulator", "viewer"]
    parts, _ = up(SimulationConfig(), record=Path("flight"))
    assert arguments(parts["simulator"], after=5) == ["--record", "flight"]
    assert not any(part.writes_file for part in up(SimulationConfig())[0].values())


@pytest.mark.parametrize(("mode", "at_its_end"), [("lockstep", "end if it failed"), ("streaming", "go on")])
def test_all_end_with_the_simulator_and_a_flight_in_lockstep_with_its_controller(up, mode, at_its_end):
    parts, _ = up(load_config({"live": {"mode": mode}}), viewer="web")
    assert {name: part.at_its_end for name, part in parts.items()} == {
        "simulator": "end",
        "controller": at_its_end,
        "viewer": "go on",
    }
    assert {name for name, part in parts.items() if part.is_prefixed} == {"controller", "viewer"}
    assert "the flight goes on" in parts["viewer"].advice
    assert "fail-safe" in parts["controller"].advice


@pytest.mark.parametrize(
    ("viewer", "display", "platform", "wanted"),
    [
        ("auto", "DISPLAY", "linux", []),
        ("auto", "WAYLAND_DISPLAY", "linux", []),
        ("auto", None, "darwin", []),
        ("auto", None, "win32", []),
        ("auto", None, "linux", ["--web", "--no-browser"]),
        ("native", None, "linux", []),
        ("web", "DISPLAY", "linux", ["--web"]),
        ("web", None, "linux", ["--web", "--no-browser"]),
        ("none", "DISPLAY", "linux", None),
        ("some folder/live.rrd", "DISPLAY", "linux", ["--save", "some folder/live.rrd"]),
    ],
)
def test_the_viewer_suits_the_display(monkeypatch, viewer, display, platform, wanted):
    """Without a display, or with an empty name, no browser is opened: it might be one for the terminal."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, "")
    if display is not None:
        monkeypatch.setenv(display, ":0")
    monkeypatch.setattr(sys, "platform", platform)
    assert up_module.viewer_options(viewer) == wanted


def test_a_file_that_is_there_is_refused_before_anything_runs(up, tmp_path):
    file = tmp_path / "live.rrd"
    file.write_bytes(b"mine")
    with pytest.raises(FileExistsError, match=r"live.rrd is there already: name another file"):
        up(SimulationConfig(), viewer=str(file))
    with pytest.raises(OSError, match="there is no folder"):
        up(SimulationConfig(), viewer=str(tmp_path / "no" / "f.rrd"))


@pytest.mark.parametrize("viewer", ["rerun", "", "live.mp4", "Native"])
def test_an_unknown_viewer_is_refused_before_anything_runs(up, viewer):
    with pytest.raises(ValueError, match=rf"native, web, none or a file that ends in .rrd, got '{viewer}'"):
        up(SimulationConfig(), viewer=viewer)
