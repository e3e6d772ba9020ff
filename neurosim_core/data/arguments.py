"""Unknown arguments are answered with the one that is most like them."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import ParamSpec

from neurosim_core.config_errors import suggestion

_P = ParamSpec("_P")


def refuse_unknown(name: str, given: Iterable[str], known: list[str]) -> None:
    """Refuse names of arguments that are not known."""
    for argument in given:
        if argument not in known:
            hint = suggestion(argument, known)
            raise TypeError(f"{name} has no argument {argument!r}; {hint}known: {', '.join(known)}")


def names_arguments(init: Callable[_P, None]) -> Callable[_P, None]:
    """Decorate an `__init__` to refuse unknown arguments in this way."""
    known = list(inspect.signature(init).parameters)[1:]

    @functools.wraps(init)
    def checked(*args: _P.args, **options: _P.kwargs) -> None:
        refuse_unknown(type(args[0]).__name__, options, known)
        init(*args, **options)

    return checked
