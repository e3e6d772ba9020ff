"""Pages of the site that are written from the code: settings, commands, Python names, messages, examples.

MkDocs loads this file as a hook.
"""

from __future__ import annotations

import argparse
import ast
import re
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from mkdocs.structure.files import File, Files
from pydantic import BaseModel

import neurosim_core as ns
from neurosim_core import cli
from neurosim_core.config import SimulationConfig
from neurosim_core.lazy import homes_of
from neurosim_core.settings import OfKind, documentation

ROOT = Path(__file__).resolve().parents[1]
BESIDE = ("cortex/README.md", "cortex/WIRE.md", "cortex_ros2_bridge/README.md")
BESIDE += ("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
"""Documents that do not lie in docs/."""
PACKETS = "neurosim_core.packets"


def on_files(files: Files, config: Any) -> Files:
    """Add what is written here, and the documents that lie beside their packages."""
    pages = {
        "reference/settings.md": settings_page(),
        "reference/commands.md": commands_page(),
        "reference/python.md": python_page(),
        "reference/messages.md": messages_page(),
        "examples.md": examples_page(),
    }
    for name in BESIDE:
        pages[name] = (ROOT / name).read_text(encoding="utf-8")
    for name, text in pages.items():
        if (known := files.get_file_from_path(name)) is not None:
            files.remove(known)
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn links between documents, which hold in the repository, into those between pages."""
    place = page.file.src_uri
    up = "../" * place.count("/")
    inside = place not in BESIDE

    def link(match: re.Match[str]) -> str:
        target = match[1]
        if "://" in target or target.startswith("#"):
            return match[0]
        path, _, anchor = target.partition("#")
        base = ROOT / "docs" if inside else ROOT
        file = (base / place).parent.joinpath(path).resolve()
        if not file.is_relative_to(ROOT) or not file.exists():
            return match[0]
        name = file.relative_to(ROOT).as_posix()
        anchor = f"#{anchor}" if anchor else ""
        if name.startswith("examples/") and file.suffix == ".py":
            return f"]({up}examples.md#{file.stem})"
        if name.startswith("docs/") or name in BESIDE:
            return f"]({up}{name.removeprefix('docs/')}{anchor})"
        return match[0]

    return re.sub(r"\]\(([^)\s]+)\)", link, markdown)


def settings_page() -> str:
    """All groups of settings, from the models that check them."""
    lines = [
        "# Settings",
        "",
        "`neurosim run --print-config` prints the defaults as YAML with these remarks; "
        "`--set KEY=VALUE` sets one of them. Lengths are metres, angles radians.",
    ]
    waiting: list[tuple[str, type[BaseModel]]] = [("", SimulationConfig)]
    seen: set[type[BaseModel]] = {SimulationConfig}
    while waiting:
        place, model = waiting.pop(0)
        kind = model.model_fields.get("kind")
        title = f"`{place}`" if place else "The file"
        title += f", kind `{kind.default}`" if kind is not None and place else ""
        about = (model.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ")
        lines += ["", f"## {title}", "", " ".join(about.split()), ""]
        lines += ["| key | default | |", "| --- | --- | --- |"]
        for name, field in model.model_fields.items():
            if name == "kind":
                continue
            inner = [m for m in models_of(field.rebuild_annotation()) if m not in seen]
            named = get_origin(field.annotation) is dict
            for choice in inner:
                seen.add(choice)
                waiting.append((".".join(filter(None, (place, name, "NAME" if named else ""))), choice))
            meaning = " ".join(documentation(model).get(name, "").split())
            lines.append(f"| `{name}` | {default_of(field)} | {cell(meaning)} |")
    return "\n".join(lines) + "\n"


def models_of(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the groups that a value may be or hold."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    elif get_origin(annotation) is Annotated:
        kinds = [mark for mark in get_args(annotation)[1:] if isinstance(mark, OfKind)]
        for choice in kinds[0].choices() if kinds else get_args(annotation)[:1]:
            yield from models_of(choice)
    elif get_origin(annotation) in (Union, types.UnionType, dict, tuple, list):
        for part in get_args(annotation):
            yield from models_of(part)


def default_of(field: Any) -> str:
    """Return the default as it is written in YAML, with the choices where there are some."""
    if field.is_required():
        text = "required"
    else:
        value = field.get_default(call_default_factory=True)
        if isinstance(value, BaseModel):
            kind = getattr(value, "kind", "")
            return f"`{{kind: {kind}}}`" if kind else "see below"
        if isinstance(value, dict):
            return f"`{{{', '.join(value)}}}`"
        named = {None: "null", True: "true", False: "false"}
        text = f"`{named[value] if value is None or isinstance(value, bool) else value}`"
    if get_origin(field.annotation) is Literal:
        text += " of " + ", ".join(f"`{choice}`" for choice in get_args(field.annotation))
    return cell(text)


def cell(text: str) -> str:
    """Return text for a cell of a table."""
    return text.replace("|", "\\|").replace("<", "&lt;")


def commands_page() -> str:
    """What `--help` says, of all commands."""
    lines = ["# Commands", "", "| | |", "| --- | --- |"]
    sections: list[str] = []

    def add(parser: argparse.ArgumentParser, depth: int) -> None:
        for action in parser._actions:
            if not isinstance(action, argparse._SubParsersAction):
                continue
            helps = {item.dest: item.help for item in action._choices_actions}
            for name, child in action.choices.items():
                if depth == 2:
                    lines.append(f"| [`{child.prog}`](#{child.prog.replace(' ', '-')}) | {helps[name]} |")
                text = child.format_help()
                sections.extend(["", f"{'#' * depth} {child.prog}", "", f"{helps.get(name) or ''}", ""])
                sections.extend(["```text", text.rstrip(), "```"])
                add(child, depth + 1)

    add(cli._parser(), 2)
    return "\n".join(lines + sections) + "\n"


def python_page() -> str:
    """The names of `import neurosim_core as ns`, from their docstrings."""
    lines = ["# Python", "", "`import neurosim_core as ns` offers these names; nothing else is public."]
    lines += names_of(ns)
    lines += ["", "## ns.data", "", "Windows of events with ground truth: [data sets](../data.md)."]
    lines += names_of(ns.data)
    lines += ["", "## ns.sensors", "", "What [sensors of your own](../tutorials/own-sensor.md) are made of."]
    lines += names_of(ns.sensors)
    lines += ["", "## ns.control and ns.sinks", ""]
    lines += ["What [controllers and sinks of your own](../simulator.md) are made of."]
    for package in (ns.control, ns.sinks):
        home = package.__name__
        for name, value in vars(package).items():
            if isinstance(value, type) and value.__module__.startswith(home) and name[0] != "_":
                lines += entry(f"{value.__module__}.{name}", f"{home.replace('neurosim_core', 'ns')}.{name}")
    return "\n".join(lines) + "\n"


def names_of(package: types.ModuleType) -> list[str]:
    """Return the lines for all names of a package, but for packets, which have a page of their own."""
    short = package.__name__.replace("neurosim_core", "ns", 1)
    homes = homes_of(str(package.__file__)).items()
    shown = [(name, home) for name, (home, _) in homes if home not in (package.__name__, PACKETS)]
    return [line for name, home in shown for line in entry(f"{home}.{name}", f"{short}.{name}")]


def entry(place: str, heading: str) -> list[str]:
    """Return the lines that bring the documentation of a name."""
    return ["", f"::: {place}", "    options:", f"      heading: {heading}"]


def messages_page() -> str:
    """The message types of Cortex."""
    lines = ["# Messages", "", "What travels over [Cortex](../cortex/README.md); `cortex info TOPIC` prints"]
    lines += ["the structure of one that is in use.", ""]
    for file in sorted((ROOT / "cortex" / "messages").glob("[!_]*.py")):
        lines += [f"::: cortex.messages.{file.stem}", "    options:", "      show_root_toc_entry: false", ""]
    return "\n".join(lines) + "\n"


def examples_page() -> str:
    """All files of examples/, each with what it says of itself."""
    lines = [
        "# Examples",
        "",
        "Each runs as it is: `python examples/NAME.py`. Tests run them, and check the number",
    ]
    lines += ["that they end on.", ""]
    for file in sorted((ROOT / "examples").glob("*.py")):
        source = file.read_text(encoding="utf-8")
        about = (ast.get_docstring(ast.parse(source)) or "").split("\n\n")[0].replace("\n", " ")
        lines += [
            f"## {file.stem} {{ #{file.stem} }}",
            "",
            about,
            "",
            "```python",
            source.rstrip(),
            "```",
            "",
        ]
    return "\n".join(lines)
