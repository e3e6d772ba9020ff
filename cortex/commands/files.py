"""`cortex record` and `cortex play`."""

from __future__ import annotations

import argparse
import math
import signal
import sys
import threading
import time
from pathlib import Path

from cortex.commands.interrupts import raise_again, raise_at_signals
from cortex.commands.session import UsageError, WaitingHint, hint, open_node
from cortex.commands.text import bytes_of, number_of, plain, seconds, table
from cortex.log import Log, Player, Recorder, RecordStats, open_log
from cortex.policy import keep_last

_TICK_S = 0.1
_REPORT_S = 1.0
_NOTHING_S = 3.0


def record(options: argparse.Namespace) -> int:
    """`cortex record`; it ends with Ctrl-C, SIGTERM, or after `--duration`, and fails if nothing came."""
    if not options.all and not options.topic:
        raise UsageError("say which topics to record, or --all")
    if options.all and options.topic:
        raise UsageError(f"--all records every topic: leave out {' '.join(options.topic)}")
    if options.output.exists() and not options.force:
        raise FileExistsError(f"{options.output} exists: choose another name, or --force to overwrite it")
    told_to_stop: list[int] = []
    # Before there is a file, so that no signal breaks into its making. Nor may a handler set an event that
    # this thread waits for: it could come while the wait holds the event's lock, and hang.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: told_to_stop.append(number))
    with open_node(options) as node:
        recorder = Recorder(
            node,
            options.output,
            None if options.all else options.topic,
            policy=keep_last(1024) if options.best_effort else None,
            overwrite=options.force,
            compression=options.compression,
        )
        hint(f"recording into {options.output}; Ctrl-C ends it")
        missing = {topic: WaitingHint(node, topic) for topic in options.topic}
        _wait_for_end(recorder, told_to_stop, options.duration, missing)
        stats = recorder.close()
    _report(options.output, stats)
    if stats.written:
        return 0
    topics = " or ".join(options.topic) or "any topic"
    hint(f"cortex record: nothing was recorded: no message of {topics} has come")
    return 1


def _wait_for_end(
    recorder: Recorder, told_to_stop: list[int], duration_s: float | None, missing: dict[str, WaitingHint]
) -> None:
    began_s = report_s = time.monotonic()
    warned = False
    while recorder.running and not told_to_stop:
        time.sleep(_TICK_S)
        now_s = time.monotonic()
        if duration_s is not None and now_s - began_s >= duration_s:
            break
        for topic, waiting_hint in missing.items():
            if (seen := recorder.stats.topics.get(topic)) is not None and seen.written:
                waiting_hint.heard()
            waiting_hint.check()
        if now_s - report_s >= _REPORT_S:
            report_s = now_s
            stats = recorder.stats
            if sys.stderr.isatty():
                text = (
                    f"{stats.duration_s:.0f} s  {bytes_of(stats.file_bytes)}  "
                    f"{number_of(len(stats.topics), 'topic')}  {number_of(stats.written, 'message')}  "
                    f"{stats.lost:,} lost"
                )
                print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)
            if not missing and not stats.written and not warned and now_s - began_s > _NOTHING_S:
                warned = True
                hint("nothing has come yet: `cortex topics` shows what is published")
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def _report(path: Path, stats: RecordStats) -> None:
    names = ("lost", "overtaken", "rejected", "cut_off")
    rows = [
        (topic, f"{s.written:,}", bytes_of(s.bytes), *(f"{getattr(s, name):,}" for name in names))
        for topic, s in stats.topics.items()
    ]
    if rows:
        for line in table(("topic", "messages", "size", *(name.replace("_", " ") for name in names)), rows):
            print(line)
    what = number_of(stats.written, "message")
    print(f"{path}: {what} in {stats.duration_s:.1f} s, {bytes_of(stats.file_bytes)}")


def play(options: argparse.Namespace) -> int:
    """`cortex play`; with `--loop`, Ctrl-C is how it ends."""
    with open_log(options.file) as log:
        if log.cut:
            hint(f"{options.file}: {log.cut}; what is before can be read")
        for topic in log.foreign:
            hint(f"{plain(topic)} is passed over: its messages are not those of Cortex")
        if options.info:
            _describe(log)
            return 0
        remap = dict(_split(pair) for pair in options.remap)
        with (
            open_node(options) as node,
            Player(node, log, topics=options.topic or None, remap=remap) as player,
        ):
            progress = threading.Thread(target=_show_progress, args=(player, log), daemon=True)
            progress.start()
            status = 0
            try:
                raise_again()
                raise_at_signals(player.stop)
                player.run(
                    rate=options.rate, start_s=options.start, duration_s=options.duration, loop=options.loop
                )
                raise_again()
            except KeyboardInterrupt:
                status = 0 if options.loop else int(options.interrupted)
            finally:
                player.stop()
                progress.join(1.0)
            late = (
                f"; the latest was {seconds(player.late_ns * 1e-9)} late" if options.rate < math.inf else ""
            )
            hint(f"{number_of(player.published, 'message')} played{late}")
    return status


def _describe(log: Log) -> None:
    rows = [
        (entry.topic, entry.schema.name, f"{entry.message_count:,}", plain(", ".join(entry.nodes)))
        for entry in log.topics
    ]
    for line in table(("topic", "<type", "messages", "<from"), rows):
        print(line)
    began = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(log.start_ns * 1e-9))
    print(f"{log.path}: {number_of(log.message_count, 'message')}, {log.duration_s:.3f} s from {began} on")


def _split(pair: str) -> tuple[str, str]:
    old, separator, new = pair.partition(":=")
    if not separator:
        raise UsageError(f"--remap takes /old:=/new, got {pair!r}")
    return old, new


def _show_progress(player: Player, log: Log) -> None:
    if not sys.stderr.isatty():
        return
    while not player.wait_stopped(_TICK_S):
        played = number_of(player.published, "message")
        text = f"{player.position_s:.1f} of {log.duration_s:.1f} s  {played}"
        print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)
    print("\r\x1b[K", end="", file=sys.stderr, flush=True)
