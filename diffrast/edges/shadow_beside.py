"""Where outlines of shadows on what lies behind a piece of an edge cross the piece."""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from diffrast._selection import divided
from diffrast._stored import stored
from diffrast.edges.neighborhood import Surface, steps_to
from diffrast.edges.planes import corners_of, from_centre
from diffrast.edges.shadow_pairs import DIRECTION, FIRST, ON_BOTH, SECOND, Cast, decoded, on_ground
from diffrast.edges.shadow_planes import Plane, face_plane, meeting, shadow_plane


@jax.jit
def crossing(
    face: Int[Array, " n"],
    begin: Float[Array, "2 n"],
    end: Float[Array, "2 n"],
    pixel: Int[Array, "2 n"],
    cast: Cast,
    surface: Surface,
    shown: Int[Array, "9 n"],
) -> Float[Array, " n"]:
    """Where, 0 to 1, the first outline on faces crosses pieces, whose ends are from the centre.

    1 if none does. `shown` are the faces at the 3×3 pixels round each. Of each light two edges at
    most are known whose shadows part pixels round there that show the faces' surface.
    """
    faces, pixels, _, _ = surface
    patch = cast.patches[jnp.maximum(face, 0)]
    same = (face >= 0) & (shown >= 0) & (cast.patches[jnp.maximum(shown, 0)] == patch)
    column, row = pixel[:, None] + 1 + steps_to(jnp.asarray(FIRST))[..., None]
    edge, ground = decoded(cast.between[:, DIRECTION[:, None], row, column])  # (lights, pairs, n)
    on_face = (edge >= 0) & on_ground(ground, same[FIRST], same[SECOND])
    known = on_face & ((ground == ON_BOTH) | ~same[4])
    last = jnp.max(jnp.where(known, edge, -1), axis=1)
    first = jnp.min(jnp.where(known, edge, jnp.iinfo(edge.dtype).max), axis=1)
    edge = stored(jnp.stack([jnp.minimum(first, last), last]))  # (2, lights, n)
    caster, third = divided(jnp.maximum(edge, 0), 3)
    start, stop = (from_centre(pixels[:, faces[caster, (third + k) % 3]], pixel) for k in (1, 2))
    lights = cast.weight.size
    source = from_centre(pixels[:, -2 * lights : -lights, None], pixel)[:, None]
    shadow = shadow_plane(source, cast.weight[:, None], start, stop)
    plane = face_plane(from_centre(corners_of(face, faces, pixels), pixel))
    plane = Plane(plane.normal[:, None, None], plane.offset)
    a, b, c = stored(meeting(plane, shadow))
    at_begin, at_end = (a * x + b * y + c for x, y in (begin, end))
    parts = (edge >= 0) & ((at_begin < 0) != (at_end < 0))
    at = jnp.where(parts, at_begin / jnp.where(parts, at_begin - at_end, 1), 1)
    return stored(jnp.min(at, axis=(0, 1)))
