# mypy: disable-error-code="no-untyped-call"
"""A renderer in another process, over Cortex: poses go out, frames come back.

Any engine that takes a camera's pose and returns linear light can stand in for ours: it runs `serve_frames`
(or speaks the two messages itself), and the simulator has `renderer: {kind: remote}`. Frames should be linear
and float32. Those of 8-bit sRGB are taken as well, with a warning: an event camera sees their steps.
"""

from __future__ import annotations

import logging
import secrets
import threading
import weakref
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray
from pydantic import Field

from neurosim_core.registry import register
from neurosim_core.render.camera import Lens, PinholeConfig
from neurosim_core.render.config import RenderConfig
from neurosim_core.render.ray_times import refuse_several
from neurosim_core.render.renderer import Renderer, RendererConfig
from neurosim_core.scene.bodies import Body, BodyPoses
from neurosim_core.scene.scene import Scene
from neurosim_core.scene.srgb import linear_to_srgb8, srgb_to_linear

if TYPE_CHECKING:
    from cortex import Node
    from neurosim_core.live.render_messages import RenderReply, RenderRequest

OUTPUTS = ("depth", "log_radiance", "rgb")
"""What a renderer in another process can be asked for."""

_LUMA = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)  # Rec. 709
_POLL_S = 0.1

_logger = logging.getLogger(__name__)


class RemoteRendererError(RuntimeError):
    """The renderer in the other process did not answer, or its answer cannot be used."""


@dataclass(frozen=True, kw_only=True)
class Frames:
    """The answer of a renderer: frames of all poses that it was asked for, in their order."""

    linear: NDArray[np.float32] | None = None
    """Linear radiance, red, green, blue (Rec. 709), shape [n, H, W, 3]."""
    srgb: NDArray[np.uint8] | None = None
    """Radiance in 8-bit sRGB where there is nothing better, shape [n, H, W, 3]."""
    depth: NDArray[np.float32] | None = None
    """Planar z [m], inf where nothing is hit, shape [n, H, W]."""


def serve_frames(
    render: Callable[[RenderRequest], Frames],
    *,
    topic: str = "/renderer",
    stop: threading.Event | None = None,
    on_ready: Callable[[], None] | None = None,
) -> int:
    """Answer requests for frames until told to stop; call it in the process that renders.

    Args:
        render: Renders the poses of a request. What it raises ends the run of the simulator, which says it.
        topic: Where requests come in, on TOPIC/request, and frames go out, on TOPIC/frames.
        stop: Set to end; None: never.
        on_ready: Called when requests can come.

    Returns:
        How many requests were answered.
    """
    from cortex import Node, reliable
    from neurosim_core.live.render_messages import RenderReply, RenderRequest

    answered = 0
    with Node(f"renderer {topic}") as node:
        requests = node.subscriber(
            f"{topic}/request", RenderRequest, policy=reliable(depth=4, timeout_s=10.0)
        )
        replies = node.publisher(f"{topic}/frames", RenderReply)
        if on_ready is not None:
            on_ready()
        while stop is None or not stop.is_set():
            try:
                request = requests.recv(timeout_s=_POLL_S)
            except TimeoutError:
                continue
            problem, frames = "", Frames()
            try:
                frames = render(request)
            except Exception as error:  # whatever a foreign renderer raises: the simulator says it
                problem = f"{type(error).__name__}: {error}"
            replies.publish(
                RenderReply(
                    client=request.client,
                    number=request.number,
                    problem=problem,
                    linear=_given(frames.linear, np.float32, (0, 0, 0, 3)),
                    srgb=_given(frames.srgb, np.uint8, (0, 0, 0, 3)),
                    depth=_given(frames.depth, np.float32, (0, 0, 0)),
                )
            )
            answered += 1
    return answered


def _given(array: NDArray[Any] | None, dtype: Any, nothing: tuple[int, ...]) -> NDArray[Any]:
    return np.zeros(nothing, dtype) if array is None else np.ascontiguousarray(array, dtype=dtype)


@dataclass(kw_only=True, eq=False)
class RemoteScene:
    """The connection to a renderer in another process, which has a scene of its own."""

    config: RenderConfig
    settings: RemoteRendererConfig
    device: str
    node: Node
    requests: Any
    replies: Any
    client: int
    number: int = 0
    warned: bool = False

    def ask(
        self, lens: PinholeConfig, positions: Any, orientations: Any, outputs: Collection[str]
    ) -> RenderReply:
        """Return the frames of some poses; what was not asked for has size 0.

        `positions`: p_WC [m], shape [n, 3]. `orientations`: q_WC of the optical frame, xyzw, shape [n, 4].
        """
        from neurosim_core.live.render_messages import RenderRequest

        fx, fy, cx, cy = lens.intrinsics()
        self.number += 1
        self.requests.publish(
            RenderRequest(
                client=self.client,
                number=self.number,
                position=np.ascontiguousarray(positions, dtype=np.float64),
                orientation=np.ascontiguousarray(orientations, dtype=np.float64),
                width=lens.width,
                height=lens.height,
                fx=fx,
                fy=fy,
                cx=cx,
                cy=cy,
                outputs=sorted(outputs),
            )
        )
        reply = self._wait()
        where = f"the renderer on {self.settings.topic}"
        if reply.problem:
            raise RemoteRendererError(f"{where} failed: {reply.problem}")
        shape = (len(positions), lens.height, lens.width)
        for name, array, wanted in (
            ("linear", reply.linear, (*shape, 3)),
            ("srgb", reply.srgb, (*shape, 3)),
            ("depth", reply.depth, shape),
        ):
            if array.size and array.shape != wanted:
                raise RemoteRendererError(f"{where} sent {name} of shape {array.shape}, asked for {wanted}")
        missing = {"radiance": not reply.linear.size and not reply.srgb.size, "depth": not reply.depth.size}
        if lacks := [name for name in sorted(outputs) if missing[name]]:
            raise RemoteRendererError(f"{where} sent no {', '.join(lacks)}")
        return reply

    def _wait(self) -> RenderReply:
        try:
            while True:
                reply: RenderReply = self.replies.recv(timeout_s=self.settings.timeout_s)
                if (reply.client, reply.number) == (self.client, self.number):
                    return reply
        except TimeoutError as error:
            raise RemoteRendererError(
                f"no frames on {self.settings.topic}/frames within {self.settings.timeout_s:g} s: {error}"
            ) from None


@register("renderer", "remote")
class RemoteRendererConfig(RendererConfig):
    """A renderer in another process, over Cortex: poses go out, linear frames come back; pinholes only."""

    kind: Literal["remote"] = "remote"
    topic: Annotated[str, Field(pattern=r"^(/[A-Za-z0-9_]+)+$")] = "/renderer"
    """Topic prefix of the renderer: requests go to TOPIC/request, frames come from TOPIC/frames."""
    timeout_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 10.0
    """Longest wait for the renderer to appear, and for its frames [wall-clock s]."""

    scene_type = RemoteScene

    def upload(
        self, scene: Scene, config: RenderConfig, *, device: str, bodies: Sequence[Body]
    ) -> RemoteScene:
        """Connect to the renderer, which has a scene of its own; `scene` is what the vehicle can touch."""
        from cortex import Node, reliable
        from neurosim_core.live.render_messages import RenderReply, RenderRequest

        if bodies:
            names = ", ".join(body.name for body in bodies)
            raise ValueError(f"the renderer 'remote' sees no bodies, and there are some: {names}")
        node = Node(f"frames of {self.topic} {secrets.token_hex(4)}")
        requests = node.publisher(f"{self.topic}/request", RenderRequest)
        replies = node.subscriber(
            f"{self.topic}/frames", RenderReply, policy=reliable(depth=2, timeout_s=self.timeout_s)
        )
        if not (
            requests.wait_for_subscribers(1, timeout_s=self.timeout_s)
            and replies.wait_for_publisher(timeout_s=self.timeout_s)
        ):
            node.close()
            raise RemoteRendererError(
                f"no renderer serves {self.topic} (waited {self.timeout_s:g} s): start its process first"
            )
        connected = RemoteScene(
            config=config,
            settings=self,
            device=device,
            node=node,
            requests=requests,
            replies=replies,
            client=secrets.randbits(63),
        )
        # In a thread of its own: one of the node may collect the garbage. At exit nodes end by themselves.
        ending = threading.Thread(target=node.close, name=f"end of {node.name}", daemon=True)
        weakref.finalize(connected, ending.start).atexit = False
        return connected

    @staticmethod
    def make(scene: RemoteScene, lens: Lens, *, outputs: Collection[str], **shape: Any) -> Renderer:
        """Return a renderer for one lens."""
        refuse_several("remote", shape)
        if not isinstance(lens, PinholeConfig):
            kind = getattr(lens, "kind", type(lens).__name__)
            raise ValueError(f"the renderer 'remote' renders pinholes, not a lens of kind {kind}")
        if unknown := sorted(set(outputs) - set(OUTPUTS)):
            raise ValueError(f"the renderer 'remote' renders {list(OUTPUTS)}, asked for {unknown}")
        return RemoteRenderer(
            scene,
            lens,
            outputs=outputs,
            instant_count=shape["instant_count"],
            image_count=shape["image_count"],
        )


class RemoteRenderer:
    """Asks for the frames of each launch in one message; see `Renderer`.

    Attributes:
        log_radiance: float32 [K, H, W], or None.
        rgb: uint8 [M, H, W, 3], or None.
        depth: float32 [M, H, W], or None.
        normal: None; so are range, instance and returns.
    """

    def __init__(
        self,
        scene: RemoteScene,
        lens: PinholeConfig,
        *,
        outputs: Collection[str],
        instant_count: int,
        image_count: int,
    ) -> None:
        self._scene, self._lens = scene, lens
        size = (lens.height, lens.width)

        def array(name: str, count: int, *more: int, dtype: Any = float) -> Any:
            wanted = name in outputs
            return wp.zeros((count, *size, *more), dtype=dtype, device=scene.device) if wanted else None

        self.log_radiance = array("log_radiance", instant_count)
        self.rgb = array("rgb", image_count, 3, dtype=wp.uint8)
        self.depth = array("depth", image_count)
        self.radiance = self.normal = self.range = self.instance = self.returns = None
        self._outputs = {"depth"} & set(outputs)
        if {"rgb", "log_radiance"} & set(outputs):
            self._outputs.add("radiance")

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
        """Render those of the first `instant_count` poses that are looked at; waits for the answer."""
        slots = image_slot.numpy()[:instant_count]
        chosen = np.arange(instant_count) if self.log_radiance is not None else np.flatnonzero(slots >= 0)
        if not len(chosen):
            return
        reply = self._scene.ask(self._lens, p_WC.numpy()[chosen], q_WC.numpy()[chosen], outputs=self._outputs)
        linear = self._linear(reply)
        for frame, instant in enumerate(chosen.tolist()):
            slot = int(slots[instant])
            if self.log_radiance is not None:
                luma = np.maximum(linear[frame] @ _LUMA, 0.0) + np.float32(self._scene.config.dark_floor)
                self.log_radiance[instant].assign(np.log(luma, dtype=np.float32))
            if slot >= 0 and self.rgb is not None:
                self.rgb[slot].assign(self._display(reply, frame))
            if slot >= 0 and self.depth is not None:
                self.depth[slot].assign(reply.depth[frame])

    def _linear(self, reply: RenderReply) -> NDArray[np.float32]:
        """Return what log radiance is made of."""
        if reply.linear.size or self.log_radiance is None:
            return reply.linear
        if not self._scene.warned:
            self._scene.warned = True
            _logger.warning(
                "the renderer on %s sends 8-bit sRGB: log radiance has steps (of a threshold in the dark), "
                "which an event camera reports as events; let it send linear float32",
                self._scene.settings.topic,
            )
        return np.asarray(srgb_to_linear(reply.srgb), dtype=np.float32)

    def _display(self, reply: RenderReply, frame: int) -> NDArray[np.uint8]:
        if not reply.linear.size:
            return reply.srgb[frame]
        exposure = self._scene.config.exposure
        return linear_to_srgb8(reply.linear[frame] * np.float32(1.0 if exposure == "auto" else exposure))
