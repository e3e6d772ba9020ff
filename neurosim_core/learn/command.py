"""The commands `neurosim learn`, `neurosim deploy` and `neurosim predict`."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurosim_core.learn import need

if TYPE_CHECKING:
    _Commands = argparse._SubParsersAction[argparse.ArgumentParser]


def add_parsers(commands: _Commands) -> None:
    """Add the commands."""
    _add_learn(commands)
    _add_deploy(commands)
    _add_predict(commands)


def _add_learn(commands: _Commands) -> None:
    learn = commands.add_parser("learn", help="train a policy that flies from events, or evaluate one")
    learn.add_argument(
        "what",
        metavar="TASK",
        help="hover, throw-recover, dodge, avoid, gates; depth, flow, pretrain; `eval` or `rate`",
    )
    uses: dict[str, Collection[str]] = {}
    """By name of an option: what makes use of it, of `_COMMANDS`."""

    def add(name: str, of: str, said: str, group: Any = learn, **settings: Any) -> None:
        uses[group.add_argument(name, help=said, **settings).dest] = of.split()

    number: dict[str, Any] = {"type": int, "metavar": "N"}
    folder: dict[str, Any] = {"type": Path, "metavar": "DIR"}
    run = "eval: folder of a run, or depth.pt, ...; rate: a task"
    add("run", "dagger ppo eval transfer network rate", run, nargs="?", type=Path, metavar="RUN")
    add("--out", "dagger ppo dense", "folder of the run (default: runs/TASK)", **folder)
    device = "auto, cpu, cuda:0, ... (default: auto; eval: as trained)"
    add("--device", "dagger ppo dense eval transfer rate", device)
    worlds = "number of worlds to train the student, to evaluate, or to learn depth or flow in"
    add("--worlds", "dagger ppo dense eval transfer rate", worlds, **number)
    add("--pixels", "dagger ppo rate", "width and height of the camera (default: by task)", **number)
    surface = "event representation for the student (default: by task)"
    add("--surface", "dagger ppo", surface, choices=("leaky", "time", "counts", "voxels"))
    add("--seed", "dagger ppo dense", "seed of all random numbers (default: 0)", type=int, default=0)
    add("--seeds", "dagger ppo", "train with N seeds from --seed on; with --ray", default=1, **number)
    add("--workers", "dagger ppo", "processes that train one policy; with --ray", default=1, **number)
    ray = (
        "address of a Ray cluster (local, host:port; auto, the default: one on this host): one training "
        "per seed; depth, flow: the flights of --live"
    )
    add("--ray", "dagger ppo dense", ray, nargs="?", const="auto", metavar="ADDRESS")
    add("--wandb", "dagger ppo", "send what TensorBoard gets to Weights & Biases", action="store_true")
    algorithm = (
        "dagger: imitate a teacher (default); ppo: train a recurrent policy without a teacher "
        "(also of `rate`)"
    )
    add("--algorithm", "dagger ppo rate", algorithm, choices=("dagger", "ppo"), default="dagger")
    add("--teacher-iterations", "dagger", "PPO iterations of the teacher", **number)
    add("--student-iterations", "dagger ppo", "iterations of the student", **number)
    add("--resume", "dagger ppo", "resume from the checkpoint in --out", action="store_true")
    scenes = "eval: scenes: seen, unseen (default), or the file of a scene"
    add("--scenes", "eval transfer", scenes, default="unseen")
    add("--speed", "eval", "eval: initial speed of all episodes [m/s]", type=float, metavar="M_S")
    add("--blind", "eval", "eval: also without events", action="store_true")
    transfer = "eval: with noise, and with other lenses, thresholds and dynamics than in training"
    add("--transfer", "transfer", transfer, action="store_true")
    randomise = (
        "randomisation of training episodes: that of the task for training (default on a GPU), "
        "that of its tests, or none"
    )
    add("--randomise", "dagger ppo", randomise, choices=("training", "tests", "none"))
    dense = learn.add_argument_group("depth, flow, pretrain")
    add("--data", "dense", "a data set to learn from", dense, **folder)
    add("--live", "dense", "or number of processes that fly during training", dense, default=0, **number)
    fly_device = "device of the worlds: cuda:1, ... (default: --device)"
    add("--fly-device", "dense", fly_device, dense, metavar="DEVICE")
    add("--test", "dense network", "a data set to test on", dense, **folder)
    add("--minutes", "dense", "training time [min] (default: 3)", dense, type=float, default=3.0, metavar="M")
    add("--size", "dense", "image size of flights (default: 48)", dense, type=int, default=48, metavar="PX")
    backbone = "network whose weights to begin with, such as pretrain.pt"
    add("--backbone", "dense", backbone, dense, metavar="FILE")
    learn.set_defaults(command=partial(_learn, learn, uses), many_blas_threads=True)


def _add_deploy(commands: _Commands) -> None:
    deploy = commands.add_parser(
        "deploy", help="fly a simulator or a vehicle with a trained policy, over Cortex"
    )
    deploy.add_argument("policy", help="policy.onnx of a run, or the name of an included policy: hover")
    deploy.add_argument("--vehicle", default="drone", metavar="NAME", help="vehicle (default: drone)")
    deploy.add_argument("--events", default="events", metavar="NAME", help="event camera (default: events)")
    deploy.add_argument(
        "--print-config", action="store_true", help="print settings for `neurosim serve`, and exit"
    )
    deploy.add_argument(
        "--ros",
        nargs="?",
        const="auto",
        choices=("auto", "rclpy", "dds"),
        help="the vehicle is in ROS 2: receive its events and odometry, send it AttitudeTarget",
    )
    deploy.add_argument(
        "--max-thrust",
        type=float,
        metavar="N",
        help="--ros: force of a thrust of 1 [N] (default: the largest of the vehicle in training)",
    )
    deploy.add_argument("--duration", type=float, metavar="S", help="simulated time after which to stop [s]")
    deploy.set_defaults(command=_deploy, many_blas_threads=True)


def _add_predict(commands: _Commands) -> None:
    predict = commands.add_parser(
        "predict", help="estimate depth or flow from the events of a running simulator, over Cortex"
    )
    predict.add_argument("network", type=Path, help="depth.pt or flow.pt of `neurosim learn`")
    predict.add_argument("--vehicle", default="drone", metavar="NAME", help="vehicle (default: drone)")
    predict.add_argument("--events", default="events", metavar="NAME", help="event camera (default: events)")
    predict.add_argument("--device", default="cpu", help="device: cpu, cuda:0, ... (default: cpu)")
    predict.add_argument("--duration", type=float, metavar="S", help="simulated time after which to stop [s]")
    predict.set_defaults(command=_predict, many_blas_threads=True)


def _predict(arguments: argparse.Namespace) -> int:
    need("torch")
    from neurosim_core.learn.predict import predict

    names = {"vehicle": arguments.vehicle, "events": arguments.events}
    predict(arguments.network, **names, device=arguments.device, duration_s=arguments.duration)
    return 0


def _learn(
    parser: argparse.ArgumentParser, uses: Mapping[str, Collection[str]], arguments: argparse.Namespace
) -> int:
    need("torch")
    what = _command_of(arguments)
    unused = [
        name
        for name, users in sorted(uses.items())
        if what not in users and getattr(arguments, name) != parser.get_default(name)
    ]
    if unused:  # options that would have no effect
        names = ("RUN" if name == "run" else f"--{name.replace('_', '-')}" for name in unused)
        raise ValueError(f"neurosim learn {arguments.what} makes no use of {', '.join(names)} here")
    return _COMMANDS[what](arguments)


def _command_of(arguments: argparse.Namespace) -> str:
    """Return which of `_COMMANDS` is asked for."""
    if arguments.what == "eval":
        if arguments.run is not None and arguments.run.suffix == ".pt":
            return "network"
        return "transfer" if arguments.transfer else "eval"
    if arguments.what in ("depth", "flow", "pretrain"):
        return "dense"
    return "rate" if arguments.what == "rate" else str(arguments.algorithm)


def _train(arguments: argparse.Namespace) -> int:
    if arguments.run is not None:
        raise ValueError(f"{arguments.run}: a folder is for `neurosim learn eval`; say --out")
    from neurosim_core.learn.train import default_config, read_config, train

    config = default_config(
        arguments.what,
        device=arguments.device or "auto",
        seed=arguments.seed,
        algorithm=arguments.algorithm,
    )
    config = _changed(
        config,
        pixels=arguments.pixels,
        surface=arguments.surface,
        randomise=arguments.randomise,
        wandb=arguments.wandb,
        student=_changed(config.student, worlds=arguments.worlds, iterations=arguments.student_iterations),
        teacher=_changed(config.teacher, iterations=arguments.teacher_iterations),
    )
    changes = ("worlds", "pixels", "surface", "teacher_iterations", "student_iterations", "randomise")
    changed = [name.replace("_", "-") for name in changes if getattr(arguments, name) is not None]
    changed += ["algorithm"] * (arguments.algorithm == "ppo")
    if arguments.resume and changed:
        raise ValueError(f"--resume goes on as the run was configured: leave out --{', --'.join(changed)}")
    folder = arguments.out or Path("runs") / arguments.what
    if arguments.resume:
        kept = read_config(folder)
        asked = {"task": arguments.what, "seed": arguments.seed or kept.seed, "device": config.device}
        if arguments.device is None:
            del asked["device"]
        for name, value in asked.items():
            if value != (was := getattr(kept, name)):
                raise ValueError(f"--resume: the {name} of the run in {folder} is {was}, not {value}")
    if (folder / "checkpoint.pt").exists() and not arguments.resume:
        raise ValueError(f"{folder} holds a run: give --resume, or another --out")
    if arguments.ray is not None:
        if arguments.resume:
            raise ValueError("--resume continues one run, and does not go with --ray")
        from neurosim_core.learn.population import train_population

        seeds = range(arguments.seed, arguments.seed + arguments.seeds)
        population = {f"seed-{seed}": dataclasses.replace(config, seed=seed) for seed in seeds}
        train_population(folder, population, address=arguments.ray, workers=arguments.workers)
        return 0
    if arguments.seeds != 1 or arguments.workers != 1:
        raise ValueError("--seeds and --workers need --ray: local, auto or host:port")
    if train(folder, config, resume=arguments.resume):
        print(f"wrote {folder}/policy.onnx, evaluation.json and .webp; tensorboard --logdir {folder}")
    return 0


def _changed(settings: Any, **given: Any) -> Any:
    """Return settings with what is given; None: as it is."""
    return dataclasses.replace(settings, **{name: v for name, v in given.items() if v is not None})


def _measure_rate(arguments: argparse.Namespace) -> int:
    """Print steps a second of a task, with one and two renders in each, and what endings (and PPO) cost."""
    from neurosim_core.learn.env import find_task, make_env
    from neurosim_core.learn.rate import measure_steps, measure_updates
    from neurosim_core.learn.train import prepare_torch

    prepare_torch()
    where: dict[str, Any] = {}
    for renders in (1, 2):
        task = find_task(str(arguments.run or "hover"))
        task.renders_per_step = renders
        where = where or {"scenes": task.scenes(unseen=False)[:4]}
        env = make_env(
            task,
            worlds=arguments.worlds or 64,
            device=arguments.device or "auto",
            pixels=arguments.pixels,
            **where,
        )
        where = {"models": env.sim.models}
        rate, least, most = measure_steps(env)
        ended, _, _ = measure_steps(env, ending=max(env.num_envs // 100, 1))
        print(
            f"steps_per_s {rate:.0f} 1/s ({least:.0f} to {most:.0f}; {renders} renders a step, {env.device})"
        )
        print(f"step_with_endings {rate / ended:.3f} (1 % of the worlds, or one, in each step)", flush=True)
        if arguments.algorithm == "ppo":
            rate, least, most = measure_updates(env)
            print(f"steps_with_updates_per_s {rate:.0f} 1/s ({least:.0f} to {most:.0f})", flush=True)
    return 0


def _learn_dense(arguments: argparse.Namespace) -> int:
    import logging

    import torch

    from neurosim_core.learn.dense_train import DenseConfig, train_dense

    logging.getLogger(train_dense.__module__).setLevel(logging.INFO)  # it takes minutes: how far it has come
    device, task = arguments.device or "auto", arguments.what
    if device == "auto":
        device = "cuda:0" if torch.cuda.is_available() else "cpu"
    config = DenseConfig(
        task=task, device=device, seed=arguments.seed, minutes=arguments.minutes, size_px=arguments.size,
        backbone=arguments.backbone, fly_device=arguments.fly_device,
        batch=8 if device == "cpu" else 16,  # what docs/data.md was measured with
    )  # fmt: skip
    folder = arguments.out or Path("runs") / task
    source = {
        "data": arguments.data,
        "live": arguments.live,
        "ray": arguments.ray,
        "worlds": arguments.worlds or 0,
    }
    for name, error in train_dense(folder, config, **source, test=arguments.test).items():
        print(f"{name}: {error}")
    print(f"wrote {folder}/{task}.pt and {task}.json")
    return 0


def _evaluate_network(arguments: argparse.Namespace) -> int:
    from neurosim_core.learn.dense_train import evaluate, held_out_windows, load_dense

    net, dense = load_dense(arguments.run)
    print(evaluate(net, held_out_windows(dense, arguments.test), dense.head))
    return 0


def _evaluate_transfer(arguments: argparse.Namespace) -> int:
    from neurosim_core.learn.transfer import evaluate_transfer

    where = {"device": arguments.device, "worlds": arguments.worlds}
    scenes = arguments.scenes if arguments.scenes in ("seen", "unseen") else [arguments.scenes]
    for name, evaluation in evaluate_transfer(_run_of(arguments), scenes=scenes, **where):
        print(f"{name}: {evaluation}", flush=True)
    return 0


def _run_of(arguments: argparse.Namespace) -> Path:
    if arguments.run is None:
        raise ValueError("say which run: neurosim learn eval runs/hover")
    run: Path = arguments.run
    return run


def _evaluate(arguments: argparse.Namespace) -> int:
    from neurosim_core.learn.train import evaluate_run

    speed = "" if arguments.speed is None else f"-{arguments.speed:g}m_s"
    run = _run_of(arguments)
    animation = run / f"{Path(arguments.scenes).stem}{speed}.webp"
    for name, evaluation in evaluate_run(
        run,
        scenes=arguments.scenes,
        device=arguments.device,
        worlds=arguments.worlds,
        speed_m_s=arguments.speed,
        animation=animation,
    ):
        print(f"{arguments.scenes} scenes, {name}: {evaluation}")
        if not arguments.blind:
            break
    print(f"wrote {animation}: the first of the episodes")
    return 0


_COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "dagger": _train,
    "ppo": _train,
    "dense": _learn_dense,
    "eval": _evaluate,
    "transfer": _evaluate_transfer,
    "network": _evaluate_network,
    "rate": _measure_rate,
}
"""What `neurosim learn` does: train a policy by one of two algorithms, or a dense prediction; evaluate a run,
here or in other conditions, or a dense network; measure a rate."""


def fly_policy(arguments: argparse.Namespace, overrides: Mapping[str, Any]) -> int:
    """Do `neurosim fly --policy`."""
    from neurosim_core.learn import pilot

    if arguments.config is not None:
        raise ValueError("--policy flies in the default apartment; say --scene FILE")
    given = {key: value for key, value in overrides.items() if key not in ("duration_s", "seed")}
    speed_m_s = pilot.fly_policy(
        arguments.policy,
        duration_s=arguments.duration or 6.0,
        seed=arguments.seed or 0,
        overrides=given,
        save=arguments.save,
    )
    return 0 if speed_m_s < float("inf") else 1


def _deploy(arguments: argparse.Namespace) -> int:
    from neurosim_core.learn.pilot import Pilot, pilot_settings, shipped_policy

    file = shipped_policy(arguments.policy)
    if arguments.print_config:
        from neurosim_core.config import load_config, to_yaml

        print(to_yaml(load_config(pilot_settings(Pilot(file).card)), comments=True), end="")
        return 0
    from neurosim_core.learn.deploy import deploy

    return deploy(
        file,
        vehicle=arguments.vehicle,
        events=arguments.events,
        duration_s=arguments.duration,
        ros=arguments.ros,
        max_thrust_n=arguments.max_thrust,
    )
