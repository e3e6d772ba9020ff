"""One import gives every public name, and costs nothing before one is used."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import neurosim_core as ns


@pytest.mark.parametrize("name", ns.__all__)
def test_every_public_name_is_there(name):
    assert getattr(ns, name) is not None


@pytest.mark.parametrize("name", ["scene", "sensors", "learn"])
def test_what_a_package_lists_is_there(name):
    """With the libraries that are installed: `help` reads all names."""
    if name == "learn":
        pytest.importorskip("torch")
    package = getattr(ns, name)
    assert set(package.__all__) <= {found for found, _ in inspect.getmembers(package)}


@pytest.mark.parametrize(
    ("category", "known"),
    [
        ("vehicle", ["multirotor"]),
        ("controller", ["se3"]),
        ("scene", ["apartment", "hall", "mesh"]),
        ("renderer", ["pyrender", "remote", "synthetic", "warp"]),
        ("sink", ["cortex", "event_file", "hdf5", "overview", "rerun"]),
    ],
)
def test_a_category_lists_our_kinds_before_anything_else_is_used(category, known):
    code = f"import neurosim_core as ns; print(sorted(ns.registry.kinds({category!r})))"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.strip() == str(known)


def test_examples_and_documents_need_no_other_import():
    root = Path(__file__).parents[1]
    files = [root / "README.md", *root.glob("docs/**/*.md"), *root.glob("examples/*.py")]
    deep = r"from (neurosim_core[\w.]*) import|`(neurosim_core\.\w+\.\w+)"
    wanted = {found for file in files for found in re.findall(deep, file.read_text())}
    assert wanted == set()


def test_an_unknown_name_is_said():
    with pytest.raises(AttributeError, match="no attribute 'Simulations', known: "):
        ns.Simulations  # noqa: B018


def test_the_import_loads_nothing_heavy():
    heavy = ("warp", "numpy", "scipy", "trimesh", "torch", "rerun", "pydantic")
    code = f"import sys, neurosim_core; print([name for name in {heavy} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_a_set_up_looks_for_no_garbage():
    """Among hundreds of thousands of objects that stay, each look takes up to 0.1 s."""
    code = """
import gc
import neurosim_core as ns
ns.load_config
new, looks = len(gc.get_objects(0)), []
config = ns.load_config({"scene": "hall", "path": {"kind": "hover"}, "sensors": {}, "device": "cpu"})
gc.callbacks.append(lambda phase, about: looks.append(phase))
ns.make_model(config)
during = len(looks)
gc.collect()
print(new < 20_000, during < 10, len(looks) > during, gc.isenabled())
"""
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert said.strip() == "True True True True"
