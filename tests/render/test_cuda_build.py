"""Kernels build for CUDA on a machine without a GPU."""

from __future__ import annotations

import warp as wp

from neurosim_core.render import lighting
from neurosim_core.render.raycast import OUTPUTS, Terms, raycast_kernel


def test_kernels_build_for_sm_90(tmp_path):
    everything = Terms(textured=True, emissive=True, baked=True, supersampled=False, bodies=True)
    kernel = raycast_kernel(OUTPUTS, everything)
    for module in (kernel.module, lighting):
        wp.compile_aot_module(module, module_dir=str(tmp_path), arch=90)
    assert len(list(tmp_path.rglob("*.cubin")) + list(tmp_path.rglob("*.ptx"))) >= 2
