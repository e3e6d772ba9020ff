# mypy: disable-error-code="no-untyped-def,empty-body,index"
"""The bounding volume hierarchy of a `wp.Mesh`, laid out for single rays.

A node holds the boxes of its two children side by side, and a leaf holds the corners of its triangles: one
step of a ray reads 64 bytes in one place where `wp.mesh_query_ray` reads four times 16, and a triangle is
read at once where that reads three arrays one after the other (docs/decisions/ray-tree.md).

Triangles are intersected by Woop's test, with the operations and so the bits of `wp.mesh_query_ray`. Of two
triangles at the same distance the one with the lesser index counts, unless the ray nearly grazes them: then
rounding of the distance may exclude a box. The box test allows for rounding: the far side counts as further
by 1 + 2 gamma_3 (Ize), and boxes are one rounding larger than their content, so that a ray along a side of a
box hits it.

References: Woop, Benthin, Wald (2013), Watertight Ray/Triangle Intersection; Ize (2013), Robust BVH Ray
Traversal; Aila, Laine (2009), Understanding the Efficiency of Ray Traversal on GPUs.
"""

# No `from __future__ import annotations`: Warp needs the annotations of structures and functions as objects.

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.native_code import read_native
from neurosim_core.render.kernel_data import RayTree

wp.set_module_options({"enable_backward": False})


@wp.func_native(read_native(__file__, "bound_node"))
def _bound_node(id: wp.uint64, node: int, bounds: wp.array[int]):
    """Extend the range [first, last] of nodes that have children."""
    ...


@wp.func_native(read_native(__file__, "lay_out_node"))
def _lay_out_node(
    id: wp.uint64,
    node: int,
    first: int,
    root: wp.array[int],
    nodes: wp.array[wp.vec4],
    triangles: wp.array[wp.vec4],
):
    """Write a node, or the triangles of a leaf, where `RayTree` has them."""
    ...


@wp.kernel
def _bound_nodes(mesh: wp.uint64, bounds: wp.array[int]) -> None:
    _bound_node(mesh, wp.tid(), bounds)


@wp.kernel
def _lay_out(
    mesh: wp.uint64, first: int, root: wp.array[int], nodes: wp.array[wp.vec4], triangles: wp.array[wp.vec4]
) -> None:
    _lay_out_node(mesh, wp.tid(), first, root, nodes, triangles)


def make_mesh(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], device: str, *, constructor: str | None = "sah"
) -> wp.Mesh:
    """Bring triangles to a device and build their tree; None: the constructor that is soonest done there.

    On a CPU "sah" is three times faster to traverse than "median" and as fast as "cubql".
    """
    return wp.Mesh(
        wp.array(vertices, dtype=wp.vec3, device=device),
        wp.array(faces.reshape(-1), dtype=int, device=device),
        bvh_constructor=constructor,
        bvh_leaf_size=1 if wp.get_device(device).is_cuda else 4,
    )


def make_ray_tree(mesh: wp.Mesh) -> RayTree:
    """Return the tree of a mesh of `make_mesh` ("sah", not empty) as it is now; waits for the device."""
    face_count = mesh.indices.shape[0] // 3
    device, node_limit = mesh.device, 2 * face_count
    tree = RayTree()
    root = wp.empty(1, dtype=int, device=device)
    bounds: wp.array[int] = wp.array([node_limit, -1], dtype=int, device=device)
    wp.launch(_bound_nodes, dim=node_limit, inputs=[mesh.id], outputs=[bounds], device=device)
    first, last = (int(x) for x in bounds.numpy())
    tree.nodes = wp.zeros(4 * max(last - first + 1, 1), dtype=wp.vec4, device=device)
    tree.triangles = wp.zeros(3 * face_count, dtype=wp.vec4, device=device)
    outputs = [root, tree.nodes, tree.triangles]
    wp.launch(_lay_out, dim=node_limit, inputs=[mesh.id, first], outputs=outputs, device=device)
    tree.root = int(root.numpy()[0])
    return tree


@wp.func_native(read_native(__file__, "intersect_tree"))
def intersect_tree(tree: RayTree, origin: wp.vec3, ray: wp.vec3, far_m: float) -> wp.vec4:
    """Return the first hit of a ray: distance, u and v of `ray_intersection.Hit`, and the bits of the face.

    Beyond `far_m` the ray, of unit length, hits nothing: the face is -1. So does one that is not finite.
    """
    ...
