"""The C module is left out where it is of another version."""

from __future__ import annotations

import logging
import subprocess
import sys
import types

import pytest

from cortex import compiled


@pytest.fixture
def found(monkeypatch):
    """What is found as `cortex._native`."""
    module = types.ModuleType("cortex._native")
    module.__file__ = "there/_native.so"

    def load(name):
        if module.__file__ is None:
            raise ImportError("undefined symbol: nothing")
        return module

    monkeypatch.setattr(compiled.importlib, "import_module", load)
    monkeypatch.delenv("CORTEX_PURE_PYTHON", raising=False)
    return module


def test_the_compiled_module_is_of_this_version():
    assert compiled.native is None or compiled.native.INTERFACE == compiled.INTERFACE


def test_a_module_of_another_version_or_that_cannot_be_loaded_is_left_out_and_no_secret(found, caplog):
    with caplog.at_level(logging.WARNING):
        assert compiled._load() is None
        assert "there/_native.so is older or newer" in caplog.text
        found.INTERFACE = compiled.INTERFACE
        assert compiled._load() is found
        found.__file__ = None
        assert compiled._load() is None
    assert "cannot be loaded" in caplog.text
    assert "undefined symbol: nothing" in caplog.text


@pytest.mark.parametrize("enabled", [True, False])
def test_without_the_gil_nothing_is_imported(enabled):
    """Better an error than a message that is lost now and then."""
    program = f"import sys; sys._is_gil_enabled = lambda: {enabled}; from cortex import Node"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode == 0) == enabled
    assert enabled or "cortex needs the GIL: run python with -X gil=1" in done.stderr


def test_it_can_be_left_out_on_request(found, monkeypatch):
    found.INTERFACE = compiled.INTERFACE
    monkeypatch.setenv("CORTEX_PURE_PYTHON", "1")
    assert compiled._load() is None
