"""Optional libraries: error messages say here, and only here, how to install them."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any


def install_hint(extra: str) -> str:
    """Return the command that installs the libraries of an extra of pyproject.toml."""
    return f"pip install -e '.[{extra}]' in the folder of Neurosim"


def need(what: str, extra: str, *modules: str) -> Any:
    """Import modules of optional libraries, and return the first; `what` needs them, as the error says."""
    try:
        found = [importlib.import_module(module) for module in modules]
    except ImportError as error:
        raise ImportError(f"{what}: {install_hint(extra)}") from error
    return found[0]


def check_cortex() -> None:
    """Refuse another package called `cortex`: the package index has one, which is unrelated.

    Raises:
        ImportError: `import cortex` would not find the package that comes with the simulator.
    """
    found = importlib.util.find_spec("cortex")
    place = Path(found.origin).resolve().parent if found and found.origin else None
    if place != Path(__file__).resolve().parents[1] / "cortex":
        raise ImportError(
            f"`import cortex` finds {place or 'nothing'}, which is not the Cortex that comes with Neurosim: "
            "pip uninstall cortex, then pip install -e . in the folder of Neurosim"
        )
