"""Classes of what pixels see: by names, by what the file says, by patterns; in recordings and messages."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from small_room import fly_in_room

import neurosim_core as ns
from neurosim_core.live.messages import to_message, to_packet
from neurosim_core.record.hdf5 import RecordingWriter
from neurosim_core.record.header import RecordingHeader
from neurosim_core.record.recording import Recording
from neurosim_core.sensors.instance import LabelImage

LENS = {"width": 64, "height": 48, "horizontal_fov_rad": 1.4}
CAMERA = {"lens": LENS, "mount": {"position_m": [0, 0, 0]}, "rate_hz": 20}


def write_scene(path, extras=None):
    """A room, and three boards in a row before the wall x = 3: Chair.001, chair_2 and X."""
    scene = trimesh.Scene()
    walls = trimesh.creation.box(extents=(6.0, 4.0, 3.0))
    walls.invert()
    walls.apply_translation([0.0, 0.0, 1.5])
    scene.add_geometry(walls, node_name="Walls 12")
    for name, y in (("Chair.001", 1.0), ("chair_2", 0.0), ("X", -1.0)):
        board = trimesh.creation.box(extents=[0.02, 0.8, 0.8])
        board.apply_translation([2.5, y, 1.5])
        scene.add_geometry(board, node_name=name, geom_name=name)
    tree = json.loads(scene.export(file_type="gltf")["model.gltf"])
    for node in tree["nodes"]:
        if node.get("name") in (extras or {}):
            node["extras"] = extras[node["name"]]
    files = scene.export(file_type="gltf")
    files["model.gltf"] = json.dumps(tree).encode()
    for name, data in files.items():
        (path / name).write_bytes(data)
    return path / "model.gltf"


def labels_of(packet):
    meaning = json.loads(packet.labels)
    seen = {}
    for name, column in (("Chair.001", 20), ("chair_2", 32), ("X", 44), ("Walls 12", 2)):
        seen[name] = meaning["classes"][packet.data[24, column]]
    return seen


@pytest.mark.parametrize(
    ("extras", "classes", "expected"),
    [
        ({}, None, ("chair", "chair", "x", "walls")),
        ({"X": {"semantic": "Table"}, "chair_2": {"other": 1}}, None, ("chair", "chair", "Table", "walls")),
        (
            {"X": {"semantic": "Table"}},
            {"furniture": ["chair*", "table"], "wall": ["*wall*"]},
            ("furniture", "furniture", "furniture", "wall"),
        ),
        ({}, {"seat": ["chair_?"]}, ("unlabelled", "seat", "unlabelled", "unlabelled")),
    ],
)
def test_classes_come_from_patterns_or_the_file_or_names(tmp_path, extras, classes, expected):
    scene = write_scene(tmp_path, extras)
    sensors = {"semantic": {"kind": "semantic", "classes": classes, **CAMERA}}
    first = fly_in_room(scene, sensors)[0]
    assert tuple(labels_of(first).values()) == expected
    assert first.data.dtype == np.int32


def test_a_pattern_of_nothing_is_said_with_the_names_there_are(tmp_path, caplog):
    """An event camera tells which class an event is of, by the same patterns."""
    classes = {"seat": ["chair*", "sofa_*"], "walls": ["walls"]}
    events = {"kind": "event_camera", "lens": LENS, "labels": ["semantic"], "classes": classes}
    sensors = {"camera": {"kind": "semantic", "classes": classes, **CAMERA}, "events": events}
    fly_in_room(write_scene(tmp_path), sensors)
    said = "nothing is called 'sofa_*', as class 'seat' says; there are: chair, walls, x"
    assert sorted(caplog.messages) == [f"sensor camera: {said}", f"sensor events: {said}"]


def test_instances_say_their_names_and_classes(tmp_path):
    bodies = {"ball_1": {"shape": {"kind": "sphere", "radius_m": 0.2}, "motion": {"position_m": [1, 0, 1.5]}}}
    sensors = {"instance": {"kind": "instance", **CAMERA}, "semantic": {"kind": "semantic", **CAMERA}}
    found = {p.sensor: p for p in fly_in_room(write_scene(tmp_path), sensors, bodies=bodies)}
    meaning = json.loads(found["instance"].labels)
    name, number = meaning["instances"][found["instance"].data[24, 32]]
    assert (name, meaning["classes"][number]) == ("ball_1", "ball")
    classes = np.array([number for _, number in meaning["instances"]])
    np.testing.assert_array_equal(classes[found["instance"].data], found["semantic"].data)


def test_the_apartment_has_labels():
    config = ns.load_config(
        {
            "duration_s": 0.01,
            "device": "cpu",
            "scene": {"kind": "apartment", "rooms": 1},
            "render": {"lighting": {"mode": "unshadowed"}},
            "sensors": {"semantic": {"kind": "semantic", **CAMERA}},
        }
    )
    packet = next(p for p in ns.run(config) if isinstance(p, LabelImage))
    classes = json.loads(packet.labels)["classes"]
    assert {"wall", "floor", "ceiling", "chair", "sofa"} <= set(classes)
    seen = {classes[label] for label in np.unique(packet.data)}
    assert {"wall", "floor"} <= seen


def test_worlds_look_up_the_same_classes(tmp_path):
    settings = {
        "duration_s": 0.1,
        "device": "cpu",
        "scene": {
            "kind": "mesh",
            "file": str(write_scene(tmp_path)),
            "up_axis": "z",
            "inside_m": [0, 0, 1.5],
        },
        "render": {"lighting": {"mode": "unshadowed"}},
        "path": {"kind": "hover", "position_m": [0.0, 0.0, 1.5]},
        "sensors": {"semantic": {"kind": "semantic", **CAMERA}},
    }
    alone = next(p for p in ns.run(settings) if isinstance(p, LabelImage))
    seen = ns.Simulation(settings, worlds=2).reset()
    for world in range(2):
        np.testing.assert_array_equal(seen.images["semantic"].numpy()[world], alone.data)


@pytest.mark.parametrize("count", [3, 20_000])
def test_what_labels_mean_is_kept(tmp_path, count):
    """Also of very many objects, whose names no attribute of HDF5 holds."""
    text = json.dumps({"instances": [[f"chair_{k}", 1] for k in range(count)], "classes": ["", "chair"]})
    packet = LabelImage(data=np.arange(6, dtype=np.int32).reshape(2, 3), labels=text, sensor="labels")
    with RecordingWriter(tmp_path / "a.h5", RecordingHeader(config_yaml="", seed=0, version="0")) as writer:
        writer.write(packet)
    with Recording(tmp_path / "a.h5") as recording:
        (read,) = recording.packets()
    again = to_packet(to_message(packet), "labels")
    for other in (read, again):
        assert (type(other), other.labels, other.encoding) == (LabelImage, text, "32SC1")
        np.testing.assert_array_equal(other.data, packet.data)
