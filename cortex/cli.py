"""The command `cortex`."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import logging
import math
import os
import signal
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from cortex.commands import interrupts

INTERRUPTED = 130
TERMINATED = 143
BROKEN_PIPE = 141
_HELP_WIDTH = 78
_OWN_ARGUMENTS = {"bench": "cortex.bench.command", "discovery": "cortex.discovery"}

_EXAMPLES = """examples:
  cortex doctor                                whether all works here
  cortex top                                   topics: rate, bandwidth, losses
  cortex topics                                what is published and subscribed
  cortex info /scan                            counters, live, and the type
  cortex echo /scan                            messages as they come
  cortex hz /scan                              rate, bandwidth, delay
  cortex record -o run.mcap --all              record everything until Ctrl-C
  cortex play run.mcap --rate 0.5 --loop       play it slowly, again and again
  cortex topics --registry tcp://10.0.0.2:7460 --keys ~/.config/cortex
"""

T = TypeVar("T")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status: 0 done, 1 failed, 2 wrong use, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments and arguments[0] in _OWN_ARGUMENTS:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # it closes what it has opened
        try:
            return int(importlib.import_module(_OWN_ARGUMENTS[arguments[0]]).main(arguments[1:]))
        except KeyboardInterrupt:
            return INTERRUPTED
    parser = _parser()
    if not arguments:
        parser.print_help(sys.stderr)
        return 2
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format=f"cortex {options.command}: %(message)s")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, interrupts.leave)  # imports may swallow an exception, or make another of it
    try:
        status = _call(options)
        sys.stdout.flush()
    except KeyboardInterrupt:
        status = options.interrupted
    except interrupts.Terminated:
        status = TERMINATED
    except BrokenPipeError:
        # Whoever read our output has seen enough. Python would complain once more at exit.
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = BROKEN_PIPE
    return status


def _call(options: argparse.Namespace) -> int:
    module, name = options.run
    try:
        run = getattr(importlib.import_module(f"cortex.commands.{module}"), name)
        interrupts.raise_at_signals()
        return int(run(options))
    except BrokenPipeError:
        raise
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        text = " ".join(str(error).split()).replace("insecure=True", "--insecure")
        if isinstance(error, OSError) and error.strerror and error.filename:
            text = f"{error.filename}: {error.strerror}"
        print(f"cortex {options.command}: {text}", file=sys.stderr)
        return int(getattr(error, "status", 1))


class _Version(argparse.Action):
    """Print the version of the package, which is looked up only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"cortex {version('neurosim-core')}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="cortex",
        description="Inspect, record and replay the messages of Cortex nodes.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", metavar="command", required=True)
    _add_looking(commands)
    _add_watching(commands)
    _add_files(commands)
    _add_tools(commands)
    return parser


def _add(
    commands: Any,
    name: str,
    what: str,
    run: tuple[str, str],
    *,
    details: str = "",
    examples: Sequence[str] = (),
    interrupted: int = 0,
    network: bool = True,
    aliases: Sequence[str] = (),
) -> Callable[..., argparse.Action]:
    """Add a command; return what adds its arguments."""
    description = textwrap.fill(f"{what[0].upper()}{what[1:]}. {details}".strip(), _HELP_WIDTH)
    shown = "\n".join(["examples:", *(f"  {line}" for line in examples)]) if examples else None
    form = argparse.RawDescriptionHelpFormatter
    texts = {"help": what, "description": description, "epilog": shown}
    parser = commands.add_parser(name, aliases=aliases, formatter_class=form, **texts)
    parser.set_defaults(run=run, interrupted=interrupted)
    if network:
        add = parser.add_argument_group("network").add_argument
        add("--domain", type=int, metavar="N", help="0 to 232; default: CORTEX_DOMAIN, else 0")
        add(
            "--registry",
            default=os.environ.get("CORTEX_REGISTRY") or "auto",
            metavar="ADDRESS",
            help='"auto" (this host), "off", or tcp://host:port; default: CORTEX_REGISTRY, else "auto"',
        )
        listen = "address for other hosts, e.g. 192.168.1.5; default: CORTEX_LISTEN"
        add("--listen", metavar="IP", help=listen)
        add("--keys", type=_path, metavar="DIR", help="key directory, for tcp; default: CORTEX_KEYS")
        add("--insecure", action="store_true", help="allow plain tcp beyond this host")
    adds: Callable[..., argparse.Action] = parser.add_argument
    return adds


def _add_looking(commands: Any) -> None:
    what = "list the topics, their types, and who publishes and subscribes"
    _add(commands, "topics", what, ("look", "show_topics"))
    _add(commands, "nodes", "list the nodes", ("look", "show_nodes"))
    once = "print once and exit, instead of every second"
    what, details = "show all topics live: rate, bandwidth, losses, delay", "Losses are counted since each "
    add = _add(commands, "top", what, ("look", "show_top"), details=f"{details}subscriber began.")
    add("--once", action="store_true", help=once)
    examples = ["cortex info /scan", "cortex info /scan --once"]
    what = "show the counters of a topic live, and its type"
    add = _add(commands, "info", what, ("look", "show_info"), examples=examples)
    add("topic", type=_topic)
    add("--once", action="store_true", help=once)


def _add_watching(commands: Any) -> None:
    add = _add(
        commands,
        "echo",
        "print the messages of a topic",
        ("watch", "echo"),
        details="Each begins with its number, its size and its latency.",
        examples=[
            "cortex echo /scan -n 1",
            "cortex echo /scan --full | less",
            "cortex echo /scan --json | jq .message.stamp_ns",
        ],
    )
    add("topic", type=_topic)
    add("-n", "--count", type=_count, metavar="N", help="number of messages after which to exit")
    add("--json", action="store_true", help="one line of JSON for each message, arrays in full")
    arrays = commands.choices["echo"].add_mutually_exclusive_group()
    arrays.add_argument("--no-arrays", action="store_true", help="print only type and shape of arrays")
    arrays.add_argument("--full", action="store_true", help="print arrays and texts in full")
    what = "measure rate, regularity, bandwidth and delay of a topic"
    details = (
        "One line a second, over the last --window: rate; standard deviation and maximum of the intervals "
        "between messages, as they were published; bandwidth and mean size; latency."
    )
    add = _add(commands, "hz", what, ("watch", "show_rate"), details=details, aliases=("bw", "delay"))
    add("topic", type=_topic)
    add("--window", type=_positive, default=5.0, metavar="S", help="length of the window in seconds (5)")
    add("-n", "--count", type=_count, metavar="N", help="number of lines after which to exit")
    add("--stamp", action="store_true", help="delay from stamp_ns, where that is the time of day, until now")


def _add_files(commands: Any) -> None:
    add = _add(
        commands,
        "record",
        "record topics into an MCAP file",
        ("files", "record"),
        details="Ctrl-C ends it.",
        examples=["cortex record -o run.mcap /scan /cmd", "cortex record -o run.mcap --all --duration 60"],
        interrupted=INTERRUPTED,
    )
    add("topic", nargs="*", type=_topic)
    add("-o", "--output", type=Path, required=True, metavar="FILE")
    add("-a", "--all", action="store_true", help="every topic, also those that appear later")
    add("--force", action="store_true", help="overwrite the file if it exists")
    add("--duration", type=_positive, metavar="S", help="seconds after which to exit")
    best_effort = "never block a publisher; lose messages instead, and count them"
    add("--best-effort", action="store_true", help=best_effort)
    kinds = ("none", "lz4", "zstd")
    add("--compression", choices=kinds, default="none", help="compression of the file (none, the fastest)")
    add = _add(
        commands,
        "play",
        "publish what was recorded",
        ("files", "play"),
        details="Messages keep their stamps.",
        examples=[
            "cortex play run.mcap --rate 0.5",
            "cortex play run.mcap --start 12.5 --duration 3 --loop",
            "cortex play run.mcap /scan --remap /scan:=/replay/scan",
            "cortex play run.mcap --info",
        ],
        interrupted=INTERRUPTED,
    )
    add("file", type=Path)
    add("topic", nargs="*", type=_topic, help="topics to play (all)")
    add("--info", action="store_true", help="print a summary of the file, and exit")
    rate = 'speed factor, or "max": without pauses (1)'
    add("--rate", type=_rate, default=1.0, metavar="R", help=rate)
    start = "offset into the file in seconds"
    add("--start", type=_not_negative, default=0.0, metavar="S", help=start)
    add("--duration", type=_positive, metavar="S", help="seconds of the file to play")
    add("--loop", action="store_true", help="restart at the end")
    remap = "publish under another name; may be repeated"
    add("--remap", action="append", default=[], metavar="/OLD:=/NEW", help=remap)


def _add_tools(commands: Any) -> None:
    for name, what in (
        ("discovery", "run the registry of a domain, also for other hosts"),
        ("bench", "compare Cortex with other libraries on this machine"),
    ):
        options = f"its options: cortex {name} --help"
        commands.add_parser(name, help=f"{what} ({options})", add_help=False)
    examples = ["cortex keys new", "cortex keys new --dir ./keys"]
    what = "make a key pair for tcp"
    add = _add(commands, "keys", what, ("tools", "make_keys"), examples=examples, network=False)
    add("action", choices=("new",))
    add("--dir", type=_path, metavar="DIR", help="key directory (cortex in XDG_CONFIG_HOME or ~/.config)")
    examples = ["cortex doctor", "cortex doctor --registry tcp://10.0.0.2:7460 --keys ~/.config/cortex"]
    what = "check what Cortex needs on this host, and tell how to fix problems"
    _add(commands, "doctor", what, ("doctor", "examine"), examples=examples)
    examples = ["cortex schema diff robot:Scan /scan", "cortex schema diff run.mcap:/scan robot:Scan"]
    what = "compare two message types, and tell whether one may read the other"
    add = _add(commands, "schema", what, ("tools", "compare"), examples=examples)
    add("action", choices=("diff",))
    for which in ("old", "new"):
        add(which, help="module:Type, a published topic, or FILE.mcap:/topic")
    examples = ["cortex cpp cortex.messages:Imu > imu.hpp", "cortex cpp robot:Scan robot:Cmd > robot.hpp"]
    what = "write the C++ header of message types to the standard output"
    add = _add(commands, "cpp", what, ("tools", "write_cpp"), examples=examples, network=False)
    add("type", nargs="*", metavar="module:Type", help="message types, also of modules in this directory")
    add("--namespace", help="C++ namespace of the structs")
    add("--include-dir", action="store_true", help="print the folder of the headers of Cortex, and exit")
    headers = "write the headers that the client includes there, and exit"
    add("--headers", type=Path, metavar="DIR", help=headers)


# Arguments


def _topic(text: str) -> str:
    from cortex.topic import check_topic

    try:
        return check_topic(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _checked(read: Callable[[str], T], accepts: Callable[[T], bool], what: str) -> Callable[[str], T]:
    """Return what reads an argument, and refuses all but `what`."""

    def checked(text: str) -> T:
        with contextlib.suppress(ValueError):
            value = read(text)
            if accepts(value):
                return value
        raise argparse.ArgumentTypeError(f"must be {what}, got {text!r}")

    return checked


_positive = _checked(float, lambda value: 0.0 < value < math.inf, "a number > 0")
_not_negative = _checked(float, lambda value: 0.0 <= value < math.inf, "a number >= 0")
_count = _checked(int, lambda value: value > 0, "an integer > 0")


def _rate(text: str) -> float:
    wanted = 'a number > 0, or "max"'
    return math.inf if text == "max" else _checked(float, lambda v: 0.0 < v < math.inf, wanted)(text)


def _path(text: str) -> Path:
    return Path(text).expanduser()
