"""What pyproject.toml cannot say: the module in C, left out without a compiler or without a GIL."""

import sys
import sysconfig

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
    if not sysconfig.get_config_var("Py_GIL_DISABLED")
    else []
)
