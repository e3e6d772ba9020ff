"""Where points are in the picture of a lens, by the functions that kernels use."""

# No `from __future__ import annotations`: Warp needs the annotations of kernels in closures as objects.

import functools

import numpy as np
import warp as wp

from neurosim_core.render.projection import LensData, make_lens_data, projector


@functools.cache
def _kernel(kind):
    projection = projector(kind)

    @wp.kernel(module="unique", enable_backward=False)
    def project_points(lens: LensData, points: wp.array(dtype=wp.vec3d), seen_out: wp.array(dtype=wp.vec3d)):
        seen_out[wp.tid()] = projection(lens, points[wp.tid()])

    return project_points


def project(lens, points_C):
    """Return column and row of points in C [px], shape [..., 2]; nan where the lens does not see them."""
    points = wp.array(np.reshape(points_C, (-1, 3)), dtype=wp.vec3d, device="cpu")
    seen = wp.zeros_like(points)
    data = make_lens_data(lens, "cpu")
    wp.launch(_kernel(lens.kind), dim=points.shape, inputs=[data, points], outputs=[seen], device="cpu")
    places = seen.numpy()
    return np.where(places[:, 2:] > 0.0, places[:, :2], np.nan).reshape(*np.shape(points_C)[:-1], 2)
