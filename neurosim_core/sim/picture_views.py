# mypy: disable-error-code="attr-defined,no-untyped-call,call-overload"
"""What the processing of pictures is made for, and what it needs to know besides the poses of rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from neurosim_core.render.camera import Lens
from neurosim_core.render.ray_times import RayTimes
from neurosim_core.render.renderer import Renderer, RenderWorlds
from neurosim_core.scene.bodies import BodyPoses, make_body_poses
from neurosim_core.sensors.base import PictureContext, PictureSensorConfig


@dataclass(frozen=True, kw_only=True, eq=False)
class Further:
    """What a picture sensor needs besides the poses at which rays are cast, for one batch in flight."""

    offsets_ns: Any
    """From the stamp to a further time [ns], device array, shape [1]; None: there is none."""
    p_WC: Any
    q_WC: Any
    stamps: Any
    bodies: BodyPoses | None
    """As in `PictureViews`, at that time."""
    twist: Any
    """`PictureViews.twist`; None: it is not needed."""


def make_picture_context(
    name: str,
    config: PictureSensorConfig,
    renderer: Renderer,
    *,
    lens: Lens,
    scene: Any,
    worlds: RenderWorlds,
    times: RayTimes | None,
    motions: Any,
    stride: int,
    seeds: Any,
    device: str,
) -> PictureContext:
    """Return what the processing of the pictures of a sensor is made for."""
    one_scene = not worlds.arrays or worlds.scene_of_world is None
    return PictureContext(
        name=name,
        source=getattr(renderer, config.output),
        sources={output: getattr(renderer, output) for output in config.outputs},
        lenses=worlds.lenses or (lens,),
        lens_of_world=worlds.lens_of_world if worlds.lenses else [0] * worlds.count,
        scenes=(scene,) if one_scene else worlds.arrays,
        scene_of_world=wp.zeros(worlds.count, dtype=int, device=device)
        if one_scene
        else worlds.scene_of_world,
        motions=motions,
        times=times,
        stride=stride,
        seeds=seeds,
    )


def make_further(config: PictureSensorConfig, rows: int, body_count: int, device: str) -> Further:
    """Allocate what the processing of a sensor needs of a batch besides the poses of its rays."""
    offset_ns, twists = config.pose_offset_ns, config.needs_twist
    rows_then = 0 if offset_ns is None else rows
    has_bodies = body_count > 0 and offset_ns is not None
    return Further(
        offsets_ns=None if offset_ns is None else wp.array([offset_ns], dtype=wp.int64, device=device),
        p_WC=wp.zeros(rows_then, dtype=wp.vec3, device=device),
        q_WC=wp.zeros(rows_then, dtype=wp.quat, device=device),
        stamps=wp.zeros((rows_then, 1), dtype=wp.int64, device=device),
        bodies=make_body_poses(rows_then, body_count, device) if has_bodies else None,
        twist=wp.zeros(rows, dtype=wp.spatial_vectord, device=device) if twists else None,
    )
