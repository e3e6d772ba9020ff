"""`neurosim up`: simulator, controller and viewer as one command. They start, print and end together."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from rich.console import Console

from neurosim_core.config import SimulationConfig, to_yaml
from neurosim_core.live.supervisor import Part, run_together
from neurosim_core.scene.mesh import MeshSceneConfig
from neurosim_core.view.rerun_targets import check_new_file
from neurosim_core.view.rerun_viewer import has_display


def up(config: SimulationConfig, *, viewer: str, record: Path | None, overwrite: bool) -> int:
    """Run a simulator, the controller that follows the path, and a viewer, until one ends or a signal comes.

    All end with the simulator. In lockstep the failure of the controller ends all; in streaming it is
    reported, and the fail-safe flies until another controller comes. The flight goes on without a viewer. The
    processes use the Cortex domain of the environment, so that other tools can join. `viewer`: native, web,
    none, a file that ends in .rrd, or auto: native where there is a display. `record`: folder to record to,
    as with `serve`. Returns the exit status of the simulator, or of the controller whose failure ended all;
    130 after a signal.
    """
    viewer_arguments = viewer_options(viewer)
    if viewer.endswith(".rrd"):
        check_new_file(Path(viewer))
    with tempfile.TemporaryDirectory(prefix="neurosim-") as folder:
        settings = Path(folder) / "config.yaml"
        settings.write_text(to_yaml(_with_absolute_scene(config)), encoding="utf-8")
        recording = [] if record is None else ["--record", str(record), *["--overwrite"] * overwrite]
        streaming = config.live.mode == "streaming"
        parts = [
            Part(name="simulator", command=_neurosim("serve", str(settings), *recording), is_prefixed=False),
            Part(
                name="controller",
                command=_neurosim("fly", str(settings)),
                at_its_end="go on" if streaming else "end if it failed",
                advice="the fail-safe flies until another controller comes (neurosim fly)",
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
        return run_together(parts, console=Console(highlight=False))


def viewer_options(viewer: str) -> list[str] | None:
    """Return the arguments of `neurosim view` for a choice of viewer; None for none."""
    if viewer == "auto":
        viewer = "native" if has_display() else "web"
    if viewer == "none":
        return None
    if viewer == "native":
        return []
    if viewer == "web":
        return ["--web"] if has_display() else ["--web", "--no-browser"]
    if viewer.endswith(".rrd"):
        return ["--save", viewer]
    raise ValueError(f"--viewer must be auto, native, web, none or a file that ends in .rrd, got {viewer!r}")


def _neurosim(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "neurosim_core", *arguments]


def _with_absolute_scene(config: SimulationConfig) -> SimulationConfig:
    """Make a relative scene file absolute: the others read the settings from another folder."""
    scene = config.scene
    if not isinstance(scene, MeshSceneConfig):
        return config
    file = Path.cwd() / scene.file.expanduser()
    return config.model_copy(update={"scene": scene.model_copy(update={"file": file})})
