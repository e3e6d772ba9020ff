"""Recordings: a writer and a reader of HDF5 files."""

from neurosim_core.record.hdf5 import RecordingWriter
from neurosim_core.record.header import Intrinsics, RecordingHeader, SensorDescription, describe_sensors
from neurosim_core.record.recording import Recording

__all__ = [
    "Intrinsics",
    "Recording",
    "RecordingHeader",
    "RecordingWriter",
    "SensorDescription",
    "describe_sensors",
]
