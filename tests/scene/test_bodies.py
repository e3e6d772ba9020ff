"""Moving bodies: where they are, against SciPy and closed forms; what their shapes are; what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
import warp as wp
from PIL import Image
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from neurosim_core.config import ConfigError, load_config, to_yaml
from neurosim_core.scene.bodies import (
    BodyConfig,
    MotionConfig,
    OrbitConfig,
    SwayConfig,
    body_poses,
    bounding_points,
    make_bodies,
    make_body_poses,
    pose_bodies,
    upload_motions,
)
from neurosim_core.scene.body_shapes import (
    BoxShape,
    CheckerSurface,
    CylinderShape,
    MeshShape,
    PictureSurface,
    PlainSurface,
    SphereShape,
    make_solid,
)
from neurosim_core.scene.source import SceneError

EVERYTHING = MotionConfig(
    position_m=(1.0, -2.0, 3.0),
    rpy_rad=(0.3, -0.4, 2.0),
    velocity_m_s=(0.1, 0.0, -0.2),
    sway=SwayConfig(amplitude_m=(0.2, 0.5, -0.1), frequency_hz=0.7, phase_rad=0.4),
    orbit=OrbitConfig(radius_m=1.5, rate_hz=-0.3, axis=(1.0, 2.0, -2.0), phase_rad=-1.0),
    spin_rad_s=(1.0, -2.0, 5.0),
)


def bodies(*motions: MotionConfig) -> dict[str, BodyConfig]:
    return {f"body{k}": BodyConfig(motion=motion) for k, motion in enumerate(motions)}


def oracle(motion: MotionConfig, t: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Position and orientation at times [s], by SciPy."""
    p = np.array(motion.position_m) + t[:, None] * np.array(motion.velocity_m_s)
    if motion.sway is not None:
        phase = 2.0 * np.pi * motion.sway.frequency_hz * t + motion.sway.phase_rad
        p = p + np.sin(phase)[:, None] * np.array(motion.sway.amplitude_m)
    if motion.orbit is not None:
        normal = np.array(motion.orbit.axis) / np.linalg.norm(motion.orbit.axis)
        start = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) <= math.cos(0.5) else np.array([0.0, 1.0, 0.0])
        start = np.cross(np.cross(normal, start), normal)  # its part in the plane of the circle
        start *= motion.orbit.radius_m / np.linalg.norm(start)
        angle = 2.0 * np.pi * motion.orbit.rate_hz * t + motion.orbit.phase_rad
        p = p + Rotation.from_rotvec(angle[:, None] * normal).apply(start)
    rest = Rotation.from_euler("ZYX", motion.rpy_rad[::-1])
    return p, rest * Rotation.from_rotvec(t[:, None] * np.array(motion.spin_rad_s))


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, 2.0, -2.0), (-3.0, 0.1, 0.0)])
def test_poses_against_scipy(axis):
    orbit = EVERYTHING.orbit.model_copy(update={"axis": axis})
    motion = EVERYTHING.model_copy(update={"orbit": orbit})
    stamps_ns = np.random.default_rng(0).integers(0, 100 * 10**9, size=500)
    p, q = body_poses(bodies(MotionConfig(), motion), stamps_ns)
    expected_p, expected_R = oracle(motion, 1e-9 * stamps_ns)
    assert p.shape == (500, 2, 3)
    assert q.shape == (500, 2, 4)
    # 1e-16 of 550 rad at 100 s, a few times: 5e-13
    np.testing.assert_allclose(p[:, 1], expected_p, rtol=0.0, atol=1e-12)
    assert (Rotation.from_quat(q[:, 1]) * expected_R.inv()).magnitude().max() < 1e-12
    np.testing.assert_array_equal(p[:, 0], 0.0)
    np.testing.assert_array_equal(q[:, 0], np.broadcast_to([0.0, 0.0, 0.0, 1.0], (500, 4)))


def test_spin_is_an_angular_velocity_in_the_body():
    """Integrating dq/dt = q (w, 0) / 2 with w = spin_rad_s gives the orientation."""
    motion = MotionConfig(rpy_rad=(0.3, -0.4, 2.0), spin_rad_s=(1.0, -2.0, 5.0))

    def rate(_, q):
        x, y, z, w = q
        return 0.5 * np.array([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]]) @ motion.spin_rad_s

    start = body_poses(bodies(motion), [0])[1][0, 0]
    end = solve_ivp(rate, (0.0, 1.7), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(body_poses(bodies(motion), [1_700_000_000])[1][0, 0], end, atol=1e-10)


def test_orbit_is_right_handed_from_the_projected_x_axis():
    orbit = OrbitConfig(radius_m=2.0, rate_hz=0.25)
    p, _ = body_poses(bodies(MotionConfig(position_m=(0.0, 0.0, 1.0), orbit=orbit)), [0, 10**9, 2 * 10**9])
    np.testing.assert_allclose(p[:, 0], [[2.0, 0.0, 1.0], [0.0, 2.0, 1.0], [-2.0, 0.0, 1.0]], atol=1e-15)


def test_device_reads_stamps_where_it_is_told(device):
    """Slots choose rows; what is beyond `count` is left alone."""
    settings = bodies(EVERYTHING, MotionConfig(spin_rad_s=(0.0, 0.0, 1e-7)), EVERYTHING)
    stamps = np.arange(6, dtype=np.int64).reshape(6, 1) * 234_567_891
    poses = make_body_poses(4, 3, device)
    poses.p_WO.fill_(-7.0)
    pose_bodies(
        upload_motions(settings, device),
        wp.array(stamps, dtype=wp.int64, device=device),
        wp.array([5, 0, 3, 1], dtype=int, device=device),
        count=3,
        poses=poses,
    )
    p, q = body_poses(settings, stamps[[5, 0, 3], 0])
    np.testing.assert_allclose(poses.p_WO.numpy()[:3], p, atol=1e-14)  # CUDA may fuse a product and a sum
    np.testing.assert_allclose(poses.q_WO.numpy()[:3], q, atol=1e-14)
    np.testing.assert_array_equal(poses.p_WO.numpy()[3], -7.0)


def test_poses_of_nothing_and_of_no_instant():
    assert [a.shape for a in body_poses({}, [1, 2])] == [(2, 0, 3), (2, 0, 4)]
    assert [a.shape for a in body_poses(bodies(EVERYTHING), [])] == [(0, 1, 3), (0, 1, 4)]
    assert bounding_points([]).shape == (0, 8, 3)
    with pytest.raises(TypeError, match="stamps_ns must be integers, got float64"):
        body_poses(bodies(EVERYTHING), [0.5])


@pytest.mark.parametrize(
    ("shape", "volume_m3", "extent_m", "loss"),
    [
        (BoxShape(size_m=(0.2, 0.4, 0.8)), 0.064, (0.2, 0.4, 0.8), 1e-6),
        # inscribed polyhedra of 128 sides: an area falls short by 2 pi^2 / (3 128^2) = 4e-4
        (SphereShape(radius_m=0.3), 4.0 / 3.0 * math.pi * 0.027, (0.6, 0.6, 0.6), 2e-3),
        (CylinderShape(radius_m=0.1, length_m=0.5), math.pi * 0.005, (0.2, 0.2, 0.5), 5e-4),
    ],
)
@pytest.mark.parametrize("surface", [None, PlainSurface(), CheckerSurface(square_m=0.1)])
def test_solids_are_closed_and_face_outwards(shape, volume_m3, extent_m, loss, surface):
    solid = make_solid(shape, surface, name="solid")
    mesh = trimesh.Trimesh(solid.vertices.astype(float), solid.faces)  # merges equal vertices
    assert mesh.is_watertight
    assert volume_m3 * (1.0 - loss) <= mesh.volume <= volume_m3 * (1.0 + 1e-6)
    np.testing.assert_allclose(mesh.extents, extent_m, rtol=1e-6)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0.0, atol=1e-7)
    tips = solid.vertices[solid.faces].astype(float)
    front = np.cross(tips[:, 1] - tips[:, 0], tips[:, 2] - tips[:, 0])
    front /= np.linalg.norm(front, axis=1, keepdims=True)
    assert np.einsum("fc,fkc->fk", front, solid.normals[solid.faces]).min() > 0.99
    assert (solid.materials[0].texture is not None) == isinstance(surface, CheckerSurface)


def test_checker_has_squares_of_the_width_asked_for():
    """Across a face of 0.4 m lie 4 squares of 0.1 m; around a sphere a whole number of pairs."""
    surface = CheckerSurface(square_m=0.1, color=(1.0, 0.0, 0.0), other_color=(0.0, 0.0, 1.0))
    solid = make_solid(BoxShape(size_m=(0.4, 0.4, 0.4)), surface, name="crate")
    np.testing.assert_allclose(np.ptp(solid.uv, axis=0), [2.0, 2.0])  # a repeat is two squares
    texels = solid.materials[0].texture.srgb
    size = len(texels)
    assert texels[-1, 0].tolist() == [255, 0, 0]  # u = v = 0, the corner of a face
    assert texels[-1, size // 2].tolist() == texels[0, 0].tolist() == [0, 0, 255]
    assert texels[size // 2 - 1, size // 2].tolist() == [255, 0, 0]
    assert (texels[..., 0] == 255).mean() == 0.5
    ball = make_solid(SphereShape(radius_m=0.3), surface, name="ball")
    assert np.ptp(ball.uv[:, 0]) == round(2.0 * math.pi * 0.3 / 0.2)


def test_picture_keeps_its_proportions_and_stands_upright(tmp_path):
    picture = np.zeros((20, 40, 3), np.uint8)
    picture[:10] = 200  # the upper half is bright
    Image.fromarray(picture).save(tmp_path / "sign.png")
    surface = PictureSurface(file=tmp_path / "sign.png", width_m=0.4)
    solid = make_solid(BoxShape(size_m=(0.4, 0.4, 0.2)), surface, name="sign")
    side = np.abs(solid.normals[:, 2]) < 0.5
    np.testing.assert_allclose(solid.uv[side], np.clip(solid.uv[side], 0.0, 1.0), atol=1e-6)  # once each
    assert ((solid.uv[side, 1] > 0.5) == (solid.vertices[side, 2] > 0.0)).all()  # v = 1 is the top
    assert solid.materials[0].texture.srgb[0, 0, 0] == 200
    with pytest.raises(SceneError, match=r"none.png: the picture of 'sign' cannot be read"):
        make_solid(BoxShape(), PictureSurface(file=tmp_path / "none.png"), name="sign")


def test_mesh_file(tmp_path):
    """In file units, turned and moved to the frame of the body, with the colour of the file or another."""
    mesh = trimesh.creation.box(extents=[100.0, 200.0, 300.0])
    mesh.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(baseColorFactor=[1.0, 0.0, 0.0, 1.0])
    )
    mesh.export(tmp_path / "brick.glb")
    shape = MeshShape(file=tmp_path / "brick.glb", unit_m=0.001, up_axis="y", offset_m=(1.0, 0.0, 0.0))
    brick, painted = make_bodies(
        {"brick": BodyConfig(shape=shape), "painted": BodyConfig(shape=shape, surface=PlainSurface())}
    )
    corners = bounding_points([brick, painted])
    assert corners.shape == (2, 8, 3)
    assert len(np.unique(corners[0], axis=0)) == 8
    np.testing.assert_allclose(corners[1].min(axis=0), [0.95, -0.15, -0.1], atol=1e-7)
    np.testing.assert_allclose(corners[1].max(axis=0), [1.05, 0.15, 0.1], atol=1e-7)
    np.testing.assert_allclose(brick.center_m, [1.0, 0.0, 0.0], atol=1e-7)
    assert brick.radius_m == pytest.approx(math.sqrt(0.05**2 + 0.15**2 + 0.1**2))
    assert brick.solid.materials[brick.solid.face_material[0]].base_color == (1.0, 0.0, 0.0)
    assert [note.split(":")[0] for note in brick.solid.notes[:2]] == ["Unit", "Up axis"]  # none on lights
    assert not any("light" in note for note in brick.solid.notes)
    assert painted.solid.materials[painted.solid.face_material[0]].base_color == (0.6, 0.6, 0.6)
    with pytest.raises(SceneError, match="body 'brick': a mesh wears the surface of its file"):
        make_bodies({"brick": BodyConfig(shape=shape, surface=CheckerSurface())})
    with pytest.raises(SceneError, match="no such file"):
        make_bodies({"lost": BodyConfig(shape=MeshShape(file=tmp_path / "lost.glb"))})


def test_settings_file(tmp_path):
    """Files are looked up beside the settings; what is printed reads back the same."""
    (tmp_path / "world.yaml").write_text(
        """
        bodies:
          sign:
            shape: {kind: box, size_m: [0.02, 0.4, 0.3]}
            surface: {kind: picture, file: sign.png}
            motion: {position_m: [1, 0, 1.5], sway: {amplitude_m: [0, 1, 0]}, spin_rad_s: [0, 0, 1]}
          chair:
            shape: {kind: mesh, file: meshes/chair.glb}
          crate:
            shape: {kind: mesh, file: /meshes/crate.glb}
        """
    )
    config = load_config(tmp_path / "world.yaml")
    assert config.bodies["sign"].surface.file == tmp_path / "sign.png"
    assert config.bodies["chair"].shape.file == tmp_path / "meshes" / "chair.glb"
    assert str(config.bodies["crate"].shape.file) == "/meshes/crate.glb"
    assert config.bodies["sign"].motion.sway.frequency_hz == 0.5
    (tmp_path / "again.yaml").write_text(to_yaml(config, comments=True))
    assert load_config(tmp_path / "again.yaml") == config
    assert load_config({}).bodies == {}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"shape": {"kind": "cone"}}, "bodies.ball.shape.kind: must be one of 'box', 'sphere', 'cylinder'"),
        (
            {"shape": {"kind": "sphere", "radius_m": -1.0}},
            "bodies.ball.shape.radius_m: Input should be great",
        ),
        ({"motion": {"orbit": {"axis": [0, 0, 0]}}}, "bodies.ball.motion.orbit.axis: must not be zero"),
        ({"motion": {"swai": {}}}, "bodies.ball.motion.swai: unknown key; did you mean 'sway'"),
        ({"surface": {"kind": "plain", "color": [2, 0, 0]}}, "bodies.ball.surface.color.0: Input should be"),
    ],
)
def test_wrong_settings_say_where(wrong, message):
    with pytest.raises(ConfigError, match=message):
        load_config({"bodies": {"ball": wrong}})
