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
from typing import Any, NoReturn

INTERRUPTED = 130
TERMINATED = 143
BROKEN_PIPE = 141
_HELP_WIDTH = 78

_EXAMPLES = """examples:
  cortex doctor                                whether all works here
  cortex top                                   topics: rate, bandwidth, losses
  cortex topics                                what is published and subscribed
  cortex info /scan                            counters, live, and the type
  cortex echo /scan                            messages as they come
  cortex hz /scan                              rate and regularity
  cortex record -o run.mcap --all              record everything until Ctrl-C
  cortex play run.mcap --rate 0.5 --loop       play it slowly, again and again
  cortex topics --registry tcp://10.0.0.2:7460 --keys ~/.config/cortex
"""


class _Terminated(BaseException):
    """SIGTERM: end as after Ctrl-C, with files closed and leave taken."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status: 0 done, 1 failed, 2 wrong use, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments[:1] == ["bench"]:
        return _run_module("cortex.bench.command", arguments[1:])
    if arguments[:1] == ["discovery"]:
        return _run_module("cortex.discovery", arguments[1:])
    parser = _parser()
    if not arguments:
        parser.print_help(sys.stderr)
        return 2
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format=f"cortex {options.command}: %(message)s")
    signal.signal(signal.SIGINT, _leave)  # imports may swallow an exception, or make another of it
    signal.signal(signal.SIGTERM, _leave)
    try:
        status = _call(options)
        sys.stdout.flush()
    except KeyboardInterrupt:
        status = options.interrupted
    except _Terminated:
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
        signal.signal(signal.SIGINT, _interrupt)
        signal.signal(signal.SIGTERM, _terminate)
        return int(run(options))
    except BrokenPipeError:
        raise
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        text = " ".join(str(error).split()).replace("insecure=True", "--insecure")
        if isinstance(error, OSError) and error.strerror and error.filename:
            text = f"{error.filename}: {error.strerror}"
        print(f"cortex {options.command}: {text}", file=sys.stderr)
        return int(getattr(error, "status", 1))


def _run_module(name: str, arguments: Sequence[str]) -> int:
    """Run a command that reads its own arguments."""
    run: Callable[[Sequence[str]], int] = importlib.import_module(name).main
    try:
        return run(arguments)
    except KeyboardInterrupt:
        return INTERRUPTED


def _interrupt(number: int, frame: object) -> NoReturn:
    signal.signal(signal.SIGINT, _leave)
    raise KeyboardInterrupt


def _leave(number: int, frame: object) -> NoReturn:
    """Leave at once: nothing is open yet, or closing takes too long. No file is worse than after SIGKILL."""
    os._exit(128 + number)


def _terminate(number: int, frame: object) -> NoReturn:
    signal.signal(signal.SIGTERM, _leave)
    raise _Terminated


class _Version(argparse.Action):
    """Print the version of the package, which is looked up only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import PackageNotFoundError, version

        try:
            found = version("neurosim-core")
        except PackageNotFoundError:
            found = "of unknown version: the package is not installed"
        print(f"cortex {found}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="cortex",
        description="Look at, record and replay what Cortex nodes say to each other.",
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
) -> argparse.ArgumentParser:
    shown = "examples:\n" + "\n".join(f"  {line}" for line in examples) if examples else None
    description = f"{what[0].upper()}{what[1:]}. {details}".strip()
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=what,
        description=textwrap.fill(description, _HELP_WIDTH) if examples else description,
        epilog=shown,
        formatter_class=argparse.RawDescriptionHelpFormatter if examples else argparse.HelpFormatter,
    )
    parser.set_defaults(run=run, interrupted=interrupted)
    if network:
        group = parser.add_argument_group("where to look")
        group.add_argument("--domain", type=int, metavar="N", help="0 to 232; default: CORTEX_DOMAIN, else 0")
        group.add_argument(
            "--registry",
            default=os.environ.get("CORTEX_REGISTRY") or "auto",
            metavar="ADDRESS",
            help='"auto" (this host), "off", or tcp://host:port; default: CORTEX_REGISTRY, else "auto"',
        )
        group.add_argument(
            "--listen",
            metavar="IP",
            help="let other hosts reach us, e.g. 192.168.1.5; default: CORTEX_LISTEN",
        )
        group.add_argument(
            "--keys", type=_directory, metavar="DIR", help="key directory, for tcp; default: CORTEX_KEYS"
        )
        group.add_argument("--insecure", action="store_true", help="allow plain tcp beyond this host")
    return parser


def _add_looking(commands: Any) -> None:
    _add(
        commands,
        "topics",
        "list the topics, their types, and who publishes and subscribes",
        ("look", "show_topics"),
    )
    _add(commands, "nodes", "list the nodes", ("look", "show_nodes"))
    top = _add(
        commands,
        "top",
        "show all topics live: rate, bandwidth, losses, delay",
        ("look", "show_top"),
        details="Losses are counted since each subscriber began.",
    )
    top.add_argument("--once", action="store_true", help="print once and end, instead of every second")
    info = _add(
        commands,
        "info",
        "show the counters of a topic live, and its type",
        ("look", "show_info"),
        examples=["cortex info /scan", "cortex info /scan --once"],
    )
    info.add_argument("topic", type=_topic)
    info.add_argument("--once", action="store_true", help="print once and end, instead of every second")


def _add_watching(commands: Any) -> None:
    echo = _add(
        commands,
        "echo",
        "print the messages of a topic",
        ("watch", "echo"),
        details="Each begins with its number, its size, and how long it was under way.",
        examples=[
            "cortex echo /scan -n 1",
            "cortex echo /scan --full | less",
            "cortex echo /scan --json | jq .message.stamp_ns",
        ],
    )
    echo.add_argument("topic", type=_topic)
    echo.add_argument("-n", "--count", type=_count, metavar="N", help="end after so many messages")
    echo.add_argument("--json", action="store_true", help="one line of JSON for each message, arrays in full")
    arrays = echo.add_mutually_exclusive_group()
    arrays.add_argument("--no-arrays", action="store_true", help="of arrays only the type and shape")
    arrays.add_argument("--full", action="store_true", help="arrays and texts in full, however long")
    for name, what, run, details in (
        (
            "hz",
            "measure how often and how regularly a topic is published",
            "show_rate",
            "Of the time between two messages, as they were published: mean, standard deviation",
        ),
        ("bw", "measure the bandwidth of a topic", "show_bandwidth", "Of the size of a message: mean"),
        (
            "delay",
            "measure the time from publishing to receiving",
            "show_delay",
            "Of that time: mean, standard deviation",
        ),
    ):
        watch = _add(
            commands,
            name,
            what,
            ("watch", run),
            details=f"{details}, least, median, 99th percentile and most.",
        )
        watch.add_argument("topic", type=_topic)
        watch.add_argument(
            "--window", type=_positive, default=5.0, metavar="S", help="seconds to look back over (5)"
        )
        watch.add_argument("-n", "--count", type=_count, metavar="N", help="end after so many lines")
        if name == "delay":
            watch.add_argument(
                "--stamp", action="store_true", help="from stamp_ns, where that is the time of day, until now"
            )


def _add_files(commands: Any) -> None:
    record = _add(
        commands,
        "record",
        "record topics into an MCAP file",
        ("files", "record"),
        details="Ctrl-C ends it.",
        examples=[
            "cortex record -o run.mcap /scan /cmd",
            "cortex record -o run.mcap --all --duration 60",
        ],
        interrupted=INTERRUPTED,
    )
    record.add_argument("topic", nargs="*", type=_topic)
    record.add_argument("-o", "--output", type=Path, required=True, metavar="FILE")
    record.add_argument("-a", "--all", action="store_true", help="every topic, also those that appear later")
    record.add_argument("--force", action="store_true", help="overwrite the file if it exists")
    record.add_argument("--duration", type=_positive, metavar="S", help="end after so many seconds")
    record.add_argument(
        "--best-effort",
        action="store_true",
        help="never hold up a publisher; rather lose messages, which are counted",
    )
    record.add_argument(
        "--compression",
        choices=("none", "lz4", "zstd"),
        default="none",
        help="of the file (none, the fastest)",
    )
    play = _add(
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
    play.add_argument("file", type=Path)
    play.add_argument("topic", nargs="*", type=_topic, help="only these")
    play.add_argument("--info", action="store_true", help="say what is in the file, and end")
    play.add_argument(
        "--rate", type=_rate, default=1.0, metavar="R", help='factor of speed, or "max": without pauses (1)'
    )
    play.add_argument(
        "--start", type=_not_negative, default=0.0, metavar="S", help="begin so many seconds into the file"
    )
    play.add_argument("--duration", type=_positive, metavar="S", help="play so many seconds of the file")
    play.add_argument("--loop", action="store_true", help="begin anew at the end")
    play.add_argument("--paused", action="store_true", help="begin paused; Enter goes on and pauses again")
    play.add_argument(
        "--remap",
        action="append",
        default=[],
        metavar="/OLD:=/NEW",
        help="publish under another name; may be repeated",
    )


def _add_tools(commands: Any) -> None:
    commands.add_parser(
        "discovery",
        help="run the registry of a domain, also for other hosts (its options: cortex discovery --help)",
        add_help=False,
    )
    keys = _add(
        commands,
        "keys",
        "make a pair of keys for tcp",
        ("tools", "make_keys"),
        examples=["cortex keys new", "cortex keys new --dir ./keys"],
        network=False,
    )
    keys.add_argument("action", choices=("new",))
    keys.add_argument(
        "--dir", type=_directory, metavar="DIR", help="where to (cortex in XDG_CONFIG_HOME or ~/.config)"
    )
    _add(
        commands,
        "doctor",
        "check what Cortex needs on this host, and say how to mend what is wrong",
        ("doctor", "examine"),
        examples=["cortex doctor", "cortex doctor --registry tcp://10.0.0.2:7460 --keys ~/.config/cortex"],
    )
    schema = _add(
        commands,
        "schema",
        "say what sets two message types apart, and whether one may read the other",
        ("tools", "compare"),
        examples=["cortex schema diff robot:Scan /scan", "cortex schema diff run.mcap:/scan robot:Scan"],
    )
    schema.add_argument("action", choices=("diff",))
    for which in ("old", "new"):
        schema.add_argument(which, help="module:Type, a topic that is published, or FILE.mcap:/topic")
    cpp = _add(
        commands,
        "cpp",
        "write the C++ header of message types to the standard output",
        ("tools", "write_cpp"),
        examples=["cortex cpp cortex.messages:Imu > imu.hpp", "cortex cpp robot:Scan robot:Cmd > robot.hpp"],
        network=False,
    )
    cpp.add_argument(
        "type", nargs="*", metavar="module:Type", help="modules in this directory are found, too"
    )
    cpp.add_argument("--namespace", help="C++ namespace of the structs")
    cpp.add_argument(
        "--include-dir", action="store_true", help="print where the headers of Cortex are, and end"
    )
    cpp.add_argument(
        "--headers", type=Path, metavar="DIR", help="write there what the client includes besides, and end"
    )
    commands.add_parser(
        "bench",
        help="measure Cortex beside its peers on this machine (its options: cortex bench --help)",
        add_help=False,
    )


# Arguments


def _topic(text: str) -> str:
    from cortex.topic import check_topic

    try:
        return check_topic(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _number(text: str, least: float, what: str, *, above: bool) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (value > least if above else value >= least) or not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be {what}, got {text!r}")
    return value


def _positive(text: str) -> float:
    return _number(text, 0.0, "a number > 0", above=True)


def _not_negative(text: str) -> float:
    return _number(text, 0.0, "a number >= 0", above=False)


def _rate(text: str) -> float:
    return math.inf if text == "max" else _number(text, 0.0, 'a number > 0, or "max"', above=True)


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"must be an integer > 0, got {text!r}")
    return int(text)


def _directory(text: str) -> Path:
    return Path(text).expanduser()
