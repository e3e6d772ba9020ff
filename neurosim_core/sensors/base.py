"""The interface of sensors: a sensor is one file that registers one subclass of these classes.

- A *state sensor* (IMU, odometry) reads the state of the vehicles at its stamps. Its config makes a
  `Sampler`.
- An *image sensor* (RGB, depth) takes pictures. Its config names an output of the renderer, and makes a
  packet of a picture.
- A *frame sensor* (the event camera) processes every rendered instant. Its config makes a `FrameSensor`.

The engine uses these interfaces only, and has no code for a particular sensor.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Protocol

from numpy.typing import NDArray
from pydantic import Field, model_validator

from neurosim_core.clock import Rate
from neurosim_core.frames import Mount
from neurosim_core.packets import Image, ImageEncoding, Packet, schema_of
from neurosim_core.render.camera import Lens, PinholeConfig
from neurosim_core.render.lenses import AnyLens
from neurosim_core.render.ray_times import RayTimes, RayTiming, ShutterConfig
from neurosim_core.runtime.cuda import Launches
from neurosim_core.settings import BaseConfig
from neurosim_core.vehicle import Multirotor

RateHz = Annotated[float, Field(gt=0.0, le=1e6)]
"""Type of the rate of a sensor in its settings [Hz]: in (0, 1e6]."""


class RenderRequest(NamedTuple):
    """The request of a camera to the renderer."""

    outputs: frozenset[str]
    """Render outputs, a subset of `render.outputs.OUTPUTS`."""
    rate_hz: float
    """Render rate [Hz]."""
    every_instant: bool = False
    """The camera processes all rendered instants of its group, in order; its rate is that of the group."""
    max_displacement_px: float | None = None
    """Adaptive sampling: skip an instant as long as no point has moved further than this [px]."""
    required: Rate | None = None
    """Ticks that adaptive sampling never skips."""


class SensorConfig(BaseConfig):
    """Settings of a sensor. Subclasses add `kind: Literal["..."]` and are registered under that kind."""

    packet_type: ClassVar[type[Packet]]
    """Class of its packets; `packet_class` may return a subclass for some settings."""
    is_overlay: ClassVar[bool] = False
    """A viewer draws its pictures over those of a colour camera with the same view."""
    reported: ClassVar[Mapping[str, Callable[[Any], str]]] = {}
    """Rows of the flight report: title -> function that describes the settings."""

    if TYPE_CHECKING:
        kind: str
        """The kind under which it is registered; a field of every subclass."""

    @classmethod
    def check_class(cls) -> None:
        """Check the class when it is registered.

        Raises:
            TypeError: It has no packet type or no rate, or its packets cannot be recorded or sent.
        """
        packet = getattr(cls, "packet_type", None)
        if not (isinstance(packet, type) and issubclass(packet, Packet)):
            raise TypeError(
                f"{cls.__qualname__}.packet_type must be a subclass of ns.Packet, got {packet!r}: add "
                "`packet_type = MyPacket`"
            )
        loose = [field.name for field in schema_of(packet).fields if "..." in field.shape]
        if loose and packet is not Image:
            raise TypeError(
                f"{packet.__qualname__}.{loose[0]}: the array needs axes, such as "
                "Annotated[NDArray[np.float32], FieldSpec(3)], or FieldSpec('n', 3) if their number varies"
            )
        if "rate_hz" not in cls.model_fields and cls.clock is SensorConfig.clock:
            raise TypeError(f"{cls.__qualname__} needs a field `rate_hz: RateHz = 100.0`, or its own `clock`")

    @property
    def clock(self) -> Rate:
        """Clock of its samples."""
        return Rate(self.rate_hz)  # type: ignore[attr-defined]

    @property
    def packets(self) -> Rate:
        """Clock of its packets."""
        return self.clock

    @property
    def packet_class(self) -> type[Packet]:
        """Class of its packets with these settings: `packet_type`, or a subclass of it."""
        return self.packet_type


@dataclass(frozen=True, kw_only=True, eq=False)
class SamplerContext:
    """Arguments of `StateSensorConfig.make`."""

    name: str
    """Name of the sensor in the settings; sensors with different names have independent noise."""
    vehicle: Multirotor
    """The vehicles of all worlds."""
    slot_count: int
    """Number of samples that the sampler's arrays must hold."""
    seeds: Any
    """Seed of each world, device array of uint64, shape [world]."""
    active: Any
    """0 for worlds that are not measured, device array of int32, shape [world]."""
    surfaces: Any = None
    """The surfaces that vehicles can touch (`sim.trace.Surfaces`)."""


class Sampler(ABC):
    """A state sensor in all worlds, made by its config.

    Attributes:
        terms: Names of optional terms that it computes, such as noise; for the flight report.
        arrays: Its measurements by name, device arrays of shape [slot, world, ...].
    """

    terms: tuple[str, ...] = ()
    arrays: Mapping[str, Any]

    @abstractmethod
    def measure(self, slot: int) -> None:
        """Measure all vehicles at their present state; only launch kernels and copies, do not wait.

        Args:
            slot: Index of the sample in the first axis of `arrays`.
        """

    @abstractmethod
    def packet(self, rows: Mapping[str, NDArray[Any]], **header: Any) -> Packet | None:
        """Return one sample of one world as a packet. None: the sample is lost, a gap in `sequence`.

        Args:
            rows: The sample in each of `arrays`, by name, on the host: shape [...] of [slot, world, ...].
            header: `stamp_ns`, `sequence` and `sensor`; pass them to the packet.
        """

    def reset(self, mask: Any) -> None:  # noqa: B027  (most sensors have no memory)
        """Reset the memory of the sensor in some worlds; only launch kernels and copies, do not wait.

        Args:
            mask: Not 0 for worlds that are reset, device array of int32, shape [world].
        """


class StateSensorConfig(SensorConfig):
    """Settings of a sensor that reads the state of the vehicle."""

    def make(self, context: SamplerContext) -> Sampler:
        """Return the sampler for all worlds."""
        raise NotImplementedError(
            f"{type(self).__name__} must define `make(context)`, which returns a Sampler"
        )


class StereoConfig(BaseConfig):
    """Settings of a stereo pair."""

    baseline_m: Annotated[float, Field(gt=0.0)]
    """Distance from the left camera to the right one [m], along a row of the picture."""


class RenderedConfig(SensorConfig):
    """Settings of a sensor that casts rays from a mount on the body."""

    mount: Mount = Mount(position_m=(0.1, 0.0, 0.03))
    """Pose of the camera on the body."""

    @property
    def optics(self) -> Lens:
        """Directions of its rays."""
        raise NotImplementedError(f"{type(self).__name__} must define the property `optics`, a lens")

    @property
    def timing(self) -> RayTiming | None:
        """Times of its rays relative to the stamp; None: all are cast at the stamp."""
        return None

    @property
    def look_back_ns(self) -> int:
        """Length of the motion history that it needs before the end of a batch [ns]."""
        return 0

    def render_request(self) -> RenderRequest:
        """Return its request to the renderer."""
        raise NotImplementedError(
            f"{type(self).__name__} must define `render_request()`, which returns a RenderRequest"
        )


class CameraConfig(RenderedConfig):
    """Settings of all cameras: a lens and a mount on the body."""

    lens: AnyLens = PinholeConfig(width=346, height=260, horizontal_fov_rad=1.5)
    """Resolution and field of view: {kind: pinhole | radtan | rational | equidistant | double_sphere |
    ray_table, ...}, a pinhole if no kind is given."""
    stereo: StereoConfig | None = None
    """Replaces the camera NAME by two: NAME_left at the mount, and NAME_right: {baseline_m: 0.12}."""

    @property
    def optics(self) -> Lens:
        """The lens."""
        return self.lens


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureContext:
    """Arguments of `PictureSensorConfig.make_process` and `constants`."""

    name: str
    """Name of the sensor in the settings; sensors with different names have independent noise."""
    source: Any
    """Pictures that the renderer writes for `output`, device array, shape [M, H, W, ...]; M image slots."""
    sources: Mapping[str, Any]
    """The same for each name in `outputs`."""
    lenses: Sequence[Lens]
    """Lenses of the camera, all of one size."""
    lens_of_world: Any
    """Index of the lens of each world, device array of int32, shape [N]."""
    scenes: Sequence[Any]
    """The scenes in the form that the renderer keeps."""
    scene_of_world: Any
    """Index of the scene of each world, device array of int32, shape [N]."""
    motions: Any
    """Motions of the bodies, device array of `scene.bodies.Motion`; None: there are no bodies."""
    times: RayTimes | None
    """Times of its rays relative to the stamp; None: all are cast at the stamp."""
    stride: int
    """K, the largest number of instants of a world in one batch."""
    seeds: Any
    """Seed of each world, device array of uint64, shape [N]."""


class PictureViews(NamedTuple):
    """Camera poses and times of the pictures of a batch; device arrays with rows in the order [world, K]."""

    instant_count: int
    """Number of rendered instants of each world, at most K."""
    image_slot: Any
    """Image slot of each instant, int32, shape [N K]; -1: no picture."""
    p_WC: Any
    """Position of the camera [m], vec3, shape [N K J]; J is the number of ray times (1: the stamp)."""
    q_WC: Any
    """Orientation of the camera, xyzw, quat, same shape."""
    stamps: Any
    """Times of the poses [ns], int64, shape [N K J, 1]."""
    active: Any
    """0 for worlds that are not rendered, int32, shape [N]; None: all worlds are rendered."""
    bodies: Any
    """Poses of bodies at these times, `scene.bodies.BodyPoses`; None: there are no bodies."""
    compute_poses: Callable[..., None]
    """Computes poses at other times. Its argument is an array of offsets from the stamp [ns], int64, shape
    [J], within `RenderedConfig.look_back_ns`; it overwrites the arrays given as keywords `p_WC`, `q_WC`,
    `stamps` and `bodies`."""
    compute_twists: Callable[[Any], None]
    """Computes velocities of the camera at the stamps, linear in W [m/s] and angular in C [rad/s], into a
    device array of spatial_vectord, shape [N K]."""


class PictureProcess(Protocol):
    """Processing of rendered pictures on the device, such as noise.

    It needs an output with image slots. Random numbers are addressed by the stamp.
    """

    terms: tuple[str, ...]
    """Names of optional terms that it computes; for the flight report."""
    picture: Any
    """Pictures that it writes, device array, shape [M, H, W, ...]."""

    def launch(self, views: PictureViews) -> None:
        """Process the pictures of a batch; only launch kernels and copies, do not wait."""


class PictureSensorConfig(RenderedConfig):
    """Settings of a sensor that makes each packet from one picture of a render output."""

    rate_hz: RateHz = 20.0
    """Pictures a second [Hz]."""

    output: ClassVar[str]
    """Name of the render output, one of `render.outputs.OUTPUTS`."""

    @property
    def outputs(self) -> frozenset[str]:
        """Names of all render outputs that it needs."""
        return frozenset([self.output])

    @classmethod
    def check_class(cls) -> None:
        """Check the class when it is registered, and that it has an `output`."""
        super().check_class()
        if not hasattr(cls, "output"):
            raise TypeError(f'{cls.__qualname__} must name a render output, such as output = "depth"')

    def render_request(self) -> RenderRequest:
        """Return its request to the renderer."""
        return RenderRequest(outputs=self.outputs, rate_hz=self.rate_hz)

    @property
    def remembers(self) -> bool:
        """Whether a picture depends on earlier pictures; batches are then rendered one after the other."""
        return False

    def constants(self, context: PictureContext) -> Mapping[str, Any]:
        """Return packet fields that are the same in all its packets, such as names of objects."""
        return {}

    def packet(self, picture: NDArray[Any], **header: Any) -> Packet:
        """Return a picture as a packet.

        Args:
            picture: The render output, or the picture of `make_process`, on the host, shape [H, W] or
                [H, W, C]; the packet may keep it.
            header: `stamp_ns`, `sequence` and `sensor`; pass them to the packet.
        """
        raise NotImplementedError(f"{type(self).__name__} must define `packet(picture, **header)`")

    def make_process(self, context: PictureContext) -> PictureProcess | None:
        """Return the processing of its pictures on the device; None: none."""
        return None


class ImageSensorConfig(CameraConfig, PictureSensorConfig):
    """Settings of a camera that takes pictures of one render output."""

    shutter: ShutterConfig = ShutterConfig()
    """Exposure times of lines: {readout_s: 0.02} is a rolling shutter, {exposure_s: 0.005} blurs motion. By
    default all rays are cast at the stamp."""

    packet_type: ClassVar[type[Packet]] = Image
    encoding: ClassVar[ImageEncoding]
    """Encoding of a pixel of its pictures."""

    @model_validator(mode="after")
    def _pictures_do_not_overlap(self) -> ImageSensorConfig:
        for name in ("readout_s", "exposure_s"):
            if (time_s := getattr(self.shutter, name)) * self.rate_hz > 1.0 + 1e-6:
                raise ValueError(
                    f"shutter.{name} must be at most 1 / rate_hz = {1.0 / self.rate_hz:g}, got {time_s:g}"
                )
        return self

    @property
    def timing(self) -> RayTiming | None:
        """The shutter; None for a global shutter without exposure time."""
        return self.shutter if self.shutter.window_ns else None

    @property
    def packet_encoding(self) -> str:
        """Encoding of its pictures with these settings; by default `encoding`."""
        return self.encoding

    def packet(self, picture: NDArray[Any], **header: Any) -> Packet:
        """Return a packet with the fields `data` and `encoding`; see `PictureSensorConfig.packet`."""
        packet: Packet = self.packet_class(data=picture, encoding=self.packet_encoding, **header)  # type: ignore[call-arg]
        return packet


class FrameSensor(ABC):
    """A frame sensor in all worlds, made by its config. It processes every rendered instant.

    With `FrameContext.on_host`, its results go to the host as packets; else they stay on the device in
    `results`. The engine calls `plan` for each batch and, for packets, `begin_read` for the oldest batch that
    was not read.

    Attributes:
        terms: Names of optional terms that it computes, such as noise; for the flight report.
        results: Results of the last batch, on the device.
    """

    terms: tuple[str, ...] = ()
    results: Any = None

    @abstractmethod
    def begin(self, frames: Any, stamp_ns: int, mask: Any) -> None:
        """Take the first frame of each world as its reference.

        Args:
            frames: See `plan`.
            stamp_ns: Time of the first frame [ns].
            mask: Not 0 for worlds that take a new reference, device array of int32, shape [N].
        """

    @abstractmethod
    def plan(self, frames: Any, stamps_ns: Sequence[int], end_ns: int) -> Launches | None:
        """Return the launches that process the frames of a batch; None: there is nothing to do.

        Keys of launches must be unique within this sensor.

        Args:
            frames: Log radiance, device array of float32, shape [N K, H, W]. It is written before the
                launches run, and valid until the batch has been read.
            stamps_ns: Times of the valid frames of each world [ns], at most K, increasing. The list may be
                empty, also before the first `begin`.
            end_ns: End of the batch [ns].
        """

    def begin_read(self, stamps_ns: Sequence[int], *, until_ns: int) -> Callable[[], list[Packet]]:
        """Wait for the oldest batch; return a function that returns its packets.

        The engine calls that function next, or after the launches of one more batch.

        Args:
            stamps_ns: Times of the frames of the batch [ns].
            until_ns: Last stamp of packets to return [ns].
        """
        raise NotImplementedError(f"{type(self).__name__} has no packets: its results stay on the device")

    def flush(self, *, until_ns: int) -> list[Packet]:
        """Return the packet of the open window, cut at a stamp [ns]; for the end of a run."""
        return []

    def seed(self, seeds: Sequence[int], worlds: Collection[int] | None = None) -> None:
        """Draw the constant noise of the pixels of some worlds again; waits for the device.

        Args:
            seeds: Seed of each of the N worlds.
            worlds: Indices of the worlds to draw; None: all.
        """
        if self.terms:
            raise NotImplementedError(
                f"{type(self).__name__} has noise and must define `seed(seeds, worlds)` to take new seeds"
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameContext:
    """Arguments of `FrameSensorConfig.make`."""

    name: str
    """Name of the sensor in the settings; sensors with different names have independent noise."""
    configs: Sequence[Any]
    """Settings of the sensor in each world."""
    lens: Lens
    """Lens of the camera."""
    device: str
    """Warp device."""
    on_host: bool
    """The sensor returns packets of one world; else its results stay on the device."""
    in_flight: int
    """Largest number of batches that are launched and not read."""
    instant_count: int
    """K, the largest number of frames of a world in one batch."""
    capacity: int
    """Capacity for results of one world in one batch (`FrameSensorConfig.world_capacity`)."""
    ordered: bool
    """Sort the results of each world."""
    seeds: Sequence[int]
    """Seed of each world."""
    clock_ns: Any
    """Time of each world at the end of the batch [ns], device array of int64, shape [N]."""
    scene: Any
    """The scene in the form that the renderer keeps."""
    motions: Any
    """Motions of the bodies, device array of `scene.bodies.Motion`; None: there are no bodies."""
    history: Any
    """Motion history of length `look_back_ns` (`vehicle.history.History`)."""
    p_BC: Any
    """Position of the camera on the body [m], vec3d."""
    q_BC: Any
    """Orientation of the camera on the body, quatd."""


class FrameSensorConfig(CameraConfig):
    """Settings of a camera that processes every rendered instant."""

    def world_capacity(self, world_count: int, event_capacity: int | None) -> int:
        """Return the capacity for results of each world in a batch.

        Args:
            world_count: Number of worlds N.
            event_capacity: Capacity that the user asks for; None: the sensor's own choice.

        Raises:
            ValueError: The capacity of all worlds is too large.
        """
        return event_capacity or 0

    def make(self, context: FrameContext) -> FrameSensor:
        """Return the frame sensor for all worlds.

        Raises:
            ValueError: The sensor or its settings do not support many worlds; the message says why.
        """
        raise NotImplementedError(
            f"{type(self).__name__} must define `make(context)`, which returns a FrameSensor"
        )
