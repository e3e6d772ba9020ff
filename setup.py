"""What pyproject.toml cannot say: the one module in C, left out where it cannot be compiled."""

import sys

import numpy
from setuptools import Extension, setup

setup(
    ext_modules=[
        Extension(
            "cortex._native",
            ["cortex/_construct.c", "cortex/_native.c", "cortex/_ring.c", "cortex/_socket.c"],
            depends=["cortex/_native.h", "cortex/_ring.h"],
            libraries=["dl"] if sys.platform == "linux" else [],
            include_dirs=[numpy.get_include()],
            optional=True,
        ),
    ]
)
