"""YAML files as they are written: tables, and settings with keys that win over them. Nothing is checked."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import yaml


class ConfigError(ValueError):
    """A settings file or dict is wrong; the message names each key, its value and what is allowed."""


def read_file(path: Path) -> dict[str, Any]:
    """Return the keys and values of a YAML file.

    Raises:
        ConfigError: It cannot be read, or is not YAML.
    """
    import yaml  # processes that read no files do without it: 0.01 s

    try:
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError:
        raise ConfigError(
            f"{path} is binary, no settings; a mesh is given by --scene {path}, or in settings: "
            f"scene: {{kind: mesh, file: {path}}}"
        ) from None
    except FileNotFoundError:
        if path.suffix.lower() not in ("", ".yaml", ".yml"):
            raise ConfigError(
                f"{path}: no such file; settings are YAML, in which a mesh is "
                f"scene: {{kind: mesh, file: {path.name}}}, "
                f"or say --scene {path}"
            ) from None
        raise ConfigError(
            f"no settings file {path}: `neurosim run --print-config > {path}` makes one"
        ) from None
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path} is not YAML: {_in_one_line(error)}") from error
    if raw is None:
        return {}
    if not isinstance(raw, dict):
        raise ConfigError(f"{path} must hold a mapping of keys to values, got a {type(raw).__name__}")
    return raw


@functools.cache
def read_table(module_file: str, name: str) -> dict[str, Any]:
    """Return the table `name`.yaml beside a module, whose `__file__` is given."""
    import yaml

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # PyYAML may be built without libyaml
    table: dict[str, Any] = yaml.load(Path(module_file).with_name(f"{name}.yaml").read_bytes(), loader)
    return table


def nest(key: str, value: Any) -> dict[str, Any]:
    """Return {"a": {"b": value}} for the key "a.b"."""
    nested = value
    for part in reversed(key.split(".")):
        nested = {part: nested}
    return dict(nested)


def nested(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the groups that dotted keys make together."""
    return functools.reduce(merge, (nest(key, value) for key, value in settings.items()), {})


def merge(base: Mapping[str, Any], patch: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with the keys of `patch`; a group of another kind replaces the one it meets."""
    if "kind" in patch and patch["kind"] != base.get("kind"):
        return dict(patch)
    merged = dict(base)
    for key, value in patch.items():
        old = merged.get(key)
        merged[key] = merge(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return merged


def beside(raw: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Make relative files of scene, bodies and lenses absolute, as poses, from the settings file's folder."""
    places: list[tuple[str, ...]] = [("scene",), ("path",)]
    bodies = raw.get("bodies")
    for name in bodies if isinstance(bodies, Mapping) else ():
        places += [("bodies", name, "shape"), ("bodies", name, "surface")]
    sensors = raw.get("sensors")
    for name in sensors if isinstance(sensors, Mapping) else ():
        places += [("sensors", name, "lens"), ("sensors", name, "pixel", "measured_noise")]
    for place in places:
        group: Any = raw
        for key in place:
            group = group.get(key) if isinstance(group, Mapping) else None
        file = group.get("file") if isinstance(group, Mapping) else None
        if isinstance(file, str) and not Path(file).expanduser().is_absolute():
            raw = merge(raw, nest(".".join((*place, "file")), str(folder / file)))
    return raw


def unchecked_settings(source: Path | None, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a file and the keys that win over it say; arguments as for `load_config`.

    Raises:
        ConfigError: The file cannot be read, or is not YAML.
    """
    raw = {} if source is None else read_file(source)
    raw = functools.reduce(merge, (nest(key, value) for key, value in overrides.items()), raw)
    return raw if source is None else beside(raw, source.resolve().parent)


def _in_one_line(error: yaml.YAMLError) -> str:
    """Return where YAML ends to be YAML, and what to look for."""
    import yaml

    if not isinstance(error, yaml.MarkedYAMLError) or error.problem_mark is None:
        return " ".join(str(error).split())
    mark = error.problem_mark
    tab = "; indent with spaces" if "'\\t'" in str(error.problem) else ""
    return f"line {mark.line + 1}, column {mark.column + 1}: {error.problem}{tab}"
