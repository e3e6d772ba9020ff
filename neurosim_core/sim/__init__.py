"""The engine: what a run needs (`model`), what changes in it (`state`), and the data flow (`step`)."""

from neurosim_core.sim.integrate import COLLISION, forget_controllers
from neurosim_core.sim.model import Model, make_fleet, make_model, plan_paths
from neurosim_core.sim.render_group import move_bodies
from neurosim_core.sim.rollout import (
    acquire_next_picture_buffers,
    advance,
    begin_step,
    end_step,
    finish,
    integrate_period,
    observe,
    prepare_step,
    render_backlog_left,
    render_batch,
    run,
    run_model,
    select_cameras,
    settle,
    skip_batch,
    start,
    step,
    warm_flight,
    warm_up,
)
from neurosim_core.sim.simulation import Simulation
from neurosim_core.sim.state import Batch, StartState, State, make_state

__all__ = [
    "COLLISION",
    "Batch",
    "Model",
    "Simulation",
    "StartState",
    "State",
    "acquire_next_picture_buffers",
    "advance",
    "begin_step",
    "end_step",
    "finish",
    "forget_controllers",
    "integrate_period",
    "make_fleet",
    "make_model",
    "make_state",
    "move_bodies",
    "observe",
    "plan_paths",
    "prepare_step",
    "render_backlog_left",
    "render_batch",
    "run",
    "run_model",
    "select_cameras",
    "settle",
    "skip_batch",
    "start",
    "step",
    "warm_flight",
    "warm_up",
]
