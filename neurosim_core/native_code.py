"""Native code of kernels: C++ and CUDA in `native/*.cuh` files beside the modules that use it.

A file holds the body of one function, whose parameters its Python declaration names (`wp.func_native`). The
text is part of Warp's hash of a module: a changed file is compiled anew.
"""

from __future__ import annotations

import re
from pathlib import Path

_INCLUDE = re.compile(r'^#include "([^"]+)"$', re.MULTILINE)


def read_native(module_file: str, name: str, **constants: bool | int) -> str:
    """Return the body of a native function.

    `module_file`: `__file__` of the module that declares the function. `name`: name of the file in `native/`
    beside it, without `.cuh`. A line `#include "other.cuh"` stands for the text of another file of that
    folder. `constants`: compile-time constants that the body uses, declared before it.
    """
    folder = Path(module_file).parent / "native"

    def text_of(file: str) -> str:
        return _INCLUDE.sub(lambda found: text_of(found[1]), (folder / file).read_text(encoding="utf-8"))

    declared = (
        f"constexpr {'bool' if isinstance(value, bool) else 'int'} {key} = {str(value).lower()};\n"
        for key, value in constants.items()
    )
    return "\n" + "".join(declared) + text_of(f"{name}.cuh")
