"""The area of a pixel beyond a piece of an edge, and how it changes with the edge's vertices.

With q the position of a direction along the unit square's perimeter, 0 to 4, a piece from y0 to y1,
relative to its pixel's centre, parts off the area

    S = wrap(q(y1) - q(y0)) / 4 - (y0 × y1) / 2

beyond it as the centre sees it, which adds up exactly over the pieces of any outline. To first
order dS is minus the piece's normal times the motion of its middle: linear in the positions,
without a singularity.
"""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._stored import stored
from diffrast.edges.neighborhood import picked
from diffrast.edges.pieces import Pieces, Segments, to_pixels
from diffrast.edges.visibility import Seen


def _perimeter(x: Array, y: Array) -> Array:
    """Where the ray through (x, y) leaves the unit square, 0 to 4 along its perimeter."""
    across, along = jnp.abs(x), jnp.abs(y)
    largest = jnp.maximum(across, along)
    inverse = 0.5 / jnp.where(largest > 0, largest, 1)
    return jnp.where(
        across >= along,
        jnp.where(x >= 0, 0, 2) + jnp.where(x >= 0, y, -y) * inverse,
        jnp.where(y > 0, 1, 3) + jnp.where(y > 0, -x, x) * inverse,
    )


def area_beyond(begin: Array, end: Array) -> Array:
    """Part of the pixel beyond a piece, positive if that is on the right."""
    turn = _perimeter(*end) - _perimeter(*begin)
    turn = turn - 4 * jnp.round(turn / 4)
    return turn / 4 - (begin[0] * end[1] - begin[1] * end[0]) / 2


def motion_of_edge(segments: Segments, pieces: Pieces, seen: Seen) -> Array:
    """Derivative of the area by x, y, w of the edge's start and of its end, shape (6, n)."""
    of = pieces.segment
    across, down = seen.begin[1] - seen.end[1], seen.end[0] - seen.begin[0]
    shares = jnp.stack([1 - seen.middle, seen.middle]) * segments.weights[:, of]
    inside = segments.range[:, of]
    vertex = shares * jnp.stack([1 - inside, inside])  # (start and end, clipped ends, n)
    x, y = segments.ends[:, 0, of], segments.ends[:, 1, of]
    total = jnp.sum(vertex, axis=1)
    moment = jnp.sum(vertex * (across * x + down * y), axis=1)
    return jnp.stack([total * across, total * down, -moment], axis=1).reshape(6, -1)


def motion_of_inner_edge(
    positions_clip: Float[Array, "V 4"],
    size: tuple[int, int],
    segments: Segments,
    pieces: Pieces,
    seen: Seen,
) -> tuple[Int[Array, "2 n"], Float[Array, "6 n"], Bool[Array, " n"]]:
    """How the inner edge of the face at a rim moves: the area between here and there.

    Returns:
        The two vertices of this edge, the derivative of the area by their x, y, w, and whether the
        whole face is before the eye; else there is none.
    """
    vertices = stored(jnp.stack([*segments.vertices[:, pieces.segment], seen.rim.apex]))
    table = to_pixels(positions_clip[vertices.reshape(-1)], *size)
    x, y, w = stored(table).reshape(3, 3, -1)
    inverse_w = 1 / jnp.where(w > 0, w, 1)
    centre = pieces.pixel.astype(w.dtype) + 0.5
    middle = centre + (seen.begin + seen.end) / 2
    right, down = x * inverse_w - middle[0], y * inverse_w - middle[1]
    across = seen.end - seen.begin
    length = jnp.hypot(*across)
    along = across / jnp.where(length > 0, length, 1)
    inward = jnp.where(seen.front_on_right, 1, -1) * jnp.stack([along[1], -along[0]])
    ahead = along[0] * right + along[1] * down
    depth = inward[0] * right + inward[1] * down
    # It leads to the apex from the end of the rim that is on the other side of the middle.
    end = jnp.where(ahead[2] < 0, 1, 0)
    span = ahead[2] - picked(ahead, end)
    inverse_span = jnp.where(span != 0, 1, 0) / jnp.where(span != 0, span, 1)
    share = jnp.clip(-picked(ahead, end) * inverse_span, 0, 1)
    steep = jnp.clip((depth[2] - picked(depth, end)) * inverse_span, -1, 1)
    way = length * (inward - steep * along)
    rows = []
    for part, vertex in ((1 - share, end), (share, jnp.full_like(end, 2))):
        weight = part * picked(inverse_w, vertex)
        place = middle[0] + picked(right, vertex), middle[1] + picked(down, vertex)
        rows += [*(weight * way), -weight * (way[0] * place[0] + way[1] * place[1])]
    return jnp.stack([picked(vertices, end), vertices[2]]), jnp.stack(rows), jnp.all(w > 0, axis=0)
