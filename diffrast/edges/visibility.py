"""What lies on the two sides of a piece of an edge, and which part of it can be seen.

Candidates for what hides a piece, or lies behind it, are the faces at the 3×3 pixels round it,
those round the edge itself, and of those that have an edge in the pixel but show at none of these
centres the farthest and, of several bodies, the nearest of another one (or that of the next pixel).
The first part of the piece is looked at here (see `parts`); what is left of it becomes a piece of
its own. Faces may be too thin for any pixel to show them: a walk over the surface that is seen
nearby, and would hide the part if it reached it, tells whether it does. Where no candidate lies
behind the part, walks over two surfaces at the pixels around, the one beyond first, tell which of
their faces does, or that both end before. Where only one is seen, the second may be one that no
centre shows, or the farthest that is seen a few pixels away.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._stored import stored, stored_together
from diffrast._topology import third_corner
from diffrast.edges.creases import buried
from diffrast.edges.neighborhood import (
    Surface,
    first_row,
    of_block,
    only,
    picked,
    pixel_at,
    pixels_round,
    ring_of_edge,
    steps_to,
)
from diffrast.edges.parts import Candidates, first_part, nearest_behind
from diffrast.edges.pieces import Pieces, Segments
from diffrast.edges.planes import (
    FINE_TOLERANCE,
    TOLERANCE,
    Columns,
    area,
    beside_edge,
    corners_of,
    dot_rows,
    edge_values,
    inverse_depth_slope,
)
from diffrast.edges.rim import SHORT, Rim, look_inwards, next_inwards, reach
from diffrast.edges.shadow_beside import crossing
from diffrast.edges.shadow_pairs import Cast
from diffrast.edges.unseen import Unseen
from diffrast.edges.ways import LOOK, Spot, inwards, located, outwards, sides_of, walked
from diffrast.raster.fixed_point import subpixel_bits

SNAPPED = 2e-3  # pixels: more than edges move by the rounding of vertices in the rasteriser
_BY = 1 / 16  # pixels: vertices so near a centre lie where the rasteriser has them
_TIE = (2.0**-12, 2.0**-17)  # pixels to the right and down: less than the rasteriser's steps
_FINE = 1.0  # square pixels: faces of half this area may hide others that no pixel shows
_SMALL = 1e-6  # keeps a ratio of lengths finite

BACKGROUND = -2
_FARTHEST = 9 + 12  # which of the candidates, behind those at nine pixels, is the unseen one
# Which of them are next to an edge's first face, or second.
_NEXT = np.zeros((2, _FARTHEST + 2, 1), bool)
_NEXT[0, [9, 11]] = _NEXT[1, [10, 12]] = True


class Side(NamedTuple):
    """What is seen on one side of pieces."""

    face: Int[Array, " n"]  # shaded at `barycentrics`; -1: as the pixel `look`; or BACKGROUND
    barycentrics: Columns
    look: Int[Array, " n"]  # 0 to 8: pixel of the 3×3 whose colour changes as this side's
    is_centre: Bool[Array, " n"]  # whether the pixel's centre shows this surface


class Seen(NamedTuple):
    """Visible parts of pieces."""

    visible: Bool[Array, " n"]
    fold: Bool[Array, " n"]
    front_on_right: Bool[Array, " n"]
    front: Side
    beyond: Side
    rim: Rim
    wrong_side: Bool[Array, " n"]  # the centre lies on the edge and shows the face that front hides
    centre_depth: Float[Array, " n"]  # of the pixel's centre in front of the piece, negative beyond
    begin: Float[Array, "2 n"]  # ends of the part, from the pixel's centre
    end: Float[Array, "2 n"]
    middle: Float[Array, " n"]  # of the part on the clipped edge, as seen on the screen
    # Of what is beyond, half-way from there to where the pixel ends; None without shadows.
    half_way: Columns | None


@jax.jit
def look(
    pieces: Pieces,
    segments: Segments,
    surface: Surface,
    face_image: Int[Array, "height_with_border width_with_border"],
    near_bare: Bool[Array, "rows columns"],
    seen_farthest: Int[Array, "rows columns"],
    unseen: Unseen,
    cast: Cast | None,
) -> tuple[Seen, Pieces]:
    """What is seen beside the first visible parts of pieces, and what is left of the pieces.

    `face_image` has a border of one pixel all round; `near_bare` is its `near_background`.
    A part ends where the outline of a shadow crosses it on what lies behind.
    """
    faces, pixels, topology, volume = surface
    own, own_corners, vertices, weights, *ends, fold, first_on_right = stored_together(
        (
            segments.faces[:, pieces.segment],
            segments.corners[:, pieces.segment],
            segments.vertices[:, pieces.segment],
            segments.weights[:, pieces.segment],
            *segments.ends[..., pieces.segment],
            segments.fold[pieces.segment],
            segments.first_on_right[pieces.segment],
        )
    )
    # From the pixel's centre; the normal points to the right, y downwards as everywhere here.
    centre = pieces.pixel.astype(weights.dtype) + 0.5
    start, along = ends[0] - centre, ends[1] - ends[0]
    length = jnp.sqrt(along[0] * along[0] + along[1] * along[1])
    inverse_length = 1 / jnp.where(length > 0, length, 1)
    normal = jnp.stack([along[1] * inverse_length, -along[0] * inverse_length])
    start, normal, length = stored_together((start, normal, length))

    def inverse_depth(t: Array) -> Array:
        return (1 - t) * weights[0] + t * weights[1]

    # Of two faces of a fold, the one that comes nearer away from the edge is seen.
    inward = jnp.where(first_on_right, normal, -normal)
    face_corners = corners_of(own, faces, pixels)
    slopes = inverse_depth_slope(face_corners, volume[jnp.maximum(own, 0)], inward[:, None])
    use_first = (own[0] >= 0) & (~fold | (own[1] < 0) | (slopes[0] >= slopes[1]))
    front, other = jnp.where(use_first, own, own[::-1])
    front_corners = jnp.where(use_first, own_corners[0], own_corners[1])
    front_on_right = jnp.where(use_first | fold, first_on_right, ~first_on_right)
    outward = jnp.where(front_on_right, -1, 1)
    front, other, outward = stored_together((front, other, outward))
    out = stored(outward.astype(normal.dtype) * normal)

    t = (pieces.range[0] + pieces.range[1]) / 2
    apex = stored(faces[jnp.maximum(front, 0), third_corner(front_corners)])
    thickness = stored(_thickness(pixels[:, apex], ends[0], normal, length, t))
    pictured = stored(pixels_round(face_image, *pieces.pixel))
    undrawn = own < -1
    of_edge = jnp.where(undrawn, -2 - own, own)
    nearby = only(ring_of_edge(of_edge, topology.neighbors), volume != 0)
    farthest = _at(unseen.farthest, *pieces.pixel)
    more = [farthest] if unseen.nearest is None else [farthest, _at(unseen.nearest, *pieces.pixel)]
    around = stored(jnp.concatenate([pictured, nearby, jnp.stack(more)]))
    foreign = (around >= 0) & (around != own[0]) & (around != own[1])

    # Seen from just inside, and from just beyond.
    inside, outside, rounding = beside_edge(face_image.shape, length.dtype)
    inset = stored(jnp.minimum(inside, thickness / 2))
    offset = jnp.stack([-inset * out, outside * out], axis=1)
    x, y = (ends[0][:, None] + offset)[:, :, None] + (pieces.range * along[:, None])[:, None]
    x, y = stored_together((x[:, :, None], y[:, :, None]))  # (2 lines, 2 ends, 1, n)
    around_corners = corners_of(around, faces, pixels)
    values, depth = edge_values(around_corners[:, :, None, None], x, y, near=(centre[0], centre[1]))
    patch = stored(topology.patches[jnp.maximum(around, 0)])
    fine = jnp.min(area(face_corners), axis=0) < _FINE
    front_patch = stored(topology.patches[jnp.maximum(front, 0)])
    touching = (patch == front_patch) | fine
    tolerance = jnp.array(TOLERANCE, depth.dtype)
    tolerance = jnp.where(touching, FINE_TOLERANCE, tolerance)
    # Both sides of a face that is seen edge-on end in one place, and may be equally near.
    first, second = _NEXT[:, : len(around)]
    across = (first & undrawn[0]) | (second & undrawn[1])
    tolerance = stored(jnp.where(across, 0, tolerance))
    # Faces in which the surface goes on meet the edge at its ends, and reach over it with no more
    # than rounding: so they are looked at closer to it, but for what lies beside one seen edge-on.
    joins = jnp.any(around[:, None] == nearby, axis=1) & ~(undrawn[0] | undrawn[1])
    closer = jnp.where(joins, jnp.maximum(inset - rounding, 0) / (inset + outside), 0)

    def inside_of(values: Array) -> Array:
        return values[0] + closer * (values[1] - values[0])

    covers = [inside_of(value) for value in values]
    limit = inverse_depth(pieces.range)[:, None] * (1 + tolerance)
    margin = stored(jnp.stack([inside_of(depth), depth[1]]) - limit)
    # What joins a front face that is thinner than that begins where the edge is, and hides nothing.
    joined = jnp.where(use_first, first, second) & (thickness < outside)
    candidates = Candidates(
        face=around,
        patch=patch,
        foreign=foreign,
        hides=[*covers, jnp.where(joined, -1, margin[0])],
        behind=[*(value[1] for value in values), -margin[1]],
        inverse_depth=depth[1],
    )
    part = first_part(candidates, fold)
    half = stored((part.begin + part.end) / 2)
    first, last = pieces.range
    if cast is not None:
        nearest, best = (rows[0] for rows in nearest_behind(candidates, half[None]))
        ground = jnp.where(fold & (nearest > 0), picked(around, best), -1)
        places = [stored(start + (first + at * (last - first)) * along) for at in part[:2]]
        at = crossing(ground, *places, pieces.pixel, cast, surface, pictured)
        shown = (part.end - part.begin) * (last - first) * length
        at = jnp.where(jnp.minimum(at, 1 - at) * shown > SHORT, at, 1)
        part = part._replace(end=stored(part.begin + at * (part.end - part.begin)))
        half = stored((part.begin + part.end) / 2)
    low, high, end, t = (first + at * (last - first) for at in (*part, half))
    exists = pieces.exists & (part.begin < part.end)
    # A rest too short to be looked at belongs to it: a gap may be most of what a centre sees.
    high = jnp.where((end - high) * length > SHORT, high, jnp.maximum(high, end))
    # Of a part that rounding makes nothing of, what follows is left all the same, and is less.
    following = jnp.maximum(high, first * (1 + jnp.finfo(first.dtype).eps))
    left = pieces._replace(
        range=jnp.stack([following, end]), exists=exists & ((end - following) * length > SHORT)
    )
    visible, low, high, t, left = stored_together((exists & (low < high), low, high, t, left))
    begin, end, middle = stored_together([start + at * along for at in (low, high, t)])
    near = stored(inverse_depth(t))

    hidden = buried(
        visible & ~fold,
        centre + middle,
        out,
        near,
        jnp.stack([front, other]),
        around,
        surface,
    )
    visible = visible & ~hidden

    # What is behind.
    nearest, best = (rows[0] for rows in nearest_behind(candidates, half[None]))
    found = fold & (nearest > 0)
    beyond = jnp.where(fold, jnp.where(found, picked(around, best), -1), other)
    beyond = stored(beyond)

    # Pixels whose centres lie on either side. What the rasteriser shows of an edge that passes
    # through a centre tells on which side that is.
    at_end = [_near(begin) & (low == 0), _near(end) & (high == 1)]
    snaps = [_snap(vertex, face_image.shape) for vertex in ends]
    begin, end = (
        point + jnp.where(is_near, snap, 0)
        for point, is_near, snap in zip((begin, end), at_end, snaps, strict=True)
    )
    by = jnp.where(at_end[0], begin, jnp.where(at_end[1], end, middle))
    begin, end, to_right = stored_together((begin, end, -dot_rows(by, normal)))
    depths = stored(depth[1, 0, :9] + half * (depth[1, 1, :9] - depth[1, 0, :9]))
    farther = (pictured[4] < 0) | (foreign[4] & (depths[4] * (1 + FINE_TOLERANCE) < near))
    farther = (pictured[4] == beyond) | (fold & farther)
    wrong_side = fold & (pictured[4] >= 0) & (pictured[4] == other)
    nearer = (pictured[4] == front) | wrong_side
    is_beyond = jnp.where(nearer, -1, jnp.where(farther, 1, 0))
    # Of a needle the centre may show another face as near, and may lie beyond either edge as the
    # rasteriser has them, but not beyond both.
    needle = thickness < 2 * SNAPPED
    same = fold & (pictured[4] >= 0) & (patch[4] == front_patch)
    is_beyond = jnp.where(needle & same & (is_beyond == 0), -1, is_beyond)
    least = jnp.array(_TIE[1], near.dtype)
    told = (outward * is_beyond).astype(near.dtype)  # the sign of `to_right`
    side = _snapped_side(stored(pixels[:, vertices]), centre, face_image.shape)
    told = jnp.where(needle & (is_beyond >= 0) & (side != 0), jnp.sign(side), told)
    close = (jnp.abs(to_right) < SNAPPED) & (told != 0)
    # Of an edge that ends before the centre the one beyond its corner tells.
    ends_before = (at_end[0] & (dot_rows(begin, along) > 0)) | (
        at_end[1] & (dot_rows(end, along) < 0)
    )
    turned = close & ~ends_before & (told * to_right < least)
    shift = stored(jnp.where(turned, told * least - to_right, 0))
    centre_depth = (-outward).astype(near.dtype) * (to_right + shift)
    wrong_side = wrong_side & close
    begin, end, centre_depth = stored_together(
        (begin - shift * normal, end - shift * normal, centre_depth)
    )
    beyond_centre = centre_depth < 0
    front_look = jnp.where(beyond_centre, pixel_at(middle, out, -LOOK), 4)
    beyond_look = jnp.where(beyond_centre, 4, pixel_at(middle, out, LOOK))
    front_look, beyond_look = stored_together((front_look, beyond_look))
    tiny = stored(area(around_corners[:, :, :9])) < _FINE
    before = foreign[:9] & (depths > near * (1 + FINE_TOLERANCE))
    # The surface in front may come nearer inwards, where another one is seen beyond.
    above, of_front = (
        [picked(part, side) for side in (front_look, beyond_look)]
        for part in (tiny & before, patch[:9] == front_patch)
    )
    visible = visible & ~(above[0] & above[1] & (of_front[0] == of_front[1]))

    spot = Spot(
        centre=centre,
        middle=middle,
        out=out,
        near=near,
        fold=fold,
        own=own,
        front=front,
        front_patch=front_patch,
        pictured=pictured,
        patch=patch[:9],
        foreign=foreign[:9],
        depths=depths,
        front_look=front_look,
        beyond_look=beyond_look,
    )
    # The farthest unseen one, or that of the next pixel, or the farthest of those seen not far
    # away: of other surfaces than the two that are walked over anyway, and not what turns away.
    next_farthest = _at(unseen.farthest, *(pieces.pixel + steps_to(beyond_look)))
    unlike = (farthest >= 0) & (patch[_FARTHEST] != front_patch)
    usual = jnp.where(unlike | (next_farthest < 0), farthest, next_farthest)
    not_far = of_block(seen_farthest, *pieces.pixel).astype(jnp.int32)
    starts = jnp.stack([farthest, next_farthest, not_far])
    known = jnp.maximum(starts, 0)
    walked_over = jnp.stack([front_patch, picked(patch[:9], beyond_look)])
    is_other = jnp.all(topology.patches[known] != walked_over[:, None], axis=0)
    best = first_row((starts >= 0) & (volume[known] < 0) & is_other)
    farthest = jnp.where(best < 3, picked(starts, jnp.minimum(best, 2)), usual)
    rim_depth, inner = next_inwards(middle, -out)
    walks = walked(
        spot,
        visible,
        outwards(spot, nearest, farthest, surface),
        inwards(spot, inner, nearby, surface),
        (inset, outside),
        surface,
    )
    visible = visible & ~walks.hidden
    # Where nothing is found, and there are empty pixels not far away, the background is bare.
    gap = walks.ends & of_block(near_bare, *pieces.pixel)
    beyond = jnp.where(walks.behind >= 0, walks.behind, beyond)
    beyond = stored(jnp.where(gap, BACKGROUND, beyond))
    beside, both_end = sides_of(front, beyond, near, walks, surface)
    # Of two edges in one line, as those of tiles side by side are, one is drawn: the first face's.
    visible = visible & ~(fold & both_end & (beyond < front))
    half_way = None
    if cast is not None:
        at = centre + middle + reach(middle, out) / 2 * out
        half_way = located(beyond, at, surface)
    bare = pictured < 0
    bare_look = first_row(bare)
    bare_look = jnp.where(bare_look < 9, bare_look, front_look)

    # What the sides show may be seen at another pixel.
    patch = jnp.where(bare, -1, patch[:9])
    front_shown = stored(_where_shown(front, front_look, patch, topology.patches))
    beyond_look = _where_shown(beyond, beyond_look, patch, topology.patches)
    beyond_look = stored(jnp.where(gap, bare_look, beyond_look))

    # Where the next pixel inwards shows something else, or what lies round a lip, the pixel's own
    # centre takes its place.
    alone = walks.goes_on[0] & ~walks.goes_on[1] & (front_look == 4)
    rim = look_inwards(
        front,
        apex,
        thickness,
        pictured,
        (rim_depth, stored(jnp.where(alone, 4, inner))),
        walks.connected[0] & walks.connected[1],
        middle,
        length,
        end - begin,
        -out,
        centre,
        surface,
    )

    # Which side is what the pixel shows at its centre: one surface may lie there in several layers.
    shows = pictured[4] >= 0
    is_front = shows & (front_shown == 4) & (patch[4] == front_patch)
    is_front = is_front & (~fold | ((front_look == 4) & walks.connected[0]))
    alike = (beyond == -1) | (beyond == pictured[4])
    is_beyond = shows & (beyond_look == 4) & alike

    # A flap of a curved surface, narrower than a pixel, in front of that surface itself.
    folded = picked(patch, beyond_look) == front_patch
    flap = fold & ~rim.smooth & (beyond == -1) & folded
    seen = Seen(
        visible=visible & ~flap,
        fold=fold,
        front_on_right=front_on_right,
        front=Side(front, [b[0] for b in beside], front_shown, is_front),
        beyond=Side(beyond, [b[1] for b in beside], beyond_look, is_beyond & ~is_front),
        rim=rim,
        wrong_side=wrong_side,
        centre_depth=centre_depth,
        begin=begin,
        end=end,
        middle=t,
        half_way=half_way,
    )
    return stored_together(seen), left


def _where_shown(face: Array, look: Array, patch: Array, patches: Array) -> Array:
    """Which of the 3×3 pixels shows the surface of a face: `look` if it does, or if none does."""
    same = (face >= 0) & (patch == patches[jnp.maximum(face, 0)])
    first = first_row(same)
    return jnp.where(picked(same, look) | (first == 9), look, first)


def _at(image: Int[Array, "height width"], column: Array, row: Array) -> Int[Array, " n"]:
    """The values of an image at pixels, or at the nearest ones that it has."""
    height, width = image.shape
    return stored(image[row.clip(0, height - 1), column.clip(0, width - 1)].astype(jnp.int32))


def _near(point: Array) -> Bool[Array, " n"]:
    return dot_rows(point, point) < _BY**2


def _snap(vertex: Float[Array, "2 *n"], shape: tuple[int, ...]) -> Float[Array, "2 *n"]:
    """From where a vertex near a pixel's centre is to where the rasteriser has it.

    That is on a grid, and a centre on an edge belongs to what is on the right of it, or else below.
    So all edges that meet at a centre agree on which side that is.
    """
    steps = float(1 << subpixel_bits(*shape))
    tie = jnp.array(_TIE, vertex.dtype).reshape(2, *[1] * (vertex.ndim - 1))
    return jnp.round(vertex * steps) / steps - vertex - tie


def _snapped_side(
    ends: Float[Array, "3 2 n"], centre: Float[Array, "2 n"], shape: tuple[int, ...]
) -> Float[Array, " n"]:
    """How far centres lie to the right of edges as the rasteriser has them, times any length.

    Zero where an end is behind the camera.
    """
    x, y, w = ends
    inverse_w = 1 / jnp.where(w > 0, w, 1)
    vertex = jnp.stack([x * inverse_w, y * inverse_w])
    snapped = vertex + _snap(vertex, shape) - centre[:, None]
    (start_x, end_x), (start_y, end_y) = snapped
    side = start_y * end_x - start_x * end_y
    return jnp.where((w[0] > 0) & (w[1] > 0), side, 0)


def _thickness(apex: Array, start: Array, normal: Array, length: Array, t: Array) -> Array:
    """How far a face reaches from the point `t` of its edge, at right angles to it, or less."""
    x, y, w = apex
    inverse_w = 1 / jnp.where(w > 0, w, 1)
    x, y = x * inverse_w - start[0], y * inverse_w - start[1]
    height = jnp.abs(x * normal[0] + y * normal[1])
    foot = (y * normal[0] - x * normal[1]) / jnp.where(length > 0, length, 1)
    share = jnp.minimum(
        t / jnp.maximum(jnp.maximum(foot, t), _SMALL),
        (1 - t) / jnp.maximum(jnp.maximum(1 - foot, 1 - t), _SMALL),
    )
    return jnp.where(w > 0, height * share, 1)
