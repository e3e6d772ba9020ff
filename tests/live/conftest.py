"""Fixtures for tests of the live stack."""

from __future__ import annotations

from runtime_directory import runtime, shared_runtime

__all__ = ["runtime", "shared_runtime"]
