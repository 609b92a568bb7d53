"""Edge functions and depth planes of faces.

Edge functions. With snapped end points a, b and pixel centre p in grid steps, E(p) = A (p.x - a.x)
+ B (p.y - a.y), A = a.y - b.y, B = b.x - a.x, is positive inside. Centres are whole pixels apart,
so `floor((E - bias) / steps)` changes by exactly A and B from pixel to pixel, and its sign is that
of E - bias; bias is 0 on top and left edges and 1 on others, which gives a centre on a shared edge
to one owner. Where int32 might overflow, float32 knows the sign and the value saturates.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jax.typing import ArrayLike

from diffrast._compensated import difference_of_products
from diffrast._stored import stored, stored_together
from diffrast.raster.fixed_point import (
    FAR,
    GUARD_BITS,
    IRREGULAR,
    NEAR,
    Vertices,
    first_centre,
    maximum3,
    minimum3,
    pixel_range,
    twice_area_sign,
)

TILE = (32, 32)  # rows and columns, powers of two: from its corner on a large face is evaluated

# |A columns + B rows| over a tile, with |A|, |B| <= 2**23, stays below this, and this plus that
# stays below 2**31: a saturated edge value keeps its sign all over the tile.
_SATURATED = 1 << 29


class Image(NamedTuple):
    """Static sizes: pixels, and log2 of the grid steps a pixel."""

    height: int
    width: int
    bits: int


class Corners(NamedTuple):
    """Corners of faces, (3, n) columns, the smallest first in the same cyclic order.

    Differences from the first are taken: from a large one they would lose all digits of corners
    next to the eye.
    """

    own: Vertices
    start: Vertices  # of the edge opposite to each
    end: Vertices
    scale: Array  # (n,), the size of the largest


def corners_of(vertices: Vertices, faces: Array, chunk: Array) -> Corners:
    """The corners of some faces."""
    corners = faces[chunk].T
    sizes = _largest(
        stored_together([column[corners] for column in (vertices.x, vertices.y, vertices.w)])
    )
    smallest = jnp.argmin(sizes, axis=0)
    # Own corner, start and end: each the next of the one before.
    turned = (jnp.arange(3)[:, None, None] + jnp.arange(3)[:, None] + smallest) % 3
    index = stored(corners[turned, jnp.arange(chunk.size)])
    columns = stored_together([column[index] for column in vertices])
    own, start, end = (Vertices(*(column[k] for column in columns)) for k in range(3))
    return Corners(own, start, end, maximum3(list(sizes)))


class Edge(NamedTuple):
    """Edges, the three of a face along the first axis: A column + B row + K at a pixel."""

    a: Array
    b: Array
    k: Array  # wraps in int32
    anchor_x: Array  # a point on the edge, in pixel indices
    anchor_y: Array
    run: Array  # columns to the right that make up for one row down: -B / A, or 0


class Plane(NamedTuple):
    """A function affine over the image: value + dx (column - x) + dy (row - y)."""

    value: Array
    dx: Array
    dy: Array
    x: Array
    y: Array


class Sweep(NamedTuple):
    """Faces of any size, ready to be drawn; faces lie along the last axis of every member.

    The first plane is the depth key; any others are not negative between near and far.
    """

    edges: Edge
    planes: Plane
    key_range: tuple[Array, Array]
    columns: tuple[Array, Array]  # first and last
    rows: tuple[Array, Array]


def _anchored_edge(x: Array, y: Array, a: Array, b: Array, sign: Array, image: Image) -> Edge:
    """Edge through a fixed-point anchor (x, y) with the integer normal (a, b) times `sign`.

    With the anchor split into whole pixels and a rest of at most one, E / steps is the sum of an
    integer product, which may wrap, and of a rest that is small enough to be computed exactly.
    """
    bits, steps = image.bits, 1 << image.bits
    a, b = a * sign, b * sign
    x, y = x - first_centre(image.width, bits), y - first_centre(image.height, bits)
    whole_x, whole_y = x >> bits, y >> bits
    rest_x, rest_y = x - (whole_x << bits), y - (whole_y << bits)
    a_high, b_high = a >> bits, b >> bits
    a_low, b_low = a - (a_high << bits), b - (b_high << bits)
    low = (-a_low * rest_x - b_low * rest_y - bias(a, b)) >> bits
    k = low - a_high * rest_x - b_high * rest_y - a * whole_x - b * whole_y
    run = -b / jnp.where(a == 0, 1, a)
    return Edge(a, b, k, x / steps, y / steps, run)


def set_up(faces: Corners, image: Image, cull_backfaces: bool) -> Sweep:
    """Faces with any vertices: edges as lines of homogeneous coordinates, near and far per pixel.

    e_i(p) = p · (v_j × v_k) is proportional to the barycentric coordinate i times 1/w, and an
    attribute u with corner values u_i has u / w = Σ e_i(p) u_i / det on the face (Olano and Greer,
    "Triangle scan conversion using 2D homogeneous coordinates", 1997). So every edge and plane is
    the dot product of p = (x, y, 1) with a vector, whatever the signs of w.
    """
    corners, scale = faces.own, faces.scale
    inverse_scale = 1 / jnp.where(scale > 0, scale, 1)
    points = [column * inverse_scale for column in (corners.x, corners.y, corners.w)]
    # (v_1 - v_0) × (v_2 - v_0), v_2 × v_0 and v_0 × v_1, for each the three components.
    crosses = _cross(
        [jnp.stack([c[1] - c[0], c[2], c[0]]) for c in points],
        [jnp.stack([c[2] - c[0], c[0], c[1]]) for c in points],
    )
    determinant = sum(point[0] * cross[0] for point, cross in zip(points, crosses, strict=True))
    orientation = jnp.sign(determinant)

    size = jnp.abs(determinant) * scale
    inverse_size = jnp.where(size > 0, orientation / jnp.where(size > 0, size, 1), 0)
    # Numerators Σ e_i u_i of the key and of the distances from the near and the far plane.
    depths = corners.z * inverse_scale
    values = jnp.stack([corners.rank, points[2] + depths, points[2] - depths], axis=1)
    crossing = jnp.any((corners.outcode & (NEAR | FAR)) != 0, axis=0)
    limit = jnp.where(crossing, orientation, 0)
    factors = jnp.stack([inverse_size, limit, limit])
    value_0, value_1, value_2 = values
    dx, dy, value = (
        (value_0 * cross[0] + (value_1 - value_0) * cross[1] + (value_2 - value_0) * cross[2])
        * factors
        for cross in crosses
    )
    centre_x, centre_y = (jnp.full_like(value, (n - 1) / 2) for n in (image.width, image.height))

    in_front = corners.w > 0
    ratios = list(corners.rank / jnp.where(in_front, corners.w, 1))
    bounded = jnp.all(in_front, axis=0)
    infinite = jnp.asarray(jnp.inf, scale.dtype)
    # y points down: a front face, counter-clockwise to the viewer, has a negative determinant.
    # With a sign of zero the edges leave nothing inside.
    regular = jnp.all((corners.outcode & IRREGULAR) == 0, axis=0)
    x_fixed, y_fixed = list(corners.x_fixed), list(corners.y_fixed)
    turn = jnp.where(regular, twice_area_sign(x_fixed, y_fixed), orientation.astype(jnp.int32))
    drawn = (turn < 0) if cull_backfaces else (turn != 0)
    sign = jnp.where(drawn, turn, 0)

    def extent(fixed: list[Array], size: int) -> tuple[Array, Array]:
        first, last = pixel_range(minimum3(fixed), maximum3(fixed), size=size, bits=image.bits)
        last = jnp.where(regular, last, size - 1)
        return jnp.where(regular, first, 0), jnp.where(drawn, last, -1)

    return Sweep(
        _homogeneous_edge(faces.start, faces.end, sign, image),
        Plane(value, dx, dy, centre_x, centre_y),
        (
            jnp.where(bounded, minimum3(ratios), -infinite),
            jnp.where(bounded, maximum3(ratios), infinite),
        ),
        extent(x_fixed, image.width),
        extent(y_fixed, image.height),
    )


def _homogeneous_edge(start: Vertices, end: Vertices, sign: Array, image: Image) -> Edge:
    """Integer edge of a face; it depends on its two end points alone.

    Between regular ends the edge is that of every other face. With one regular end it passes
    exactly through the snapped end, so that a fan round a vertex in view has no gaps, towards the
    other. Between two ends that are not regular it is their line, anchored where it comes nearest
    to the image centre, or without a zero in the image if that is farther than all of the image.
    """
    start_regular, end_regular = ((c.outcode & IRREGULAR) == 0 for c in (start, end))
    one, both = start_regular != end_regular, start_regular & end_regular

    # One regular end: direction towards the other, as the regular end sees it.
    near = Vertices(*(jnp.where(start_regular, s, e) for s, e in zip(start, end, strict=True)))
    far = Vertices(*(jnp.where(start_regular, e, s) for s, e in zip(start, end, strict=True)))
    inverse_w = 1 / jnp.where(one | both, near.w, 1)
    other = _unit_point(far)
    turn = jnp.where(start_regular, 1, -1)
    toward_x = (other[0] - near.x * inverse_w * other[2]) * turn
    toward_y = (other[1] - near.y * inverse_w * other[2]) * turn

    # No regular end: the line through both, computed from the same operands by both owners.
    first, second = _unit_point(start), _unit_point(end)
    swap = _sorts_after(first, second)
    first, second = (
        [jnp.where(swap, s, f) for f, s in zip(first, second, strict=True)],
        [jnp.where(swap, f, s) for f, s in zip(first, second, strict=True)],
    )
    line = [jnp.where(swap, -component, component) for component in _cross(first, second)]
    square = line[0] * line[0] + line[1] * line[1]
    foot = -line[2] / jnp.where(square > 0, square, 1)
    foot_x, foot_y = line[0] * foot, line[1] * foot
    # The image may fill the guard band, whose corners are √2 times farther than its sides.
    limit = 1.5 * (1 << (GUARD_BITS - image.bits))
    crosses = (square > 0) & (jnp.maximum(jnp.abs(foot_x), jnp.abs(foot_y)) <= limit)

    normal_x = jnp.where(one, -toward_y, jnp.where(crosses, line[0], 0))
    normal_y = jnp.where(one, toward_x, jnp.where(crosses, line[1], 0))
    length = jnp.maximum(jnp.abs(normal_x), jnp.abs(normal_y))
    unit = float(1 << GUARD_BITS) / jnp.where(length > 0, length, 1)

    def integer(values: Array) -> Array:
        return jnp.round(values).astype(jnp.int32)

    def fixed(regular: Array, foot: Array) -> Array:
        return jnp.where(
            one | both, regular, integer(jnp.where(crosses, foot, 0) * (1 << image.bits))
        )

    edge = _anchored_edge(
        fixed(near.x_fixed, foot_x),
        fixed(near.y_fixed, foot_y),
        jnp.where(both, start.y_fixed - end.y_fixed, integer(normal_x * unit)),
        jnp.where(both, end.x_fixed - start.x_fixed, integer(normal_y * unit)),
        sign,
        image,
    )
    constant = jnp.where(line[2] * sign.astype(unit.dtype) > 0, _SATURATED, -_SATURATED)
    return edge._replace(k=jnp.where(one | both | crosses, edge.k, constant))


def _unit_point(corner: Vertices) -> list[Array]:
    """Homogeneous pixel coordinates, scaled by their largest."""
    size = _largest([corner.x, corner.y, corner.w])
    inverse = 1 / jnp.where(size > 0, size, 1)
    return [corner.x * inverse, corner.y * inverse, corner.w * inverse]


def _largest(values: list[Array]) -> Array:
    return maximum3([jnp.abs(v) for v in values])


def _cross(a: list[Array], b: list[Array]) -> list[Array]:
    pairs = ((1, 2), (2, 0), (0, 1))
    return [difference_of_products(a[i], b[j], a[j], b[i]) for i, j in pairs]


def _sorts_after(a: list[Array], b: list[Array]) -> Array:
    """Whether `a` comes after `b` in lexicographic order."""
    return (a[0] > b[0]) | ((a[0] == b[0]) & ((a[1] > b[1]) | ((a[1] == b[1]) & (a[2] > b[2]))))


def bias(a: Array, b: Array) -> Array:
    """0 for a top or left edge, which owns the centres on it, and 1 for the others."""
    return jnp.where((a > 0) | ((a == 0) & (b > 0)), 0, 1)


def triangle_slopes(x: list[Array], y: list[Array], values: list[Array]) -> tuple[Array, Array]:
    """Slopes along columns and rows of the affine function with these corner values.

    The result is clamped to the corner values by its user, so a sliver's wild slopes do no harm.
    """
    x1, y1, x2, y2 = x[1] - x[0], y[1] - y[0], x[2] - x[0], y[2] - y[0]
    v1, v2 = values[1] - values[0], values[2] - values[0]
    twice_area = x1 * y2 - x2 * y1
    scale = jnp.where(twice_area == 0, 0, 1 / jnp.where(twice_area == 0, 1, twice_area))
    return (v1 * y2 - v2 * y1) * scale, (v2 * x1 - v1 * x2) * scale


def evaluate(plane: Plane, column: Array, row: Array, columns: ArrayLike, rows: ArrayLike) -> Array:
    """Value at each pixel of the block that begins at (column, row)."""
    dtype = plane.value.dtype
    x, y = column.astype(dtype) - plane.x, row.astype(dtype) - plane.y
    value = plane.value + plane.dx * x + plane.dy * y
    value = value + plane.dx * lax.convert_element_type(columns, dtype)
    return value + plane.dy * lax.convert_element_type(rows, dtype)


def each_edge(edges: Edge) -> list[Edge]:
    """Split edges along their first axis."""
    return [Edge(*(column[j] for column in edges)) for j in range(3)]


def edge_value(edge: Edge, column: Array, row: Array) -> Array:
    """Exact edge value at a pixel, saturated where it is far from zero."""
    dtype = edge.anchor_x.dtype
    wrapped = edge.a * column + edge.b * row + edge.k
    rounded = edge.a.astype(dtype) * (column.astype(dtype) - edge.anchor_x) + edge.b.astype(
        dtype
    ) * (row.astype(dtype) - edge.anchor_y)
    far = jnp.where(rounded > 0, _SATURATED, -_SATURATED)
    return jnp.where(jnp.abs(rounded) < _SATURATED, wrapped, far)
