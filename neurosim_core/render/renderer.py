"""The interface of renderers, and the choice of one."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any, ClassVar, Literal, Protocol

import warp as wp
from numpy.typing import ArrayLike, NDArray

from neurosim_core.registry import find, kinds, register, registered
from neurosim_core.render.camera import Lens
from neurosim_core.render.config import LightingConfig, RenderConfig
from neurosim_core.render.ray_times import RayTimes
from neurosim_core.render.scene_arrays import SceneArrays
from neurosim_core.render.scene_arrays import upload_scene as upload_warp_scene
from neurosim_core.render.warp_renderer import ONE_WORLD, RenderWorlds, WarpRenderer
from neurosim_core.scene.bodies import Body, BodyPoses
from neurosim_core.scene.scene import Scene
from neurosim_core.settings import BaseConfig

__all__ = [
    "ONE_WORLD",
    "LightingConfig",
    "RenderConfig",
    "RenderWorlds",
    "Renderer",
    "RendererConfig",
    "make_renderer",
    "take_picture",
    "upload_scene",
]


class Renderer(Protocol):
    """Renders up to K instants of one lens in N worlds per call into arrays of its own.

    Instants are [world, K] in this order; outputs that were not asked for are None.
    """

    log_radiance: Any
    """Logarithm of linear luma plus the dark floor, float32 [N K, H, W]."""
    rgb: Any
    """8-bit sRGB, uint8 [M, H, W, 3]."""
    radiance: Any
    """Exposure times linear radiance, of which 1 is white, vec3 [M, H, W]."""
    depth: Any
    """Planar z [m], inf where nothing is hit, float32 [M, H, W]."""
    range: Any
    """Length of the ray [m], inf where nothing is hit, float32 [M, H, W]."""
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


class RendererConfig(BaseConfig):
    """Settings of a renderer. A kind adds its `kind`, what it needs, `scene_type`, `upload` and `make`."""

    kind: str
    """Under which name the class is registered."""

    scene_type: ClassVar[type]
    """Class of what `upload` returns."""
    make: ClassVar[Callable[..., Renderer]]
    """Makes a renderer for one lens. It takes what `upload` returned, the lens, and by name `outputs`,
    `instant_count`, `image_count`, `worlds` and `times` of `make_renderer`, and raises a ValueError where it
    cannot do what is asked for."""
    only_launches: ClassVar[bool] = False
    """Whether `Renderer.render` only launches work on the device, and waits for nothing. Otherwise no CUDA
    graph records it, and one batch is rendered after the other."""

    def upload(self, scene: Scene, config: RenderConfig, *, device: str, bodies: Sequence[Body]) -> Any:
        """Prepare a scene, for all cameras; see `upload_scene`."""
        raise NotImplementedError


@register("renderer", "warp")
class WarpRendererConfig(RendererConfig):
    """Ray casting on CPU and CUDA, for all cameras."""

    kind: Literal["warp"] = "warp"
    scene_type = SceneArrays
    make = WarpRenderer
    only_launches = True

    def upload(self, scene: Scene, config: RenderConfig, *, device: str, bodies: Sequence[Body]) -> Any:
        """Bring a scene to a device."""
        return upload_warp_scene(scene, config, device=device, bodies=bodies)


def upload_scene(
    scene: Scene,
    config: RenderConfig,
    *,
    device: str,
    renderer: RendererConfig | str = "warp",
    bodies: Sequence[Body] = (),
) -> Any:
    """Prepare a scene for a renderer.

    Args:
        scene: What to render.
        config: Light, exposure and the like.
        device: Where Warp renders, and where light is baked.
        renderer: Its settings, or its kind alone: `warp`, `pyrender`, `synthetic`, or one of a plug-in.
        bodies: What moves in the scene.

    Raises:
        ValueError: The synthetic renderer is asked to show bodies.
        PyrenderError: pyrender cannot be used here.
    """
    chosen = renderer if isinstance(renderer, RendererConfig) else find("renderer", renderer)()
    return chosen.upload(scene, config, device=device, bodies=bodies)


def make_renderer(
    scene: Any,
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
        outputs: Some of `render.outputs.OUTPUTS`.
        instant_count: K, the most instants of a world per call.
        image_count: M, number of image slots, of all worlds together.
        worlds: Who is rendered together: several only by `warp`.
        times: When rays are cast; None: all at the stamp.

    Raises:
        ValueError: An output is unknown, or the renderer does not have it; it renders one world only, or only
            pinholes.
    """
    shape = {"instant_count": instant_count, "image_count": image_count, "worlds": worlds, "times": times}
    kind: Any
    for kind in registered("renderer").values():
        if isinstance(scene, kind.scene_type):
            renderer: Renderer = kind.make(scene, lens, outputs=outputs, **shape)
            return renderer
    raise ValueError(f"no renderer made {type(scene).__name__}, known: {sorted(kinds('renderer'))}")


def take_picture(
    renderer: Renderer, position: ArrayLike, orientation: ArrayLike, *, outputs: Collection[str]
) -> dict[str, NDArray[Any]]:
    """Return outputs of one pose, p_WC [m] and q_WC, by name; waits for the device."""
    device = getattr(renderer, next(iter(outputs))).device
    p_WC: Any = wp.array([position], dtype=wp.vec3, device=device)
    q_WC: Any = wp.array([orientation], dtype=wp.quat, device=device)
    slot: Any = wp.zeros(1, dtype=int, device=device)
    renderer.render(p_WC, q_WC, slot, instant_count=1)
    return {name: getattr(renderer, name).numpy()[0].copy() for name in outputs}
