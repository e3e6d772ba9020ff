"""The page of settings, which is written from the code."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import neurosim_core as ns


def test_it_has_every_sensor_and_scene_and_a_remark_on_each_key():
    pytest.importorskip("mkdocs", reason="needs the extra docs", exc_type=ImportError)
    path = Path(__file__).parents[1] / "docs" / "pages.py"
    code = f"import runpy; print(runpy.run_path({str(path)!r})['settings_page']())"
    # in a process of its own, where no test has registered kinds
    page = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    for kind in ("apartment", "hall", "mesh"):
        assert f"## `scene`, kind `{kind}`" in page
    sensors = ns.registry.kinds("sensor").items()
    own = {kind for kind, cls in sensors if cls.__module__.startswith("neurosim_core")}
    assert {kind for kind in own if f"## `sensors.NAME`, kind `{kind}`" in page} == own
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    assert len(rows) > 400
    assert [row for row in rows if row.endswith("|  |")] == []
