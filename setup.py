"""What pyproject.toml cannot say: the module in C, left out without a compiler or without a GIL."""

import sys
import sysconfig

import numpy
from setuptools import Extension, setup

SUBJECTS = [
    "body",
    "broadcast",
    "coder",
    "construct",
    "fast_send",
    "fast_receive",
    "native",
    "ring_reader",
    "socket",
]
HEADERS = ("broadcast", "coder", "native", "numpy")

setup(
    ext_modules=[
        Extension(
            "cortex._native",
            [f"cortex/_{name}.c" for name in SUBJECTS],
            depends=[
                *(f"cortex/_{name}.h" for name in HEADERS),
                *(
                    f"cortex/cpp/include/cortex/{name}.h"
                    for name in (
                        "body",
                        "body_walk",
                        "broadcast",
                        "broadcast_os",
                        "broadcast_reader",
                        "broadcast_slots",
                    )
                ),
            ],
            libraries=["dl"] if sys.platform == "linux" else [],
            include_dirs=[numpy.get_include()],
            optional=True,
        ),
    ]
    if not sysconfig.get_config_var("Py_GIL_DISABLED")
    else []
)
