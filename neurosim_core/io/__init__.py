"""Event files: readers and writers, one file for each format."""

from neurosim_core.io.event_file import EventFileError, EventReader, EventWriter
from neurosim_core.io.formats import FORMATS, create_events, is_event_file, open_events

__all__ = [
    "FORMATS",
    "EventFileError",
    "EventReader",
    "EventWriter",
    "create_events",
    "is_event_file",
    "open_events",
]
