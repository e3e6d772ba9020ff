"""Pictures for people: Rerun, live or to a file, and one overview of a flight."""

from neurosim_core.view.overview import FlightSummary, Snapshot, Track
from neurosim_core.view.overview_plot import save_overview
from neurosim_core.view.pictures import event_classes, event_picture
from neurosim_core.view.rerun_log import RerunLogger
from neurosim_core.view.rerun_sdk import open_rerun
from neurosim_core.view.rerun_shapes import SceneShapes, scene_shapes
from neurosim_core.view.rerun_targets import FileTarget, ViewerTarget
from neurosim_core.view.rerun_viewer import RerunViewer, ViewerEnded

__all__ = [
    "FileTarget",
    "FlightSummary",
    "RerunLogger",
    "RerunViewer",
    "SceneShapes",
    "Snapshot",
    "Track",
    "ViewerEnded",
    "ViewerTarget",
    "event_classes",
    "event_picture",
    "open_rerun",
    "save_overview",
    "scene_shapes",
]
