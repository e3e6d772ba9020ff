"""Learning to fly: environments of many worlds for PyTorch, tasks, training, and the deployment of policies.

Needs the extra `learn`.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

from neurosim_core.install import install_hint
from neurosim_core.lazy import lazy_names

if TYPE_CHECKING:  # isort: off
    from neurosim_core.learn.dense import DenseNet as DenseNet
    from neurosim_core.learn.dense_train import load_dense as load_dense
    from neurosim_core.learn.heads import depth_loss as depth_loss
    from neurosim_core.learn.env import (
        Env as Env,
        make_env as make_env,
    )
    from neurosim_core.learn.episodes import StartConfig as StartConfig
    from neurosim_core.learn.evaluate import (
        evaluate_policy as evaluate_policy,
        teacher_actor as teacher_actor,
    )
    from neurosim_core.learn.gym import make_numpy_env as make_numpy_env
    from neurosim_core.learn.population import train_population as train_population
    from neurosim_core.learn.ppo import (
        Ppo as Ppo,
        PpoConfig as PpoConfig,
    )
    from neurosim_core.learn.randomisation import Randomisation as Randomisation
    from neurosim_core.learn.rsl_rl import RslRlEnv as RslRlEnv
    from neurosim_core.learn.sb3 import Sb3Env as Sb3Env
    from neurosim_core.learn.skrl import SkrlEnv as SkrlEnv
    from neurosim_core.learn.surfaces import (
        Counts as Counts,
        LeakySurface as LeakySurface,
        TimeSurface as TimeSurface,
        VoxelGrid as VoxelGrid,
    )
    from neurosim_core.learn.task import (
        Task as Task,
        View as View,
    )


def need(*modules: str) -> Any:
    """Import libraries of the extra, and return the first."""
    try:
        found = [importlib.import_module(module) for module in modules]
        return found[0]
    except ImportError as error:
        raise ImportError(f"{error}: learning needs {', '.join(modules)}; {install_hint('learn')}") from None


__getattr__, __dir__, __all__ = lazy_names(__name__, __file__, lambda: need("torch"))
for _name, _library in {"RslRlEnv": "rsl_rl", "Sb3Env": "stable_baselines3", "SkrlEnv": "skrl"}.items():
    if importlib.util.find_spec(_library) is None:  # else `help` and `import *` would need all of them
        __all__.remove(_name)
