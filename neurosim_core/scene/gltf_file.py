"""The container of glTF 2.0: JSON and binary chunks, buffers and accessors of a .gltf or .glb file.

Reference: Khronos glTF 2.0 specification, sections 3.6 (binary data storage) and 4 (GLB).
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.source import SceneError

_COMPONENT = {
    5120: np.int8,
    5121: np.uint8,
    5122: np.int16,
    5123: np.uint16,
    5125: np.uint32,
    5126: np.float32,
}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
UNREADABLE = {
    "KHR_draco_mesh_compression": "compressed geometry",
    "EXT_meshopt_compression": "compressed geometry",
    "KHR_texture_basisu": "compressed textures",
}
"""Required extensions that are refused, and what they bring."""


class GltfFile:
    """An open glTF file."""

    def __init__(self, path: Path) -> None:
        """Read a file.

        Raises:
            SceneError: If it is truncated, no glTF 2, or needs an extension that is not read.
        """
        self.path = path
        self.tree, self.binary = self._split(path.read_bytes())
        version = str(self.tree.get("asset", {}).get("version", "2.0"))
        if not version.startswith("2"):
            raise SceneError(f"{path}: glTF version {version}, only 2.x is read")
        for name in self.tree.get("extensionsRequired", []):
            if name in UNREADABLE:
                raise SceneError(
                    f"{path}: needs {name} ({UNREADABLE[name]}), which is not read; "
                    "export it again without compression"
                )

    def _split(self, data: bytes) -> tuple[dict[str, Any], bytes]:
        if data[:4] != b"glTF":
            if self.path.suffix.lower() == ".glb":
                raise SceneError(f"{self.path}: not a GLB file, it does not start with 'glTF'")
            return self._parse(data), b""
        if len(data) < 20:
            raise SceneError(f"{self.path}: truncated, only {len(data)} bytes")
        length = struct.unpack_from("<I", data, 8)[0]
        if len(data) < length:
            raise SceneError(f"{self.path}: truncated, {len(data)} of {length} bytes are there")
        chunks: dict[int, bytes] = {}
        at = 12
        while at + 8 <= length:
            size, kind = struct.unpack_from("<II", data, at)
            if at + 8 + size > length:
                raise SceneError(f"{self.path}: truncated, a chunk of {size} bytes ends after the file")
            chunks.setdefault(kind, data[at + 8 : at + 8 + size])
            at += 8 + size
        if 0x4E4F534A not in chunks:
            raise SceneError(f"{self.path}: no JSON chunk, not a glTF 2.0 binary")
        return self._parse(chunks[0x4E4F534A]), chunks.get(0x004E4942, b"")

    def _parse(self, text: bytes) -> dict[str, Any]:
        try:
            tree = json.loads(text.decode("utf-8-sig"))
        except (UnicodeDecodeError, json.JSONDecodeError) as error:
            raise SceneError(f"{self.path}: not glTF, or truncated: {error}") from error
        if not isinstance(tree, dict) or "asset" not in tree:
            raise SceneError(f"{self.path}: not glTF, there is no 'asset' in its JSON")
        return tree

    def entry(self, kind: str, index: int) -> dict[str, Any]:
        """Return entry `index` of the top-level list `kind`."""
        entries = self.tree.get(kind, [])
        if not isinstance(entries, list) or not isinstance(index, int) or not 0 <= index < len(entries):
            raise SceneError(
                f"{self.path}: malformed glTF, it refers to number {index!r} of its {kind}, "
                f"of which there are {len(entries)}"
            )
        entry = entries[index]
        if not isinstance(entry, dict):
            raise SceneError(f"{self.path}: malformed glTF, number {index} of its {kind} is no JSON object")
        return entry

    def uri_bytes(self, uri: str) -> bytes | None:
        """Return the bytes behind a URI, None if there is no such file."""
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=False)
            except binascii.Error as error:
                raise SceneError(f"{self.path}: broken base64 in a data URI: {error}") from error
        file = self.path.parent / unquote(uri)
        return file.read_bytes() if file.is_file() else None

    @cached_property
    def _buffers(self) -> list[bytes]:
        buffers = []
        for index, buffer in enumerate(self.tree.get("buffers", [])):
            data = self.uri_bytes(buffer["uri"]) if "uri" in buffer else self.binary
            if data is None:
                raise SceneError(f"{self.path}: buffer file {buffer['uri']!r} is missing beside it")
            if len(data) < buffer["byteLength"]:
                raise SceneError(
                    f"{self.path}: truncated, buffer {index} has {len(data)} of {buffer['byteLength']} bytes"
                )
            buffers.append(data)
        return buffers

    def view(self, index: int) -> tuple[memoryview, int | None]:
        """Return the bytes of a buffer view, and its stride in bytes if it has one."""
        view = self.entry("bufferViews", index)
        start = view.get("byteOffset", 0)
        self.entry("buffers", view["buffer"])
        data = memoryview(self._buffers[view["buffer"]])[start : start + view["byteLength"]]
        if len(data) < view["byteLength"]:
            raise SceneError(f"{self.path}: truncated, buffer view {index} ends after its buffer")
        return data, view.get("byteStride")

    def _elements(self, view: int, offset: int, component: int, width: int, count: int) -> NDArray[Any]:
        data, stride = self.view(view)
        dtype = np.dtype(_COMPONENT[component]).newbyteorder("<")
        row = dtype.itemsize * width
        stride = stride or row
        if count and offset + (count - 1) * stride + row > len(data):
            raise SceneError(f"{self.path}: truncated, an accessor ends after buffer view {view}")
        values: NDArray[Any] = np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))
        return values

    def accessor(self, index: int) -> NDArray[Any]:
        """Return accessor `index`, shape [count, width]; normalised integers as floats."""
        accessor = self.entry("accessors", index)
        component, width, count = accessor["componentType"], _WIDTH[accessor["type"]], accessor["count"]
        if "bufferView" in accessor:
            values = self._elements(
                accessor["bufferView"], accessor.get("byteOffset", 0), component, width, count
            )
        else:
            values = np.zeros((count, width), _COMPONENT[component])
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            where, what = sparse["indices"], sparse["values"]
            values = values.copy()
            rows = self._elements(
                where["bufferView"], where.get("byteOffset", 0), where["componentType"], 1, sparse["count"]
            )
            values[rows[:, 0]] = self._elements(
                what["bufferView"], what.get("byteOffset", 0), component, width, sparse["count"]
            )
        if accessor.get("normalized", False) and np.issubdtype(values.dtype, np.integer):
            return np.asarray(np.maximum(values / np.float64(np.iinfo(values.dtype).max), -1.0))
        return values
