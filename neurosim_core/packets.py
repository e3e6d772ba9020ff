"""The packets of a run: one frozen record per measurement, stamped in integer simulation time.

A sensor declares its packet as a frozen dataclass. The annotations are its schema, from which recordings,
pictures, plots and messages are derived, so that no other file has to know the class:

    @dataclass(frozen=True, kw_only=True, eq=False)
    class Ranges(Packet):
        display: ClassVar[str] = "points"
        hits: Annotated[NDArray[np.float32], FieldSpec("n", 3, unit="m")]
        range_max_m: float
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from neurosim_core.docstrings import field_docs

_UNITS = ("ns", "us", "s", "m", "px", "hz", "rad", "rad_s", "m_s", "m_s2", "n", "kg", "bytes")
_SCALARS: dict[Any, str] = {int: "int64", float: "float64", bool: "bool", str: "str"}
_classes: dict[str, type[Packet]] = {}

PACKET_CLASSES: Mapping[str, type[Packet]] = MappingProxyType(_classes)
"""The known packet classes by name. A class is known as soon as its module is imported."""


def _name(cls: type) -> str:
    own = cls.__module__.partition(".")[0] == __name__.partition(".")[0]
    return cls.__qualname__ if own else f"{cls.__module__}.{cls.__qualname__}"


@dataclass(frozen=True)
class FieldSpec:
    """The unit, shape and meaning of a packet's field; part of its annotation."""

    shape: tuple[int | str, ...] = ()
    """Lengths of the axes. A number is fixed. An upper-case name, such as "H", is a length that the first
    packet of a sensor fixes. A lower-case name, such as "n", is a length that differs from packet to packet;
    only the first axis may have one. "..." stands for any axes that the first packet fixes."""
    unit: str = ""
    """SI symbol; empty for counts."""
    dtype: str = ""
    """Type of the items; empty: that of the annotation."""
    constant: bool = False
    """Every packet of a sensor has the same value."""
    frame: str = ""
    """Frame in which the components are expressed, such as "world"; empty where there is none."""

    def __init__(
        self, *shape: int | str, unit: str = "", dtype: str = "", constant: bool = False, frame: str = ""
    ) -> None:
        values = {"shape": shape, "unit": unit, "dtype": dtype, "constant": constant, "frame": frame}
        for name, value in values.items():
            object.__setattr__(self, name, value)


class FieldSchema(NamedTuple):
    """One field of a packet class."""

    name: str
    dtype: str
    """Name of a NumPy type, "str", or "any": that of the first packet of a sensor."""
    shape: tuple[int | str, ...] = ()
    """As in `FieldSpec`; empty for a scalar or a string."""
    unit: str = ""
    constant: bool = False
    doc: str = ""
    frame: str = ""

    @property
    def varying(self) -> str:
        """Name of the length that differs from packet to packet; empty if none does."""
        return str(self.shape[0]) if self.shape and str(self.shape[0])[0].islower() else ""

    @property
    def is_number(self) -> bool:
        """Whether the field is a number, or an array of them of rank 1 and fixed length."""
        return self.dtype != "str" and not self.constant and not self.varying and len(self.shape) <= 1


class PacketSchema(NamedTuple):
    """The structure of a packet class."""

    name: str
    """Name of the class; with its module if that is not part of Neurosim."""
    display: str
    """How packets are shown: a key of `view.rerun_log.DISPLAYS`."""
    fields: tuple[FieldSchema, ...]
    """The fields after the header (stamp_ns, sequence, sensor)."""
    doc: str = ""

    @property
    def has_events(self) -> bool:
        """Whether packets have all that those of `Events` have."""
        return {*_structure(schema_of(Events))} <= {*_structure(self)}

    def field(self, name: str) -> FieldSchema:
        """Return a field by its name."""
        return next(field for field in self.fields if field.name == name)

    def to_json(self) -> str:
        """Return the schema as JSON."""
        fields = [field._asdict() for field in self.fields]
        return json.dumps({"name": self.name, "display": self.display, "doc": self.doc, "fields": fields})

    @classmethod
    def from_json(cls, text: str) -> PacketSchema:
        """Return the schema of a text that `to_json` made."""
        values = json.loads(text)
        fields = (FieldSchema(**{**field, "shape": tuple(field["shape"])}) for field in values["fields"])
        return cls(values["name"], values["display"], tuple(fields), values["doc"])


@dataclass(frozen=True, kw_only=True, eq=False)
class Packet:
    """The header of every packet. Defining a subclass registers it by its name."""

    display: ClassVar[str] = ""
    """How packets are shown in Rerun and in the overview: "image", "depth", "segmentation", "normals",
    "flow", "events", "points", "time series", "bars", "text", "pose", "contact", "delay" or "none"; empty:
    what suits the schema."""

    stamp_ns: int = 0
    """Simulation time of the measurement [ns]."""
    sequence: int = 0
    """Counts the packets of one sensor from 0; a gap is a loss."""
    sensor: str = ""
    """Name of the sensor in the configuration."""

    def __init_subclass__(cls, *, known: bool = True) -> None:
        if known:
            _classes[_name(cls)] = cls


class GenericPacket(Packet, known=False):
    """A packet of a recording whose class is not known here: the same fields, without methods."""

    _schema: ClassVar[PacketSchema]

    def __init_subclass__(cls) -> None:
        """Leave the table of known classes as it is."""


def packet_class(schema: PacketSchema) -> type[Packet]:
    """Return the known class of a schema, or a new subclass of `GenericPacket` if there is none.

    A known class whose fields differ from the schema, as in another version of a plug-in, does not count.
    """
    known = _classes.get(schema.name)
    if known is not None and _structure(schema_of(known)) == _structure(schema):
        return known
    return _generic_class(schema)


def schema_of(cls: type[Packet]) -> PacketSchema:
    """Return the schema of a packet class.

    Raises:
        TypeError: A field has an annotation that no recording can hold; the message names it.
    """
    known: Any = cls  # mypy does not take classes for hashable
    schema: PacketSchema = cls._schema if issubclass(cls, GenericPacket) else _derived_schema(known)
    return schema


@functools.cache
def _derived_schema(cls: Any) -> PacketSchema:
    header = {field.name for field in dataclasses.fields(Packet)}
    hints = get_type_hints(cls, include_extras=True)
    docs = field_docs(cls)
    fields = tuple(
        _field_schema(cls, field.name, hints[field.name], docs.get(field.name, ""))
        for field in dataclasses.fields(cls)
        if field.name not in header
    )
    return PacketSchema(_name(cls), cls.display or _display(fields), fields, inspect.getdoc(cls) or "")


def as_numpy(value: Any) -> NDArray[Any]:
    """Return a field of a packet as a NumPy array; what is on a device is copied to the host."""
    return np.asarray(
        value if isinstance(value, np.ndarray) or not hasattr(value, "numpy") else value.numpy()
    )


def _structure(schema: PacketSchema) -> list[tuple[Any, ...]]:
    return [field[:5] for field in schema.fields]


@functools.cache
def _generic_class(schema: PacketSchema) -> type[Packet]:
    annotations = [(field.name, Any) for field in schema.fields]
    namespace = {"_schema": schema, "display": schema.display, "__doc__": schema.doc}
    name = schema.name.rpartition(".")[2]
    return dataclasses.make_dataclass(
        name, annotations, bases=(GenericPacket,), namespace=namespace, frozen=True, kw_only=True, eq=False
    )


def _field_schema(cls: type, name: str, hint: Any, doc: str) -> FieldSchema:
    spec, kind = None, hint
    if get_origin(hint) is Annotated:
        kind, *extras = get_args(hint)
        spec = next((extra for extra in extras if isinstance(extra, FieldSpec)), None)
    if get_origin(kind) is Literal:
        kind = type(get_args(kind)[0])
    if (alias := getattr(get_origin(kind), "__value__", None)) is not None:  # NDArray of NumPy 2.5
        kind = alias[get_args(kind)]
    dtype = spec.dtype if spec is not None else ""
    is_array = get_origin(kind) is np.ndarray
    if not dtype and is_array:
        items = get_args(get_args(kind)[1])[0]
        dtype = "any" if items is Any else np.dtype(items).name
    dtype = dtype or _SCALARS.get(kind, "")
    if not dtype:
        raise TypeError(
            f"field {name!r} of packet {cls.__name__} is annotated {hint}; allowed are int, float, bool, "
            "str, NDArray[...], and Annotated with a FieldSpec that has a dtype"
        )
    spec = spec or FieldSpec(*(("...",) if is_array else ()))
    unit = spec.unit
    if not unit and (ending := re.search(r"_(rad_s|m_s2|m_s|[a-z]+)$", name)) and ending[1] in _UNITS:
        unit = {"hz": "Hz", "n": "N"}.get(ending[1], ending[1].replace("_s2", "/s^2").replace("_s", "/s"))
    return FieldSchema(name, dtype, spec.shape, unit, spec.constant, doc, spec.frame)


def _display(fields: tuple[FieldSchema, ...]) -> str:
    """Return how packets of a class that does not say it are shown."""
    if any(len(f.shape) >= 2 and {str} == {type(n) for n in f.shape[:2]} and not f.varying for f in fields):
        return "image"
    if any(f.varying and f.shape[1:] == (3,) for f in fields):
        return "points"
    if any(f.is_number for f in fields):
        return "time series"
    if any(f.varying and len(f.shape) == 1 for f in fields):
        return "bars"
    return "text" if any(f.dtype == "str" for f in fields) else "none"


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

    def rows(self, index: slice | NDArray[Any]) -> EventArrays:
        """Return some of the events: of a slice, a mask, or an array of indices."""
        return EventArrays(self.t[index], self.x[index], self.y[index], self.polarity[index])


NO_EVENTS = EventArrays(
    np.zeros(0, np.int64), np.zeros(0, np.uint16), np.zeros(0, np.uint16), np.zeros(0, np.uint8)
)


def join_events(parts: Sequence[EventArrays]) -> EventArrays:
    """Return the events of all parts, one after the other, as new arrays."""
    if not parts:
        return NO_EVENTS
    return EventArrays(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


@dataclass(frozen=True, kw_only=True, eq=False)
class Events(Packet):
    """The events of one window of time, sorted by (t, y, x, polarity).

    The window is the half-open interval (`start_ns`, `stamp_ns`]. Arrays have shape [n]. A run yields NumPy
    arrays; an `EventCamera` alone yields Warp arrays on a CUDA device, unless told otherwise. `numpy()` gives
    NumPy arrays in all cases.
    """

    display: ClassVar[str] = "events"

    t: Annotated[Any, FieldSpec("event", unit="us", dtype="int64")]
    """Time since the start of the episode, floored to the microsecond [us], int64."""
    x: Annotated[Any, FieldSpec("event", unit="px", dtype="uint16")]
    """Column [px], uint16."""
    y: Annotated[Any, FieldSpec("event", unit="px", dtype="uint16")]
    """Row [px], uint16."""
    polarity: Annotated[Any, FieldSpec("event", dtype="uint8")]
    """1: brighter, 0: darker, uint8."""
    width: Annotated[int, FieldSpec(unit="px", constant=True)]
    """Width of the sensor [px]."""
    height: Annotated[int, FieldSpec(unit="px", constant=True)]
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
        return EventArrays(*(as_numpy(values) for values in (self.t, self.x, self.y, self.polarity)))


ImageEncoding = Literal[
    "rgb8", "mono8", "rgb16", "mono16", "32FC1", "32FC2", "32FC3", "32SC1",
    "bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8",
    "bayer_rggb16", "bayer_bggr16", "bayer_gbrg16", "bayer_grbg16",
]  # fmt: skip
"""Names of ROS image encodings; `Image` says what they hold."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Image(Packet):
    """One picture.

    | encoding | data | content |
    | --- | --- | --- |
    | rgb8, mono8 | uint8 [H, W, 3], [H, W] | colour or grey in sRGB |
    | rgb16, mono16 | uint16 [H, W, 3], [H, W] | the same in 16 bits, or as the camera says |
    | bayer_rggb8, ..., bayer_grbg16 | uint8, uint16 [H, W] | one colour at each pixel |
    | 32FC1 | float32 [H, W] | depth: planar z [m], inf where nothing was hit |
    | 32FC2 | float32 [H, W, 2] | optical flow (x, y) [px] |
    | 32FC3 | float32 [H, W, 3] | surface normals, unit vectors, 0 where nothing was hit |
    | 32SC1 | int32 [H, W] | labels of instances, below 0 where nothing was hit |
    """

    data: Annotated[NDArray[Any], FieldSpec("H", "W", "...")]
    """Pixels, row-major, shape [H, W] or [H, W, C]."""
    encoding: Annotated[ImageEncoding, FieldSpec(constant=True)]
    """Encoding of a pixel."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PointCloud(Packet):
    """One sweep of a LiDAR: the rays that came back, in the order of time; its stamp is that of the last."""

    display: ClassVar[str] = "points"

    points: Annotated[NDArray[np.float32], FieldSpec("n", 3, unit="m", frame="sensor")]
    """Positions in S (x forward, y left, z up) [m], shape [n, 3]: of S when each ray was cast, or if
    `deskewed`, at the stamp."""
    intensity: Annotated[NDArray[np.float32], FieldSpec("n", unit="1/m^2")]
    """albedo cos / r^2, shape [n]."""
    ring: Annotated[NDArray[np.uint16], FieldSpec("n")]
    """Which laser it was, shape [n]."""
    t: Annotated[NDArray[np.uint32], FieldSpec("n", unit="ns")]
    """When its ray was cast, since `start_ns` [ns], shape [n]."""
    start_ns: int
    """When the first ray was cast [ns]; before stamp 0 the vehicle stands where it begins."""
    deskewed: Annotated[bool, FieldSpec(constant=True)]
    """All points are seen from the pose at the stamp."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImuSample(Packet):
    """The reading of an inertial measurement unit at its stamp, in its own frame S."""

    specific_force: Annotated[NDArray[np.float64], FieldSpec(3, unit="m/s^2")]
    """Acceleration minus gravity at the mount, in S [m/s^2], shape [3]; at rest it points up with 9.81."""
    angular_rate: Annotated[NDArray[np.float64], FieldSpec(3, unit="rad/s")]
    """Angular velocity of S against W, in S [rad/s], shape [3]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Odometry(Packet):
    """The true state of the vehicle."""

    display: ClassVar[str] = "pose"

    position: Annotated[NDArray[np.float64], FieldSpec(3, unit="m")]
    """p_WB [m], shape [3]."""
    orientation: Annotated[NDArray[np.float64], FieldSpec(4)]
    """q_WB, xyzw, shape [4]."""
    velocity: Annotated[NDArray[np.float64], FieldSpec(3, unit="m/s")]
    """v_WB in W [m/s], shape [3]."""
    body_rate: Annotated[NDArray[np.float64], FieldSpec(3, unit="rad/s")]
    """w_WB in B [rad/s], shape [3]."""
    rotor_speed: Annotated[NDArray[np.float64], FieldSpec("R", unit="rad/s")]
    """Speed of each rotor [rad/s], shape [R]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Collision(Packet):
    """The vehicle touches the scene: its centre is closer to a surface than its radius."""

    display: ClassVar[str] = "contact"

    position: Annotated[NDArray[np.float64], FieldSpec(3, unit="m")]
    """p_WB at the stamp [m], shape [3]."""
    clearance_m: float
    """Distance from the vehicle's centre to the nearest surface, minus its radius [m]; <= 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Delivery(Packet):
    """Delivery of a message by a simulated link; `sensor` is "<link>_link", `stamp_ns` when it was sent."""

    display: ClassVar[str] = "delay"

    delivered_ns: int
    """When it arrives [ns]; -1: never."""
    size_bytes: int
    """Its size, as far as it takes bandwidth [bytes]."""
