"""Event files: readers and writers, one file for each format."""

from neurosim_core.io.event_file import EventFileError, EventReader, EventWriter, NoEventsError
from neurosim_core.io.formats import FORMATS, check_events, create_events, is_event_file, open_events

__all__ = [
    "FORMATS",
    "EventFileError",
    "EventReader",
    "EventWriter",
    "NoEventsError",
    "check_events",
    "create_events",
    "is_event_file",
    "open_events",
]
