"""Unknown arguments are answered with the one that is most like them."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import ParamSpec

from neurosim_core.config_errors import suggestion

_P = ParamSpec("_P")


def names_arguments(init: Callable[_P, None]) -> Callable[_P, None]:
    """Decorate an `__init__` to refuse unknown arguments in this way."""
    known = list(inspect.signature(init).parameters)[1:]

    @functools.wraps(init)
    def checked(*args: _P.args, **options: _P.kwargs) -> None:
        for argument in options:
            if argument not in known:
                name, hint = type(args[0]).__name__, suggestion(argument, known)
                raise TypeError(f"{name} has no argument {argument!r}; {hint}known: {', '.join(known)}")
        init(*args, **options)

    return checked
