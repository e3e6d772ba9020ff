# mypy: disable-error-code="no-untyped-def,empty-body,valid-type"
"""Rays on the CPU by Embree, which casts packets of rays ten times faster than Warp casts single ones.

Kernels call the shared library that the package `embreex` carries through the address of its function: no
Python per ray, no copies. Embree's robust mode: no ray slips through an edge that two triangles share. The
rays of antialiasing do without it: of a first ray any face nearby will do, and the others are one of many.
"""

# No `from __future__ import annotations`: Warp needs the annotations of functions in closures as objects.

import ctypes
import importlib.metadata
import weakref
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.native_code import read_native
from neurosim_core.render.kernel_data import Hit

PACKET = 16
"""Rays that a kernel casts together."""

# rtcore.h of Embree 4
_TRIANGLES = 0
_INDICES, _VERTICES = 0, 1
_UINT3, _FLOAT3 = 0x5003, 0x9003
_ROBUST = 4
_NATIVE_WIDTH = {16: 34, 8: 33, 4: 32}  # rays per native packet: device property


class EmbreeError(RuntimeError):
    """Embree cannot be used here."""


class _Library:
    """Embree's shared library and the device of this process."""

    def __init__(self) -> None:
        try:
            files = importlib.metadata.files("embreex") or []
        except importlib.metadata.PackageNotFoundError:
            raise EmbreeError("the package embreex is not installed (pip install embreex)") from None
        paths = [str(f.locate()) for f in files if f.name.startswith(("libembree4", "embree4"))]
        if not paths:
            raise EmbreeError("the installed package embreex carries no Embree 4 (pip install -U embreex)")
        try:
            self._functions = ctypes.CDLL(paths[0])
        except OSError as error:
            raise EmbreeError(f"{paths[0]} cannot be loaded: {error}") from None
        # One thread: built by several, a leaf may hold its triangles in another order each time.
        self.device = self.call("rtcNewDevice", b"threads=1,set_affinity=0")
        self.check()
        widths = [
            w for w, key in _NATIVE_WIDTH.items() if self.call("rtcGetDeviceProperty", self.device, key)
        ]
        if not widths:
            raise EmbreeError("Embree was built without packets of rays")
        self.width = widths[0]

    def call(self, name: str, *arguments: bytes | int | None) -> int:
        """Call a function whose parameters are pointers, integers and sizes: all fit a pointer."""
        function = getattr(self._functions, name)
        function.restype = ctypes.c_void_p
        return function(*(ctypes.c_void_p(x) if isinstance(x, int) else x for x in arguments)) or 0

    def address(self, name: str) -> int:
        """Return where a function is."""
        return ctypes.cast(getattr(self._functions, name), ctypes.c_void_p).value or 0

    def check(self) -> None:
        """Raise the first error since the last check."""
        error = self.call("rtcGetDeviceError", self.device)
        if error:
            raise EmbreeError(f"Embree failed with error {error} of rtcore_device.h")


@cache
def _library() -> _Library:
    return _Library()


def packet_width() -> int:
    """Return how many rays this processor casts at once: 4, 8 or 16.

    Raises:
        EmbreeError: Embree cannot be used here; says why.
    """
    return _library().width


class EmbreeTree:
    """The triangles of a scene, ready for rays. Its memory is freed with the object.

    Attributes:
        scene: Address of the tree, for kernels.
        quick: Address of one that rays pass a quarter faster, but some through an edge that two triangles
            share; 0 if it was not asked for.
        intersect: Address of the function that casts a packet, for kernels.
        intersect_one: Address of the function that casts a ray, for `embree_distance`.
    """

    def __init__(
        self, vertices: NDArray[np.float32], faces: NDArray[np.int32], *, quick: bool = False
    ) -> None:
        """Build the tree, and `quick` if asked; vertices [m], shape [V, 3], and faces, [F, 3], are copied.

        Raises:
            EmbreeError: Embree cannot be used here, or is out of memory.
        """
        library = _library()
        call = library.call
        self.intersect = library.address(f"rtcIntersect{library.width}")
        self.intersect_one = library.address("rtcIntersect1")
        geometry = call("rtcNewGeometry", library.device, _TRIANGLES)
        for kind, form, rows in (
            (_VERTICES, _FLOAT3, vertices.astype(np.float32, order="C")),
            (_INDICES, _UINT3, faces.astype(np.uint32, order="C")),
        ):
            buffer = call("rtcSetNewGeometryBuffer", geometry, kind, 0, form, 12, len(rows))
            if buffer:
                ctypes.memmove(buffer, rows.ctypes.data, rows.nbytes)
        call("rtcCommitGeometry", geometry)
        self.scene = self._build(geometry, _ROBUST)
        self.quick = self._build(geometry, 0) if quick else 0
        call("rtcReleaseGeometry", geometry)
        library.check()

    def _build(self, geometry: int, flags: int) -> int:
        call = _library().call
        scene = call("rtcNewScene", _library().device)
        weakref.finalize(self, call, "rtcReleaseScene", scene)
        call("rtcSetSceneFlags", scene, flags)
        call("rtcAttachGeometry", scene, geometry)
        call("rtcCommitScene", scene)
        return scene


@wp.func_native(read_native(__file__, "embree_ray"))
def embree_distance(
    intersect: wp.uint64, scene: wp.uint64, origin: wp.vec3, ray: wp.vec3, far_m: float
) -> float:
    """Return the distance to the nearest triangle along a unit ray [m], or `far_m`; on a CPU only."""
    ...


@cache
def packet_caster(width: int) -> Any:
    """Return the Warp function, for CPU kernels only, that casts 16 rays.

    Its parameters: `EmbreeTree.intersect` and `.scene`; the origin of each ray [16]; rays [16], unit length,
    of which those of zero length are not cast; the distance beyond which hits do not count [m]. It writes
    their hits [16], with normals of any length.

    The last bits of a hit may depend on the other rays of its packet.
    """

    @wp.func_native(read_native(__file__, "cast_rays", WIDTH=width))
    def cast_packet(
        intersect: wp.uint64,
        scene: wp.uint64,
        origins: wp.array[wp.vec3],
        rays: wp.array[wp.vec3],
        far_m: float,
        hit_out: wp.array[Hit],
    ): ...

    return cast_packet
