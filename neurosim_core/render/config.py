"""Settings of the renderers."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from neurosim_core.settings import BaseConfig

TextureFilter = Literal["trilinear", "bilinear", "nearest"]
"""Names of the ways to read a texture; see `RenderConfig.texture_filter`."""


class LightingConfig(BaseConfig):
    """Lighting: Lambertian surfaces, hemispheric ambient light, the lights of the scene."""

    mode: Literal["baked", "unshadowed"] = "baked"
    """`baked`: shadows and ambient occlusion, computed once when the scene is loaded. `unshadowed`: light
    evaluated for each pixel, exact, without shadows."""
    edge_max_m: float = Field(default=0.5, ge=0.01)
    """`baked`: edges of triangles are split until none is longer [m]; light is linear between their ends."""
    ambient_ray_count: int = Field(default=16, ge=1, le=1024)
    """`baked`: rays per point and side that test for occluders of the ambient light."""
    ambient_radius_m: float = Field(default=1.0, gt=0.0)
    """`baked`: range of ambient occlusion [m]; nearer occluders take more of the ambient light, farther ones
    none."""
    interreflection: float = Field(default=0.5, ge=0.0, lt=1.0)
    """`baked`: mean albedo of occluders; they reflect this share of the ambient light that they block."""
    shadow_ray_count: int = Field(default=4, ge=1, le=256)
    """`baked`: rays per point, side and light that test for shadows."""
    light_radius_m: float = Field(default=0.1, gt=0.0)
    """Radius of the lights [m]: softens shadows; shading takes distances as at least this."""

    @model_validator(mode="after")
    def _only_baked_light_has_shadows(self) -> LightingConfig:
        both = ("mode", "light_radius_m")
        changed = [
            name
            for name, field in type(self).model_fields.items()
            if name not in both and getattr(self, name) != field.default
        ]
        if self.mode == "unshadowed" and changed:
            raise ValueError(f"{', '.join(changed)}: for mode baked, and does nothing with unshadowed")
        return self


class CandidateListConfig(BaseConfig):
    """Triangles that the rays of a tile of 8 x 8 pixels may hit; lists change speed, not results."""

    instants: int = Field(default=32, ge=1, le=256)
    """Consecutive instants of a launch that share a list. More are cheaper as long as the camera turns by
    less than a few tiles within them."""
    face_count_max: int = Field(default=384, ge=1, le=4096)
    """Capacity of a list [triangles]: the rays of a tile with more traverse the tree."""


class RenderConfig(BaseConfig):
    """Rendering of pictures, the same for all cameras of a run."""

    cpu_traversal: Literal["auto", "embree", "warp"] = "auto"
    """Library that intersects rays on a CPU device. `embree`: Embree, in packets of rays, several times
    faster. `warp`: Warp kernels. `auto`: Embree where it can be loaded, and Warp with explicit
    `candidate_lists`."""
    candidate_lists: CandidateListConfig | Literal["auto"] | None = "auto"
    """Whether the rays of a tile of pixels share one search of the ray-tracing tree (BVH) over several
    instants: the same pictures and events to the last bit, sooner. `auto`: lists are used on CUDA, where a
    launch has 8 instants or more of pixels at most 1.5 mrad wide (in the median), 16 or more of 2.5 mrad, or
    32 or more of 6 mrad, the lens looks forward, and the square of a pixel's width [rad] times the triangles
    of the scene, as cut for baked light, is at most 7; and on a CPU without Embree, where the lens looks
    forward. null: each ray traverses the tree."""
    lighting: LightingConfig = LightingConfig()
    """Lighting of the surfaces."""
    exposure: Literal["auto"] | Annotated[float, Field(gt=0.0)] = "auto"
    """Factor from linear radiance to the linear value 1.0 of an 8-bit picture. `auto`: chosen once from the
    scene. Event cameras do not use it."""
    dark_floor: float = Field(default=1.0e-3, gt=0.0)
    """Radiance added before the logarithm that event cameras see: the radiance of a black surface."""
    samples_per_pixel: Literal["adaptive"] | Annotated[int, Field(ge=1, le=64)] = "adaptive"
    """Rays per pixel. Radiance is their mean in linear light, before the logarithm. `adaptive`: one ray finds
    the surfaces around a pixel, and 32 points of the pixel tell how much of it each covers; 8 rays are cast
    where many small surfaces meet and for moving bodies. It takes 2 to 4 times as long as one ray, and more
    in pictures of 64x64 of a detailed scene. An integer: as many rays in all pixels. With 1, edges alias, and
    a quarter to a half of the events at 346x260 are aliasing. Geometry (depth, range, normal, instance) is
    always that of the ray through the pixel's centre."""
    fill_factor: float = Field(default=1.0, gt=0.0, le=1.0)
    """Light-sensitive share of a pixel's area, a square around its centre."""
    mip_bias: float = Field(default=0.0, ge=-4.0, le=4.0)
    """Offset of the mip-map level that the footprint of a ray selects; negative values give sharper textures
    that alias."""
    texture_filter: TextureFilter = "trilinear"
    """Texture lookup. `trilinear`: averaged over the footprint of the ray (mip-mapped). `bilinear`: at full
    resolution, interpolated between texels; `nearest`: at full resolution, the nearest texel. The latter two
    alias, and event cameras show the aliasing as events that no real sensor gives."""

    @model_validator(mode="after")
    def _candidate_lists_need_warp(self) -> RenderConfig:
        if isinstance(self.candidate_lists, CandidateListConfig) and self.cpu_traversal == "embree":
            raise ValueError("candidate_lists need cpu_traversal auto or warp, got embree")
        return self

    @model_validator(mode="after")
    def _bias_has_levels(self) -> RenderConfig:
        if self.mip_bias != 0.0 and self.texture_filter != "trilinear":
            raise ValueError(
                f"mip_bias is for texture_filter trilinear, got {self.mip_bias:g} with {self.texture_filter}"
            )
        return self
