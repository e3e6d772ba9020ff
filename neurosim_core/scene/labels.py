"""The classes of objects in scenes: from settings, from scene files, or from names."""

from __future__ import annotations

import fnmatch
import functools
import json
import logging
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

UNLABELLED = "unlabelled"
"""Class 0: what no class is known of."""

_log = logging.getLogger(__name__)

_SHOWN_MAX = 1000
_NUMBER = re.compile(r"[ _.#-]*[0-9]+$")


class Labels(NamedTuple):
    """The classes of the instances of scenes."""

    classes: tuple[str, ...]
    """Names of the classes; the first is `UNLABELLED`."""
    instances: tuple[tuple[tuple[str, int], ...], ...]
    """Name and class of each instance, then of each body, for each scene."""


def label_scenes(scenes: Sequence[Any], classes: Mapping[str, Sequence[str]] | None) -> Labels:
    """Return what the instances of scenes are, with the same classes in all.

    Patterns of names, such as "chair*", are given by class; the first class that matches counts, whatever the
    case. None: an instance is what its file says, or what its name says without the number at its end, so
    that chair_1 and Chair.002 are chairs.
    """
    found = [
        [(name, _class_of(name, scene.scene.instance_labels, classes)) for name in scene.instance_names]
        for scene in scenes
    ]
    names = list(classes) if classes is not None else sorted({label for row in found for _, label in row})
    known = (UNLABELLED, *(name for name in names if name != UNLABELLED))
    index = {name: number for number, name in enumerate(known)}
    return Labels(known, tuple(tuple((name, index[label]) for name, label in row) for row in found))


def warn_of_patterns(sensor: str, scenes: Sequence[Any], classes: Mapping[str, Sequence[str]] | None) -> None:
    """Log each pattern of a sensor that no instance of any scene matches, and what there is; each once."""
    names = {
        name: _label_of(name, scene.scene.instance_labels)
        for scene in scenes
        for name in scene.instance_names
    }
    known = sorted({*names.values()} - {UNLABELLED})
    if not known:  # also the scene in which kernels are warmed up before there is another
        return
    for kind, patterns in (classes or {}).items():
        for pattern in patterns:
            if not any(_matches(pattern, name, label) for name, label in names.items()):
                shown = textwrap.shorten(", ".join(known), _SHOWN_MAX, placeholder=" ...")
                said = f"nothing is called {pattern!r}, as class {kind!r} says; there are: {shown}"
                _warn_once(f"sensor {sensor}: {said}")


@functools.cache
def _warn_once(text: str) -> None:
    """Log a text that each of several batches in flight would log."""
    _log.warning(text)


def _class_of(name: str, labels: Mapping[str, str], classes: Mapping[str, Sequence[str]] | None) -> str:
    label = _label_of(name, labels)
    if classes is None:
        return label
    for kind, patterns in classes.items():
        if any(_matches(pattern, name, label) for pattern in patterns):
            return kind
    return UNLABELLED


def _label_of(name: str, labels: Mapping[str, str]) -> str:
    return labels.get(name) or _NUMBER.sub("", name).strip().lower() or UNLABELLED


def _matches(pattern: str, *texts: str) -> bool:
    return any(fnmatch.fnmatchcase(text.lower(), pattern.lower()) for text in texts)


def describe_labels(labels: Labels) -> str:
    """Return labels as JSON; the instances only if there is one scene."""
    instances = labels.instances[0] if len(labels.instances) == 1 else ()
    return json.dumps({"instances": instances, "classes": labels.classes}, separators=(",", ":"))
