"""Shared by the commands: a node of their own, and words for when there is nothing to see."""

from __future__ import annotations

import argparse
import socket
import sys
import time
from pathlib import Path

from cortex.host import REGISTRY_SOCKET, domain_id, runtime_dir
from cortex.node import Node
from cortex.security import Keys, load_keys
from cortex.topic import check_topic

_ANSWER_S = 3.0


class CommandError(ValueError):
    """Why a command failed, in one line for people."""

    status = 1


class UsageError(CommandError):
    """It was used in a wrong way, which its parser alone cannot see."""

    status = 2


def open_node(options: argparse.Namespace) -> Node:
    """Open the node of a command with the common options."""
    return Node(
        f"cortex {options.command}",
        domain=options.domain,
        registry=options.registry,
        listen=options.listen,
        keys=read_keys(options.keys),
        insecure=options.insecure,
    )


def read_keys(directory: Path | None) -> Keys | None:
    """Read a key directory, if one was given."""
    if directory is None:
        return None
    try:
        return load_keys(directory)
    except FileNotFoundError as error:
        raise CommandError(f"{error.filename} does not exist: make keys with `cortex keys new`") from error


def look_around(options: argparse.Namespace) -> Node | None:
    """Open a node that knows the others; None, after telling why, if nobody is there.

    Raises:
        CommandError: The registry does not answer.
    """
    read_keys(options.keys)  # wrong ones are worth an error even if nobody is there
    if options.registry == "auto" and not _is_registry_there(options.domain):
        # Opening a node would start a registry, only to hear from it that there is nobody.
        say_empty(options)
        return None
    node = open_node(options)
    try:
        if not node.wait_for_registry(_ANSWER_S):
            raise CommandError(f"no answer from the registry ({options.registry})")
    except BaseException:
        node.close()
        raise
    return node


def say_empty(options: argparse.Namespace) -> None:
    """Say what to do about a domain in which nothing runs."""
    domain = domain_id(options.domain)
    hint(
        f"no node is running in domain {domain} of this host ({runtime_dir(domain)}). Start one; if it runs "
        "in another domain, give --domain or set CORTEX_DOMAIN; if on another host, --registry tcp://host:port"
    )


def hint(text: str) -> None:
    """Tell something besides the output proper."""
    print(text, file=sys.stderr, flush=True)


def _is_registry_there(domain: int | None) -> bool:
    path = runtime_dir(domain_id(domain)) / REGISTRY_SOCKET
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except OSError:
            return False
    return True


class WaitingHint:
    """Prints a hint, once, if no message of a topic has come for a second after it was made."""

    def __init__(self, node: Node, topic: str) -> None:
        self._node = node
        self._topic = check_topic(topic)
        self._due_s = time.monotonic() + 1.0

    def heard(self) -> None:
        """A message has come: print no hint any more."""
        self._due_s = float("inf")

    def check(self) -> None:
        """Print the hint if it is due."""
        if time.monotonic() < self._due_s:
            return
        self._due_s = float("inf")
        topics = self._node.topics()
        if any(info.topic == self._topic and info.publishers for info in topics):
            hint(f"{self._topic} has a publisher, but no message has come yet")
            return
        others = sorted({info.topic for info in topics if info.publishers})
        there = f"published are: {', '.join(others)}" if others else "nothing is published at the moment"
        hint(f"waiting for a publisher of {self._topic}; {there}")
