"""Filtering: what a texture shows at given coordinates.

Texels are looked up in rows that hold every level of every image (see `pyramid`), so the cost at a
point does not depend on how many textures there are. Coordinates are split into a part with few
bits, whose product with an image's size is exact, and the rest: weights are as precise as the
coordinates themselves, for images of up to 4096 texels a side in float32.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from diffrast._check import ArrayInput, float_array
from diffrast._stored import stored
from diffrast.light import Columns
from diffrast.texture.kinds import AnyTexture, CubeTexture, Texture
from diffrast.texture.pyramid import FORWARD, RIGHT, UP, Layout, layout_of, rows_of

# Derivatives of coordinates by the pixel's x and y, as columns: [coordinate][axis].
Slopes = list[Columns]
Number = int | Array  # the same for all points, or one for each


class _Level(NamedTuple):
    """A level of an image; numbers, or arrays of the points' shape."""

    first: Number
    width: Number
    height: Number


def sample_texture(
    texture: AnyTexture, uv: ArrayInput, *, derivatives: ArrayInput | None = None
) -> Float[Array, "*size channels"]:
    """Filtered colours of a texture.

    Differentiable in the texels, in `uv` (but for "nearest") and, through the level of a trilinear
    texture, in `derivatives`; on an edge of a cube as on one of its sides. Coordinates that are not
    finite, or so large that their fraction is lost, give a finite colour. Memory and time for the
    smaller levels are spent in each call.

    Args:
        texture: its own mapping is not used.
        uv: (..., 2) coordinates u to the right and v upwards, in images; for a `CubeTexture`
            (..., 3) directions of any length.
        derivatives: (..., 2, 2) or (..., 3, 2) how each coordinate changes from pixel to pixel, by
            x and by y: `screen_derivatives` tells. Without them a trilinear texture is bilinear.

    Returns:
        (..., channels).

    Raises:
        ValueError: for wrong shapes.

    Example:
        >>> checker = dr.Texture(jnp.array([[[0.0], [1]], [[1], [0]]]), filter="bilinear")
        >>> dr.sample_texture(checker, jnp.array([[0.25, 0.25], [0.5, 0.25]])).tolist()
        [[1.0], [0.5]]
    """
    if not isinstance(texture, Texture | CubeTexture):
        raise ValueError(f"texture: wanted a Texture or CubeTexture, got {type(texture).__name__}")
    count = 3 if isinstance(texture, CubeTexture) else 2
    at = float_array("uv", uv, ("...", count), finite=False)
    slopes = None
    if derivatives is not None:
        wanted = (*at.shape, 2)
        steps = float_array("derivatives", derivatives, wanted, finite=False)
        slopes = [[steps[..., i, j] for j in range(2)] for i in range(count)]
    return _sampled(texture, [at[..., i] for i in range(count)], slopes)


@jax.jit
def _sampled(texture: AnyTexture, coordinates: Columns, slopes: Slopes | None) -> Array:
    layout = layout_of([texture])
    return sample(texture, layout, rows_of([texture]), None, coordinates, slopes)


def sample(
    kind: AnyTexture,
    layout: Layout,
    rows: Float[Array, "texels channels"],
    which: Int[Array, "*size"] | None,
    coordinates: Columns,
    slopes: Slopes | None,
) -> Float[Array, "*size channels"]:
    """Colours of textures that are filtered in the same way.

    Args:
        kind: any of them, for its options.
        layout: where their texels lie in the rows.
        rows: of all of them.
        which: the texture at each point; None if there is but one.
        coordinates: u and v, or a direction.
        slopes: their derivatives; None for the first level.
    """
    if isinstance(kind, CubeTexture):
        side, coordinates, slopes = _on_side(coordinates, slopes)
        wrap = ("border", "border")
    else:
        side, wrap = None, kind.wrap
    if kind.filter != "trilinear" or slopes is None:
        level = _level(layout, which, 0)
        look = _nearest if kind.filter == "nearest" else _bilinear
        return look(rows, level, side, coordinates, wrap)
    size = _level(layout, which, 0)
    steps = [[slope * n for slope in pair] for pair, n in zip(slopes, size[1:], strict=True)]
    last = _table(np.subtract(layout.levels, 1), which)
    count = kind.anisotropy if isinstance(kind, Texture) else 1
    if count == 1:
        height = stored(_clamped(_log2_length(steps), last))
        return _trilinear(rows, layout, which, side, coordinates, wrap, height)
    along, height = _ellipse(steps, count)
    offset = (jnp.arange(count).astype(coordinates[0].dtype) + 0.5) / count - 0.5
    offset = offset.reshape(-1, *(1,) * coordinates[0].ndim)
    axis = stored([jnp.where(along, pair[0], pair[1]) for pair in slopes])
    places = stored([c + offset * a for c, a in zip(coordinates, axis, strict=True)])
    height = stored(_clamped(height, last))
    colors = stored(_trilinear(rows, layout, which, side, places, wrap, height))
    return jnp.mean(colors, axis=0)


# ----------------------------------------------------------------------------------------- levels


def _log2_length(steps: Slopes) -> Array:
    """log2 of the longer of the two vectors by which a pixel steps through the texels.

    Lengths are taken relative to the largest component, which carries no gradient, for it cancels.
    Minus infinity, with derivative 0, where there is no step; plus infinity for infinite ones.
    """
    sizes = [jnp.abs(lax.stop_gradient(part)) for pair in steps for part in pair]
    largest = functools.reduce(jnp.maximum, sizes)
    known = (largest > 0) & (largest < jnp.inf)
    inverse = 1 / jnp.where(known, largest, 1)
    scaled = [[jnp.where(known, part, 0) * inverse for part in pair] for pair in steps]
    squares = [scaled[0][k] * scaled[0][k] + scaled[1][k] * scaled[1][k] for k in range(2)]
    square = jnp.maximum(*squares)
    length = jnp.log2(jnp.where(known, largest, 1)) + jnp.log2(jnp.where(known, square, 1)) / 2
    return jnp.where(known, length, jnp.where(largest > 0, jnp.inf, -jnp.inf))


def _ellipse(steps: Slopes, count: int) -> tuple[Array, Array]:
    """Whether a pixel's step along x is its longer one, and log2 of the width it is filtered to.

    That is the width of the parallelogram across its longer side, or the `count`-th part of that
    side if this is more.
    """
    lengths = [_log2_length([[pair[k], pair[k]] for pair in steps]) for k in range(2)]
    along = lengths[0] >= lengths[1]
    longer = jnp.maximum(*lengths)
    # The area over the longer side, both relative to it.
    known = jnp.abs(longer) < jnp.inf
    unit = jnp.exp2(-jnp.where(known, longer, 0))
    (ax, bx), (ay, by) = ([jnp.where(known, part, 0) * unit for part in pair] for pair in steps)
    area = jnp.abs(ax * by - ay * bx)
    thin = ~(area * count > 1)
    across = jnp.log2(jnp.where(thin, 1, area))
    return along, longer + jnp.where(thin, -jnp.log2(float(count)), across)


def _clamped(height: Array, last: Number) -> Array:
    """The level as a number from 0 to the last one."""
    inside = (height > 0) & (height < last)
    return jnp.where(inside, jnp.where(inside, height, 0), jnp.where(height > 0, last, 0))


def _table(values: tuple[int, ...] | np.ndarray, place: Number | None) -> Number:
    """Entries of a static table: a number where all asked for are the same one."""
    if place is None or len(set(values)) == 1:
        return int(values[0])
    if isinstance(place, int):
        return int(values[place])
    return jnp.asarray(np.asarray(values, np.int32))[place]


def _level(layout: Layout, which: Array | None, number: Number) -> _Level:
    """The level of this number of each point's texture."""
    starts = np.cumsum([0, *layout.levels[:-1]])
    place = _table(starts, which) + number
    return _Level(*(_table(values, place) for values in layout[:3]))


# ---------------------------------------------------------------------------------------- filters


def _trilinear(
    rows: Array,
    layout: Layout,
    which: Array | None,
    side: Array | None,
    at: Columns,
    wrap: tuple[str, str],
    height: Array,
) -> Array:
    low = jnp.floor(lax.stop_gradient(height))
    number = low.astype(jnp.int32)
    last = _table(np.subtract(layout.levels, 1), which)
    fine, coarse = (
        _bilinear(rows, _level(layout, which, n), side, at, wrap)
        for n in (number, jnp.minimum(number + 1, last))
    )
    return fine + (height - low)[..., None] * (coarse - fine)


def _bilinear(
    rows: Array, level: _Level, side: Array | None, at: Columns, wrap: tuple[str, str]
) -> Array:
    (left, right, across), (low, high, up) = (
        _neighbors(c, n, w) for c, n, w in zip(at, level[1:], wrap, strict=True)
    )
    below, above = (
        _mixed(rows[_row(level, side, y, left)], rows[_row(level, side, y, right)], across)
        for y in (low, high)
    )
    return _mixed(below, above, up)


def _nearest(
    rows: Array, level: _Level, side: Array | None, at: Columns, wrap: tuple[str, str]
) -> Array:
    x, y = (_texel(c, n, w) for c, n, w in zip(at, level[1:], wrap, strict=True))
    return rows[_row(level, side, y, x)]


def _mixed(one: Array, other: Array, share: Array) -> Array:
    share = share[..., None]
    return (1 - share) * one + share * other


def _row(level: _Level, side: Array | None, y: Array, x: Array) -> Array:
    """Index of a texel in the rows; y counts from the bottom."""
    if side is None:
        return level.first + (level.height - 1 - y) * level.width + x
    width = level.width + 2
    return level.first + (side * width + level.height - y) * width + x + 1


def _folded(coordinate: Array, wrap: str) -> tuple[Array, Array]:
    """The same place within the image, 0 to 1, as a sum of two.

    The first is a multiple of a power of two, so that no product with an image's size rounds it;
    it has no derivative. Coordinates whose fraction is lost count as 0.
    """
    bits = (jnp.finfo(coordinate.dtype).nmant + 1) // 2
    known = jnp.abs(coordinate) < 2.0 ** (2 * bits)
    coordinate = jnp.where(known, coordinate, 0)
    if wrap not in ("repeat", "mirror"):
        # By comparisons: at 0 and 1, the edges of a cube, `jnp.clip` takes half of the derivative.
        coordinate = jnp.where(coordinate > 1, 1, jnp.where(coordinate < 0, 0, coordinate))
    place = lax.stop_gradient(coordinate)
    high = jnp.round(place * 2.0**bits) / 2.0**bits
    low = coordinate - high
    if wrap == "repeat":
        return high - jnp.floor(place), low
    if wrap == "mirror":
        high = high - 2 * jnp.floor(place / 2)
        returns = high + lax.stop_gradient(low) > 1
        return jnp.where(returns, 2 - high, high), jnp.where(returns, -low, low)
    return high, low


def _in_texels(coordinate: Array, size: Number, wrap: str) -> tuple[Array, Array]:
    high, low = _folded(coordinate, wrap)
    size = jnp.asarray(size, coordinate.dtype)
    return high * size, low * size


def _neighbors(coordinate: Array, size: Number, wrap: str) -> tuple[Array, Array, Array]:
    """The texels on both sides of a coordinate, and the share of the second."""
    high, low = _in_texels(coordinate, size, wrap)
    high = high - 0.5
    first = jnp.floor(high + lax.stop_gradient(low))
    share = (high - first) + low
    start = jnp.clip(first.astype(jnp.int32), -1, size - 1)
    end = start + 1
    if wrap == "repeat":
        return jnp.where(start < 0, size - 1, start), jnp.where(end >= size, 0, end), share
    if wrap == "border":
        return start, end, share
    return jnp.maximum(start, 0), jnp.minimum(end, size - 1), share


def _texel(coordinate: Array, size: Number, wrap: str) -> Array:
    high, low = _in_texels(lax.stop_gradient(coordinate), size, wrap)
    return jnp.clip(jnp.floor(high + low).astype(jnp.int32), 0, size - 1)


# ------------------------------------------------------------------------------------------ cubes


def _on_side(direction: Columns, slopes: Slopes | None) -> tuple[Array, Columns, Slopes | None]:
    """The side of the cube that a direction meets, where on it (0 to 1), and the slopes there."""
    sizes = [jnp.abs(lax.stop_gradient(part)) for part in direction]
    along_x = (sizes[0] >= sizes[1]) & (sizes[0] >= sizes[2])
    axis = jnp.where(along_x, 0, jnp.where(sizes[1] >= sizes[2], 1, 2))
    largest = jnp.where(axis == 0, direction[0], jnp.where(axis == 1, direction[1], direction[2]))
    side = 2 * axis + jnp.where(largest < 0, 1, 0)
    frame = [_turned_to(side, table, direction) for table in (FORWARD, RIGHT, UP)]
    known = (frame[0] > 0) & (frame[0] < jnp.inf)
    inverse = jnp.where(known, 1, 0) / jnp.where(known, frame[0], 1)
    at = [jnp.where(known, part, 0) * inverse for part in frame[1:]]
    places = [part / 2 + 0.5 for part in at]
    if slopes is None:
        return side, places, None
    turned = [
        [_turned_to(side, table, [pair[k] for pair in slopes]) for k in range(2)]
        for table in (FORWARD, RIGHT, UP)
    ]
    here = [
        [(turned[i + 1][k] - at[i] * turned[0][k]) * inverse / 2 for k in range(2)]
        for i in range(2)
    ]
    return side, places, here


def _turned_to(side: Array, table: np.ndarray, vector: Columns) -> Array:
    """Component of vectors along each side's own axis: one of ±x, ±y, ±z."""
    signed = [sign * part for part in vector for sign in (1, -1)]
    place = [int(2 * np.argmax(np.abs(row)) + (row.sum() < 0)) for row in table]
    result = signed[place[5]]
    for number in range(5):
        result = jnp.where(side == number, signed[place[number]], result)
    return result
