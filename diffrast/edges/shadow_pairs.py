"""What pixels tell of shadows: between which two of them one ends, and where the light reaches."""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._selection import divided, selected
from diffrast._stored import stored
from diffrast.edges.neighborhood import steps_to
from diffrast.edges.pieces import Depth

# Which of two pixels show what a shadow falls on; if one does, that surface goes on behind what the
# other one shows, or ends before that.
ON_BOTH, ON_FIRST, ON_SECOND = np.arange(3, dtype=np.int32)
CODES = 9  # `coded`, of a face

NEAREST = np.array([4, 1, 3, 5, 7, 0, 2, 6, 8], np.int32)  # of the 3×3 pixels,
_PLACE = np.argsort(NEAREST)  # of pixels among these,
_CROSS = 5  # of which the first so many are the middle one and the four next to it
# Neighbours among the 3×3 pixels, those of the middle one first: direction, first, second.
_RIGHT = [(0, 3 * row + k, 3 * row + k + 1) for row, k in itertools.product(range(3), range(2))]
_BELOW = [(1, 3 * row + k, 3 * row + k + 3) for row, k in itertools.product(range(2), range(3))]
DIRECTION, FIRST, SECOND = np.array(
    sorted(_RIGHT + _BELOW, key=lambda pair: 4 not in pair[1:]), np.int32
).T


class Cast(NamedTuple):
    """The shadows of a scene, by their lights."""

    between: Int[Array, "lights 2 height_with_border width_with_border"]
    # `coded`: the edge whose shadow passes between a pixel and the one on its right, or below it;
    # -1 if there is none.
    lit: Bool[Array, "lights height_with_border width_with_border"]
    patches: Int[Array, " F"]  # the surfaces on which they fall, see `Topology`
    turned: Bool[Array, "lights F"]  # faces that turn their outside to the light
    source: Float[Array, "lights 4"]  # clip position, or direction to the light
    weight: Float[Array, " lights"]  # h: 1 for places, 0 for directions; see `with_lights`
    parallel: Bool[Array, ""]  # whether the weight moves with the light


def with_lights(
    cast: Cast, depth: Depth, unit: Float[Array, ""]
) -> tuple[Cast, Float[Array, "rows 4"]]:
    """Shadows as this projection has them, and what follows the vertices' positions.

    First the lights, in such units, then their weights in the place of w, so that they may move.
    """
    weight = jnp.where(depth.parallel, depth.weight(cast.source), cast.weight)
    rows = jnp.zeros_like(cast.source).at[:, 3].set(weight)
    cast = cast._replace(weight=weight, parallel=depth.parallel)
    return cast, jnp.concatenate([cast.source / unit, rows])


def coded(edge: Int[Array, "*n"], ground: Int[Array, "*n"]) -> Int[Array, "*n"]:
    """One number of edges, 3 * face + corner, and the pixels that show what their shadow falls on.

    -1 where there is no edge.
    """
    return jnp.where(edge < 0, -1, 3 * edge + ground)


def decoded(code: Int[Array, "*n"]) -> tuple[Int[Array, "*n"], Int[Array, "*n"]]:
    """Edges and pixels of such numbers."""
    edge, ground = divided(jnp.maximum(code, 0).astype(jnp.int32), 3)
    return jnp.where(code < 0, -1, edge), ground


def on_ground(ground: Int[Array, "*n"], first: Array, second: Array) -> Array:
    """Of values of two pixels that of one which shows what the shadow falls on."""
    return jnp.where(ground == ON_SECOND, second, first)


def choose_pixels(cast: Cast) -> tuple[Int[Array, " places"], Int[Array, ""]]:
    """Indices (light, row, column) of pixels round which an outline passes, and how many."""
    right, below = (cast.between[:, k] >= 0 for k in range(2))
    right = right[:, :-2] | right[:, 1:-1] | right[:, 2:]
    below = below[:, :-2] | below[:, 1:-1]
    right = right[:, :, :-2] | right[:, :, 1:-1]
    below = below[:, :, :-2] | below[:, :, 1:-1] | below[:, :, 2:]
    return selected(right | below)


@jax.jit
def light_told(
    cast: Cast,
    face_image: Int[Array, "height_with_border width_with_border"],
    pixel: Int[Array, "2 n"],
    face: Int[Array, " n"],
) -> tuple[Int[Array, "lights n"], Int[Array, "lights n"], Bool[Array, "lights n"]]:
    """Whether lights reach faces at pixels, as far as these and the four next to them tell.

    1 or 0 where all those agree that show the same surface, turned to the light; else -1. Between
    them no outline is known, so a ray to the light would tell of a strip that no centre shows. Also
    what all of the 3×3 pixels tell, -2 where none of these shows it so; and whether an outline is
    drawn on the faces though it is not they that the middle pixel shows.
    """
    column, row = pixel[:, None] + 1 + steps_to(jnp.asarray(NEAREST))[..., None]
    shown = stored(face_image[row, column])
    seen, face = jnp.maximum(shown, 0), jnp.maximum(face, 0)
    patch = stored(cast.patches[seen])
    same = (shown >= 0) & (patch == cast.patches[face])
    counts = same & cast.turned[:, seen]
    lit = cast.lit[:, row, column]
    # Whether a shadow may begin, on what the middle pixel shows, behind what others do.
    first, second = _PLACE[FIRST], _PLACE[SECOND]
    between, ground = decoded(cast.between[:, DIRECTION[:, None], row[first], column[first]])
    on_middle = on_ground(ground, patch[first], patch[second]) == patch[0]
    on_middle = (between >= 0) & on_middle & (shown[0] >= 0)
    on_faces = (between >= 0) & on_ground(ground, same[first], same[second])
    parted = jnp.any(on_faces, axis=1) & ~jnp.any(on_middle, axis=1)
    hidden = jnp.any(on_faces & (ground != ON_BOTH), axis=1) & same[0]

    def told(rows: int) -> Array:
        bright, dark = (jnp.any((counts & part)[:, :rows], axis=1) for part in (lit, ~lit))
        alike = jnp.where(bright, jnp.where(dark, -1, 1), jnp.where(dark, 0, -2))
        alike = jnp.where(hidden, -1, alike)
        return jnp.where(cast.turned[:, face], alike, 0)

    return stored((jnp.maximum(told(_CROSS), -1), told(len(NEAREST)), parted))
