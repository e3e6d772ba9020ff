"""Plans paths in a process of its own, which imports SciPy while the one that asks imports all else."""

from __future__ import annotations

import dataclasses
import pickle
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from neurosim_core.runtime.child import begin_child, end_child, start_child

if TYPE_CHECKING:
    from neurosim_core.scene.freespace import FreeSpace, FreeSpaceConfig
    from neurosim_core.scene.scene import Scene
    from neurosim_core.trajectory import Path, PathConfig


class NotPlannedError(Exception):
    """The process has not planned the paths that are asked for; who plans them here is told what is wrong."""


def may_need_planning(settings: Mapping[str, Any]) -> bool:
    """Return whether settings, which were not checked, may ask for paths around obstacles."""
    path = settings.get("path")
    kind = path.get("kind") if isinstance(path, Mapping) else None
    return kind in (None, "tour", "waypoints") or bool(settings.get("vehicles"))


class PlanningProcess:
    """A process that plans paths, once. A context manager, which ends it."""

    def __init__(self) -> None:
        self._process = start_child(__name__, stdin=subprocess.PIPE, env={"CUDA_VISIBLE_DEVICES": ""})

    def plan(
        self,
        scene: Scene,
        config: FreeSpaceConfig,
        flights: Sequence[tuple[PathConfig, float]],
        *,
        mapped: Callable[[], FreeSpace],
    ) -> tuple[FreeSpace, list[Path]]:
        """Return what `choose_seed` does, and the path that `make_path` plans there for each flight.

        Args:
            scene: The scene to fly in; materials are not needed.
            config: See `choose_seed`.
            flights: Configuration of each path, and how long it is flown at least [s].
            mapped: Waits for the distance map; meanwhile the process builds the tree of the triangles.

        Raises:
            NotPlannedError: The process has ended, because there is no such path or for any other reason.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            pickle.dump((scene.vertices, scene.faces.reshape(-1)), self._process.stdin, protocol=5)
            self._process.stdin.flush()
            unseeded = mapped()
            names = {field.name for field in dataclasses.fields(unseeded)} - {"arrays", "mesh", "device"}
            grid = {name: getattr(unseeded, name) for name in names}
            pickle.dump((grid, config, flights, scene.inside_m), self._process.stdin, protocol=5)
            self._process.stdin.flush()
            seed_m, notes, paths = pickle.load(self._process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError):
            raise NotPlannedError from None
        return dataclasses.replace(unseeded, seed_m=seed_m, notes=notes), paths

    def close(self) -> None:
        """End the process; doing it again does nothing."""
        end_child(self._process)

    def __enter__(self) -> PlanningProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def main() -> None:
    """Be the process."""
    with begin_child() as answers:
        import warp as wp

        from neurosim_core.scene.freespace import DistanceField, FreeSpace, choose_seed
        from neurosim_core.trajectory import load_scipy, make_path
        from neurosim_core.warp_start import start_warp

        start_warp()
        load_scipy()
        points, indices = pickle.load(sys.stdin.buffer)
        mesh = wp.Mesh(
            points=wp.array(points, dtype=wp.vec3, device="cpu"),
            indices=wp.array(indices, dtype=wp.int32, device="cpu"),
            bvh_constructor="median",  # built faster than others, and few points are asked for
        )
        grid, config, flights, inside_m = pickle.load(sys.stdin.buffer)
        arrays = DistanceField()  # kernels that plan paths read no distances of the grid
        arrays.mesh = mesh.id
        unseeded = FreeSpace(**grid, arrays=arrays, mesh=mesh, device="cpu")
        space = choose_seed(unseeded, config, inside_m=inside_m)
        paths = [make_path(path, space, duration_s=duration_s) for path, duration_s in flights]
        pickle.dump((space.seed_m, space.notes, paths), answers)
