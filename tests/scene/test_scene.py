"""A scene that was made can be shown."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from neurosim_core.scene.apartment import ApartmentConfig, make_apartment


def test_a_scene_without_triangles_is_refused():
    scene = make_apartment(ApartmentConfig(rooms=1))
    with pytest.raises(ValueError, match=r"a scene must have triangles, and .*apartment.* has none"):
        dataclasses.replace(scene, faces=np.zeros((0, 3), np.int32))
