"""Ways over faces from one to the next across common edges, as a light or the eye sees them."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._device import anywhere, in_strides
from diffrast._selection import divided
from diffrast._stored import stored
from diffrast.edges.planes import edge_functions, largest, lowest

_STEPS = 64  # from face to face
_EDGE_ON = 8  # roundings in the volume of a face

_Search = tuple[Array, Array, Array, Array, Array]
_State = tuple[Array, Array, Array, Array, Array, Array, Array]


def leaves(
    corners: Float[Array, "3 3 *n"], ends: list[list[Array]]
) -> tuple[Float[Array, "*n"], Int[Array, "*n"], Float[Array, "*n"]]:
    """Where on the way between two points, 0 to 1, a face ends; 3 if it does not.

    Also the corner opposite to the edge there, and the volume of the face, whose sign tells which
    side it turns to these; zero if they see it edge-on, as far as rounding can tell.
    """
    (first, volume), (last, _) = (edge_functions(corners, *end) for end in ends)
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    extent = jnp.maximum(largest(one), largest(other))
    place = largest(corners.swapaxes(0, 1))
    size = jnp.maximum(place[0], place[1]) * place[2] * extent
    volume = jnp.where(abs(volume) > _EDGE_ON * jnp.finfo(size.dtype).eps * size, volume, 0)
    sign = jnp.where(volume < 0, -1, 1)
    parts = []
    for a, b in zip(first, last, strict=True):
        a, b = jnp.maximum(a * sign, 0), b * sign
        parts.append(jnp.where(b < 0, a / jnp.where(b < 0, a - b, 1), 3))
    return stored((*lowest(parts), volume))


def covering(
    face: Int[Array, " n"],
    searched: Bool[Array, " n"],
    neighbors: Int[Array, "F 3"],
    corners_of: Callable[[Array], Array],
    end: list[Array],
) -> Int[Array, " n"]:
    """The face of the same surface that hides a point, where one is searched for; or the same."""

    def step(state: _Search) -> _Search:
        steps, there, turn, goes, found = state
        values, volume = edge_functions(corners_of(there), *end)
        sign = jnp.sign(volume)
        goes = goes & (there >= 0) & ((turn == 0) | (sign == turn))
        least, corner = lowest([value * sign for value in values])
        arrives = goes & (least >= 0)
        following = neighbors[jnp.maximum(there, 0), corner]
        goes_on = goes & ~arrives
        found = jnp.where(arrives, there, found)
        return stored((steps + 1, jnp.where(goes_on, following, there), sign, goes_on, found))

    def is_on_the_way(state: _Search) -> Array:
        return anywhere((state[0] < _STEPS) & jnp.any(state[3]))

    zero = jnp.zeros_like(end[0])
    start = jnp.sum(jnp.zeros_like(face)), face, zero, searched & (face >= 0), face
    return lax.while_loop(is_on_the_way, in_strides(step), start)[-1]


def follow(
    face: Int[Array, " n"],
    neighbors: Int[Array, "F 3"],
    corners_of: Callable[[Array], Array],
    ends: list[list[Array]],
) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """The edge at which the surface ends, or turns away, on the way from a face; and where, 0 to 1.

    The edge is -1 where none is found.
    """

    def step(state: _State) -> _State:
        steps, face, edge, end, turn, found, done = state
        part, corner, volume = leaves(corners_of(face), ends)
        turned = (edge >= 0) & (volume * turn <= 0)
        found = found | (~done & ((face < 0) | turned) & (edge >= 0))
        done = done | found | (face < 0) | (part > 1)
        following = neighbors[jnp.maximum(face, 0), corner]
        next_edge = jnp.where(done, edge, 3 * face + corner)
        end, turn = jnp.where(done, jnp.stack([end, turn]), jnp.stack([part, jnp.sign(volume)]))
        face = jnp.where(done, face, following)
        return stored((steps + 1, face, next_edge, end, turn, found, done))

    def is_on_the_way(state: _State) -> Array:
        return anywhere((state[0] < _STEPS) & ~jnp.all(state[-1]))

    nothing, zero = jnp.zeros_like(face), jnp.zeros_like(ends[0][0])
    start = jnp.sum(nothing), face, nothing - 1, zero, zero, face < -1, face < 0
    _, _, edge, end, _, found, _ = lax.while_loop(is_on_the_way, in_strides(step), start)
    return stored((jnp.where(found, _named_once(edge, neighbors), -1), end))


def _named_once(edge: Int[Array, " n"], neighbors: Int[Array, "F 3"]) -> Int[Array, " n"]:
    """Edges by the lower one of their two faces."""
    face, corner = divided(jnp.maximum(edge, 0), 3)
    other = neighbors[face, corner]
    back = neighbors[jnp.maximum(other, 0)] == face[:, None]
    corner = jnp.where(back[:, 0], 0, jnp.where(back[:, 1], 1, 2))
    return jnp.where((other >= 0) & (other < face), 3 * other + corner, edge)
