# mypy: disable-error-code="attr-defined,type-arg,misc,index,call-overload,operator"
"""A test pattern instead of a view: pictures at almost no cost, to benchmark everything else.

A bright square moves with the camera over a fixed card. A picture is a pure function of the pose: the card is
drawn once, and each instant restores what the square covered and draws it elsewhere. `rgb` and `depth` begin
with the pose that they show, so that a receiver can tell which instant it sees: `read_pose`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.registry import register
from neurosim_core.render.camera import Lens
from neurosim_core.render.config import RenderConfig
from neurosim_core.render.ray_times import refuse_several
from neurosim_core.render.renderer import RendererConfig
from neurosim_core.scene.bodies import Body, BodyPoses
from neurosim_core.scene.scene import Scene
from neurosim_core.scene.srgb import srgb_to_linear

wp.set_module_options({"enable_backward": False})

OUTPUTS = ("depth", "log_radiance", "rgb")
"""What a test pattern has."""

_LUMA = np.array([0.2126, 0.7152, 0.0722])
_BARS = np.array(
    [[192, 192, 192], [192, 192, 0], [0, 192, 192], [0, 192, 0], [192, 0, 192], [192, 0, 0], [0, 0, 192]],
    dtype=np.uint8,
)
_DEPTH_NEAR_M, _DEPTH_FAR_M = 2.0, 10.0
_SQUARE_DEPTH_M = wp.constant(1.0)
_SQUARE_SHARE = 30
_METRE_PX = wp.constant(200.0)
_LAUNCH_COUNT_MAX = 256
_POSE_IN_RGB_PX = wp.constant(10)
"""Pixels of three bytes that hold seven floats."""
_POSE_IN_DEPTH_PX = wp.constant(7)


@dataclass(frozen=True, kw_only=True, eq=False)
class SyntheticScene:
    """The data that all test patterns of a run share."""

    scene: Scene
    config: RenderConfig
    device: str


@wp.func
def _fold(way_px: float, room_px: int) -> int:
    """Return a way as a place in [0, room_px], run through back and forth."""
    turn = 2.0 * float(wp.max(room_px, 1))
    rest = way_px - turn * wp.floor(way_px / turn)
    return wp.min(int(wp.min(rest, turn - rest)), room_px)


@wp.kernel
def _restore(
    # Model:
    rgb_card: wp.array3d[wp.uint8],
    depth_card: wp.array2d[float],
    log_card: wp.array2d[float],
    # In:
    image_slot: wp.array[int],
    picture_place: wp.array[wp.vec2i],
    log_place: wp.array[wp.vec2i],
    # Out:
    rgb_out: wp.array4d[wp.uint8],
    depth_out: wp.array3d[float],
    log_radiance_out: wp.array3d[float],
) -> None:
    instant, down, right = wp.tid()
    slot = image_slot[instant]
    if slot >= 0:
        row = picture_place[slot][0] + down
        col = picture_place[slot][1] + right
        if rgb_out:
            for channel in range(3):
                rgb_out[slot, row, col, channel] = rgb_card[row, col, channel]
        if depth_out:
            depth_out[slot, row, col] = depth_card[row, col]
    if log_radiance_out:
        row = log_place[instant][0] + down
        col = log_place[instant][1] + right
        log_radiance_out[instant, row, col] = log_card[row, col]


@wp.kernel
def _draw(
    # Model:
    side: int,
    width: int,
    height: int,
    log_white: float,
    # In:
    p_WC: wp.array[wp.vec3],
    q_WC: wp.array[wp.quat],
    image_slot: wp.array[int],
    # Out:
    picture_place_out: wp.array[wp.vec2i],
    log_place_out: wp.array[wp.vec2i],
    rgb_out: wp.array4d[wp.uint8],
    depth_out: wp.array3d[float],
    log_radiance_out: wp.array3d[float],
) -> None:
    instant, down, right = wp.tid()
    p = p_WC[instant]
    view = wp.quat_rotate(q_WC[instant], wp.vec3(0.0, 0.0, 1.0))
    corner_row = _fold(-_METRE_PX * p[2] - float(height) * view[2], height - side)
    corner_col = _fold(_METRE_PX * (p[0] + p[1]) + float(width) * (view[0] - view[1]), width - side)
    row = corner_row + down
    col = corner_col + right
    slot = image_slot[instant]
    if log_radiance_out:
        log_radiance_out[instant, row, col] = log_white
        if down == 0 and right == 0:
            log_place_out[instant] = wp.vec2i(corner_row, corner_col)
    if slot >= 0:
        pixel = row * width + col
        if rgb_out and pixel >= _POSE_IN_RGB_PX:
            for channel in range(3):
                rgb_out[slot, row, col, channel] = wp.uint8(255)
        if depth_out and pixel >= _POSE_IN_DEPTH_PX:
            depth_out[slot, row, col] = _SQUARE_DEPTH_M
        if down == 0 and right == 0:
            picture_place_out[slot] = wp.vec2i(corner_row, corner_col)
            for number in range(7):
                value = p[wp.min(number, 2)]
                if number >= 3:
                    value = q_WC[instant][number - 3]
                if depth_out:
                    depth_out[slot, number // width, number % width] = value
                if rgb_out:
                    bits = wp.cast(value, wp.uint32)
                    for byte in range(4):
                        place = 4 * number + byte
                        pixel = place // 3
                        rgb_out[slot, pixel // width, pixel % width, place % 3] = wp.uint8(
                            bits >> wp.uint32(8 * byte) & wp.uint32(255)
                        )


class SyntheticRenderer:
    """Draws test patterns: log radiance without the pose, rgb and depth of `renderer.Renderer`.

    `render` neither allocates nor waits for a CUDA device.
    """

    def __init__(
        self,
        scene: SyntheticScene,
        lens: Lens,
        *,
        outputs: Collection[str],
        instant_count: int,
        image_count: int = 1,
        **several: Any,
    ) -> None:
        """Draw the card into every picture; parameters as of `make_renderer`.

        Raises:
            ValueError: An output beyond `OUTPUTS` is asked for, none is, or a picture is too small for a
                pose; there are several worlds, or rays have times of their own.
        """
        refuse_several("synthetic", several)
        if not set(outputs) <= set(OUTPUTS) or not outputs:
            raise ValueError(
                f"the synthetic renderer has {list(OUTPUTS)}, asked for {sorted(outputs)}: use renderer: warp"
            )
        if lens.width * lens.height < _POSE_IN_RGB_PX:
            raise ValueError(
                f"a test pattern needs at least {_POSE_IN_RGB_PX} pixels, got {lens.width} x {lens.height}"
            )
        device = scene.device
        self._device = device
        self._width, self._height = lens.width, lens.height
        self._side = max(1, min(lens.width, lens.height) // _SQUARE_SHARE)
        rgb, depth = _card(lens.width, lens.height)
        log_radiance = np.log(srgb_to_linear(rgb) @ _LUMA + scene.config.dark_floor).astype(np.float32)
        self._log_white = float(np.log(1.0 + scene.config.dark_floor))
        cards = {"rgb": rgb, "depth": depth, "log_radiance": log_radiance}
        counts = {"rgb": image_count, "depth": image_count, "log_radiance": instant_count}

        def allocate(name: str) -> tuple[Any, Any]:
            """A card, and as many copies of it as there are pictures."""
            if name not in outputs:
                return None, None
            card = cards[name]
            dtype = wp.uint8 if name == "rgb" else float
            pictures = np.repeat(card[None], counts[name], axis=0)
            return wp.array(card, dtype=dtype, device=device), wp.array(pictures, dtype=dtype, device=device)

        rgb_card, self.rgb = allocate("rgb")
        depth_card, self.depth = allocate("depth")
        log_card, self.log_radiance = allocate("log_radiance")
        self._cards = [rgb_card, depth_card, log_card]
        self.radiance = self.normal = self.range = self.instance = self.returns = None
        self._picture_place = wp.zeros(image_count, dtype=wp.vec2i, device=device)
        self._log_place = wp.zeros(instant_count, dtype=wp.vec2i, device=device)
        self._launches: dict[tuple[int, ...], tuple[wp.Launch, wp.Launch]] = {}

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
        """Draw the cards of the first `instant_count` poses; see `Renderer.render`. Bodies are not seen."""
        key = (p_WC.ptr, q_WC.ptr, image_slot.ptr, instant_count)
        launches = self._launches.get(key)
        if launches is None:
            if len(self._launches) >= _LAUNCH_COUNT_MAX:
                del self._launches[next(iter(self._launches))]
            launches = self._launches[key] = self._record(p_WC, q_WC, image_slot, instant_count)
        for launch in launches:
            launch.launch()

    def _record(
        self, p_WC: Any, q_WC: Any, image_slot: Any, instant_count: int
    ) -> tuple[wp.Launch, wp.Launch]:
        """Prepare the launches for these arrays: that costs several times what they do."""
        dim = (instant_count, self._side, self._side)
        places = [self._picture_place, self._log_place]
        outputs = [self.rgb, self.depth, self.log_radiance]
        restore = wp.launch(
            _restore,
            dim=dim,
            inputs=[*self._cards, image_slot, *places],
            outputs=outputs,
            device=self._device,
            record_cmd=True,
        )
        shape = [self._side, self._width, self._height, self._log_white]
        draw = wp.launch(
            _draw,
            dim=dim,
            inputs=[*shape, p_WC, q_WC, image_slot],
            outputs=[*places, *outputs],
            device=self._device,
            record_cmd=True,
        )
        return restore, draw


def read_pose(data: NDArray[Any]) -> NDArray[np.float32]:
    """Return the pose p_WC [m] and q_WC (xyzw), shape [7], that a test pattern shows, rgb or depth."""
    size = 28 if data.dtype == np.uint8 else 7
    return np.frombuffer(np.ravel(data)[:size].tobytes(), dtype=np.float32)


def _card(width: int, height: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return bars of colour over a ramp of grey, and a slope of depth [m]."""
    rgb = np.empty((height, width, 3), dtype=np.uint8)
    split = 3 * height // 4
    rgb[:split] = _BARS[len(_BARS) * np.arange(width) // width]
    rgb[split:] = np.linspace(0, 255, width).astype(np.uint8)[:, None]
    depth = np.linspace(_DEPTH_NEAR_M, _DEPTH_FAR_M, width, dtype=np.float32)
    return rgb, np.repeat(depth[None], height, axis=0)


@register("renderer", "synthetic")
class SyntheticRendererConfig(RendererConfig):
    """A test pattern at almost no cost, on CPU and CUDA; it does not show the scene."""

    kind: Literal["synthetic"] = "synthetic"
    scene_type = SyntheticScene
    make = SyntheticRenderer
    only_launches = True

    def upload(self, scene: Scene, config: RenderConfig, *, device: str, bodies: Sequence[Body]) -> Any:
        """Return what all test patterns of a run share."""
        if bodies:
            names = ", ".join(body.name for body in bodies)
            raise ValueError(f"the renderer 'synthetic' sees no bodies, and there are some: {names}")
        return SyntheticScene(scene=scene, config=config, device=device)
