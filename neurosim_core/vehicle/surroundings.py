# mypy: disable-error-code="valid-type"
"""All that acts on a batch besides its airframe, as one parameter of the kernels."""

import warp as wp

from neurosim_core.vehicle.ground import Ground
from neurosim_core.vehicle.rotors import Rotors
from neurosim_core.vehicle.wind import Wind


@wp.struct
class Surroundings:
    """Wind, ground, and the rotors one by one; arrays of terms that are not compiled in are empty."""

    wind: Wind
    ground: Ground
    rotors: Rotors
