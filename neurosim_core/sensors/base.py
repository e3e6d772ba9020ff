"""The interface of sensors: a sensor is one file that registers one subclass of these classes.

A *state sensor* (IMU, odometry) reads the state of the vehicles at its stamps: its config makes a `Sampler`.
An *image sensor* (RGB, depth) takes a picture that the renderer has computed: its config names the output of
the renderer, and turns the picture into a packet. A *frame sensor* (the event camera) sees every instant that
is rendered for it: its config makes a `FrameSensor`. The engine asks for nothing else, and never which sensor
it is.
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
    """Some of `render.outputs.OUTPUTS`."""
    rate_hz: float
    """Frequency [Hz]."""
    every_instant: bool = False
    """It has to see all instants that are rendered in its group, in order; its rate is that of the group."""
    max_displacement_px: float | None = None
    """Adaptive sampling: an instant is rendered only where something would move further than this [px]."""
    required: Rate | None = None
    """Ticks that are rendered in any case."""


class SensorConfig(BaseConfig):
    """Settings of a sensor. Subclasses add `kind: Literal["..."]` and are registered under that kind."""

    packet_type: ClassVar[type[Packet]]
    """Class of its packets, whatever its settings; `packet_class` may say more."""
    is_overlay: ClassVar[bool] = False
    """A viewer draws its pictures over those of a colour camera with the same view."""
    reported: ClassVar[Mapping[str, Callable[[Any], str]]] = {}
    """What the report of a flight says of its settings, by the title of the row."""

    if TYPE_CHECKING:
        kind: str
        """The kind under which it is registered; a field of every subclass."""

    @classmethod
    def check_class(cls) -> None:
        """Check what all sensors have, when the class is registered.

        Raises:
            TypeError: Its packets are not said, or cannot be recorded or sent; or it has no rate.
        """
        packet = getattr(cls, "packet_type", None)
        if not (isinstance(packet, type) and issubclass(packet, Packet)):
            raise TypeError(
                f"{cls.__qualname__} must say the class of its packets, a subclass of ns.Packet: "
                f"packet_type = ..., got {packet!r}"
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
        """When it samples."""
        return Rate(self.rate_hz)  # type: ignore[attr-defined]

    @property
    def packets(self) -> Rate:
        """When its packets come."""
        return self.clock

    @property
    def packet_class(self) -> type[Packet]:
        """Class of its packets with these settings: `packet_type`, or a subclass of it."""
        return self.packet_type


@dataclass(frozen=True, kw_only=True, eq=False)
class SamplerContext:
    """The context that a state sensor is made in."""

    name: str
    """Its name in the settings; two sensors with different names have independent noise."""
    vehicle: Multirotor
    """The vehicles of all worlds."""
    slot_count: int
    """Number of samples that its arrays hold."""
    seeds: Any
    """Seed of each world, device array of uint64, shape [world]."""
    active: Any
    """0 where a world is not measured, device array of int32, shape [world]."""
    surfaces: Any = None
    """The surfaces that vehicles can touch (`sim.trace.Surfaces`)."""


class Sampler(ABC):
    """A state sensor at work, in all worlds.

    Attributes:
        terms: What is computed beyond what every such sensor needs.
        arrays: What it measures, by name: device arrays of shape [slot, world, ...].
    """

    terms: tuple[str, ...] = ()
    arrays: Mapping[str, Any]

    @abstractmethod
    def measure(self, slot: int) -> None:
        """Measure all vehicles at their present state; launches only.

        Args:
            slot: Index into the first axis of `arrays` that the sample is written to.
        """

    @abstractmethod
    def packet(self, rows: Mapping[str, NDArray[Any]], **header: Any) -> Packet | None:
        """Return one sample of one world as a packet; None: it is lost, and the sequence shows the gap.

        Args:
            rows: The sample's element of each of `arrays`, by name, on the host: shape [...] of [slot, world,
                ...].
            header: `stamp_ns`, `sequence` and `sensor`, which the packet passes on.
        """

    def reset(self, mask: Any) -> None:  # noqa: B027  (most sensors have no memory)
        """Begin anew in some worlds; launches only.

        Args:
            mask: Not 0 where a world begins anew, device array of int32, shape [world].
        """


class StateSensorConfig(SensorConfig):
    """A sensor that reads the state of the vehicle."""

    def make(self, context: SamplerContext) -> Sampler:
        """Return the sensor at work."""
        raise NotImplementedError(f"{type(self).__name__} must say how it is made")


class StereoConfig(BaseConfig):
    """A second camera beside the first."""

    baseline_m: Annotated[float, Field(gt=0.0)]
    """Distance from the left camera to the right one [m], along a row of the picture."""


class RenderedConfig(SensorConfig):
    """A sensor that casts rays from a place on the body."""

    mount: Mount = Mount(position_m=(0.1, 0.0, 0.03))
    """Pose of the camera on the body."""

    @property
    def optics(self) -> Lens:
        """Which ways its rays go."""
        raise NotImplementedError(f"{type(self).__name__} must say where it looks")

    @property
    def timing(self) -> RayTiming | None:
        """When its rays are cast; None: all at the stamp."""
        return None

    @property
    def look_back_ns(self) -> int:
        """Time before the end of a batch for which it needs the motion of the vehicle [ns]."""
        return 0

    def render_request(self) -> RenderRequest:
        """Return what it asks of the renderer."""
        raise NotImplementedError(f"{type(self).__name__} must say what is rendered for it")


class CameraConfig(RenderedConfig):
    """Settings that all cameras have: a lens and a place on the body."""

    lens: AnyLens = PinholeConfig(width=346, height=260, horizontal_fov_rad=1.5)
    """Resolution and field of view: {kind: pinhole | radtan | rational | equidistant | double_sphere |
    ray_table, ...}, a pinhole if no kind is given."""
    stereo: StereoConfig | None = None
    """Makes two cameras of one, NAME_left where it is mounted, and NAME_right: {baseline_m: 0.12}."""

    @property
    def optics(self) -> Lens:
        """The lens."""
        return self.lens


@dataclass(frozen=True, kw_only=True, eq=False)
class PictureContext:
    """The context that the processing of the pictures of one sensor is made in."""

    name: str
    """Its name in the settings; two sensors with different names have independent noise."""
    source: Any
    """Pictures that the renderer writes, device array, shape [M, H, W, ...]; M image slots."""
    sources: Mapping[str, Any]
    """The same for all outputs that the sensor asks for, by name."""
    lenses: Sequence[Lens]
    """The lenses there are, all of one size."""
    lens_of_world: Any
    """Index into them of each world, device array of int32, shape [N]."""
    scenes: Sequence[Any]
    """The scenes as the renderer has them."""
    scene_of_world: Any
    """Index into them of each world, device array of int32, shape [N]."""
    motions: Any
    """Of the bodies, device array of `scene.bodies.Motion`; None: there are none."""
    times: RayTimes | None
    """When its rays are cast; None: all at the stamp."""
    stride: int
    """K, the most instants of a world in one batch."""
    seeds: Any
    """Seed of each world, device array of uint64, shape [N]."""


class PictureViews(NamedTuple):
    """From where and when the pictures of a batch were taken; device arrays, rows are [world, K] in order."""

    instant_count: int
    """Number of the K instants of each world that were rendered."""
    image_slot: Any
    """Slot of the picture of an instant, int32, shape [N K]; -1: there is none."""
    p_WC: Any
    """Position of the camera [m], vec3, shape [N K J], for the J times of its rays (1: the stamp)."""
    q_WC: Any
    """Orientation, likewise."""
    stamps: Any
    """Times [ns], int64, shape [N K J, 1]."""
    active: Any
    """0 where a world is not rendered, int32, shape [N]; None: all are."""
    bodies: Any
    """Poses of bodies at these times, `scene.bodies.BodyPoses`; None: there are none."""
    look: Callable[..., None]
    """Writes these poses at other times: of the offsets from the stamp [ns], int64, shape [J], not before
    `RenderedConfig.look_back_ns`; `p_WC`, `q_WC`, `stamps` and `bodies` are overwritten."""
    find_twists: Callable[[Any], None]
    """Writes velocities of the camera in W [m/s] and angular in C [rad/s] at the stamps, to an array of
    spatial_vectord, shape [N K]."""


class PictureProcess(Protocol):
    """Turns the rendered pictures into those of the sensor: adds noise, for example.

    Its pictures are those of an output that has image slots. What it draws is addressed by the stamp.
    """

    terms: tuple[str, ...]
    """Optional terms that it computes."""
    picture: Any
    """Pictures that it makes, device array, shape [M, H, W, ...]."""

    def launch(self, views: PictureViews) -> None:
        """Process the pictures of a batch that was just rendered; launches only."""


class PictureSensorConfig(RenderedConfig):
    """A sensor whose packet is made of one picture of one output of the renderer."""

    rate_hz: RateHz = 20.0
    """Pictures a second [Hz]."""

    output: ClassVar[str]
    """The rendered quantity, one of `render.outputs.OUTPUTS`."""

    @property
    def outputs(self) -> frozenset[str]:
        """All outputs that its pictures are made of."""
        return frozenset([self.output])

    def render_request(self) -> RenderRequest:
        """Return what it asks of the renderer."""
        return RenderRequest(outputs=self.outputs, rate_hz=self.rate_hz)

    @property
    def remembers(self) -> bool:
        """Whether a picture depends on those before: then one batch is rendered after the other."""
        return False

    def constants(self, context: PictureContext) -> Mapping[str, Any]:
        """Return fields that all its packets have, such as names of what is in the scene."""
        return {}

    def packet(self, picture: NDArray[Any], **header: Any) -> Packet:
        """Return a picture as a packet.

        Args:
            picture: The output of the renderer, or what `make_process` makes of it, on the host, shape [H, W]
                or [H, W, C]; the packet keeps it.
            header: `stamp_ns`, `sequence` and `sensor`, which the packet passes on.
        """
        raise NotImplementedError(f"{type(self).__name__} must say what its packets are")

    def make_process(self, context: PictureContext) -> PictureProcess | None:
        """Return what its pictures go through on the device, before anyone has them; None: nothing."""
        return None


class ImageSensorConfig(CameraConfig, PictureSensorConfig):
    """A camera that takes pictures of one output of the renderer."""

    shutter: ShutterConfig = ShutterConfig()
    """When lines are exposed: {readout_s: 0.02} rolls, {exposure_s: 0.005} blurs what moves; by default
    all rays are cast at the stamp."""

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
        """The shutter, unless it is global and takes no time."""
        return self.shutter if self.shutter.window_ns else None

    @property
    def packet_encoding(self) -> str:
        """Encoding of its pictures with these settings: `encoding`, unless a sensor says another."""
        return self.encoding

    def packet(self, picture: NDArray[Any], **header: Any) -> Packet:
        """Return a picture as a packet, whose class has `data` and `encoding`; see `PictureSensorConfig`."""
        packet: Packet = self.packet_class(data=picture, encoding=self.packet_encoding, **header)  # type: ignore[call-arg]
        return packet


class FrameSensor(ABC):
    """A frame sensor at work in all worlds: it sees every instant that is rendered for it.

    What it makes of the frames stays on the device, in `results`, or goes to the host as packets: the context
    says which is wanted (`FrameContext.on_host`). Frames come batch by batch: `plan` for each, and where
    there are packets `begin_read` for the oldest one that was not read.

    Attributes:
        terms: What is computed beyond what every such sensor needs.
        results: What it found in the last batch, on the device.
    """

    terms: tuple[str, ...] = ()
    results: Any = None

    @abstractmethod
    def begin(self, frames: Any, stamp_ns: int, mask: Any) -> None:
        """Take the first frame of each world as its reference.

        Args:
            frames: As of `plan`.
            stamp_ns: Time of the first frame [ns].
            mask: Not 0 where a world begins, device array of int32, shape [N].
        """

    @abstractmethod
    def plan(self, frames: Any, stamps_ns: Sequence[int], end_ns: int) -> Launches | None:
        """Return what makes something of the frames of a batch; None: nothing is to be done.

        Keys of launches tell those of this sensor apart; other sensors may have the same.

        Args:
            frames: Log radiance, device array of float32, shape [N K, H, W]; stays as it is until the batch
                has been read. It is there when the launches run.
            stamps_ns: Times of the first frames of each world [ns], at most K, increasing. There may be none,
                in a run also before `begin`.
            end_ns: End of the batch [ns].
        """

    def begin_read(self, stamps_ns: Sequence[int], *, until_ns: int) -> Callable[[], list[Packet]]:
        """Wait for the oldest batch; return the function that returns the packets that end in it.

        That function is called next, or after the launches of one more batch.

        Args:
            stamps_ns: Times of the frames of the batch [ns].
            until_ns: Packets that end later are not returned [ns].
        """
        raise NotImplementedError(f"{type(self).__name__} has no packets: its results stay on the device")

    def flush(self, *, until_ns: int) -> list[Packet]:
        """Return the packet that has begun and not ended, cut at a stamp [ns]."""
        return []

    def seed(self, seeds: Sequence[int], worlds: Collection[int] | None = None) -> None:
        """Draw what stays in the pixels of some worlds anew; waits for the device.

        Args:
            seeds: Seed of each world, of all N.
            worlds: Indices of the worlds whose pixels are drawn; None: all.
        """
        if self.terms:
            raise NotImplementedError(f"{type(self).__name__} cannot draw its noise anew")


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameContext:
    """The context that a frame sensor is made in."""

    name: str
    """Its name in the settings; two sensors with different names have independent noise."""
    configs: Sequence[Any]
    """Its settings in each world."""
    lens: Lens
    device: str
    on_host: bool
    """There is one world, and packets of it are wanted; else results stay on the device."""
    in_flight: int
    """The most batches that it has seen and that were not read."""
    instant_count: int
    """K, the most frames of a world in one batch."""
    capacity: int
    """Room for results of one world in one batch (`FrameSensorConfig.world_capacity`)."""
    ordered: bool
    """Sort the results of each world."""
    seeds: Sequence[int]
    """Of each world."""
    clock_ns: Any
    """Time of each world at the end of the batch [ns], device array of int64, shape [N]."""
    scene: Any
    """As the renderer has it."""
    motions: Any
    """Of the bodies, device array of `scene.bodies.Motion`; None: there are none."""
    history: Any
    """The flight, as far back as `look_back_ns` says (`vehicle.history.History`)."""
    p_BC: Any
    """Position of the camera on the body [m], vec3d."""
    q_BC: Any
    """Orientation of the camera against the body, quatd."""


class FrameSensorConfig(CameraConfig):
    """A camera that sees every instant that is rendered for it."""

    def world_capacity(self, world_count: int, event_capacity: int | None) -> int:
        """Return for how many results of each world there is room in a batch.

        Args:
            world_count: Number of worlds N.
            event_capacity: What the user asks for; None: as the sensor likes.

        Raises:
            ValueError: They are more than can be counted.
        """
        return event_capacity or 0

    def make(self, context: FrameContext) -> FrameSensor:
        """Return the sensor at work.

        Raises:
            ValueError: It cannot be in many worlds, or in one; the message says why.
        """
        raise NotImplementedError(f"{type(self).__name__} must say how it is made")
