"""Reads a scene in a process of its own, while the one that asks imports its libraries.

Both would hold Python's interpreter lock most of the time: threads take turns. So would those that decode
pictures with the one that cuts triangles: the process forks for pictures. It forks before it reads the scene:
afterwards the kernel would copy each shared page of memory that one of them writes to. Arrays come in a file
without a name, which is mapped into memory.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
import mmap
import os
import pickle
import signal
import tempfile
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any

from neurosim_core.runtime.child import begin_child, end_child, start_child
from neurosim_core.signals import end_with_parent

if TYPE_CHECKING:
    from neurosim_core.path_process import PlanningProcess
    from neurosim_core.scene.config import SceneConfig
    from neurosim_core.scene.scene import Scene

_SCENE, _REFINED, _PICTURES, _CONNECTIONS = range(4)
"""What the process answers."""
_ALIGNMENT = 64
_KEEP_MEMORY = {
    "MALLOC_ARENA_MAX": "1",
    "MALLOC_MMAP_THRESHOLD_": "4294967296",
    "MALLOC_TRIM_THRESHOLD_": "4294967296",
    "MALLOC_TOP_PAD_": "67108864",
}
"""Lets glibc use memory again that NumPy has freed: the kernel is asked for 40,000 pages, not 100,000."""


class NotReadError(Exception):
    """The process has not read the scene that is asked for; who loads it here is told what is wrong."""


class SceneReader:
    """A process that reads a scene. A context manager, which ends it."""

    def __init__(self, settings: Mapping[str, Any], *, planner: PlanningProcess | None = None) -> None:
        """Start the process.

        Args:
            settings: Unchecked; of them `scene` and `render` count. Relative files are looked up from the
                working directory.
            planner: Plans paths in the scene; None: they are planned by who asks for it.
        """
        self.planner = planner
        self._file = tempfile.TemporaryFile()  # noqa: SIM115  closed by `__exit__`
        self._places: list[Future[list[tuple[int, int]]]] = [Future() for _ in range(4)]
        """Offset and length in the file of the parts of each answer."""
        self._answers: dict[int, Any] = {}
        self._unpacking = threading.Lock()
        read = {key: settings.get(key, {}) for key in ("scene", "render")}
        with contextlib.suppress(OSError):  # the disk is full: the process finds no settings
            # more than arguments may hold; nothing stays in a buffer
            os.pwrite(self._file.fileno(), json.dumps(read, default=str).encode(), 0)
        # its standard input is to be written, too: its number may be 0 here, and is there
        self._process = start_child(__name__, stdin=self._file, env=_KEEP_MEMORY)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def scene(self, config: SceneConfig) -> Scene:
        """Wait for the triangles, and return their scene.

        Its pictures, its refined mesh and its connections come later: an access waits for them, and raises a
        NotReadError if the process has ended before they were there.

        Args:
            config: The checked settings.

        Raises:
            NotReadError: The process could not read it, or read other settings.
        """
        from neurosim_core.scene.scene import Texture

        scene, names, texture_of = self._answer(_SCENE, config)

        def picture(k: int, part: int) -> Any:
            return self._answer(_PICTURES, config)[k][part]

        textures = {
            k: Texture(name=name, srgb=partial(picture, k, 0), levels=partial(picture, k, 1))
            for k, name in enumerate(names)
        }
        return dataclasses.replace(
            scene,
            materials=tuple(
                dataclasses.replace(material, texture=textures.get(k))
                for material, k in zip(scene.materials, texture_of, strict=True)
            ),
            refine=partial(self._answer, _REFINED, config),
            connect=partial(self._answer, _CONNECTIONS, config),
        )

    def _answer(self, number: int, config: SceneConfig) -> Any:
        places = self._places[number].result()
        with self._unpacking:
            if number not in self._answers:
                data = memoryview(mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_COPY))
                body, *buffers = (data[at : at + size] for at, size in places)
                self._answers[number] = pickle.loads(body, buffers=buffers)
        read, answer = self._answers[number]
        if read != config:
            raise NotReadError
        return answer

    def _listen(self) -> None:
        """Note where answers are, until the process ends."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.endswith(b"\n"):  # else it was ended
                number, places = json.loads(line)
                self._places[number].set_result(places)
        for missing in self._places:
            if not missing.done():
                missing.set_exception(NotReadError())

    def __enter__(self) -> SceneReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._listener.join()  # it reads to the end
        end_child(self._process)
        self._file.close()


def main() -> None:
    """Be the process: read settings from file 0, write their scene behind them, and say where it is."""
    with begin_child() as answers, open(0, "r+b") as file:
        settings = json.load(file)
        _read(settings, partial(_write, file=file, answers=answers))


def _read(settings: Mapping[str, Any], write: Callable[[int, object], None]) -> None:
    """Read a scene and write its triangles; compute what its light and its pictures need, and write that."""
    from neurosim_core.registry import find
    from neurosim_core.scene.mesh import MeshSceneConfig, load_mesh_scene, scene_kind

    given = settings["scene"]
    given = {"kind": given} if isinstance(given, str) else given
    kind = scene_kind(given)
    config: SceneConfig = find("scene", kind).model_validate({"kind": kind, **given})  # type: ignore[attr-defined]
    end_with_reader = end_with_parent(signal.SIGKILL)
    receiving, sending = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            if end_with_reader is not None:
                end_with_reader()
            os.close(sending)
            with open(receiving, "rb") as source, ThreadPoolExecutor() as threads:
                textures = pickle.load(source)
                write(_PICTURES, (config, list(threads.map(lambda t: (t.srgb, t.pack_levels()), textures))))
        finally:
            os._exit(0)
    os.close(receiving)
    scene = load_mesh_scene(config, decode=False) if isinstance(config, MeshSceneConfig) else config.load()
    textures = list(dict.fromkeys(m.texture for m in scene.materials if m.texture is not None))
    plain = tuple(dataclasses.replace(material, texture=None) for material in scene.materials)
    texture_of = [None if m.texture is None else textures.index(m.texture) for m in scene.materials]
    names = [texture.name for texture in textures]
    write(_SCENE, (config, (dataclasses.replace(scene, materials=plain), names, texture_of)))

    def send() -> None:
        with open(sending, "wb") as asking:
            pickle.dump(textures, asking, protocol=5)

    threading.Thread(target=send).start()  # of decoded pictures this can be 100 MB and more
    from neurosim_core.render.config import RenderConfig
    from neurosim_core.render.refine import refine_within

    render = RenderConfig.model_validate(settings["render"])
    edge_m = render.lighting.edge_max_m if render.lighting.mode == "baked" else None
    if (mesh := refine_within(scene, edge_m)) is not None:
        _ = mesh.corner_groups, mesh.corner_normals
    write(_REFINED, (config, {} if mesh is None else {edge_m: mesh}))
    if render.samples_per_pixel == "adaptive":
        write(_CONNECTIONS, (config, scene.connections))
    os.waitpid(child, 0)  # it ends with this one


def _write(number: int, content: object, *, file: IO[bytes], answers: IO[bytes]) -> None:
    """Add an answer and the arrays in it to a file, and say where each of them begins, and its size."""
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps(content, protocol=5, buffer_callback=buffers.append)
    places = []
    fcntl.lockf(file, fcntl.LOCK_EX)  # two processes write
    file.seek(0, os.SEEK_END)
    for view in (memoryview(body), *(buffer.raw() for buffer in buffers)):
        file.write(bytes(-file.tell() % _ALIGNMENT))
        places.append((file.tell(), view.nbytes))
        file.write(view)
    file.flush()
    answers.write(json.dumps((number, places)).encode() + b"\n")
    answers.flush()
    fcntl.lockf(file, fcntl.LOCK_UN)
