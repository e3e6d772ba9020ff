"""Pictures for people: Rerun, live or to a file, and one overview of a flight."""

from neurosim_core.view.event_picture import event_classes, event_picture
from neurosim_core.view.overview import FlightSummary, Snapshot, Track, save_overview
from neurosim_core.view.rerun_log import RerunLogger, open_recording

__all__ = [
    "FlightSummary",
    "RerunLogger",
    "Snapshot",
    "Track",
    "event_classes",
    "event_picture",
    "open_recording",
    "save_overview",
]
