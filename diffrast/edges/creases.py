"""Which creases are none: where another surface begins, it may hide one of the sides.

Boxes that stand in a row have a side each where they touch. The eye may look at one of the two, but
the top of the next box begins at this very edge, and hides it.
"""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._stored import stored_together
from diffrast.edges.neighborhood import Surface, first_row, over_few, picked, walk
from diffrast.edges.planes import TOLERANCE, corners_of, covers, edge_values

_ASIDE = 0.02  # pixels from a crease to the points that show what hides its sides
_RISES = 1e-4  # of 1/w a pixel: what hides a side recedes less, by so much at least
_AT_ONCE = 256


def buried(
    crease: Bool[Array, " n"],
    point: Float[Array, "2 n"],
    out: Float[Array, "2 n"],
    near: Float[Array, " n"],
    own: Int[Array, "2 n"],
    around: Int[Array, "candidates n"],
    surface: Surface,
) -> Bool[Array, " n"]:
    """Whether a surface that begins at a crease, and is seen around it, hides one of its sides.

    Args:
        crease: what to look at; False elsewhere.
        point: of the crease on the screen.
        out: unit vectors from its first face to the second.
        near: 1/w at the point.
        own: the two faces.
        around: faces seen near it; -1 where there is nothing.
        surface: all faces.
    """
    faces, pixels, _, _ = surface

    def look(way: Array, exists: Array, total: Array) -> Array:
        place, outward, depth, face, others = stored_together(
            (point[:, way], out[:, way], near[way], own[:, way], around[:, way])
        )
        # A point on each side of the crease, where the two faces lie.
        x, y = place[:, None] + outward[:, None] * jnp.array([[-_ASIDE], [_ASIDE]], out.dtype)
        values, own_depth = edge_values(corners_of(face, faces, pixels), x, y)
        there = covers(values)

        def may_hide(other: Array) -> tuple[Array, Array]:
            """Whether planes begin at the crease and hide either side, and faces cover it."""
            corners = corners_of(other, faces, pixels)[:, :, None]
            values, depths = edge_values(corners, x[:, None], y[:, None])
            foreign = (other >= 0) & (other != face[0]) & (other != face[1])
            begins = foreign & (abs((depths[0] + depths[1]) / 2 - depth) < TOLERANCE * depth)
            hides = depths > (own_depth + _ASIDE * _RISES * depth)[:, None]
            return begins & hides & there[:, None], covers(values)

        hides, here = stored_together(may_hide(others))
        starts = []
        for side in range(2):
            covering = first_row(hides[side] & here[side])
            best = jnp.where(covering < len(others), covering, first_row(hides[side]))
            start = picked(others, jnp.minimum(best, len(others) - 1))
            starts.append(jnp.where(exists & (best < len(others)), start, -1))
        # It may be seen where another one of its faces lies.
        reached, _ = walk(jnp.stack(starts), x, y, surface)
        hides, here = may_hide(reached)
        found = (hides[0, 0] & here[0, 0]) | (hides[1, 1] & here[1, 1])
        return total.at[jnp.where(exists, way, crease.size)].set(found, mode="drop")

    return over_few(crease, _AT_ONCE, look, crease & False)
