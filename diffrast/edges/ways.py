"""Walks over surfaces, which tell what lies beside an edge where no pixel's centre shows it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._stored import stored, stored_together
from diffrast.edges.neighborhood import (
    Surface,
    least_row,
    picked,
    steps_to,
    turned_alike,
    walk,
)
from diffrast.edges.planes import (
    FINE_TOLERANCE,
    TOLERANCE,
    Columns,
    barycentrics,
    corners_of,
    edge_values,
    lowest,
)

LOOK = 0.75  # pixels from the edge to a point whose pixel's centre lies on its side: > sqrt(1/2)
_PLAIN = 0.7  # of what comes nearer from a rim to a pixel: its plane's share, 0.5 on a sphere


class Spot(NamedTuple):
    """Where pieces are, and what is seen at the 3×3 pixels round them."""

    centre: Float[Array, "2 n"]  # of the pixel, on the screen
    middle: Float[Array, "2 n"]  # of the part that may be seen, from there
    out: Float[Array, "2 n"]  # unit normal, away from the face in front
    near: Float[Array, " n"]  # 1/w of the edge there
    fold: Bool[Array, " n"]
    own: Int[Array, "2 n"]  # faces of the edge
    front: Int[Array, " n"]  # the one in front
    front_patch: Int[Array, " n"]
    pictured: Int[Array, "9 n"]  # faces at the pixels
    patch: Int[Array, "9 n"]  # of these
    foreign: Bool[Array, "9 n"]  # whether the edge is not theirs
    depths: Float[Array, "9 n"]  # 1/w of their planes at the middle
    front_look: Int[Array, " n"]  # 0 to 8: pixel of the 3×3 on the side of the face in front
    beyond_look: Int[Array, " n"]  # and on the other one


class Outwards(NamedTuple):
    """Ways to the point just beyond a piece."""

    # Faces of two surfaces that may hide it, and of two that may lie behind; or -1.
    starts: Int[Array, "4 n"]
    search: Bool[Array, " n"]  # whether something may lie behind that is not found yet,
    least: Float[Array, " n"]  # with more than this 1/w,
    found: Bool[Array, " n"]  # or instead of nothing
    shown: Int[Array, " n"]  # what is seen beyond


class Inwards(NamedTuple):
    """Ways to the point just inside of a piece."""

    starts: Int[Array, "2 n"]  # faces at the pixel in front and at the next one inwards; or -1
    plain: Bool[Array, "2 n"]  # whether it is plain that the surface in front goes on to them
    alike: Bool[Array, "2 n"]  # whether it may
    same_side: Bool[Array, "2 n"]  # whether they turn the same side to the eye as the one in front


class Walked(NamedTuple):
    """What was found."""

    hidden: Bool[Array, " n"]  # the piece is
    behind: Int[Array, " n"]  # the face behind it, or -1
    ends: Bool[Array, " n"]  # nothing is, and what is seen beyond ends before
    connected: Bool[Array, "2 n"]  # whether the pixels of `Inwards` show the surface in front,
    goes_on: Bool[Array, "2 n"]  # and from the same side, so that no lip lies between
    inside: Float[Array, "2 n"]  # the point just inside, on the screen,
    beyond: Float[Array, "2 n"]  # and just beyond


def outwards(
    spot: Spot,
    nearest: Float[Array, " n"],
    farthest: Int[Array, " n"],
    surface: Surface,
) -> Outwards:
    """From where to walk to the point just beyond.

    From where a surface is seen that would hide the piece if it reached it: the nearest one on the
    screen and, for a fold, the one that is least in front of it. Where nothing is found behind, or
    one is seen that would lie before that, from what is seen beyond or, if that does not fit, from
    the nearest one that does; and from the farthest other one, or one that is not seen. What hides
    an edge that is no fold is mostly the other side of its own body, so its second walk starts from
    what is seen last before it.

    Args:
        spot: of pieces.
        nearest: 1/w of what is found behind them, if above 0.
        farthest: of faces there that no centre shows, or -1.
        surface: all faces.
    """
    near, fold, own, pictured = spot.near, spot.fold, spot.own, spot.pictured
    foreign, depths, look = spot.foreign, spot.depths, spot.beyond_look
    found = fold & (nearest > 0)
    before = foreign & (depths > near * (1 + FINE_TOLERANCE))
    least = stored(jnp.where(found, nearest * (1 + FINE_TOLERANCE), -jnp.inf))
    after = foreign & (depths < near * (1 - FINE_TOLERANCE)) & (depths > least)
    search = fold & (~found | jnp.any(after, axis=0))
    crease = ~fold & ~jnp.any((pictured == own[0]) | (pictured == own[1]), axis=0)
    shown = picked(pictured, look)
    masks = jnp.stack([(fold | crease) & before, search & after])
    points = jnp.stack([spot.middle, spot.middle + LOOK * spot.out])
    hiding, behind = jax.vmap(_seen_nearest, in_axes=(0, None, 0))(masks, pictured, points)
    last = _seen_least((fold | crease) & before, pictured, depths)
    shown_fits = picked(after, look) | (behind < 0)
    behind = jnp.where(shown_fits, jnp.where(search, shown, -1), behind)
    behind = stored(jnp.where(crease, last, behind))
    others = search & after & (spot.patch != surface.topology.patches[jnp.maximum(behind, 0)])
    second = _seen_least(others, pictured, depths)
    starts = search & (second < 0) & (farthest != own[0]) & (farthest != own[1])
    second = jnp.where(starts, farthest, second)
    last = jnp.where(fold & (last != hiding), last, -1)
    return Outwards(jnp.stack([hiding, last, behind, second]), search, least, found, shown)


def inwards(
    spot: Spot,
    inner: Int[Array, " n"],
    nearby: Int[Array, "some n"],
    surface: Surface,
) -> Inwards:
    """From where to walk to the point just inside.

    From pixels that show the surface in front, or another part of it that folds before or behind:
    where it is not plain that this one comes nearer inwards.

    Args:
        spot: of pieces.
        inner: the next pixel inwards, 0 to 8.
        nearby: faces round the edge.
        surface: all faces.
    """
    looks = jnp.stack([spot.front_look, inner])
    ours = stored(jnp.stack([picked(spot.pictured, look) for look in looks]))
    alike = jnp.stack([picked(spot.patch, look) for look in looks]) == spot.front_patch
    alike = alike & spot.fold & (ours >= 0)
    x, y = spot.centre[:, None] + steps_to(looks).astype(spot.centre.dtype)
    both = jnp.stack([ours, jnp.broadcast_to(spot.front, ours.shape)])
    values, inverse_depths = edge_values(corners_of(both, surface.faces, surface.pixels), x, y)
    ahead = inverse_depths[0] - spot.near
    # Where the face in front reaches a centre that shows another one, it is hidden there.
    least_share = lowest(barycentrics([value[1] for value in values]))[0]
    hidden = (least_share > FINE_TOLERANCE) & (ours != spot.front)
    planes = jnp.stack([picked(spot.depths, look) for look in looks]) - spot.near
    plain = (ours == spot.front) | jnp.any(nearby[:, None] == ours, axis=0)
    plain = plain | ((ahead > 0) & (abs(planes) < _PLAIN * ahead))
    facing = jnp.sign(surface.volume[jnp.maximum(spot.front, 0)])
    same_side = turned_alike(ours, facing, surface.volume)
    return Inwards(jnp.where(alike & ~plain, ours, -1), plain, alike & ~hidden, same_side)


def walked(
    spot: Spot,
    visible: Bool[Array, " n"],
    outward: Outwards,
    inward: Inwards,
    distances: tuple[Float[Array, " n"], float],
    surface: Surface,
) -> Walked:
    """Walk, for pieces that may be visible, to points so many pixels inside and beyond."""
    near, own = spot.near, spot.own
    starts = jnp.concatenate([outward.starts, inward.starts])
    inside, outside = distances
    away = jnp.stack([outside * spot.out] * 4 + [-inside * spot.out] * 2, axis=1)
    starts, (x, y) = stored_together(
        (jnp.where(visible, starts, -1), (spot.centre + spot.middle)[:, None] + away)
    )
    reached, there = walk(starts, x, y, surface)
    arrives = there & (reached >= 0)
    depth = edge_values(corners_of(reached, surface.faces, surface.pixels), x, y)[1]
    in_front = depth > near * (1 + FINE_TOLERANCE)
    touches = ~in_front[4:] & (depth[4:] > near * (1 - FINE_TOLERANCE))
    connected = inward.plain | (arrives[4:] & (touches | (reached[4:] == spot.front)))
    connected = connected & inward.alike
    hides = arrives[:4] & (reached[:4] != own[0]) & (reached[:4] != own[1]) & in_front[:4]
    lies = outward.search & arrives[2:4] & ~hides[2:] & (depth[2:4] > outward.least)
    nearer_lies = lies & (depth[2:4] >= jnp.where(lies, depth[2:4], 0)[::-1])
    ends = outward.search & ~outward.found & there[2] & (reached[2] < 0) & (outward.shown >= 0)
    hidden = hides[0] | hides[1] | hides[2]
    # Held: combined once more for each of their uses they are no vector code.
    connected, lies, nearer_lies, hidden, ends = stored_together(
        (connected, lies, nearer_lies, hidden, ends & ~lies[1])
    )
    behind = jnp.where(nearer_lies[0], reached[2], jnp.where(lies[1], reached[3], -1))
    return Walked(
        hidden,
        behind,
        ends,
        connected,
        connected & inward.same_side,
        inside=jnp.stack([x[4], y[4]]),
        beyond=jnp.stack([x[0], y[0]]),
    )


def sides_of(
    front: Int[Array, " n"],
    beyond: Int[Array, " n"],
    near: Float[Array, " n"],
    found: Walked,
    surface: Surface,
) -> tuple[Columns, Bool[Array, " n"]]:
    """Barycentric coordinates of faces at the points just inside and just beyond, one each.

    On the edge itself rounding would decide whether a face that ends there shades it. And whether
    the surface beyond ends at this edge as well, of 1/w `near`: so do tiles side by side.
    """
    faces = jnp.stack([front, beyond, beyond])
    x, y = jnp.stack([found.inside, found.beyond, found.inside], axis=1)
    values, depth = edge_values(corners_of(faces, surface.faces, surface.pixels), x, y)
    least, corner = lowest([value[2] for value in values])
    known = jnp.maximum(beyond, 0)
    across = surface.topology.neighbors[known, corner]
    goes_on = turned_alike(across, jnp.sign(surface.volume[known]), surface.volume)
    touches = abs(depth[1] - near) < TOLERANCE * near
    both_end = (beyond >= 0) & touches & (least < 0) & ~goes_on
    return barycentrics([jnp.maximum(value[:2], 0) for value in values]), both_end


def located(face: Array, point: Array, surface: Surface) -> Columns:
    """Barycentric coordinates of points (x, y) on the screen, or of what faces have near them."""
    values, _ = edge_values(corners_of(face, surface.faces, surface.pixels), *point)
    return barycentrics([jnp.maximum(value, 0) for value in values])


def _seen_nearest(mask: Array, pictured: Array, point: Array) -> Array:
    """What the pixel of the 3×3 shows whose centre is nearest to a point, of a mask; or -1."""
    x, y = steps_to(jnp.arange(9))[..., None].astype(point.dtype) - point[:, None]
    return _seen_least(mask, pictured, x * x + y * y)


def _seen_least(mask: Array, pictured: Array, values: Array) -> Array:
    """What the pixel of the 3×3 shows where a value is least, of a mask; or -1."""
    best = least_row(mask, values)
    return jnp.where(best < 9, picked(pictured, jnp.minimum(best, 8)), -1)
