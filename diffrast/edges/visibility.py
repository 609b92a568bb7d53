"""What lies on the two sides of a piece of an edge, and which part of it can be seen.

Candidates for what hides a piece, or lies behind it, are the faces at the 3×3 pixels round it,
those round the edge itself and, of several bodies, two that have an edge in the pixel but show at
none of these centres. The first part of the piece is looked at here (see `parts`); what is
left of it becomes a piece of its own. Faces may be too thin for any pixel to show them: a walk over
the surface that is seen nearby, and would hide the part if it reached it, tells whether it does.
Where no candidate lies behind the part, walks over two surfaces at the pixels around, the one
beyond first, tell which of their faces does, or that both end before. Where only one is seen, the
second may be one that no centre shows.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._stored import stored, stored_together
from diffrast._topology import Topology, third_corner
from diffrast.edges.creases import buried
from diffrast.edges.neighborhood import (
    first_row,
    is_near_background,
    least_row,
    only,
    picked,
    pixel_at,
    pixels_round,
    ring_of_edge,
    steps_to,
    walk,
)
from diffrast.edges.parts import Candidates, first_part, nearest_behind
from diffrast.edges.pieces import Pieces, Segments
from diffrast.edges.planes import (
    FINE_TOLERANCE,
    TOLERANCE,
    Columns,
    Table,
    area,
    barycentrics,
    corners_of,
    covers,
    edge_values,
    inverse_depth_slope,
    lowest,
)
from diffrast.edges.rim import SHORT, Rim, look_inwards, next_inwards

_BEYOND = 1e-4  # pixels from the edge to the point that shows what is behind it,
_ROUNDINGS = 8  # of a position, if that is more
_SNAPPED = 2e-3  # pixels: more than edges move by the rounding of vertices in the rasteriser
_LOOK = 0.75  # pixels from the edge to a point whose pixel's centre lies on its side: > sqrt(1/2)
_PLAIN = 0.7  # of what comes nearer from a rim to a pixel: its plane's share, 0.5 on a sphere
_FINE = 1.0  # square pixels: faces of half this area may hide others that no pixel shows
_SMALL = 1e-6  # keeps a ratio of lengths finite

BACKGROUND = -2
# Which of the candidates, behind those at nine pixels, are next to an edge's first face, or second.
_NEXT = np.zeros((2, 9 + 12 + 2, 1), bool)
_NEXT[0, [9, 11]] = _NEXT[1, [10, 12]] = True


class Unseen(NamedTuple):
    """Faces that have an edge in a pixel, but are seen at no centre of the 3×3 round it; or -1."""

    nearest: Int[Array, "height width"]  # of other bodies than those seen there
    farthest: Int[Array, "height width"]  # of any


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


@jax.jit
def uncovered(
    pieces: Pieces,
    segments: Segments,
    faces: Int[Array, "F 3"],
    pixels: Table,
    face_image: Int[Array, "height_with_border width_with_border"],
) -> Pieces:
    """Pieces without those that the face seen at their pixel's centre hides all along.

    Most are left out where many surfaces lie one behind the other.
    """
    column, row = pieces.pixel
    face = stored(face_image[row + 1, column + 1])
    own, weights, ends = stored_together(
        (
            segments.faces[:, pieces.segment],
            segments.weights[:, pieces.segment],
            segments.ends[..., pieces.segment],
        )
    )
    along = ends[1] - ends[0]
    length = jnp.sqrt(along[0] * along[0] + along[1] * along[1])
    inside, _ = _beside_edge(face_image.shape, length.dtype)
    aside = along * (inside / jnp.where(length > 0, length, 1))
    sides = jnp.stack([-aside, aside])
    x = ends[0, 0] + pieces.range * along[0] + sides[:, None, 1]  # (2 sides, 2 ends, n)
    y = ends[0, 1] + pieces.range * along[1] - sides[:, None, 0]
    x, y = stored_together((x, y))
    corners = corners_of(face, faces, pixels)[:, :, None, None]
    values, depth = edge_values(corners, x, y, near=(x[0, 0], y[0, 0]))
    own_depth = weights[0] + pieces.range * (weights[1] - weights[0])
    before = covers(values) & (depth > own_depth * (1 + FINE_TOLERANCE))
    before = stored(before.astype(jnp.int32)).reshape(4, -1)  # a reduction would be no vector code
    foreign = (face >= 0) & (face != own[0]) & (face != own[1])
    hidden = foreign & ((before[0] & before[1] & before[2] & before[3]) > 0)
    return pieces._replace(exists=pieces.exists & ~hidden)


@jax.jit
def unpictured(
    pieces: Pieces,
    segments: Segments,
    face_image: Int[Array, "height_with_border width_with_border"],
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Faces of pieces' edges that none of the 3×3 pixels shows, or -1; and 1/w of the pieces."""
    own, weights = stored_together(
        (segments.faces[:, pieces.segment], segments.weights[:, pieces.segment])
    )
    pictured = pixels_round(face_image, *pieces.pixel)
    shown = jnp.any(pictured[:, None] == own, axis=0)
    face = jnp.max(jnp.where(shown | ~pieces.exists, -1, jnp.maximum(own, -1)), axis=0)
    middle = (pieces.range[0] + pieces.range[1]) / 2
    return face, weights[0] + middle * (weights[1] - weights[0])


@jax.jit
def look(
    pieces: Pieces,
    segments: Segments,
    faces: Int[Array, "F 3"],
    pixels: Table,
    topology: Topology,
    volume: Float[Array, " F"],
    face_image: Int[Array, "height_with_border width_with_border"],
    near_bare: Bool[Array, "rows columns"],
    unseen: Unseen | None,
) -> tuple[Seen, Pieces]:
    """What is seen beside the first visible parts of pieces, and what is left of the pieces.

    `volume` is that of `facing`, but 0 for faces that are not drawn; `face_image` has a border of
    one pixel all round; `near_bare` is its `near_background`. `unseen` are two more faces of each
    pixel.
    """
    own, own_corners, weights, *ends, fold, first_on_right = stored_together(
        (
            segments.faces[:, pieces.segment],
            segments.corners[:, pieces.segment],
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
    out = stored(outward * normal)

    t = (pieces.range[0] + pieces.range[1]) / 2
    thickness = stored(_thickness(front, front_corners, faces, pixels, ends[0], normal, length, t))
    pictured = stored(pixels_round(face_image, *pieces.pixel))
    undrawn = own < -1
    of_edge = jnp.where(undrawn, -2 - own, own)
    nearby = only(ring_of_edge(of_edge, topology.neighbors), volume != 0)
    more = [] if unseen is None else [_at(part, *pieces.pixel)[None] for part in unseen]
    around = stored(jnp.concatenate([pictured, nearby, *more]))
    foreign = (around >= 0) & (around != own[0]) & (around != own[1])

    # Seen from just inside, and from just beyond.
    inside, outside = _beside_edge(face_image.shape, length.dtype)
    offset = jnp.stack([-jnp.minimum(inside, thickness / 2) * out, outside * out], axis=1)
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
    margin = stored(depth - inverse_depth(pieces.range)[:, None] * (1 + tolerance))
    # What joins a front face that is thinner than that begins where the edge is, and hides nothing.
    joined = jnp.where(use_first, first, second) & (thickness < outside)
    candidates = Candidates(
        face=around,
        patch=patch,
        foreign=foreign,
        hides=[*(value[0] for value in values), jnp.where(joined, -1, margin[0])],
        behind=[*(value[1] for value in values), -margin[1]],
        inverse_depth=depth[1],
    )
    part = first_part(candidates, fold)
    half = stored((part.begin + part.end) / 2)
    first, last = pieces.range
    low, high, end, t = (first + at * (last - first) for at in (*part, half))
    exists = pieces.exists & (part.begin < part.end)
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
        faces,
        pixels,
        topology.neighbors,
        volume,
    )
    visible = visible & ~hidden

    # What is behind.
    nearest, best = (rows[0] for rows in nearest_behind(candidates, half[None]))
    found = fold & (nearest > 0)
    beyond = jnp.where(fold, jnp.where(found, picked(around, best), -1), other)
    beyond = stored(beyond)

    # Pixels whose centres lie on either side. What the rasteriser shows of an edge that passes
    # through a centre tells on which side that is.
    to_right = -(middle[0] * normal[0] + middle[1] * normal[1])
    depths = stored(depth[1, 0, :9] + half * (depth[1, 1, :9] - depth[1, 0, :9]))
    farther = (pictured[4] < 0) | (foreign[4] & (depths[4] * (1 + FINE_TOLERANCE) < near))
    farther = (pictured[4] == beyond) | (fold & farther)
    wrong_side = fold & (pictured[4] >= 0) & (pictured[4] == other)
    nearer = (pictured[4] == front) | wrong_side
    is_beyond = jnp.where(nearer, -1, jnp.where(farther, 1, 0))
    close = (jnp.abs(to_right) < _SNAPPED) & (is_beyond != 0)
    snapped = jnp.array(_SNAPPED, near.dtype)
    shift = stored(jnp.where(close, outward * is_beyond * snapped - to_right, 0))
    centre_depth = -outward * (to_right + shift)
    wrong_side = wrong_side & close
    begin, end, centre_depth = stored_together(
        (begin - shift * normal, end - shift * normal, centre_depth)
    )
    beyond_centre = centre_depth < 0
    front_look = jnp.where(beyond_centre, pixel_at(middle, out, -_LOOK), 4)
    beyond_look = jnp.where(beyond_centre, 4, pixel_at(middle, out, _LOOK))
    front_look, beyond_look = stored_together((front_look, beyond_look))
    tiny = stored(area(around_corners[:, :, :9])) < _FINE
    same = patch[:9] == front_patch
    before = foreign[:9] & (depths > near * (1 + FINE_TOLERANCE))
    # The surface in front may come nearer inwards, where another one is seen beyond.
    above = tiny & before
    looks = jnp.stack([front_look, beyond_look])
    above, ours = (jnp.stack([picked(part, look) for look in looks]) for part in (above, same))
    visible = visible & ~(above[0] & above[1] & (ours[0] == ours[1]))

    # Walks over the surface to the point just beyond: from where a surface is seen that would hide
    # the piece if it reached it; and where nothing is found behind, or one is seen that would lie
    # before that, from what is seen beyond or, if that does not fit, from the nearest one that
    # does. If its surface ends before, so does the nearest other one, nothing else was found, and
    # there are empty pixels not far away, the background is bare. What hides an edge that is no
    # fold is mostly the other side of its own body, so its second walk starts from what is seen
    # last before it.
    least = stored(jnp.where(found, nearest * (1 + FINE_TOLERANCE), -jnp.inf))
    after = foreign[:9] & (depths < near * (1 - FINE_TOLERANCE)) & (depths > least)
    search = fold & (~found | jnp.any(after, axis=0))
    crease = ~fold & ~jnp.any((pictured == own[0]) | (pictured == own[1]), axis=0)
    bare = pictured < 0
    shown = picked(pictured, beyond_look)
    masks = jnp.stack([(fold | crease) & before, search & after])
    points = jnp.stack([middle, middle + _LOOK * out])
    hiding, behind = jax.vmap(_seen_nearest, in_axes=(0, None, 0))(masks, pictured, points)
    last = _seen_least(crease & before, pictured, depths)
    shown_fits = picked(after, beyond_look) | (behind < 0)
    behind = jnp.where(shown_fits, jnp.where(search, shown, -1), behind)
    behind = stored(jnp.where(crease, last, behind))
    others = search & after & (patch[:9] != topology.patches[jnp.maximum(behind, 0)])
    other_behind = _seen_nearest(others, pictured, points[1])
    if unseen is not None:
        farthest = unseen.farthest
        last = _last_unseen(farthest, pieces.pixel, beyond_look, front_patch, topology.patches)
        last = jnp.where(search & (last != own[0]) & (last != own[1]), last, -1)
        other_behind = jnp.where(other_behind < 0, last, other_behind)

    # And two to the point just inside, from pixels that show the surface in front, or another part
    # of it that folds before or behind: where it is not plain that this one comes nearer inwards.
    inwards = next_inwards(middle, -out)
    looks = jnp.stack([front_look, inwards[1]])
    ours = stored(jnp.stack([picked(pictured, look) for look in looks]))
    alike = jnp.stack([picked(patch, look) for look in looks]) == front_patch
    alike = alike & fold & (ours >= 0)
    x, y = centre[:, None] + steps_to(looks)
    both = jnp.stack([ours, jnp.broadcast_to(front, ours.shape)])
    values, inverse_depths = edge_values(corners_of(both, faces, pixels), x, y)
    ahead = inverse_depths[0] - near
    # Where the face in front reaches a centre that shows another one, it is hidden there.
    least_share = lowest(barycentrics([value[1] for value in values]))[0]
    hidden = (least_share > FINE_TOLERANCE) & (ours != front)
    planes = jnp.stack([picked(depths, look) for look in looks]) - near
    plain = (ours == front) | jnp.any(around[9 : 9 + len(nearby), None] == ours, axis=0)
    plain = plain | ((ahead > 0) & (abs(planes) < _PLAIN * ahead))

    ways = jnp.stack([hiding, behind, other_behind, *jnp.where(alike & ~plain, ours, -1)])
    away = jnp.stack([outside * out] * 3 + [-jnp.minimum(inside, thickness / 2) * out] * 2, axis=1)
    ways, (x, y) = stored_together(
        (jnp.where(visible, ways, -1), (centre + middle)[:, None] + away)
    )
    reached, there = walk(ways, x, y, faces, pixels, topology.neighbors, volume)
    arrives = there & (reached >= 0)
    reached_depth = edge_values(corners_of(reached, faces, pixels), x, y)[1]
    in_front = reached_depth > near * (1 + FINE_TOLERANCE)
    touches = ~in_front[3:] & (reached_depth[3:] > near * (1 - FINE_TOLERANCE))
    connected = plain | (arrives[3:] & (touches | (reached[3:] == front)))
    connected = connected & alike & ~hidden
    hides = arrives[:3] & (reached[:3] != own[0]) & (reached[:3] != own[1]) & in_front[:3]
    visible = visible & ~hides[0] & ~hides[1]
    lies = search & arrives[1:3] & ~hides[1:] & (reached_depth[1:3] > least)
    nearer_lies = lies & (reached_depth[1:3] >= jnp.where(lies, reached_depth[1:3], 0)[::-1])
    stops = search & ~found & there[1] & (reached[1] < 0) & (shown >= 0) & ~lies[1]
    # Held: combined once more for each of their uses they are no vector code.
    connected, lies, nearer_lies, visible, stops = stored_together(
        (connected, lies, nearer_lies, visible, stops)
    )
    gap = stops & is_near_background(near_bare, *pieces.pixel)
    beyond = jnp.where(nearer_lies[0], reached[1], jnp.where(lies[1], reached[2], beyond))
    beyond = stored(jnp.where(gap, BACKGROUND, beyond))
    # On the edge itself rounding would decide whether a face that ends there shades it.
    sides = jnp.stack([front, beyond])
    x, y = (jnp.stack([along[3], along[1]]) for along in (x, y))
    values, _ = edge_values(corners_of(sides, faces, pixels), x, y)
    beside = barycentrics([jnp.maximum(value, 0) for value in values])
    bare_look = first_row(bare)
    bare_look = jnp.where(bare_look < 9, bare_look, front_look)

    # What the sides show may be seen at another pixel.
    patch = jnp.where(bare, -1, patch[:9])
    front_shown = stored(_where_shown(front, front_look, patch, topology.patches))
    beyond_look = _where_shown(beyond, beyond_look, patch, topology.patches)
    beyond_look = stored(jnp.where(gap, bare_look, beyond_look))

    rim = look_inwards(
        front,
        thickness,
        pictured,
        inwards,
        connected[0] & connected[1],
        middle,
        end - begin,
        -out,
        centre,
        faces,
        pixels,
        topology.neighbors,
        volume,
    )

    # Which side is what the pixel shows at its centre: one surface may lie there in several layers.
    shows = pictured[4] >= 0
    is_front = shows & (front_shown == 4) & (patch[4] == front_patch)
    is_front = is_front & (~fold | ((front_look == 4) & connected[0]))
    alike = (beyond == -1) | (beyond == pictured[4])
    is_beyond = shows & (beyond_look == 4) & alike

    # A flap of a curved surface, narrower than a pixel, in front of that surface itself.
    same = picked(patch, beyond_look) == front_patch
    flap = fold & ~rim.smooth & (beyond == -1) & same
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
    )
    return stored_together(seen), left


def _beside_edge(shape: tuple[int, ...], dtype: jnp.dtype) -> tuple[float, float]:
    """Pixels from edges to the points that show what hides them, inside, and what is beyond.

    As few as rounding leaves certain: where fine surfaces fold, others lie as near.
    """
    outside = max(_BEYOND, _ROUNDINGS * float(jnp.finfo(dtype).eps) * max(shape))
    return 2 * outside, outside


def _where_shown(face: Array, look: Array, patch: Array, patches: Array) -> Array:
    """Which of the 3×3 pixels shows the surface of a face: `look` if it does, or if none does."""
    same = (face >= 0) & (patch == patches[jnp.maximum(face, 0)])
    first = first_row(same)
    return jnp.where(picked(same, look) | (first == 9), look, first)


def _at(image: Int[Array, "height width"], column: Array, row: Array) -> Int[Array, " n"]:
    """The values of an image at pixels, or at the nearest ones that it has."""
    height, width = image.shape
    return stored(image[row.clip(0, height - 1), column.clip(0, width - 1)].astype(jnp.int32))


def _last_unseen(
    farthest: Array, pixel: Array, look: Array, front_patch: Array, patches: Array
) -> Array:
    """The farthest unseen face of a pixel or, if that is of the surface in front, of the next."""
    here, there = _at(farthest, *pixel), _at(farthest, *(pixel + steps_to(look)))
    other = (here >= 0) & (patches[jnp.maximum(here, 0)] != front_patch)
    return jnp.where(other | (there < 0), here, there)


def _seen_nearest(mask: Array, pictured: Array, point: Array) -> Array:
    """What the pixel of the 3×3 shows whose centre is nearest to a point, of a mask; or -1."""
    x, y = steps_to(jnp.arange(9))[..., None] - point[:, None]
    return _seen_least(mask, pictured, x * x + y * y)


def _seen_least(mask: Array, pictured: Array, values: Array) -> Array:
    """What the pixel of the 3×3 shows where a value is least, of a mask; or -1."""
    best = least_row(mask, values)
    return jnp.where(best < 9, picked(pictured, jnp.minimum(best, 8)), -1)


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
    x, y, w = pixels[:, stored(faces[jnp.maximum(face, 0), third_corner(edge)])]
    inverse_w = 1 / jnp.where(w > 0, w, 1)
    x, y = x * inverse_w - start[0], y * inverse_w - start[1]
    height = jnp.abs(x * normal[0] + y * normal[1])
    foot = (y * normal[0] - x * normal[1]) / jnp.where(length > 0, length, 1)
    share = jnp.minimum(
        t / jnp.maximum(jnp.maximum(foot, t), _SMALL),
        (1 - t) / jnp.maximum(jnp.maximum(1 - foot, 1 - t), _SMALL),
    )
    return jnp.where(w > 0, height * share, 1)
