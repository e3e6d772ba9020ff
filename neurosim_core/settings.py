"""The base of everything a user can configure: frozen, keyword-only, checked once when it is made."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict

from neurosim_core.docstrings import field_docs


class Settings(BaseModel):
    """A frozen group of settings.

    Unknown keys, non-finite numbers and values out of range are refused with a `ValueError` (pydantic's
    `ValidationError`) that names the key, the value and what is allowed. Subclasses document each field with
    a docstring on the line after it; `neurosim run --print-config` prints these as comments.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        validate_default=True,
    )


@functools.cache
def documentation(settings: type[BaseModel]) -> dict[str, str]:
    """Return what `Field` or else the source says of each field of a class of settings, by name.

    Read when it is asked for: pydantic's `use_attribute_docstrings` parses every class when it is imported.
    """
    described = {
        name: field.description for name, field in settings.model_fields.items() if field.description
    }
    return field_docs(settings) | described


def fill_from_preset(given: Any, presets: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return settings with those of the preset that they name below them; for validators of mode "before".

    Single keys win. Groups of keys are merged, unless they are of another `kind`.

    Raises:
        ValueError: There is no such preset.
    """
    if not isinstance(given, Mapping) or not isinstance(given.get("preset"), str):
        return given
    name = given["preset"]
    if name not in presets:
        raise ValueError(f"unknown preset {name!r}, known: {', '.join(presets)}")
    filled = dict(presets[name])
    for key, value in given.items():
        old = filled.get(key)
        filled[key] = value
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            same = value.get("kind", old.get("kind")) == old.get("kind")
            filled[key] = {**old, **value} if same else value
    return filled
