"""CDR against a second writer; and data that are no messages: cut off, too long, wrong lengths, noise."""

from __future__ import annotations

import importlib.util
import struct

import numpy as np
import pytest
from cdr_oracle import random_message, write

from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.cdr import CdrError
from cortex_ros2_bridge.convert import RULES
from cortex_ros2_bridge.msgs import Header, Image, Imu, String, message_class
from cortex_ros2_bridge.typestore import UnknownTypeError, typestore

ROUTED = sorted({rule.ros_type for rule in RULES})


def test_a_header_is_these_bytes():
    """By hand: header of CDR; seconds; nanoseconds; length of "map" with its 0; the text."""
    header = Header(frame_id="map")
    header.stamp.sec, header.stamp.nanosec = -2, 500
    expected = bytes.fromhex("00010000 feffffff f4010000 04000000 6d617000")
    assert bytes(cdr.encode(header)) == expected
    decoded = cdr.decode(expected, Header)
    assert (decoded.stamp.sec, decoded.stamp.nanosec, decoded.frame_id) == (-2, 500, "map")


def test_a_message_is_padded_to_a_multiple_of_four():
    assert bytes(cdr.encode(String(data="ab"))) == bytes.fromhex("00010000 03000000 61620000")
    assert bytes(cdr.encode(String(data="abcd"))) == bytes.fromhex("00010000 05000000 61626364 00000000")


def test_encoding_and_decoding_agree_with_a_second_writer():
    rng = np.random.default_rng(0)
    for type_name in sorted(typestore().fielddefs):
        for _ in range(3):
            message = random_message(type_name, rng)
            expected = write(message, type_name)
            assert bytes(cdr.encode(message)) == expected, type_name
            assert bytes(cdr.encode(cdr.decode(expected, type_name))) == expected, type_name
            big = write(message, type_name, ">")
            assert bytes(cdr.encode(cdr.decode(big, type_name))) == expected, type_name
            theirs = bytes(typestore().serialize_cdr(message, type_name))
            assert expected == theirs + bytes(-len(theirs) % 4), type_name


@pytest.mark.parametrize("type_name", ROUTED)
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_message_that_is_cut_off_anywhere_is_refused(type_name, order):
    message = random_message(type_name, np.random.default_rng(5))
    data, whole = write(message, type_name, order), write(message, type_name)
    unpadded = len(typestore().serialize_cdr(message, type_name))
    for length in range(unpadded):
        with pytest.raises(CdrError, match=type_name):
            cdr.decode(data[:length], type_name)
    for length in range(unpadded, len(data) + 1):
        assert bytes(cdr.encode(cdr.decode(data[:length], type_name))) == whole


@pytest.mark.parametrize("type_name", ROUTED)
def test_a_message_that_is_too_long_is_refused(type_name):
    data = cdr.encode(random_message(type_name, np.random.default_rng(6)))
    with pytest.raises(CdrError, match=rf"{type_name}|mismatch"):
        cdr.decode(bytes(data) + bytes(4), type_name)


@pytest.mark.parametrize("kind", [b"\0\2", b"\0\3", b"\0\7", b"\0\6", b"\1\0", b"\xff\xff"])
def test_other_representations_than_plain_cdr_are_refused(kind):
    data = bytearray(cdr.encode(String(data="a")))
    data[:2] = kind
    with pytest.raises(CdrError, match=f"0x{kind.hex()}"):
        cdr.decode(data, "std_msgs/msg/String")


@pytest.mark.parametrize("count", [5, 1000, 2**31, 2**32 - 1])
def test_lengths_beyond_the_data_are_refused_without_making_room_for_them(count):
    image = bytearray(cdr.encode(Image(data=[7])))
    assert image[-8:-4] == struct.pack("<I", 1)
    image[-8:-4] = struct.pack("<I", count)
    with pytest.raises(CdrError, match="Image"):
        cdr.decode(image, "sensor_msgs/msg/Image")
    text = bytearray(cdr.encode(String(data="a")))
    text[4:8] = struct.pack("<I", count)
    with pytest.raises(CdrError, match="String"):
        cdr.decode(text, "std_msgs/msg/String")
    transforms = bytearray(cdr.encode(message_class("tf2_msgs/msg/TFMessage")()))
    transforms[4:8] = struct.pack("<I", count)
    with pytest.raises(CdrError, match="TFMessage"):
        cdr.decode(transforms, "tf2_msgs/msg/TFMessage")


def test_text_that_is_no_utf8_is_refused():
    with pytest.raises(CdrError, match="String"):
        cdr.decode(bytes.fromhex("00010000 03000000 fffe0000"), "std_msgs/msg/String")


def test_noise_is_decoded_or_refused_but_nothing_else():
    """Messages with random bytes in random places: whatever comes out, it is a message or a CdrError."""
    rng = np.random.default_rng(11)
    refused = 0
    for type_name in ROUTED:
        good = np.frombuffer(cdr.encode(random_message(type_name, rng)), np.uint8)
        for _ in range(60):
            data = good.copy()
            where = rng.integers(2, len(data), rng.integers(1, 6))
            data[where] = rng.integers(0, 256, len(where))
            try:
                cdr.decode(data.tobytes(), type_name)
            except CdrError:
                refused += 1
    assert refused > 100


def test_a_message_that_does_not_fit_its_type_is_refused():
    record = cdr.record_class("std_msgs/msg/UInt8")
    with pytest.raises(CdrError, match="UInt8"):
        cdr.encode(record(300))
    imu = cdr.decode(cdr.encode(Imu()), Imu)
    imu.orientation_covariance = np.zeros(8)
    with pytest.raises(CdrError, match="Imu"):
        cdr.encode(imu)


def test_unknown_types_are_refused():
    with pytest.raises(UnknownTypeError, match="no_msgs/msg/Such"):
        cdr.decode(b"\0\1\0\0", "no_msgs/msg/Such")
    with pytest.raises(TypeError, match="not a ROS message"):
        cdr.encode(3)


def test_bytes_are_those_of_rclpy():
    """Where ROS is sourced: the messages of the packages that are installed."""
    serialization = pytest.importorskip("rclpy.serialization")
    compared = 0
    for type_name in ROUTED:
        if importlib.util.find_spec(type_name.split("/")[0]) is None:
            continue
        package, _, name = type_name.split("/")
        real = getattr(importlib.import_module(f"{package}.msg"), name)
        ours = bytes(cdr.encode(random_message(type_name, np.random.default_rng(3))))
        message = serialization.deserialize_message(ours, real)
        theirs = cdr.encode(message)
        assert serialization.deserialize_message(bytes(theirs), real) == message
        assert bytes(cdr.encode(cdr.decode(theirs, type_name))) == ours
        # Fast CDR leaves bytes between fields as they happen to be.
        assert len(theirs) == len(ours)
        assert sum(a != b for a, b in zip(ours, theirs, strict=True)) < 0.1 * len(theirs) + 4
        compared += 1
    assert compared > 5
