"""Names of topics and services, and patterns of topics."""

from __future__ import annotations

import functools
import re

_NAME = re.compile(r"(/[A-Za-z0-9_]+)+")
_PATTERN = re.compile(r"(/([A-Za-z0-9_]+|\*\*?))+")
NAME_MAX = 200


def check_topic(name: str) -> str:
    """Return the name of a topic or service if it is one.

    Raises:
        ValueError: It is not of the form `/part/part` with letters, digits and underscores, or too long.
    """
    if not isinstance(name, str) or len(name) > NAME_MAX or not _NAME.fullmatch(name):
        raise ValueError(
            f"a topic or service is named like '/front/image' (letters, digits, '_', at most {NAME_MAX}), "
            f"got {name!r}"
        )
    return name


def check_pattern(pattern: str) -> str:
    """Return a topic, or a pattern of topics: `*` stands for one part of a name, `**` for any number.

    Raises:
        ValueError: It is neither.
    """
    if is_pattern(pattern) and len(pattern) <= NAME_MAX and _PATTERN.fullmatch(pattern):
        return pattern
    return check_topic(pattern)


def is_pattern(text: str) -> bool:
    """Tell whether a text stands for several topics."""
    return isinstance(text, str) and "*" in text


def matches(pattern: str, topic: str) -> bool:
    """Tell whether a topic is the one named, or fits a pattern."""
    return pattern == topic or (is_pattern(pattern) and bool(_expression(pattern).fullmatch(topic)))


@functools.lru_cache(maxsize=256)
def _expression(pattern: str) -> re.Pattern[str]:
    kinds = {"*": "/[^/]+", "**": "(?:/[^/]+)*"}
    return re.compile("".join(kinds.get(part, "/" + part) for part in pattern.split("/")[1:]))
