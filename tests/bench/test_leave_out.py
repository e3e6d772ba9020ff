"""What is left out, counted in fresh processes; and that the counting counts."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from neurosim_core.bench.leave_out import (
    dynamics_differences,
    imu_difference,
    leave_out_chapter,
    measure_leave_out,
    pixel_difference,
    radiance_difference,
    run_probe,
)
from neurosim_core.bench.leave_out_cases import make_cases, plain_room, textured_room
from neurosim_core.bench.report import write_report
from neurosim_core.scene.mesh import MeshSceneConfig, load_mesh_scene
from neurosim_core.vehicle.multirotor import TERMS


@pytest.fixture(scope="module")
def result():
    return measure_leave_out(quick=True)


def test_an_imu_alone_allocates_no_image(result):
    imu, events = result.probes["imu"], result.probes["events"]
    assert (imu.picture_count, imu.picture_bytes, imu.texture_bytes) == (0, 0, 0)
    assert events.picture_bytes > 4 * 47 * 61  # the count sees them where they are
    assert events.texture_bytes > 1_000_000
    assert imu.terms.keys() == {"dynamics", "imu"}


def test_an_imu_alone_imports_no_library_for_scenes(result):
    for name in ("imu", "imu-file"):
        imu = result.probes[name]
        assert imu.libraries == ["scipy"]
        assert not imu.embree
        assert not [name for name in imu.kernels if "raycast" in name or "scan" in name]
    assert "PIL" in result.probes["all-file"].libraries  # to look at the same file
    assert result.probes["all-file"].texture_bytes == 64 * 64 * 3


@pytest.mark.parametrize(
    ("case", "change", "index"),
    [
        ("imu-file", {"libraries": ["scipy", "PIL"]}, 1),
        ("imu", {"embree": True}, 1),
        ("all-file", {"libraries": ["scipy"], "embree": False}, 1),  # a scene that takes none shows nothing
        ("imu-file", {"texture_bytes": 12}, 0),
        ("events", {"terms": {"events": ["rgb"]}}, 2),
        ("events-plain", {"shader_functions": ["sample_texture"]}, 3),
        ("events", {"shader_functions": []}, 3),
    ],
)
def test_bars_can_be_missed(result, case, change, index):
    probes = {**result.probes, case: dataclasses.replace(result.probes[case], **change)}
    bars = leave_out_chapter(dataclasses.replace(result, probes=probes)).bars
    assert [bar.met for bar in bars] == [k != index for k in range(5)]


def test_unequal_kernels_are_missed(result):
    off = dataclasses.replace(result.differences[0], largest=2e-12)
    bars = leave_out_chapter(dataclasses.replace(result, differences=(*result.differences, off))).bars
    assert [bar.met for bar in bars] == [True, True, True, True, False]


def test_events_alone_compute_no_rgb(result):
    for name in ("events", "events-plain"):
        probe = result.probes[name]
        assert "_to_srgb" not in probe.shader_functions
        assert not [term for terms in probe.terms.values() for term in terms if term in ("rgb", "depth")]
    assert "_to_srgb" in result.probes["all"].shader_functions


def test_a_scene_without_textures_compiles_no_sampler(result):
    samplers = {
        "sample_texture",
        "sample_finest",
        "sample_nearest",
        "shade_textured_packet",
        "see_textured_packet",
    }
    assert not samplers & set(result.probes["events-plain"].shader_functions)
    assert samplers & set(result.probes["events"].shader_functions)  # which: with Embree or not
    assert result.probes["events-plain"].texture_bytes == 0


def test_everything_is_everything(result):
    probe = result.probes["all"]
    assert probe.terms["dynamics"] == list(TERMS)
    assert set(probe.terms["events, rgb, depth"]) >= {"log_radiance", "rgb", "depth", "textured", "bodies"}
    for name in ("imu", "events-plain", "events"):
        assert result.probes[name].launches_per_s < probe.launches_per_s
        assert result.probes[name].array_bytes < probe.array_bytes


def test_reduced_kernels_equal_full_ones():
    """1e-12 in float64; a vehicle that is tossed about for a second."""
    for difference in (*dynamics_differences(), imu_difference()):
        assert difference.largest <= 1e-12, difference
    assert radiance_difference().largest == 0.0
    pixels = pixel_difference()
    assert pixels.largest == 0.0
    assert "spread, low_pass, refractory, leak, spontaneous" in pixels.full


def test_bars_and_files(result, tmp_path):
    chapter = leave_out_chapter(result)
    assert [bar.met for bar in chapter.bars] == [True] * 5
    write_report([chapter], tmp_path)
    tables = ("leave-out", "leave-out-terms", "leave-out-libraries", "leave-out-differences")
    names = {f"{name}.csv" for name in tables} | {"leave-out.png", "report.md", "report.html"}
    assert {p.name for p in tmp_path.iterdir()} == names


def test_a_broken_run_says_why():
    with pytest.raises(RuntimeError, match=r"(?s)status 1: .*sensors.imu.kind: must be one of"):
        run_probe({"sensors": {"imu": {"kind": "sextant"}}}, seconds=0.1)


def test_the_room_is_closed_and_plain(tmp_path):
    file = tmp_path / "room.gltf"
    file.write_text(plain_room())
    scene = load_mesh_scene(MeshSceneConfig(file=file))
    np.testing.assert_allclose(scene.bounds_m, [[-4.0, -3.0, 0.0], [4.0, 3.0, 3.0]], atol=1e-6)
    tips = scene.vertices[scene.faces].astype(float)
    area = 0.5 * np.linalg.norm(np.cross(tips[:, 1] - tips[:, 0], tips[:, 2] - tips[:, 0]), axis=1).sum()
    assert area == pytest.approx(2 * (8 * 6 + 8 * 3 + 6 * 3), rel=1e-5)
    assert all(material.texture is None for material in scene.materials)
    file.write_text(textured_room())
    textured = load_mesh_scene(MeshSceneConfig(file=file))
    np.testing.assert_array_equal(textured.vertices[textured.faces], scene.vertices[scene.faces])
    corner = textured.uv[textured.faces].astype(float)
    edge = corner[:, 1:] - corner[:, :1]
    assert np.abs(np.linalg.det(edge)).min() > 1.0  # no wall has a smeared picture
    assert np.unique(textured.materials[0].texture.srgb).tolist() == [95, 255]


def test_the_full_set_of_cases(tmp_path):
    cases = {case.name: case for case in make_cases(tmp_path / "a.gltf", tmp_path / "b.gltf", quick=False)}
    names = ["imu", "imu-file", "events-plain", "events", "pictures", "sensors"]
    assert list(cases) == [*names, "all-plain", "all-file", "all"]
    for case in cases.values():
        assert cases[case.full].config["scene"] == case.config["scene"]


COUNTING = """
import json
import warp as wp
from neurosim_core.bench.leave_out_probe import watch
counts = watch({(5, 7)})
from neurosim_core.render.launch import launch_split

@wp.kernel
def fill(first: int, out: wp.array[float]):
    k = first + wp.tid()
    out[k] = 1.0

wp.zeros((2, 5, 7), dtype=float, device="cpu")  # 280 bytes, a picture
wp.zeros(35, dtype=wp.vec2, device="cpu")  # 280 bytes, its pixels in a row
values = wp.zeros(100_000, dtype=float, device="cpu")
values[10:20]  # a view
before = counts.allocation_count, counts.allocated_bytes
launch_split(fill, dim=100_000, inputs=[], outputs=[values], device="cpu", thread_count=3)
command = wp.launch(fill, dim=10, inputs=[0], outputs=[values], device="cpu", record_cmd=True)
command.launch()
command.launch()
print(json.dumps([before, counts.picture_count, counts.picture_bytes, sum(counts.launches.values()),
                  float(values.numpy().sum())]))
"""


def test_the_counts_are_what_happens(tmp_path):
    script = tmp_path / "counting.py"
    script.write_text(COUNTING)
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    allocations, pictures, picture_bytes, launches, total = json.loads(done.stdout.splitlines()[-1])
    assert allocations == [3, 280 + 280 + 400_000]
    assert (pictures, picture_bytes) == (2, 560)
    assert launches == 1 + 2  # slices are one launch; recording is none
    assert total == 100_000.0
