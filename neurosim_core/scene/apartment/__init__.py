"""Generated scenes: the apartment (floor plan, building, surfaces, furniture), and a hall with boxes."""

from neurosim_core.scene.apartment.apartment import ApartmentConfig, make_apartment
from neurosim_core.scene.apartment.hall import HallConfig, make_hall

__all__ = ["ApartmentConfig", "HallConfig", "make_apartment", "make_hall"]
