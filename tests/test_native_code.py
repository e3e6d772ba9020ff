"""Native code in files: includes, constants, and kernels that follow a change of the text."""

from __future__ import annotations

import warp as wp

from neurosim_core.native_code import read_native


def test_a_kernel_follows_the_text_of_its_native_code(tmp_path, device):
    """The value comes through an include; a changed file gives a changed kernel, not one from the cache."""
    module_file, folder = str(tmp_path / "module.py"), tmp_path / "native"
    folder.mkdir()
    (folder / "value.cuh").write_text('#include "part.cuh"\nreturn FLIP ? -(part + ADDED) : part + ADDED;\n')

    def evaluate(part: int, **constants: bool | int) -> int:
        (folder / "part.cuh").write_text(f"const int part = {part};\n")

        @wp.func_native(read_native(module_file, "value", **constants))
        def value() -> int: ...

        @wp.kernel(module="unique", enable_backward=False)
        def write(out: wp.array[int]) -> None:
            out[0] = value()

        out = wp.zeros(1, dtype=int, device=device)
        wp.launch(write, dim=1, outputs=[out], device=device)
        return int(out.numpy()[0])

    assert evaluate(2, ADDED=40, FLIP=False) == 42
    assert evaluate(3, ADDED=40, FLIP=False) == 43
    assert evaluate(3, ADDED=40, FLIP=True) == -43
