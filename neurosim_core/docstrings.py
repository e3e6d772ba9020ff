"""Docstrings of fields: the texts on the lines after them, which Python does not keep."""

from __future__ import annotations

import ast
import functools
import inspect
import itertools
import sys


def field_docs(cls: type) -> dict[str, str]:
    """Return the docstrings on the lines after the fields of a class; none if its source is not there."""
    docs: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if base.__module__.partition(".")[0] in ("builtins", "pydantic"):
            continue
        try:
            node = _class_nodes(inspect.getsource(sys.modules[base.__module__])).get(base.__qualname__)
        except (KeyError, OSError, TypeError, SyntaxError):
            continue
        body = [] if node is None else node.body
        for field, text in itertools.pairwise([*body, None]):
            if isinstance(field, ast.AnnAssign):
                docs.pop(ast.unparse(field.target), None)  # what it was in a base may not hold
                if isinstance(text, ast.Expr):
                    docs[ast.unparse(field.target)] = inspect.cleandoc(str(ast.literal_eval(text.value)))
    return docs


@functools.cache
def _class_nodes(source: str) -> dict[str, ast.ClassDef]:
    """Return the classes of a module by qualified name; `inspect` would parse the module for each of them."""
    found: dict[str, ast.ClassDef] = {}
    todo: list[tuple[ast.AST, str]] = [(ast.parse(source), "")]
    while todo:
        parent, prefix = todo.pop()
        for node in ast.iter_child_nodes(parent):
            inner = prefix
            if isinstance(node, ast.ClassDef):
                found[prefix + node.name] = node
                inner = f"{prefix}{node.name}."
            elif isinstance(node, ast.FunctionDef):
                inner = f"{prefix}{node.name}.<locals>."
            if isinstance(node, ast.stmt):
                todo.append((node, inner))
    return found
