# mypy: disable-error-code="attr-defined,call-overload"
"""The scenes of worlds: one scene for all worlds, or several that kernels find by index."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.render.config import CandidateListConfig
from neurosim_core.render.kernel_data import RenderTerms, SceneData
from neurosim_core.render.scene_arrays import SceneArrays
from neurosim_core.scene.freespace import DistanceField
from neurosim_core.sim.model import Model, make_model, refit
from neurosim_core.warp_start import find_device

_logger = logging.getLogger(__name__)

SceneSource = str | Path | Mapping[str, Any]
"""A settings file, whose scene is used; a mesh file; or settings of a scene."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneTable:
    """The scenes of all worlds, on the device."""

    models: tuple[Model, ...]
    """The model of each scene: free space, path and light."""
    scene_of_world: tuple[int, ...]
    """Index of the scene of each world."""
    fields: wp.array[Any]
    """Distance to each scene, array of `DistanceField`, shape [scene]."""
    scene: wp.array[int]
    """`scene_of_world` on the device, shape [world]."""
    data: wp.array[Any] | None
    """`completed` on the device, array of `SceneData`; None: there is one row, or no camera."""
    row: wp.array[int]
    """Row of `data` that the renderer reads in each world, shape [world]."""
    completed: tuple[SceneData, ...]
    """Arrays of each scene, or of each world, with all that a kernel for all scenes reads; empty: `data` is
    None."""
    terms: RenderTerms | None
    """Terms of the renderer's kernel that some scene needs; None: there is no camera."""

    @property
    def model(self) -> Model:
        """The model of the first scene; what does not depend on the scene is the same in all."""
        return self.models[0]

    def light(self, name: str) -> Any:
        """Return `dark_floor` or `exposure` of `SceneData` in each world, device array of float32, [world].

        Raises:
            ValueError: Worlds share the light of their scene: they were not made with `per_world_light`.
        """
        if self.data is None or len(self.data) != len(self.scene_of_world):
            raise ValueError("all worlds share the light of their scene: make them with per_world_light=True")
        offset = getattr(SceneData.ctype, name).offset
        size = wp.types.type_size_in_bytes(self.data.dtype)
        floats: Any = wp.array(
            ptr=self.data.ptr + offset,
            dtype=float,
            shape=len(self.data),
            strides=(size,),
            device=self.data.device,
        )
        return floats


def make_scene_table(
    config: SimulationConfig,
    *,
    count: int,
    scenes: Sequence[SceneSource] | None = None,
    models: Sequence[Model] | None = None,
    scene_of_world: ArrayLike | None = None,
    lenses_differ: bool = False,
    per_world_light: bool = False,
) -> SceneTable:
    """Load the scenes of `count` worlds, by default the configured one, and upload them.

    `models` are loaded scenes, each with its path and light. `scene_of_world` is the index of
    the scene of each world, shape [N]; by default 0, 1, ..., 0, 1, ... With `per_world_light`, the light of
    each world can be changed.

    Raises:
        ValueError: A scene cannot be loaded, an index is out of range, the renderer is not `warp`, or bodies
            move and there are several scenes; or models are on another device, have other bodies or were lit
            or packed by other settings of the renderer than `config` says.
    """
    if config.renderer.kind != "warp":
        raise ValueError(f"worlds need the renderer 'warp', got {config.renderer.kind!r}")
    if scenes is not None and models is not None:
        raise ValueError("give scenes or models, not both")
    if any(given is not None and len(given) == 0 for given in (scenes, models)):
        raise ValueError("scenes or models must have at least one scene, got none")
    if len(scenes or models or ()) > 1 and config.bodies:
        raise ValueError(
            f"bodies move in one scene only, got {len(scenes or models or ())} scenes and "
            f"{', '.join(config.bodies)}"
        )
    if models is not None:
        _check_models(models, config)
    asked = isinstance(config.render.candidate_lists, CandidateListConfig)
    if asked and (lenses_differ or per_world_light or len(scenes or models or ()) > 1):
        _logger.info("render.candidate_lists is not used: worlds differ in scenes, lenses or light")
        alone = config.render.model_copy(update={"candidate_lists": None})  # Embree may do it on a CPU
        config = config.model_copy(update={"render": alone})
    if models is not None:
        made = tuple(refit(model, config) for model in models)
    else:
        configs = [config] if scenes is None else [_in_scene(config, source) for source in scenes]
        made = tuple(make_model(each) for each in configs)
    turns = np.arange(count) % len(made)
    chosen = np.asarray(turns if scene_of_world is None else scene_of_world)
    if chosen.shape != (count,) or not np.issubdtype(chosen.dtype, np.integer):
        raise ValueError(f"scene_of_world must be integers of shape [{count}], got {list(chosen.shape)}")
    if chosen.min() < 0 or chosen.max() >= len(made):
        raise ValueError(
            f"scene_of_world must be in [0, {len(made) - 1}], got {chosen.min()} to {chosen.max()}"
        )
    return _table(made, chosen, per_world_light=per_world_light)


def single_scene(model: Model) -> SceneTable:
    """Return the table of one world in the scene of a model."""
    return _table((model,), np.zeros(1, dtype=np.int64), per_world_light=False)


def _table(models: tuple[Model, ...], chosen: NDArray[Any], *, per_world_light: bool) -> SceneTable:
    """Bring what worlds need of their scenes to the device; `chosen` is the scene of each world."""
    count = len(chosen)
    device = models[0].device
    arrays = [m.scene_on_device for m in models if isinstance(m.scene_on_device, SceneArrays)]
    terms = None
    if arrays:
        terms = RenderTerms(*(max(values) for values in zip(*(a.terms for a in arrays), strict=True)))
        terms = terms._replace(world_scenes=per_world_light or len(arrays) > 1)
    completed: tuple[SceneData, ...] = ()
    scene: Any = wp.array(chosen.astype(np.int32), dtype=int, device=device)
    row = scene
    if arrays and (per_world_light or len(arrays) > 1):
        completed = tuple(_completed(a) for a in arrays)
    if per_world_light:
        completed = tuple(completed[index] for index in chosen)
        row = wp.array(np.arange(count, dtype=np.int32), dtype=int, device=device)
    return SceneTable(
        models=models,
        scene_of_world=tuple(int(scene) for scene in chosen),
        fields=wp.array([m.free_space.arrays for m in models], dtype=DistanceField, device=device),
        scene=scene,
        row=row,
        data=wp.array(list(completed), dtype=SceneData, device=device) if completed else None,
        completed=completed,
        terms=terms,
    )


def _check_models(models: Sequence[Model], config: SimulationConfig) -> None:
    """Raise if models do not match the configuration."""
    wanted = find_device(config.device)
    for index, model in enumerate(models):
        if model.device != wanted:
            raise ValueError(
                f"models[{index}] is on {model.device}, but the worlds are on {wanted}: make the model there"
            )
        if model.config.bodies != config.bodies:
            raise ValueError(
                f"models[{index}] has the bodies {sorted(model.config.bodies)}, or moves them otherwise than "
                f"the configuration, which has {sorted(config.bodies)}"
            )
        arrays = model.scene_on_device
        if isinstance(arrays, SceneArrays) and arrays.config != config.render:
            raise ValueError(f"models[{index}] was made with other settings of `render` than these worlds")


def _in_scene(config: SimulationConfig, source: SceneSource) -> SimulationConfig:
    if isinstance(source, Mapping):
        scene = load_config({"scene": dict(source)}).scene
    elif str(source).endswith((".yaml", ".yml")):
        scene = load_config(source).scene
    else:
        scene = load_config({"scene": {"kind": "mesh", "file": str(Path(source).resolve())}}).scene
    return config.model_copy(update={"scene": scene})


def _completed(arrays: SceneArrays) -> SceneData:
    """Return the arrays of a scene with what a kernel for textured scenes reads of one that is not."""
    if arrays.terms.textured:
        return arrays.data
    data = SceneData()  # that of the model stays as it is: others may look at it
    for name in SceneData.vars:
        setattr(data, name, getattr(arrays.data, name))
    data.material_texture = wp.zeros(data.base_color.shape[0], dtype=wp.vec2i, device=arrays.device)
    return data
