"""A scene that another process reads is the one that is loaded here."""

from __future__ import annotations

import dataclasses
import errno
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
import trimesh
from processes import children_of
from small_room import room_scene

import neurosim_core as ns
from neurosim_core.render.refine import refine
from neurosim_core.scene.config import SceneConfig
from neurosim_core.scene.hall import HallConfig
from neurosim_core.scene.mesh import MeshSceneConfig
from neurosim_core.scene.reader import NotReadError, SceneReader
from neurosim_core.scene.scene import Scene
from neurosim_core.scene.source import SceneError
from neurosim_core.sim import make_model


def arrays_of(scene: Scene) -> dict[str, Any]:
    found = {field.name: getattr(scene, field.name) for field in dataclasses.fields(scene)}
    return {name: value for name, value in found.items() if isinstance(value, np.ndarray)}


def settings_in(config: SceneConfig, **sensors: Any) -> ns.SimulationConfig:
    """Hover in a scene."""
    scene = config.model_dump(mode="json")
    sensors["imu"] = {"kind": "imu"}
    return ns.load_config({"scene": scene, "path": {"kind": "hover"}, "sensors": sensors, "device": "cpu"})


def test_it_is_the_scene_that_is_loaded_here(tmp_path, monkeypatch):
    file = tmp_path / "box.glb"
    box = trimesh.creation.box(extents=(6.0, 4.0, 3.0))
    image = PIL.Image.fromarray(np.arange(4 * 4 * 3, dtype=np.uint8).reshape(4, 4, 3))
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2] / 10.0, image=image)
    box.export(file)
    config = MeshSceneConfig(file=file)
    loaded = config.load()
    monkeypatch.setattr(MeshSceneConfig, "load", None)
    with SceneReader({"scene": {"file": str(file)}}) as reader:
        scene = reader.scene(config)
        pairs = [(m.texture, n.texture) for m, n in zip(scene.materials, loaded.materials, strict=True)]
        pictures = [one and (one.srgb, one.pack_levels()) for one, _ in pairs]
        (mesh,), connections = scene.refined.values(), scene.connections
    for name, values in arrays_of(loaded).items():
        np.testing.assert_array_equal(getattr(scene, name), values, strict=True)
    wanted = refine(loaded, 0.5)
    for field in dataclasses.fields(wanted):
        np.testing.assert_array_equal(getattr(mesh, field.name), getattr(wanted, field.name), strict=True)
    assert len(mesh.faces) > len(loaded.faces)
    for found, expected in zip(mesh.corner_groups, wanted.corner_groups, strict=True):
        np.testing.assert_array_equal(found, expected, strict=True)
    for found, expected in zip(connections, loaded.connections, strict=True):
        np.testing.assert_array_equal(found, expected, strict=True)
    assert refine(scene, 0.5) is mesh
    assert scene.notes == loaded.notes
    assert (scene.lights, scene.instance_names) == (loaded.lights, loaded.instance_names)
    assert any(pictures)
    for picture, (_, other) in zip(pictures, pairs, strict=True):
        assert (picture is None) == (other is None)
        if picture is not None and other is not None:
            srgb, levels = picture
            np.testing.assert_array_equal(srgb, other.srgb)
            assert len(levels) == 3  # of 4 x 4 texels
            for found, expected in zip(levels, other.pack_levels(), strict=True):
                np.testing.assert_array_equal(found, expected, strict=True)


@pytest.mark.parametrize("settings", [{"kind": "mesh", "file": "elsewhere.ply"}, "hall", 3, {"kind": "no"}])
def test_what_the_process_has_not_read_is_read_here(tmp_path, settings):
    config = MeshSceneConfig.model_validate(room_scene(tmp_path))
    with SceneReader({"scene": settings}) as reader:
        with pytest.raises(NotReadError):
            reader.scene(config)
        assert make_model(settings_in(config), reader=reader).scene.name == "room"


def test_what_is_wrong_with_a_file_is_said_here(tmp_path):
    with (
        SceneReader({"scene": {"file": "no.glb"}}) as reader,
        pytest.raises(SceneError, match=r"no\.glb: no such file"),
    ):
        make_model(settings_in(MeshSceneConfig(file=Path("no.glb"))), reader=reader)


def test_ctrl_c_interrupts_the_reading_of_a_scene(monkeypatch):
    """Without another process the thread that is interrupted reads it, so nobody waits for the rest."""
    readers = []
    load = HallConfig.load

    def load_here(config, **options):
        readers.append(threading.current_thread())
        return load(config, **options)

    monkeypatch.setattr(HallConfig, "load", load_here)
    make_model(settings_in(HallConfig()))
    assert readers == [threading.current_thread()]


def test_modules_of_the_working_directory_are_left_alone(tmp_path, monkeypatch):
    config = MeshSceneConfig.model_validate(room_scene(tmp_path))
    (tmp_path / "pickle.py").write_text("open('imported', 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(MeshSceneConfig, "load", None)
    with SceneReader({"scene": config.model_dump(mode="json")}) as reader:
        assert reader.scene(config).name == "room"
    assert not (tmp_path / "imported").exists()


def test_it_reads_where_standard_input_is_closed(tmp_path):
    program = f"""
from neurosim_core.scene.mesh import MeshSceneConfig
from neurosim_core.scene.reader import SceneReader
settings = {MeshSceneConfig.model_validate(room_scene(tmp_path)).model_dump(mode="json")}
config, MeshSceneConfig.load = MeshSceneConfig.model_validate(settings), None
with SceneReader({{"scene": settings}}) as reader:
    assert reader._file.fileno() == 0
    assert reader.scene(config).name == "room"
"""
    command = [sys.executable, "-c", program]
    subprocess.run(["sh", "-c", 'exec "$@" <&-', "sh", *command], check=True, timeout=120)


def test_its_process_ends_with_the_one_that_asks():
    program = """
import os, signal
from neurosim_core.scene.reader import SceneReader
reader = SceneReader({"scene": "apartment"})
print(open(f"/proc/self/task/{os.getpid()}/children").read(), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    state = Path("/proc", done.stdout.strip(), "stat")
    deadline = time.monotonic() + 1.0  # to read the scene takes longer
    while state.exists() and state.read_text().split()[2] != "Z":
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_picture_that_cannot_be_decoded_counts_where_somebody_looks(tmp_path):
    box = trimesh.creation.box(extents=(6.0, 4.0, 3.0))
    image = PIL.Image.fromarray(np.zeros((4, 4, 3), dtype=np.uint8))
    box.visual = trimesh.visual.TextureVisuals(uv=box.vertices[:, :2], image=image)
    (tmp_path / "box.glb").write_bytes(box.export(file_type="glb").replace(b"\x89PNG", b"none"))
    config = MeshSceneConfig(file=tmp_path / "box.glb")
    with SceneReader({"scene": config.model_dump(mode="json")}) as reader:
        assert len(make_model(settings_in(config), reader=reader).scene.faces) == 12
        camera = {"kind": "rgb", "lens": {"width": 8, "height": 8, "horizontal_fov_rad": 1.0}}
        with pytest.raises(SceneError, match="cannot be decoded"):
            make_model(settings_in(config, camera=camera), reader=reader)


def test_settings_of_a_scene_may_be_long(monkeypatch):
    """Longer than an argument of a process on Linux, 128 KiB."""
    boxes = [{"position_m": [0.001 * k, 1.0, 1.0], "size_m": [0.1, 0.1, 0.1]} for k in range(2000)]
    config = HallConfig.model_validate({"boxes": boxes})
    monkeypatch.setattr(HallConfig, "load", None)
    with SceneReader({"scene": config.model_dump(mode="json")}) as reader:
        assert len(reader.scene(config).faces) > 12 * len(boxes)


def test_a_disk_without_room_is_done_without(tmp_path, monkeypatch):
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", fail)
    config = MeshSceneConfig.model_validate(room_scene(tmp_path))
    with SceneReader({"scene": config.model_dump(mode="json")}) as reader:
        assert make_model(settings_in(config), reader=reader).scene.name == "room"


def test_a_process_that_ends_too_early_is_done_without(tmp_path):
    config = MeshSceneConfig.model_validate(room_scene(tmp_path))
    before = children_of(os.getpid())
    with SceneReader({"scene": config.model_dump(mode="json")}) as reader:
        (pid,) = children_of(os.getpid()) - before
        reader.scene(config)
        os.kill(pid, signal.SIGKILL)
        assert make_model(settings_in(config), reader=reader).scene.name == "room"


def test_a_scene_that_nobody_waits_for_is_given_up():
    before = children_of(os.getpid())
    with SceneReader({"scene": "apartment"}):
        (pid,) = children_of(os.getpid()) - before
    assert pid not in children_of(os.getpid())


def test_the_kind_of_a_scene_without_one_is_that_of_its_keys(tmp_path):
    assert ns.load_config({"scene": {"file": str(tmp_path / "a.glb")}}).scene.kind == "mesh"
    assert ns.load_config({"scene": {"seed": 3}}).scene.kind == "apartment"
