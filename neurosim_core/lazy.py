"""Public names that are imported on first use."""

from __future__ import annotations

import ast
import gc
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any


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
        collects = gc.isenabled()
        gc.disable()  # what imports make stays: to look through it takes a quarter of their time
        try:
            if module == package:  # a module of the package itself
                return importlib.import_module(f"{module}.{attribute}")
            return getattr(importlib.import_module(module), attribute)
        finally:
            if collects:
                gc.enable()

    return find, lambda: names, names
