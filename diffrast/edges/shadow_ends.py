"""Where the lines of shadows begin and end, and on which side of pixels' centres they pass.

A line goes on over the faces of a surface, up to where the edge that casts it meets another one, or
goes into what the shadow falls on.
"""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float

from diffrast._stored import stored
from diffrast.edges.pieces import positive_part
from diffrast.edges.planes import ASIDE, TOLERANCE, dot_rows, edge_values, largest
from diffrast.edges.shadow_planes import Plane

ROUNDED = 0.02  # pixels: more than lines, and what is lit, move by rounding
ONE_LINE = 1e-3  # pixels: how far lines that are one may be apart
REACH = 0.75  # pixels from the centre: farther than the corners
_TOUCHES = 1e-4  # of its size: how far from the plane of a face an edge may end that stands on it
_STEEP = 1e-3  # of its size: how far an edge at least goes into the plane of a face
_BLUNT = 0.05  # cosine: of sharper corners the sides are moved less far than that takes
_FLAT = 0.1  # pixels: how far lines on faces that count as one plane may be apart
_GAP = 1e-3  # of a line: how far faces that cover it may be apart


def enter(
    ground: Plane, source: Float[Array, "3 n"], weight: Float[Array, " n"], ends: list[Array]
) -> tuple[Bool[Array, "edges faces n"], Bool[Array, "edges faces n"]]:
    """Whether edges go into the planes of faces, or end there: no shadow falls beyond.

    Not those that lie in them. And whether they rise out of them towards the light.
    """
    first, last = (dot_rows(ground.normal, end[:, :, None]) + ground.offset for end in ends)
    to_light = dot_rows(ground.normal, source[:, None, None]) + ground.offset * weight
    size = largest(ends[1] - ends[0])[:, None]
    low, high = jnp.minimum(first, last), jnp.maximum(first, last)
    low, high = jnp.where(to_light < 0, -high, low), jnp.where(to_light < 0, -low, high)
    goes_in = (low < _TOUCHES * size) & (high - low > _STEEP * size)
    return stored((goes_in, high > _TOUCHES * size))


def common(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    """What parts of lines have in common, from begin to end."""
    return jnp.maximum(one[0], other[0]), jnp.minimum(one[1], other[1])


def continued(
    own: tuple[Array, Array],
    room: tuple[Array, Array],
    usable: Bool[Array, "edges faces n"],
    foot: Float[Array, "2 edges faces n"],
    along: Float[Array, "2 edges faces n"],
) -> tuple[Array, Array]:
    """Begins and ends of lines on faces, 0 to 1, where other faces are not known.

    What is not on its `own` face goes on in that face's plane, as far as there is `room`, before
    the first one of the faces and behind each up to the next. Along an edge between two it is on
    one of them.
    """
    low, high = own
    here = usable & (low < high)
    axis = along[:, :, :1]
    step, at = dot_rows(along, axis), dot_rows(foot, axis)
    begin, end = (at + (2 * part - 1) * step for part in own)
    middle = jnp.where(here, begin + end, jnp.inf)
    faces = usable.shape[1]
    order = jnp.arange(faces)[:, None, None]
    one, other = middle[:, :, None], middle[:, None]
    later = here[:, None] & (
        (other > one) | ((other == one) & (jnp.arange(faces)[:, None] > order))
    )
    aside = _cross(axis, foot) / REACH
    beside = jnp.abs(aside[:, :, None] - aside[:, None]) < ONE_LINE
    again = jnp.any(
        here[:, :, None] & later & beside & (2 * begin[:, None] < middle[:, :, None]), axis=1
    )
    here, later = here & ~again, later & ~again[:, None]
    low, high = jnp.where(again, 1, low), jnp.where(again, 0, high)
    following = jnp.min(jnp.where(later, begin[:, None], jnp.inf), axis=2)
    first = here & (jnp.sum(later, axis=2) == jnp.sum(here, axis=1, keepdims=True) - 1)
    alike = step > 0.5 * dot_rows(axis, axis)  # in direction
    up_to = ((following - at) / jnp.where(alike, step, 1) + 1) / 2
    longer = jnp.maximum(high, jnp.minimum(room[1], up_to))
    # Where it is on none, but all of these are one plane, or nearly: in the first.
    apart = [
        _cross(along, foot[:, :, :1] + sign * along[:, :, :1] - foot) / REACH for sign in (1, -1)
    ]
    flat = jnp.all(~usable | (jnp.maximum(*map(jnp.abs, apart)) < _FLAT), axis=1, keepdims=True)
    alone = flat & ~jnp.any(here, axis=1, keepdims=True) & (jnp.arange(faces)[:, None] == 0)
    low = jnp.where((first & alike) | alone, room[0], low)
    high = jnp.where(here & alike, longer, jnp.where(alone, room[1], high))
    return stored((low, high))


def past_centre(
    outwards: Float[Array, "2 edges faces n"],
    beyond: Float[Array, "edges faces n"],
    passed: Bool[Array, "edges faces n"],
    is_lit: Bool[Array, " n"],
) -> Float[Array, "2 n"]:
    """How far lines that pass a pixel's centre are moved, to have it on the side that it shows.

    Rounding decides else where lines through a centre have it. All of a pixel are moved alike, so
    that corners stay whole; `outwards`, from dark to lit, and how far out they lie as there.
    """
    side = jnp.where(is_lit, -1, 1)
    way = jnp.sum(jnp.where(passed, outwards, 0), axis=(1, 2))
    size = jnp.hypot(*way)
    way = way / jnp.where(size > 0, size, 1)
    gained = jnp.maximum(dot_rows(outwards, way[:, None, None]), _BLUNT)
    lacking = jnp.where(passed, (ASIDE - side * beyond) / gained, 0)
    return stored(side * jnp.clip(jnp.max(lacking, axis=(0, 1)), 0, 2 * ROUNDED) * way)


def uncovered(
    begin: Float[Array, "3 n"],
    end: Float[Array, "3 n"],
    corners: Float[Array, "3 3 faces n"],
    hides: Bool[Array, "faces n"],
) -> tuple[Array, Array]:
    """What parts of lines, from 0 to 1, faces nearer to the eye leave that cover their ends.

    Args:
        begin: x and y from the pixel's centre, and 1/w.
        end: likewise.
        corners: of the faces.
        hides: which of them count.
    """
    zero = jnp.zeros_like(begin[0])

    def inside(point: Array) -> list[Array]:
        x, y, nearness = point
        values, depth = edge_values(corners, x[None], y[None], near=(zero, zero))
        return [*values, stored(depth - nearness * (1 + TOLERANCE))]

    first, last = positive_part(inside(begin), inside(end))
    hides = hides & (first < last)
    low, high = zero, zero + 1
    for _ in range(2):  # where one face ends another one may go on
        low = jnp.maximum(low, jnp.max(jnp.where(hides & (first <= low + _GAP), last, 0), axis=0))
        high = jnp.minimum(
            high, jnp.min(jnp.where(hides & (last >= high - _GAP), first, 1), axis=0)
        )
    return stored((low, high))


def same_place(end: Array, others: list[Array]) -> Array:
    """Which ends (3, edges, n) are where others are, shape (edges, edges, n); not their own."""
    same = [jnp.all(end[:, :, None] == other[:, None], axis=0) for other in others]
    return (same[0] | same[1]) & ~jnp.eye(end.shape[1], dtype=bool)[..., None]


def _cross(a: Array, b: Array) -> Array:
    return a[0] * b[1] - a[1] * b[0]
