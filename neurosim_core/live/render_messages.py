"""Messages between the simulator and a renderer in another process."""

from __future__ import annotations

from typing import Annotated

from cortex import Array, Unit, message
from cortex.message_types import UInt32, UInt64


@message(name="neurosim/RenderRequest")
class RenderRequest:
    """Poses of one camera, of which frames are wanted."""

    client: UInt64
    """Number of the client; the answer has the same."""
    number: UInt64
    """Which of its requests this is; likewise."""
    position: Annotated[Array["float64", "n", 3], Unit("m")]
    """p_WC of each pose [m], shape [n, 3]; W is ENU, z up."""
    orientation: Array["float64", "n", 4]
    """q_WC of each pose, xyzw, of the optical frame: x right, y down, z forward, shape [n, 4]."""
    width: Annotated[UInt32, Unit("px")]
    """Width of a frame [px]."""
    height: Annotated[UInt32, Unit("px")]
    """Height of a frame [px]."""
    fx: Annotated[float, Unit("px")]
    """Focal length [px]."""
    fy: Annotated[float, Unit("px")]
    """Focal length [px]."""
    cx: Annotated[float, Unit("px")]
    """Principal point [px]; pixel centres are at +0.5."""
    cy: Annotated[float, Unit("px")]
    """Principal point [px]."""
    outputs: list[str]
    """Requested outputs: radiance, depth."""


@message(name="neurosim/RenderReply")
class RenderReply:
    """The frames of one request, in the order of its poses; what was not asked for has size 0."""

    client: UInt64
    """Number of the client that asked."""
    number: UInt64
    """Which request this answers."""
    linear: Array["float32", "linear_n", "linear_height", "linear_width", 3]
    """Linear radiance, red, green, blue (Rec. 709)."""
    srgb: Array["uint8", "srgb_n", "srgb_height", "srgb_width", 3]
    """Radiance in 8-bit sRGB, where there is no linear one."""
    depth: Annotated[Array["float32", "depth_n", "depth_height", "depth_width"], Unit("m")]
    """Planar z [m], inf where nothing is hit."""
    problem: str = ""
    """Why there are no frames; empty if there are."""
