"""Colours that turn within a pixel.

A pixel shows the colour at its centre, and edges weigh colours by area. But where a surface curls,
or has a highlight no larger than a pixel, its colour turns within the pixel. Such pixels, found by
how colours bend from each to the next ones, are shaded at four more points of the surface at their
centre, and get its mean colour. Those that edges part are shaded at sixteen, as far as nothing
hides the surface there.

How the mean changes is what edges weigh, too: of a highlight narrower than a pixel the colour at
the centre may change by any amount.
"""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Bool, Float

from diffrast._device import over_views
from diffrast._linear import linear_map, linear_zeros
from diffrast._selection import divided
from diffrast._stored import stored, stored_together
from diffrast._topology import Topology
from diffrast._varying import varying_alike, varying_zero
from diffrast.bending import Chosen, Turning, bending
from diffrast.edges.antialias import Finish
from diffrast.edges.neighborhood import pixels_round
from diffrast.geometry import Points, points_at
from diffrast.light import Columns
from diffrast.raster.evaluate import Drawn, pixels_at
from diffrast.shadows import Reached
from diffrast.within import (
    POINTS,
    Parts,
    PointsWithin,
    faces_at,
    faces_of,
    number_seen,
    over_parts,
    parts_of,
)

Shade: TypeAlias = Callable[[Any, Points, Reached], Columns]

_BESIDE = 0.02  # pixels: to where slopes are taken
_STEEP = 2  # times the range of the colours round a pixel: more does not pass in it


class _Fixed(NamedTuple):
    """By what pixels are chosen, and what is seen at their points is found."""

    turning: Turning
    reached: Reached  # images with a border of one pixel
    topology: Topology
    apart: Bool[Array, " edges"]
    volume: Float[Array, " faces"]


class _Given(NamedTuple):
    """That, and what the colours of points depend on."""

    fixed: _Fixed
    colored: tuple[Any, Drawn]


def turns(
    shade: Shade,
    data: Any,
    drawn: Drawn,
    reached: Reached,
    topology: Topology,
    apart: Bool[Array, " edges"],
    volume: Float[Array, " faces"],
    turning: Turning,
) -> Finish:
    """What gives an image with edges the mean colours of pixels in which colours turn.

    Edges weigh the change of these means in place of that of the colours at centres. No second
    derivatives.

    Args:
        shade: colours of points, one array a channel; its first argument is `data`.
        data: a tree of all arrays that it uses.
        drawn: what is drawn, in an image with a border of one pixel all round.
        reached: by each light; images of that size.
        topology: of the faces.
        apart: whether colours may jump across an edge.
        volume: of faces, what `facing` found.
        turning: what `find_turning` found; the edges know of the pixels chosen there.
    """

    def draw(given: _Given, image: Array) -> tuple[Array, PointsWithin]:
        height, width, _ = image.shape
        with jax.named_scope("turning"):
            points = _find(given, image)
            added = _added(shade, (height, width), given.colored, points)
            return _put(image, points.chosen, added), points

    def change(given: _Given, points: PointsWithin, changes: _Given, colors: Array) -> Array:
        size = colors.shape[0] - 2, colors.shape[1] - 2
        with jax.named_scope("turning"):
            if all(isinstance(part, SymbolicZero) for part in jax.tree.leaves(changes.colored)):
                return colors
            turning = given.fixed.turning
            added = _change(shade, size, given.colored, points, turning.hard, changes.colored)
            return _put(colors, points.chosen, added, border=1)

    topology = jax.tree.map(jnp.asarray, topology)
    fixed = lax.stop_gradient(_Fixed(turning, reached, topology, apart, volume))
    return Finish(_Given(fixed, (data, drawn)), draw, change)


def _put(image: Array, chosen: Chosen, added: Array, *, border: int = 0) -> Array:
    """Add to the chosen pixels, in an image with such a border."""
    place = jnp.arange(chosen.number.size, dtype=jnp.int32)
    row, column = divided(chosen.number, image.shape[1] - 2 * border)
    row = jnp.where(place < chosen.total, row + border, image.shape[0] + place)  # none twice
    return image.at[row, column + border].add(added, mode="drop", unique_indices=True)


def _find(given: _Given, image: Float[Array, "height width 3"]) -> PointsWithin:
    """The pixels in which colours turn, and what is seen at their points."""
    width = image.shape[1]
    drawn = given.colored[1]

    def find(fixed: _Fixed, image: Array, clip: Array, faces: Array) -> PointsWithin:
        turning, reached, topology, apart, volume = fixed
        chosen = bending(turning, image)
        row, column = divided(chosen.number, width)
        lit = jax.tree.map(lambda part: part[row + 1, column + 1], reached)
        face = faces_at(chosen, turning.face_image, clip, faces, topology, apart, volume)
        return PointsWithin(chosen, number_seen(chosen, face), turning.face_image, face, lit)

    seen = lax.stop_gradient((given.fixed, image, drawn.positions_clip, drawn.faces))
    return over_views(find, image.shape[0] * width)(*seen)


def _added(
    shade: Shade, size: tuple[int, int], colored: tuple[Any, Drawn], points: PointsWithin
) -> Float[Array, "places 3"]:
    """By how much the mean colours of pixels differ from those at their centres."""

    def all_batches(colored: tuple[Any, Drawn], points: PointsWithin) -> Array:
        count = points.chosen.parts

        def step(n: Array, total: Array) -> Array:
            parts = parts_of(points.chosen, n, count)
            colors = _colors(shade, size, colored, points, parts, n)
            quarter = jnp.array(0.25, colors[0].dtype)
            weight = jnp.where(parts.points > 0, quarter * quarter, quarter)
            return total.at[parts.place].add(stored(_sums(colors, points, parts, n, weight)))

        start = _nothing(colored, points)
        start = start + varying_zero((colored, points)).astype(start.dtype)
        return over_parts(points.chosen, count, step, start)

    return over_views(all_batches, size[0] * size[1])(*varying_alike((colored, points)))


def _change(
    shade: Shade,
    size: tuple[int, int],
    colored: tuple[Any, Drawn],
    points: PointsWithin,
    hard: Float[Array, "height_with_border width_with_border 3"],
    changes: tuple[Any, Drawn],
) -> Float[Array, "places 3"]:
    """By how much more the mean colours of pixels change than those at their centres.

    The means are of what is seen of the surface, and of no more change than `_share_of_change`. Of
    those that edges part only where colours turn sharply: else the centre's change is as good.
    """
    fixed = varying_alike((colored, points, hard))
    leaves, tree = jax.tree.flatten(colored)
    known = enumerate(jax.tree.leaves(changes))
    moving = {i: change for i, change in known if not isinstance(change, SymbolicZero)}

    def of_batch(fixed: Any, n: Array) -> tuple[Array, Callable[..., Array], list[Array]]:
        """Places, and their means as a function of what moves, which is given as well."""
        colored, points, hard = fixed
        leaves = jax.tree.leaves(colored)
        parts = parts_of(points.chosen, n, points.chosen.moving_parts)
        row, column = divided(points.chosen.number[parts.place], size[1])
        around = stored(pixels_round(hard, column, row))
        at = partial(_colors, shade, size, points=points, parts=parts, n=n)
        beside = [at(colored, shift=shift) for shift in ((_BESIDE, 0.0), (0.0, _BESIDE))]
        weight = 1 / jnp.maximum(points.seen[parts.place], 1).astype(hard.dtype)

        def means(values: list[Array]) -> Array:
            given = dict(zip(moving, values, strict=True))
            moved = jax.tree.unflatten(tree, [given.get(i, leaf) for i, leaf in enumerate(leaves)])
            colors = at(moved)
            share = _share_of_change(lax.stop_gradient(colors), beside, around)
            return _sums(colors, points, parts, n, weight, share)

        return parts.place, means, [leaves[i] for i in moving]

    def over_batches_of(fixed: Any, step: Callable[[Array, Any], Any], start: Any) -> Any:
        chosen = fixed[1].chosen
        return over_parts(chosen, chosen.moving_parts, step, start)

    def push(fixed: Any, changes: list[Array], nothing: Array) -> Array:
        def step(n: Array, total: Array) -> Array:
            place, means, at = of_batch(fixed, n)
            return total.at[place].add(jax.jvp(means, (at,), (changes,))[1])

        return over_batches_of(fixed, step, nothing)

    def pull(fixed: Any, cotangent: Array) -> list[Array]:
        def step(n: Array, total: list[Array]) -> list[Array]:
            place, means, at = of_batch(fixed, n)
            (back,) = jax.vjp(means, at)[1](cotangent[place])
            return jax.tree.map(jnp.add, total, back)

        start = [linear_zeros(leaves[i].shape, cotangent) for i in moving]
        return over_batches_of(fixed, step, start)

    def over(function: Callable[..., Any]) -> Callable[..., Any]:
        return over_views(function, size[0] * size[1])

    return linear_map(
        lambda changes, nothing: over(push)(fixed, changes, nothing),
        lambda cotangent: over(pull)(fixed, cotangent),
        list(moving.values()),
        _nothing(colored, points),
    )


def _nothing(colored: tuple[Any, Drawn], points: PointsWithin) -> Array:
    return jnp.zeros((points.chosen.number.size, 3), colored[1].positions_clip.dtype)


def _colors(
    shade: Shade,
    size: tuple[int, int],
    colored: tuple[Any, Drawn],
    points: PointsWithin,
    parts: Parts,
    n: Array,
    shift: tuple[float, float] = (0.0, 0.0),
) -> list[Float[Array, "points some"]]:
    """The colours at the points of parts of the batch `n`, all shifted to the right and down."""
    data, drawn = colored
    row, column = divided(points.chosen.number[parts.place], size[1])
    face = faces_of(points, parts, n)
    full = size[0] + 2, size[1] + 2
    pixels = pixels_at(face, row + 1, column + 1, full, drawn.positions_clip.dtype)
    moved = POINTS + np.array(shift, np.float32)[:, None, None]
    right, down = jnp.asarray(moved, pixels.x.dtype)[:, :, parts.points]
    x, y = pixels.x + 2 * right, pixels.y - 2 * down
    flat, x, y = stored_together([part.reshape(-1) for part in (face, x, y)])
    # Stored, and the colours: in what repeats rows no loop is vectorised.
    lit = jax.tree.map(lambda part: jnp.tile(part[parts.place], face.shape[0]), points.reached)
    lit = stored(lit)
    seen = points_at(drawn, pixels._replace(face=flat, x=x, y=y))
    return [color.reshape(face.shape) for color in stored(shade(data, seen, lit))]


def _sums(
    colors: list[Float[Array, "points some"]],
    points: PointsWithin,
    parts: Parts,
    n: Array,
    weight: Float[Array, " some"],
    share: Float[Array, "points_but_one some"] | None = None,
) -> Float[Array, "some 3"]:
    """The weighted sums of colours less those at the centres; of what is not seen, edges tell.

    With a share of each point's colour, these are for derivatives alone.
    """
    used = (faces_of(points, parts, n)[1:] >= 0) & parts.exists
    others = [color[1:] if share is None else share * color[1:] for color in colors]
    more = [other - color[0] for other, color in zip(others, colors, strict=True)]
    return jnp.stack([weight * jnp.sum(jnp.where(used, m, 0), axis=0) for m in more], axis=-1)


def _share_of_change(
    colors: list[Float[Array, "points some"]],
    beside: list[list[Float[Array, "points some"]]],
    around: Float[Array, "9 some 3"],
) -> Float[Array, "points_but_one some"]:
    """How much of their change counts at points: less where it is over within less than a pixel.

    The change of a pixel's mean is no more than what its colours differ by while they pass, but
    that at a point is as large as a slope is steep: it is cut to what the colours round the pixel
    allow.

    Args:
        colors: at the points.
        beside: a little to the right of them, and below.
        around: at the 3×3 pixels.
    """
    right, down = (
        reduce(jnp.add, [abs(a - b)[1:] for a, b in zip(aside, colors, strict=True)]) / _BESIDE
        for aside in beside
    )
    steepness = jnp.sqrt(right * right + down * down)
    most = _STEEP * jnp.sum(jnp.max(around, axis=0) - jnp.min(around, axis=0), axis=-1)
    steep = steepness > most
    return stored(jnp.where(steep, most / jnp.where(steep, steepness, 1), 1))
