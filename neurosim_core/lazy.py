"""Public names that are imported on first use."""

from __future__ import annotations

import ast
import gc
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from neurosim_core.garbage import pause_collection


def homes_of(file: str) -> dict[str, tuple[str, str]]:
    """Return module and name there of each name that a package imports under `if TYPE_CHECKING:`.

    `file`: `__file__` of the package.
    """
    tree = ast.parse(Path(file).read_text(encoding="utf-8"))
    (block,) = (
        node for node in tree.body if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
    )
    return {
        alias.asname or alias.name: (str(node.module), alias.name)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def lazy_names(
    package: str, file: str, prepare: Callable[[], object] = lambda: None
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package.

    Its names are those that `if TYPE_CHECKING:` imports (`from module import name as name`): a type checker
    reads the same lines, so that no name is listed twice.

    Args:
        package: `__name__` of the package.
        file: Its `__file__`.
        prepare: Called before a name is imported; it may raise ImportError.
    """
    homes = homes_of(file)
    names = sorted(homes)

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}, known: {', '.join(names)}")
        prepare()
        module, attribute = homes[name]
        if module == package:  # a module of the package itself
            module, attribute = f"{module}.{attribute}", ""
        is_new = module not in sys.modules
        with pause_collection():
            found = importlib.import_module(module)
            if is_new and gc.get_freeze_count() == 0:  # else the program has frozen objects of its own
                gc.freeze()
                gc.unfreeze()  # moves all objects to the oldest generation, unseen
        return getattr(found, attribute) if attribute else found

    return find, lambda: names, names
