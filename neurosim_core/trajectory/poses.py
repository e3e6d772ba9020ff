"""Motions that a file or a list of keyframes prescribes: a rig follows them exactly, without dynamics.

Between poses the position is a cubic spline, and the orientation a cubic spline of rotation vectors.
Velocity, acceleration, angular rate and angular acceleration are continuous, and derivatives of the curve:
an IMU agrees with the pictures.

Reference: SciPy's `CubicSpline` (not-a-knot) and `RotationSpline`, whose coefficients a device evaluates.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import scipy  # which imports its parts when they are used
from numpy.typing import NDArray
from pydantic import Field, model_validator

from neurosim_core.clock import NS_PER_S
from neurosim_core.frames import Q_FORWARD_OPTICAL, Vector3
from neurosim_core.install import install_hint
from neurosim_core.settings import BaseConfig
from neurosim_core.trajectory.path import Attitude, Path

_log = logging.getLogger(__name__)

_LENGTH_TOLERANCE = 0.01
"""Of a quaternion: files have few digits."""
_REPEAT_SHARE = 0.01
"""Of the median time between poses: what comes sooner is a repeat."""

PoseFormat = Literal["tum", "euroc", "csv", "bag"]
"""Names of file formats."""

_FORMATS: dict[str, tuple[str, float, tuple[int, ...]]] = {
    "tum": ("time_s x y z qx qy qz qw, apart by spaces", 1.0, (0, 1, 2, 3, 4, 5, 6, 7)),
    "euroc": ("time_ns,x,y,z,qw,qx,qy,qz and perhaps more", 1e-9, (0, 1, 2, 3, 5, 6, 7, 4)),
    "csv": ("time_s,x,y,z,qx,qy,qz,qw", 1.0, (0, 1, 2, 3, 4, 5, 6, 7)),
}
"""What a row is, the length of its unit of time [s], and where time, position and quaternion (xyzw) stand."""


class KeyframeConfig(BaseConfig):
    """A pose at one time."""

    time_s: float
    """Time [s]."""
    position_m: Vector3
    """Position of the body in W, p_WB [m]."""
    rpy_rad: Vector3 = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw of the body [rad]: R = Rz(yaw) Ry(pitch) Rx(roll)."""


class PosesConfig(BaseConfig):
    """A prescribed motion: the sensors follow it exactly, also through walls, without dynamics.

    Time begins at the first pose. Before the first and after the last pose the rig rests. It takes no
    commands, and touches nothing.
    """

    kind: Literal["poses"] = "poses"
    file: FilePath | None = None
    """File of poses; null: `keyframes` are given."""
    format: PoseFormat = "tum"
    """`tum`: time_s x y z qx qy qz qw. `euroc`: time_ns,x,y,z,qw,qx,qy,qz,... `csv`:
    time_s,x,y,z,qx,qy,qz,qw. `bag`: a bag of ROS 1 or ROS 2, with PoseStamped, TransformStamped or Odometry.
    Lines that begin with # are left out, and one line of names at the top of csv."""
    topic: str | None = None
    """`bag`: topic of the poses; null: the only topic that has some."""
    keyframes: Annotated[tuple[KeyframeConfig, ...], Field(min_length=2)] | None = None
    """Poses in place of a file: [{time_s: 0, position_m: [0, 0, 1]}, ...]."""
    frame: Literal["body", "optical"] = "body"
    """Frame whose poses these are. `body`: x forward, y left, z up. `optical`: a camera's, x right, y down, z
    forward; the origin of the body is there, and a camera whose mount is at zero sees from there."""
    start_s: Annotated[float, Field(ge=0.0)] = 0.0
    """Time after the first pose at which the run begins [s]."""

    @model_validator(mode="after")
    def _one_source(self) -> PosesConfig:
        if (self.file is None) == (self.keyframes is None):
            raise ValueError("give file or keyframes" + ("" if self.file is None else ", not both"))
        return self


class Poses(NamedTuple):
    """Poses of a body, in the order of time."""

    stamps_ns: NDArray[np.int64]
    """[ns], shape [n]."""
    position: NDArray[np.float64]
    """p_WB [m], shape [n, 3]."""
    orientation: NDArray[np.float64]
    """q_WB, xyzw, of unit length, shape [n, 4]."""


def pose_path(config: PosesConfig) -> Path:
    """Return the path through the poses of a configuration.

    Raises:
        ValueError: A file cannot be read, or a row is wrong; the message names file, row and value.
    """
    if config.keyframes is not None:
        rpy_rad = [frame.rpy_rad for frame in config.keyframes]
        quaternions = scipy.spatial.transform.Rotation.from_euler("xyz", rpy_rad).as_quat()
        frames = zip(config.keyframes, quaternions, strict=True)
        where = "path.keyframes"
        table = np.array([[frame.time_s, *frame.position_m, *turn] for frame, turn in frames])
        poses = _check_poses(table, where, lambda row: f"{where}[{row}]", repeats=False)
    else:
        assert config.file is not None
        where = str(config.file)
        poses = read_poses(config.file, config.format, topic=config.topic)
    orientation = scipy.spatial.transform.Rotation.from_quat(poses.orientation)
    if config.frame == "optical":
        orientation = orientation * scipy.spatial.transform.Rotation.from_quat(Q_FORWARD_OPTICAL).inv()
    stamps_ns = poses.stamps_ns - round(config.start_s * NS_PER_S)
    if stamps_ns[-1] <= 0:
        raise ValueError(
            f"path.start_s must be before the last pose at {poses.stamps_ns[-1] / NS_PER_S:g} s, "
            f"got {config.start_s:g}"
        )
    try:
        with np.errstate(over="raise", invalid="raise"):
            return spline_path(stamps_ns, poses.position, orientation)
    except (FloatingPointError, ValueError):  # SciPy's search for the rotations does not end
        raise ValueError(
            f"{where}: no smooth motion goes through these poses: some turn far in no time"
        ) from None


def read_poses(file: FilePath, kind: PoseFormat, *, topic: str | None = None) -> Poses:
    """Read a file of poses; stamps count from the first.

    Poses with the time of the one before, or nearly so, are left out, and the log says it: published ground
    truth has some. Of a bag the topic may be left open if only one has poses.

    Raises:
        ValueError: The file cannot be read, or a row is wrong; the message names file, row and value.
        ImportError: The libraries that read bags are not installed.
    """
    if kind == "bag":
        return _read_bag(file.expanduser(), topic)
    _, unit_s, columns = _FORMATS[kind]
    try:
        table, lines = _read_text(file, kind)
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read {file}: {error}") from None
    return _check_poses(table[:, columns], str(file), lambda row: f"{file}, line {lines[row]}", unit_s=unit_s)


def _read_text(file: FilePath, kind: PoseFormat) -> tuple[NDArray[Any], list[int]]:
    """Return the numbers of a text file, float64 or, of nanoseconds, longdouble; and their lines."""
    description = _FORMATS[kind][0]
    rows: list[list[Any]] = []
    lines: list[int] = []
    number = np.longdouble if kind == "euroc" else float  # 19 digits of nanoseconds
    for line, text in enumerate(file.expanduser().read_text(encoding="utf-8-sig").splitlines(), 1):
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        words = text.split() if kind == "tum" else [word.strip() for word in text.split(",")]
        try:
            row = [number(word) for word in words[:8]]
        except ValueError:
            if not rows and kind != "tum":
                continue  # names of columns
            raise ValueError(f"{file}, line {line}: no numbers, {text!r}: {description}") from None
        if len(row) < 8 or (kind == "tum" and len(words) == 12):  # KITTI's rows of a matrix have no time
            raise ValueError(f"{file}, line {line}: {len(words)} numbers, not 8, {text!r}: {description}")
        rows.append(row)
        lines.append(line)
    return np.array(rows).reshape(-1, 8), lines


_POSE_FIELDS = {
    "PoseStamped": ("pose", "position", "orientation"),
    "PoseWithCovarianceStamped": ("pose.pose", "position", "orientation"),
    "Odometry": ("pose.pose", "position", "orientation"),
    "TransformStamped": ("transform", "translation", "rotation"),
}
"""Where messages of ROS have a pose, and what its parts are called."""


def _read_bag(file: FilePath, topic: str | None) -> Poses:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError(f"bags need rosbags: {install_hint('ros2')}") from error
    rows: list[list[float]] = []
    start_ns: int | None = None
    try:
        with AnyReader([file], default_typestore=get_typestore(Stores.LATEST)) as reader:
            has_poses = [c for c in reader.connections if c.msgtype.rpartition("/")[2] in _POSE_FIELDS]
            chosen = [c for c in has_poses if topic in (None, c.topic)]
            if len({c.topic for c in chosen}) != 1:
                known = ", ".join(sorted({c.topic for c in has_poses})) or "none"
                raise ValueError(
                    f"{file}: say in path.topic which topic has the poses, {topic!r}; with poses: {known}"
                )
            for connection, _, data in reader.messages(chosen):
                message: Any = reader.deserialize(data, connection.msgtype)
                where, *parts = _POSE_FIELDS[connection.msgtype.rpartition("/")[2]]
                place, turn = attrgetter(*parts)(attrgetter(where)(message))
                stamp_ns = message.header.stamp.sec * NS_PER_S + message.header.stamp.nanosec
                start_ns = stamp_ns if start_ns is None else start_ns
                pose = [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]
                rows.append([stamp_ns - start_ns, *pose])
    except (OSError, AnyReaderError) as error:
        raise ValueError(f"cannot read {file}: {error}") from None
    return _check_poses(
        np.array(rows).reshape(-1, 8), str(file), lambda row: f"{file}, message {row}", unit_s=1e-9
    )


def _check_poses(
    table: NDArray[Any],
    where: str,
    name: Callable[[int], str],
    *,
    unit_s: float = 1.0,
    repeats: bool = True,
) -> Poses:
    """Return poses, with stamps from the first one on.

    The table has time in `unit_s`, p_WB [m] and q_WB, xyzw, of length 1 to 1 %, shape [n, 8]. Messages call
    it `where` and a row `name`. With `repeats` poses less than 1 % of the usual time after the one before are
    left out, not refused.
    """
    times, p, q = table[:, 0], table[:, 1:4].astype(np.float64), table[:, 4:].astype(np.float64)
    if len(times) < 2:
        raise ValueError(f"{where}: a motion needs at least two poses, got {len(times)}")
    length = np.linalg.norm(q, axis=1)
    for row in np.flatnonzero(~np.isfinite(table).all(axis=1))[:1]:
        raise ValueError(f"{name(row)}: not finite, got {[float(value) for value in table[row]]}")
    for row in np.flatnonzero(np.abs(length - 1.0) > _LENGTH_TOLERANCE)[:1]:
        raise ValueError(f"{name(row)}: no unit quaternion, {q[row].tolist()} has length {length[row]:.6g}")
    stamps_ns = np.rint((times - times[0]) * (unit_s * NS_PER_S)).astype(np.int64)
    gaps_ns = np.diff(stamps_ns)
    for row in np.flatnonzero(gaps_ns < (0 if repeats else 1))[:1] + 1:
        before, after = float(times[row - 1]), float(times[row])
        raise ValueError(f"{name(row)}: time must increase, got {after!r} after {before!r}")
    repeated = np.flatnonzero(gaps_ns < _REPEAT_SHARE * np.median(gaps_ns) if repeats else gaps_ns < 0) + 1
    if len(repeated):
        told = len(repeated), name(repeated[0])
        _log.warning(
            "%d poses come with the time of the one before, and are left out: the first is %s", *told
        )
    rows = np.delete(np.arange(len(times)), repeated)
    return Poses(stamps_ns[rows], p[rows], (q / length[:, None])[rows])


def spline_path(
    stamps_ns: NDArray[np.int64], position: NDArray[np.float64], orientation: scipy.spatial.transform.Rotation
) -> Path:
    """Return the path through poses p_WB [m], [n, 3], and R_WB at rising stamps [ns]; it prescribes both."""
    times_s = (stamps_ns - stamps_ns[0]) / NS_PER_S
    spans_s = np.diff(times_s)
    rising = spans_s[:, None, None] ** np.arange(4)
    place = _rising(scipy.interpolate.CubicSpline(times_s, position).c) * rising
    rotation = _rising(scipy.spatial.transform.RotationSpline(times_s, orientation).interpolator.c) * rising
    forward = orientation.apply([1.0, 0.0, 0.0])
    yaw = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    heading = np.zeros((len(spans_s), 1, 4))
    heading[:, 0, 0], heading[:, 0, 1] = yaw[:-1], np.diff(yaw)
    attitude = Attitude(knots=orientation.as_quat(), rotation_vectors=rotation.transpose(0, 2, 1))
    return Path(stamps_ns, np.concatenate([place, heading], axis=1), attitude)


def _rising(coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return coefficients [degree + 1, S, 3] in falling powers as [S, 3, 4] in rising ones."""
    rising = coefficients[::-1].transpose(1, 2, 0)
    return np.pad(rising, ((0, 0), (0, 0), (0, 4 - rising.shape[2])))
