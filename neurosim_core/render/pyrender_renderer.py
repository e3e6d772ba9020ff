# mypy: disable-error-code="attr-defined"
"""The second renderer: rgb and depth through pyrender and OpenGL, to check the first one against.

Geometry, visibility, perspective and texture filtering are OpenGL's; light is that of `lighting`, as colours
of vertices. All that pyrender 0.1.45 needs on current libraries is in this module.
"""

from __future__ import annotations

import ctypes.util
import os
import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import scipy  # which imports its parts when they are used
import warp as wp
from numpy.typing import NDArray

from neurosim_core.install import install_hint
from neurosim_core.registry import register
from neurosim_core.render.camera import Lens, PinholeConfig
from neurosim_core.render.config import RenderConfig
from neurosim_core.render.lighting import bake_light
from neurosim_core.render.ray_times import refuse_several
from neurosim_core.render.refine import refine
from neurosim_core.render.renderer import RendererConfig
from neurosim_core.render.scene_arrays import auto_exposure
from neurosim_core.scene.bodies import Body, BodyPoses, body_poses
from neurosim_core.scene.materials import mean_albedo, pack_textures
from neurosim_core.scene.scene import Material, RefinedMesh, Scene

_NEAR_M = 0.02
_OPENGL_FROM_OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])
_GAMMA = 2.2  # of pyrender's shader
_INSTALL_OPENGL = (
    "OpenGL without a display needs EGL and a driver, for example: apt-get install libegl1 libgl1-mesa-dri; "
    "or use renderer: warp, which needs neither"
)


class PyrenderError(RuntimeError):
    """pyrender or OpenGL cannot be used on this machine; the message says what to install."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PyrenderScene:
    """A scene as pyrender keeps it; shared by all cameras."""

    scene: Scene
    config: RenderConfig
    nodes: Any
    """pyrender.Scene."""
    exposure: float
    bodies: tuple[Any, ...] = ()
    """The pyrender.Node of each body."""


def _import_pyrender() -> Any:
    """Import pyrender on current NumPy and Python, on the platform that needs no display."""
    if "PYOPENGL_PLATFORM" not in os.environ:  # read once, when OpenGL is imported
        if ctypes.util.find_library("EGL") is None:
            raise PyrenderError(_INSTALL_OPENGL)
        os.environ["PYOPENGL_PLATFORM"] = "egl"
    if not hasattr(np, "infty"):
        np.infty = np.inf  # noqa: NPY201  removed in NumPy 2.0, used by pyrender 0.1.45
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of libraries that pyrender brings
            import pyrender
            from OpenGL.plugins import FormatHandler
    except ImportError as error:
        raise PyrenderError(f"pyrender cannot be used ({error}): {install_hint('render')}") from error
    handler = "OpenGL.arrays.ctypesparameters.CtypesParameterHandler"
    FormatHandler("ctypesparameter", handler, ["_ctypes.CArgObject"])  # its name from Python 3.12 on
    return pyrender


def upload_pyrender_scene(
    scene: Scene, config: RenderConfig, *, device: str, bodies: Sequence[Body] = ()
) -> PyrenderScene:
    """Light a scene and hand it to pyrender.

    Each side of a surface is a copy with its own light; OpenGL culls the one that is turned away. Faces that
    emit show only their emission. Bodies keep the light that they have at stamp 0, wherever they move. Mip
    levels and samples are OpenGL's own.

    Raises:
        PyrenderError: pyrender is not installed or there is no OpenGL.
    """
    pyrender = _import_pyrender()
    mesh = refine(scene, config.lighting.edge_max_m)
    light = bake_light(scene, mesh, config.lighting, device=device)
    albedo = mean_albedo(scene.materials, pack_textures(scene.materials))
    material_of = scene.face_material[mesh.origin]
    exposure = config.exposure
    if exposure == "auto":
        exposure = auto_exposure(mesh, light, albedo[material_of])
    nodes = pyrender.Scene(
        bg_color=[*_to_display(exposure * np.array(scene.sky)), 1.0], ambient_light=[1.0] * 3
    )
    nodes.add(_mesh(pyrender, mesh, light, material_of, scene.materials, exposure))
    return PyrenderScene(
        scene=scene,
        config=config,
        nodes=nodes,
        exposure=exposure,
        bodies=tuple(
            nodes.add(_body_mesh(pyrender, body, scene, config, exposure, device)) for body in bodies
        ),
    )


def _body_mesh(
    pyrender: Any, body: Body, scene: Scene, config: RenderConfig, exposure: float, device: str
) -> Any:
    mesh = refine(body.solid, None)
    p_WO, q_WO = body_poses({body.name: body.config}, [0])
    R_WO = scipy.spatial.transform.Rotation.from_quat(q_WO[0, 0])
    placed = replace(
        mesh,
        vertices=(R_WO.apply(mesh.vertices) + p_WO[0, 0]).astype(np.float32),
        normals=R_WO.apply(mesh.normals).astype(np.float32),
    )
    light = bake_light(scene, placed, config.lighting, device=device)
    return _mesh(pyrender, mesh, light, body.solid.face_material, body.solid.materials, exposure)


def _mesh(
    pyrender: Any,
    mesh: RefinedMesh,
    light: NDArray[np.float32],
    material_of: NDArray[np.int32],
    materials: Sequence[Material],
    exposure: float,
) -> Any:
    """Return faces as pyrender.Mesh; shapes: linear light [2, F, 3, 3] (`bake_light`), `material_of` [F]."""
    sides = []
    for index, material in enumerate(materials):
        chosen = np.flatnonzero(material_of == index)
        if not chosen.size:
            continue
        emits = max(material.emission) > 0.0
        look = pyrender.MetallicRoughnessMaterial(
            baseColorFactor=[*((0.0,) * 3 if emits else material.base_color), 1.0],
            baseColorTexture=None if material.texture is None else _texture(pyrender, material.texture.srgb),
            emissiveFactor=np.sqrt(exposure * np.array(material.emission)),  # the shader squares it
            metallicFactor=0.0,
            doubleSided=False,
        )
        for side, corners in enumerate(((0, 1, 2), (0, 2, 1))):
            vertices = mesh.faces[chosen][:, corners].reshape(-1)
            color = np.ones((vertices.size, 4), dtype=np.float32)
            if not emits:
                color[:, :3] = exposure * light[side, chosen][:, corners].reshape(-1, 3)
            sides.append(
                pyrender.Primitive(
                    positions=mesh.vertices[vertices],
                    normals=mesh.normals[vertices],
                    texcoord_0=mesh.uv[vertices],
                    color_0=color,
                    material=look,
                )
            )
    return pyrender.Mesh(primitives=sides)


def _to_display(linear: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.clip(linear, 0.0, 1.0) ** (1.0 / _GAMMA))


def _texture(pyrender: Any, srgb: NDArray[np.uint8]) -> Any:
    return pyrender.Texture(source=srgb, source_channels="RGB")


class PyrenderRenderer:
    """Renders rgb and depth of `renderer.Renderer` on the host, one pose after another, through OpenGL.

    The display curve of rgb is a power of 1 / 2.2, not sRGB.
    """

    def __init__(
        self,
        scene: PyrenderScene,
        lens: Lens,
        *,
        outputs: Collection[str],
        image_count: int = 1,
        **several: Any,
    ) -> None:
        """Allocate the outputs and open an OpenGL context; parameters as of `make_renderer`.

        Raises:
            ValueError: Another output than rgb and depth is asked for, or another lens than a pinhole; there
                are several worlds, or rays have times of their own.
            PyrenderError: There is no OpenGL.
        """
        refuse_several("pyrender", several)
        if not isinstance(lens, PinholeConfig):
            kind = getattr(lens, "kind", type(lens).__name__)
            raise ValueError(f"pyrender renders pinholes, not a lens of kind {kind}: use renderer: warp")
        unknown = sorted(set(outputs) - {"rgb", "depth"})
        if unknown or not outputs:
            raise ValueError(
                f"pyrender renders ['rgb', 'depth'], asked for {sorted(outputs)}: "
                "use renderer: warp for event cameras and the rest"
            )
        pyrender = _import_pyrender()
        self._scene = scene
        self._width, self._height = lens.width, lens.height
        fx, fy, cx, cy = lens.intrinsics()
        far = 2.0 * float(np.linalg.norm(np.ptp(scene.scene.bounds_m, axis=0))) + 100.0
        self._camera = pyrender.IntrinsicsCamera(fx, fy, cx, cy, znear=_NEAR_M, zfar=far)
        self._context = _open_context(pyrender, lens.width, lens.height)
        # The pass for segmentation is the one without multisampling: its depth is that of the pixel's centre.
        self._segment = pyrender.RenderFlags.SEG
        self._ids = dict.fromkeys(scene.nodes.mesh_nodes, (255, 255, 255))
        self.log_radiance = self.radiance = self.normal = self.range = self.instance = self.returns = None
        shape = (image_count, lens.height, lens.width)
        self.rgb = wp.zeros((*shape, 3), dtype=wp.uint8, device="cpu") if "rgb" in outputs else None
        self.depth = wp.zeros(shape, dtype=float, device="cpu") if "depth" in outputs else None

    def render(
        self,
        p_WC: wp.array[wp.vec3],
        q_WC: wp.array[wp.quat],
        image_slot: wp.array[int],
        *,
        instant_count: int,
        bodies: BodyPoses | None = None,
        active: Any = None,
    ) -> None:
        """Render those of the first `instant_count` poses that have an image slot; see `Renderer.render`."""
        rotations = scipy.spatial.transform.Rotation.from_quat(q_WC.numpy()[:instant_count]).as_matrix()
        positions, slots = p_WC.numpy(), image_slot.numpy()
        for instant in range(instant_count):
            if slots[instant] < 0:
                continue
            if bodies is not None:
                self._place_bodies(bodies.p_WO.numpy()[instant], bodies.q_WO.numpy()[instant])
            T_WC = _matrix(rotations[instant], positions[instant])
            node = self._scene.nodes.add(self._camera, pose=T_WC @ _OPENGL_FROM_OPTICAL)
            self._scene.nodes.main_camera_node = node
            if self.rgb is not None:
                rgb, _ = self._context.render(self._scene.nodes)
                self.rgb.numpy()[slots[instant]] = rgb
            if self.depth is not None:
                _, depth = self._context.render(
                    self._scene.nodes, flags=self._segment, seg_node_map=self._ids
                )
                self.depth.numpy()[slots[instant]] = np.where(depth > 0.0, depth, np.inf)
            self._scene.nodes.remove_node(node)

    def _place_bodies(self, p_WO: NDArray[np.float64], q_WO: NDArray[np.float64]) -> None:
        rotations = scipy.spatial.transform.Rotation.from_quat(q_WO).as_matrix()
        for node, rotation, position in zip(self._scene.bodies, rotations, p_WO, strict=True):
            self._scene.nodes.set_pose(node, _matrix(rotation, position))


def _matrix(rotation: NDArray[np.float64], position: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = position
    return matrix


def _open_context(pyrender: Any, width: int, height: int) -> Any:
    from OpenGL.error import Error

    try:
        return pyrender.OffscreenRenderer(width, height)
    except (
        AttributeError,
        AssertionError,
        ImportError,
        ValueError,
        Error,
    ) as error:  # what a lack of OpenGL raises
        raise PyrenderError(f"OpenGL cannot be used ({error}). {_INSTALL_OPENGL}") from error


@register("renderer", "pyrender")
class PyrenderRendererConfig(RendererConfig):
    """OpenGL, rgb and depth only."""

    kind: Literal["pyrender"] = "pyrender"
    scene_type = PyrenderScene
    make = PyrenderRenderer

    def upload(self, scene: Scene, config: RenderConfig, *, device: str, bodies: Sequence[Body]) -> Any:
        """Light a scene and hand it to pyrender."""
        return upload_pyrender_scene(scene, config, device=device, bodies=bodies)
