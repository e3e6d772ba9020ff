"""Errors in settings, in the words of those who write them: keys and values as they are in YAML."""

from __future__ import annotations

import difflib
import math
import types
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from neurosim_core.settings import OfKind

_GROUP = frozenset({"model_type", "model_attributes_type", "dict_type", "dataclass_type"})
_LIST = frozenset({"tuple_type", "list_type"})
_OTHER_TYPE = _LIST | {"missing", "too_long", "too_short"}
"""Errors of a value that is of none of several types, besides `..._type` and `..._parsing`."""
_SHOWN_MAX = 80


def explain(model: type[BaseModel], error: ValidationError) -> list[str]:
    """Return one line for each error: path of the key, what is allowed, and the value."""
    items: list[Mapping[str, Any]] = [*error.errors()]
    # a list of which an item is wrong is also said to be too short, and one that is too short to lack items
    items = list(_of_choices(model, items))
    inner = {item["loc"][:k] for item in items for k in range(len(item["loc"]))}
    lines = [
        _line(model, item) for item in items if not (item["type"] == "too_short" and item["loc"] in inner)
    ]
    return list(dict.fromkeys(lines))


def suggestion(wrong: str, known: list[str]) -> str:
    """Return "did you mean ...? " for a key that is not known; nothing if none is like it."""
    close = difflib.get_close_matches(wrong, known, n=1) or [
        key for key in known if key.startswith(wrong) or wrong.startswith(key)
    ]
    return f"did you mean {close[0]!r}? " if close else ""


def describe_errors(
    origin: str, errors: list[str], options: Mapping[str, str], given: Mapping[str, Any]
) -> str:
    """Return the text of an error: each error by the name that the user gave its key.

    `errors`: lines that begin with a dotted key. `options`: names of keys that were given otherwise. `given`:
    what is in the settings without these.
    """
    lines = dict.fromkeys(_by_option(line, options, given) for line in errors)
    elsewhere = any(line in errors for line in lines)
    if not elsewhere and len(lines) == 1:
        return next(iter(lines))
    head = f"{origin} is not a valid configuration:" if elsewhere else "wrong options:"
    return "\n".join([head, *(f"  {line}" for line in lines)])


def _by_option(line: str, options: Mapping[str, str], given: Mapping[str, Any]) -> str:
    """Name the option in place of its key; a key within it, or in a group that it made, is said as well."""
    key, separator, reason = line.partition(": ")
    for place in sorted(options, key=len, reverse=True):
        if key == place:
            return f"{options[place]}{separator}{reason}"
        if key.startswith(f"{place}."):
            return f"{options[place]}: {line}"
    for group in (key, key.rpartition(".")[0]):
        makers = [place for place in options if group and place.startswith(f"{group}.")]
        if makers and not _holds(given, key) and (f"{group}.kind" in makers or not _holds(given, group)):
            return f"{options[makers[0]]}: {line}"
    return line


def _holds(raw: Mapping[str, Any], key: str) -> bool:
    """Return whether settings have a value at a dotted key."""
    value: Any = raw
    for part in key.split("."):
        if not isinstance(value, Mapping) or part not in value:
            return False
        value = value[part]
    return True


def _of_choices(model: type[BaseModel], items: list[Mapping[str, Any]]) -> Iterator[Mapping[str, Any]]:
    """Join the errors of a value that may be of several types, such as a number or a list of three.

    Each type has its own errors: those of the type that the value is of remain, else one of them all.
    """
    seen: set[tuple[int | str, ...]] = set()
    for item in items:
        place = _choice(model, item["loc"])
        if place is None:
            yield item
        elif place not in seen:
            seen.add(place)
            own = [other for other in items if other["loc"][: len(place)] == place]
            inner = [
                other
                for other in own
                if not (other["type"] in _OTHER_TYPE or other["type"].endswith(("_type", "_parsing")))
            ]
            for other in inner:
                yield {**other, "loc": place + other["loc"][len(place) + 1 :]}
            if not inner:
                yield {"type": "choice", "loc": place, "input": own[0]["input"]}


def _choice(model: type[BaseModel], loc: tuple[int | str, ...]) -> tuple[int | str, ...] | None:
    """Return the place of a value that may be of several types, none a group, above that of an error."""
    for size in range(1, len(loc)):
        annotation = _follow(model, loc[:size])[0]
        choices = [choice for choice in _alternatives(annotation) if choice is not type(None)]
        if len(choices) > 1 and not any(map(_is_model, choices)) and isinstance(loc[size], str):
            return loc[:size]
    return None


def _line(model: type[BaseModel], item: Mapping[str, Any]) -> str:
    kind, loc, value = item["type"], item["loc"], item["input"]
    if kind == "missing" and isinstance(loc[-1], int):  # of a list of so many numbers
        loc, kind = loc[:-1], "tuple_type"
    annotation, keys = _follow(model, loc)
    shown = ".".join(keys)
    if kind == "extra_forbidden":
        owner = _model_of(_follow(model, loc[:-1])[0])
        known = sorted(owner.model_fields) if owner else []
        hint = suggestion(str(loc[-1]), known) or _deeper(owner, str(loc[-1]))
        return f"{shown}: unknown key; {hint}known: {', '.join(known)}"
    if kind == "invalid_key":
        return _unreadable_key(_follow(model, loc[:-1]), value)
    if kind == "missing":
        return f"{shown}: required, and not given"
    if kind == "union_tag_not_found":
        sensor = loc[0] == "sensors" and len(loc) == 2
        hint = f" (there is no sensor {loc[1]!r}; a kind makes one)" if sensor else ""
        return f"{shown}.kind: required, and not given{hint}"
    if kind == "union_tag_invalid":
        context = item["ctx"]
        own = "; one of your own is found once its module is imported, or installed as a plugin"
        hint = suggestion(
            str(context["tag"]), [tag.strip(" '") for tag in context["expected_tags"].split(",")]
        )
        hint = f"; {hint}".rstrip("; ") or (own if loc[0] == "sensors" else "")
        return f"{shown}.kind: must be one of {context['expected_tags']}, got {context['tag']!r}{hint}"
    if kind == "value_error":
        reason = item["msg"].removeprefix("Value error, ")
        return f"{shown}: {reason}" if shown else reason
    got = f", got {_shorten(value)}"
    if loc and loc[-1] == "[key]":
        return f"{'.'.join(keys[:-1])}: a name is a letter, then letters, digits and _{got}"
    if kind == "choice" or kind in _LIST or kind in _GROUP:
        return f"{shown}: must be {_wanted(annotation)}{got}"
    if kind == "too_short":
        least = item["ctx"]["min_length"]
        return f"{shown}: must have at least {least} item{'s' * (least > 1)}{got}"
    if kind == "path_type":
        return f"{shown}: must be the name of a file{got}"
    if shown.endswith("_rad") and isinstance(value, int | float) and kind.startswith("less_than"):
        got += f"; if these are degrees, write {math.radians(value):.6g}"
    if shown.endswith(("latency_s", "jitter_s")) and isinstance(value, int | float):
        got += (
            f"; if these are milliseconds, write {1e-3 * value:.6g}" if kind.startswith("less_than") else ""
        )
    reason = item["msg"].partition(", unable to")[0].partition(", got")[0]
    return f"{shown}: {reason}{got}" if shown else f"{reason}{got}"


def _deeper(owner: type[BaseModel] | None, key: str) -> str:
    """Return "did you mean ...? " for a key that belongs one level deeper; nothing if it does not."""
    for name, field in owner.model_fields.items() if owner else ():
        groups = [choice for choice in _alternatives(field.rebuild_annotation()) if _is_model(choice)]
        if any(key in group.model_fields for group in groups):
            return f"did you mean '{name}.{key}'? "
    return ""


def _unreadable_key(found: tuple[Any, list[str]], key: Any) -> str:
    """Say what to do about a key that YAML does not read as text."""
    annotation, keys = found
    owner = _model_of(annotation)
    where = f"{'.'.join(keys)}: " if keys else ""
    known = f"; known: {', '.join(sorted(owner.model_fields))}" if owner else ""
    if isinstance(key, bool):
        words = "on, yes or true" if key else "off, no or false"
        return f"{where}a key is {words}, which YAML reads as {str(key).lower()}{known}"
    return f"{where}keys must be text, got {_shorten(key)}{known}"


def _shorten(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _SHOWN_MAX else text[: _SHOWN_MAX - 3] + "..."


def _follow(model: type[BaseModel], loc: tuple[int | str, ...]) -> tuple[Any, list[str]]:
    """Follow the place of an error; return the type that is wanted there and the keys as they were written.

    The type is None where there is none.
    """
    keys: list[str] = []
    annotation: Any = model
    for part in loc:
        members = [a for a in _alternatives(annotation) if _is_model(a)]
        tagged = [m for m in members if _tag(m) == part]
        # the tag of a discriminated union, which may have one choice only: not a key
        if tagged and (len(members) > 1 or part not in members[0].model_fields):
            annotation = tagged[0]
            continue
        keys.append(str(part))
        owner = members[0] if len(members) == 1 else None
        if owner is not None:
            field = owner.model_fields.get(str(part))
            annotation = None if field is None else field.rebuild_annotation()
        else:
            annotation = _item_type(annotation, part)
    return annotation, keys


def _item_type(annotation: Any, part: int | str) -> Any:
    """Return the type of an item of a dict or a list; None if it is neither."""
    for choice in _alternatives(annotation):
        arguments = get_args(choice)
        if get_origin(choice) is dict:
            return arguments[1]
        if get_origin(choice) is list or arguments[-1:] == (Ellipsis,):
            return arguments[0]
        if get_origin(choice) is tuple and isinstance(part, int) and part < len(arguments):
            return arguments[part]
    return None


def _alternatives(annotation: Any) -> Iterator[Any]:
    """Yield the types that a value may be of."""
    origin = get_origin(annotation)
    if origin is Annotated:
        kinds = [mark for mark in get_args(annotation)[1:] if isinstance(mark, OfKind)]
        for choice in kinds[0].choices() if kinds else get_args(annotation)[:1]:
            yield from _alternatives(choice)
    elif origin in (Union, types.UnionType):
        for choice in get_args(annotation):
            yield from _alternatives(choice)
    else:
        yield annotation


def _is_model(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _model_of(annotation: Any) -> type[BaseModel] | None:
    """Return the one group that a value may be; None if there is none, or several."""
    members = [choice for choice in _alternatives(annotation) if _is_model(choice)]
    return members[0] if len(members) == 1 else None


def _tag(model: type[BaseModel]) -> str | None:
    kind = model.model_fields.get("kind")
    return None if kind is None else kind.default


def _wanted(annotation: Any) -> str:
    """Say what a value must be, as it is written in YAML."""
    choices = [choice for choice in _alternatives(annotation) if choice is not type(None)]
    kinds = [_tag(choice) for choice in choices if _is_model(choice)]
    if len(kinds) > 1:
        return "keys with values, such as {kind: " + " or ".join(sorted(str(kind) for kind in kinds)) + "}"
    texts = dict.fromkeys(_described(choice) for choice in choices)
    null = ["null"] if type(None) in _alternatives(annotation) else []
    return ", or ".join([*texts, *null])


def _described(choice: Any) -> str:
    arguments = get_args(choice)
    if _is_model(choice):
        return f"keys with values, such as {_example(choice)}"
    if get_origin(choice) is dict:
        return "names with what they stand for, such as {name: ...}"
    if get_origin(choice) is tuple and arguments[-1:] != (Ellipsis,):
        some = ", ".join(str(k + 1) for k in range(len(arguments)))
        return f"a list of {len(arguments)} numbers, such as [{some}]"
    if get_origin(choice) in (tuple, list):
        (inner,) = (a for a in _alternatives(arguments[0]) if a is not type(None))
        if _is_model(inner):
            return f"a list, such as [{_example(inner)}]"
        size = len(get_args(inner))
        return f"a list of lists of {size} numbers" if get_origin(inner) is tuple else "a list of numbers"
    names = {float: "a number", int: "a whole number", str: "text", bool: "true or false"}
    return names.get(choice, str(getattr(choice, "__name__", "something else")))


def _example(model: type[BaseModel]) -> str:
    """Return the first keys of a group with their defaults."""
    shown = []
    for name, field in list(model.model_fields.items())[:2]:
        plain = isinstance(field.default, bool | int | float | str)
        number = f"{field.default:g}" if isinstance(field.default, float) else field.default
        shown.append(f"{name}: {number if plain else '...'}")
    return "{" + ", ".join(shown) + "}"
