"""Packets as Rerun sees them: the same code fills a file and feeds a live viewer.

Rerun gets what eyes need: pictures as JPEG, depth as 16-bit PNG in millimetres, events as one picture per
window. Exact values are in the HDF5 recording. All data is on the timeline `sim_time`. Entities:

    world/scene/{room,ceiling}/<n>   the scene, one mesh per material; what is close to its top can be hidden
    world/path                       the planned path
    world/trail                      where the vehicle was, one stroke per 50 ms
    world/collisions                 where it touched the scene
    world/vehicle                    its pose; below it one entity per camera, with frustum and picture
    plots/<sensor>/<quantity>        IMU, speed, height, rotor speeds
    plots/<name>                     what `log_scalar` was given
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from neurosim_core.packets import Collision, EventArrays, Events, Image, ImuSample, Odometry, Packet
from neurosim_core.record.header import SensorDescription
from neurosim_core.scene.scene import Material, Scene
from neurosim_core.scene.source import linear_to_srgb8
from neurosim_core.view.event_picture import PALETTE, EventWindow, event_classes

if TYPE_CHECKING:
    import rerun as rr

TIMELINE = "sim_time"
_TEXTURE_MAX_PX = 256
_BATCH_NS = 50_000_000
_BATCH_ROWS = 1024
_XYZ_COLORS = ((224, 49, 49), (47, 158, 68), (28, 126, 214))
_TRAIL_COLOR = (253, 126, 20)
_PATH_COLOR = (51, 154, 240)
_NO_POINTS = np.zeros((0, 3))


def open_recording(path: str | Path | None = None) -> rr.RecordingStream:
    """Open a recording of its own, independent of others in this process.

    Args:
        path: Write it to this .rrd file; None: the caller connects it (`serve_grpc`, `connect_grpc`, ...).

    Raises:
        OSError: The file cannot be written.
        ImportError: Rerun is not installed.
    """
    rr = _import_rerun()
    recording = rr.RecordingStream("neurosim")
    recording.set_log_time_enabled(False)  # wall-clock time has no place in a simulation's recording
    recording.set_log_tick_enabled(False)
    if path is not None:
        try:
            Path(path).touch()
            recording.save(path)
        except (OSError, RuntimeError) as error:
            raise OSError(f"cannot write {path}: {error}") from error
    return recording  # type: ignore[no-any-return]


class RerunLogger:
    """Logs the packets of one vehicle. A context manager that flushes at the end.

    Memory is bounded: scalars and poses wait for at most 50 ms of simulated time or 1024 rows, events for one
    window. A picture is logged at once.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        *,
        scene: Scene | None = None,
        sensors: tuple[SensorDescription, ...] = (),
        path_position: NDArray[np.float64] = _NO_POINTS,
        event_window_ns: int = 20_000_000,
        image_rate_max_hz: float | None = None,
    ) -> None:
        """Log what does not change, and the layout of the viewer.

        Args:
            recording: Where to log: `open_recording`.
            scene: The scene to show.
            sensors: Descriptions of the sensors; packets of other sensors are shown without frustum.
            path_position: Planned p_WB [m], shape [n, 3].
            event_window_ns: How much time one picture of events shows [ns].
            image_rate_max_hz: Log no more pictures per sensor and simulated second than this.

        Raises:
            ImportError: Rerun is not installed.
        """
        self._rr = _import_rerun()
        self._recording: Any = recording
        self._event_window_ns = event_window_ns
        self._image_period_ns = 0 if image_rate_max_hz is None else round(1e9 / image_rate_max_hz)
        self._image_stamp_ns: dict[str, int] = {}
        self._windows: dict[str, EventWindow] = {}
        self._tables: dict[str, _Table] = {}
        self._trail_end: NDArray[np.float64] | None = None
        self._log_of: dict[type[Packet], Callable[[Any], None]] = {
            Events: self._log_events,
            Image: self._log_image,
            ImuSample: self._log_imu,
            Odometry: self._log_odometry,
            Collision: self._log_collision,
        }
        recording.log("world", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        if scene is not None:
            for entity, mesh in scene_meshes(scene):
                recording.log(entity, mesh, static=True)
        if len(path_position) > 1:
            path = self._rr.LineStrips3D(
                [path_position], colors=[_PATH_COLOR], radii=self._rr.Radius.ui_points(1.5)
            )
            recording.log("world/path", path, static=True)
        recording.log("world/vehicle", self._rr.TransformAxes3D(0.25), static=True)
        for sensor in sensors:
            self._log_description(sensor)
        recording.send_blueprint(make_blueprint(sensors, scene))

    def log(self, packet: Packet) -> None:
        """Log one packet.

        Raises:
            ValueError: The packet is of a type that cannot be shown.
        """
        if type(packet) not in self._log_of:
            known = sorted(t.__name__ for t in self._log_of)
            raise ValueError(f"cannot show a packet of type {type(packet).__name__!r}, known: {known}")
        self._log_of[type(packet)](packet)

    def log_scalar(self, name: str, stamp_ns: int, value: float) -> None:
        """Plot a quantity that no packet carries, such as the clearance [m].

        Args:
            name: Name of the plot; the blueprint shows `clearance`.
            stamp_ns: Time [ns].
            value: Value in SI units.
        """
        self._table(f"plots/{name}", {"scalars": 1}, self._send_scalars).append(stamp_ns, scalars=value)

    def flush(self) -> None:
        """Send what waits, and wait until it has left."""
        for table in self._tables.values():
            table.send()
        self._recording.flush()

    def close(self) -> None:
        """Flush and disconnect from the file or viewer."""
        self.flush()
        self._recording.disconnect()

    def __enter__(self) -> RerunLogger:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _log_description(self, sensor: SensorDescription) -> None:
        rr = self._rr
        if sensor.intrinsics is not None:
            lens = sensor.intrinsics
            self._recording.log(
                f"world/vehicle/{sensor.name}",
                rr.Transform3D(translation=sensor.position, quaternion=sensor.orientation),
                rr.Pinhole(
                    image_from_camera=[[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]],
                    resolution=[lens.width, lens.height],
                    camera_xyz=rr.ViewCoordinates.RDF,
                    image_plane_distance=0.5,
                ),
                static=True,
            )

    def _set_time(self, stamp_ns: int) -> None:
        self._recording.set_time(TIMELINE, duration=np.timedelta64(stamp_ns, "ns"))

    def _table(self, entity: str, widths: dict[str, int], send: Callable[..., None]) -> _Table:
        if entity not in self._tables:
            self._tables[entity] = _Table(entity, widths, send)
        return self._tables[entity]

    def _send_scalars(self, entity: str, stamp_ns: NDArray[np.int64], scalars: NDArray[np.float64]) -> None:
        times = self._rr.TimeColumn(TIMELINE, duration=stamp_ns.astype("timedelta64[ns]"))
        self._recording.send_columns(
            entity, indexes=[times], columns=self._rr.Scalars.columns(scalars=scalars)
        )

    def _plot(self, entity: str, stamp_ns: int, value: Any, names: tuple[str, ...]) -> None:
        if entity not in self._tables:
            colors = _XYZ_COLORS if len(names) == 3 else None
            self._recording.log(entity, self._rr.SeriesLines(names=names, colors=colors), static=True)
        self._table(entity, {"scalars": len(names)}, self._send_scalars).append(stamp_ns, scalars=value)

    def _log_imu(self, packet: ImuSample) -> None:
        plot = f"plots/{packet.sensor}"
        self._plot(f"{plot}/specific_force", packet.stamp_ns, packet.specific_force, ("x", "y", "z"))
        self._plot(f"{plot}/angular_rate", packet.stamp_ns, packet.angular_rate, ("x", "y", "z"))

    def _log_odometry(self, packet: Odometry) -> None:
        self._table("world/vehicle", {"translation": 3, "quaternion": 4}, self._send_poses).append(
            packet.stamp_ns, translation=packet.position, quaternion=packet.orientation
        )
        plot = f"plots/{packet.sensor}"
        self._plot(f"{plot}/speed", packet.stamp_ns, np.linalg.norm(packet.velocity), ("speed",))
        self._plot(f"{plot}/height", packet.stamp_ns, packet.position[2], ("height",))
        rotors = tuple(f"rotor {k}" for k in range(len(packet.rotor_speed)))
        self._plot(f"{plot}/rotor_speed", packet.stamp_ns, packet.rotor_speed, rotors)

    def _send_poses(
        self,
        entity: str,
        stamp_ns: NDArray[np.int64],
        translation: NDArray[np.float64],
        quaternion: NDArray[np.float64],
    ) -> None:
        rr = self._rr
        times = rr.TimeColumn(TIMELINE, duration=stamp_ns.astype("timedelta64[ns]"))
        columns = rr.Transform3D.columns(translation=translation, quaternion=quaternion)
        self._recording.send_columns(entity, indexes=[times], columns=columns)
        start = translation[:1] if self._trail_end is None else self._trail_end
        stroke = np.concatenate([start, translation])
        self._trail_end = translation[-1:]
        self._set_time(int(stamp_ns[-1]))
        line = rr.LineStrips3D([stroke], colors=[_TRAIL_COLOR], radii=rr.Radius.ui_points(3.0))
        self._recording.log("world/trail", line)

    def _log_image(self, packet: Image) -> None:
        last_ns = self._image_stamp_ns.get(packet.sensor)
        if last_ns is not None and 0 <= packet.stamp_ns - last_ns < self._image_period_ns:
            return
        self._image_stamp_ns[packet.sensor] = packet.stamp_ns
        self._set_time(packet.stamp_ns)
        self._recording.log(f"world/vehicle/{packet.sensor}/image", encode_image(packet))

    def _log_events(self, packet: Events) -> None:
        window = self._windows.setdefault(packet.sensor, EventWindow(length_ns=self._event_window_ns))
        arrays = packet.numpy()
        for end_ns, events in window.add(arrays, start_ns=packet.start_ns, stamp_ns=packet.stamp_ns):
            self._set_time(end_ns)
            picture = encode_events(events, width=packet.width, height=packet.height)
            self._recording.log(f"world/vehicle/{packet.sensor}/image", picture)

    def _log_collision(self, packet: Collision) -> None:
        self._set_time(packet.stamp_ns)
        point = self._rr.Points3D([packet.position], colors=[(255, 0, 0)], radii=[0.08])
        self._recording.log("world/collisions", point)


class _Table:
    """Rows of one entity that are sent together."""

    def __init__(self, entity: str, widths: dict[str, int], send: Callable[..., None]) -> None:
        self._entity = entity
        self._send = send
        self._stamp_ns: list[int] = []
        self._columns: dict[str, list[NDArray[np.float64]]] = {name: [] for name in widths}
        self._widths = widths

    def append(self, stamp_ns: int, **values: Any) -> None:
        if self._stamp_ns and stamp_ns < self._stamp_ns[-1]:  # after a reset
            self.send()
        self._stamp_ns.append(stamp_ns)
        for name, value in values.items():
            self._columns[name].append(np.array(value, dtype=np.float64).reshape(self._widths[name]))
        if stamp_ns - self._stamp_ns[0] >= _BATCH_NS or len(self._stamp_ns) >= _BATCH_ROWS:
            self.send()

    def send(self) -> None:
        if self._stamp_ns:
            columns = {name: np.stack(rows) for name, rows in self._columns.items()}
            self._send(self._entity, np.array(self._stamp_ns, dtype=np.int64), **columns)
            self._stamp_ns = []
            self._columns = {name: [] for name in self._columns}


def encode_image(image: Image) -> Any:
    """Return a picture as Rerun shows it.

    rgb8 and mono8 become JPEG; 32FC1 becomes a depth image in millimetres up to 65 m, 0 where nothing is hit.

    Raises:
        ValueError: If another encoding is given.
    """
    rr = _import_rerun()
    if image.encoding in ("rgb8", "mono8"):
        return rr.Image(image.data).compress(jpeg_quality=90)
    if image.encoding == "32FC1":
        depth_mm = np.where(np.isfinite(image.data), np.minimum(image.data * 1000.0 + 0.5, 65535.0), 0.0)
        return rr.EncodedDepthImage(
            _png(PIL.Image.fromarray(depth_mm.astype(np.uint16))),
            media_type="image/png",
            meter=1000.0,
            colormap=rr.components.Colormap.Turbo,
        )
    raise ValueError(f"cannot show a picture of encoding {image.encoding!r}, known: rgb8, mono8, 32FC1")


def encode_events(events: EventArrays, *, width: int, height: int) -> Any:
    """Return events as the picture of `event_picture`, losslessly compressed."""
    picture = PIL.Image.fromarray(event_classes(events, width=width, height=height), mode="L")
    picture.putpalette(PALETTE.tobytes())
    return _import_rerun().EncodedImage(contents=_png(picture), media_type="image/png")


def _png(picture: PIL.Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG", compress_level=1)
    return buffer.getvalue()


def scene_meshes(scene: Scene) -> list[tuple[str, Any]]:
    """Return the scene as Rerun meshes, one per material, each with its entity path.

    Faces that lie wholly in the highest 15 % go below `world/scene/ceiling`, so that they can be hidden.
    Textures are reduced to 256 pixels.
    """
    rr = _import_rerun()
    low_m, high_m = scene.bounds_m[:, 2]
    top = scene.vertices[scene.faces, 2].min(axis=1) > low_m + 0.85 * (high_m - low_m)
    meshes = []
    for part, chosen in (("room", ~top), ("ceiling", top)):
        for index, material in enumerate(scene.materials):
            faces = scene.faces[chosen & (scene.face_material == index)]
            if not len(faces):
                continue
            used, triangles = np.unique(faces, return_inverse=True)
            texture = _texture(material)
            mesh = rr.Mesh3D(
                vertex_positions=scene.vertices[used],
                vertex_normals=scene.normals[used],
                triangle_indices=triangles.reshape(-1, 3).astype(np.uint32),
                vertex_texcoords=None if texture is None else _image_coordinates(scene.uv[used]),
                albedo_texture=texture,
                albedo_factor=[*linear_to_srgb8(_albedo(material)), 255],
            )
            meshes.append((f"world/scene/{part}/{index}", mesh))
    return meshes


def _albedo(material: Material) -> NDArray[np.float64]:
    color: NDArray[np.float64] = np.array(material.base_color) + np.array(material.emission)
    return color.clip(0.0, 1.0)


def _image_coordinates(uv: NDArray[np.float32]) -> NDArray[np.float32]:
    """Rerun counts v from the top row."""
    return np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)


def _texture(material: Material) -> NDArray[np.uint8] | None:
    if material.texture is None:
        return None
    picture = PIL.Image.fromarray(material.texture.srgb)
    picture.thumbnail((_TEXTURE_MAX_PX, _TEXTURE_MAX_PX))
    return np.asarray(picture)


def make_blueprint(sensors: tuple[SensorDescription, ...], scene: Scene | None = None) -> Any:
    """Lay the viewer out: the scene large, pictures at its right, plots below."""
    rrb = _import_rerun().blueprint
    cameras = [sensor for sensor in sensors if sensor.intrinsics is not None]
    cameras.sort(key=lambda sensor: ("rgb", "event_camera", "depth").index(sensor.kind))
    until_now = rrb.VisibleTimeRanges(
        rrb.VisibleTimeRange(
            TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
        )
    )
    eye = None
    if scene is not None:
        low, high = scene.bounds_m
        center, size = 0.5 * (low + high), high - low
        away = np.array([-0.3 * size[0], -0.7 * max(size), 0.85 * max(size)])
        eye = rrb.EyeControls3D(position=center + away, look_target=center, eye_up=(0.0, 0.0, 1.0))
    space = rrb.Spatial3DView(
        origin="world",
        name="Scene",
        # One frustum is enough where cameras share a place; the others' pictures are at the right.
        contents=["$origin/**", *(f"- /world/vehicle/{camera.name}/**" for camera in cameras[1:])],
        overrides={
            "world/trail": until_now,
            "world/collisions": until_now,
            "world/scene/ceiling": rrb.EntityBehavior(visible=False),
        },
        eye_controls=eye,
        line_grid=False,
    )
    pictures = [
        rrb.Spatial2DView(origin=f"world/vehicle/{camera.name}", contents="$origin/image", name=camera.name)
        for camera in cameras
    ]
    imus = [sensor.name for sensor in sensors if sensor.kind == "imu"]
    plots = []
    for name in imus:
        plots += [
            rrb.TimeSeriesView(origin=f"plots/{name}/specific_force", name=f"{name}: specific force [m/s²]"),
            rrb.TimeSeriesView(origin=f"plots/{name}/angular_rate", name=f"{name}: angular rate [rad/s]"),
        ]
    for name in (sensor.name for sensor in sensors if sensor.kind == "odometry"):
        motion = [f"/plots/{name}/speed", f"/plots/{name}/height", "/plots/clearance"]
        plots += [
            rrb.TimeSeriesView(origin="plots", contents=motion, name="speed [m/s], height, clearance [m]"),
            rrb.TimeSeriesView(origin=f"plots/{name}/rotor_speed", name="rotor speed [rad/s]"),
        ]
    left = rrb.Vertical(space, rrb.Horizontal(*plots), row_shares=[3, 1]) if plots else space
    layout = rrb.Horizontal(left, rrb.Vertical(*pictures), column_shares=[3, 1]) if pictures else left
    return rrb.Blueprint(
        layout,
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )


def _import_rerun() -> ModuleType:
    try:
        import rerun
        import rerun.blueprint
    except ImportError as error:
        raise ImportError("the viewer needs Rerun: pip install 'neurosim[view]'") from error
    return rerun
