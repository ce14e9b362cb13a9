"""Procedural textures: small images that repeat without a seam."""

import numpy as np
from jaxtyping import Float, UInt8

SIDE = 128
"""Side of a texture, pixels."""

Image = UInt8[np.ndarray, "s s 3"]
Grey = Float[np.ndarray, "s s"]


def noise(rng: np.random.Generator, across: float, along: float) -> Grey:
    """Return smooth periodic noise, mean 0 and deviation 1; features span `across` x `along` of the image (u, v)."""
    u, v = np.fft.fftfreq(SIDE)[None, :] * SIDE, np.fft.fftfreq(SIDE)[:, None] * SIDE
    weight = np.exp(-((u * across) ** 2) - (v * along) ** 2)
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((SIDE, SIDE))) * weight).real
    return np.asarray((field - field.mean()) / max(float(field.std()), 1e-9))


def _image(grey: Grey, tint: Grey | None = None) -> Image:
    """Return a brightness around 1 as an image, with 1 at level 220 for headroom; a positive `tint` reddens."""
    tint = np.zeros_like(grey) if tint is None else tint
    channels = np.stack([grey * (1 + tint), grey, grey * (1 - tint)], axis=-1)
    return _pixels(channels * 220)


def _pixels(levels: Float[np.ndarray, "s s 3"]) -> Image:
    return np.asarray(np.clip(levels, 0, 255), np.uint8)


def wood(rng: np.random.Generator) -> Image:
    """Draw wood with its grain along v."""
    rings = np.sin(6.0 * noise(rng, 0.06, 0.9) + 2.5 * noise(rng, 0.25, 0.9))
    return _image(1 + 0.06 * rings + 0.05 * noise(rng, 0.012, 0.25), 0.015 * noise(rng, 0.1, 0.8))


def planks(rng: np.random.Generator) -> Image:
    """Draw floor boards along v, each with a shade and a joint."""
    boards = int(rng.integers(5, 8))
    row, column = np.indices((SIDE, SIDE))
    board = column * boards // SIDE
    shade, joint = rng.normal(0, 0.07, boards)[board], rng.integers(0, SIDE, boards)[board]
    gap = (np.abs(column - np.round((board + 0.5) * SIDE / boards)) > SIDE / boards / 2 - 1) | (row == joint)
    return _image(
        (1 + shade + 0.05 * noise(rng, 0.01, 0.25)) * np.where(gap, 0.6, 1.0), 0.015 * noise(rng, 0.08, 0.5)
    )


def herringbone(rng: np.random.Generator) -> Image:
    """Draw parquet of short blocks in alternating directions."""
    row, column = np.indices((SIDE, SIDE))
    block = SIDE // 4
    turned = (row // block + column // block) % 2 == 1
    strip = np.where(turned, row, column) % (block // 4)
    number = (row // block * 4 + column // block) * 4 + np.where(turned, row, column) % block // (block // 4)
    shade = rng.normal(0, 0.08, number.max() + 1)[number]
    return _image((1 + shade + 0.03 * noise(rng, 0.03, 0.03)) * np.where(strip == 0, 0.65, 1.0))


def tiles(rng: np.random.Generator) -> Image:
    """Draw four by four square tiles with grout."""
    row, column = np.indices((SIDE, SIDE))
    side = SIDE // 4
    shade = rng.normal(0, 0.03, (4, 4))[row // side, column // side]
    grout = (row % side < 2) | (column % side < 2)
    return _image((1 + shade + 0.03 * noise(rng, 0.1, 0.1)) * np.where(grout, 0.72, 1.0))


def plaster(rng: np.random.Generator) -> Image:
    """Draw an almost plain painted wall."""
    return _image(1 + 0.012 * noise(rng, 0.02, 0.02) + 0.015 * noise(rng, 0.2, 0.2))


def wallpaper(rng: np.random.Generator) -> Image:
    """Draw wallpaper with soft stripes or dots."""
    row, column = np.indices((SIDE, SIDE)) / SIDE * 2 * np.pi
    count = int(rng.integers(3, 8))
    stripes = np.sign(np.sin(count * column))
    dots = np.sin(count * column) * np.sin(count * row) > 0.6
    pattern = stripes if rng.random() < 0.5 else dots.astype(np.float64)
    return _image(1 + 0.06 * pattern + 0.01 * noise(rng, 0.02, 0.02))


def fabric(rng: np.random.Generator) -> Image:
    """Draw woven fabric."""
    row, column = np.indices((SIDE, SIDE))
    weave = ((row // 2 + column // 2) % 2) * 2.0 - 1
    return _image(1 + 0.05 * weave + 0.05 * noise(rng, 0.008, 0.008) + 0.03 * noise(rng, 0.1, 0.1))


def stripes(rng: np.random.Generator) -> Image:
    """Draw striped cloth."""
    column = np.indices((SIDE, SIDE))[1]
    bands = rng.integers(4, 9)
    dark = (column * bands // SIDE) % 2
    return _image(np.where(dark, rng.uniform(0.55, 0.8), 1.0) + 0.04 * noise(rng, 0.008, 0.008))


def carpet(rng: np.random.Generator) -> Image:
    """Draw the pile of a carpet."""
    return _image(1 + 0.09 * noise(rng, 0.006, 0.006) + 0.04 * noise(rng, 0.1, 0.1))


def rug(rng: np.random.Generator) -> Image:
    """Draw a rug with a border around lozenges; one tile covers the rug."""
    row, column = np.indices((SIDE, SIDE))
    edge = np.minimum.reduce([row, column, SIDE - 1 - row, SIDE - 1 - column])
    lozenge = (np.abs(row - SIDE / 2) + np.abs(column - SIDE / 2)) // int(rng.integers(6, 16)) % 2
    levels = rng.uniform(0.45, 1.1, 4)
    grey = np.where(lozenge > 0, levels[0], levels[1])
    grey = np.where(edge < 14, levels[2], grey)
    grey = np.where((edge < 18) & (edge > 12), levels[3], grey)
    return _image(grey + 0.06 * noise(rng, 0.006, 0.006), 0.15 * np.where(lozenge > 0, 1.0, -1.0))


def marble(rng: np.random.Generator) -> Image:
    """Draw marble with veins."""
    veins = np.abs(noise(rng, 0.1, 0.1)) < 0.06
    return _image(1 + 0.04 * noise(rng, 0.15, 0.15) + 0.05 * noise(rng, 0.01, 0.01) - 0.12 * veins)


def painting(rng: np.random.Generator) -> Image:
    """Draw a picture: patches of colour over a horizon."""
    first, second = noise(rng, 0.25, 0.12), noise(rng, 0.12, 0.12)
    shades = rng.uniform(0.15, 1.0, (4, 3))
    patch = (first > 0).astype(int) * 2 + (second + np.linspace(-1, 1, SIDE)[:, None] > 0)
    grain = 1 + 0.08 * noise(rng, 0.02, 0.02)[..., None]
    return _pixels(shades[patch] * grain * 235)


def sky(rng: np.random.Generator) -> Image:
    """Draw the view from a window: bright sky above a blurred skyline or trees."""
    height = np.linspace(0, 1, SIDE)[::-1, None] + 0 * np.zeros((1, SIDE))
    ground = height < 0.32 + 0.08 * noise(rng, 0.1, 4.0)
    day = np.stack(
        [0.80 + 0.12 * (1 - height), 0.88 + 0.08 * (1 - height), np.full_like(height, 0.99)], axis=-1
    )
    land = np.array([0.45, 0.55, 0.42]) * (1 + 0.12 * noise(rng, 0.05, 0.05))[..., None]
    return _pixels(np.where(ground[..., None], land, day) * 255)
