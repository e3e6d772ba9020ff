"""Names of topics and services."""

from __future__ import annotations

import re

_NAME = re.compile(r"(/[A-Za-z0-9_]+)+")
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
