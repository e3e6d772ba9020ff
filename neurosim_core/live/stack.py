"""Simulator, controller and viewer as one command: `neurosim up`."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from rich.console import Console

from neurosim_core.config import SimulationConfig, to_yaml
from neurosim_core.live.supervisor import Part, run_together
from neurosim_core.scene.mesh import MeshSceneConfig
from neurosim_core.view.rerun_targets import check_new_file


def up(config: SimulationConfig, *, viewer: str, record: Path | None, overwrite: bool) -> int:
    """Run a simulator, the controller that follows the path, and a viewer, until one ends or we are told to.

    All end with the simulator. Without a controller a flight in lockstep cannot go on, so that its failure
    ends all; in streaming it is reported, and the fail-safe flies until another one comes. Without a viewer
    the flight goes on. They meet in the Cortex domain of the environment, so that other tools can join.

    Args:
        config: What is simulated and flown.
        viewer: native, web, none, a file that ends in .rrd, or auto: native where there is a display.
        record: Where to leave a recording, as with `serve`.
        overwrite: Replace a recording that is there.

    Returns:
        The exit status of the simulator, or of the controller whose failure ended all; 130 after a signal.

    Raises:
        ValueError: There is no such viewer.
        OSError: The viewer cannot write its file, or it is there already.
    """
    viewer_arguments = arguments_of(viewer)
    if viewer.endswith(".rrd"):
        check_new_file(Path(viewer))
    with tempfile.TemporaryDirectory(prefix="neurosim-") as folder:
        settings = Path(folder) / "config.yaml"
        settings.write_text(to_yaml(_independent_of_folder(config)), encoding="utf-8")
        recording = [] if record is None else ["--record", str(record), *["--overwrite"] * overwrite]
        streaming = config.live.mode == "streaming"
        parts = [
            Part(name="simulator", command=_neurosim("serve", str(settings), *recording), prefixed=False),
            Part(
                name="controller",
                command=_neurosim("fly", str(settings)),
                at_its_end="go on" if streaming else "end if it failed",
                advice_if_failed="the fail-safe flies until another one comes (neurosim fly)",
            ),
        ]
        if viewer_arguments is not None:
            parts.append(
                Part(
                    name="viewer",
                    command=_neurosim("view", *viewer_arguments),
                    at_its_end="go on",
                    advice="the flight goes on (neurosim view opens another)",
                )
            )
        return run_together(parts, console=Console(highlight=False), folder=folder)


def arguments_of(viewer: str) -> list[str] | None:
    """Return the arguments of `neurosim view` for a choice of viewer; None for none.

    Raises:
        ValueError: There is no such viewer.
    """
    has_display = sys.platform == "darwin" or any(os.environ.get(k) for k in ("DISPLAY", "WAYLAND_DISPLAY"))
    if viewer == "auto":
        viewer = "native" if has_display else "web"
    if viewer == "none":
        return None
    if viewer == "native":
        return []
    if viewer == "web":
        return ["--web"] if has_display else ["--web", "--no-browser"]
    if viewer.endswith(".rrd"):
        return ["--save", viewer]
    raise ValueError(f"--viewer must be auto, native, web, none or a file that ends in .rrd, got {viewer!r}")


def _neurosim(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "neurosim_core", *arguments]


def _independent_of_folder(config: SimulationConfig) -> SimulationConfig:
    """Make a relative scene file absolute, which would be looked up beside the settings file."""
    scene = config.scene
    if not isinstance(scene, MeshSceneConfig):
        return config
    file = Path.cwd() / scene.file.expanduser()
    return config.model_copy(update={"scene": scene.model_copy(update={"file": file})})
