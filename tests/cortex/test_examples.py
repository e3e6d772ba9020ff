"""The examples and commands of cortex/README.md."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "cortex" / "README.md").read_text(encoding="utf-8")
EXAMPLES = dict(re.findall(r"<!-- example: (\w+) -->\s*```python\n(.*?)```", README, flags=re.DOTALL))
SHOWN = {"minute": "mean 2.25 m", "loan": "(480, 640, 3)", "service": "Done(stamp_ns=0)"}
"""What each example prints, among other things."""


def test_every_example_is_run():
    assert set(EXAMPLES) == set(SHOWN)
    assert README.count("```python") == len(EXAMPLES)


@pytest.mark.parametrize("name", sorted(SHOWN))
def test_an_example(name, runtime, tmp_path):
    path = tmp_path / "example.py"
    path.write_text(EXAMPLES[name], encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-W", "error", path], capture_output=True, text=True, timeout=300.0, check=False
    )
    assert done.returncode == 0, done.stderr
    assert SHOWN[name] in done.stdout
    assert not done.stderr


def test_commands_exist():
    """Every `cortex …` of the README names a command of the program."""
    listed = set(re.findall(r"^cortex (\w+)", README, flags=re.MULTILINE))
    known = subprocess.run(
        [sys.executable, "-m", "cortex", "--help"], capture_output=True, text=True, timeout=300.0, check=True
    ).stdout
    assert listed
    for name in listed:
        assert re.search(rf"\b{name}\b", known), name
