"""Lights for a scene: those of its file brought to a sensible level, or lamps hung where there is room."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neurosim_core.scene.scene import Light, LinearRgb, extent
from neurosim_core.scene.source import SceneError, Source, rgb
from neurosim_core.scene.topology import connected_components
from neurosim_core.scene.triangles import dot, double_areas

LEVEL = 0.3
"""What the median bit of surface would reflect if it were white and faced its brightest lamp, alone."""
MAX_LAMPS = 6
_SAMPLES = 4096
_CELL_MAX = 300_000


def surface_samples(corners: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return points spread over triangles [axis, corner, F] in proportion to area, shape [axis, count].

    A low-discrepancy sequence: the same triangles give the same points.
    """
    index = np.arange(count)
    total = np.cumsum(double_areas(corners))
    face = np.minimum(np.searchsorted(total, (index + 0.5) / count * total[-1]), len(total) - 1)
    a = np.sqrt((index * 0.7548776662466927) % 1.0)  # Roberts' R2 sequence
    b = (index * 0.5698402909980532) % 1.0
    weights = 1.0 - a, a * (1.0 - b), a * b
    return dot(weights, corners.take(face, axis=2).swapaxes(0, 1))


def _level(
    positions: NDArray[np.float64], intensities: NDArray[np.float64], samples: NDArray[np.float64]
) -> float:
    """Return the median over `samples` of the brightest light's intensity / distance^2."""
    squared = ((samples.T[:, None] - positions[None]) ** 2).sum(axis=2)
    return float(np.median((intensities.mean(axis=1) / np.maximum(squared, 0.01)).max(axis=1)))


def scaled_lights(
    positions: Sequence[NDArray[np.float64]],
    intensities: Sequence[LinearRgb],
    corners: NDArray[np.float64],
    *,
    factor: float | None,
) -> tuple[tuple[Light, ...], float]:
    """Return lights and the factor that was applied: `factor`, or the one that brings them to `LEVEL`."""
    where, power = np.asarray(positions, dtype=np.float64), np.asarray(intensities, dtype=np.float64)
    if factor is None:
        factor = LEVEL / max(_level(where, power, surface_samples(corners, _SAMPLES)), 1e-12)
    lights = tuple(
        Light(
            position_m=(float(p[0]), float(p[1]), float(p[2])),
            intensity=(float(i[0]), float(i[1]), float(i[2])),
        )
        for p, i in zip(where, power * factor, strict=True)
    )
    return lights, factor


def lights_of(
    source: Source,
    light_scale: float | None,
    corners: NDArray[np.float64],
    notes: list[str],
    *,
    turn: NDArray[np.float64],
    shift_m: NDArray[np.float64],
    path: Path,
) -> tuple[Light, ...]:
    """Return the lights of a file, or lamps hung where it has none, and add a sentence to the notes.

    `light_scale` is a factor of its lights; None: what brings them to `LEVEL`. `turn` [3, 3] takes directions
    and places of the file to metres with z up, and `shift_m` is added to places; corners are those of the
    scene's triangles [m], shape [axis, corner, F].

    Raises:
        SceneError: There are no lights to scale by `light_scale`.
    """
    if not source.lamps:
        if light_scale is not None:
            raise SceneError(
                f"light_scale = {light_scale:g} scales the lights of the file, and {path} has none: "
                "leave it out"
            )
        places, sentence = hang_lamps(corners)
        notes.append(f"The file has no lights; {len(places)} are {sentence}.")
        return scaled_lights(list(places), [(1.0, 0.96, 0.9)] * len(places), corners, factor=None)[0]
    low, high = extent(corners.T)
    away = 20.0 * float(np.linalg.norm(high - low))
    positions, intensities = [], []
    for lamp in source.lamps:
        vector = turn @ lamp.vector
        if lamp.kind == "directional":  # a point light so far off that its rays are parallel
            vector = vector / np.linalg.norm(vector)
            positions.append((low + high) / 2.0 - away * vector)
            intensities.append(rgb(np.asarray(lamp.intensity) * away**2))
        else:
            positions.append(vector + shift_m)
            intensities.append(lamp.intensity)
    lights, factor = scaled_lights(positions, intensities, corners, factor=light_scale)
    how = "as declared" if light_scale is not None else "so that the median surface is well lit"
    notes.append(f"{len(lights)} lights of the file, their intensities (cd, lx) times {factor:.3g}, {how}.")
    return lights


def hang_lamps(corners: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
    """Choose places for lamps: inside, one to each part of the rooms; around the scene if it is no room.

    Surfaces are sampled into a grid. A lamp may hang in a cell with a surface 1.2 m or more below and a
    ceiling 0.3 to 0.9 m above; where less than a third of the floor has one, the top of the scene counts as
    ceiling. From the cell with most room on, each further lamp goes to a cell that is far by air, around
    walls, from those that hang, until every cell is within 4 m of one.

    Returns:
        Positions [m], shape [n, 3], and the end of a sentence that says what was done.
    """
    low, high = extent(corners.T)
    size = high - low
    if size[:2].min() < 2.0 or size[2] < 1.8 or size.max() > 500.0:
        return _around(low, high), "placed above and around the scene, which is no room"
    cell = max(0.2, float((np.prod(size + 0.5) / _CELL_MAX) ** (1.0 / 3.0)))
    shape = np.ceil(size / cell).astype(int) + 2
    count = int(min(2.0 * double_areas(corners).sum() / cell**2 + corners.shape[2], 1_000_000))
    full = np.zeros(shape, dtype=bool)
    for points in (surface_samples(corners, count), corners[:, 0]):
        index = [((x - least) / cell).astype(int) + 1 for x, least in zip(points, low, strict=True)]
        full[tuple(np.clip(i, 0, cells - 1) for i, cells in zip(index, shape, strict=True))] = True
    full[[0, -1]] = full[:, [0, -1]] = True  # nothing hangs outside
    room = _distance(full, (1.0, 1.0, 1.0)) * cell
    width = _distance(full, (1.0, 1.0, 4.0))  # counts walls, hardly the floor
    floor = _gap(full) * cell
    standing = np.isfinite(floor) & (floor >= 1.2)
    how = "hung under the ceilings"
    above = _gap(full[:, :, ::-1])[:, :, ::-1] * cell
    places = standing & (above >= 0.3) & (above <= 0.9) & (room >= 0.25)
    if places.any(axis=2).sum() < standing.any(axis=2).sum() / 3.0:
        how = "hung inside at the height where a ceiling would be, for there is none"
        top = (shape[2] - 1 - np.arange(shape[2])) * cell
        places = standing & np.isinf(above) & (top >= 0.3) & (top <= 0.9) & (room >= 0.25)
    air = room >= 1.5 * cell
    if not (air & places).any():
        return _around(low, high), "placed above and around the scene, which has no room for them inside"
    region = _regions(air)
    free = region == np.bincount(region[air & places]).argmax()
    places &= free
    lamps = [_widest(places, width)]
    reach = _steps_by_air(free, lamps[0]) * cell
    while len(lamps) < MAX_LAMPS:
        far = float(reach[places].max())
        if far <= 4.0:
            break
        # of the cells nearly as far off as the farthest, the one in most room: not the corner itself
        lamps.append(_widest(places & (reach >= max(far - 2.0, 0.6 * far)), width))
        reach = np.minimum(reach, _steps_by_air(free, lamps[-1]) * cell)
    return low + (np.array(lamps) - 0.5) * cell, how


def _widest(places: NDArray[np.bool_], width: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.array(np.unravel_index(np.argmax(np.where(places, width, -1.0)), width.shape))


def _around(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    centre, reach = (low + high) / 2.0, float(np.linalg.norm(high - low))
    angles = np.array([0.6, 0.6 + 2.0 * math.pi / 3.0, 0.6 + 4.0 * math.pi / 3.0])
    directions = np.stack([np.cos(angles), np.sin(angles), np.full(3, 0.9)], axis=1)
    return np.asarray(centre + 1.2 * reach * directions / np.linalg.norm(directions[0]))


def _distance(full: NDArray[np.bool_], spacing: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return the distance of each cell to the nearest full one; to import SciPy's takes 0.14 s."""
    squared = np.where(full, 0.0, np.inf)
    for axis, step in enumerate(spacing):
        nearer = np.moveaxis(squared, axis, 0)  # the one array, seen along this axis
        before = nearer.copy()
        for cells in range(1, len(nearer)):
            away = (step * cells) ** 2
            if away >= nearer.max():
                break
            np.minimum(nearer[cells:], before[:-cells] + away, out=nearer[cells:])
            np.minimum(nearer[:-cells], before[cells:] + away, out=nearer[:-cells])
    return np.sqrt(squared)


def _regions(free: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return a number for each cell that free cells share from which one gets to the other through faces."""
    number = np.arange(free.size).reshape(free.shape)
    pairs = []
    for axis in range(free.ndim):
        cell, is_free = np.moveaxis(number, axis, 0), np.moveaxis(free, axis, 0)
        open_face = is_free[1:] & is_free[:-1]
        pairs.append((cell[:-1][open_face], cell[1:][open_face]))
    one, other = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    return connected_components(free.size, one, other)[1].reshape(free.shape)


def _gap(full: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the distance in cells to the nearest full cell at a lower last index; inf: there is none."""
    index = np.arange(full.shape[2], dtype=np.float64)
    last = np.maximum.accumulate(np.where(full, index, -np.inf), axis=2)
    return np.asarray(index - last)


def _steps_by_air(free: NDArray[np.bool_], start: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the number of steps from `start` to each cell through free cells, inf where there is no way.

    Steps go alternately to 6 and to 26 neighbours, whose balls are close to round. A cell is done with
    once a step went to 26.
    """
    padded = np.pad(free, 1)
    unseen = padded.ravel()
    steps = np.full(unseen.shape, np.inf)
    around = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    _, depth, height = padded.shape
    wide = around @ (depth * height, height, 1)
    near = wide[np.abs(around).sum(axis=1) == 1]
    place = np.empty(unseen.shape, dtype=np.int64)
    before, last = wide[:0], np.array([(start + 1) @ (depth * height, height, 1)])
    steps[last], unseen[last] = 0.0, False
    for step in range(1, sum(free.shape) * 2):
        leaving = last[:, None] + near if step % 2 else np.concatenate([before, last])[:, None] + wide
        found = leaving[unseen[leaving]]
        order = np.arange(len(found))
        place[found] = order
        found = found[place[found] == order]  # each once
        if step % 2 == 0 and len(found) == 0:
            break
        steps[found], unseen[found] = step, False
        before, last = last, found
    return steps.reshape(padded.shape)[1:-1, 1:-1, 1:-1]
