"""What lies on the two sides of a piece of an edge, and which part of it can be seen.

Candidates for what hides a piece, or lies behind it, are the faces at the 3×3 pixels round it,
those round the edge itself, and those round the face at the next pixel beyond it. A piece ends
where one of them covers it and is nearer; behind it lies the nearest of those that cover a point
just beyond its middle.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._topology import Topology
from diffrast.edges.pieces import Pieces, Pixelled, Segments, positive_part

_TOLERANCE = 1e-3  # of 1/w: surfaces nearer to one another than this touch
_BEYOND = 5e-4  # pixels from the edge to the point that shows what is behind it
_BEFORE = 1e-3  # pixels from the edge to the points that show what hides it, in its face
_SNAPPED = 2e-3  # pixels: more than edges move by the rounding of vertices in the rasteriser
_LOOK = 0.75  # pixels from the edge to a point whose pixel's centre lies on its side: > sqrt(1/2)
_TRUSTED = 1.0  # square pixels: beside a face of half this area may lie others that none shows
_ALONE = 6.0  # square pixels: the same, where the background is not seen near by
_SMALL = 1e-6  # keeps a ratio of lengths finite
_ROUNDS = 3  # faces one behind the other along one piece

BACKGROUND = -2

Columns = list[Float[Array, " n"]]


class Side(NamedTuple):
    """What is seen on one side of pieces."""

    face: Int[Array, " n"]  # shaded at `barycentrics`; -1: as the pixel `look`; or BACKGROUND
    barycentrics: Columns
    look: Int[Array, " n"]  # 0 to 8: pixel of the 3×3 whose colour changes as this side's


class Rim(NamedTuple):
    """The surface in front of pieces, from the piece inwards as far as the pixel reaches."""

    smooth: Bool[Array, " n"]  # whether this pixel and the next show the same smooth surface
    inner: Int[Array, " n"]  # 0 to 8: the next pixel of the 3×3 inwards
    depth: Float[Array, " n"]  # how far the pixel reaches,
    first: Float[Array, " n"]  # how far the face at the edge does, if that is less,
    distance: Float[Array, " n"]  # and how far away the centre of the next pixel is
    bend: tuple[Int[Array, " n"], Columns]  # face and barycentrics where that face ends
    far: tuple[Int[Array, " n"], Columns]  # and where the pixel ends
    single: Bool[Array, " n"]  # whether one face covers what lies between


class Seen(NamedTuple):
    """Visible parts of pieces."""

    visible: Bool[Array, " n"]
    fold: Bool[Array, " n"]
    front_on_right: Bool[Array, " n"]
    front: Side
    beyond: Side
    rim: Rim
    centre_depth: Float[Array, " n"]  # of the pixel's centre in front of the piece, negative beyond
    begin: tuple[Array, Array]  # ends of the part, from the pixel's centre
    end: tuple[Array, Array]
    middle: Float[Array, " n"]  # of the part on the clipped edge, as seen on the screen


def look(
    pieces: Pieces,
    segments: Segments,
    faces: Int[Array, "F 3"],
    pixels: Pixelled,
    topology: Topology,
    drawn: Bool[Array, " F"],
    face_image: Int[Array, "height_with_border width_with_border"],
) -> Seen:
    """Find out what is seen beside pieces. `face_image` has a border of one pixel all round."""
    of = pieces.segment
    p, q = ([column[of] for column in ends] for ends in (segments.start, segments.end))
    weights = [column[of] for column in segments.weights]
    own = [column[of] for column in segments.faces]
    fold, first_on_right = segments.fold[of], segments.first_on_right[of]
    crease = ~fold

    # From the pixel's centre; the normal points to the right, y downwards as everywhere here.
    centre = [pieces.column + 0.5, pieces.row + 0.5]
    start = [c - m for c, m in zip(p, centre, strict=True)]
    along = [c - m for c, m in zip(q, p, strict=True)]
    length = jnp.sqrt(along[0] * along[0] + along[1] * along[1])
    inverse_length = 1 / jnp.where(length > 0, length, 1)
    normal = [along[1] * inverse_length, -along[0] * inverse_length]

    def inverse_depth(t: Array) -> Array:
        return (1 - t) * weights[0] + t * weights[1]

    # Of two faces of a fold, the one that comes nearer away from the edge is seen.
    inward = jnp.where(first_on_right, 1, -1)
    slopes = [_inverse_depth_slope(f, faces, pixels, [inward * n for n in normal]) for f in own]
    use_first = (own[0] >= 0) & (~fold | (own[1] < 0) | (slopes[0] >= slopes[1]))
    front = jnp.where(use_first, own[0], own[1])
    other = jnp.where(use_first, own[1], own[0])
    corners = [column[of] for column in segments.corners]
    front_corners = jnp.where(use_first, corners[0], corners[1])
    other_corners = jnp.where(use_first, corners[1], corners[0])
    front_on_right = jnp.where(use_first | fold, first_on_right, ~first_on_right)
    outward = jnp.where(front_on_right, -1, 1)
    out = [outward * n for n in normal]

    t = (pieces.range[0] + pieces.range[1]) / 2
    middle = [c + t * d for c, d in zip(start, along, strict=True)]
    thickness = _thickness(front, front_corners, faces, pixels, p, normal, length, t)

    pictured = jnp.stack(
        [face_image[pieces.row + i, pieces.column + j] for i in range(3) for j in range(3)]
    )
    outside = _picked(pictured, _pixel(middle, out, _LOOK))
    around = jnp.concatenate(
        [
            pictured,
            _ring(own[0], own[1], topology.neighbors, drawn),
            _ring(own[1], own[0], topology.neighbors, drawn),
            _ring(outside, None, topology.neighbors, drawn),
        ]
    )
    foreign = (around >= 0) & (around != own[0]) & (around != own[1])
    candidates = _Planes(jnp.maximum(around, 0), faces, pixels)

    # What nothing hides, seen from just inside.
    inset = -jnp.minimum(_BEFORE, thickness / 2)
    ends = []
    for t_end in pieces.range:
        x, y = (
            m + c + t_end * d + inset * n
            for m, c, d, n in zip(centre, start, along, out, strict=True)
        )
        edge_values, depth = candidates.at(x, y)
        ends.append([*edge_values, depth - inverse_depth(t_end) * (1 + _TOLERANCE)])
    low, high = _unhidden(foreign, *ends)
    span = pieces.range[1] - pieces.range[0]
    low, high = pieces.range[0] + low * span, pieces.range[0] + high * span
    visible = pieces.exists & (low < high)
    t = (low + high) / 2
    begin, end, middle = (
        [c + at * d for c, d in zip(start, along, strict=True)] for at in (low, high, t)
    )
    near = inverse_depth(t)

    # What is behind.
    x, y = (m + c + _BEYOND * n for m, c, n in zip(centre, middle, out, strict=True))
    edge_values, depth = candidates.at(x, y)
    covers = foreign & candidates.covers(edge_values)
    candidate = jnp.where(covers & (depth <= near * (1 + _TOLERANCE)), depth, 0)
    best = jnp.argmax(candidate, axis=0)
    found = fold & (jnp.max(candidate, axis=0) > 0)
    beyond = jnp.where(fold, jnp.where(found, _picked(around, best), -1), other)
    _, behind = locate(jnp.maximum(beyond, 0), faces, pixels, x, y)

    # Pixels whose centres lie on either side. What the rasteriser shows of an edge that passes
    # through a centre tells on which side that is.
    to_right = -(middle[0] * normal[0] + middle[1] * normal[1])
    is_beyond = jnp.where(pictured[4] == beyond, 1, jnp.where(pictured[4] == front, -1, 0))
    close = (jnp.abs(to_right) < _SNAPPED) & (is_beyond != 0)
    shift = jnp.where(close, outward * is_beyond * _SNAPPED - to_right, 0)
    to_right = to_right + shift
    begin, end = ([c - shift * n for c, n in zip(e, normal, strict=True)] for e in (begin, end))
    beyond_centre = to_right * outward > 0
    front_look = jnp.where(beyond_centre, _pixel(middle, out, -_LOOK), 4)
    beyond_look = jnp.where(beyond_centre, 4, _pixel(middle, out, _LOOK))
    area = _area_of(jnp.maximum(pictured, 0), faces, pixels)
    small = area < _TRUSTED
    above = small & foreign[:9] & (depth[:9] > near * (1 + _TOLERANCE))
    visible = visible & ~(_picked(above, front_look) & _picked(above, beyond_look))

    # A face that is found may be shown by another pixel. Where none is known to be behind, though
    # the face at the pixel beyond is too large for others to lie unseen between, there is none.
    shown = _picked(pictured, beyond_look)
    elsewhere = found & (best < 9) & (shown != beyond)
    bare = pictured < 0
    trusted = jnp.where(jnp.any(bare, axis=0), _TRUSTED, _ALONE)
    gap = fold & ~found & (shown >= 0) & (_picked(area, beyond_look) > trusted)
    beyond = jnp.where(gap, BACKGROUND, beyond)
    beyond_look = jnp.where(elsewhere, best, beyond_look)
    bare_look = jnp.where(jnp.any(bare, axis=0), jnp.argmax(bare, axis=0), front_look)
    beyond_look = jnp.where(gap, bare_look, beyond_look)

    range_low, range_high = (column[of] for column in segments.range)
    s = range_low + t * weights[1] / jnp.where(near > 0, near, 1) * (range_high - range_low)
    on_other = _on_edge(other_corners, s)
    behind = [jnp.where(crease, a, b) for a, b in zip(on_other, behind, strict=True)]
    rim = _rim(
        front,
        thickness,
        pictured,
        topology.patches,
        front_look,
        middle,
        [-n for n in out],
        centre,
        faces,
        pixels,
    )
    rim = rim._replace(smooth=rim.smooth & fold)

    # A flap of a curved surface, narrower than a pixel, in front of that surface itself.
    shown = _picked(pictured, beyond_look)
    same = topology.patches[jnp.maximum(shown, 0)] == topology.patches[jnp.maximum(front, 0)]
    flap = fold & ~rim.smooth & (beyond == -1) & (shown >= 0) & same
    return Seen(
        visible=visible & ~flap,
        fold=fold,
        front_on_right=front_on_right,
        front=Side(front, _on_edge(front_corners, s), front_look),
        beyond=Side(beyond, behind, beyond_look),
        rim=rim,
        centre_depth=-outward * to_right,
        begin=(begin[0], begin[1]),
        end=(end[0], end[1]),
        middle=t,
    )


def _picked(values: Array, index: Array) -> Array:
    return jnp.take_along_axis(values, index[None], axis=0)[0]


def _pixel(point: list[Array], direction: list[Array], distance: Array | float) -> Array:
    """0 to 8: the pixel of the 3×3 at a distance from a point, which is given from the centre."""
    column, row = (
        jnp.clip(jnp.floor(c + distance * n + 0.5).astype(jnp.int32), -1, 1)
        for c, n in zip(point, direction, strict=True)
    )
    return 4 + 3 * row + column


def _ring(face: Array, without: Array | None, neighbors: Array, drawn: Array) -> Array:
    """The drawn faces that are up to two edges away, but for those beyond `without`."""

    def others(face: Array, without: Array | None) -> list[Array]:
        near = [jnp.where(face >= 0, neighbors[jnp.maximum(face, 0), i], -1) for i in range(3)]
        if without is None:
            return near
        return [jnp.where(n == without, near[2], n) for n in near[:2]]

    next_to = others(face, without)
    ring = jnp.stack([*next_to, *(f for one in next_to for f in others(one, face))])
    return jnp.where((ring >= 0) & drawn[jnp.maximum(ring, 0)], ring, -1)


def _unhidden(foreign: Array, first: list[Array], last: list[Array]) -> tuple[Array, Array]:
    """What is left of pieces, 0 to 1, once faces at their ends have hidden as much as they can.

    A face hides what all values, which change linearly from `first` to `last`, are positive for.
    """
    low, high = positive_part(first, last)
    hides = foreign & (low < high)
    begin, end = jnp.zeros_like(first[0][0]), jnp.ones_like(first[0][0])
    for _ in range(_ROUNDS):
        begin = jnp.maximum(begin, jnp.max(jnp.where(hides & (low <= begin), high, 0), axis=0))
        end = jnp.minimum(end, jnp.min(jnp.where(hides & (high >= end), low, 1), axis=0))
    return begin, end


def _rim(
    front: Array,
    thickness: Array,
    pictured: Array,
    patches: Array,
    front_look: Array,
    middle: Columns,
    inward: Columns,
    centre: Columns,
    faces: Array,
    pixels: Pixelled,
) -> Rim:
    exits = [
        (0.5 - jnp.sign(n) * m) / jnp.maximum(jnp.abs(n), _SMALL)
        for m, n in zip(middle, inward, strict=True)
    ]
    depth = jnp.clip(jnp.minimum(*exits), 0, 1.5)
    inner = _pixel(middle, inward, depth + 0.5)
    column, row = inner % 3 - 1, inner // 3 - 1
    distance = (column - middle[0]) * inward[0] + (row - middle[1]) * inward[1]
    patch = patches[jnp.maximum(front, 0)]

    def same(look: Array) -> Array:
        face = _picked(pictured, look)
        return (face >= 0) & (patches[jnp.maximum(face, 0)] == patch)

    def point(depth: Array) -> Columns:
        return [c + m + depth * n for c, m, n in zip(centre, middle, inward, strict=True)]

    first = jnp.minimum(thickness, depth)
    _, bend = locate(jnp.maximum(front, 0), faces, pixels, *point(first))
    bend = [jnp.clip(b, 0, 1) for b in bend]
    total = jnp.maximum(bend[0] + bend[1] + bend[2], _SMALL)
    beyond = jnp.where(thickness >= depth, front, _picked(pictured, inner))
    covers, far = locate(jnp.maximum(beyond, 0), faces, pixels, *point(depth))
    return Rim(
        smooth=(front >= 0) & same(front_look) & same(inner),
        inner=inner,
        depth=depth,
        first=first,
        distance=jnp.maximum(distance, depth + 0.25),
        bend=(front, [b / total for b in bend]),
        far=(beyond, far),
        single=covers,
    )


def _thickness(
    face: Array,
    corners: Array,
    faces: Array,
    pixels: Pixelled,
    start: Columns,
    normal: Columns,
    length: Array,
    t: Array,
) -> Array:
    """How far a face reaches from the point `t` of its edge, at right angles to it, or less."""
    third = 3 - corners // 3 - corners % 3
    vertex = faces[jnp.maximum(face, 0), third]
    w = pixels.w[vertex]
    in_front = w > 0
    inverse_w = 1 / jnp.where(in_front, w, 1)
    x, y = (p[vertex] * inverse_w - q for p, q in zip((pixels.x, pixels.y), start, strict=True))
    height = jnp.abs(x * normal[0] + y * normal[1])
    foot = (y * normal[0] - x * normal[1]) / jnp.where(length > 0, length, 1)
    share = jnp.minimum(
        t / jnp.maximum(jnp.maximum(foot, t), _SMALL),
        (1 - t) / jnp.maximum(jnp.maximum(1 - foot, 1 - t), _SMALL),
    )
    return jnp.where(in_front, height * share, 1)


def _area_of(face: Array, faces: Array, pixels: Pixelled) -> Array:
    """Twice the area of faces on the screen; infinite if they reach behind the camera."""
    x, y, w = _corner_columns(face, faces, pixels)
    before = (w[0] > 0) & (w[1] > 0) & (w[2] > 0)
    inverse = [1 / jnp.where(before, v, 1) for v in w]
    x = [v * i for v, i in zip(x, inverse, strict=True)]
    y = [v * i for v, i in zip(y, inverse, strict=True)]
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    return jnp.where(before, jnp.abs(area), jnp.inf)


def _on_edge(corners: Array, s: Array) -> Columns:
    """Barycentric coordinates a part `s` of the way from one corner of a face to another."""
    start, end = corners // 3, corners % 3
    return [jnp.where(start == j, 1 - s, jnp.where(end == j, s, 0)) for j in range(3)]


def _corner_columns(face: Array, faces: Array, pixels: Pixelled) -> list[list[Array]]:
    corners = [faces[:, j][face] for j in range(3)]
    return [[column[c] for c in corners] for column in (pixels.x, pixels.y, pixels.w)]


def _inverse_depth_slope(face: Array, faces: Array, pixels: Pixelled, direction: Columns) -> Array:
    """Change of 1/w along a direction on the screen, on the plane of a face."""
    x, y, w = _corner_columns(jnp.maximum(face, 0), faces, pixels)
    x1, y1, w1 = x[1] - x[0], y[1] - y[0], w[1] - w[0]
    x2, y2, w2 = x[2] - x[0], y[2] - y[0], w[2] - w[0]
    gx, gy, gw = y1 * w2 - w1 * y2, w1 * x2 - x1 * w2, x1 * y2 - y1 * x2
    volume = x[0] * gx + y[0] * gy + w[0] * gw
    safe = jnp.where(volume == 0, 1, volume)
    return jnp.where(volume == 0, 0, (gx * direction[0] + gy * direction[1]) / safe)


class _Planes:
    """Faces, to be evaluated at points."""

    def __init__(self, face: Array, faces: Array, pixels: Pixelled) -> None:
        self.columns, self.rows, self.w = _corner_columns(face, faces, pixels)

    def at(self, x: Array, y: Array) -> tuple[list[Array], Array]:
        """Three values that are positive inside, linear on the screen, and 1/w, or -1 of none."""
        w = self.w
        u = [c - x * d for c, d in zip(self.columns, w, strict=True)]
        v = [c - y * d for c, d in zip(self.rows, w, strict=True)]
        e = [
            u[1] * v[2] - u[2] * v[1],
            u[2] * v[0] - u[0] * v[2],
            u[0] * v[1] - u[1] * v[0],
        ]
        volume = e[0] * w[0] + e[1] * w[1] + e[2] * w[2]
        total = e[0] + e[1] + e[2]
        sign = jnp.where(volume < 0, -1, 1)
        depth = jnp.where(volume == 0, -1, total / jnp.where(volume == 0, 1, volume))
        return [value * sign for value in e], depth

    @staticmethod
    def covers(edge_values: list[Array]) -> Array:
        return (edge_values[0] >= 0) & (edge_values[1] >= 0) & (edge_values[2] >= 0)


def locate(
    face: Int[Array, "*n"],
    faces: Int[Array, "F 3"],
    pixels: Pixelled,
    x: Float[Array, "*n"],
    y: Float[Array, "*n"],
) -> tuple[Bool[Array, "*n"], list[Float[Array, "*n"]]]:
    """Whether faces cover points on the screen, and barycentrics there on their planes."""
    planes = _Planes(face, faces, pixels)
    edge_values, depth = planes.at(x, y)
    total = edge_values[0] + edge_values[1] + edge_values[2]
    inverse_total = 1 / jnp.where(total == 0, 1, total)
    return planes.covers(edge_values) & (depth > 0), [e * inverse_total for e in edge_values]
