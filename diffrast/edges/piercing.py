"""Lines along which surfaces pierce each other.

The 1/w of a plane is linear on the screen, and so is the difference of that of two faces: where it
is zero they meet, along a straight line, with the one in front on this side and the other on that.
The line is cut to one pixel and to both faces, and then parts areas as an edge of a mesh does. Only
faces of different bodies are looked at: those seen at the 3×3 pixels round a pixel, those next to
one of each of two bodies, and one of which an edge is visible in the pixel, but nothing at any of
these centres. A surface that pierces itself is not found.

With homogeneous corners V, a point p of the screen (x, y, 1) is the sum of λ V, the λ linear in p
and positive on the face, and 1/w is their sum. For the plane c, c · p = 1/w, and c · V = 1 at each
corner; so where a corner moves by dV, 1/w changes at a fixed point by −λ c · dV.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._selection import selected
from diffrast._stored import stored
from diffrast._topology import Topology
from diffrast.edges.neighborhood import first_row, only, picked, pixels_round
from diffrast.edges.pieces import positive_part
from diffrast.edges.planes import TOLERANCE, Table, corners_of

PIXELS_AT_ONCE = 512
LINES_AT_ONCE = 128
_REACH = 0.75  # pixels from the centre: farther than the corners
_THROUGH = 0.01  # pixels to both sides of the line that both faces reach
_ROUNDINGS = 64  # in the slope of 1/w
_FACES = 9 + 2 * 3 + 1


class _Planes(NamedTuple):
    """Faces that may be seen at each pixel, shape (16, n); from the pixel's centre."""

    face: Array
    look: Array  # 0 to 8: pixel of the 3×3 whose colour changes as this face's
    lambdas: Array  # (3, 3 corners, 16, n): at the centre in units of the largest sum, slopes
    known: Array  # neither edge-on nor there already


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
    barycentrics: list[Float[Array, "2 n"]]  # and where the line's middle lies on them
    begin: Float[Array, "2 n"]  # ends, from the pixel's centre
    end: Float[Array, "2 n"]
    motion: Float[Array, "2 3 3 n"]  # area on the right with faces' corners' x, y, w


def choose_pixels(
    face_image: Int[Array, "height_with_border width_with_border"],
    bodies: Int[Array, " F"],
    unseen: Int[Array, " pixels"],
) -> tuple[Int[Array, " list"], Int[Array, ""]]:
    """Indices of the pixels round which two bodies are seen, in ascending order, and how many.

    Also of those that show a face, `unseen`, only beside their centres; -1 where there is none.
    """
    body = jnp.where(face_image >= 0, bodies[jnp.maximum(face_image, 0)], -1)
    largest, least = body, jnp.where(body >= 0, body, jnp.iinfo(body.dtype).max)
    largest = jnp.maximum(jnp.maximum(largest[:-2], largest[1:-1]), largest[2:])
    largest = jnp.maximum(jnp.maximum(largest[:, :-2], largest[:, 1:-1]), largest[:, 2:])
    least = jnp.minimum(jnp.minimum(least[:-2], least[1:-1]), least[2:])
    least = jnp.minimum(jnp.minimum(least[:, :-2], least[:, 1:-1]), least[:, 2:])
    return selected((largest > least).reshape(-1) | (unseen >= 0))


def _two_bodies(body: Array) -> tuple[Array, Array]:
    """Rows of the first one that is there, and of the first other."""
    last = body.shape[0] - 1
    one = jnp.minimum(first_row(body >= 0), last)
    differs = (body >= 0) & (body != picked(body, one))
    return one, jnp.minimum(first_row(differs), last)


@jax.jit
def cross(
    pixel: Int[Array, "2 n"],
    exists: Bool[Array, " n"],
    faces: Int[Array, "F 3"],
    pixels: Table,
    topology: Topology,
    volume: Float[Array, " F"],
    face_image: Int[Array, "height_with_border width_with_border"],
    unseen: Int[Array, " n"],
) -> Crossings:
    """Find which faces near pixels (column, row) may pierce each other there, seen or not.

    Those that reach into the pixel, and whose planes meet within it. `unseen` is one more face of
    each pixel, or -1.
    """
    assert topology.bodies is not None
    face, look, body = _candidates(
        pixel, topology.bodies, topology.neighbors, volume, face_image, unseen
    )
    planes, unit = _planes(pixel, face, look, faces, pixels)
    value, *slopes = planes.lambdas
    reach = 0.5 * (abs(slopes[0]) + abs(slopes[1]))
    near = planes.known & jnp.all(value + reach >= 0, axis=0) & exists
    body = stored(jnp.where(near, body, -1))
    value, across, down = (part[:, None] - part for part in stored(jnp.sum(planes.lambdas, axis=1)))
    meet = abs(value) <= 0.5 * (abs(across) + abs(down))
    differ = (body[:, None] != body) & (body[:, None] >= 0) & (body >= 0)
    once = np.tri(_FACES, k=-1, dtype=bool).T[..., None]
    return Crossings(pixel, planes, unit, *selected((once & differ & meet).reshape(-1)))


def _candidates(
    pixel: Array,
    bodies: Array,
    neighbors: Array,
    volume: Array,
    face_image: Array,
    unseen: Array,
) -> tuple[Array, Array, Array]:
    """Faces, the pixels of the 3×3 where they or faces next to them are seen, and their bodies."""
    pictured = stored(pixels_round(face_image, *pixel))
    nearest_first = np.array([4, 1, 3, 5, 7, 0, 2, 6, 8])
    face = pictured[nearest_first]
    body = jnp.where(face >= 0, bodies[jnp.maximum(face, 0)], -1)
    one, other = _two_bodies(body)
    seen = jnp.stack([one, other])
    look = jnp.concatenate(
        [
            jnp.broadcast_to(nearest_first[:, None], face.shape),
            jnp.repeat(jnp.asarray(nearest_first)[seen], 3, axis=0),
            jnp.full_like(face[:1], 4),
        ]
    )
    parents = jnp.stack([picked(face, one), picked(face, other)])
    nearby = neighbors[jnp.maximum(parents, 0)].transpose(0, 2, 1).reshape(6, -1)
    face = stored(jnp.concatenate([face, only(nearby, volume != 0), unseen[None]]))
    return face, look, bodies[jnp.maximum(face, 0)]


def _planes(
    pixel: Array, face: Array, look: Array, faces: Array, pixels: Table
) -> tuple[_Planes, Array]:
    x, y, w = corners_of(face, faces, pixels)
    centre = pixel + 0.5
    u, v = stored((x - centre[0] * w, y - centre[1] * w))
    turns = [(1, 2), (2, 0), (0, 1)]
    values = [u[i] * v[j] - u[j] * v[i] for i, j in turns]
    volume = values[0] * w[0] + values[1] * w[1] + values[2] * w[2]
    inverse = stored(1 / jnp.where(volume == 0, 1, volume))
    again = jnp.any(
        face[:, None] == jnp.where(jnp.tri(_FACES, k=-1)[..., None] > 0, face, -1), axis=1
    )
    known = (face >= 0) & (volume != 0) & jnp.isfinite(volume) & ~again
    total = (values[0] + values[1] + values[2]) * inverse
    largest = jnp.max(jnp.where(known, abs(total), 0), axis=0)
    unit = stored(1 / jnp.where(largest > 0, largest, 1))
    scale = inverse * unit
    at_centre = jnp.stack(values) * scale
    across = jnp.stack([w[j] * v[i] - w[i] * v[j] for i, j in turns]) * scale
    down = jnp.stack([u[j] * w[i] - u[i] * w[j] for i, j in turns]) * scale
    lambdas = stored(jnp.stack([at_centre, across, down]))
    return _Planes(face=face, look=look, lambdas=lambdas, known=known), unit


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


@jax.jit
def lines_of(crossings: Crossings, pair: Int[Array, " n"], exists: Bool[Array, " n"]) -> Line:
    """The lines along which these pairs of faces pierce each other, where they are visible."""
    at_once = crossings.unit.size
    one, other, place = pair // at_once // _FACES, pair // at_once % _FACES, pair % at_once
    pixel, planes = stored(
        jax.tree.map(lambda part: part[..., place], (crossings.pixel, crossings.planes))
    )

    def both(values: Array) -> Array:
        return stored(jnp.stack([picked(values, one), picked(values, other)]))

    which = jnp.stack([one, other])[None, None]
    at = jnp.take_along_axis(planes.lambdas, which, axis=2, mode="promise_in_bounds")
    at = stored(at)  # (3, 3 corners, 2 faces, n)
    sums = jnp.sum(at, axis=1)  # 1/w and its slopes, of both faces
    point, normal, inverse = stored(_line(sums[:, 0] - sums[:, 1]))
    along = _left_of(normal)

    def inside(x: Array, y: Array) -> Array:
        square = jnp.stack([0.5 - x, 0.5 + x, 0.5 - y, 0.5 + y])
        on_faces = at[0] + x * at[1] + y * at[2]
        return stored(jnp.concatenate([square, on_faces.reshape(6, *x.shape)]))

    low, high = positive_part(*(list(inside(*(point + r * along))) for r in (-_REACH, _REACH)))
    first, last = stored((_REACH * (2 * low - 1), _REACH * (2 * high - 1)))
    begin, end = point + first * along, point + last * along
    x, y = stored((begin + end) / 2)
    values = at[0] + x * at[1] + y * at[2]  # (3 corners, 2 faces, n)
    depth = jnp.sum(values, axis=0)

    # Both reach to both sides.
    aside = _THROUGH * (at[1] * normal[0] + at[2] * normal[1])
    through = jnp.min(values - abs(aside), axis=(0, 1)) > 0
    # Faces that lie on one another differ by rounding, and have no line.
    largest = jnp.max(abs(at), axis=(0, 1))
    rounding = _ROUNDINGS * jnp.finfo(largest.dtype).eps * (largest[0] + largest[1])
    used = exists & (inverse * rounding < 1) & (low < high) & through
    used = used & ~_hidden(planes, x, y, depth[0])

    # Seen a little aside, where each is in front: on the line itself either may shade the other.
    in_front = values + aside * jnp.array([[1], [-1]])
    total = jnp.sum(in_front, axis=0)

    centre = pixel + 0.5
    plane = jnp.stack(
        [sums[1], sums[2], depth - (x + centre[0]) * sums[1] - (y + centre[1]) * sums[2]]
    )
    # λ is in units of 1/w, and so are the planes and the slope that divides them.
    factor = (last - first) * inverse / crossings.unit[place] * jnp.array([[-1], [1]])
    motion = values[:, None] * (factor * plane)[None]
    return Line(
        pixel=pixel,
        used=used,
        look=both(planes.look),
        face=both(planes.face),
        barycentrics=[value / jnp.where(total > 0, total, 1) for value in in_front],
        begin=begin,
        end=end,
        motion=jnp.where(used, motion.transpose(2, 0, 1, 3), 0),
    )


def _hidden(planes: _Planes, x: Array, y: Array, depth: Array) -> Array:
    """Whether one of the faces is before the point (x, y), whose 1/w is `depth`."""
    values = planes.lambdas[0] + x * planes.lambdas[1] + y * planes.lambdas[2]
    covers = jnp.all(values >= 0, axis=0) & planes.known
    return jnp.any(covers & (jnp.sum(values, axis=0) > depth * (1 + TOLERANCE)), axis=0)
