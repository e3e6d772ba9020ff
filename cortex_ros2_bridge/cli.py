"""The command `cortex-ros2-bridge`."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import gc
import importlib.metadata
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from cortex import Node
from cortex_ros2_bridge.config import ROOTED, SETTINGS, BridgeConfig, load
from cortex_ros2_bridge.options import OPTIONS
from cortex_ros2_bridge.ros_args import RosArguments, split
from cortex_ros2_bridge.routes import Route, Seen, known_options, look, make_routes, unfit

logger = logging.getLogger(__name__)

INTERRUPTED = 130
_EVERY_NODE = ("use_sim_time", "start_type_description_service", "qos_overrides")
"""Parameters that ROS gives to every node, without a meaning for this one."""
LIST_S = 1.5
"""How long `--list` and `--print-config` look for nodes [s]."""
SETTLED_S = 0.3
"""After so long without news, all nodes have been heard [s]."""
SWITCH_S = 0.5e-3
"""How long a thread may keep others from running [s]: messages pass on others than what opens routes."""
EXIT_S = 4.0
"""Longest time to leave in [s]; then the process ends as it is. `ros2 launch` kills after 5 s."""

_EXAMPLES = """examples:
  cortex-ros2-bridge                                   all standard topics, both ways
  cortex-ros2-bridge --namespace /neurosim             with /neurosim in front of them
  cortex-ros2-bridge --list                            what would go where
  cortex-ros2-bridge --print-config > bridge.yaml      settings to edit, for --config bridge.yaml
  cortex-ros2-bridge --backend run.mcap                into a bag, until Ctrl-C
  cortex-ros2-bridge --convert bag log.mcap            a bag for `cortex play`; a log into a bag likewise
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status: 0 done, 1 failed, 2 wrong use, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        arguments, ros = split(arguments)
        options = _parser().parse_args(arguments)
        _log_to_console(logging.DEBUG if options.verbose else ros.log_level or logging.INFO)
        make, given = _settings(options, ros)
        if options.convert:
            return _convert(*options.convert)
        if options.list or options.print_config:
            return _show(make(given), as_yaml=options.print_config)
        return _bridge(make, given, beside=options.beside)
    except KeyboardInterrupt:
        return INTERRUPTED
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        print(f"cortex-ros2-bridge: {error}", file=sys.stderr)
        return 1


def _convert(source: Path, target: Path) -> int:
    from cortex_ros2_bridge.log_file import convert

    counts, others = convert(source, target)
    for topic, count in sorted(counts.items()):
        print(f"{topic}  {count}")
    if others:
        print(f"left out: {', '.join(others)}", file=sys.stderr)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="cortex-ros2-bridge",
        description="Connect Cortex topics with ROS 2, both ways, with or without a ROS installation.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--config", metavar="FILE", help="settings in YAML; see --print-config")
    parser.add_argument(
        "--backend",
        metavar="auto|rclpy|dds|BAG.mcap",
        help="how to reach ROS 2: rclpy, DDS without ROS, or a bag to write; default: rclpy if installed",
    )
    parser.add_argument(
        "--distro", help="ROS distribution, such as jazzy; default: ROS_DISTRO, or that of other nodes"
    )
    parser.add_argument(
        "--namespace", help="prefix of all ROS topics but /clock, /tf, /tf_static, /diagnostics"
    )
    parser.add_argument(
        "--cortex-domain", "--domain", type=int, help="domain of Cortex; that of ROS is ROS_DOMAIN_ID"
    )
    parser.add_argument(
        "--convert",
        nargs=2,
        type=Path,
        metavar=("SOURCE", "TARGET"),
        help="convert a bag into a log of Cortex, or a log into a bag, and exit",
    )
    parser.add_argument("--version", action="version", version=f"cortex-ros2-bridge {_version()}")
    parser.add_argument("--list", action="store_true", help="print the routes of all topics, and exit")
    parser.add_argument("--print-config", action="store_true", help="print all settings as YAML, and exit")
    parser.add_argument("--verbose", "-v", action="store_true", help="also log subscriptions to topics")
    parser.add_argument(
        "--converter",
        action="append",
        metavar="MODULE|FILE.py",
        help="import conversions for types of your own; may be repeated",
    )
    parser.add_argument(
        "--beside", action="store_true", help="run even if another bridge publishes the same topics"
    )
    return parser


def _settings(
    options: argparse.Namespace, ros: RosArguments
) -> tuple[Callable[[Mapping[str, Any]], BridgeConfig], dict[str, Any]]:
    """Return what makes settings of ROS parameters, and the parameters that are given."""
    for argument in ros.useless:
        logger.warning("--ros-args: %s has no effect", argument)
    first = _config(options, ros, {})
    given = {}
    for name, value in ros.parameters_of(first.node, first.namespace).items():
        key = name.partition(".")[0]
        if key in SETTINGS:
            given[name] = value
        elif key not in _EVERY_NODE:
            logger.warning("no parameter is called %s, known: %s", name, ", ".join(SETTINGS))
    return functools.partial(_config, options, ros), given


def _config(options: argparse.Namespace, ros: RosArguments, parameters: Mapping[str, Any]) -> BridgeConfig:
    """Return settings: those of the file, over them parameters, over them options, over them remappings."""
    given = {name: getattr(options, name) for name in ("backend", "distro", "cortex_domain", "namespace")}
    config = load(
        options.config, {**parameters, **{name: value for name, value in given.items() if value is not None}}
    )
    node, namespace = ros.names(config.node, config.namespace)
    converters = (*config.converters, *(options.converter or ()))
    return dataclasses.replace(config, node=node, namespace=namespace, converters=converters, ros=ros)


def _version() -> str:
    try:
        return importlib.metadata.version("neurosim-core")
    except importlib.metadata.PackageNotFoundError:  # a source tree on PYTHONPATH
        return "of a source tree"


def _bridge(
    make: Callable[[Mapping[str, Any]], BridgeConfig], given: Mapping[str, Any], *, beside: bool
) -> int:
    """Bridge until interrupted, with what makes settings of ROS parameters, and the parameters."""
    config = make(given)
    _load_converters(config)
    stop = _stop_at_signals(forced=not config.is_bag)
    from cortex_ros2_bridge.backend.choose import open_backend
    from cortex_ros2_bridge.bridge import Bridge
    from cortex_ros2_bridge.lifecycle import Lifecycle
    from cortex_ros2_bridge.parameters import Parameters

    with contextlib.ExitStack() as stack:
        node = stack.enter_context(Node(_identity(config), domain=config.cortex_domain))
        if not beside:
            _refuse_second(node)
        backend = open_backend(
            config.backend, node_name=config.node, namespace=config.namespace, distro=config.distro
        )
        try:
            bridge = stack.enter_context(Bridge(config, backend, node))
            if not config.is_bag:
                stack.callback(Parameters(bridge, backend, make, given).close)
                stack.callback(Lifecycle(bridge, backend, f"{config.namespace}/{config.node}").close)
            where = getattr(backend, "directory", None)
            into = f" into {where}/ (rosbag2)" if where is not None else ""
            how = f"{backend.name}{into}, {backend.distro}"
            what = "waiting for Cortex topics" if config.autostart else "unconfigured: ROS manages it"
            _say(f"{config.namespace}/{config.node}: {how}; {what}, Ctrl-C ends")
            gc.collect()
            gc.freeze()  # what is there stays; the collector need not look at it again and again
            sys.setswitchinterval(SWITCH_S)
            bridge.run(stop)
        finally:
            stack.close()
            backend.close()
    return 0


def _load_converters(config: BridgeConfig) -> None:
    from cortex_ros2_bridge.convert.registry import load_converters

    for problem in load_converters(config.converters):
        logger.error("%s", problem)


def _identity(config: BridgeConfig) -> str:
    """Return what a bridge is called in Cortex: two of one name publish the same topics."""
    if config.is_bag:
        return f"{config.node} into {config.backend}"
    return f"{config.node} in ROS domain {os.environ.get('ROS_DOMAIN_ID') or '0'}, {config.namespace or '/'}"


def _refuse_second(node: Node) -> None:
    """Raise `RuntimeError` if a living bridge of this host, or any of another one, has the same name."""
    node.wait_for_registry(LIST_S)
    begin_s = time.monotonic()
    while True:
        records = node.nodes()
        host = next(record.host for record in records if record.node == node.id)
        twins = [record for record in records if record.node != node.id and record.name == node.name]
        for twin in twins:
            if twin.host != host or os.path.exists(f"/proc/{twin.pid}"):
                raise RuntimeError(
                    f"another bridge runs already ({twin.name}; process {twin.pid} on {twin.host}): ROS "
                    "would get everything twice. End it, give this one a --namespace, or say --beside"
                )
        if time.monotonic() - begin_s > SETTLED_S:
            return
        time.sleep(0.02)


def _show(config: BridgeConfig, *, as_yaml: bool) -> int:
    """Print what would go where; return 1 if anything is wrong with that, and it is not to be edited."""
    _load_converters(config)
    with Node(f"{config.node} list", domain=config.cortex_domain) as node:
        node.wait_for_registry(LIST_S)
        seen = _what_there_is(node)
    routes, problems = make_routes(seen, config)
    problems += unfit(seen, config)
    if as_yaml:
        sys.stdout.write(to_yaml(config, routes))
    elif not routes and seen.topics:
        print(f"none of {len(seen.topics)} Cortex topics goes anywhere: see include, exclude and defaults")
    elif not routes:
        print("no Cortex topics that go anywhere; is a simulator running? (cortex topics)")
    else:
        widths = [max(len(row[n]) for row in map(_row, routes)) for n in range(3)]
        for row in map(_row, routes):
            print(
                "  ".join(text.ljust(width) for text, width in zip(row, [*widths, 0], strict=True)).rstrip()
            )
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems and not as_yaml else 0


def _what_there_is(node: Node) -> Seen:
    """Look until there are topics and nothing new has come for a while, or for `LIST_S`."""
    begin_s = changed_s = time.monotonic()
    seen = look(node)
    while (now_s := time.monotonic()) - begin_s < LIST_S:
        if seen.topics and now_s - changed_s > SETTLED_S:
            break
        time.sleep(0.02)
        before, seen = seen, look(node)
        if seen != before:
            changed_s = now_s
    return seen


def _row(route: Route) -> tuple[str, str, str, str]:
    _, arrow, _ = str(route).split()
    qos = route.qos
    return (
        route.cortex_topic,
        f"{arrow} {route.ros_topic}",
        route.ros_type,
        (f"{qos.reliability}, {qos.durability}, depth {qos.depth}"),
    )


def to_yaml(config: BridgeConfig, routes: Sequence[Route]) -> str:
    """Return settings as YAML that `load` reads back, with the routes that there are now as entries."""
    settings: dict[str, Any] = {name: getattr(config, name) for name in SETTINGS}
    settings |= {name: list(getattr(config, name)) for name in ("include", "exclude", "converters")}
    settings |= {"rename": dict(config.rename), "frames": dataclasses.asdict(config.frames)}
    settings["routes"] = [
        {
            "cortex": route.cortex_topic,
            "type": route.ros_type,
            "ros": route.ros_topic
            if route.ros_topic in ROOTED
            else route.ros_topic.removeprefix(config.namespace),
            "qos": dataclasses.asdict(route.qos),
            "options": {
                name: route.options.get(name, OPTIONS[name].default) for name in sorted(known_options(route))
            },
        }
        for route in routes
    ]
    return (
        "# Settings of cortex-ros2-bridge, all optional; see README.md. The routes are those of now.\n"
        + yaml.safe_dump(settings, sort_keys=False)
    )


def _log_to_console(level: int) -> None:
    """Print what the bridge logs from a level on, a line each."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))
    for name in ("cortex", "cortex_ros2_bridge"):
        logger = logging.getLogger(name)
        logger.handlers[:] = [handler]
        logger.propagate = False
    logging.getLogger("cortex_ros2_bridge").setLevel(level)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _give_up() -> None:
    _say(f"cortex-ros2-bridge: it did not end within {EXIT_S} s, and is ended as it is")
    os._exit(1)


def _stop_at_signals(*, forced: bool) -> threading.Event:
    """Return an event that SIGINT and SIGTERM set; if forced, the process ends soon after, whatever waits."""
    stop = threading.Event()

    def end(number: int, frame: object) -> None:
        if not stop.is_set() and forced:
            timer = threading.Timer(EXIT_S, _give_up)
            timer.daemon = True
            timer.start()
        stop.set()

    signal.signal(signal.SIGINT, end)
    signal.signal(signal.SIGTERM, end)
    return stop
