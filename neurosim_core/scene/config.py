"""Which scene surrounds the vehicle: the settings of a scene, by kind."""

from __future__ import annotations

from neurosim_core.scene.scene import Scene
from neurosim_core.settings import BaseConfig


class SceneConfig(BaseConfig):
    """Settings of a scene. A kind adds its `kind`, what it needs, and `load`."""

    kind: str
    """Under which name the class is registered."""

    def load(self, *, pictures: bool = True) -> Scene:
        """Generate or read the scene.

        Args:
            pictures: Decode the textures of a file now, or when they are first looked at, if ever.

        Raises:
            SceneError: A file cannot be used.
        """
        raise NotImplementedError
