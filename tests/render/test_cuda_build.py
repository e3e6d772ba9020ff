"""Kernels build for CUDA on a machine without a GPU."""

from __future__ import annotations

import warp as wp

from neurosim_core.render import lighting
from neurosim_core.render.antialias import antialiasing_kernel
from neurosim_core.render.candidate_data import BLOCK
from neurosim_core.render.frustum_search import frustum_search_kernel
from neurosim_core.render.outputs import OUTPUTS
from neurosim_core.render.raycast import raycast_kernel
from neurosim_core.render.render_terms import RenderTerms


def test_kernels_build_for_sm_90(tmp_path):
    everything = RenderTerms(textured=True, emissive=True, baked=True, supersampled=False, bodies=True)
    kernels = (
        raycast_kernel(OUTPUTS, everything),
        raycast_kernel(("log_radiance",), everything._replace(candidate_group=4)),
        frustum_search_kernel(BLOCK),
        antialiasing_kernel(OUTPUTS, everything),
    )
    for module in (*(kernel.module for kernel in kernels), lighting):
        wp.compile_aot_module(module, module_dir=str(tmp_path), arch=90)
    assert len(list(tmp_path.rglob("*.cubin")) + list(tmp_path.rglob("*.ptx"))) >= 4
