"""Bags of ROS to logs of Cortex, and back: `cortex-ros2-bridge --convert SOURCE TARGET`."""

from __future__ import annotations

import contextlib
import shutil
from collections import Counter
from pathlib import Path

from cortex.log import LogWriter, open_log
from cortex.schema import schema_of
from cortex_ros2_bridge.bag_file import BagReader, BagWriter
from cortex_ros2_bridge.routes import CORTEX_TYPES

COMMAND_TOPICS = {
    "cortex/MotorCommand": "motor_speeds",
    "cortex/RateThrustCommand": "rates",
    "cortex/AttitudeCommand": "attitude",
    "cortex/VelocityCommand": "velocity",
    "cortex/PoseCommand": "position",
}
"""Where commands go in Cortex, below VEHICLE/command/."""


def convert(source: Path, target: Path) -> tuple[Counter[str], list[str]]:
    """Convert a log of Cortex into a bag, or a bag into a log, whichever the source is.

    What was made of it is removed if it fails or is interrupted.

    Returns:
        How many messages of each topic were written, by their names in Cortex, and the topics left out: those
        of types that have no counterpart.

    Raises:
        BagError, BackendError, ConvertError: The bag is damaged, exists, or cannot have a message.
        LogError: The log is damaged.
        OSError: A file cannot be read or written.
    """
    with open(source, "rb") if source.is_file() else contextlib.nullcontext() as file:
        is_log = file is not None and file.read(27)[21:] == b"cortex"
    made = [path for path in (target, target.with_name(f"{target.stem}.bag")) if not path.exists()]
    try:
        return log_to_bag(source, target) if is_log else bag_to_log(source, target)
    except BaseException:
        for path in made:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        raise


def bag_to_log(source: Path, target: Path) -> tuple[Counter[str], list[str]]:
    """Convert a bag into a log: events, pictures, inertial measurements, odometry and commands."""
    counts: Counter[str] = Counter()
    with contextlib.closing(BagReader(source)) as bag, LogWriter(target) as log:
        for topic, message, at_ns in bag.timed_messages(*bag.topics, *bag.commands):
            if message is None:
                continue
            name = topic.removesuffix("/image_raw")
            command = COMMAND_TOPICS.get(schema_of(type(message)).name)
            if command is not None:
                name = f"{topic.rpartition('/')[0]}/command/{command}"
            log.write(name, message, at_ns)
            counts[name] += 1
        return counts, bag.others


def log_to_bag(source: Path, target: Path) -> tuple[Counter[str], list[str]]:
    """Convert a log into a bag, as the bridge would send its messages."""
    counts: Counter[str] = Counter()
    with open_log(source) as log, contextlib.closing(BagWriter(target)) as bag:
        types = {
            entry.topic: kind
            for entry in log.topics
            if (kind := CORTEX_TYPES.get(entry.schema.name)) and schema_of(kind) == entry.schema
        }
        for topic, message, info in log.messages(types, types=types):
            if bag.write(topic, message, frame_id=topic.strip("/"), at_ns=info.log_ns):
                counts[topic] += 1
        return counts, sorted({entry.topic for entry in log.topics} - counts.keys())
