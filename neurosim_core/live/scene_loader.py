"""The scene of a simulator, loaded beside its stream."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from neurosim_core.config import SimulationConfig
from neurosim_core.scene.bodies import make_bodies
from neurosim_core.simulation import load_scene
from neurosim_core.view.rerun_shapes import SceneShapes, scene_shapes


class SceneLoader:
    """Loads scenes in a thread, so that the stream is shown meanwhile; each only once."""

    def __init__(self, say: Callable[[str], None]) -> None:
        """Load nothing yet.

        Args:
            say: Told if a scene cannot be had.
        """
        self._say = say
        self._settings: Any = None
        self._shapes: SceneShapes | None = None
        self._lock = threading.Lock()
        self._threads: list[threading.Thread] = []

    @property
    def loading(self) -> bool:
        """Whether a scene is being loaded, even if nobody wants it any more."""
        return any(thread.is_alive() for thread in self._threads)

    def load(self, config: SimulationConfig) -> None:
        """Begin to load a scene, unless it is the one that is there."""
        with self._lock:
            if _what(config) == self._settings:
                return
            self._settings, self._shapes = _what(config), None
        thread = threading.Thread(target=self._load, args=(config,), name="load scene", daemon=True)
        self._threads = [other for other in self._threads if other.is_alive()] + [thread]
        thread.start()

    def shapes(self) -> SceneShapes | None:
        """Return the scene; None if it is not there yet, or cannot be had."""
        with self._lock:
            return self._shapes

    def _load(self, config: SimulationConfig) -> None:
        try:
            shapes = scene_shapes(load_scene(config.scene), make_bodies(config.bodies))
        except (ValueError, OSError) as error:
            self._say(f"warning: shown without the scene: {error}")
            return
        with self._lock:
            if _what(config) == self._settings:
                self._shapes = shapes


def _what(config: SimulationConfig) -> tuple[Any, Any]:
    return config.scene, config.bodies
