"""What a run yields: one frozen record per measurement, stamped in integer simulation time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Axes:
    """The axes of an array field, for packets whose message types are derived from their fields.

    `ranges: Annotated[NDArray[np.float32], Axes("beams", unit="m")]` is an array of shape [beams] in metres.

    Attributes:
        sizes: For each axis its size, or a name; axes of one name have the same size within a packet.
        unit: SI symbol; empty for counts.
        frame: Frame that the components are expressed in, such as "world"; empty where there is none.
    """

    def __init__(self, *sizes: int | str, unit: str = "", frame: str = "") -> None:
        self.sizes = sizes
        self.unit = unit
        self.frame = frame


@dataclass(frozen=True, kw_only=True, eq=False)
class Packet:
    """The header that every packet carries."""

    stamp_ns: int = 0
    """Simulation time of the measurement [ns]."""
    sequence: int = 0
    """Counts the packets of one sensor from 0; a gap is a loss."""
    sensor: str = ""
    """Name of the sensor in the configuration."""


class EventArrays(NamedTuple):
    """Events as NumPy arrays on the host, all of shape [n]."""

    t: NDArray[np.int64]
    """Time since the start of the episode [us]."""
    x: NDArray[np.uint16]
    """Column [px]."""
    y: NDArray[np.uint16]
    """Row [px]."""
    polarity: NDArray[np.uint8]
    """1: brighter, 0: darker."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Events(Packet):
    """The events of one window of time, sorted by (t, y, x, polarity).

    The window is the half-open interval (`start_ns`, `stamp_ns`]. Arrays have shape [n]. A run yields NumPy
    arrays; an `EventCamera` alone yields Warp arrays on a CUDA device, unless told otherwise. `numpy()` gives
    NumPy arrays in all cases.
    """

    t: Any
    """Time since the start of the episode, floored to the microsecond [us], int64."""
    x: Any
    """Column [px], uint16."""
    y: Any
    """Row [px], uint16."""
    polarity: Any
    """1: brighter, 0: darker, uint8."""
    width: int
    """Width of the sensor [px]."""
    height: int
    """Height of the sensor [px]."""
    start_ns: int = 0
    """Start of the window, not part of it [ns]."""
    dropped_count: int = 0
    """Events of this window that are lost: they did not fit into the buffer, or the readout's queue was
    full."""

    def __len__(self) -> int:
        return int(self.t.shape[0])

    def numpy(self) -> EventArrays:
        """Return the events as NumPy arrays on the host."""
        arrays = (
            a if isinstance(a, np.ndarray) else a.numpy() for a in (self.t, self.x, self.y, self.polarity)
        )
        return EventArrays(*arrays)


ImageEncoding = Literal["rgb8", "mono8", "32FC1", "32FC2", "32SC1"]
"""Names of ROS image encodings; what each sensor uses is in its docstring."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Image(Packet):
    """One picture.

    rgb8 is uint8 [H, W, 3] in sRGB. 32FC1 is float32 [H, W]; for depth it is planar z [m], inf where nothing
    was hit.
    """

    data: NDArray[Any]
    """Pixels, row-major, shape [H, W] or [H, W, C]."""
    encoding: ImageEncoding
    """What a pixel is."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImuSample(Packet):
    """What an inertial measurement unit reads at its stamp, in its own frame S."""

    specific_force: NDArray[np.float64]
    """Acceleration minus gravity at the mount, in S [m/s^2], shape [3]; at rest it points up with 9.81."""
    angular_rate: NDArray[np.float64]
    """Angular velocity of S against W, in S [rad/s], shape [3]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Odometry(Packet):
    """The true state of the vehicle."""

    position: NDArray[np.float64]
    """p_WB [m], shape [3]."""
    orientation: NDArray[np.float64]
    """q_WB, xyzw, shape [4]."""
    velocity: NDArray[np.float64]
    """v_WB in W [m/s], shape [3]."""
    body_rate: NDArray[np.float64]
    """w_WB in B [rad/s], shape [3]."""
    rotor_speed: NDArray[np.float64]
    """Speed of each rotor [rad/s], shape [R]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Collision(Packet):
    """The vehicle touches the scene: its centre is closer to a surface than its radius."""

    position: NDArray[np.float64]
    """p_WB at the stamp [m], shape [3]."""
    clearance_m: float
    """Distance from the vehicle's centre to the nearest surface, minus its radius [m]; <= 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Delivery(Packet):
    """What a simulated link did to one message; `sensor` is "<link>_link", `stamp_ns` when it was sent."""

    delivered_ns: int
    """When it arrives [ns]; -1: never."""
    size_bytes: int
    """Its size, as far as it takes bandwidth [bytes]."""
