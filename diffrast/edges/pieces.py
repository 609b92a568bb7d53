"""Edges that may be seen, cut into pieces of one pixel each.

An edge matters where the picture may jump across it: at a fold of the surface (both faces project
to one side of it), at a boundary, and between two faces that are shaded apart. It is clipped in
homogeneous coordinates, projected, and cut where it passes from one pixel to the next.

Cutting. Along a line with both coordinates growing, the sum of the floors of x and y grows by one
from pixel to pixel, and every pixel's part of the line contains its point where x + y is a whole
number one larger: so piece k of a line is found without walking along it, all at once.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._topology import Edges
from diffrast.raster.fixed_point import CULLED, group_by_class

EDGES_AT_ONCE = 256
PIECES_AT_ONCE = 512
_EDGE_ON = 8  # roundings in the volume of a face


class Pixelled(NamedTuple):
    """Vertices in homogeneous pixel coordinates, as columns: x / w right of the left border."""

    x: Float[Array, " V"]
    y: Float[Array, " V"]  # down
    z: Float[Array, " V"]
    w: Float[Array, " V"]


class Segments(NamedTuple):
    """Clipped edges on the screen; columns with one entry an edge."""

    faces: tuple[Array, Array]  # -1 where there is none, or where it is not drawn
    corners: tuple[Array, Array]  # of each face: index of the start times 3 plus that of the end
    vertices: tuple[Array, Array]  # start and end
    fold: Bool[Array, " n"]  # both faces on one side, or one face only
    first_on_right: Bool[Array, " n"]  # the first face that is drawn lies right of the edge
    start: tuple[Array, Array]  # x and y in pixels
    end: tuple[Array, Array]
    weights: tuple[Array, Array]  # 1/w at start and end
    range: tuple[Array, Array]  # of the clipped part on the edge, 0 to 1
    parts: Int[Array, " n"]  # as many pieces


class Pieces(NamedTuple):
    """Parts of edges within one pixel; columns."""

    segment: Int[Array, " n"]
    row: Int[Array, " n"]
    column: Int[Array, " n"]
    range: tuple[Array, Array]  # of the piece on the clipped edge, as seen on the screen
    exists: Bool[Array, " n"]


def to_pixels(positions_clip: Float[Array, "V 4"], height: int, width: int) -> Pixelled:
    """Clip coordinates to homogeneous pixel coordinates."""
    x, y, z, w = (positions_clip[:, i] for i in range(4))
    return Pixelled((x + w) * (width / 2), (w - y) * (height / 2), z, w)


def facing(pixels: Pixelled, faces: Int[Array, "F 3"]) -> Float[Array, " F"]:
    """Volume det(v0, v1, v2) of x, y, w: negative on front faces, as y points down.

    Zero for faces seen edge-on, as far as rounding can tell.
    """
    (x0, x1, x2), (y0, y1, y2), (w0, w1, w2) = (
        [column[faces[:, j]] for j in range(3)] for column in (pixels.x, pixels.y, pixels.w)
    )
    x1, y1, w1, x2, y2, w2 = x1 - x0, y1 - y0, w1 - w0, x2 - x0, y2 - y0, w2 - w0
    terms = [
        (x0, y1, w2),
        (-x0, w1, y2),
        (y0, w1, x2),
        (-y0, x1, w2),
        (w0, x1, y2),
        (-w0, y1, x2),
    ]
    products = [a * b * c for a, b, c in terms]
    stack = jnp.stack(products)
    volume, size = jnp.sum(stack, axis=0), jnp.sum(jnp.abs(stack), axis=0)
    return jnp.where(jnp.abs(volume) > _EDGE_ON * jnp.finfo(size.dtype).eps * size, volume, 0)


def _sides(edges: Edges, volume: Array, seen: Array) -> tuple[list[Array], list[Array], Array]:
    """For both faces of edges: whether it is drawn, whether it lies on the right; and if a fold."""
    drawn, right = [], []
    for side in range(2):
        own = volume[jnp.maximum(edges.faces[:, side], 0)]
        exists = edges.faces[:, side] >= 0
        drawn.append(exists & seen[jnp.maximum(edges.faces[:, side], 0)])
        start, end = edges.corners[:, side] // 3, edges.corners[:, side] % 3
        right.append((own < 0) == ((start + 1) % 3 == end))
    fold = (drawn[0] != drawn[1]) | (right[0] == right[1])
    return drawn, right, fold


def choose_edges(
    edges: Edges,
    volume: Float[Array, " F"],
    seen: Bool[Array, " F"],
    apart: Bool[Array, " E"],
) -> tuple[Int[Array, " E"], Int[Array, ""]]:
    """Indices of the edges across which the picture may jump, in ascending order, and how many.

    Args:
        edges: of the mesh.
        volume: result of `facing`.
        seen: whether faces turn a side to the viewer that is drawn.
        apart: whether colours may jump across edges that are no folds.
    """
    drawn, _, fold = _sides(edges, volume, seen)
    chosen = (drawn[0] | drawn[1]) & (fold | apart)
    order, starts = group_by_class(jnp.where(chosen, 0, CULLED))
    return order, starts[1]


def clip_edges(
    chosen: Int[Array, " n"],
    exists: Bool[Array, " n"],
    edges: Edges,
    faces: Int[Array, "F 3"],
    pixels: Pixelled,
    volume: Float[Array, " F"],
    seen: Bool[Array, " F"],
    *,
    height: int,
    width: int,
) -> Segments:
    """Clip edges to the view and project them."""
    edges = Edges(*(column[chosen] for column in edges))
    drawn, right, fold = _sides(edges, volume, seen)
    owner = edges.faces[:, 0]
    start, end = edges.corners[:, 0] // 3, edges.corners[:, 0] % 3
    a, b = faces[owner, start], faces[owner, end]
    first, last = (Pixelled(*(column[v] for column in pixels)) for v in (a, b))

    def heights(v: Pixelled) -> list[Array]:
        return [v.w + v.z, v.w - v.z, v.x, width * v.w - v.x, v.y, height * v.w - v.y]

    low, high = positive_part(heights(first), heights(last))
    visible = exists & (low < high)

    def project(s: Array) -> tuple[Array, Array, Array]:
        x, y, w = (p + s * (q - p) for p, q in zip(first, last, strict=True) if p is not first.z)
        visible_w = w > 0
        inverse_w = jnp.where(visible_w, 1 / jnp.where(visible_w, w, 1), 0)
        return jnp.clip(x * inverse_w, 0, width), jnp.clip(y * inverse_w, 0, height), inverse_w

    x0, y0, weight0 = project(low)
    x1, y1, weight1 = project(high)
    visible = visible & (weight0 > 0) & (weight1 > 0)
    parts = jnp.where(visible, _crossings(x0, x1) + _crossings(y0, y1) + 1, 0)
    return Segments(
        faces=(
            jnp.where(drawn[0], edges.faces[:, 0], -1),
            jnp.where(drawn[1], edges.faces[:, 1], -1),
        ),
        corners=(edges.corners[:, 0], edges.corners[:, 1]),
        vertices=(a, b),
        fold=fold,
        first_on_right=jnp.where(drawn[0], right[0], right[1]),
        start=(x0, y0),
        end=(x1, y1),
        weights=(weight0, weight1),
        range=(low, high),
        parts=parts,
    )


def positive_part(first: list[Array], last: list[Array]) -> tuple[Array, Array]:
    """Where on a line, 0 to 1, values are positive that change linearly from `first` to `last`.

    Where there is no such part its begin is not below its end.
    """
    low, high = jnp.zeros_like(first[0]), jnp.ones_like(first[0])
    for a, b in zip(first, last, strict=True):
        crossing = a / jnp.where((a < 0) == (b < 0), 1, a - b)
        low = jnp.where(a < 0, jnp.where(b < 0, 2, jnp.maximum(low, crossing)), low)
        high = jnp.where((a >= 0) & (b < 0), jnp.minimum(high, crossing), high)
    return low, high


def _forward(start: Array, end: Array) -> tuple[Array, Array]:
    """Start, as a fraction of a pixel, and length of a coordinate turned so that it grows."""
    start, end = jnp.where(end < start, -start, start), jnp.where(end < start, -end, end)
    return start - jnp.floor(start), end - start


def _crossings(start: Array, end: Array) -> Array:
    first, length = _forward(start, end)
    return jnp.floor(first + length).astype(jnp.int32)


def cut(
    segments: Segments, ends: Int[Array, " n"], first_piece: Array, *, height: int, width: int
) -> Pieces:
    """Pieces first_piece, first_piece + 1, ... of all segments; `ends` sums their counts."""
    number = first_piece + jnp.arange(PIECES_AT_ONCE)
    segment = jnp.searchsorted(ends, number, side="right", method="compare_all")
    exists = segment < ends.shape[0]
    segment = jnp.minimum(segment, ends.shape[0] - 1)
    k = number - (ends[segment] - segments.parts[segment])
    x0, y0 = (column[segment] for column in segments.start)
    x1, y1 = (column[segment] for column in segments.end)
    (x, length_x), (y, length_y) = _forward(x0, x1), _forward(y0, y1)
    length = length_x + length_y
    middle = (k + 1 - x - y) / jnp.where(length > 0, length, 1)
    middle = jnp.clip(middle, 0, 1)
    i, j = jnp.floor(x + middle * length_x), jnp.floor(y + middle * length_y)
    exists = exists & (length > 0) & (i + j == k)

    def interval(cell: Array, first: Array, length: Array) -> tuple[Array, Array]:
        moves = length > 0
        safe = jnp.where(moves, length, 1)
        return (
            jnp.where(moves, (cell - first) / safe, 0),
            jnp.where(moves, (cell + 1 - first) / safe, 1),
        )

    (low_x, high_x), (low_y, high_y) = interval(i, x, length_x), interval(j, y, length_y)
    low = jnp.maximum(jnp.maximum(low_x, low_y), 0)
    high = jnp.minimum(jnp.minimum(high_x, high_y), 1)

    def place(cell: Array, start: Array, end: Array) -> Array:
        turned = end < start
        base = jnp.floor(jnp.where(turned, -start, start))
        return jnp.where(turned, -(base + cell) - 1, base + cell).astype(jnp.int32)

    column, row = place(i, x0, x1), place(j, y0, y1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return Pieces(segment, row, column, (low, high), exists & inside & (low < high))
