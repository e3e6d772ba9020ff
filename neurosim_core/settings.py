"""The base of everything a user can configure: frozen, keyword-only, checked once when it is made."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from typing import Any, get_args

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError, model_validator
from pydantic_core import (
    CoreSchema,
    InitErrorDetails,
    PydanticCustomError,
    PydanticKnownError,
    SchemaValidator,
    core_schema,
)

from neurosim_core.docstrings import field_docs
from neurosim_core.registry import find, kinds
from neurosim_core.settings_file import ConfigError, merge

_NO_NUMBER = PydanticCustomError("no_number", "must be a number")


class BaseConfig(BaseModel):
    """A frozen group of settings.

    Unknown keys, non-finite numbers and values out of range are refused with a `ConfigError` that names the
    key, the value and what is allowed (`model_validate` raises pydantic's `ValidationError`). Subclasses
    document each field with a docstring on the line after it; `neurosim run --print-config` prints these as
    comments.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        validate_default=True,
    )

    def __init__(self, **values: Any) -> None:
        """Check the values of one group.

        Raises:
            ConfigError: A key is unknown, or a value is of the wrong type or out of range.
        """
        try:
            super().__init__(**values)
        except ValidationError as error:
            from neurosim_core.config_errors import describe_errors, explain

            lines = explain(type(self), error)
            raise ConfigError(describe_errors(type(self).__name__, lines, {}, {})) from None

    # As of pydantic's own: groups within a group are checked without it, and errors keep their place.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    @model_validator(mode="before")
    @classmethod
    def _truth_is_no_number(cls, given: Any) -> Any:
        """Refuse true and false where numbers are wanted: pydantic takes them as 1 and 0."""
        errors = [
            InitErrorDetails(type=_NO_NUMBER, loc=(key,), input=value)
            for key, value in (given.items() if isinstance(given, Mapping) else ())
            if any(isinstance(item, bool) for item in (value if isinstance(value, list | tuple) else [value]))
            and key in cls.model_fields
            and _is_number(cls.model_fields[key].annotation)
        ]
        if errors:
            raise ValidationError.from_exception_data(cls.__name__, errors)
        return given


def _is_number(annotation: Any) -> bool:
    """Return whether numbers may be there, and no truth values."""
    parts = [*_parts(annotation)]
    truth = any(part is bool or part is Any or isinstance(part, bool) for part in parts)
    return not truth and any(part is int or part is float for part in parts)


def _parts(annotation: Any) -> Iterator[Any]:
    """Yield the types that an annotation is made of; of a literal its values."""
    yield annotation
    for part in get_args(annotation):
        yield from _parts(part)


class OfKind:
    """Settings of any kind of a category: `Annotated[SensorConfig, OfKind("sensor")]`.

    Which class they are of is looked up when they are read: only kinds that are in use are imported.
    """

    def __init__(self, category: str, *, default: str | None = None) -> None:
        """Say which settings.

        Args:
            category: A table of the registry.
            default: The kind where none is said; then a name alone is a kind, too.
        """
        self.category = category
        self._default = default

    def choices(self) -> list[type[BaseModel]]:
        """Return the classes of all kinds."""
        return [*kinds(self.category).values()]

    def __get_pydantic_core_schema__(self, base: type[BaseModel], _: GetCoreSchemaHandler) -> CoreSchema:
        """Return how to read them; errors are those of a union that is discriminated by `kind`."""

        def validate(value: Any) -> BaseModel:
            if isinstance(value, base):
                return value
            if isinstance(value, str) and self._default is not None:
                value = {"kind": value}
            if not isinstance(value, Mapping):
                raise PydanticKnownError("model_attributes_type")
            kind = value.get("kind", self._default)
            if kind is None:
                raise PydanticKnownError("union_tag_not_found", {"discriminator": "'kind'"})
            try:
                settings: type[BaseModel] = find(self.category, kind)
            except (ValueError, TypeError):  # unknown; no name
                known = ", ".join(map(repr, kinds(self.category)))
                context = {"discriminator": "'kind'", "tag": str(kind), "expected_tags": known}
                raise PydanticKnownError("union_tag_invalid", context) from None
            choice = core_schema.tagged_union_schema({kind: settings.__pydantic_core_schema__}, "kind")
            read: BaseModel = SchemaValidator(choice).validate_python({"kind": kind, **value})
            return read

        return core_schema.no_info_plain_validator_function(validate)


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
    kind = {"kind": given["kind"]} if "kind" in given else {}
    return merge({**presets[name], **kind}, given)
