"""The report of a scene: figures, a table of them, and a picture with the plan of its free space."""

from __future__ import annotations

import dataclasses
import itertools
import time
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from rich import box
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation
from trimesh.intersections import slice_faces_plane

from neurosim_core.record.disk import naming_file
from neurosim_core.render.camera import PinholeConfig
from neurosim_core.render.config import LightingConfig, RenderConfig
from neurosim_core.render.renderer import make_renderer, take_picture, upload_scene
from neurosim_core.render.scene_arrays import SceneArrays
from neurosim_core.scene.freespace import FreeSpace, FreeSpaceConfig, make_free_space
from neurosim_core.scene.mesh import MeshSceneConfig, load_mesh_scene
from neurosim_core.scene.scene import Scene

CLEARANCE_M = 0.3
"""Room around its centre that a small multirotor asks for, in the figures and the plan [m]."""

_SIZE = (1600, 900)
_VIEW = (1010, 900)
_PLAN = (550, 760)
_INK, _FAINT, _PAPER = (29, 37, 48), (107, 118, 130), (255, 255, 255)
_FREE = np.array([34.0, 160.0, 110.0])


def figures(scene: Scene, space: FreeSpace | None = None) -> dict[str, str]:
    """Return the figures of a scene as text by their names, and those of its free space if that is given.

    The area is that of all triangles, one side each, the median edge that of their longest edges. Free space
    is what can be reached at `CLEARANCE_M`, to the voxel, and its area is seen from above.
    """
    triangles = scene.vertices[scene.faces].astype(np.float64)
    edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    plain = np.array([material.texture is None for material in scene.materials])[scene.face_material]
    pictures = {id(m.texture): m.texture.srgb for m in scene.materials if m.texture is not None}
    glowing = sum(max(material.emission) > 0.0 for material in scene.materials)
    bare = 100.0 * float(area[plain].sum() / area.sum())
    texels = sum(srgb.shape[0] * srgb.shape[1] for srgb in pictures.values()) / 1e6
    edge_m = float(np.median(edges.max(axis=1)))
    edge = f"{100.0 * edge_m:.1f} cm" if edge_m < 10.0 else f"{edge_m:,.0f} m"
    corners = " to ".join("(" + ", ".join(f"{c:.2f}" for c in corner) + ")" for corner in scene.bounds_m)
    found = {
        "size": " x ".join(f"{length:,.2f}" for length in np.ptp(scene.bounds_m, axis=0)) + " m",
        "corners": f"{corners} m",
        "triangles": f"{len(scene.faces):,}, median edge {edge}",
        "vertices": f"{len(scene.vertices):,}",
        "area": f"{area.sum():,.1f} m²",
        "objects": str(len(np.unique(scene.face_instance))),
        "materials": f"{len(scene.materials)}, {glowing} glow",
        "textures": f"{len(pictures)}, {texels:.1f} million texels"
        + (f"; {bare:.0f} % of the area has none" if bare > 0.0 else ""),
        "lights": str(len(scene.lights)),
    }
    if space is not None:
        reachable = space.reachable(CLEARANCE_M)
        volume_m3 = float(reachable.sum() * space.voxel_m**3)
        floor_m2 = float(reachable.any(axis=2).sum() * space.voxel_m**2)
        widest_m = float(space.distance[reachable].max(initial=0.0))
        found["free space"] = f"{volume_m3:,.1f} m³ over {floor_m2:,.1f} m², {CLEARANCE_M:g} m clear"
        found["widest place"] = f"{widest_m:,.2f} m to the nearest surface"
        found["fly at"] = f"z = {flight_height_m(space):.2f} m"
    return found


def flight_height_m(space: FreeSpace) -> float:
    """Return a good height to fly at [m]: the middle of those at which there is about the most room."""
    layers = space.reachable(CLEARANCE_M).sum(axis=(0, 1))
    wide = np.flatnonzero(layers >= 0.95 * layers.max())
    return float(space.origin_m[2] + space.voxel_m * wide[len(wide) // 2])


def report_scene(file: Path | Scene, out: Path | None = None, *, console: Console | None = None) -> None:
    """Say on a console (None: standard output) what is in a scene, of a file or loaded already, and draw it.

    The picture goes to `out`; None: the scene's name with .png, in the working directory.

    Raises:
        SceneError: The file cannot be used.
        OSError: The picture cannot be written.
        ValueError: `out` is no name of a picture.
    """
    if out is not None and out.suffix.lower() not in Image.registered_extensions():
        raise ValueError(f"{out}: the scene is drawn into a picture: {out.stem}.png")
    console = console or Console()
    start = time.perf_counter()
    scene = file if isinstance(file, Scene) else load_mesh_scene(MeshSceneConfig(file=file))
    loaded_s = time.perf_counter() - start
    space: FreeSpace | None = None
    notes = list(scene.notes)
    more = {}
    try:
        space = make_free_space(scene, FreeSpaceConfig(), device="cpu")
        notes += space.notes
        if not space.reachable(CLEARANCE_M).any():
            space = None
    except ValueError as error:  # a sheet, or something smaller than a voxel
        notes.append(f"There is no room to fly in: {error}.")
    if space is None:
        more["free space"] = f"none with {CLEARANCE_M:g} m clear"
    table = Table(title=scene.name, title_justify="left", box=box.SIMPLE, show_header=False)
    table.add_column(style="bold")
    for name, value in (figures(scene, space) | more).items():
        table.add_row(name, value)
    console.print(table)
    if not isinstance(file, Scene):
        notes.append(f"Loaded in {loaded_s:.2f} s.")
    out = Path(f"{scene.name}.png") if out is None else out
    with naming_file(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        scene_picture(scene, space).save(out)
    for note in (*notes, f"Picture: {out}"):
        console.print(f"- {note}", markup=False, highlight=False, soft_wrap=True)


def scene_picture(scene: Scene, space: FreeSpace | None) -> Image.Image:
    """Draw a scene, cut open at about eye height, from above, with the plan of its free space if it has any.

    Returns:
        An RGB picture of 1600 x 900 px.
    """
    low, high = scene.bounds_m[:, 2]
    fly_m = high if space is None else flight_height_m(space)
    edge_max_m = max(0.3, float(np.ptp(scene.bounds_m, axis=0).max()) / 60.0)
    lighting = LightingConfig(edge_max_m=edge_max_m, ambient_ray_count=12)
    # under the ceiling of the storey that one flies in, over most furniture; things are whole
    cut_m = min(max(fly_m + 0.5, low + 0.5 * (high - low)), high - 0.15 * (high - low))
    opened = cut_open(scene, high if high - low < 1.8 else cut_m)
    arrays = upload_scene(opened, RenderConfig(samples_per_pixel=4, lighting=lighting), device="cpu")
    arrays.data.sky = wp.vec3(1.0 / arrays.exposure)  # white paper
    picture = Image.new("RGB", _SIZE, _PAPER)
    picture.paste(Image.fromarray(_look(arrays, *_view_from_above(opened.bounds_m), _VIEW)), (0, 0))

    plan, scale, origin = _draw_plan(arrays, space, fly_m, opened.bounds_m)
    left, top = _VIEW[0] + 20, 70
    picture.paste(plan, (left, top))
    draw = ImageDraw.Draw(picture)
    draw.text((left, 22), scene.name, font=ImageFont.load_default(size=30), fill=_INK)
    bottom = top + plan.height
    for light in scene.lights:
        x = left + (light.position_m[0] - origin[0]) * scale
        y = bottom - (light.position_m[1] - origin[1]) * scale
        if left < x < left + plan.width and top < y < bottom:
            draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=(255, 210, 60), outline=_INK)
    bar_m = float(10.0 ** np.floor(np.log10(150.0 / scale)))
    bar_m *= next(k for k in (5.0, 2.0, 1.0) if k * bar_m * scale <= 160.0)
    draw.line((left, bottom + 14, left + bar_m * scale, bottom + 14), fill=_INK, width=3)
    caption = f"{bar_m:g} m"
    if space is not None:
        caption += f"      green: free at z = {fly_m:.1f} m, {CLEARANCE_M:g} m clear"
    draw.text((left, bottom + 20), caption, font=ImageFont.load_default(size=17), fill=_FAINT)
    return picture


def cut_open(scene: Scene, height_m: float) -> Scene:
    """Return the scene without what is above a height z [m]; triangles that cross it are cut.

    Raises:
        ValueError: If nothing is below the height.
    """
    corner, face = scene.faces.ravel(), np.arange(len(scene.faces))
    more = np.column_stack([scene.normals[corner], scene.uv[corner], face.repeat(3)])  # of corners
    vertices, faces, more = slice_faces_plane(
        scene.vertices[corner].astype(np.float64),
        np.arange(len(corner)).reshape(-1, 3),
        plane_normal=[0.0, 0.0, -1.0],
        plane_origin=[0.0, 0.0, height_m],
        uv=more,
    )
    if not len(faces):
        raise ValueError(f"nothing of scene {scene.name!r} is below {height_m} m")
    length = np.linalg.norm(more[:, :3], axis=1, keepdims=True)
    face = np.rint(more[faces[:, 0], 5]).astype(np.int64)
    return dataclasses.replace(
        scene,
        vertices=vertices.astype(np.float32),
        normals=(more[:, :3] / np.where(length > 0.0, length, 1.0)).astype(np.float32),
        uv=more[:, 3:5].astype(np.float32),
        faces=faces.astype(np.int32),
        face_material=scene.face_material[face],
        face_instance=scene.face_instance[face],
    )


def _pose(eye: NDArray[np.float64], forward: NDArray[np.float64], up: NDArray[np.float64]) -> Any:
    """Return p_WC and q_WC of a camera that looks along `forward`."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    R_WC = np.stack([right, np.cross(forward, right), forward], axis=1)
    return eye, Rotation.from_matrix(R_WC).as_quat()


def _view_from_above(bounds: NDArray[np.float64]) -> tuple[Any, float]:
    """Return the pose and the horizontal field of view [rad] of a camera that sees all of the scene."""
    fov_rad = 0.7
    forward = np.array([0.28, 0.55, -0.79])
    forward /= np.linalg.norm(forward)
    _, q_WC = _pose(np.zeros(3), forward, np.array([0.0, 0.0, 1.0]))
    corners = np.array(list(itertools.product(*bounds.T)))
    in_C = Rotation.from_quat(q_WC).inv().apply(corners - corners.mean(axis=0))
    half = np.tan(0.5 * fov_rad) * np.array([1.0, _VIEW[1] / _VIEW[0]]) * 0.94
    # |p + shift| <= half (z + distance) for all corners: least distance, axis by axis
    high = np.array([np.max(in_C[:, a] - half[a] * in_C[:, 2]) for a in (0, 1)])
    low = np.array([np.max(-in_C[:, a] - half[a] * in_C[:, 2]) for a in (0, 1)])
    distance = float(np.max((high + low) / (2.0 * half)))
    shift = np.array([*(0.5 * (low - high)), distance])
    eye = corners.mean(axis=0) - Rotation.from_quat(q_WC).apply(shift)
    return (eye, q_WC), fov_rad


def _look(arrays: SceneArrays, pose: Any, fov_rad: float, size: tuple[int, int]) -> NDArray[np.uint8]:
    lens = PinholeConfig(width=size[0], height=size[1], horizontal_fov_rad=fov_rad)
    renderer = make_renderer(arrays, lens, outputs={"rgb"}, instant_count=1)
    return take_picture(renderer, *pose, outputs={"rgb"})["rgb"]


def _draw_plan(
    arrays: SceneArrays, space: FreeSpace | None, fly_m: float, bounds: NDArray[np.float64]
) -> tuple[Image.Image, float, NDArray[np.float64]]:
    """Return the scene from above with free space in green, its pixels per metre and its lower left [m]."""
    extent = bounds[1, :2] - bounds[0, :2]
    scale = float(min(_PLAN[0] / max(extent[0], 1e-3), _PLAN[1] / max(extent[1], 1e-3)))
    width, height = (max(int(length * scale), 2) for length in extent)
    centre = bounds.mean(axis=0)
    distance = 60.0 * float(max(extent.max(), bounds[1, 2] - bounds[0, 2]))  # far off: nearly parallel rays
    eye = np.array([centre[0], centre[1], centre[2] + distance])
    pose = _pose(eye, np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0]))
    fov_rad = 2.0 * float(np.arctan(0.5 * width / scale / distance))
    picture = _look(arrays, pose, fov_rad, (width, height)).astype(np.float64)

    lower_left = centre[:2] - 0.5 * np.array([width, height]) / scale
    if space is None:
        return Image.fromarray(picture.astype(np.uint8)), scale, lower_left
    layer = space.voxel_of([*space.seed_m[:2], fly_m])[2]
    free = space.reachable(CLEARANCE_M)[:, :, layer]
    x = lower_left[0] + (np.arange(width) + 0.5) / scale
    y = lower_left[1] + (height - np.arange(height) - 0.5) / scale
    column = np.rint((x - space.origin_m[0]) / space.voxel_m).astype(int)
    row = np.rint((y - space.origin_m[1]) / space.voxel_m).astype(int)
    inside = ((column >= 0) & (column < free.shape[0]))[None] & ((row >= 0) & (row < free.shape[1]))[:, None]
    at = np.clip(column, 0, free.shape[0] - 1)[None], np.clip(row, 0, free.shape[1] - 1)[:, None]
    reached = inside & free[at]
    picture[reached] = 0.55 * picture[reached] + 0.45 * _FREE
    return Image.fromarray(picture.astype(np.uint8)), scale, lower_left
