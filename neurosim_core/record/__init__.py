"""Recordings: one writer and its reader per file format."""

from neurosim_core.record.hdf5 import Flight, FlightWriter
from neurosim_core.record.header import FlightHeader, Intrinsics, SensorDescription, describe_sensors

__all__ = ["Flight", "FlightHeader", "FlightWriter", "Intrinsics", "SensorDescription", "describe_sensors"]
