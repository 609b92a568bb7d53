"""Edges that may be seen, cut into pieces of one pixel each.

An edge matters where the picture may jump across it: at a fold of the surface (both faces project
to one side of it), at a boundary, and between two faces that are shaded apart. It is clipped in
homogeneous coordinates, projected, and cut where it passes from one pixel to the next.

Cutting. Along a line with both coordinates growing, the sum of the floors of x and y grows by one
from pixel to pixel, and every pixel's part of the line contains its point where x + y is a whole
number one larger: so piece k of a line is found without walking along it, all at once.

Where many surfaces lie one behind the other nearly all pieces are hidden. So all are cut once to
find out which may be seen, in up to 32 runs of each edge's pieces, and only those runs are cut
again.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int, UInt32

from diffrast._device import lanes, views_fill_lanes
from diffrast._selection import divided, prefix_sum, selected
from diffrast._stored import stored, stored_together
from diffrast._topology import Edges, by_three
from diffrast.edges.planes import FINE_TOLERANCE, Table, cross_rows, largest, nearest_first

PIECES_AT_ONCE = 256, 512
OF_MANY_VIEWS = 128  # where others would wait for the view that has most
FEW = 32  # pieces, each of which is looked at in parts
RUNS = 32  # of an edge's pieces, for each of which there is a bit
_EDGE_ON = 8  # roundings in the volume of a face,
_PLACED = 2  # and in where its vertices are


class AtOnce(NamedTuple):
    """How many edges are clipped at once, how many pieces cut, and how many looked at.

    Where no more than a few pieces are left they are looked at in so many parts each.
    """

    edges: int
    cut: int
    pieces: int
    few: int
    parts: int


class Segments(NamedTuple):
    """Clipped edges on the screen; one entry an edge, along the last axis."""

    faces: Int[Array, "2 n"]  # -1 where there is none, -2 - number of one that is not drawn
    corners: Int[Array, "2 n"]  # of each face: index of the start times 3 plus that of the end
    vertices: Int[Array, "2 n"]  # start and end
    fold: Bool[Array, " n"]  # both faces on one side, or one face only
    first_on_right: Bool[Array, " n"]  # the first face that is drawn lies right of the edge
    ends: Float[Array, "2 2 n"]  # start and end, each x and y in pixels
    weights: Float[Array, "2 n"]  # 1/w at start and end
    range: Float[Array, "2 n"]  # of the clipped part on the edge, 0 to 1
    parts: Int[Array, " n"]  # as many pieces
    runs: UInt32[Array, " n"] | None = None  # bits of the runs that are cut; None for all pieces

    @property
    def run_length(self) -> Int[Array, " n"]:
        """Pieces in each run of an edge; its last one may hold fewer."""
        return divided(self.parts + (RUNS - 1), RUNS)[0]

    @property
    def places(self) -> Int[Array, " n"]:
        """How many places there are for pieces in what is cut."""
        if self.runs is None:
            return self.parts
        return self.run_length * lax.population_count(self.runs).astype(jnp.int32)


class Pieces(NamedTuple):
    """Parts of edges within one pixel, along the last axis."""

    segment: Int[Array, " n"]
    pixel: Int[Array, "2 n"]  # column and row
    range: Float[Array, "2 n"]  # of the piece on the clipped edge, as seen on the screen
    exists: Bool[Array, " n"]


def usual_batches(edges: int, pixels: int) -> AtOnce:
    """Batches of a mesh of so many edges, neither mostly empty nor more than the caches hold.

    An outline has about the square root of the mesh's edges, and is cut at as many borders of
    pixels.
    """
    usual = 1 << round(math.log2(math.sqrt(edges) + math.sqrt(pixels)))
    least, most = PIECES_AT_ONCE
    parts = min(max(usual, least), most) // FEW
    usual = min(max(usual, OF_MANY_VIEWS if views_fill_lanes() else least), most)
    pieces = lanes() * usual
    return AtOnce(8 * pieces, 2 * pieces, pieces, usual // parts, parts)


def to_pixels(positions_clip: Float[Array, "V 4"], height: int, width: int) -> Table:
    """Clip coordinates to homogeneous pixel coordinates x, y, w.

    x / w lies right of the image's left border, y / w below its upper one; w stays.
    """
    x, y, _, w = positions_clip.T
    return jnp.stack([(x + w) * (width / 2), (w - y) * (height / 2), w])


class Depth(NamedTuple):
    """How a parallel projection, which has the same w everywhere, tells what is nearer.

    Homogeneous coordinates divided by `weight`, which is linear in them and moves nothing on the
    screen, have a 1/w that grows from 1 to 2 (times as much) from the farthest vertex to the
    nearest; on a plane it stays linear on the screen. So the weight takes the place that the
    constant 1 has under perspective.
    """

    parallel: Bool[Array, ""]
    nearest: Float[Array, ""]  # z
    slope: Float[Array, ""]  # one over the range of z
    inverse_w: Float[Array, ""]

    def weight(self, positions_clip: Float[Array, "V 4"]) -> Float[Array, " V"]:
        """Of points, under parallel projection. Differentiable."""
        z, w = positions_clip[:, 2], positions_clip[:, 3] * self.inverse_w
        return 2 * w - (z - self.nearest * w) * self.slope


def depth_of(positions_clip: Float[Array, "V 4"]) -> Depth:
    """How these vertices tell what is nearer. Not differentiable."""
    z, w = lax.stop_gradient(positions_clip[:, 2:].T)
    finite = jnp.all(jnp.isfinite(positions_clip), axis=1)
    common = jnp.max(jnp.where(finite, w, -jnp.inf))
    nearest = jnp.min(jnp.where(finite, z, jnp.inf))
    range_ = jnp.max(jnp.where(finite, z, -jnp.inf)) - nearest
    parallel = jnp.all((w == common) | ~finite) & (range_ > 0) & (common > 0)
    slope, inverse_w = 1 / jnp.where(parallel, jnp.stack([range_, common]), 1)
    return Depth(parallel, jnp.where(parallel, nearest, 0), slope, inverse_w)


def scale_by_depth(depth: Depth, positions_clip: Float[Array, "V 4"]) -> Float[Array, " V"]:
    """Factors of homogeneous coordinates that make 1/w tell what is nearer: 1 under perspective."""
    known = depth.parallel & jnp.all(jnp.isfinite(positions_clip), axis=1)
    safe = jnp.where(known[:, None], positions_clip, 0)
    return 1 / jnp.where(known, depth.weight(safe), 1)


@partial(jax.jit, static_argnames=("height", "width"))
def facing(
    pixels: Table, faces: Int[Array, "F 3"], *, height: int, width: int
) -> Float[Array, " F"]:
    """Volume det(v0, v1, v2) of x, y, w: negative on front faces, as y points down.

    Zero for faces seen edge-on, as far as rounding can tell, and for those with a vertex at the
    eye. But if their outlines touch, as those of faces without area do, they count as front faces:
    so one of the faces beside them has an outline there, and not both.

    Vertices are known to some roundings of the picture's size, also near its left and upper border
    where x and y are small; by how much that changes the volume other corners tell.
    """
    first, second, third = nearest_first(stored_together([pixels[:, column] for column in faces.T]))
    one, other = second - first, third - first
    cycles = [(i, (i + 1) % 3, (i + 2) % 3) for i in range(3)]
    terms = [first[i] * one[j] * other[k] for i, j, k in cycles]
    terms += [-first[i] * one[k] * other[j] for i, j, k in cycles]
    volume, size = (sum(t[1:], t[0]) for t in (terms, [abs(term) for term in terms]))
    info = jnp.finfo(size.dtype)
    at_eye = largest(first) <= info.eps**1.5 * jnp.maximum(largest(second), largest(third))
    beside = [cross_rows(first, one), cross_rows(first, other)]
    across = cross_rows(one, other)
    seen = jnp.maximum(*map(largest, beside))
    thin = largest(across) <= FINE_TOLERANCE * seen
    hardly = jnp.where(thin & ~at_eye, -info.tiny, 0)
    extent = jnp.array([width, height, 1], size.dtype)[:, None]
    nearest, *farther = (jnp.maximum(abs(v), abs(v[2]) * extent) for v in (first, second, third))
    moved = nearest * abs(across) + jnp.maximum(*farther) * (abs(beside[0]) + abs(beside[1]))
    rounding = info.eps * (_EDGE_ON * size + _PLACED * (moved[0] + moved[1] + moved[2]))
    return stored(jnp.where((abs(volume) > rounding) & ~at_eye, volume, hardly))


def _sides(edges: Edges, volume: Array) -> tuple[Array, Array, Array]:
    """For both faces of edges: whether it is drawn, whether it lies on the right; and if a fold."""
    face = jnp.maximum(edges.faces.T, 0)
    drawn = (edges.faces.T >= 0) & (volume[face] != 0)
    corners = edges.corners.T
    around = (corners == 1) | (corners == 5) | (corners == 6)  # 3 i + j with j next to i
    right = (volume[face] < 0) == around
    return drawn, right, (drawn[0] != drawn[1]) | (right[0] == right[1])


def choose_edges(
    edges: Edges,
    volume: Float[Array, " F"],
    apart: Bool[Array, " E"],
) -> tuple[Int[Array, " list"], Int[Array, ""]]:
    """Indices of the edges across which the picture may jump, in ascending order, and how many.

    Args:
        edges: of the mesh.
        volume: result of `facing`, 0 for faces that are not drawn.
        apart: whether colours may jump across edges that are no folds.
    """
    drawn, _, fold = _sides(edges, volume)
    chosen = (drawn[0] | drawn[1]) & (fold | apart)
    return selected(chosen)


@partial(jax.jit, static_argnames=("height", "width"))
def clip_edges(
    chosen: Int[Array, " n"],
    exists: Bool[Array, " n"],
    edges: Edges,
    faces: Int[Array, "F 3"],
    pixels: Table,
    z: Float[Array, " V"],
    volume: Float[Array, " F"],
    *,
    height: int,
    width: int,
) -> Segments:
    """Clip edges to the view, by x, y, w in pixels and z, and project them.

    `volume` as in `choose_edges`.
    """
    edges = Edges(*(column[chosen] for column in edges))
    drawn, right, fold = _sides(edges, volume)
    corners = edges.corners.T
    vertices = stored(faces[edges.faces[:, 0], jnp.stack(by_three(corners[0]))])
    at, z = stored_together((pixels[:, vertices], z[vertices]))  # (3, 2, n), (2, n)

    x, y, w = at
    heights = [w + z, w - z, x, width * w - x, y, height * w - y]
    inside = jnp.stack(positive_part([h[0] for h in heights], [h[1] for h in heights]))
    first, last = at.swapaxes(0, 1)
    rest = jnp.stack(positive_part([h[1] for h in heights], [h[0] for h in heights])[::-1])
    clipped = rest * first[:, None] + inside * last[:, None]  # (x, y, w; 2 ends; n)
    weights = jnp.where(clipped[2] > 0, 1 / jnp.where(clipped[2] > 0, clipped[2], 1), 0)
    size = jnp.array([width, height], weights.dtype)[None, :, None]
    ends = stored(jnp.clip((clipped[:2] * weights).swapaxes(0, 1), 0, size))
    visible = exists & (inside[0] < inside[1]) & (weights[0] > 0) & (weights[1] > 0)
    first_cell, length = _forward(ends)
    crossings = jnp.sum(jnp.floor(first_cell + length), axis=0).astype(jnp.int32)
    return Segments(
        faces=jnp.where(drawn, edges.faces.T, -2 - jnp.maximum(edges.faces.T, -1)),
        corners=corners,
        vertices=vertices,
        fold=fold,
        first_on_right=jnp.where(drawn[0], right[0], right[1]),
        ends=ends,
        weights=weights,
        range=inside,
        parts=jnp.where(visible, crossings + 1, 0),
    )


def positive_part(first: Sequence[Array], last: Sequence[Array]) -> tuple[Array, Array]:
    """Where on a line, 0 to 1, values are positive that change linearly from `first` to `last`.

    Where there is no such part its begin is not below its end.
    """
    begin, end = jnp.zeros_like(first[0]), jnp.ones_like(first[0])
    for a, b in zip(first, last, strict=True):
        # The same quotient, written in two ways: XLA makes a pass of its own of what is used twice.
        alike = (a < 0) == (b < 0)
        enters, leaves = a / jnp.where(alike, 1, a - b), -a / jnp.where(alike, 1, b - a)
        begin = jnp.where(a < 0, jnp.where(b < 0, 2, jnp.maximum(begin, enters)), begin)
        end = jnp.where((a >= 0) & (b < 0), jnp.minimum(end, leaves), end)
    return stored_together((begin, end))


def _forward(ends: Array) -> tuple[Array, Array]:
    """Start, as a fraction of a pixel, and length of coordinates turned so that they grow."""
    start, end = ends
    start, end = jnp.where(end < start, -start, start), jnp.where(end < start, -end, end)
    return start - jnp.floor(start), end - start


@partial(jax.jit, static_argnames=("at_once", "height", "width"))
def cut(
    segments: Segments,
    ends: Int[Array, " n"],
    first_piece: Array,
    *,
    at_once: int,
    height: int,
    width: int,
) -> Pieces:
    """Pieces first_piece, first_piece + 1, ... of all segments; `ends` sums their `places`."""
    number = first_piece + jnp.arange(at_once, dtype=jnp.int32)
    # As many segments end before or at each piece's number. Those at the very end do not count:
    # they may be many, and a GPU would take them one after another.
    end = jnp.where(ends < ends[-1], jnp.maximum(ends - first_piece, 0), at_once)
    ended = jnp.zeros(at_once, jnp.int32).at[end].add(1, mode="drop")
    segment = stored(prefix_sum(ended))
    exists = number < ends[-1]
    k = number - (ends - segments.places)[segment]
    if segments.runs is not None:
        length = segments.run_length[segment]
        run, within = divided(k, jnp.maximum(length, 1))
        k = _set_bit(segments.runs[segment], run) * length + within
        exists = exists & (k < segments.parts[segment])
    at = stored(segments.ends[..., segment])
    first, length = _forward(at)
    # What runs along a border between two pixels belongs to one of them.
    first, length = stored((jnp.where(length > 0, first, 0.5), length))
    total = length[0] + length[1]
    middle = ((k + 1).astype(first.dtype) - first[0] - first[1]) / jnp.where(total > 0, total, 1)
    cell = stored(jnp.floor(first + jnp.clip(middle, 0, 1) * length))
    exists = exists & (total > 0) & (cell[0] + cell[1] == k.astype(cell.dtype))

    moves = length > 0
    inverse = 1 / jnp.where(moves, length, 1)
    low = jnp.where(moves, (cell - first) * inverse, 0)
    high = jnp.where(moves, (cell + 1 - first) * inverse, 1)
    range_ = jnp.stack(
        [jnp.clip(jnp.max(low, axis=0), 0), jnp.clip(jnp.min(high, axis=0), None, 1)]
    )
    turned = at[1] < at[0]
    column_row = jnp.floor(jnp.where(turned, -at[0], at[0])) + cell
    pixel = jnp.where(turned, -column_row - 1, column_row).astype(jnp.int32)
    size = jnp.array([width, height], jnp.int32)[:, None]
    inside = jnp.all((pixel >= 0) & (pixel < size), axis=0)
    pixel, range_ = stored_together((pixel, range_))
    return Pieces(segment, pixel, range_, exists & inside & (range_[0] < range_[1]))


def _set_bit(bits: UInt32[Array, " n"], number: Int[Array, " n"]) -> Int[Array, " n"]:
    """The place of one of those bits that are set, counted from 0."""
    place = jnp.zeros_like(number)
    for width in (16, 8, 4, 2, 1):
        below = lax.population_count(bits & np.uint32((1 << width) - 1)).astype(number.dtype)
        beyond = number >= below
        number = jnp.where(beyond, number - below, number)
        place = jnp.where(beyond, place + width, place)
        bits = jnp.where(beyond, bits >> width, bits)
    return place


def _run_of(pieces: Pieces, segments: Segments) -> Int[Array, " n"]:
    """In which run of its edge each piece lies."""
    start, end = stored(segments.ends[..., pieces.segment])
    turned = end < start
    first = jnp.floor(jnp.where(turned, -start, start)).astype(jnp.int32)
    cell = jnp.where(turned, -pieces.pixel - 1, pieces.pixel) - first
    length = jnp.maximum(segments.run_length[pieces.segment], 1)
    return divided(jnp.maximum(cell[0] + cell[1], 0), length)[0]


def with_runs(
    runs: UInt32[Array, " edges"],
    last: Int[Array, ""],
    pieces: Pieces,
    segments: Segments,
    edge: Int[Array, " segments"],
) -> tuple[UInt32[Array, " edges"], Int[Array, ""]]:
    """Set the bits of the runs in which pieces lie.

    Pieces of a run follow each other, and those that exist come first: the first of them sets the
    bit. `last` is what is returned with the runs for the pieces before these, or -1.
    """
    run = _run_of(pieces, segments)
    key = stored(RUNS * pieces.segment + run)
    is_first = pieces.exists & (key != jnp.concatenate([last[None], key[:-1]]))
    where = jnp.where(is_first, edge[pieces.segment], runs.size)
    runs = runs.at[where].add(jnp.uint32(1) << run.astype(jnp.uint32), mode="drop")
    return runs, jnp.max(jnp.where(pieces.exists, key, last))
