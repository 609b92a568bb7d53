"""Pyramids of images, each level half the size of the one before, down to one texel.

A level is the one before under a box filter, so that all have the same mean; together they hold at
most a third more than the image (FEATURES X3). Of an odd number of texels 2 m + 1 the box that
becomes texel i of m covers three: m - i of the first, m of the second and i + 1 of the third, all
over 2 m + 1. A pyramid is stored as rows, one a texel, all levels and all images one behind the
other; where each begins is known from shapes alone (`Layout`).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from diffrast._stored import stored
from diffrast.texture.kinds import AnyTexture, CubeTexture, texels

# Views of a cube's sides: along +x, -x, +y, -y, +z, -z; right and up in the image.
FORWARD = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
UP = np.array([[0, 1, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0, 1, 0], [0, 1, 0]])
RIGHT = np.cross(FORWARD, UP)


class Layout(NamedTuple):
    """Where the levels of images lie in their rows; static. One entry a level, in order.

    Attributes:
        first: row of the level's first texel.
        width: its columns, without a cube's border.
        height: its rows.
        levels: how many levels each image has.
    """

    first: tuple[int, ...]
    width: tuple[int, ...]
    height: tuple[int, ...]
    levels: tuple[int, ...]


def layout_of(textures: list[AnyTexture]) -> Layout:
    """How `rows_of` stores textures."""
    first, width, height, levels = [0], [], [], []
    for texture in textures:
        sizes = _level_sizes(texture)
        border, sides = (2, 6) if isinstance(texture, CubeTexture) else (0, 1)
        for rows, columns in sizes:
            height.append(rows)
            width.append(columns)
            first.append(first[-1] + sides * (rows + border) * (columns + border))
        levels.append(len(sizes))
    return Layout(tuple(first[:-1]), tuple(width), tuple(height), tuple(levels))


def rows_of(textures: list[AnyTexture]) -> Float[Array, "texels channels"]:
    """All texels of all levels of textures."""
    rows = []
    for texture in textures:
        for level in pyramid(texels(texture), len(_level_sizes(texture))):
            level = with_border(level) if isinstance(texture, CubeTexture) else level
            rows.append(level.reshape(-1, level.shape[-1]))
    return rows[0] if len(rows) == 1 else jnp.concatenate(rows)


def pyramid(
    image: Float[Array, "*cube height width channels"], levels: int
) -> list[Float[Array, "*cube _ _ channels"]]:
    """The image and the levels above it, differentiable in it."""
    images = [image]
    for _ in range(levels - 1):
        images.append(stored(_halved(_halved(images[-1], -3), -2)))
    return images


def with_border(images: Float[Array, "6 size size channels"]) -> Array:
    """The sides of a cube with a border of one texel, taken from the sides that meet there.

    Where three sides meet stands the mean of their texels. So bilinear interpolation within a
    bordered side gives the same colours from either side of an edge.
    """
    size = images.shape[1]
    padded = images.reshape(6 * size * size, -1)[_border_texels(size)]
    ends, inner = np.array([0, size + 1]), np.array([1, size])
    row, column = np.meshgrid(ends, ends, indexing="ij")
    near_row, near_column = np.meshgrid(inner, inner, indexing="ij")
    corner = (
        padded[:, near_row, near_column] + padded[:, near_row, column] + padded[:, row, near_column]
    )
    return padded.at[:, row, column].set(corner / 3)


def _level_sizes(texture: AnyTexture) -> list[tuple[int, int]]:
    height, width = texels(texture).shape[-3:-1]
    sizes = [(height, width)]
    while texture.filter == "trilinear" and sizes[-1] != (1, 1):
        sizes.append((max(sizes[-1][0] // 2, 1), max(sizes[-1][1] // 2, 1)))
    return sizes


def _halved(image: Array, axis: int) -> Array:
    """Half as many texels along an axis, -3 or -2."""
    count = image.shape[axis]
    half = count // 2
    if half == 0:
        return image

    def every_second(start: int) -> Array:
        return lax.slice_in_dim(image, start, start + 2 * half - 1, 2, axis)

    first, second = every_second(0), every_second(1)
    if count % 2 == 0:
        return (first + second) * 0.5
    place = np.arange(half).reshape(-1, *(1,) * (-axis - 1))
    shares = [np.asarray(s / count, image.dtype) for s in (half - place, half, place + 1)]
    return shares[0] * first + shares[1] * second + shares[2] * every_second(2)


def _border_texels(size: int) -> np.ndarray:
    """Which texel of the six images stands at each place of the bordered sides."""
    at = (2 * np.arange(-1, size + 1) + 1) / size - 1  # -1 to 1 over the side itself
    t, s = np.meshgrid(-at, at, indexing="ij")
    s, t = s[..., None], t[..., None]
    inside = np.abs(s) < 1, np.abs(t) < 1
    edge = 1 - 1 / size
    # Beyond an edge lies the first texel of the next side: full size along this side's axis there.
    s, t = (np.where(i, x, np.sign(x)) for i, x in zip(inside, (s, t), strict=True))
    s = np.where(~inside[0] & ~inside[1], np.sign(s) * edge, s)
    away = np.where(inside[0] & inside[1], 1, edge)
    directions = [away * f + s * r + t * u for f, r, u in zip(FORWARD, RIGHT, UP, strict=True)]
    d = np.stack(directions)
    side = np.argmax(d @ FORWARD.T, axis=-1)
    across, above = np.sum(d * RIGHT[side], axis=-1), np.sum(d * UP[side], axis=-1)
    # Corners, which are overwritten, lie on no texel's centre.
    column = np.clip(np.rint((across + 1) * size / 2 - 0.5), 0, size - 1).astype(np.int32)
    row = np.clip(np.rint((1 - above) * size / 2 - 0.5), 0, size - 1).astype(np.int32)
    return ((side * size + row) * size + column).astype(np.int32)
