"""Bars that are for one device, an NVIDIA H200, and one scene, a furnished house of 145,844 triangles."""

from __future__ import annotations

HOUSE_TRIANGLES = 145_000
"""A scene with fewer is not that house."""


def is_enough(device: str, figure: float, least: float) -> bool | None:
    """Return whether a figure is enough; None: it is too low, on a device that the bar is not for."""
    if figure >= least:
        return True
    return False if "H200" in device else None
