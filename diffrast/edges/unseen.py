"""What no pixel's centre shows: pieces of edges that are covered, and faces beside the centres."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int, UInt32

from diffrast._stored import stored, stored_together
from diffrast.edges.neighborhood import Surface, pixels_round
from diffrast.edges.pieces import Pieces, Segments
from diffrast.edges.planes import FINE_TOLERANCE, beside_edge, corners_of, covers, edge_values


class Unseen(NamedTuple):
    """Faces that have an edge in a pixel, but are seen at no centre of the 3×3 round it; or -1.

    Of such as turn away from the eye only where there are no others.
    """

    farthest: Int[Array, "height width"]
    # Of other bodies than those seen there; or the nearest of those found next to the pixel.
    nearest: Int[Array, "height width"] | None = None


class Survey(NamedTuple):
    """What a first pass over all edges finds."""

    runs: UInt32[Array, " edges"]  # bits of the runs of pieces that may be seen
    unseen: Unseen


@jax.jit
def uncovered(
    pieces: Pieces,
    segments: Segments,
    surface: Surface,
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
    inside, _, _ = beside_edge(face_image.shape, length.dtype)
    aside = along * (inside / jnp.where(length > 0, length, 1))
    sides = jnp.stack([-aside, aside])
    x = ends[0, 0] + pieces.range * along[0] + sides[:, None, 1]  # (2 sides, 2 ends, n)
    y = ends[0, 1] + pieces.range * along[1] - sides[:, None, 0]
    x, y = stored_together((x, y))
    corners = corners_of(face, surface.faces, surface.pixels)[:, :, None, None]
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
    volume: Float[Array, " F"],
    face_image: Int[Array, "height_with_border width_with_border"],
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Faces of pieces' edges that none of the 3×3 pixels shows, or -1; and 1/w of the pieces.

    Not one that turns away beside one that shows its front: of a closed body it cannot be seen.
    """
    own, weights = stored_together(
        (segments.faces[:, pieces.segment], segments.weights[:, pieces.segment])
    )
    pictured = pixels_round(face_image, *pieces.pixel)
    drawn = own >= 0
    away = drawn & (volume[jnp.maximum(own, 0)] >= 0)
    closed_in = away & (drawn & ~away)[::-1]
    shown = jnp.any(pictured[:, None] == own, axis=0)
    first, second = jnp.where(drawn & ~closed_in & ~shown & pieces.exists, own, -1)
    face = jnp.maximum(first, second)
    middle = (pieces.range[0] + pieces.range[1]) / 2
    return face, weights[0] + middle * (weights[1] - weights[0])
