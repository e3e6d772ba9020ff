"""Packets in Rerun: the same code fills a file and feeds a live viewer.

The `display` of a packet's class and its schema say how it is shown; `DISPLAYS` has a function for each.
Rerun gets what eyes need: pictures as JPEG, depth in whole millimetres, events as one picture per window.
Exact values are in the HDF5 recording. All data is on the timeline `sim_time`. Entities:

    world/scene/{room,ceiling}/<n>          the scene, one mesh per material; the ceiling is hidden
    world/bodies/<body>                     where it is, whenever the first vehicle says where that one is
    world/vehicles/<vehicle>[/<sensor>]     its pose; where a sensor sits; frustum, picture, points
    world/paths/<vehicle>                   the planned path
    world/trails/<vehicle>                  where it was, one stroke per batch of poses
    world/vehicles/<vehicle>/<camera>/<sensor>  labels or flow, over the picture of a colour camera
    world/vehicles/<vehicle>/<sensor>/arrows    flow, on a grid of pixels
    world/vehicles/<vehicle>/<sensor>/surface   the last events of all pixels, which fade
    world/collisions/<vehicle>              where it touched the scene
    plots/<vehicle>/collisions              the same as a list: a click on a line goes to its time
    events/<vehicle>/<sensor>               events of the last 0.1 s as points in x, y and time; not live
    plots/<vehicle>/<sensor>/rate           millions of events a second
    plots/<vehicle>/<sensor>/<field>        numbers, bars and texts; speed, height, rotor speeds of a pose
    plots/<vehicle>/command/<mode>          what it was told to do
    plots/<vehicle>/links/<link>            delay of each message [ms]; a gap where one was lost
    plots/<vehicle>/clearance               room around it, as `log_values` was given
    simulator/<name>, status                how it is doing: what `log_values` and `log_status` were given
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim_core.clock import NS_PER_S
from neurosim_core.packets import Packet, PacketSchema, as_numpy, schema_of
from neurosim_core.record.header import SensorDescription
from neurosim_core.scene.bodies import BodyConfig, body_poses
from neurosim_core.view.event_views import EventViews
from neurosim_core.view.pictures import picture_of
from neurosim_core.view.rerun_layout import (
    PICTURES,
    Panel,
    body,
    cloud_entity,
    make_blueprint,
    overlays,
    picture_panel,
    sensor_panels,
)
from neurosim_core.view.rerun_sdk import TIMELINE, RateLimit, RerunStream, Table, import_rerun
from neurosim_core.view.rerun_shapes import (
    SceneShapes,
    body_entity,
    encode_picture,
    flow_arrows,
)

_BATCH_NS = 50_000_000
_EVENT_PERIOD_NS = 20_000_000
_EVENT_BURST_NS = 500_000_000
_OVERLAY_OPACITY = 0.5
_XYZ_COLORS = ((224, 49, 49), (47, 158, 68), (28, 126, 214))
_SERIES_COLORS = (
    *_XYZ_COLORS,
    (240, 140, 0),
    (132, 94, 247),
    (18, 184, 134),
    (230, 73, 128),
    (134, 142, 150),
)
_VEHICLE_COLORS = ((253, 126, 20), (132, 94, 247), (18, 184, 134), (230, 73, 128))
_PATH_COLOR = (51, 154, 240)
_COLLISION_COLOR = (255, 0, 0)
_AXES_M = 0.25
_FRUSTUM_M = 0.5

_SETPOINT_NAMES = {
    "rates": ("thrust [N]", "rate x [rad/s]", "rate y [rad/s]", "rate z [rad/s]"),
    "attitude": ("thrust [N]", "roll [rad]", "pitch [rad]", "yaw [rad]"),
    "velocity": ("x [m/s]", "y [m/s]", "z [m/s]", "yaw rate [rad/s]"),
    "position": ("x [m]", "y [m]", "z [m]", "yaw [rad]"),
}


class RerunLogger:
    """Logs what vehicles measure. A context manager that flushes at the end.

    Memory is bounded: scalars and poses wait for at most 50 ms of simulated time or 1024 rows, events for one
    window. Live, `send` is to be called now and then instead of the 50 ms. A picture is logged at once.
    """

    def __init__(
        self,
        stream: RerunStream,
        *,
        vehicles: Mapping[str, tuple[SensorDescription, ...]],
        scene: SceneShapes | None = None,
        event_window_ns: int = 20_000_000,
        image_rate_max_hz: float | None = None,
        compress: bool = True,
        live: bool = False,
        keep_layout: bool = False,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Log what does not change, and the layout of the viewer.

        Args:
            stream: Where to log.
            vehicles: Descriptions of the sensors of each vehicle; packets of other sensors are shown without
                frustum.
            scene: The scene to show.
            event_window_ns: How much time one picture of events shows [ns].
            image_rate_max_hz: Log no more images per sensor and second than this: of simulated time, or live,
                by the wall clock. Live, pictures of events are as many as in real time, at most 50 a second.
            compress: Make pictures small, for a file. What is not, a viewer shows without delay; it then
                follows a stream, and shows the last seconds of it.
            live: This is a stream that may go on for hours.
            keep_layout: Leave the layout as the viewer has it now, if it has one.
            clock_ns: The wall clock [ns].
        """
        if not vehicles:
            raise ValueError("there must be at least one vehicle to log")
        self._rr = import_rerun()
        self._stream = stream
        recording = self._recording = stream.recording
        self._vehicles = dict(vehicles)
        self._first = next(iter(vehicles))
        self._colors = {
            name: _VEHICLE_COLORS[k % len(_VEHICLE_COLORS)] for k, name in enumerate(self._vehicles)
        }
        self._event_window_ns = event_window_ns
        self._image_limit = RateLimit(0 if image_rate_max_hz is None else round(1e9 / image_rate_max_hz))
        self._event_limit = RateLimit(max(event_window_ns, _EVENT_PERIOD_NS), burst_ns=_EVENT_BURST_NS)
        self._compress = compress
        self._live = live
        self._keep_layout = keep_layout
        self._clock_ns = clock_ns
        self._events: dict[str, EventViews] = {}
        self._below = {name: overlays(sensors) for name, sensors in self._vehicles.items()}
        self._tables: dict[str, Table] = {}
        self._trail_end: dict[str, NDArray[np.float64]] = {}
        named = [name for name, sensors in vehicles.items() if any(s.name == "odometry" for s in sensors)]
        self._pose_of = dict.fromkeys(named, "odometry")  # of others the first that comes
        self._bodies: Mapping[str, BodyConfig] = {}
        self._scene = scene
        self._panels: dict[str, dict[Panel, None]] = {name: {} for name in self._vehicles}
        self._kind_of: dict[tuple[str, str], str] = {}
        self._layout_is_old = False
        recording.log("world", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, sensors in self._vehicles.items():
            recording.log(body(name), self._rr.TransformAxes3D(_AXES_M), static=True)
            for sensor in sensors:
                self._log_description(name, sensor)
        if scene is not None:
            self._bodies = scene.bodies
            for entity, mesh in scene.meshes:
                recording.log(entity, mesh, static=True)
        self._send_blueprint()

    def log(self, packet: Packet, *, vehicle: str | None = None) -> None:
        """Log one packet.

        `vehicle`: name of the vehicle; None: the first one.
        """
        schema = schema_of(type(packet))
        if schema.display not in DISPLAYS:
            raise ValueError(
                f"packet {schema.name!r} declares the unknown display {schema.display!r}, "
                f"known: {', '.join(DISPLAYS)}"
            )
        vehicle = self._first if vehicle is None else vehicle
        if (vehicle, packet.sensor) not in self._kind_of:
            self._show_sensor(vehicle, packet, schema)
        DISPLAYS[schema.display](self, vehicle, packet, schema)

    def log_path(self, position: NDArray[np.float64], *, vehicle: str | None = None) -> None:
        """Show where a vehicle is meant to fly.

        `position`: planned p_WB [m], shape [n, 3]. `vehicle`: name of the vehicle; None: the first one.
        """
        if len(position) > 1:
            path = self._rr.LineStrips3D(
                [position], colors=[_PATH_COLOR], radii=self._rr.Radius.ui_points(1.5)
            )
            self._recording.log(f"world/paths/{vehicle or self._first}", path, static=True)

    def log_values(self, entity: str, stamp_ns: int, values: Mapping[str, ArrayLike]) -> None:
        """Plot quantities that no packet carries.

        `entity`: their plot, as in the list above, such as plots/drone/clearance or simulator/timing.
        `stamp_ns`: time [ns]. `values`: one value for each line, by its name; the same names every time.
        """
        self._plot(entity, stamp_ns, list(values.values()), tuple(values))

    def log_rotor_speeds(
        self, sensor: str, stamp_ns: int, speed: NDArray[np.float64], *, vehicle: str | None = None
    ) -> None:
        """Plot rotor speeds that do not come in a packet.

        `sensor`: name of the odometry that they belong to. `stamp_ns`: time [ns]. `speed`: speeds [rad/s],
        shape [R]. `vehicle`: name of the vehicle; None: the first one.
        """
        entity = f"plots/{vehicle or self._first}/{sensor}/rotor_speed"
        self._plot(entity, stamp_ns, speed, _rotors(len(speed)))

    def log_command(
        self, mode: str, stamp_ns: int, setpoint: ArrayLike, *, vehicle: str | None = None
    ) -> None:
        """Plot what a vehicle is told to do.

        `mode`: motor_speeds, rates, attitude, velocity or position; see `control.modes`. `stamp_ns`: time of
        the state that the command answers [ns]. `setpoint`: row of setpoints, laid out as in `control.modes`.
        `vehicle`: name of the vehicle; None: the first one.
        """
        row = np.asarray(setpoint, dtype=np.float64)
        names = _SETPOINT_NAMES.get(mode) or _rotors(len(row))
        if mode == "attitude":
            row = np.array([row[0], *_roll_pitch_yaw(row[1:5])])
        self._plot(f"plots/{vehicle or self._first}/command/{mode}", stamp_ns, row, names)

    def log_status(self, stamp_ns: int, text: str) -> None:
        """Show a text beside the pictures.

        `stamp_ns`: from when on it holds [ns].
        """
        self._set_time(stamp_ns)
        self._recording.log("status", self._rr.TextDocument(text, media_type="text/markdown"))

    def send(self) -> None:
        """Send what waits, and the layout if there is more to show than before."""
        if self._layout_is_old:
            self._send_blueprint()
        for table in self._tables.values():
            table.send()

    def check(self) -> None:
        """See whether all that has left so far could be written; wait for nothing."""
        self._stream.check()

    def close(self) -> None:
        """Flush and disconnect from the file or viewer."""
        self.send()
        self._stream.close()

    def __enter__(self) -> RerunLogger:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _show_sensor(self, vehicle: str, packet: Packet, schema: PacketSchema) -> None:
        """Give the packets of a sensor their places in the layout, when the first comes."""
        kind = schema.display
        if kind in PICTURES and kind != "events":
            kind = picture_of(packet)[0]
        self._kind_of[vehicle, packet.sensor] = kind
        panels = self._panels.setdefault(vehicle, {})
        below = self._below.get(vehicle, {}).get(packet.sensor, "")
        if panels.pop(picture_panel(vehicle, packet.sensor, below=below), 0) is None:
            self._layout_is_old = True  # it has another rank now
        for panel in sensor_panels(vehicle, packet.sensor, schema, kind, live=self._live, below=below):
            self._layout_is_old |= panel not in panels
            panels[panel] = None

    def _send_blueprint(self) -> None:
        self._layout_is_old = False
        layout = make_blueprint(
            {vehicle: tuple(panels) for vehicle, panels in self._panels.items()},
            None if self._scene is None else self._scene.bounds_m,
            live=self._live,
            rolling=self._live and not self._compress,
        )
        self._recording.send_blueprint(layout, make_active=not self._keep_layout)

    def _log_description(self, vehicle: str, sensor: SensorDescription) -> None:
        rr, lens = self._rr, sensor.intrinsics
        if below := self._below[vehicle].get(sensor.name):
            self._panels[vehicle][picture_panel(vehicle, sensor.name, below=below)] = None
            return
        parts = [rr.Transform3D(translation=sensor.position, quaternion=sensor.orientation)]
        if lens is not None:
            self._panels[vehicle][picture_panel(vehicle, sensor.name)] = None
            parts += [
                rr.Pinhole(
                    image_from_camera=[[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]],
                    resolution=[lens.width, lens.height],
                    camera_xyz=rr.ViewCoordinates.RDF,
                    image_plane_distance=_FRUSTUM_M,
                )
            ]
        self._recording.log(f"{body(vehicle)}/{sensor.name}", *parts, static=True)

    def _set_time(self, stamp_ns: int) -> None:
        self._recording.set_time(TIMELINE, duration=np.timedelta64(stamp_ns, "ns"))

    def _table(self, entity: str, send: Callable[..., None]) -> Table:
        if entity not in self._tables:
            self._tables[entity] = Table(entity, send, span_ns=None if self._live else _BATCH_NS)
        return self._tables[entity]

    def _times(self, stamp_ns: NDArray[np.int64]) -> Any:
        return self._rr.TimeColumn(TIMELINE, duration=stamp_ns.astype("timedelta64[ns]"))

    def _send_poses_of(
        self, entity: str, stamp_ns: NDArray[np.int64], translation: Any, quaternion: Any
    ) -> None:
        columns = self._rr.Transform3D.columns(translation=translation, quaternion=quaternion)
        self._recording.send_columns(entity, indexes=[self._times(stamp_ns)], columns=columns)

    def _send_scalars(self, entity: str, stamp_ns: NDArray[np.int64], scalars: NDArray[np.float64]) -> None:
        columns = self._rr.Scalars.columns(scalars=scalars)
        self._recording.send_columns(entity, indexes=[self._times(stamp_ns)], columns=columns)

    def _plot(self, entity: str, stamp_ns: int, value: Any, names: Sequence[str]) -> None:
        if entity not in self._tables:
            colors = None  # a single line shares its plot with those of other entities: the viewer chooses
            if len(names) > 1:
                colors = [_SERIES_COLORS[k % len(_SERIES_COLORS)] for k in range(len(names))]
            self._recording.log(entity, self._rr.SeriesLines(names=names, colors=colors), static=True)
        self._table(entity, self._send_scalars).append(stamp_ns, scalars=value)

    def _log_numbers(self, vehicle: str, packet: Packet, schema: PacketSchema) -> None:
        for field in schema.fields:
            if field.is_number:
                value = as_numpy(getattr(packet, field.name)).astype(np.float64).ravel()
                names = (field.name,) if value.size == 1 else tuple("xyz")
                if value.size not in (1, 3):
                    names = tuple(f"{field.name} {k}" for k in range(value.size))
                self._plot(f"plots/{vehicle}/{packet.sensor}/{field.name}", packet.stamp_ns, value, names)

    def _log_bars(self, vehicle: str, packet: Packet, schema: PacketSchema) -> None:
        self._set_time(packet.stamp_ns)
        for field in schema.fields:
            if field.varying and len(field.shape) == 1:
                bars = self._rr.BarChart(as_numpy(getattr(packet, field.name)))
                self._recording.log(f"plots/{vehicle}/{packet.sensor}/{field.name}", bars)

    def _log_text(self, vehicle: str, packet: Packet, schema: PacketSchema) -> None:
        self._set_time(packet.stamp_ns)
        text = "\n".join(getattr(packet, field.name) for field in schema.fields if field.dtype == "str")
        self._recording.log(f"plots/{vehicle}/{packet.sensor}", self._rr.TextLog(text))

    def _log_points(self, vehicle: str, packet: Packet, schema: PacketSchema) -> None:
        points = next(f.name for f in schema.fields if f.varying and f.shape[1:] == (3,))
        self._set_time(packet.stamp_ns)
        cloud = self._rr.Points3D(as_numpy(getattr(packet, points)), radii=self._rr.Radius.ui_points(2.0))
        self._recording.log(f"{body(vehicle)}/{packet.sensor}", cloud)

    def _log_pose(self, vehicle: str, packet: Any, _schema: PacketSchema) -> None:
        if self._pose_of.setdefault(vehicle, packet.sensor) == packet.sensor:
            self._table(body(vehicle), self._send_poses).append(
                packet.stamp_ns, translation=packet.position, quaternion=packet.orientation
            )
        plot = f"plots/{vehicle}/{packet.sensor}"
        self._plot(f"{plot}/speed", packet.stamp_ns, np.linalg.norm(packet.velocity), ("speed",))
        self._plot(f"{plot}/height", packet.stamp_ns, packet.position[2], ("height",))
        if len(packet.rotor_speed):
            self.log_rotor_speeds(packet.sensor, packet.stamp_ns, packet.rotor_speed, vehicle=vehicle)

    def _send_poses(
        self,
        entity: str,
        stamp_ns: NDArray[np.int64],
        translation: NDArray[np.float64],
        quaternion: NDArray[np.float64],
    ) -> None:
        rr = self._rr
        vehicle = entity.removeprefix(body(""))
        self._send_poses_of(entity, stamp_ns, translation, quaternion)
        if vehicle == self._first and self._bodies:
            position, orientation = body_poses(self._bodies, stamp_ns)
            for index, name in enumerate(self._bodies):
                self._send_poses_of(body_entity(name), stamp_ns, position[:, index], orientation[:, index])
        stroke = np.concatenate([self._trail_end.get(vehicle, translation[:1]), translation])
        self._trail_end[vehicle] = translation[-1:]
        self._set_time(int(stamp_ns[-1]))
        color = self._colors.get(vehicle, _VEHICLE_COLORS[0])
        line = rr.LineStrips3D([stroke], colors=[color], radii=rr.Radius.ui_points(3.0))
        self._recording.log(f"world/trails/{vehicle}", line)

    def _log_picture(self, vehicle: str, packet: Packet, _schema: PacketSchema) -> None:
        below = self._below.get(vehicle, {}).get(packet.sensor)
        at = f"{body(vehicle)}/{below}/{packet.sensor}" if below else f"{body(vehicle)}/{packet.sensor}"
        now_ns = self._clock_ns() if self._live else packet.stamp_ns
        if self._image_limit.passes(at, now_ns):
            self._set_time(packet.stamp_ns)
            opacity = _OVERLAY_OPACITY if below else 1.0
            self._recording.log(
                f"{at}/image", encode_picture(packet, compress=self._compress, opacity=opacity)
            )
            if self._kind_of[vehicle, packet.sensor] == "flow":
                self._recording.log(f"{at}/arrows", flow_arrows(picture_of(packet)[1]))

    def _log_events(self, vehicle: str, packet: Any, _schema: PacketSchema) -> None:
        at, length_ns = f"{body(vehicle)}/{packet.sensor}", self._event_window_ns
        if at not in self._events:
            self._events[at] = EventViews(
                width=packet.width, height=packet.height, window_ns=length_ns, compress=self._compress
            )
            for name, colors in self._events[at].colors().items():
                self._recording.log(f"{at}/{name}", colors, static=True)
        views = self._events[at]
        for end_ns, events, surface in views.add(packet):
            if not self._live or self._event_limit.passes(at, self._clock_ns()):
                self._set_time(end_ns)
                for name, picture in views.pictures(events, surface).items():
                    self._recording.log(f"{at}/{name}", picture)
                rate_m_s = 1e3 * len(events.t) / length_ns
                self._plot(f"plots/{vehicle}/{packet.sensor}/rate", end_ns, rate_m_s, ("events",))
                if not self._live:
                    points, colors = views.points(events, end_ns)
                    cloud = self._rr.Points3D(points, colors=colors)
                    self._recording.log(cloud_entity(vehicle, packet.sensor), cloud)

    def _log_contact(self, vehicle: str, packet: Any, _schema: PacketSchema) -> None:
        self._set_time(packet.stamp_ns)
        point = self._rr.Points3D([packet.position], colors=[_COLLISION_COLOR], radii=[0.08])
        self._recording.log(f"world/collisions/{vehicle}", point)
        x, y, z = packet.position
        text = f"{packet.stamp_ns / NS_PER_S:.3f} s: at ({x:.2f}, {y:.2f}, {z:.2f}) m"
        self._recording.log(f"plots/{vehicle}/collisions", self._rr.TextLog(text, level="WARN"))

    def _log_delay(self, vehicle: str, packet: Any, _schema: PacketSchema) -> None:
        link = packet.sensor.removesuffix("_link")
        delay_ms = 1e-6 * (packet.delivered_ns - packet.stamp_ns) if packet.delivered_ns >= 0 else np.nan
        self._plot(f"plots/{vehicle}/links/{link}", packet.stamp_ns, delay_ms, (link,))


DISPLAYS: dict[str, Callable[[RerunLogger, str, Packet, PacketSchema], None]] = {
    **dict.fromkeys(("image", "depth", "segmentation", "normals", "flow"), RerunLogger._log_picture),
    "events": RerunLogger._log_events,
    "points": RerunLogger._log_points,
    "time series": RerunLogger._log_numbers,
    "bars": RerunLogger._log_bars,
    "text": RerunLogger._log_text,
    "pose": RerunLogger._log_pose,
    "contact": RerunLogger._log_contact,
    "delay": RerunLogger._log_delay,
    "none": lambda *_: None,
}
"""How packets are logged, by the `display` of their class."""


def _rotors(count: int) -> tuple[str, ...]:
    return tuple(f"rotor {k}" for k in range(count))


def _roll_pitch_yaw(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles of q = yaw about z, then pitch about y, then roll about x [rad]; nan for no rotation at all."""
    length = np.linalg.norm(quaternion)
    x, y, z, w = quaternion / length if length > 0.0 else np.full(4, np.nan)
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.array([roll, np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0)), yaw])
