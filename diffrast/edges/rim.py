"""The surface just inside of an edge, as far as the edge's pixel reaches."""

from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._stored import stored
from diffrast.edges.neighborhood import Surface, picked, pixel_at, steps_to, turned_alike
from diffrast.edges.planes import Columns, barycentrics, corners_of, edge_values, locate

BESIDE = 0.02  # pixels
_SMALL = 1e-6  # keeps a ratio of lengths finite
_THIN = 0.15  # pixels
_LONG = 4.0  # pixels: where edges are shorter, the next face takes the place of one that opens
_EIGHTHS = (-3 / 8, -1 / 8, 1 / 8, 3 / 8)  # of a piece, from its middle
SHORT = 1e-3  # pixels: no piece is left that is shorter
_SHALLOW = 1e-3  # pixels: keeps ratios of depths finite


class Rim(NamedTuple):
    """The surface in front of pieces, from the piece inwards as far as the pixel reaches."""

    smooth: Bool[Array, " n"]  # whether this pixel and the next show the same smooth surface
    inner: Int[Array, " n"]  # 0 to 8: the next pixel of the 3×3 inwards, or this one: see `alone`
    reaches: Float[Array, "4 n"]  # how far the pixel reaches, from the middles of four parts
    depth: Float[Array, " n"]  # and from that of the whole,
    first: Float[Array, " n"]  # and how far the face at the edge does, if that is less
    thin: Bool[Array, " n"]  # whether that is hardly anything, of a long edge,
    apex: Int[Array, " n"]  # and the vertex of that face which is not on the edge
    bend: tuple[Int[Array, " n"], Columns]  # face and barycentrics where that face ends
    far: tuple[Int[Array, " n"], Columns]  # and where the pixel ends
    single: Bool[Array, " n"]  # whether one face covers what lies between
    beside: tuple[Int[Array, " n"], Columns]  # point `BESIDE` outwards of the next pixel's centre
    inner_depth: Float[Array, " n"]  # of that centre
    border: Float[Array, "2 n"]  # depths of the pixel's border, see `_border`,
    weight: Float[Array, " n"]  # and the first one's weight

    @property
    def alone(self) -> Bool[Array, " n"]:
        """Whether this pixel shows the surface in front, and the next one not this side of it."""
        return self.inner == 4


def next_inwards(
    middle: Float[Array, "2 n"], inward: Float[Array, "2 n"]
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """How far a pixel reaches from points inwards, and which of the 3×3 is next: see `Rim`."""
    depth = reach(middle, inward)
    return depth, stored(pixel_at(middle, inward, depth + 0.5))


def reach(point: Float[Array, "2 *size"], inward: Float[Array, "2 *size"]) -> Float[Array, "*size"]:
    """How far a pixel reaches from points in it, in these directions; no farther than 1.5."""
    exits = [
        (0.5 - jnp.sign(way) * at) / jnp.maximum(abs(way), _SMALL)
        for way, at in zip(inward, point, strict=True)
    ]
    return stored(jnp.clip(jnp.minimum(*exits), 0, 1.5))


def look_inwards(
    front: Int[Array, " n"],
    apex: Int[Array, " n"],
    thickness: Float[Array, " n"],
    pictured: Int[Array, "9 n"],
    inwards: tuple[Float[Array, " n"], Int[Array, " n"]],
    connected: Bool[Array, " n"],
    middle: Float[Array, "2 n"],
    long: Float[Array, " n"],
    across: Float[Array, "2 n"],
    inward: Float[Array, "2 n"],
    centre: Float[Array, "2 n"],
    surface: Surface,
) -> Rim:
    """What the faces in front show from the middle of pieces inwards.

    Args:
        front: face in front.
        apex: its vertex that is not on the edge.
        thickness: how far it reaches.
        pictured: faces at the 3×3 pixels.
        inwards: what `next_inwards` tells.
        connected: whether the pixel that shows the front and the next one inwards show its surface.
        middle: of the piece, from the pixel's centre.
        long: how long the edge is.
        across: from the piece's begin to its end.
        inward: unit normal towards the face in front.
        centre: of the pixel, on the screen.
        surface: all faces.
    """
    faces, pixels, topology, volume = surface
    depth, inner = inwards
    step = steps_to(inner).astype(centre.dtype)
    next_face = stored(picked(pictured, inner))
    first = jnp.minimum(thickness, depth)
    beyond = jnp.where(thickness >= depth, front, next_face)
    face = jnp.stack([front, beyond])
    x, y = (centre + middle)[:, None] + jnp.stack([first, depth]) * inward[:, None]
    covered, at = locate(corners_of(face, faces, pixels), x, y)
    bend = [jnp.clip(b[0], 0, 1) for b in at]
    # Where the face ends, a narrow one may fold again.
    known, out = jnp.maximum(front, 0), jnp.argmin(jnp.stack(bend), axis=0)
    following = turned_alike(topology.neighbors[known, out], jnp.sign(volume[known]), volume)
    goes_on = (thickness >= depth) | following
    x, y = centre + step - BESIDE * inward
    beside = barycentrics(edge_values(corners_of(next_face, faces, pixels), x, y)[0])
    total = jnp.maximum(bend[0] + bend[1] + bend[2], _SMALL)
    own_depth = -jnp.sum(middle * inward, axis=0)
    border, weight = _border(own_depth, inward)
    return Rim(
        smooth=(front >= 0) & connected & goes_on,
        inner=inner,
        reaches=jnp.stack([reach(middle + way * across, inward) for way in _EIGHTHS]),
        depth=depth,
        first=first,
        thin=(thickness < jnp.minimum(depth, _THIN)) & (long > _LONG) & (next_face != front),
        apex=apex,
        bend=(front, [b / total for b in bend]),
        far=(beyond, [b[1] for b in at]),
        single=covered[1],
        beside=(next_face, beside),
        inner_depth=own_depth + jnp.sum(step * inward, axis=0),
        border=stored(border),
        weight=stored(weight),
    )


def _border(centre: Float[Array, " n"], inward: Float[Array, "2 n"]) -> tuple[Array, Array]:
    """Where chords of the pixel, parallel to a rim, end inside of it: what leaves as it moves.

    Of a length w(s) at the depth s, they grow and then shrink at a constant rate each. A rim that
    moves by one takes away -∫ w' c ds of a colour c(s) that moves along; as c(s) hardly curves over
    those depths, that is w(0) times weight c(border[0]) + (1 - weight) c(border[1]).

    Args:
        centre: depth of the pixel's centre.
        inward: unit normal of the rim.
    """
    steep, flat = jnp.max(abs(inward), axis=0), jnp.min(abs(inward), axis=0)
    ends = jnp.stack([(steep - flat) / 2, (steep + flat) / 2])
    inside = jnp.maximum(centre + jnp.stack([ends, -ends[::-1]]), 0)  # (shrink and grow, ends, n)
    whole = flat > _SMALL
    share = (inside[:, 1] - inside[:, 0]) / jnp.where(whole, flat, 1)
    share = jnp.where(whole, share, jnp.where(inside[:, 1] > 0, 1, 0))
    shrinks, grows = share
    weight = shrinks / jnp.maximum(shrinks - grows, SHORT)
    return (inside[:, 0] + inside[:, 1]) / 2, weight


def colors_along(
    rim: Rim,
    centre: Float[Array, " n"],
    front: Float[Array, "channels n"],
    bend: Float[Array, "channels n"],
    far: Float[Array, "channels n"],
    near: Float[Array, "channels n"],
    inner: Float[Array, "channels n"],
    beside: Float[Array, "channels n"],
) -> tuple[Float[Array, "channels n"], Float[Array, "channels n"], Bool[Array, " n"]]:
    """The colour of a smooth surface from its rim to where the pixel ends.

    Its integral over this depth, a mean along the piece, from whose ends a pixel reaches less far;
    and the colour that counts as the rim moves. As a point at a fixed depth keeps its colour, that
    is the one at the pixel's border, less what the derivative of the next pixel, which stands for
    this one's, says of it: as far as its colour is carried along, that is its slope. And whether
    that is too steep to go on for a pixel, as on a face much narrower than one: then nothing stands
    for this one's derivative, and nothing is taken off.

    Where the pixel's own centre is what is known of the surface, it is the colour that is carried
    along from there to the rim. What the rim shows beside that, as the highlight of a lip, moves
    along with it inside of the pixel, and adds nothing; nor does that centre's own change where
    its slope is too steep.

    Args:
        rim: what lies inwards of pieces.
        centre: depth of the pixel's centre.
        front: colour at the edge.
        bend: where the face there ends,
        far: where the pixel does,
        near: at the centre of the pixel that shows the surface first,
        inner: at that of the next one inwards,
        beside: at `rim.beside`.
    """
    first, depth = rim.first, rim.depth
    # A shadow may begin where the slope is taken.
    steepest = 2 * reduce(jnp.maximum, [jnp.abs(color) for color in (front, bend, far, inner)])
    slope = (inner - beside) / BESIDE
    steep = reduce(jnp.logical_or, list(jnp.abs(slope) > steepest))
    slope = jnp.clip(slope, -steepest, steepest)
    # Seen from ever flatter above, it changes with the square root of the depth.
    share = jnp.sqrt(depth / jnp.maximum(rim.inner_depth, _SHALLOW))
    expected = front + share * (
        (2 - share) * (inner - front) - 2 * (1 - share) * rim.inner_depth * slope
    )
    far = jnp.where(rim.single, far, expected)
    centre = jnp.clip(centre, first, depth)
    passes = centre > first
    near = jnp.where(passes, near, bend)
    known = bend, near, inner
    far = jnp.clip(far, reduce(jnp.minimum, known), reduce(jnp.maximum, known))
    far = jnp.where(first < depth, far, bend)

    def between(begin: Array, end: Array, colors: tuple[Array, Array], straight: Array) -> Array:
        """The integral over these depths; of colours that change straight or with the root."""
        at = jnp.clip(rim.reaches, begin, end) - begin
        share = at / jnp.maximum(end - begin, _SHALLOW)
        share = at * jnp.where(straight, share / 2, 2 / 3 * jnp.sqrt(share))
        return mean_of_rows(at) * colors[0] + mean_of_rows(share) * (colors[1] - colors[0])

    integral = between(jnp.zeros_like(first), first, (front, bend), jnp.ones_like(passes))
    integral += between(first, centre, (bend, near), rim.single)
    integral += between(centre, depth, (near, far), passes | rim.single)
    integral += mean_of_rows(jnp.maximum(rim.reaches - depth, 0)) * far

    carried = jnp.where(steep, 0, slope)

    def moved(at: Array) -> Array:
        share = jnp.sqrt(at / jnp.maximum(depth, _SHALLOW))
        return front + share * (far - front) - at * carried

    leaving, entering = (moved(at) for at in rim.border)
    moving = leaving + (rim.weight - 1) * (leaving - entering)
    moving = jnp.where(rim.alone, near - rim.inner_depth * carried, moving)
    return integral, moving, steep


def mean_of_rows(rows: Float[Array, "rows n"]) -> Float[Array, " n"]:
    """The mean of rows, without the pass that XLA makes of every reduction."""
    return reduce(jnp.add, list(rows)) / rows.shape[0]
