"""The planes of faces, evaluated at points of the screen.

All in homogeneous coordinates x, y, w of the corners, so that faces may reach behind the camera,
and relative to the point, so that small faces far from the image's origin lose nothing.
"""

from functools import reduce
from operator import add

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._stored import stored, stored_together

TOLERANCE = 1e-4  # of 1/w: surfaces nearer to one another than this touch
FINE_TOLERANCE = 1e-3  # of 1/w: the same between faces of one surface, and for tiny ones
_BEYOND = 1e-4  # pixels from the edge to the point that shows what is behind it,
_ROUNDINGS = 8  # of a position, if that is more
ASIDE = 1e-4  # pixels from a line to a centre that it must not pass
_TO_THE_LEFT = 2.0**-14  # pixels: as much as squares of pixels lie to the left of, and above, them

Columns = list[Float[Array, "*n"]]
Table = Float[Array, "3 V"]  # vertices in homogeneous pixel coordinates x, y, w


def cross_rows(a: Array, b: Array) -> Array:
    """Cross products of vectors whose three components are rows."""
    return jnp.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def dot_rows(a: Array, b: Array) -> Array:
    """Dot products, row by row: a reduction of so few would be a call into a library.

    Those of `b` may be integers: steps between pixels.
    """
    return reduce(add, [x * y.astype(x.dtype) for x, y in zip(a, b, strict=True)])


def largest(vectors: Array) -> Array:
    """The largest size of the components, which are rows."""
    return reduce(jnp.maximum, [abs(row) for row in vectors])


def nearest_first(corners: list[Array]) -> tuple[Array, Array, Array]:
    """The three corners of faces, each (x, y, w; ...), in turn, beginning with the smallest.

    What is computed from the differences to a corner near the eye loses nothing.
    """
    size = [largest(corner) for corner in corners]
    second = (size[1] < size[0]) & (size[1] <= size[2])
    third = (size[2] < size[0]) & (size[2] < size[1])

    def turned(first: int) -> Array:
        one, two, three = (corners[(first + k) % 3] for k in range(3))
        return jnp.where(third, three, jnp.where(second, two, one))

    return turned(0), turned(1), turned(2)


def corners_of(face: Int[Array, "*n"], faces: Int[Array, "F 3"], pixels: Table) -> Array:
    """x, y and w of the three corners of faces, shape (3, 3, *n)."""
    return stored(pixels[:, stored(faces.T[:, jnp.maximum(face, 0)])])


def from_centre(vertices: Array, pixel: Int[Array, "2 n"]) -> Array:
    """x, y and w of vertices on the screen, from pixels' centres."""
    x, y, w = vertices
    centre = pixel.astype(w.dtype) + 0.5
    moved = jnp.broadcast_arrays(x - centre[0] * w, y - centre[1] * w, w)
    return stored(jnp.stack(moved))


def edge_values(
    corners: Array, x: Array, y: Array, near: tuple[Array, Array] | None = None
) -> tuple[Columns, Array]:
    """Three values that are positive inside of faces and linear on the screen, and 1/w.

    1/w is -1 on faces seen edge-on. Multiplied by what they add up to, barycentric coordinates
    become the values, up to one sign. Where many points lie `near` one, as far as rounding is
    concerned, the faces' volume is found there, and once.
    """
    e, volume = edge_functions(corners, x, y)
    if near is not None:
        volume = stored(edge_functions(corners, *near)[1])
    sign = jnp.where(volume < 0, -1, 1)
    values = [value * sign for value in e]
    total = values[0] + values[1] + values[2]
    depth = jnp.where(volume == 0, -1, total / jnp.where(volume == 0, 1, abs(volume)))
    *values, depth = stored_together([*values, depth])
    return values, depth


def lowest(values: Columns) -> tuple[Array, Int[Array, "*n"]]:
    """The lowest of three values, and which one it is, 0 to 2: the first of equal ones."""
    least = jnp.minimum(jnp.minimum(values[0], values[1]), values[2])
    which = jnp.where(values[0] == least, 0, jnp.where(values[1] == least, 1, 2))
    return least, which.astype(jnp.int32)


def edge_functions(corners: Array, x: Array, y: Array) -> tuple[Columns, Array]:
    """Three values of one sign inside of faces, and the volume det(x, y, w), which has that sign.

    The value of a corner belongs to the edge opposite to it.
    """
    w = corners[2]
    u = [corner - x * w[i] for i, corner in enumerate(corners[0])]
    v = [corner - y * w[i] for i, corner in enumerate(corners[1])]
    e = [
        u[1] * v[2] - u[2] * v[1],
        u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0],
    ]
    return e, e[0] * w[0] + e[1] * w[1] + e[2] * w[2]


def covers(values: Columns) -> Bool[Array, "*n"]:
    """Whether faces cover a point, from their values there."""
    return (values[0] >= 0) & (values[1] >= 0) & (values[2] >= 0)


def locate(corners: Array, x: Array, y: Array) -> tuple[Bool[Array, "*n"], Columns]:
    """Whether faces cover points, and the barycentric coordinates there on their planes."""
    values, depth = edge_values(corners, x, y)
    return covers(values) & (depth > 0), barycentrics(values)


def barycentrics(values: Columns) -> Columns:
    """Barycentric coordinates on the planes of faces, from their values."""
    total = values[0] + values[1] + values[2]
    inverse_total = 1 / jnp.where(total == 0, 1, total)
    return [value * inverse_total for value in values]


def inverse_depth_slope(corners: Array, volume: Array, direction: Array) -> Array:
    """Change of 1/w along a direction (2, n) on the screen; 0 on faces seen edge-on.

    `volume` is that of the faces, as exact as `facing` finds it.
    """
    gx, gy, _ = cross_rows(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    seen = abs(volume) > jnp.finfo(volume.dtype).tiny
    return jnp.where(seen, gx * direction[0] + gy * direction[1], 0) / jnp.where(seen, volume, 1)


def area(corners: Array) -> Array:
    """Twice the area of faces on the screen; infinite if they reach behind the camera."""
    before = jnp.all(corners[2] > 0, axis=0)
    x, y = corners[:2] / jnp.where(before, corners[2], 1)
    twice = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    return jnp.where(before, abs(twice), jnp.inf)


def room_in_pixel(x: Array, y: Array) -> list[Array]:
    """Four values that are positive in a pixel, from its centre, and linear on the screen.

    A line along the border between two pixels belongs to the one on its right, or below it, and by
    so much that rounding does not give it to both, or to none.
    """
    return [
        0.5 - _TO_THE_LEFT - x,
        0.5 + _TO_THE_LEFT + x,
        0.5 - _TO_THE_LEFT - y,
        0.5 + _TO_THE_LEFT + y,
    ]


def beside_edge(shape: tuple[int, ...], dtype: jnp.dtype) -> tuple[float, float, float]:
    """Pixels from edges to the points that show what hides them, inside, and what is beyond.

    As few as rounding leaves certain: where fine surfaces fold, others lie as near. The last, by
    which a vertex itself may be rounded, is enough inside for what hides a face of its own surface.
    """
    rounding = float(jnp.finfo(dtype).eps) * max(shape)
    outside = max(_BEYOND, _ROUNDINGS * rounding)
    return 2 * outside, outside, rounding
