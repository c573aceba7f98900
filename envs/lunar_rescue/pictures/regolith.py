"""What regolith looks like from near: colour and relief of a square tile that repeats without seams, from a seed."""

from functools import lru_cache

import numpy as np

from lunar_rescue.arrays import Array, Floats

CELLS = 512
TILE = 2.4  # m, side of the tile
GREY = (0.56, 0.54, 0.51)
CRATERS = 60
RELIEF = 0.35  # of the slopes; more would look like rocks that nothing collides with


@lru_cache(maxsize=1)
def tile() -> tuple[Floats, Floats]:
    """Return brightness (CELLS, CELLS), mean 1, and slopes along x and y (CELLS, CELLS, 2) of the tile."""
    rng = np.random.default_rng(1969)
    fx, fy = np.meshgrid(*[np.fft.fftfreq(CELLS, 1 / CELLS)] * 2)
    frequency = np.hypot(fx, fy).clip(1.0)
    noise = np.fft.fft2(rng.standard_normal((CELLS, CELLS)))
    fields = [np.fft.ifft2(noise * frequency**power).real for power in (-0.8, -1.9)]
    dust, swell = ((field - field.mean()) / field.std() for field in fields)
    height = 0.006 * swell + _craters(rng)
    slopes = [(np.roll(height, -1, axis) - np.roll(height, 1, axis)) / (2 * TILE / CELLS) for axis in (1, 0)]
    return (1.0 + 0.09 * dust).astype(np.float32), (RELIEF * np.stack(slopes, -1)).astype(np.float32)


def _craters(rng: np.random.Generator) -> Array:
    """Return heights [m] of small bowls with rims."""
    line = np.arange(CELLS) * TILE / CELLS
    height = np.zeros((CELLS, CELLS))
    for x, y, u in rng.uniform(size=(CRATERS, 3)):
        radius = 0.02 / (0.08 + 0.92 * u) ** 0.75  # many small ones
        dx, dy = ((line - at * TILE + TILE / 2) % TILE - TILE / 2 for at in (x, y))
        r = np.hypot(dx[None, :], dy[:, None]) / radius
        height += 0.12 * radius * (np.exp(-(((r - 1.0) / 0.3) ** 2)) - np.exp(-((r / 0.75) ** 4)))
    return height


def surface(x: Floats, y: Floats, away: Floats) -> tuple[Floats, Floats]:
    """Return brightness (n,) and slopes (n, 2) at x, y, fading with the distance ``away`` from the camera, all [m]."""
    brightness, slopes = tile()
    cell = (np.floor(y / TILE * CELLS).astype(int) % CELLS, np.floor(x / TILE * CELLS).astype(int) % CELLS)
    # A second, larger lookup hides that the tile repeats.
    wide = (np.floor(x / TILE * CELLS / 7.3).astype(int) % CELLS, np.floor(y / TILE * CELLS / 7.3).astype(int) % CELLS)
    keep = np.exp(-((away / 8.0) ** 2)).astype(np.float32)
    colour = 1.0 + (brightness[cell] - 1.0) * keep + 0.8 * (brightness[wide] - 1.0)
    return colour, slopes[cell] * keep[:, None] + 0.4 * slopes[wide]
