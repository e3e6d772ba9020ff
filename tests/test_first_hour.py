"""Mistakes of a first hour: each is answered in one line that says what to do."""

from __future__ import annotations

import pytest

import neurosim_core as ns
from neurosim_core import cli

FILES = {
    "open.yaml": "sensors:\n  events: {kind: event_camera\n",
    "tab.yaml": "sensors:\n\timu: {kind: imu}\n",
    "list.yaml": "- duration_s: 4\n",
    "film.mp4": "no film",
    "bad.glb": "no mesh",
    "bad.h5": "no recording",
}
"""What lies in the folder where the commands are typed."""

MISTAKES = {
    "rnu": "did you mean 'run'?",
    "run --overwirte": "did you mean '--overwrite'? `neurosim run --help` lists what there is",
    "run --duration four": "--duration: invalid float value: 'four'",
    "run scene.yaml": "`neurosim run --print-config > scene.yaml` makes one",
    "run house.glb": "house.glb: no such file; settings are YAML, in which a mesh is scene: {kind: mesh",
    "run open.yaml": "open.yaml is not YAML: line 3, column 1: expected ',' or '}'",
    "run tab.yaml": "line 2, column 1: found character '\\t' that cannot start any token; indent with spaces",
    "run list.yaml": "must hold a mapping of keys to values, got a list",
    "run --set scene.romms=3": "did you mean 'rooms'?",
    "run --set sensors.events.rate_hz=500": "did you mean 'packet_rate_hz'? known: classes, kind",
    "run --set sensors.cam={kind:event_camera}": "sensors.cam.kind: required, and not given",
    "run --set vehicle=hummingbird": "the airframe is the preset: vehicle: {preset: hummingbird}",
    "run --set scene=house.glb": "the file of a scene is scene: {kind: mesh, file: house.glb}",
    "run --set duration_s=4s": "--set duration_s: Input should be a valid number, got '4s'",
    "run --set sensors.events.lens.horizontal_fov_rad=90": "if these are degrees, write 1.5708",
    "run --device cuda:7": "device: auto takes a GPU if there is one",
    "run film.mp4": "must hold a mapping",
    "scene house.glb": "house.glb: no such file",
    "scene bad.glb --out mm": "mm: the scene is drawn into a picture: mm.png",
    "scene bad.glb": "bad.glb: not a GLB file",
    "view": "there is no display to open a window on: `neurosim view --web` serves a page",
    "view flight": "`neurosim run --out flight` makes one",
    "view film.mp4": "`neurosim convert film.mp4 events.h5` makes events of a video",
    "view bad.h5": "bad.h5 is not a readable HDF5 file",
    "convert bad.h5 out.xyz": "known: .raw, .evt2.raw, .dat",
    "bench stepp": "did you mean 'step'?",
    "call status --timeout 0.1": "start one with `neurosim serve`",
    "up --viewer rviz": "--viewer must be auto, native, web, none or a file that ends in .rrd",
}


@pytest.mark.parametrize("typed", MISTAKES)
def test_a_mistake_is_answered_in_one_line(typed, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    try:
        status = cli.main(typed.split())
    except SystemExit as left:  # wrong use
        status = left.code
    assert status in (1, 2)
    lines = [line for line in capsys.readouterr().err.splitlines() if line and "configuration:" not in line]
    assert len(lines) == 1
    assert MISTAKES[typed] in lines[0]
    assert {path.name for path in tmp_path.iterdir()} == set(FILES)


def test_mistakes_in_python_are_answered_as_well():
    with pytest.raises(AttributeError, match=r"known: .*\bload_config\b"):
        _ = ns.load_confg
    with pytest.raises(ns.ConfigError, match="duration: unknown key; did you mean 'duration_s'"):
        next(iter(ns.run({"duration": 1.0})))
    with pytest.raises(
        ns.ConfigError, match=r"EventCameraConfig .*:\n  threshold_on: .* greater .*, got -1\Z"
    ):
        ns.EventCameraConfig(threshold_on=-1)
    with pytest.raises(TypeError, match="the name of a YAML file, a mapping or None, got 3"):
        ns.load_config(3)
    with pytest.raises(ValueError, match=r"unknown airframe 'humingbird', known: .*'hummingbird'"):
        ns.preset("humingbird")
    with pytest.raises(FileNotFoundError, match=r"no file nothing\.h5"):
        ns.Recording("nothing.h5")
    with pytest.raises(TypeError, match="Stream has no argument 'batch_size'; did you mean 'batch'"):
        ns.data.Stream("data", batch_size=8)
    with pytest.raises(TypeError, match="Dataset has no argument 'window'; did you mean 'window_s'"):
        ns.data.Dataset("data", window=0.05)
