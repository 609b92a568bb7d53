"""What lies on the two sides of a piece of an edge, and which part of it can be seen.

Candidates for what hides a piece, or lies behind it, are the faces at the 3×3 pixels round it,
those round the edge itself, and those round the face at the next pixel beyond it. A piece ends
where one of them covers it and is nearer; behind it lies the nearest of those that cover a point
just beyond its middle.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._stored import stored
from diffrast._topology import Topology
from diffrast.edges.neighborhood import only, picked, pixel_at, pixels_round, ring, ring_of_edge
from diffrast.edges.pieces import Pieces, Segments, positive_part
from diffrast.edges.planes import (
    TOLERANCE,
    Columns,
    Table,
    area,
    corners_of,
    covers,
    edge_values,
    inverse_depth_slope,
    locate,
    on_edge,
)
from diffrast.edges.rim import Rim, look_inwards

_BEYOND = 5e-4  # pixels from the edge to the point that shows what is behind it
_BEFORE = 1e-3  # pixels from the edge to the points that show what hides it, in its face
_SNAPPED = 2e-3  # pixels: more than edges move by the rounding of vertices in the rasteriser
_LOOK = 0.75  # pixels from the edge to a point whose pixel's centre lies on its side: > sqrt(1/2)
_TRUSTED = 1.0  # square pixels: beside a face of half this area may lie others that none shows
_ALONE = 6.0  # square pixels: the same, where the background is not seen near by
_SMALL = 1e-6  # keeps a ratio of lengths finite
_ROUNDS = 3  # faces one behind the other along one piece

BACKGROUND = -2


class Side(NamedTuple):
    """What is seen on one side of pieces."""

    face: Int[Array, " n"]  # shaded at `barycentrics`; -1: as the pixel `look`; or BACKGROUND
    barycentrics: Columns
    look: Int[Array, " n"]  # 0 to 8: pixel of the 3×3 whose colour changes as this side's


class Seen(NamedTuple):
    """Visible parts of pieces."""

    visible: Bool[Array, " n"]
    fold: Bool[Array, " n"]
    front_on_right: Bool[Array, " n"]
    front: Side
    beyond: Side
    rim: Rim
    centre_depth: Float[Array, " n"]  # of the pixel's centre in front of the piece, negative beyond
    begin: Float[Array, "2 n"]  # ends of the part, from the pixel's centre
    end: Float[Array, "2 n"]
    middle: Float[Array, " n"]  # of the part on the clipped edge, as seen on the screen


def look(
    pieces: Pieces,
    segments: Segments,
    faces: Int[Array, "F 3"],
    pixels: Table,
    topology: Topology,
    drawn: Bool[Array, " F"],
    face_image: Int[Array, "height_with_border width_with_border"],
) -> Seen:
    """Find out what is seen beside pieces. `face_image` has a border of one pixel all round."""
    own, own_corners, fold, weights, ends, range_ = stored(
        (
            segments.faces[:, pieces.segment],
            segments.corners[:, pieces.segment],
            segments.fold[pieces.segment],
            segments.weights[:, pieces.segment],
            segments.ends[..., pieces.segment],
            segments.range[:, pieces.segment],
        )
    )
    first_on_right = segments.first_on_right[pieces.segment]
    # From the pixel's centre; the normal points to the right, y downwards as everywhere here.
    centre = pieces.pixel + 0.5
    start, along = ends[0] - centre, ends[1] - ends[0]
    length = jnp.sqrt(along[0] * along[0] + along[1] * along[1])
    inverse_length = 1 / jnp.where(length > 0, length, 1)
    normal = jnp.stack([along[1] * inverse_length, -along[0] * inverse_length])
    start, normal, length = stored((start, normal, length))

    def inverse_depth(t: Array) -> Array:
        return (1 - t) * weights[0] + t * weights[1]

    # Of two faces of a fold, the one that comes nearer away from the edge is seen.
    inward = jnp.where(first_on_right, normal, -normal)
    slopes = inverse_depth_slope(corners_of(own, faces, pixels), inward[:, None])
    use_first = (own[0] >= 0) & (~fold | (own[1] < 0) | (slopes[0] >= slopes[1]))
    front, other = jnp.where(use_first, own, own[::-1])
    front_corners, other_corners = jnp.where(use_first, own_corners, own_corners[::-1])
    front_on_right = jnp.where(use_first | fold, first_on_right, ~first_on_right)
    outward = jnp.where(front_on_right, -1, 1)
    front, other, outward = stored((front, other, outward))
    out = stored(outward * normal)

    t = (pieces.range[0] + pieces.range[1]) / 2
    thickness = stored(_thickness(front, front_corners, faces, pixels, ends[0], normal, length, t))
    pictured = stored(pixels_round(face_image, *pieces.pixel))
    outside = stored(picked(pictured, pixel_at(start + t * along, out, _LOOK)))
    rings = [ring_of_edge(own, topology.neighbors), ring(outside, topology.neighbors)]
    around = stored(jnp.concatenate([pictured, only(jnp.concatenate(rings), drawn)]))
    foreign = (around >= 0) & (around != own[0]) & (around != own[1])
    candidates = corners_of(around, faces, pixels)

    # What nothing hides, seen from just inside.
    inset = -jnp.minimum(_BEFORE, thickness / 2) * out
    x, y = (ends[0] + inset)[:, None] + pieces.range * along[:, None]
    values, depth = edge_values(candidates[:, :, None], x[:, None], y[:, None])
    margin = depth - (inverse_depth(pieces.range) * (1 + TOLERANCE))[:, None]
    low, high = _unhidden(foreign, *zip(*[*values, margin], strict=True))
    span = pieces.range[1] - pieces.range[0]
    low, high = stored((pieces.range[0] + low * span, pieces.range[0] + high * span))
    visible = pieces.exists & (low < high)
    t = stored((low + high) / 2)
    begin, end, middle = stored([start + at * along for at in (low, high, t)])
    near = stored(inverse_depth(t))

    # What is behind.
    x, y = centre + middle + _BEYOND * out
    values, depth = edge_values(candidates, x, y)
    behind = foreign & covers(values) & (depth <= near * (1 + TOLERANCE))
    candidate = stored(jnp.where(behind, depth, 0))
    nearest = stored(jnp.max(candidate, axis=0))
    number = jnp.arange(candidate.shape[0])[:, None]
    best = stored(jnp.min(jnp.where(candidate == nearest, number, number.size), axis=0))
    best = jnp.minimum(best, number.size - 1)
    found = fold & (nearest > 0)
    beyond = jnp.where(fold, jnp.where(found, picked(around, best), -1), other)
    beyond = stored(beyond)
    _, at_beyond = locate(corners_of(beyond, faces, pixels), x, y)

    # Pixels whose centres lie on either side. What the rasteriser shows of an edge that passes
    # through a centre tells on which side that is.
    to_right = -(middle[0] * normal[0] + middle[1] * normal[1])
    is_beyond = jnp.where(pictured[4] == beyond, 1, jnp.where(pictured[4] == front, -1, 0))
    close = (jnp.abs(to_right) < _SNAPPED) & (is_beyond != 0)
    shift = stored(jnp.where(close, outward * is_beyond * _SNAPPED - to_right, 0))
    centre_depth = -outward * (to_right + shift)
    begin, end, centre_depth = stored((begin - shift * normal, end - shift * normal, centre_depth))
    beyond_centre = centre_depth < 0
    front_look = jnp.where(beyond_centre, pixel_at(middle, out, -_LOOK), 4)
    beyond_look = jnp.where(beyond_centre, 4, pixel_at(middle, out, _LOOK))
    front_look, beyond_look = stored((front_look, beyond_look))
    size = stored(area(candidates[:, :, :9]))
    above = (size < _TRUSTED) & foreign[:9] & (depth[:9] > near * (1 + TOLERANCE))
    visible = visible & ~(picked(above, front_look) & picked(above, beyond_look))

    # A face that is found may be shown by another pixel. Where none is known to be behind, though
    # the face at the pixel beyond is too large for others to lie unseen between, there is none.
    shown = stored(picked(pictured, beyond_look))
    elsewhere = found & (best < 9) & (shown != beyond)
    bare = pictured < 0
    any_bare = jnp.any(bare, axis=0)
    trusted = jnp.where(any_bare, _TRUSTED, _ALONE)
    gap = fold & ~found & (shown >= 0) & (picked(size, beyond_look) > trusted)
    bare_look = jnp.where(any_bare, jnp.argmax(bare, axis=0), front_look)
    beyond = jnp.where(gap, BACKGROUND, beyond)
    beyond_look = jnp.where(gap, bare_look, jnp.where(elsewhere, best, beyond_look))
    beyond, beyond_look = stored((beyond, beyond_look))

    s = t * weights[1] / jnp.where(near > 0, near, 1)
    s = stored(range_[0] + s * (range_[1] - range_[0]))
    on_other = on_edge(other_corners, s)
    at_beyond = [jnp.where(fold, a, b) for a, b in zip(at_beyond, on_other, strict=True)]
    rim = look_inwards(
        front,
        thickness,
        pictured,
        topology.patches,
        front_look,
        middle,
        -out,
        centre,
        faces,
        pixels,
    )
    rim = rim._replace(smooth=rim.smooth & fold)

    # A flap of a curved surface, narrower than a pixel, in front of that surface itself.
    shown = picked(pictured, beyond_look)
    same = topology.patches[jnp.maximum(shown, 0)] == topology.patches[jnp.maximum(front, 0)]
    flap = fold & ~rim.smooth & (beyond == -1) & (shown >= 0) & same
    return Seen(
        visible=visible & ~flap,
        fold=fold,
        front_on_right=front_on_right,
        front=Side(front, on_edge(front_corners, s), front_look),
        beyond=Side(beyond, at_beyond, beyond_look),
        rim=rim,
        centre_depth=centre_depth,
        begin=begin,
        end=end,
        middle=t,
    )


def _unhidden(
    foreign: Array, first: tuple[Array, ...], last: tuple[Array, ...]
) -> tuple[Array, Array]:
    """What is left of pieces, 0 to 1, once faces at their ends have hidden as much as they can.

    A face hides what all values, which change linearly from `first` to `last`, are positive for.
    """
    low, high = positive_part(first, last)
    hides = foreign & (low < high)

    def hide(_: Array, left: tuple[Array, Array]) -> tuple[Array, Array]:
        begin, end = left
        begin = jnp.maximum(begin, jnp.max(jnp.where(hides & (low <= begin), high, 0), axis=0))
        end = jnp.minimum(end, jnp.min(jnp.where(hides & (high >= end), low, 1), axis=0))
        return begin, end

    nothing = jnp.min(low, axis=0)
    return lax.fori_loop(0, _ROUNDS, hide, (jnp.zeros_like(nothing), jnp.ones_like(nothing)))


def _thickness(
    face: Array,
    edge: Array,
    faces: Array,
    pixels: Table,
    start: Array,
    normal: Array,
    length: Array,
    t: Array,
) -> Array:
    """How far a face reaches from the point `t` of its edge, at right angles to it, or less."""
    third = 3 - edge // 3 - edge % 3
    x, y, _, w = pixels[:, stored(faces[jnp.maximum(face, 0), third])]
    inverse_w = 1 / jnp.where(w > 0, w, 1)
    x, y = x * inverse_w - start[0], y * inverse_w - start[1]
    height = jnp.abs(x * normal[0] + y * normal[1])
    foot = (y * normal[0] - x * normal[1]) / jnp.where(length > 0, length, 1)
    share = jnp.minimum(
        t / jnp.maximum(jnp.maximum(foot, t), _SMALL),
        (1 - t) / jnp.maximum(jnp.maximum(1 - foot, 1 - t), _SMALL),
    )
    return jnp.where(w > 0, height * share, 1)
