"""The page of pictures."""

from __future__ import annotations

import base64
import io
import re

import numpy as np
from PIL import Image

from neurosim_core import cli


def test_a_section_shows_pictures_beside_settings(tmp_path):
    file = tmp_path / "page.html"
    assert cli.main(["gallery", "--only", "lenses", "--device", "cpu", "--out", str(file)]) == 0
    page = file.read_text()
    pictures = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))
        for data in re.findall(r'base64,([^"]+)"', page)
    ]
    assert [picture.shape for picture in pictures] == [(180, 240, 3)] * 2
    assert (pictures[0] != pictures[1]).any()
    assert all(len(np.unique(picture.reshape(-1, 3), axis=0)) > 500 for picture in pictures)
    assert re.findall(r"<figcaption>(\w+)<", page) == ["pinhole", "equidistant"]
    assert "kind: equidistant" in page


def test_an_unknown_section_is_refused(tmp_path, capsys):
    assert cli.main(["gallery", "--only", "noise", "--out", str(tmp_path / "page.html")]) == 1
    assert "unknown section 'noise', known: sensors, pixels, lenses, scenes" in capsys.readouterr().err


def test_every_sensor_has_a_place():
    from neurosim_core import registry
    from neurosim_core.view.gallery import sensors

    assert set(sensors()) == set(registry.kinds("sensor"))
