"""Settings files: YAML -> one frozen `SimulationConfig`. The only reader of settings files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from neurosim_core.config_errors import describe_errors, explain, suggestion
from neurosim_core.control import ControllerConfig, Se3ControllerConfig
from neurosim_core.live.config import LinkConfig, LiveConfig
from neurosim_core.registry import find
from neurosim_core.render.renderer import RenderConfig, RendererConfig, WarpRendererConfig
from neurosim_core.scene.bodies import BodyConfig
from neurosim_core.scene.config import SceneConfig
from neurosim_core.scene.freespace import FreeSpaceConfig
from neurosim_core.scene.mesh import DEFAULT_KIND, scene_kind
from neurosim_core.sensors.base import CameraConfig, SensorConfig
from neurosim_core.sensors.depth import DepthSensorConfig
from neurosim_core.sensors.event_camera import EventSensorConfig
from neurosim_core.sensors.imu import ImuConfig
from neurosim_core.sensors.odometry import OdometrySensorConfig
from neurosim_core.sensors.rgb import RgbSensorConfig
from neurosim_core.settings import BaseConfig, OfKind, documentation
from neurosim_core.settings_file import ConfigError, beside, merge, nest, read_file
from neurosim_core.sinks import SinkConfig, check_files, default_sinks
from neurosim_core.trajectory import CollisionFreeConfig, PathConfig, TourConfig
from neurosim_core.vehicle import MultirotorConfig
from neurosim_core.vehicle.base import VehicleConfig
from neurosim_core.vehicle.multirotor import MultirotorVehicleConfig


def default_sensors() -> dict[str, SensorConfig]:
    """Return the sensors of a vehicle whose settings do not say otherwise."""
    return {
        "events": EventSensorConfig(),
        "rgb": RgbSensorConfig(),
        "depth": DepthSensorConfig(),
        "imu": ImuConfig(),
        "odometry": OdometrySensorConfig(),
    }


_DEFAULTS: dict[str, Callable[[], Mapping[str, Any]]] = {"sensors": default_sensors, "sinks": default_sinks}
"""Groups of named settings that have a default set; KEY+ changes the set or adds to it."""
_DEFAULT_KINDS = {
    "scene": DEFAULT_KIND,
    "renderer": "warp",
    "vehicle": "multirotor",
    "path": "tour",
    "control": "se3",
}
"""Kinds of settings that do not say which they are."""


Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
AnySensor = Annotated[SensorConfig, OfKind("sensor")]
AnyScene = Annotated[SceneConfig, OfKind("scene", default=_DEFAULT_KINDS["scene"])]
AnyVehicle = Annotated[VehicleConfig, OfKind("vehicle", default=_DEFAULT_KINDS["vehicle"])]
AnyController = Annotated[ControllerConfig, OfKind("controller", default=_DEFAULT_KINDS["control"])]
AnySink = Annotated[SinkConfig, OfKind("sink")]
AnyRenderer = Annotated[RendererConfig, OfKind("renderer", default=_DEFAULT_KINDS["renderer"])]
_PATHS: tuple[type[BaseConfig], ...] = get_args(get_args(PathConfig)[0])


def _expand_stereo(sensors: Mapping[str, SensorConfig]) -> dict[str, SensorConfig]:
    """Return sensors with two cameras in place of each that has `stereo`.

    Raises:
        ValueError: A name of the pair is taken.
    """
    expanded: dict[str, SensorConfig] = {}
    for name, sensor in sensors.items():
        if not isinstance(sensor, CameraConfig) or sensor.stereo is None:
            expanded[name] = sensor
            continue
        for taken in {f"{name}_left", f"{name}_right"} & sensors.keys():
            raise ValueError(f"{name}.stereo makes a camera {taken!r}, and there is one of this name")
        right = sensor.mount.rotation().apply([0.0, -sensor.stereo.baseline_m, 0.0])
        position_m = tuple(float(a + b) for a, b in zip(sensor.mount.position_m, right, strict=True))
        mounts = {"left": sensor.mount, "right": sensor.mount.model_copy(update={"position_m": position_m})}
        for side, mount in mounts.items():
            expanded[f"{name}_{side}"] = sensor.model_copy(update={"mount": mount, "stereo": None})
    return expanded


Sensors = Annotated[dict[Name, AnySensor], AfterValidator(_expand_stereo)]
Links = dict[Name, LinkConfig]

STREAMS = ("odometry", "rotor_speeds", "command")
"""Links that every vehicle has besides those of its sensors."""
_RESERVED = {
    "collision": "collision reports",
    "command": "commands",
    "path": "the planned path",
    "rotor_speeds": "the speeds of the rotors",
}
_SEED_STRIDE = 0x9E3779B97F4A7C15


class FleetMember(BaseConfig):
    """One of several vehicles: the settings that differ from the common ones of the same name."""

    vehicle: AnyVehicle | None = None
    """The vehicle; null: the common `vehicle`."""
    path: PathConfig | None = None
    """Its path; null: the common `path`, a tour with a seed of its own."""
    control: AnyController | None = None
    """Its controller; null: the common `control`."""
    sensors: Sensors | None = None
    """Its sensors by name; null: the common `sensors`."""
    links: Links | None = None
    """Its simulated links; null: the common `links`."""


class SimulationConfig(BaseConfig):
    """Everything that decides the outcome of a run: same config, same device type, same bits."""

    duration_s: Annotated[float, Field(gt=0.0, le=1e6)] = 4.0
    """Simulated time [s]. Sensors sample at both ends: 4 s at 20 Hz give 81 pictures."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of all sensor noise, and of turbulence."""
    device: Annotated[str, Field(pattern=r"^(auto|cpu|cuda(:\d+)?)$")] = "auto"
    """Device to compute on: auto (the first CUDA device, else the CPU), cpu, cuda:0, ..."""
    instants_per_launch: Annotated[int, Field(ge=1, le=1024)] = 16
    """Number of consecutive instants (sampling times) of the fastest camera that one launch renders; changes
    speed and memory, not the result."""
    scene: AnyScene = Field(default_factory=lambda: find("scene", _DEFAULT_KINDS["scene"])())
    """Environment: {kind: apartment | hall, ...} or {kind: mesh, file: house.glb, ...}."""
    bodies: dict[Name, BodyConfig] = Field(default_factory=dict)
    """Moving objects of the scene, by name: {ball: {shape: {kind: sphere}, motion: {...}}}. Cameras see them;
    paths are not planned around them, and contact with one is no collision."""
    renderer: AnyRenderer = WarpRendererConfig()
    """`warp`: ray casting on CPU and CUDA, for all cameras. `pyrender`: OpenGL, rgb and depth only.
    `synthetic`: a test pattern at almost no cost, to benchmark everything else. {kind: remote, topic: ...}: a
    renderer in another process."""
    render: RenderConfig = RenderConfig()
    """Lighting and rendering of the scene."""
    free_space: FreeSpaceConfig = FreeSpaceConfig()
    """The distance map in which paths are planned."""
    vehicle: AnyVehicle = MultirotorVehicleConfig()
    """The vehicle that carries the sensors: a multirotor, or the kind of a plug-in."""
    path: PathConfig = TourConfig()
    """The reference path: {kind: tour | waypoints | hover | line | circle | figure_eight | lissajous, ...};
    {kind: poses, file: poses.txt, format: tum} moves the sensors along poses, without a vehicle."""
    control: AnyController = Se3ControllerConfig()
    """The controller: `se3`, the geometric controller, or the kind of a plug-in."""
    sensors: Sensors = Field(default_factory=default_sensors)
    """Sensors by name. A mapping given here replaces the default set: a sensor that is not listed does not
    exist, nor does one that is null, as in --set sensors.depth=null. The key `sensors+` changes the default
    set or adds to it."""
    vehicles: Annotated[dict[Name, FleetMember], Field(min_length=1)] = Field(
        default_factory=lambda: {"drone": FleetMember()}
    )
    """Vehicles by name. Several share the scene (`neurosim up`) and do not see each other. {drone: {}} is one
    vehicle with the settings above."""
    live: LiveConfig = LiveConfig()
    """Timing of `neurosim serve`: real time or lockstep, and the response to late commands."""
    sinks: dict[Name, AnySink] = Field(default_factory=default_sinks)
    """Outputs that receive the packets of `neurosim run`, by name. A mapping given here replaces the default
    set; `sinks+` adds to it: {sinks+: {raw: {kind: event_file, name: events.raw}}}."""
    links: Links = Field(default_factory=dict)
    """Simulated network links of `neurosim serve` by the stream that they carry: the name of a sensor,
    odometry, rotor_speeds or command, such as {command: {latency_s: 0.008}}."""

    _no_file_twice = field_validator("sinks")(check_files)

    @model_validator(mode="after")
    def _path_keeps_off_the_scene(self) -> SimulationConfig:
        radius_m = self.vehicle.collision_radius_m
        if isinstance(self.path, CollisionFreeConfig) and self.path.clearance_m <= radius_m:
            raise ValueError(
                f"path.clearance_m must be more than vehicle.collision_radius_m = {radius_m:g}, "
                f"got {self.path.clearance_m:g}"
            )
        return self

    @field_validator("sensors")
    @classmethod
    def _no_reserved_name(cls, sensors: dict[str, SensorConfig]) -> dict[str, SensorConfig]:
        for name, sensor in sensors.items():
            if name in _RESERVED:
                raise ValueError(f"the sensor name {name!r} is taken by {_RESERVED[name]}")
            if name.endswith("_link"):
                raise ValueError(
                    f"a sensor's name must not end in '_link', as recordings of links do: {name!r}"
                )
            if name == "odometry" and sensor.kind != "odometry":
                raise ValueError(f"a sensor named 'odometry' must be of kind odometry, got {sensor.kind}")
            try:
                _ = sensor.clock, sensor.packets
            except ValueError as error:  # of a kind of others, whose fields have no bounds
                raise ValueError(f"{name}: {error}") from None
        return sensors

    @model_validator(mode="after")
    def _links_have_ends(self) -> SimulationConfig:
        for name, member in self.vehicles.items():
            if member.control is not None and member.control.rate_hz != self.control.rate_hz:
                raise ValueError(
                    f"vehicles.{name}.control.rate_hz must be that of all, {self.control.rate_hz:g}, "
                    f"got {member.control.rate_hz:g}"
                )
            sensors = self.sensors if member.sensors is None else member.sensors
            self._no_reserved_name(sensors)
            for link, settings in (self.links if member.links is None else member.links).items():
                if link not in {*sensors, *STREAMS}:
                    known = ", ".join(dict.fromkeys([*sensors, *STREAMS]))
                    raise ValueError(f"links.{link}: vehicle {name!r} has no such link, known: {known}")
                if link == "command" and (settings.clock_offset_s or settings.clock_drift_ppm):
                    raise ValueError(
                        "links.command: clock_offset_s and clock_drift_ppm are for links of sensors"
                    )
        return self

    def of(self, name: str) -> SimulationConfig:
        """Return the settings of one vehicle, with all that differs from the common ones put in place.

        The first vehicle keeps the seed, further ones get seeds of their own.

        Raises:
            KeyError: There is no vehicle of this name.
        """
        if name not in self.vehicles:
            raise KeyError(f"unknown vehicle {name!r}, known: {', '.join(self.vehicles)}")
        index = list(self.vehicles).index(name)
        member = self.vehicles[name]
        changes: dict[str, Any] = {
            key: value for key in FleetMember.model_fields if (value := getattr(member, key)) is not None
        }
        if member.path is None and isinstance(self.path, TourConfig):
            changes["path"] = self.path.model_copy(update={"seed": self.path.seed + index})
        return self.model_copy(
            update={
                **changes,
                "seed": (self.seed + index * _SEED_STRIDE) % 2**63,
                "vehicles": {name: FleetMember()},
            }
        )


def load_config(
    source: str | Path | Mapping[str, Any] | None = None,
    *,
    overrides: Mapping[str, Any] | None = None,
    options: Mapping[str, str] | None = None,
) -> SimulationConfig:
    """Read settings and check them.

    Args:
        source: A YAML file, a mapping with the same keys, or None for the defaults. Relative files of the
            scene, the path, bodies and lenses are looked up beside the YAML file.
        overrides: Keys that win over the source. Nested mappings are merged, unless they say that they are of
            another kind; a key may be dotted ("scene.seed"). Where the source has no `sensors` or
            `sinks`, those of the default set are changed, and new ones added to it.
        options: What the user calls a key of `overrides`, such as {"duration_s": "--duration"}: an error
            there is said of it, and so is what lacks or is unknown in a group that only it has made.

    A group that comes in several kinds and does not say which (`scene`, `path`) is of the only kind that has
    its keys, else of the default kind.
    A sensor, sink or body that is null is left out: {"sensors.depth": None}. What is under the keys
    `sensors+` and `sinks+` changes the default set, as overrides do.

    Raises:
        ConfigError: The file cannot be read or is not YAML; a key is unknown; a value is of the wrong type or
            out of range. The message has one line for each error.
        TypeError: The source is neither the name of a file nor settings.
    """
    if not isinstance(source, str | Path | Mapping | SimulationConfig | None):
        raise TypeError(f"settings are the name of a YAML file, a mapping or None, got {source!r}")
    origin = str(source) if isinstance(source, str | Path) else "config"
    raw = read_file(Path(source)) if isinstance(source, str | Path) else dict(source or {})
    patches = [nest(key, value) for key, value in (overrides or {}).items()]
    for group, defaults in _DEFAULTS.items():
        added = f"{group}+"
        if added in raw:
            if group in raw:
                reason = f"give `{group}`, which replace the default set, or `{added}`, not both"
                raise ConfigError(f"{origin}: {reason}")
            patches.insert(0, {group: raw[added]})
            raw = {key: value for key, value in raw.items() if key != added}
        if group not in raw and any(group in patch for patch in patches):
            # of what a preset may say, nothing is said: errors and pixels are ideal anyway
            raw[group] = {
                name: {"kind": each.kind}
                if "preset" in type(each).model_fields
                else each.model_dump(exclude={"pixel"})
                for name, each in defaults().items()
            }
    given = raw
    for patch in patches:
        raw = merge(raw, patch)
    if isinstance(source, str | Path):
        raw = beside(raw, Path(source).resolve().parent)
    raw = _without_nulls(_with_default_kinds(raw))
    try:
        return SimulationConfig.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(describe_errors(origin, list(_explain(error, raw)), options or {}, given)) from None


def as_config(config: SimulationConfig | Mapping[str, Any] | str | Path | None) -> SimulationConfig:
    """Return loaded settings as they are; load others, see `load_config`."""
    return config if isinstance(config, SimulationConfig) else load_config(config)


def to_yaml(config: SimulationConfig, *, comments: bool = False) -> str:
    """Return a configuration as YAML that `load_config` reads back to an equal one.

    Args:
        config: The configuration.
        comments: Put the documentation of each key above it.
    """
    return "\n".join(_yaml_lines(config, indent=0, comments=comments)) + "\n"


def _with_default_kinds(raw: dict[str, Any]) -> dict[str, Any]:
    """Add the default kind to top-level groups that come in several and do not say which they are."""
    for key, kind in _DEFAULT_KINDS.items():
        group = raw.get(key)
        if isinstance(group, Mapping) and "kind" not in group:
            if key == "scene":
                kind = scene_kind(group)
            elif key == "path" and not group.keys() <= TourConfig.model_fields.keys():
                fitting = [one for one in _PATHS if group.keys() <= one.model_fields.keys()]
                kind = fitting[0].model_fields["kind"].default if len(fitting) == 1 else kind
            raw = {**raw, key: {"kind": kind, **group}}
    return raw


def _without_nulls(raw: dict[str, Any]) -> dict[str, Any]:
    """Leave out sensors, sinks and bodies that are null."""
    for key in ("sensors", "sinks", "bodies"):
        if isinstance(raw.get(key), Mapping):
            raw = {**raw, key: {name: item for name, item in raw[key].items() if item is not None}}
    return raw


def _explain(error: ValidationError, raw: Mapping[str, Any]) -> Iterator[str]:
    """Say of each error what is wrong; also where a key belongs, and which sensor may have been meant."""
    for line in explain(SimulationConfig, error):
        path, _, reason = line.partition(": ")
        group, _, name = path.rpartition(".")
        if group == "vehicle" and reason.startswith("unknown key") and name in MultirotorConfig.model_fields:
            yield f"{path}: this is one of the parameters: vehicle.parameters.{name}"
        elif name == "kind" and group.startswith("sensors.") and reason.startswith("required"):
            others = [str(key) for key in raw["sensors"] if f"sensors.{key}" != group]
            yield f"{line}; {suggestion(group.removeprefix('sensors.'), others)}".rstrip("; ")
        elif path == "scene.path":
            yield f"{path}: unknown key; the file of a scene is scene.file"
        elif path == "vehicle.kind" and reason.startswith(("Input should", "must be")):
            yield f"{line}; the airframe is the preset: vehicle: {{preset: hummingbird}}"
        elif path == "scene.kind" and reason.startswith("must be"):
            yield f"{line}; the file of a scene is scene: {{kind: mesh, file: house.glb}}"
        elif path == "device" and "pattern" in reason:
            yield f"{path}: must be auto, cpu, cuda, or cuda:0 and so on, got {raw['device']!r}"
        else:
            yield line


def _yaml_lines(model: BaseModel, *, indent: int, comments: bool) -> Iterator[str]:
    pad = "  " * indent
    for name in type(model).model_fields:
        value = getattr(model, name)
        if comments and (description := documentation(type(model)).get(name)):
            for line in description.split("\n"):
                yield f"{pad}# {line.strip()}"
        if isinstance(value, BaseModel):
            yield f"{pad}{name}:"
            yield from _yaml_lines(value, indent=indent + 1, comments=comments)
        elif isinstance(value, dict) and value and all(isinstance(v, BaseModel) for v in value.values()):
            yield f"{pad}{name}:"
            for key, item in value.items():
                yield f"{pad}  {key}:"
                yield from _yaml_lines(item, indent=indent + 2, comments=comments)
        else:
            plain = model.model_dump(mode="json", include={name})[name]
            text = yaml.safe_dump(plain, default_flow_style=True, width=10**6).splitlines()[0]
            yield f"{pad}{name}: {text}"
