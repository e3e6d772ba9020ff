"""Cameras: rays, light and pictures."""
