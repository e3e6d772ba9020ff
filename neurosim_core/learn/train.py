"""Training of a task: a teacher by PPO on states, then a student on events who imitates it.

A run is a folder: `run.json` (what was asked for), `checkpoint.pt`, TensorBoard's files, `policy.onnx` and
`evaluation.json`. Training goes in blocks of some iterations. A block begins in all worlds anew, with a seed
that hangs on the run's seed, the block's number and the process (`ranks`), and ends with a checkpoint: a run
that is resumed does what it would have done without the interruption, to the bit on a CPU.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import resource
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch

from neurosim_core.learn import need, ranks
from neurosim_core.learn.dagger import Dagger, DaggerConfig
from neurosim_core.learn.env import Env, find_task, make_env
from neurosim_core.learn.evaluate import (
    Evaluation,
    evaluate_policy,
    record_episode,
    recording_sensors,
    student_actor,
    teacher_actor,
)
from neurosim_core.learn.policies import ActorCritic, EventPolicy
from neurosim_core.learn.ppo import Ppo, PpoConfig
from neurosim_core.learn.randomisation import Randomisation
from neurosim_core.learn.recurrent import RecurrentPpo, RecurrentPpoConfig
from neurosim_core.learn.surfaces import SURFACES, LeakySurface, TimeSurface, surface_like
from neurosim_core.learn.task import Task
from neurosim_core.sim.model import Model
from neurosim_core.warp_start import find_device

Say = Callable[[str], None]
Trainer = Ppo | Dagger | RecurrentPpo

_BLOCK = 60
_TELL_S = 15.0
"""So often is said how far a block has come."""
_RANDOMISE = ("training", "tests", "none")
_SEEDS_APART = 1 << 20


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Task and algorithm of a training."""

    task: str
    device: str = "auto"
    seed: int = 0
    teacher: PpoConfig = dataclasses.field(default_factory=PpoConfig)
    student: DaggerConfig | RecurrentPpoConfig = dataclasses.field(default_factory=DaggerConfig)
    """Imitates the teacher, or learns by PPO from scratch, without a teacher."""
    pixels: int | None = None
    """Width and height of the event camera [px]; None: those of the task."""
    rate_hz: float | None = None
    """Steps per second [Hz]; time constants of surfaces scale with the step. None: that of the task."""
    surface: str | None = None
    """Kind of the event surfaces (`surfaces.SURFACES`); None: that of the task."""
    randomise: str = "training"
    """Randomisation of episodes. `training`: as `Task.training` says; `tests`: so little that few steps can
    learn it; `none`: nothing is drawn."""
    block: int = _BLOCK
    """Iterations from one checkpoint to the next."""
    evaluation_worlds: int = 96
    wandb: bool = False
    """Whether Weights & Biases gets what TensorBoard gets (package `wandb`)."""

    def __post_init__(self) -> None:
        if self.randomise not in _RANDOMISE:
            raise ValueError(f"unknown randomise {self.randomise!r}, known: {', '.join(_RANDOMISE)}")
        if self.surface not in (None, *SURFACES):
            raise ValueError(f"unknown surface {self.surface!r}, known: {', '.join(SURFACES)}")

    def make_task(self) -> Task:
        """Return the task, with the steps of this training."""
        task = find_task(self.task)
        if self.surface is not None:
            task.surface = surface_like(self.surface, task.surface)
        if self.rate_hz is not None:
            stretch, task.rate_hz = task.rate_hz / self.rate_hz, self.rate_hz
            if isinstance(task.surface, LeakySurface | TimeSurface):
                slower = tuple(stretch * tau_s for tau_s in task.surface.tau_s)
                task.surface = dataclasses.replace(task.surface, tau_s=slower)
        return task

    def make_env(self, task: Task | None = None, *, device: str | None = None, **options: Any) -> Env:
        """Return the task as an environment, with the pixels and on the device of this training.

        Args:
            task: A variant of what `make_task` returns; None: that.
            device: Another device.
            **options: Of `env.make_env`.
        """
        return make_env(task or self.make_task(), device=device or self.device, pixels=self.pixels, **options)


class Training:
    """A run of training.

    `config`: what to do; None: as `run.json` in the folder says. `models`: what `make_model` made of the
    scenes to train in; None: those of the task are loaded.

    Attributes:
        config: What is done.
        env: Where the student flies.
        trained_s: Time that each stage took in this process [s], `teacher` and `student`; checkpoints count.
        processor_s: Processor time that both took [s].
    """

    def __init__(
        self,
        folder: Path,
        config: TrainConfig | None = None,
        *,
        say: Say = print,
        models: Sequence[Model] | None = None,
    ) -> None:
        self.folder, self._say = folder, say
        self.config = config = read_config(folder) if config is None else config
        self.trained_s: dict[str, float] = {}
        self.processor_s = 0.0
        torch.manual_seed(config.seed)  # of the first weights
        task = config.make_task()
        randomise: bool | Randomisation = config.randomise != "none"
        if config.randomise == "training" and task.training is not None:
            randomise = task.training
        drawn: dict[str, Any] = {"randomise": randomise, "seed": config.seed}
        self.env = config.make_env(task, worlds=config.student.worlds, models=models, **drawn)
        device = self.env.device
        self._generator = torch.Generator(device=device)
        states = {*self.env.obs_groups["actor"], *self.env.obs_groups["critic"]}
        self._trainers: dict[str, Trainer] = {}
        if isinstance(config.student, DaggerConfig):
            models = self.env.sim.models
            teacher_env = config.make_env(
                worlds=config.teacher.worlds, observe=states, models=models, **drawn
            )
            teacher = Ppo(teacher_env, config.teacher, self._generator)
            student = Dagger(self.env, teacher.policy, config.student, self._generator)
            self._trainers |= {"teacher": teacher, "student": student}
        else:
            self._trainers["student"] = RecurrentPpo(self.env, config.student, self._generator)
        for trainer in self._trainers.values():  # kernels are compiled here, and not while training
            trainer.env.step(torch.zeros((trainer.env.num_envs, trainer.env.action_count), device=device))
        self._done = dict.fromkeys(self._trainers, 0)
        folder.mkdir(parents=True, exist_ok=True)
        if ranks.rank() == 0:
            (folder / "run.json").write_text(json.dumps(dataclasses.asdict(config), indent=1) + "\n")

    @property
    def teacher(self) -> ActorCritic | None:
        """The policy on states, if there is one."""
        trainer = self._trainers.get("teacher")
        return trainer.policy if isinstance(trainer, Ppo) else None

    @property
    def student(self) -> EventPolicy:
        """The policy on events."""
        policy = self._trainers["student"].policy
        assert isinstance(policy, EventPolicy)
        return policy

    def resume(self) -> None:
        """Go on from the checkpoint of the folder."""
        file = self.folder / "checkpoint.pt"
        state = torch.load(file, map_location=self.env.device, weights_only=True)
        _check_layers(file, state, self.student)
        for stage, trainer in self._trainers.items():
            trainer.descent.load_state_dict(state[stage])
        self._done = state["done"]

    def run(self, *, until: tuple[int, int] | None = None) -> None:
        """Train what is missing.

        `until`: iterations of teacher and student after which to stop, multiples of `block`; None: all.
        """
        from torch.utils.tensorboard.writer import SummaryWriter

        config = self.config
        wholes = {"teacher": config.teacher.iterations, "student": config.student.iterations}
        limits = wholes if until is None else dict(zip(wholes, until, strict=True))
        if config.wandb and ranks.rank() == 0:
            settings = {"dir": str(self.folder), "config": dataclasses.asdict(config)}
            importlib.import_module("wandb").init(
                project="neurosim", name=self.folder.name, sync_tensorboard=True, **settings
            )
        with SummaryWriter(str(self.folder)) if ranks.rank() == 0 else nullcontext() as writer:
            for stage, trainer in self._trainers.items():
                while self._done[stage] < min(limits[stage], wholes[stage]):
                    self._train_block(stage, trainer, wholes[stage], writer)

    def _train_block(self, stage: str, trainer: Trainer, whole: int, writer: Any) -> None:
        begin_s, processor_s, done = time.monotonic(), _processor_s(), self._done[stage]
        offset = 1 + done // self.config.block + (stage == "student") * (1 << 10)
        apart = ranks.rank() * trainer.env.num_envs
        seed = (self.config.seed * (1 << 11) + offset) * _SEEDS_APART + apart
        self._generator.manual_seed(seed)
        trainer.begin(seed)
        end = min(done + self.config.block, whole)
        sums: dict[str, list[float]] = {}
        told_s = begin_s
        for iteration in range(done, end):
            log = trainer.iterate(iteration / whole)
            for name, value in log.items():
                if writer is not None:
                    writer.add_scalar(f"{stage}/{name}", value, iteration)
                sums.setdefault(name, []).append(value)
            if time.monotonic() - told_s > _TELL_S and iteration + 1 < end:
                told_s = time.monotonic()
                self._say(f"{stage} {iteration + 1}/{whole}: {_means(sums)}")
        self._done[stage] = end
        if ranks.rank() == 0:
            self._save()
        self.trained_s[stage] = self.trained_s.get(stage, 0.0) + time.monotonic() - begin_s
        self.processor_s += _processor_s() - processor_s
        times = f"{self.trained_s[stage]:.0f} s, {self.processor_s:.0f} s of processor time in all"
        self._say(f"{stage} {end}/{whole} ({times}): {_means(sums)}")

    def _save(self) -> None:
        file = self.folder / "checkpoint.pt"
        partial = file.with_suffix(".part")
        torch.save(
            {
                **{stage: trainer.descent.state_dict() for stage, trainer in self._trainers.items()},
                "shape": self.student.shape,
                "weights": self.student.state_dict(),
                "done": self._done,
            },
            partial,
        )
        os.replace(partial, file)

    def evaluate_teacher(self) -> Evaluation:
        """Return how the teacher does in the scenes of the training, without noise on its actions."""
        assert self.teacher is not None
        env = self._trainers["teacher"].env
        return evaluate_policy(env, teacher_actor(self.teacher, env))


def prepare_torch() -> None:
    """Choose how PyTorch computes in this process."""
    torch.set_num_threads(1)  # two beside a simulator that uses all cores take five times as long
    torch.backends.cudnn.benchmark = True
    torch.set_float32_matmul_precision("high")


def is_for_cuda(device: str) -> bool:
    """Tell whether a training is for a GPU: one that is named may be a cluster's, and not of this machine."""
    return device.startswith("cuda") or find_device(device) != "cpu"


def default_config(
    task: str, *, device: str = "auto", seed: int = 0, algorithm: str = "dagger"
) -> TrainConfig:
    """Return how a task is trained: with more worlds on a GPU, and for longer.

    `algorithm`: `dagger`: by imitation of a teacher; `ppo`: on events from scratch.
    """
    found = find_task(task)
    teacher, student = dict(found.teacher), dict(found.student)
    config = TrainConfig(task=task, device=device, seed=seed)
    cuda = is_for_cuda(device)
    if algorithm == "ppo":
        ppo = RecurrentPpoConfig()
        if cuda:
            ppo = RecurrentPpoConfig(worlds=1024, iterations=300)
        return dataclasses.replace(config, student=ppo, evaluation_worlds=512)
    if not cuda:
        few: dict[str, Any] = {
            "worlds": 64,
            "iterations": 180,
            "updates": 8,
            "replay": 20,
            "learning_rate": 2e-3,
        }
        few |= {"hidden": 96, "widths": (16, 24, 32)}
        student["iterations"] = max(few["iterations"], student.get("iterations", 0))
        small = PpoConfig(**teacher), DaggerConfig(**(few | student))
        steps: dict[str, Any] = {
            "pixels": 24,
            "rate_hz": found.rate_on_cpu_hz,
            "randomise": "tests",
            "block": 100,
        }
        return dataclasses.replace(config, teacher=small[0], student=small[1], **steps)
    many = {"worlds": 1024, "iterations": 82, "replay": 4, "updates": 26, "batch": 160}
    return dataclasses.replace(
        config,
        teacher=PpoConfig(**({"worlds": 1024, "iterations": 50} | teacher)),
        student=DaggerConfig(**(many | student)),
        block=41,
        evaluation_worlds=512,
    )


def read_config(folder: Path) -> TrainConfig:
    """Return what a run was asked for."""
    file = folder / "run.json"
    if not file.is_file():
        raise ValueError(
            f"{folder} is no run of training: it has no run.json; `neurosim learn hover` makes one"
        )
    values = json.loads(file.read_text())
    values["teacher"] = PpoConfig(**values["teacher"])
    imitates = "replay" in values["student"]
    values["student"] = (DaggerConfig if imitates else RecurrentPpoConfig)(**values["student"])
    return TrainConfig(**values)


def load_student(folder: Path, device: torch.device) -> EventPolicy:
    """Return the student of a run."""
    file = folder / "checkpoint.pt"
    if not file.is_file():
        raise ValueError(f"{folder} has no checkpoint.pt: train first")
    state = torch.load(file, map_location=device, weights_only=True)
    policy = EventPolicy(**state["shape"]).to(device)
    _check_layers(file, state, policy)
    policy.load_state_dict(state["weights"])
    return policy


def _check_layers(file: Path, state: Mapping[str, Any], policy: EventPolicy) -> None:
    shapes = [
        {name: value.shape for name, value in weights.items()}
        for weights in (state["weights"], policy.state_dict())
    ]
    if shapes[0] != shapes[1]:
        raise ValueError(
            f"{file} is of another version, whose networks have other layers: train again, or use that one"
        )


def evaluate_run(
    folder: Path,
    *,
    scenes: str = "unseen",
    device: str | None = None,
    worlds: int | None = None,
    speed_m_s: float | None = None,
    animation: Path | None = None,
) -> Iterator[tuple[str, Evaluation]]:
    """Yield how the student of a run does: first with events (`events`), then without (`blind`).

    Args:
        folder: The run.
        scenes: Those that it was trained in (`seen`), others (`unseen`), or the file of a scene.
        device: None: as in the training.
        worlds: Episodes; None: as configured.
        speed_m_s: At which all episodes begin [m/s]; None: as the task says.
        animation: Where to write an animation of the first episode (.webp, .gif); None: none is made.
    """
    config = read_config(folder)

    def make(**options: Any) -> Env:
        task = config.make_task()
        if speed_m_s is not None:
            task.start = dataclasses.replace(task.start, speed_m_s=(speed_m_s, speed_m_s))
        return config.make_env(task, device=device, **options)

    where: Any = scenes if scenes in ("seen", "unseen") else [scenes]
    env = make(worlds=worlds or config.evaluation_worlds, scenes=where)
    policy = load_student(folder, env.device)
    if animation is not None:
        recorded = make(worlds=1, models=env.sim.models[:1], sensors=recording_sensors(env.task))
        record_episode(recorded, student_actor(policy, recorded), animation)
    for blind in (False, True):
        actor = student_actor(policy, env, blind=blind)
        yield "blind" if blind else "events", evaluate_policy(env, actor)


def train(
    folder: Path, config: TrainConfig, *, resume: bool = False, say: Say = print
) -> dict[str, Evaluation]:
    """Train, export and evaluate.

    `resume`: go on with the run in the folder, as it was configured; only `config.wandb` counts. Returns
    evaluations in scenes that were not trained in: `events`, and `blind`; of several processes (`ranks`) by
    the first only.
    """
    from neurosim_core.learn.export import export_onnx

    need("tensorboard", "onnx")
    begin_s = time.monotonic()
    prepare_torch()
    if resume:
        config = dataclasses.replace(read_config(folder), wandb=config.wandb)
    config = dataclasses.replace(config, device=ranks.join(config.device))
    if config.wandb and importlib.util.find_spec("wandb") is None:
        raise ImportError("--wandb needs the package wandb: pip install wandb")
    if ranks.rank() > 0:
        say = _say_nothing
    say("set-up: scenes and kernels")
    training = Training(folder, config, say=say)
    if resume:
        training.resume()
    say(f"set up in {time.monotonic() - begin_s:.0f} s")
    training.run()
    if ranks.rank() > 0:
        return {}
    if training.teacher is not None:
        say(f"teacher: {training.evaluate_teacher()}")
    export_onnx(training.student, make_card(training.env, training.config.task), folder / "policy.onnx")
    found = {}
    for name, evaluation in evaluate_run(folder, animation=folder / "evaluation.webp"):
        say(f"student, unseen scenes, {name}: {evaluation}")
        found[name] = evaluation
    values = {name: dataclasses.asdict(evaluation) for name, evaluation in found.items()}
    values["trained_s"] = training.trained_s
    (folder / "evaluation.json").write_text(json.dumps(values, indent=1) + "\n")
    return found


def make_card(env: Env, name: str) -> dict[str, Any]:
    """Return what whoever flies a policy needs to know; `name` is that of the task."""
    task = env.task
    return {
        "task": name,
        "rate_hz": task.rate_hz,
        "camera": dict(task.camera),
        "mount": dict(task.mount),
        "threshold": task.threshold,
        "renders_per_step": task.renders_per_step,
        "rays_per_pixel": task.rays_per_pixel,
        "surface": env.surface_card,
        "hover_thrust_n": env.view.vehicle.hover_thrust_n,
        "mode": task.mode,
        "thrust_span": task.thrust_span,
        "rate_max_rad_s": list(task.rate_max_rad_s),
        "vehicle": dict(task.vehicle),
    }


def _say_nothing(line: str) -> None:
    """Leave it to the first process."""


def _means(sums: Mapping[str, Sequence[float]]) -> str:
    return ", ".join(f"{name} {sum(values) / len(values):.3g}" for name, values in sums.items())


def _processor_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime
