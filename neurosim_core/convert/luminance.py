# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,no-any-return,no-untyped-call"
# mypy: disable-error-code="call-overload,untyped-decorator,assignment,var-annotated,type-var,valid-type"
"""From a picture as it is stored to linear luminance.

Greys and RGB are looked up in tables. Videos store luma and two colour differences instead. FFmpeg's own way
from there to RGB is good to one step of 8 bits, also where more are stored; this one computes with what was
stored. With k_r and k_b the weights of the matrix, R' = Y' + 2 (1 - k_r) C_r, B' = Y' + 2 (1 - k_b) C_b,
and G' follows from Y' = k_r R' + (1 - k_r - k_b) G' + k_b B'.

Reference: ITU-T H.273 (2021), 8.3, equations 38 to 43; ITU-R BT.601, BT.709, BT.2020.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from neurosim_core.convert.light import TRANSFERS, UNSPECIFIED, luminance_weights

wp.set_module_options({"enable_backward": False})

_STEPS = 1 << 16
_TABLE_STEPS = wp.constant(_STEPS)
_MATRICES = {
    1: (0.2126, 0.0722),
    4: (0.30, 0.11),
    5: (0.299, 0.114),
    6: (0.299, 0.114),
    7: (0.212, 0.087),
    9: (0.2627, 0.0593),
}
"""k_r and k_b by their number in H.273."""
_HD_HEIGHT = 720


@wp.func
def _light(table: wp.array[wp.float32], code: wp.float32) -> wp.float32:
    place = wp.clamp(code, 0.0, 1.0) * wp.float32(_TABLE_STEPS)
    step = wp.min(wp.int32(place), _TABLE_STEPS - 1)
    return wp.lerp(table[step], table[step + 1], place - wp.float32(step))


@wp.kernel
def _luminance(
    # Model:
    black: wp.float32,
    luma_scale: wp.float32,
    chroma_scale: wp.float32,
    matrix: wp.vec2,
    weights: wp.vec3,
    table: wp.array[wp.float32],
    # In:
    picture: wp.array3d[wp.uint16],
    # Out:
    luminance_out: wp.array2d[wp.float32],
) -> None:
    row = wp.tid()
    for col in range(picture.shape[1]):
        luma = (wp.float32(picture[row, col, 0]) - black) * luma_scale
        blueness = (wp.float32(picture[row, col, 1]) - 32768.0) * chroma_scale
        redness = (wp.float32(picture[row, col, 2]) - 32768.0) * chroma_scale
        red = luma + 2.0 * (1.0 - matrix[0]) * redness
        blue = luma + 2.0 * (1.0 - matrix[1]) * blueness
        green = (luma - matrix[0] * red - matrix[1] * blue) / (1.0 - matrix[0] - matrix[1])
        if redness == 0.0 and blueness == 0.0:
            luminance_out[row, col] = _light(table, luma)
        else:
            light = wp.vec3(_light(table, red), _light(table, green), _light(table, blue))
            luminance_out[row, col] = wp.dot(weights, light)


class LightTables:
    """Looks up the luminance of numbers of which 0 is black and the largest is white.

    `transfer`: name of the transfer function, one of `TRANSFERS`.

    Attributes:
        codes: Luminance of the greys, from black to white.
    """

    def __init__(self, transfer: str, *, bits: int, primaries: int = 1) -> None:
        self.codes = TRANSFERS[transfer](np.linspace(0.0, 1.0, 1 << bits))
        self._gray = self.codes.astype(np.float32)
        # summed in float64, so that a grey is the same whether it is stored as one number or as three
        self._bands = [weight * self.codes for weight in luminance_weights(primaries)]

    def luminance(self, picture: NDArray[np.uint8] | NDArray[np.uint16]) -> NDArray[np.float32]:
        """Return the luminance of a picture, shape [H, W], white is 1.

        `picture`: greys, shape [H, W], or red, green, blue, shape [H, W, 3].
        """
        if picture.ndim == 2:
            return self._gray[picture]
        red, green, blue = (band.take(picture[..., k]) for k, band in enumerate(self._bands))
        return (red + green + blue).astype(np.float32)


def matrix_of(number: int, height: int) -> tuple[float, float]:
    """Return k_r and k_b by the number of the matrix in H.273.

    A file that does not tell is taken for BT.709 from 720 rows on, and for BT.601 below, as players do.
    """
    if number in (0, UNSPECIFIED, 3):
        number = 1 if height >= _HD_HEIGHT else 6
    if number not in _MATRICES:
        raise ValueError(
            f"colour matrix {number} of ITU-T H.273 is not known, known: {sorted(_MATRICES)};"
            f" convert the video to RGB first"
        )
    return _MATRICES[number]


class LumaDecoder:
    """Turns pictures of luma and colour differences into luminance.

    `transfer`: name of the transfer function, one of `TRANSFERS`. `bits`: bits of a stored number, 8 to 16.
    `limited`: luma of black is 16 / 256 and of white 235 / 256 of the range, and colour differences span 16 /
    256 to 240 / 256, else all of it. Beyond black and white it is black and white.

    Attributes:
        codes: Luminance of the greys, from black to white.
    """

    def __init__(
        self, transfer: str, *, bits: int, matrix: tuple[float, float], primaries: int, limited: bool
    ) -> None:
        code = np.arange(_STEPS + 1) / _STEPS
        self._table = wp.array(TRANSFERS[transfer](code).astype(np.float32), device="cpu")
        full = float(((1 << bits) - 1) << (16 - bits))
        step_count = 219 << (bits - 8) if limited else (1 << bits) - 1
        self.codes = TRANSFERS[transfer](np.linspace(0.0, 1.0, step_count + 1))
        self._scales = [4096.0, 1.0 / 56064.0, 1.0 / 57344.0] if limited else [0.0, 1.0 / full, 1.0 / full]
        self._matrix = wp.vec2(*matrix)
        self._weights = wp.vec3(*luminance_weights(primaries))

    def luminance(self, picture: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Return the luminance, shape [H, W], white is 1.

        `picture`: Y', C_b, C_r, their highest bit at bit 15, shape [H, W, 3].
        """
        out = np.empty(picture.shape[:2], dtype=np.float32)
        inputs, outputs = (
            wp.array(np.ascontiguousarray(values), device="cpu", copy=False) for values in (picture, out)
        )
        parameters = [*self._scales, self._matrix, self._weights, self._table]
        wp.launch(
            _luminance, dim=picture.shape[0], inputs=[*parameters, inputs], outputs=[outputs], device="cpu"
        )
        return out
