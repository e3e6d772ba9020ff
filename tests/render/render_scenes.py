"""Small scenes and a one-line renderer for the tests of this directory."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
import warp as wp
from core_counts import cores

from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import LightingConfig, RenderConfig
from neurosim_core.render.scene_arrays import SceneArrays, upload_scene
from neurosim_core.render.warp_renderer import WarpRenderer
from neurosim_core.scene.scene import Ambient, Light, Material, Scene, Texture

UNSHADOWED = RenderConfig(lighting=LightingConfig(mode="unshadowed"), exposure=1.0, samples_per_pixel=1)
"""Rays through the centres of pixels, without shadows."""
DARK = Ambient(up=(0.0, 0.0, 0.0), down=(0.0, 0.0, 0.0))
LOOK_DOWN = (1.0, 0.0, 0.0, 0.0)
"""q_WC of a camera that looks along -z with +x to its right: its y axis (down in the picture) is -y."""
LUMA = np.array([0.2126, 0.7152, 0.0722])


def scene_of(
    *parts: trimesh.Trimesh,
    materials: tuple[Material, ...] = (Material(name="white", base_color=(1.0, 1.0, 1.0)),),
    part_material: tuple[int, ...] | None = None,
    uv: np.ndarray | None = None,
    smooth: bool = False,
    **scene: Any,
) -> Scene:
    """Return a scene of meshes, each one instance, flat-shaded unless `smooth`."""
    vertices, faces, normals, material, instance = [], [], [], [], []
    offset = 0
    for index, part in enumerate(parts):
        if smooth:
            v, f, n = part.vertices, part.faces, part.vertex_normals
        else:
            v = part.triangles.reshape(-1, 3)
            f = np.arange(len(v)).reshape(-1, 3)
            n = np.repeat(part.face_normals, 3, axis=0)
        vertices.append(v)
        normals.append(n)
        faces.append(f + offset)
        offset += len(v)
        material.append(np.full(len(f), part_material[index] if part_material else 0))
        instance.append(np.full(len(f), index))
    points = np.concatenate(vertices).astype(np.float32)
    return Scene(
        name="test",
        vertices=points,
        faces=np.concatenate(faces).astype(np.int32),
        normals=np.concatenate(normals).astype(np.float32),
        uv=np.zeros((len(points), 2), np.float32) if uv is None else uv.astype(np.float32),
        face_material=np.concatenate(material).astype(np.int32),
        face_instance=np.concatenate(instance).astype(np.int32),
        instance_names=tuple(f"part {k}" for k in range(len(parts))),
        materials=materials,
        **scene,
    )


def plane(size_m: float, z_m: float = 0.0, *, flipped: bool = False) -> trimesh.Trimesh:
    """Return a square of two triangles about the z axis that faces up, or down if flipped."""
    h = 0.5 * size_m
    corners = [[-h, -h, z_m], [h, -h, z_m], [h, h, z_m], [-h, h, z_m]]
    faces = [[0, 2, 1], [0, 3, 2]] if flipped else [[0, 1, 2], [0, 2, 3]]
    return trimesh.Trimesh(corners, faces, process=False)


def box(extents: tuple[float, float, float], centre: tuple[float, float, float]) -> trimesh.Trimesh:
    return trimesh.creation.box(extents, trimesh.transformations.translation_matrix(centre))


def checkerboard(squares: int, texels_per_square: int = 1) -> Texture:
    rows, cols = np.indices((squares * texels_per_square,) * 2) // texels_per_square
    grey = np.where((rows + cols) % 2 == 0, 255, 0).astype(np.uint8)
    return Texture(name="checkerboard", srgb=np.repeat(grey[..., None], 3, axis=2))


def textured_plane(texture: Texture, *, size_m: float, repeats: float = 1.0) -> Scene:
    """Return a square at z = 0 whose texture repeats in each direction, u along x, v along y."""
    part = plane(size_m)
    corners = part.triangles.reshape(-1, 3)
    uv = (corners[:, :2] / size_m + 0.5) * repeats
    return scene_of(
        part,
        materials=(Material(name="m", base_color=(1.0, 1.0, 1.0), texture=texture),),
        uv=uv,
        ambient=Ambient(up=(1.0, 1.0, 1.0), down=(1.0, 1.0, 1.0)),
    )


def render(
    scene: Scene | SceneArrays,
    lens: PinholeConfig,
    poses: list[tuple[tuple[float, ...], tuple[float, ...]]],
    *,
    outputs: tuple[str, ...],
    config: RenderConfig = UNSHADOWED,
    device: str = "cpu",
    slots: list[int] | None = None,
    thread_count: int | None = None,
    launches: int = 1,
) -> dict[str, np.ndarray]:
    """Render poses (p_WC, q_WC) and return the outputs; `launches` repeats the launch."""
    arrays = scene if isinstance(scene, SceneArrays) else upload_scene(scene, config, device)
    count = len(poses)
    renderer = WarpRenderer(arrays, lens, outputs=outputs, instant_count=count, image_count=count)
    position = wp.array(np.array([p for p, _ in poses], np.float32), dtype=wp.vec3, device=device)
    orientation = wp.array(np.array([q for _, q in poses], np.float32), dtype=wp.quat, device=device)
    slot = wp.array(np.array(slots or range(len(poses)), np.int32), dtype=int, device=device)
    with cores(thread_count):
        for _ in range(launches):
            renderer.render(position, orientation, slot, instant_count=count)
    return {name: getattr(renderer, name).numpy().copy() for name in outputs}


def point_light(position: tuple[float, float, float], intensity: float) -> Light:
    return Light(position_m=position, intensity=(intensity,) * 3)
