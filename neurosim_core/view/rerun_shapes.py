"""Pictures and meshes as Rerun shows them."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from neurosim_core.packets import Packet
from neurosim_core.scene.bodies import Body, BodyConfig
from neurosim_core.scene.scene import Material, Scene
from neurosim_core.scene.srgb import linear_to_srgb8
from neurosim_core.view.pictures import color_picture, picture_of
from neurosim_core.view.rerun_sdk import import_rerun

_TEXTURE_MAX_PX = 256
_ARROW_COLOR = (29, 37, 48)


def flow_arrows(flow: NDArray[np.float32]) -> Any:
    """Return flow as arrows on a grid of pixels, the longest of them a step and a half of the grid.

    `flow`: shape [H, W, 2]; nan: not known.
    """
    step = max(8, flow.shape[1] // 16)
    rows, columns = np.mgrid[step // 2 : flow.shape[0] : step, step // 2 : flow.shape[1] : step]
    vectors = flow[rows, columns].reshape(-1, 2)
    known = np.isfinite(vectors).all(axis=1)
    vectors = vectors[known]
    longest = float(np.linalg.norm(vectors, axis=1).max(initial=1e-9))
    origins = np.stack([columns.ravel(), rows.ravel()], axis=1)[known] + 0.5
    rr = import_rerun()
    return rr.Arrows2D(
        vectors=vectors * (1.5 * step / longest),
        origins=origins,
        colors=[_ARROW_COLOR],
        radii=rr.Radius.ui_points(0.75),
        draw_order=40.0,
    )


def encode_picture(packet: Packet, *, compress: bool = True, opacity: float = 1.0) -> Any:
    """Return the picture of a packet as Rerun shows it.

    Colours and greys become JPEG. Depth becomes a depth image in millimetres up to 65 m, 0 where nothing is
    hit. Labels, normals and flow become colours without loss; labels that are not compressed keep their
    numbers. `packet`: a packet that `picture_of` finds a picture in. `compress`: make it small. What is not,
    a viewer shows without delay. `opacity`: of labels, normals and flow, which are drawn over other pictures
    if they can be seen through.
    """
    rr = import_rerun()
    kind, data = picture_of(packet)
    if kind == "values":
        return rr.Image(data.astype(np.float32))
    if kind == "depth":
        high_mm = np.where(np.isfinite(data), np.minimum(data * 1000.0 + 0.5, 65535.0), 0.0)
        depth_mm = high_mm.astype(np.uint16)
        colormap = rr.components.Colormap.Turbo
        if not compress:
            return rr.DepthImage(depth_mm, meter=1000.0, colormap=colormap)
        png = _png(PIL.Image.fromarray(depth_mm))
        return rr.EncodedDepthImage(png, media_type="image/png", meter=1000.0, colormap=colormap)
    if kind == "colour":
        picture = rr.Image(data)
        return picture.compress(jpeg_quality=90) if compress else picture
    over: dict[str, Any] = {"opacity": opacity, "draw_order": 10.0 if opacity < 1.0 else None}
    if compress:
        png = _png(PIL.Image.fromarray(color_picture(kind, data)))
        return rr.EncodedImage(contents=png, media_type="image/png", **over)
    if kind == "segmentation":
        return rr.SegmentationImage(np.where(data < 0, 0, data + 1).astype(np.uint16), **over)
    return rr.Image(color_picture(kind, data), **over)


def encode_classes(classes: NDArray[np.uint8], palette: NDArray[np.uint8], *, compress: bool = True) -> Any:
    """Return class numbers, shape [H, W], in the colours of a palette, without loss.

    What is not compressed needs `class_colors` at its entity.
    """
    if not compress:
        return import_rerun().SegmentationImage(classes, opacity=1.0)
    picture = PIL.Image.fromarray(classes, mode="L")
    picture.putpalette(palette.tobytes())
    return import_rerun().EncodedImage(contents=_png(picture), media_type="image/png")


def class_colors(palette: NDArray[np.uint8], shades: Sequence[str]) -> Any:
    """Return names and colours of the classes of events.

    `palette`: colours: of no event, then of the shades of darker pixels, then of brighter ones.
    """
    names = ["no event", *(f"{way}, {shade}" for way in ("darker", "brighter") for shade in shades)]
    classes = zip(names, palette.tolist(), strict=True)
    return import_rerun().AnnotationContext([(k, name, (*rgb, 255)) for k, (name, rgb) in enumerate(classes)])


def _png(picture: PIL.Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", compress_level=1)
    return buffer.getvalue()


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneShapes:
    """A scene as Rerun shows it; made once, logged into as many recordings as need be."""

    meshes: tuple[tuple[str, Any], ...]
    """One mesh for each material, with its entity path."""
    bounds_m: NDArray[np.float64]
    """Lowest and highest corner of all vertices [m], shape [2, 3]."""
    bodies: dict[str, BodyConfig] = field(default_factory=dict)
    """Moving bodies, by name: their meshes are below `world/bodies/<name>`."""


def scene_shapes(scene: Scene, bodies: Sequence[Body] = ()) -> SceneShapes:
    """Return the shapes of a scene and of the bodies that are present in it: one mesh per material.

    Faces that lie wholly in the highest 15 % go below `world/scene/ceiling`, so that they can be hidden.
    Textures are reduced to 256 pixels.
    """
    low_m, high_m = scene.bounds_m[:, 2]
    top = scene.vertices[scene.faces, 2].min(axis=1) > low_m + 0.85 * (high_m - low_m)
    meshes = []
    for part, chosen in (("room", ~top), ("ceiling", top)):
        for index, material in enumerate(scene.materials):
            faces = scene.faces[chosen & (scene.face_material == index)]
            if len(faces):
                meshes.append((f"world/scene/{part}/{index}", _mesh(scene, faces, material)))
    bodies = [body for body in bodies if body.config.present]
    for body in bodies:
        for index, material in enumerate(body.solid.materials):
            faces = body.solid.faces[body.solid.face_material == index]
            if len(faces):
                meshes.append((f"{body_entity(body.name)}/{index}", _mesh(body.solid, faces, material)))
    return SceneShapes(
        meshes=tuple(meshes),
        bounds_m=np.array(scene.bounds_m, dtype=np.float64),
        bodies={body.name: body.config for body in bodies},
    )


def body_entity(name: str) -> str:
    """Return the entity of a body's frame."""
    return f"world/bodies/{name}"


def _mesh(source: Scene, faces: NDArray[np.int32], material: Material) -> Any:
    used, triangles = np.unique(faces, return_inverse=True)
    texture = _texture(material)
    albedo = np.array(material.base_color) + np.array(material.emission)
    return import_rerun().Mesh3D(
        vertex_positions=source.vertices[used],
        vertex_normals=source.normals[used],
        triangle_indices=triangles.reshape(-1, 3).astype(np.uint32),
        vertex_texcoords=None if texture is None else [0.0, 1.0] + [1.0, -1.0] * source.uv[used],  # v: down
        albedo_texture=texture,
        albedo_factor=[*linear_to_srgb8(albedo.clip(0.0, 1.0)), 255],
    )


def _texture(material: Material) -> NDArray[np.uint8] | None:
    if material.texture is None:
        return None
    picture = PIL.Image.fromarray(material.texture.srgb)
    picture.thumbnail((_TEXTURE_MAX_PX, _TEXTURE_MAX_PX))
    return np.asarray(picture)
