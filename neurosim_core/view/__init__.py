"""Pictures for people: Rerun, live or to a file, and one overview of a flight."""

from neurosim_core.view.event_picture import event_classes, event_picture
from neurosim_core.view.overview import FlightSummary, Snapshot, Track, save_overview
from neurosim_core.view.rerun_log import RerunLogger
from neurosim_core.view.rerun_outlet import FileOutlet, ViewerOutlet
from neurosim_core.view.rerun_sdk import open_recording
from neurosim_core.view.rerun_shapes import SceneShapes, scene_shapes
from neurosim_core.view.rerun_viewer import RerunViewer, ViewerEnded

__all__ = [
    "FileOutlet",
    "FlightSummary",
    "RerunLogger",
    "RerunViewer",
    "SceneShapes",
    "Snapshot",
    "Track",
    "ViewerEnded",
    "ViewerOutlet",
    "event_classes",
    "event_picture",
    "open_recording",
    "save_overview",
    "scene_shapes",
]
