"""Scenes: triangles with materials and lights, from a mesh file or generated."""

from __future__ import annotations

from typing import TYPE_CHECKING

from neurosim_core.lazy import lazy_names

if TYPE_CHECKING:  # isort: off
    from neurosim_core.scene.config import SceneConfig as SceneConfig
    from neurosim_core.scene.scene import (
        Ambient as Ambient,
        Light as Light,
        Material as Material,
        Scene as Scene,
        Texture as Texture,
    )

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
