"""Colours that turn within a pixel.

A pixel shows the colour at its centre, and edges weigh colours by area. But where a surface curls,
or has a highlight no larger than a pixel, its colour turns within the pixel. Such pixels, found by
how colours bend from each to the next ones, are shaded at four more points of the surface at their
centre, and get its mean colour. Those that edges part are shaded at sixteen, as far as nothing
hides the surface there.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Bool, Float, Int

from diffrast._device import anywhere, at_once, most, over_views
from diffrast._linear import linear_map, linear_zeros
from diffrast._selection import batches_of, compacted, divided, over_batches
from diffrast._stored import stored, stored_together
from diffrast._topology import Topology, third_corner
from diffrast._varying import varying_alike, varying_zero
from diffrast.bending import Chosen, Turning, bending
from diffrast.edges.neighborhood import Surface, walk
from diffrast.edges.pieces import to_pixels
from diffrast.edges.planes import FINE_TOLERANCE, corners_of, covers, edge_values
from diffrast.geometry import Points, points_at
from diffrast.light import Columns
from diffrast.raster.evaluate import Drawn, pixels_at
from diffrast.shadows import Reached

Shade: TypeAlias = Callable[[Any, Points, Reached], Columns]

_POINTS_AT_ONCE = 512  # that may be hidden


def _points() -> np.ndarray:
    """Where pixels are shaded, to the right of their centres and below, of shape (2, 5 points, 5).

    The centre, and four points, no two in a row or a column, of a whole pixel; then of each quarter
    of one, of all the points of a grid.
    """
    whole = np.array([[-1, 3, 1, -3], [-3, -1, 3, 1]])[:, :, None]
    corners = np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]])
    quarters = corners[:, :, None] + 2 * corners[:, None]
    points = np.pad(np.concatenate([whole, quarters], axis=2), ((0, 0), (1, 0), (0, 0)))
    return (points / 8).astype(np.float32)


_POINTS = _points()
_STEEP = abs(_POINTS[1]) >= abs(_POINTS[0])
_ASIDE = np.where([~_STEEP, _STEEP], np.sign(_POINTS), 0).astype(np.int32)  # the next pixel


class _Points(NamedTuple):
    """What is seen there."""

    chosen: Chosen
    face: Int[Array, "points parts"]  # -1 where the surface ends, or is hidden
    reached: Reached  # at their centres: whatever shadow begins within a pixel has its edge


class _Parts(NamedTuple):
    """A batch of pixels and quarters of them."""

    place: Int[Array, " some"]
    exists: Bool[Array, " some"]
    points: Int[Array, " some"]  # which of `_POINTS`


class _Inputs(NamedTuple):
    """What the colours of points depend on."""

    data: Any
    drawn: Drawn
    points: _Points


def with_turns(
    shade: Shade,
    data: Any,
    drawn: Drawn,
    reached: Reached,
    topology: Topology,
    apart: Bool[Array, " edges"],
    volume: Float[Array, " faces"],
    turning: Turning,
    image: Float[Array, "height width 3"],
) -> Float[Array, "height width 3"]:
    """An image with the mean colours of pixels in which colours turn.

    Differentiable as the image itself and as the colours are, but for second derivatives of what is
    added; that has none where edges part pixels, which have their derivative already.

    Args:
        shade: colours of points, one array a channel; its first argument is `data`.
        data: a tree of all arrays that it uses.
        drawn: what is drawn, in an image with a border of one pixel all round.
        reached: by each light; images of that size.
        topology: of the faces.
        apart: whether colours may jump across an edge.
        volume: of faces, what `facing` found.
        turning: what `find_turning` found; the edges know of the pixels chosen there.
        image: with edges and without the border.
    """
    height, width = image.shape[:2]

    def find(
        turning: Turning,
        image: Array,
        reached: Reached,
        clip: Array,
        faces: Array,
        topology: Topology,
        apart: Array,
        volume: Array,
    ) -> _Points:
        chosen = bending(turning, image)
        row, column = divided(chosen.number, width)
        lit = jax.tree.map(lambda part: part[row + 1, column + 1], reached)
        face = _faces_at(chosen, turning.face_image, clip, faces, topology, apart, volume)
        return _Points(chosen, face, lit)

    seen = lax.stop_gradient((image, reached, drawn.positions_clip))
    surface = drawn.faces, jax.tree.map(jnp.asarray, topology), apart, lax.stop_gradient(volume)
    points = over_views(find, height * width)(turning, *seen, *surface)
    added = _added(shade, (height, width), _Inputs(data, drawn, points))
    number, _, total = points.chosen
    place = jnp.arange(number.size)
    row, column = divided(number, width)
    row = jnp.where(place < total, row, height + place)  # none twice
    return image.at[row, column].add(added, mode="drop", unique_indices=True)


def _parts(chosen: Chosen, n: Array, count: Array) -> _Parts:
    """The batch `n` of so many parts."""
    size = chosen.at_once
    number = n * size + jnp.arange(size, dtype=jnp.int32)
    after = number - chosen.plain
    whole = (after < 0) | (chosen.parts_of_each == 1)
    place = jnp.where(whole, number, chosen.plain + after // 4)
    place = jnp.minimum(place, chosen.number.size - 1)
    return _Parts(*stored_together((place, number < count, jnp.where(whole, 0, 1 + after % 4))))


def _over_parts(chosen: Chosen, count: Array, step: Callable[[Array, Any], Any], start: Any) -> Any:
    return lax.fori_loop(0, batches_of(most(count), chosen.at_once), step, start)


def _faces_at(
    chosen: Chosen,
    face_image: Array,
    clip: Array,
    faces: Array,
    topology: Topology,
    apart: Array,
    volume: Array,
) -> Int[Array, "points parts"]:
    """The faces at the points of pixels, found from those at their centres.

    What the next pixels show may hide them.
    """
    height, width = face_image.shape
    count = chosen.parts

    def find(found: Array) -> Array:
        pixels = stored(to_pixels(clip, height, width))
        neighbors = lax.cond(jnp.any(apart), _parted, _together, topology, apart)
        surface = Surface(faces, pixels, topology._replace(neighbors=neighbors), volume)

        def add(n: Array, found: Array) -> Array:
            place, exists, part = _parts(chosen, n, count)
            row, column = stored(divided(chosen.number[place], width - 2))
            x0, y0 = (at.astype(clip.dtype) + 1.5 for at in (column, row))
            centre = stored(jnp.where(exists, face_image[row + 1, column + 1], -1))
            right, down = stored(jnp.asarray(_POINTS, clip.dtype)[:, :, part])
            point = x, y = stored_together((x0 + right, y0 + down))
            covered = covers(edge_values(corners_of(centre, faces, pixels)[:, :, None], x, y)[0])
            covered = covered | (jnp.arange(x.shape[0]) == 0)[:, None]
            own = jnp.broadcast_to(centre, x.shape)
            # Beyond a fold, to which a way might lead round its end, edges tell what is seen.
            start = stored(jnp.where(covered, -1, own))
            ends, there = walk(start, x, y, surface, straight=True)
            seen = stored(jnp.where(covered, own, jnp.where(there, ends, -1)))
            right, down = stored(jnp.asarray(_ASIDE)[:, :, part])
            beside = stored(face_image[row + 1 + down, column + 1 + right])
            parted = exists & (place >= chosen.plain)
            beside = stored(jnp.where(parted & (beside != own), beside, -1))
            seen = _unhidden(seen, beside, point, (x0 + right, y0 + down), surface)
            return lax.dynamic_update_slice_in_dim(found, seen, n * place.size, 1)

        return _over_parts(chosen, count, add, found)

    nowhere = jnp.full((_POINTS.shape[1], chosen.number.size), -1, jnp.int32)
    nowhere = nowhere + varying_zero((chosen, face_image, clip, faces, topology, apart, volume))
    return lax.cond(anywhere(count > 0), find, lambda nowhere: nowhere, nowhere)


def _unhidden(
    seen: Int[Array, "points parts"],
    beside: Int[Array, "points parts"],
    point: tuple[Array, Array],
    centre: tuple[Array, Array],
    surface: Surface,
) -> Int[Array, "points parts"]:
    """What is seen at points, -1 where the surface that the next pixel shows lies before that.

    It does not if at that pixel's centre it lies behind the plane of what is seen at the point.
    """
    faces, pixels, _, _ = surface
    order, count = compacted(
        ((seen >= 0) & (beside >= 0) & (beside != seen)).reshape(-1),
        jnp.arange(seen.size, dtype=jnp.int32),
    )
    known = stored_together([part.reshape(-1) for part in (beside, *point, *centre)])

    def hide(number: Array, exists: Array, seen: Array) -> Array:
        face, other, x, y, centre_x, centre_y = stored_together(
            [part[number] for part in (seen, *known)]
        )
        corners = corners_of(face, faces, pixels)

        def is_before(other: Array, x: Array, y: Array, tolerance: float = 0) -> Array:
            both = corners_of(other, faces, pixels), corners
            near, far = (edge_values(of_one, x, y)[1] for of_one in both)
            return near > far * (1 + tolerance)

        may_hide = exists & is_before(other, centre_x, centre_y)
        start = stored(jnp.where(may_hide, other, -1))
        end, there = walk(start, x, y, surface)
        hidden = there & (end >= 0) & is_before(end, x, y, FINE_TOLERANCE)
        return seen.at[jnp.where(hidden, number, seen.size)].set(-1, mode="drop")

    some = at_once(_POINTS_AT_ONCE, seen.size)
    return over_batches(order, count, some, hide, seen.reshape(-1)).reshape(seen.shape)


def _together(topology: Topology, apart: Array) -> Array:
    return topology.neighbors + varying_zero((topology, apart))


def _parted(topology: Topology, apart: Array) -> Array:
    """The neighbours of faces, but none across these edges."""
    side, count = third_corner(topology.edges.corners), topology.neighbors.shape[0]
    face = jnp.where(apart[:, None], topology.edges.faces, -1)
    face = jnp.where(face >= 0, face, count)
    return _together(topology, apart).at[face, side].set(-1, mode="drop")


def _added(shade: Shade, size: tuple[int, int], inputs: _Inputs) -> Float[Array, "places 3"]:
    """By how much the mean colours of pixels differ from those at their centres."""

    def over(function: Callable[..., Any]) -> Callable[..., Any]:
        return over_views(function, size[0] * size[1])

    @jax.custom_jvp
    def added(inputs: _Inputs) -> Array:
        def all_batches(inputs: _Inputs) -> Array:
            chosen = inputs.points.chosen
            count = chosen.parts

            def step(n: Array, total: Array) -> Array:
                parts = _parts(chosen, n, count)
                rows = stored(_of_parts(shade, size, inputs, parts, n))
                return total.at[parts.place].add(rows)

            return _over_parts(chosen, count, step, _nothing(inputs) + varying_zero(inputs))

        return over(all_batches)(varying_alike(inputs))

    def derivative(primals: Any, tangents: Any) -> tuple[Array, Array]:
        leaves, tree = jax.tree.flatten(varying_alike(lax.stop_gradient(primals[0])))
        changes = jax.tree.leaves(tangents[0])
        used = [i for i, change in enumerate(changes) if not isinstance(change, SymbolicZero)]

        def of_used(leaves: list[Array], n: Array) -> tuple[Array, Callable[..., Array]]:
            chosen = jax.tree.unflatten(tree, leaves).points.chosen
            parts = _parts(chosen, n, chosen.plain)

            def of(*values: Array) -> Array:
                given = dict(zip(used, values, strict=True))
                both = [given.get(i, leaf) for i, leaf in enumerate(leaves)]
                return _of_parts(shade, size, jax.tree.unflatten(tree, both), parts, n)

            return parts.place, of

        def over_plain(leaves: list[Array], step: Callable[[Array, Any], Any], start: Any) -> Any:
            chosen = jax.tree.unflatten(tree, leaves).points.chosen
            return _over_parts(chosen, chosen.plain, step, start)

        def push(leaves: list[Array], changes: list[Array], nothing: Array) -> Array:
            at = [leaves[i] for i in used]

            def step(n: Array, total: Array) -> Array:
                place, of = of_used(leaves, n)
                return total.at[place].add(jax.jvp(of, at, changes)[1])

            return over_plain(leaves, step, nothing)

        def pull(leaves: list[Array], cotangent: Array) -> list[Array]:
            at = [leaves[i] for i in used]

            def step(n: Array, total: list[Array]) -> list[Array]:
                place, of = of_used(leaves, n)
                back = jax.vjp(of, *at)[1]
                return jax.tree.map(jnp.add, total, list(back(cotangent[place])))

            return over_plain(leaves, step, [linear_zeros(leaf.shape, cotangent) for leaf in at])

        change = linear_map(
            lambda changes, nothing: over(push)(leaves, changes, nothing),
            lambda cotangent: over(pull)(leaves, cotangent),
            [changes[i] for i in used],
            _nothing(primals[0]),
        )
        return added(*primals), change

    added.defjvp(derivative, symbolic_zeros=True)
    return added(inputs)


def _nothing(inputs: _Inputs) -> Array:
    return jnp.zeros((inputs.points.chosen.number.size, 3), inputs.drawn.positions_clip.dtype)


def _of_parts(
    shade: Shade, size: tuple[int, int], inputs: _Inputs, parts: _Parts, n: Array
) -> Float[Array, "some 3"]:
    """What `_added` finds for parts of the batch `n`: of what is not seen, edges tell."""
    data, drawn, points = inputs
    row, column = divided(points.chosen.number[parts.place], size[1])
    some = row.size
    face = lax.dynamic_slice_in_dim(points.face, n * some, some, 1)
    full = size[0] + 2, size[1] + 2
    pixels = pixels_at(face, row + 1, column + 1, full, drawn.positions_clip.dtype)
    right, down = jnp.asarray(_POINTS)[:, :, parts.points]
    x, y = pixels.x + 2 * right, pixels.y - 2 * down
    flat, x, y = stored_together([part.reshape(-1) for part in (face, x, y)])
    # Stored, and the colours: in what repeats rows no loop is vectorised.
    lit = jax.tree.map(lambda part: jnp.tile(part[parts.place], face.shape[0]), points.reached)
    lit = stored(lit)
    seen = points_at(drawn, pixels._replace(face=flat, x=x, y=y))
    colors = [color.reshape(face.shape) for color in stored(shade(data, seen, lit))]
    used = (face[1:] >= 0) & parts.exists
    quarter = jnp.array(0.25, x.dtype)
    share = jnp.where(parts.points > 0, quarter, 1)  # of the pixel
    means = [jnp.mean(jnp.where(used, color[1:] - color[0], 0), axis=0) for color in colors]
    return jnp.stack([share * mean for mean in means], axis=-1)
