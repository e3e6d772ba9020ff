"""Who may import whom (the table of the design), no cycles, and an import that costs next to nothing."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from collections.abc import Collection, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = [p for p in ("neurosim_core", "cortex", "cortex_ros2_bridge") if (ROOT / p).is_dir()]
FORBIDDEN = {
    "neurosim_core": {"zmq", "rclpy", "cortex_ros2_bridge", "rotorpy"},
    "cortex": {"neurosim_core", "cortex_ros2_bridge", "warp", "rclpy"},
    "cortex_ros2_bridge": {"neurosim_core", "warp", "zmq"},
}
LAZY = {"torch", "rerun", "h5py", "matplotlib", "pyrender", "OpenGL", "gymnasium"}
LAZY |= {"cyclonedds", "rclpy", "mcap", "zenoh", "iceoryx2", "lcm", "rotorpy", "av", "faery"}
"""Heavy or optional: imported where they are used, never when a module is imported."""
SPEAKS_DDS = {f"cortex_ros2_bridge.backend.{name}" for name in ("cyclone", "dds", "graph", "idl")}
"""They are about cyclonedds from their first line to the last; others import them where they are used."""


@functools.cache
def modules(package: str) -> dict[str, list[tuple[str, str, bool]]]:
    """What each module imports: module, name in it ("": the module itself), and whether at top level.

    At top level is what is not inside functions. What is behind `if TYPE_CHECKING` is not imported.
    """
    found = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = list(statements(ast.parse(path.read_text(encoding="utf-8")), top_level=True))
    return found


def statements(tree: ast.AST, *, top_level: bool) -> Iterator[tuple[str, str, bool]]:
    for child in ast.iter_child_nodes(tree):
        if isinstance(child, ast.Import):
            yield from ((alias.name, "", top_level) for alias in child.names)
        elif isinstance(child, ast.ImportFrom) and child.module:
            yield from ((child.module, alias.name, top_level) for alias in child.names)
        elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
            continue
        elif isinstance(child, ast.stmt | ast.ExceptHandler | ast.match_case):
            is_function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
            yield from statements(child, top_level=top_level and not is_function)


def imports(rows: list[tuple[str, str, bool]], *, top_level: bool, modules: Collection[str] = ()) -> set[str]:
    """`from package import submodule` counts as the submodule if that is among the known `modules`."""
    return {
        f"{module}.{name}" if f"{module}.{name}" in modules else module
        for module, name, outside in rows
        if outside or not top_level
    }


@pytest.mark.parametrize("package", PACKAGES)
def test_package_imports_only_what_it_may(package):
    for name, rows in modules(package).items():
        used = {n.split(".")[0] for n in imports(rows, top_level=False)}
        streams = name.startswith(tuple(f"neurosim_core.{part}" for part in ("live", "data", "io", "learn")))
        allowed = {"cortex"} if streams else set()
        allowed |= {"rotorpy"} if name == "neurosim_core.bench.dynamics_oracle" else set()
        forbidden = FORBIDDEN[package] | ({"cortex"} if package == "neurosim_core" else set())
        assert not (used & forbidden) - allowed, name


@pytest.mark.parametrize("package", PACKAGES)
def test_heavy_libraries_are_imported_where_they_are_used(package):
    for name, rows in modules(package).items():
        used = imports(rows, top_level=True, modules=SPEAKS_DDS)
        heavy = {n.split(".")[0] for n in used} & LAZY | used & SPEAKS_DDS
        if name.startswith("neurosim_core.learn."):  # what is there is imported on use
            heavy -= {"torch", "gymnasium"}
        assert not heavy - (SPEAKS_DDS | {"cyclonedds"} if name in SPEAKS_DDS else set()), name


@pytest.mark.parametrize("package", PACKAGES)
def test_there_is_no_import_cycle(package):
    known = modules(package)
    graph = {
        name: {n for n in imports(rows, top_level=True, modules=known) if n in known and n != name}
        for name, rows in known.items()
    }
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join([*trail, name])
        if name not in done:
            for other in graph[name]:
                visit(other, (*trail, name))
            done.add(name)

    for name in graph:
        visit(name, ())


def test_importing_the_package_is_cheap():
    """No device starts and no heavy library loads: no timing, which a busy machine would upset."""
    code = "import sys, neurosim_core; print(' '.join(sys.modules))"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert not {"warp", "numpy", "scipy", "trimesh", "pydantic", "torch", "rerun"} & set(loaded)


def test_every_file_has_one_subject():
    banned = {"utils", "common", "helpers", "types"}
    for package in PACKAGES:
        assert not [name for name in modules(package) if name.rsplit(".", 1)[-1] in banned]
