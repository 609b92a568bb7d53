"""Lines along which surfaces pierce each other.

The 1/w of a plane is linear on the screen, and so is the difference of that of two faces: where it
is zero they meet, along a straight line, with the one in front on this side and the other on that.
The line is cut to one pixel and to both faces, and then parts areas as an edge of a mesh does. Only
faces of different bodies are looked at: those seen at the 3×3 pixels round a pixel, one that has an
edge in the pixel or next to it, but is seen at none of these centres, and the faces of two bodies
that meet nearest to the centre, with those next to them. These two are found by walks over both
surfaces to where the planes meet that are known so far. Faces of a mesh that are smaller than a
pixel are too many to be cut with one another: the planes of these two stand for their surfaces in
all of the pixel. A surface that pierces itself is not found.

With homogeneous corners V, a point p of the screen (x, y, 1) is the sum of λ V, the λ linear in p
and positive on the face, and 1/w is their sum. For the plane c, c · p = 1/w, and c · V = 1 at each
corner; so where a corner moves by dV, 1/w changes at a fixed point by −λ c · dV.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._device import anywhere
from diffrast._selection import divided, selected
from diffrast._stored import stored, stored_together, zero_after
from diffrast.edges.neighborhood import (
    Surface,
    first_row,
    largest_round,
    least_row,
    only,
    picked,
    pixels_round,
    steps_to,
    walk,
)
from diffrast.edges.pieces import positive_part
from diffrast.edges.planes import ASIDE, TOLERANCE, Table, area, corners_of, room_in_pixel
from diffrast.edges.rim import reach

PIXELS_AT_ONCE = 512
LINES_AT_ONCE = 128
_REACH = 0.75  # pixels from the centre: farther than the corners
_HALF = 0.5001  # pixels: as far as a pixel reaches, and a little for lines along its border
_THROUGH = 0.001  # pixels to both sides of the line that both faces reach
_ROUNDINGS = 64  # in the slope of 1/w
_FINE = 2.0  # square pixels: faces of half this area count as small ones
_WALKS = 4  # one after the other
_NEAR = 1.5  # pixels from the centre to where the planes meet that are known at first
_CLOSE = 0.1  # pixels from where two walks ended to where the planes found there meet
_FACES = 2 + 9 + 2 * 3 + 1
_CENTRE = 2  # the row of what the pixel's centre shows, and the first of the nine pixels
_NEAREST_FIRST = np.array([4, 1, 3, 5, 7, 0, 2, 6, 8], np.int32)  # the order of these


class _Planes(NamedTuple):
    """Faces that may be seen at each pixel, shape (18, n); from the pixel's centre."""

    face: Array
    body: Array
    look: Array  # 0 to 8: pixel of the 3×3 whose colour changes as this face's
    lambdas: Array  # (3, 3 corners, 18, n): at the centre in units of the largest sum, slopes
    known: Array  # neither edge-on nor there already
    fine: Array  # of a mesh, and smaller than a pixel


# Walks done; two faces; whether they are looked for, each arrived, and they meet; and where.
_Search = tuple[Array, Array, Array, Array, Array, Array]


class Crossings(NamedTuple):
    """Pairs of faces that may pierce each other within pixels."""

    pixel: Int[Array, "2 n"]
    planes: _Planes
    unit: Float[Array, " n"]  # of 1/w
    pairs: Int[Array, " list"]  # (one row * rows + other row) * n + number of the pixel
    total: Int[Array, ""]  # of pairs


class Line(NamedTuple):
    """Lines, one in each of n pixels."""

    pixel: Int[Array, "2 n"]
    used: Bool[Array, " n"]
    look: Int[Array, "2 n"]  # 0 to 8: pixels that show the face in front on the right and left
    face: Int[Array, "2 n"]  # these faces,
    barycentrics: list[Float[Array, "2 n"]]  # and where the line's middle lies on them,
    # and what lies half-way from there to the pixel's border; None without shadows
    half_way: list[Float[Array, "2 n"]] | None
    begin: Float[Array, "2 n"]  # ends, from the pixel's centre
    end: Float[Array, "2 n"]
    motion: Float[Array, "2 3 3 n"]  # area on the right with faces' corners' x, y, w


def choose_pixels(
    face_image: Int[Array, "height_with_border width_with_border"],
    bodies: Int[Array, " F"],
    unseen: Int[Array, " pixels"],
) -> tuple[Int[Array, " list"], Int[Array, ""]]:
    """Indices of the pixels round which two bodies are seen, in ascending order, and how many.

    Also of those that hold a face which is seen at no centre, `unseen`; -1 where there is none.
    """
    # Else all bodies would be looked up, and held, before there is anything unseen.
    first, last = bodies_round(face_image, bodies + zero_after(unseen[0]).astype(bodies.dtype))
    return selected((first + last > bodies.size + 1) | (unseen >= 0).reshape(first.shape))


def bodies_round(
    face_image: Int[Array, "height_with_border width_with_border"], bodies: Int[Array, " F"]
) -> Int[Array, "2 height width"]:
    """Which bodies are seen at each pixel's 3×3: the largest of their `ranks`, 0 where none is."""
    body = _body_of(face_image, bodies)
    seen = stored(jnp.where(body >= 0, ranks(body, bodies.size), 0))
    return stored(jnp.stack([largest_round(rank) for rank in seen]))


def ranks(body: Int[Array, "*n"], count: int) -> Int[Array, "2 *n"]:
    """Numbers of bodies counted from the first and from the last, from 1 on."""
    return jnp.stack([body + 1, count - body])


def _body_of(face: Array, bodies: Array) -> Array:
    """The bodies of faces, -1 where there is none."""
    return jnp.where(face >= 0, bodies[jnp.maximum(face, 0)], -1)


@jax.jit
def cross(
    pixel: Int[Array, "2 n"],
    exists: Bool[Array, " n"],
    surface: Surface,
    face_image: Int[Array, "height_with_border width_with_border"],
    unseen: Int[Array, " n"],
) -> Crossings:
    """Find which faces near pixels (column, row) may pierce each other there, seen or not.

    Those that reach into the pixel, and whose planes meet within it. `unseen` is one more face of
    each pixel, or -1.
    """
    planes, unit, met = _candidates(pixel, exists, surface, face_image, unseen)
    value, *slopes = planes.lambdas
    reach = _HALF * (abs(slopes[0]) + abs(slopes[1]))
    near = planes.known & jnp.all(value + reach >= 0, axis=0) & exists
    body = stored(jnp.where(near, planes.body, -1))
    value, across, down = (part[:, None] - part for part in stored(_sums(planes.lambdas)))
    meet = abs(value) <= _HALF * (abs(across) + abs(down))
    differ = (body[:, None] != body) & (body[:, None] >= 0) & (body >= 0)
    # Of small faces only the two that were found to meet.
    coarse = stored(~planes.fine)
    wanted = (coarse[:, None] & coarse).at[0, 1].set(coarse[0] & coarse[1] | met)
    once = np.tri(_FACES, k=-1, dtype=bool).T[..., None]
    return Crossings(pixel, planes, unit, *selected(once & differ & meet & wanted))


def _candidates(
    pixel: Array,
    exists: Array,
    surface: Surface,
    face_image: Array,
    unseen: Array,
) -> tuple[_Planes, Array, Array]:
    """Faces at pixels, the unit of their 1/w, and whether those in rows 0 and 1 meet."""
    faces, pixels, topology, drawn = surface
    assert topology.bodies is not None
    pictured = stored(pixels_round(face_image, *pixel))
    face = pictured[_NEAREST_FIRST]
    body = _body_of(face, topology.bodies)
    of_seen = _lambdas(pixel, face, faces, pixels)
    seen_planes = stored(_sums(of_seen[0]))
    rows = stored(jnp.stack(_two_bodies(body, seen_planes)))
    pair = jnp.stack([picked(face, row) for row in rows])
    differ = picked(body, rows[0]) != picked(body, rows[1])
    at = jnp.asarray(_NEAREST_FIRST)[rows]
    of_pair = jnp.take_along_axis(seen_planes, rows[None], axis=1, mode="promise_in_bounds")
    pair, met = _meeting(pixel, pair, of_pair, at, exists & differ, surface)
    nearby = topology.neighbors[jnp.maximum(pair, 0)].transpose(0, 2, 1).reshape(6, -1)
    others = jnp.concatenate([pair, only(nearby, drawn != 0), unseen[None]])
    of_others = _lambdas(pixel, others, faces, pixels)

    def joined(other: Array, seen: Array) -> Array:
        return jnp.concatenate([other[..., :2, :], seen, other[..., 2:, :]], axis=-2)

    look = jnp.concatenate([at, jnp.repeat(at, 3, axis=0), jnp.full_like(unseen[None], 4)])
    look = joined(look, jnp.broadcast_to(_NEAREST_FIRST[:, None], face.shape))
    body = joined(_body_of(others, topology.bodies), body)
    face, lambdas, volume, size = map(joined, (others, *of_others), (face, *of_seen))
    again = jnp.any(
        face[:, None] == jnp.where(jnp.tri(_FACES, k=-1)[..., None] > 0, face, -1), axis=1
    )
    known = (face >= 0) & (volume != 0) & jnp.isfinite(volume) & ~again
    total = _added(lambdas[0])
    largest = jnp.max(jnp.where(known, abs(total), 0), axis=0)
    unit = stored(1 / jnp.where(largest > 0, largest, 1))
    # A triangle that stands alone is all there is of its surface.
    joined_to = stored(topology.neighbors[jnp.maximum(face, 0)])
    in_mesh = (joined_to[..., 0] >= 0) | (joined_to[..., 1] >= 0) | (joined_to[..., 2] >= 0)
    face, lambdas, fine = stored_together((face, lambdas * unit, in_mesh & (size < _FINE)))
    return _Planes(face, body, look, lambdas, known, fine), unit, met


def _two_bodies(body: Array, planes: Array) -> tuple[Array, Array]:
    """Rows of the first body that is there, and of the other whose plane meets its plane nearest.

    Args:
        body: (rows, n), -1 where there is none.
        planes: (3, rows, n), 1/w at the pixel's centre and its slopes.
    """
    last = body.shape[0] - 1
    one = jnp.minimum(first_row(body >= 0), last)
    value, across, down = (part - picked(part, one) for part in planes)
    differs = (body >= 0) & (body != picked(body, one))
    steepness = jnp.hypot(across, down)
    distance = abs(value) / jnp.where(steepness > 0, steepness, 1)
    never = jnp.finfo(distance.dtype).max
    distance = jnp.where((steepness > 0) & (distance < never), distance, never)
    return one, jnp.minimum(least_row(differs, distance), last)


def _meeting(
    pixel: Array,
    pair: Array,
    planes: Array,
    look: Array,
    exists: Array,
    surface: Surface,
) -> tuple[Array, Array]:
    """Two faces where the surfaces of two others meet next to the pixel's centre; if they do.

    `planes` (3, 2, n) are those of `pair`, as in `_two_bodies`, and `look` is where it is seen.
    """
    faces, pixels, topology, _ = surface
    centre = (pixel.astype(pixels.dtype) + 0.5)[:, None]
    from_centre = steps_to(look)

    def meet(planes: Array) -> Array:
        return stored(_line(planes[:, 0] - planes[:, 1])[0])

    def step(state: _Search) -> _Search:
        n, pair, searched, arrived, met, point = state
        point = jnp.clip(point, -0.5, 0.5)
        # Half-way where it is too far: the surface may turn away before.
        to = jnp.where(
            arrived, point[:, None], (point[:, None] + from_centre.astype(point.dtype)) / 2
        )
        x, y = stored(centre + to)
        ways = jnp.where(searched, pair, -1)
        reached, there = walk(ways, x, y, surface)
        now = there & (reached >= 0)
        reached = stored(jnp.where(now, reached, pair))
        following = meet(_sums(_lambdas(pixel, reached, faces, pixels)[0]))
        x, y = following - point
        close = x * x + y * y < _CLOSE**2
        met = met | (searched & jnp.all(arrived & now, axis=0) & close)
        # Else the next walks would be these again.
        changes = jnp.any((reached != pair) | (now != arrived), axis=0)
        searched = searched & ~met & changes
        return n + 1, *stored_together((reached, searched, now, met, following))

    def is_left(state: _Search) -> Array:
        return anywhere((state[0] < _WALKS) & jnp.any(state[2]))

    point = meet(planes)
    goes_on = jnp.any(topology.neighbors[jnp.maximum(pair, 0)] >= 0, axis=(0, 2))
    searched = exists & goes_on & (jnp.max(abs(point), axis=0) < _NEAR)
    start = pixel[0, 0] & 0, pair, searched, pair >= -1, pair[0] < -1, point
    _, pair, _, _, met, _ = lax.while_loop(is_left, step, start)
    return pair, met


def _lambdas(pixel: Array, face: Array, faces: Array, pixels: Table) -> tuple[Array, Array, Array]:
    """λ of faces at the pixel's centre and its slopes, (3, 3 corners, ...); the volume; areas."""
    x, y, w = corners = corners_of(face, faces, pixels)
    centre = pixel.astype(w.dtype) + 0.5
    u, v = stored_together((x - centre[0] * w, y - centre[1] * w))
    turns = [(1, 2), (2, 0), (0, 1)]
    values = [u[i] * v[j] - u[j] * v[i] for i, j in turns]
    volume = values[0] * w[0] + values[1] * w[1] + values[2] * w[2]
    inverse = stored(1 / jnp.where(volume == 0, 1, volume))
    at_centre = jnp.stack(values)
    across = jnp.stack([w[j] * v[i] - w[i] * v[j] for i, j in turns])
    down = jnp.stack([u[j] * w[i] - u[i] * w[j] for i, j in turns])
    return jnp.stack([at_centre, across, down]) * inverse, volume, area(corners)


def _added(corners: Array) -> Array:
    """The sum over three corners. XLA makes a slow pass of its own of a reduction."""
    return corners[0] + corners[1] + corners[2]


def _sums(lambdas: Array) -> Array:
    """1/w and its slopes, (3, ...), of λ and its slopes."""
    return _added(lambdas.swapaxes(0, 1))


def _line(difference: Array) -> tuple[Array, Array, Array]:
    """Where planes meet whose 1/w differ by this at the centre, and with x and y: shape (3, ...).

    The line's point next to the centre, its unit normal towards where the first plane is in front,
    and by how much it moves where the difference changes by one; infinite where there is no line.
    """
    value, across, down = difference
    steepness = jnp.hypot(across, down)
    exists = steepness > 0
    inverse = 1 / jnp.where(exists, steepness, 1)
    normal = jnp.stack([across * inverse, down * inverse])
    return -value * inverse * normal, normal, jnp.where(exists, inverse, jnp.inf)


def _left_of(normal: Array) -> Array:
    """The direction which has a normal on its right."""
    return jnp.stack([-normal[1], normal[0]])


@partial(jax.jit, static_argnames="shadowed")
def lines_of(
    crossings: Crossings,
    pair: Int[Array, " n"],
    exists: Bool[Array, " n"],
    patches: Int[Array, " F"],
    *,
    shadowed: bool,
) -> Line:
    """The lines along which these pairs of faces pierce each other, where they are visible.

    `shadowed` is whether lights cast shadows.
    """
    both_faces, place = divided(pair, crossings.unit.size)
    one, other = divided(both_faces, _FACES)
    pixel, planes = stored_together(
        jax.tree.map(lambda part: part[..., place], (crossings.pixel, crossings.planes))
    )

    def both(values: Array) -> Array:
        return stored(jnp.stack([picked(values, one), picked(values, other)]))

    # Small faces stand for their surfaces, also beside them.
    whole, bodies = both(planes.fine), both(planes.body)
    which = jnp.stack([one, other])[None, None]
    at = jnp.take_along_axis(planes.lambdas, which, axis=2, mode="promise_in_bounds")
    at = stored(at)  # (3, 3 corners, 2 faces, n)
    sums = _sums(at)  # 1/w and its slopes, of both faces
    point, normal, inverse = stored(_line(sums[:, 0] - sums[:, 1]))
    point = _kept_aside(point, normal, whole, bodies, planes.body[_CENTRE])
    along = _left_of(normal)

    def inside(x: Array, y: Array) -> Array:
        square = jnp.stack(room_in_pixel(x, y))
        on_faces = jnp.where(whole, 1, at[0] + x * at[1] + y * at[2])
        return stored(jnp.concatenate([square, on_faces.reshape(6, *x.shape)]))

    low, high = positive_part(*(list(inside(*(point + r * along))) for r in (-_REACH, _REACH)))
    first, last = stored_together((_REACH * (2 * low - 1), _REACH * (2 * high - 1)))
    begin, end = point + first * along, point + last * along
    x, y = stored((begin + end) / 2)
    values = at[0] + x * at[1] + y * at[2]  # (3 corners, 2 faces, n)
    depth = _added(values)

    # Both reach to both sides.
    aside = _THROUGH * (at[1] * normal[0] + at[2] * normal[1])
    through = jnp.min(jnp.where(whole, 1, values - abs(aside)), axis=(0, 1)) > 0
    # Faces that lie on one another differ by rounding, and have no line.
    largest = jnp.max(abs(at), axis=(0, 1))
    rounding = _ROUNDINGS * jnp.finfo(largest.dtype).eps * (largest[0] + largest[1])
    used = exists & (inverse * rounding < 1) & (low < high) & through
    own = jnp.any(whole[:, None] & (planes.body == bodies[:, None]), axis=0)
    used = used & ~_hidden(planes, ~own, x, y, depth[0])

    # Seen a little aside, where each is in front: on the line itself either may shade the other.
    to_front = jnp.array([[1], [-1]], aside.dtype)
    in_front = values + aside * to_front
    in_front = jnp.where(whole, jnp.maximum(in_front, 0), in_front)
    half_way = None
    if shadowed:
        middle = stored(jnp.stack([x, y]))
        half = jnp.stack([reach(middle, normal), reach(middle, -normal)]) / 2
        half_way = _shares(jnp.maximum(values + aside * to_front * (half / _THROUGH), 0))

    centre = pixel.astype(depth.dtype) + 0.5
    plane = jnp.stack(
        [sums[1], sums[2], depth - (x + centre[0]) * sums[1] - (y + centre[1]) * sums[2]]
    )
    # λ is in units of 1/w, and so are the planes and the slope that divides them.
    factor = (last - first) * inverse / crossings.unit[place] * jnp.array([[-1], [1]], depth.dtype)
    motion = values[:, None] * (factor * plane)[None]
    face = both(planes.face)
    return Line(
        pixel=pixel,
        used=used,
        look=_where_shown(planes.face, face, both(planes.look), patches, x, y),
        face=face,
        barycentrics=_shares(in_front),
        half_way=half_way,
        begin=begin,
        end=end,
        motion=jnp.where(used, motion.transpose(2, 0, 1, 3), 0),
    )


def _shares(values: Array) -> list[Array]:
    """Of three values in their sum."""
    total = _added(values)
    return [value / jnp.where(total > 0, total, 1) for value in values]


def _where_shown(
    seen: Array, face: Array, look: Array, patches: Array, x: Array, y: Array
) -> Array:
    """Which of the 3×3 pixels shows the surface of a face nearest to a point; `look` if none does.

    The pixel itself if it does: it is its colour that the other one takes the place of.
    """
    seen = seen[_CENTRE : _CENTRE + 9]
    patch = stored(jnp.where(seen >= 0, patches[jnp.maximum(seen, 0)], -1))
    across, down = steps_to(jnp.asarray(_NEAREST_FIRST))[..., None].astype(x.dtype)
    distance = ((x - across) ** 2 + (y - down) ** 2).at[0].set(-1)
    best = least_row(patch[:, None] == patches[face], distance[:, None])
    return jnp.where(best < 9, jnp.asarray(_NEAREST_FIRST)[jnp.minimum(best, 8)], look)


def _kept_aside(
    point: Array, normal: Array, whole: Array, bodies: Array, at_centre: Array
) -> Array:
    """A line's point, moved past the pixel's centre if that shows the body on its other side.

    Of small faces, whose planes are not quite their surfaces; and of all as near as rounding.
    """
    to_front = -(point[0] * normal[0] + point[1] * normal[1])  # of the first face, as at the centre
    shown = jnp.where(at_centre == bodies[0], 1, jnp.where(at_centre == bodies[1], -1, 0))
    close = jnp.abs(to_front) < ASIDE
    moves = (shown != 0) & (close | (jnp.any(whole, axis=0) & (shown * to_front < 0)))
    return stored(jnp.where(moves, -shown * (ASIDE * normal), point))


def _hidden(planes: _Planes, others: Array, x: Array, y: Array, depth: Array) -> Array:
    """Whether one of these faces is before the point (x, y), whose 1/w is `depth`."""
    values = planes.lambdas[0] + x * planes.lambdas[1] + y * planes.lambdas[2]
    covers = jnp.all(values >= 0, axis=0) & planes.known & others
    return jnp.any(covers & (_added(values) > depth * (1 + TOLERANCE)), axis=0)
