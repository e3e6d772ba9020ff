"""The base of everything a user can configure: frozen, keyword-only, checked once when it is made."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


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
        use_attribute_docstrings=True,
    )
