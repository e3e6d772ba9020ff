"""What a renderer is, and which one renders."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Literal, Protocol

import warp as wp

from neurosim_core.render.camera import Lens, PinholeConfig
from neurosim_core.render.config import LightingConfig, RenderConfig
from neurosim_core.render.pyrender_renderer import PyrenderRenderer, PyrenderScene, upload_pyrender_scene
from neurosim_core.render.ray_times import RayTimes
from neurosim_core.render.scene_arrays import SceneArrays
from neurosim_core.render.scene_arrays import upload_scene as upload_warp_scene
from neurosim_core.render.synthetic_renderer import SyntheticRenderer, SyntheticScene
from neurosim_core.render.warp_renderer import ONE_WORLD, RenderWorlds, WarpRenderer
from neurosim_core.scene.bodies import Body, BodyPoses
from neurosim_core.scene.scene import Scene

__all__ = [
    "ONE_WORLD",
    "LightingConfig",
    "RenderConfig",
    "RenderWorlds",
    "Renderer",
    "RendererName",
    "SceneOnDevice",
    "make_renderer",
    "upload_scene",
]

RendererName = Literal["warp", "pyrender", "synthetic"]
"""Names of the renderers."""

SceneOnDevice = SceneArrays | PyrenderScene | SyntheticScene
"""A scene as one of the renderers keeps it, shared by all cameras."""


class Renderer(Protocol):
    """Renders up to K instants of one lens in N worlds per call into arrays of its own.

    Instants are [world, K] in this order; outputs that were not asked for are None.
    """

    log_radiance: Any
    """Logarithm of linear luma plus the dark floor, float32 [N K, H, W]."""
    rgb: Any
    """8-bit sRGB, uint8 [M, H, W, 3]."""
    depth: Any
    """Planar z [m], inf where nothing is hit, float32 [M, H, W]."""
    normal: Any
    """Normal of the surface in W, towards the camera, zero where nothing is hit, vec3 [M, H, W]."""
    instance: Any
    """Index into the names of the scene's instances and then of the bodies (`SceneArrays.instance_names`), -1
    where nothing is hit, int32 [M, H, W]."""
    returns: Any
    """Length of the ray [m], |cosine| of incidence and luma of the albedo, vec3 [M, H, W]."""

    def render(
        self,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        image_slot: wp.array[int],
        *,
        instant_count: int,
        bodies: BodyPoses | None = None,
        active: Any = None,
    ) -> None:
        """Render the first `instant_count` poses of each world.

        Args:
            p_WC: Position of the camera [m], shape [N K]; where rays have times of their own [N K J].
            q_WC: Orientation of the camera's optical frame, xyzw, shape [N K].
            image_slot: Where the images of an instant go, shape [N K]; -1: nowhere.
            instant_count: How many of the K instants of each world are rendered.
            bodies: Where bodies are at the instants; not needed without bodies.
            active: With several worlds: 1 where a world is rendered, device array of int32, shape [N].
        """


def upload_scene(
    scene: Scene,
    config: RenderConfig,
    *,
    device: str,
    renderer: RendererName = "warp",
    bodies: Sequence[Body] = (),
) -> SceneOnDevice:
    """Prepare a scene for a renderer.

    Args:
        scene: What to render.
        config: Light, exposure and the like.
        device: Where Warp renders, and where light is baked.
        renderer: `warp`: ray casting on CPU and CUDA, all outputs. `pyrender`: OpenGL, rgb and depth only.
            `synthetic`: a test card that costs next to nothing, on CPU and CUDA; the scene is not seen.
        bodies: What moves in the scene.

    Raises:
        ValueError: The synthetic renderer is asked to show bodies.
        PyrenderError: pyrender cannot be used here.
    """
    if renderer == "pyrender":
        return upload_pyrender_scene(scene, config, device=device, bodies=bodies)
    if renderer == "synthetic":
        if bodies:
            names = ", ".join(body.name for body in bodies)
            raise ValueError(f"the renderer 'synthetic' sees no bodies, and there are some: {names}")
        return SyntheticScene(scene=scene, config=config, device=device)
    return upload_warp_scene(scene, config, device=device, bodies=bodies)


def make_renderer(
    scene: SceneOnDevice,
    lens: Lens,
    *,
    outputs: Collection[str],
    instant_count: int,
    image_count: int = 1,
    worlds: RenderWorlds = ONE_WORLD,
    times: RayTimes | None = None,
) -> Renderer:
    """Return a renderer for one lens.

    Args:
        scene: What `upload_scene` returned.
        lens: The camera.
        outputs: Some of "log_radiance", "rgb", "depth", "normal", "instance", "returns".
        instant_count: K, the most instants of a world per call.
        image_count: M, number of image slots, of all worlds together.
        worlds: Who is rendered together: several only by `warp`.
        times: When rays are cast; None: all at the stamp.

    Raises:
        ValueError: An output is unknown, or the renderer does not have it; it renders one world only, or only
            pinholes.
    """
    if worlds.count > 1 and not isinstance(scene, SceneArrays):
        raise ValueError(f"{worlds.count} worlds are rendered by renderer 'warp' only")
    if isinstance(scene, PyrenderScene):
        if not isinstance(lens, PinholeConfig):
            kind = getattr(lens, "kind", type(lens).__name__)
            raise ValueError(f"pyrender renders pinholes, not a lens of kind {kind}: use renderer: warp")
        return PyrenderRenderer(scene, lens, outputs=outputs, image_count=image_count)
    if isinstance(scene, SyntheticScene):
        return SyntheticRenderer(
            scene, lens, outputs=outputs, instant_count=instant_count, image_count=image_count
        )
    return WarpRenderer(
        scene,
        lens,
        outputs=outputs,
        instant_count=instant_count,
        image_count=image_count,
        worlds=worlds,
        times=times,
    )
