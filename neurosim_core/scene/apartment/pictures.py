"""Procedural pictures: posters, rugs, the spines of books, screens and the view through a window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from neurosim_core.scene.apartment.textures import Field, Picture, blend, noise, rgb, texel_grid

SPINE_COLUMNS, SPINE_ROWS = 16, 2
"""Cells of the picture that `spines` paints; the last one is paper."""


def _cover(picture: Picture, inside: Field, color: str) -> Picture:
    """Paint where a signed distance (in picture widths, negative inside) says so, with a soft edge."""
    return blend(picture, color, 0.5 - inside * 384.0)


def _framed(picture: Picture, rng: np.random.Generator, *, margin: float = 0.07) -> Picture:
    """White paper around a print, and the tooth of the paper over both."""
    height, width = picture.shape[:2]
    x, y = texel_grid(width, height)
    inset = np.minimum(np.minimum(x, 1.0 - x), np.minimum(y, height / width - y))
    picture = blend("#f3efe6", picture, (inset - margin) * width)
    tooth = noise(rng, 0.6)[:height, :width]
    return np.asarray(picture * (1.0 + 0.025 * tooth[..., None]), np.float32)


def _hills(rng: np.random.Generator, colors: Sequence[str]) -> Picture:
    """A sun over ranges of hills, paler with distance."""
    x, y = texel_grid(384, 512)
    picture = blend(colors[0], "#f6e8cf", y * 1.1)
    center = rng.uniform(0.3, 0.7), rng.uniform(0.3, 0.5)
    picture = _cover(picture, np.hypot(x - center[0], y - center[1]) - 0.15, colors[1])
    for layer in range(5):
        crest = 0.55 + 0.16 * layer
        for octave in range(1, 7):
            height = 0.10 / octave**1.2 * rng.uniform(0.4, 1.0)
            crest = crest + height * np.sin(2.0 * np.pi * (octave * 0.8 * x + rng.uniform()))
        shade = blend(colors[2], "#f6e8cf", np.full_like(x, 0.75 - 0.18 * layer))
        strata = 1.0 - 0.08 * (np.sin(2.0 * np.pi * (y - crest) * 26.0) > 0.75)
        picture = blend(picture, shade * strata[..., None], 0.5 + (y - crest) * 384.0)
    return picture


def _shapes(rng: np.random.Generator, colors: Sequence[str]) -> Picture:
    """Quarter discs, rings and bars on a grid."""
    x, y = texel_grid(384, 512)
    picture = np.broadcast_to(rgb("#efe6d6"), (512, 384, 3)).astype(np.float32)
    for row in range(4):
        for column in range(3):
            u, v = x * 3.0 - column, y * 3.0 - row
            inside = (u >= 0.0) & (u < 1.0) & (v >= 0.0) & (v < 1.0)
            ground, motif = rng.choice(len(colors), 2, replace=False)
            corner = rng.integers(0, 2, 2)
            radius = np.hypot(u - corner[0], v - corner[1])
            share = (
                (0.98 - radius) * 128.0,
                0.5 + 4.0 * np.sin(2.0 * np.pi * 5.0 * radius),
                (0.42 - np.hypot(u - 0.5, v - 0.5)) * 128.0,
                0.5 + 8.0 * np.sin(2.0 * np.pi * 6.0 * (u if corner[0] else v)),
                (u - v) * 128.0,
            )[int(rng.integers(0, 5))]
            tile = blend(colors[ground], colors[motif], share)
            picture = np.where(inside[..., None], tile, picture).astype(np.float32)
    return picture


def _blocks(rng: np.random.Generator, colors: Sequence[str]) -> Picture:
    """Rectangles of colour between black lines."""
    picture = np.broadcast_to(rgb("#f1ede2"), (512, 384, 3)).astype(np.float32)
    todo = [(0, 0, 384, 512)]
    while todo:
        x0, y0, x1, y1 = todo.pop()
        width, height = x1 - x0, y1 - y0
        if max(width, height) > 90 and (max(width, height) > 260 or rng.uniform() < 0.72):
            share = rng.uniform(0.28, 0.72)
            if width > height:
                cut = x0 + int(share * width)
                todo += [(x0, y0, cut, y1), (cut, y0, x1, y1)]
            else:
                cut = y0 + int(share * height)
                todo += [(x0, y0, x1, cut), (x0, cut, x1, y1)]
            continue
        if rng.uniform() < 0.55:
            picture[y0:y1, x0:x1] = rgb(colors[int(rng.integers(len(colors)))])
        picture[y0 : y0 + 6, x0:x1] = picture[y0:y1, x0 : x0 + 6] = 0.07
    return picture


def _contours(rng: np.random.Generator, colors: Sequence[str]) -> Picture:
    """Level lines of a landscape, filled between some of them."""
    height = noise(rng, 2.6)[:, :384]
    level = height * 4.5
    index = np.floor(level).astype(np.int64) % len(colors)
    picture = np.stack([rgb(color) for color in colors])[index]
    slope = np.hypot(*np.gradient(level)) + 1e-4
    line = np.minimum(level % 1.0, 1.0 - level % 1.0) / slope
    return blend("#26282b", picture, line - 0.6)


def _stems(rng: np.random.Generator, colors: Sequence[str]) -> Picture:
    """A pressed plant: stems with pairs of leaves on paper."""
    x, y = texel_grid(384, 512)
    picture = blend("#efe4cc", "#e2d3b4", 0.5 + 0.3 * noise(rng, 1.8)[:, :384])
    for stem in range(3):
        root, lean = 0.5 + 0.05 * (stem - 1), 0.3 * (stem - 1) + rng.uniform(-0.06, 0.06)
        top = rng.uniform(0.16, 0.3)
        color = colors[stem % len(colors)]
        for step in np.linspace(0.0, 1.0, 11):
            base_y = 1.22 - step * (1.22 - top)
            base_x = root + lean * step * step
            size = 0.13 * (1.0 - 0.6 * step) + 0.02
            for side in (-1.0, 1.0):
                angle = -0.5 * np.pi + side * (0.95 - 0.3 * step) + lean
                low_x, low_y = (max(0, int((value - size) * 384)) for value in (base_x, base_y))
                extent = int(2.0 * size * 384) + 2
                window = np.s_[low_y : low_y + extent, low_x : low_x + extent]
                dx, dy = x[window] - base_x, y[window] - base_y
                s = (dx * np.cos(angle) + dy * np.sin(angle)) / size
                t = (dy * np.cos(angle) - dx * np.sin(angle)) / size
                blade = np.abs(t) - 0.9 * np.clip(s, 0.0, 1.0) * np.clip(1.0 - s, 0.0, 1.0)
                blade = np.maximum(blade, 0.016 - np.abs(t))  # the rib stays paper
                inside = np.asarray(np.maximum(blade, np.abs(s - 0.5) - 0.5) * size, np.float32)
                picture[window] = _cover(picture[window], inside, color)
        share = np.clip((1.25 - y) / (1.25 - top), 0.0, 1.0)
        line = np.abs(x - root - lean * share * share) - 0.004
        picture = _cover(picture, np.maximum(line, np.maximum(top - y, y - 1.25)), color)
    return picture


def poster(rng: np.random.Generator, colors: Sequence[str], kind: int) -> Picture:
    """A framed print: hills, shapes, blocks, contours or a plant."""
    return _framed(_POSTERS[kind % len(_POSTERS)](rng, colors), rng)


_POSTERS = (_hills, _shapes, _blocks, _contours, _stems)


def rug(rng: np.random.Generator, colors: Sequence[str]) -> Picture:
    """A woven rug with borders around stepped diamonds, zigzags or a medallion; fits one rug exactly."""
    u, v = texel_grid()
    knots_u, knots_v = np.floor(u * 192.0) / 192.0, np.floor(v * 144.0) / 144.0
    x, y = np.abs(knots_u - 0.5), np.abs(knots_v - 0.5)
    palette = np.stack([rgb(color) for color in colors])
    kind = int(rng.integers(0, 3))
    if kind == 0:
        wave = np.abs((x * 8.0) % 1.0 - 0.5) + np.abs((y * 6.0) % 1.0 - 0.5)
        index = np.floor(wave * 7.0 + rng.integers(0, 4)).astype(np.int64) % len(colors)
    elif kind == 1:
        wave = np.abs((knots_u * 10.0) % 1.0 - 0.5) * 0.5 + knots_v * 7.0
        index = np.floor(wave * 3.0).astype(np.int64)
        index = rng.integers(0, len(colors), 40)[index % 40]
    else:
        medallion = np.floor((x + 0.9 * y) * 18.0).astype(np.int64)
        flower = np.sin(2.0 * np.pi * 14.0 * x) * np.sin(2.0 * np.pi * 10.0 * y) > 0.35
        index = np.where(flower, medallion + 1, medallion // 2) % len(colors)
    border = np.minimum(0.5 - x, (0.5 - y) * 0.75)
    band = np.floor(border * 50.0).astype(np.int64)
    teeth = (np.floor(knots_u * 48.0) + np.floor(knots_v * 36.0)).astype(np.int64) % 2
    edging = np.where(band % 2 == 0, 0, 1 + teeth * (band % 4 == 1)) % len(colors)
    picture = palette[np.where(border < 0.09, edging, index)]
    knot = 0.5 + 0.5 * np.cos(2.0 * np.pi * 192.0 * u) * np.cos(2.0 * np.pi * 144.0 * v)
    wear = 0.82 + 0.16 * knot + 0.06 * noise(rng, 0.4) + 0.05 * noise(rng, 1.6)
    return np.asarray(picture * wear[..., None], np.float32)


def spines(rng: np.random.Generator, colors: Sequence[str]) -> Picture:
    """Backs of books in a grid of cells, each with bands, title bars and worn edges."""
    width, height = 512 // SPINE_COLUMNS, 512 // SPINE_ROWS
    picture = np.empty((512, 512, 3), np.float32)
    across = np.abs(np.linspace(-1.0, 1.0, width, dtype=np.float32))
    for row in range(SPINE_ROWS):
        for column in range(SPINE_COLUMNS):
            ground, ink = rng.choice(len(colors), 2, replace=False)
            cell = np.broadcast_to(rgb(colors[ground]), (height, width, 3)).copy()
            for _ in range(int(rng.integers(1, 4))):
                at = int(rng.integers(6, height - 14))
                cell[at : at + int(rng.integers(2, 9))] = rgb(colors[ink])
            letters = rng.uniform(size=height) < 0.62
            start, end = sorted(rng.integers(20, height - 20, 2))
            for line in range(start, end, 5):  # a title that runs along the spine
                if letters[line]:
                    cell[line : line + 3, width // 3 : 2 * width // 3] = rgb(colors[ink])
            cell *= (1.0 - 0.35 * across**3)[None, :, None]
            picture[row * height : (row + 1) * height, column * width : (column + 1) * width] = cell
    lines = 0.8 + 0.15 * (np.arange(width) % 3 != 0)
    picture[-height:, -width:] = rgb("#efe6d2") * lines[None, :, None]
    return np.asarray(picture * (1.0 + 0.05 * noise(rng, 0.7))[..., None], np.float32)


def screen(rng: np.random.Generator) -> Picture:
    """A text editor on a monitor."""
    picture = np.broadcast_to(rgb("#12161c"), (288, 512, 3)).copy()
    inks = [rgb(color) for color in ("#7fb4e6", "#c792ea", "#e6c07b", "#98c379", "#d8dee9")]
    picture[:16] = rgb("#2a313c")
    picture[:, :70] = rgb("#1a2029")
    for line in range(26, 280, 9):
        x = 84 + 14 * int(rng.integers(0, 4))
        picture[line : line + 3, 10 : 10 + int(rng.integers(14, 50))] = rgb("#5c6773")
        for _ in range(int(rng.integers(0, 6))):
            length = int(rng.integers(8, 60))
            picture[line : line + 4, x : min(x + length, 500)] = inks[int(rng.integers(len(inks)))]
            x += length + 6
            if x > 480:
                break
    return np.asarray(picture, np.float32)


def view(rng: np.random.Generator) -> Picture:
    """Return a picture of the outside: sky with clouds, a hazy town, trees; row 0 is the top."""
    x, y = texel_grid(512, 512)
    picture = blend("#8db9e8", "#e9f1f7", y * 1.5)
    cloud = noise(rng, 1.75, stretch=2.2)
    picture = blend(picture, "#ffffff", (cloud - 0.2) * 0.9 * (1.0 - y))
    for depth in range(3):
        haze = 0.62 - 0.2 * depth
        left = 0
        while left < 512:
            wide = int(rng.integers(24, 80))
            top = int(512 * (0.52 + 0.07 * depth + rng.uniform(0.0, 0.12)))
            wall = rgb(str(rng.choice(["#b9a58c", "#a8836a", "#c8c0b4", "#8f8d8a", "#b06a52"])))
            block = np.broadcast_to(wall * (1 - haze) + rgb("#dfe9f2") * haze, (512 - top, wide, 3)).copy()
            pitch = 8 + 2 * depth
            rows, columns = (np.arange(count) % pitch > pitch // 2 for count in (512 - top, wide))
            block[rows[:, None] & columns] *= 0.72
            visible = min(wide, 512 - left)
            picture[top:, left : left + visible] = block[:, :visible]
            left += wide
    tree = 0.80 + 0.05 * np.sin(2.0 * np.pi * 2.0 * x + 1.0) + 0.035 * noise(rng, 1.1)[:1]
    foliage = blend("#34502c", "#9dbb68", 0.45 + 0.3 * noise(rng, 0.9, coarsest=8.0))
    return blend(picture, foliage, (y - tree) * 120.0)


PAINTERS = (poster, rug, spines, screen, view)
"""What an expression of a texture can use; each takes a source of randomness first."""
