"""The generated apartment: floor plan, building, surfaces, furniture."""

from neurosim_core.scene.apartment.apartment import ApartmentConfig, make_apartment

__all__ = ["ApartmentConfig", "make_apartment"]
