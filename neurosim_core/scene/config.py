"""Which scene surrounds the vehicle: the settings of a scene, by kind."""

from __future__ import annotations

from neurosim_core.scene.scene import Scene
from neurosim_core.settings import BaseConfig


class SceneConfig(BaseConfig):
    """Base class of the settings of scenes. Subclasses add `kind`, their fields, and `load`."""

    kind: str
    """Name under which the class is registered."""

    def load(self, *, pictures: bool = True) -> Scene:
        """Generate or read the scene.

        Args:
            pictures: Decode the textures of a file now; else at their first use.

        Raises:
            SceneError: A file cannot be used.
        """
        raise NotImplementedError
