"""Where on its face a pixel looks, and what is there; with the derivative of both.

With vertices moved so that the pixel's ray is the axis, X_i = x_i - px w_i and Y_i = y_i - py w_i,
the edge function e_0 = X_1 Y_2 - X_2 Y_1 is proportional to the perspective-correct barycentric
coordinate of corner 0, and so on in turn, for every sign of w. Nothing is divided before the sum.

When the point that a pixel sees moves with its face by (u, v) in these coordinates, the pixel sees
another point of the face: sum X_i db_i = -u, sum Y_i db_i = -v, sum db_i = 0. So the derivative
asks for the motion of one point a pixel. What a camera adds to it, and the transforms of a few
objects (`Placed`), is summed over the picture; only what vertices do on their own (`carry`) is
collected by faces.
"""

from collections.abc import Callable
from functools import partial, reduce
from operator import add
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float, Int

from diffrast._stored import stored
from diffrast._varying import varying_zero

Columns: TypeAlias = list[Array]  # one array a component, or a corner


class Projection(NamedTuple):
    """The linear map that makes clip positions of world positions."""

    matrix: Float[Array, "3 4"]  # to clip x, y and w, of positions relative to the pivot
    pivot: Float[Array, "3"]  # not differentiable


class Placement(NamedTuple):
    """What an object's transform does."""

    positions: Float[Array, "3 4"]
    normals: Float[Array, "3 3"] | None  # before they are normalised; None without normals


class Placed(NamedTuple):
    """How world positions and normals, the first two attributes, come from those of the objects.

    Derivatives are then taken by the placements and, for fixed ones, by the vertices.
    """

    placements: tuple[Placement, ...]  # of each object
    object_of_face: Int[Array, " F"]
    positions: Float[Array, "V 3"]  # of the objects
    normals: Float[Array, "V 3"] | None  # of a length that placing them makes one
    attributes: tuple[Float[Array, "V _"], ...]  # those drawn; placements have no derivative


class Scaled(NamedTuple):
    """Clip positions in units of about the largest of them, a power of two."""

    columns: list[Float[Array, " V"]]  # x, y, w
    unit: Float[Array, ""]


class Drawn(NamedTuple):
    """What is drawn.

    With a projection the first of the attributes are the world positions of which it makes the clip
    positions, and derivatives are taken by these and by its matrix.
    """

    positions_clip: Float[Array, "V 4"]
    faces: Int[Array, "F 3"]
    attributes: tuple[Float[Array, "V _"], ...] = ()
    projection: Projection | None = None
    placed: Placed | None = None  # only with a projection
    scaled: Scaled | None = None  # of the clip positions, if they are known already


class Pixels(NamedTuple):
    """Where to look: pixels of an image of this height and width."""

    face: Int[Array, "*size"]  # that is seen there, -1 for none
    x: Float[Array, "..."]  # of their centres, in half pixels to the right of the image's centre
    y: Float[Array, "..."]  # likewise, upwards: integers, whose products are exact
    height: Float[Array, ""]
    width: Float[Array, ""]


class Evaluated(NamedTuple):
    """What pixels see, zeros where there is no face; arrays of their shape."""

    barycentrics: Columns
    inverse_depth: Array
    attributes: tuple[Columns, ...]


class Carried(NamedTuple):
    """Zeros that change as values do at fixed points of the faces: all of what vertices move."""

    clip: Columns  # x, y and w; empty with a projection
    attributes: tuple[Columns, ...]


class _Seen(NamedTuple):
    """The faces that pixels see; corners relative to the pixels' rays, in a common unit."""

    corners: Columns
    x: Columns
    y: Columns
    w: Columns
    unit: Array
    inverse_total: Array  # of the edge functions
    barycentrics: Columns
    inverse_depth: Array


def all_pixels(face: Int[Array, "height width"], dtype: jnp.dtype) -> Pixels:
    """Those of a whole image."""
    rows, columns = (jnp.arange(size) for size in face.shape)
    return pixels_at(face, rows[:, None], columns[None, :], face.shape, dtype)


def pixels_at(
    face: Array, row: Array, column: Array, shape: tuple[int, ...], dtype: jnp.dtype
) -> Pixels:
    """Pixels in these rows and columns of an image of this height and width."""
    height, width = shape
    x, y = (2 * column + 1 - width).astype(dtype), (height - 1 - 2 * row).astype(dtype)
    return Pixels(face, x, y, jnp.asarray(height, dtype), jnp.asarray(width, dtype))


def evaluate(drawn: Drawn, pixels: Pixels, carried: Carried | None = None) -> Evaluated:
    """What pixels see; differentiable in positions, attributes and projection.

    `carried` is what `carry` gives for these pixels, by whatever way; found here if there is none.
    """
    return _evaluate(drawn, pixels, carry(drawn, pixels) if carried is None else carried)


@jax.custom_jvp
def carry(drawn: Drawn, pixels: Pixels) -> Carried:
    """The changes of `Carried`."""
    dtype = drawn.positions_clip.dtype
    zeros = jnp.zeros(pixels.face.shape, dtype) + varying_zero((drawn, pixels)).astype(dtype)
    clip = [] if drawn.projection else [zeros] * 3
    return Carried(clip, tuple([zeros] * a.shape[1] for a in drawn.attributes))


@partial(carry.defjvp, symbolic_zeros=True)
def _carry_derivative(primals: Any, tangents: Any) -> tuple[Carried, Carried]:
    """Taken from faces, not from vertices: the transpose adds up all pixels that see a face.

    But not of fewer pixels than there are faces.
    """
    (drawn, pixels), (change, _) = primals, tangents
    faces, face = drawn.faces, pixels.face
    barycentrics = evaluate(drawn, pixels).barycentrics
    visible = jnp.where(face >= 0, face, faces.shape[0])
    witness = faces[:, 0].astype(drawn.positions_clip.dtype)
    zero = varying_zero((drawn, pixels))

    def change_of(column: Array) -> Array:
        if face.size < faces.shape[0]:
            at = [jnp.where(face >= 0, column[corner], 0) for corner in corners_at(faces, face)]
            return blend(barycentrics, at) + zero.astype(column.dtype)
        corners = [stored(column[faces[:, j]], witness) for j in range(3)]
        at = [corner.at[visible].get(mode="fill", fill_value=0) for corner in corners]
        return blend(barycentrics, at) + zero.astype(column.dtype)

    def changes(values: Any, zeros: Columns, columns: tuple[int, ...] | range) -> Any:
        if isinstance(values, SymbolicZero):
            return [SymbolicZero.from_primal_value(zero) for zero in zeros]
        return [change_of(values[:, c]) for c in columns]

    out = carry(drawn, pixels)
    clip = changes(change.positions_clip, out.clip, (0, 1, 3)) if out.clip else []
    values = change.attributes if drawn.placed is None else change.placed.attributes
    attributes = tuple(
        changes(values, zeros, range(len(zeros)))
        for values, zeros in zip(values, out.attributes, strict=True)
    )
    return out, Carried(clip, attributes)


@jax.custom_jvp
def _evaluate(drawn: Drawn, pixels: Pixels, carried: Carried) -> Evaluated:
    del carried  # which is zero
    seen = _see(drawn, pixels)
    columns = tuple(
        [blend(seen.barycentrics, corners) for corners in at_corners]
        for at_corners in _at_corners(drawn.attributes, seen)
    )
    return Evaluated(seen.barycentrics, seen.inverse_depth, columns)


@partial(_evaluate.defjvp, symbolic_zeros=True)
def _derivative(primals: Any, tangents: Any) -> tuple[Evaluated, Evaluated]:
    (drawn, pixels, _), (d_drawn, _, carried) = primals, tangents
    found = _evaluate(*primals)
    seen = _see(drawn, pixels)
    along = [None if isinstance(c[0], SymbolicZero) else c for c in carried.attributes]
    if drawn.placed is not None:
        moved = _moved(drawn, d_drawn.placed.placements, seen, pixels)
        along = [_sum_of(own, other) for own, other in zip(along, moved, strict=True)]
    if drawn.projection is not None:
        motion = _projected(drawn.projection, d_drawn.projection, found.attributes[0], along[0])
    else:
        motion = None if isinstance(carried.clip[0], SymbolicZero) else carried.clip
    if motion is None:
        zeros = jnp.zeros_like(found.inverse_depth)
        columns = [c or [zeros] * len(f) for c, f in zip(along, found.attributes, strict=True)]
        return found, Evaluated([zeros] * 3, zeros, tuple(columns))
    motion = stored([part / seen.unit for part in motion], found.inverse_depth)
    d1, d2 = stored(_slide(seen, pixels, motion), found.inverse_depth)
    approach = motion[2] + d1 * (seen.w[1] - seen.w[0]) + d2 * (seen.w[2] - seen.w[0])
    inverse = found.inverse_depth
    changes = []
    for own, at_corners in zip(along, _at_corners(drawn.attributes, seen), strict=True):
        slid = [d1 * (second - first) + d2 * (third - first) for first, second, third in at_corners]
        changes.append(slid if own is None else [a + b for a, b in zip(own, slid, strict=True)])
    d_inverse_depth = -inverse * (inverse * seen.unit) * approach
    return found, Evaluated([-(d1 + d2), d1, d2], d_inverse_depth, tuple(changes))


def _see(drawn: Drawn, pixels: Pixels) -> _Seen:
    corners = corners_at(drawn.faces, pixels.face)
    (x_vertex, y_vertex, w_vertex), unit = drawn.scaled or scaled(drawn.positions_clip)
    w = [w_vertex[corner] for corner in corners]
    x = [_offset(x_vertex[corners[j]], w[j], pixels.width, pixels.x) for j in range(3)]
    y = [_offset(y_vertex[corners[j]], w[j], pixels.height, pixels.y) for j in range(3)]
    edge = [
        x[1] * y[2] - x[2] * y[1],
        x[2] * y[0] - x[0] * y[2],
        x[0] * y[1] - x[1] * y[0],
    ]
    total = edge[0] + edge[1] + edge[2]
    valid = (pixels.face >= 0) & (total != 0)
    inverse_total = jnp.where(valid, 1, 0) / jnp.where(valid, total, 1)
    barycentrics = stored([e * inverse_total for e in edge])
    depth = blend(barycentrics, w)
    positive = valid & (depth > 0)
    inverse_depth = jnp.where(positive, 1 / unit, 0) / jnp.where(positive, depth, 1)
    return _Seen(corners, x, y, w, unit, inverse_total, barycentrics, inverse_depth)


def _at_corners(attributes: tuple[Array, ...], seen: _Seen) -> list[list[Columns]]:
    """For each attribute, for each of its columns, the values at the three corners."""
    return [
        [[values[:, c][corner] for corner in seen.corners] for c in range(values.shape[1])]
        for values in attributes
    ]


def _moved(
    drawn: Drawn, changes: tuple[Placement, ...], seen: _Seen, pixels: Pixels
) -> list[Columns | None]:
    """How world position and normal of fixed points change as objects are placed elsewhere."""
    placed, b = drawn.placed, seen.barycentrics
    assert placed is not None
    covered = pixels.face >= 0
    several = len(changes) > 1
    object_of = placed.object_of_face[jnp.maximum(pixels.face, 0)] if several else 0

    def of_each(matrices: list[Any], change_by: Callable[[Any], Columns]) -> Columns | None:
        """The change by the matrix of the object that a pixel sees, of those that change."""
        known = {k: m for k, m in enumerate(matrices) if not isinstance(m, SymbolicZero)}
        if not known:
            return None
        number = np.array(list(known), np.int32).reshape(-1, *[1] * pixels.face.ndim)
        here = covered & (object_of == number)
        if len(known) == 1:
            (matrix,), (moves,) = known.values(), here
        else:  # a product, whose transpose sums over the picture for all of them at once
            shares, moves = stored(here.astype(seen.inverse_depth.dtype)), covered
            every = jnp.stack(list(known.values()), axis=-1)
            # Of what is out of sight the change may be no number.
            every = jnp.where(jnp.any(here.reshape(len(known), -1), axis=1), every, 0)
            matrix = jnp.tensordot(every, shares, 1, precision=lax.Precision.HIGHEST)
        change = [jnp.where(moves, part, 0) for part in change_by(matrix)]
        return stored(change, seen.inverse_depth)

    (at_corners,) = _at_corners((placed.positions,), seen)
    position = stored([blend(b, corners) for corners in at_corners])
    moved = [
        of_each(
            [change.positions for change in changes],
            lambda matrix: [_along(row, position) + row[3] for row in matrix],
        )
    ]
    if placed.normals is None:
        return moved
    own, normals = stored(_at_corners((placed.normals, drawn.attributes[1]), seen))
    shares = stored([[b[j] * column[j] for column in own] for j in range(3)])

    def turned(matrix: Array) -> Columns:
        """Of a unit vector only the change across it is left."""
        parts, shape = [], seen.inverse_depth.shape
        # Spread once: the derivative by the matrix is then summed once, over all corners.
        spread = [[jnp.broadcast_to(number, shape) for number in row] for row in matrix]
        for j in range(3):
            change = stored([_along(row, shares[j]) for row in spread], seen.inverse_depth)
            normal = [column[j] for column in normals]
            length = _along(change, normal)
            parts.append([c - length * n for c, n in zip(change, normal, strict=True)])
        return [reduce(add, column) for column in zip(*parts, strict=True)]

    return [*moved, of_each([change.normals for change in changes], turned)]


def _sum_of(*parts: Columns | None) -> Columns | None:
    """Columns added up; None of nothing."""
    known = [part for part in parts if part is not None]
    return [reduce(add, columns) for columns in zip(*known, strict=True)] or None


def _projected(
    projection: Projection, change: Projection, position: Columns, carried: Columns | None
) -> Columns | None:
    """How the clip x, y and w of what pixels see change with its world position and the camera."""
    terms: list[Columns] = []
    if not isinstance(change.matrix, SymbolicZero):
        relative = [p - pivot for p, pivot in zip(position, projection.pivot, strict=True)]
        terms.append([_along(row, relative) + row[3] for row in change.matrix])
    if carried is not None:
        terms.append([_along(row, carried) for row in projection.matrix])
    return _sum_of(*terms)


def _along(row: Array | Columns, vector: Columns) -> Array:
    return row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2]


def _slide(seen: _Seen, pixels: Pixels, motion: Columns) -> tuple[Array, Array]:
    """How the second and the third barycentric coordinate change if the face moves under a ray."""
    u = (pixels.width * motion[0] - pixels.x * motion[2]) * -seen.inverse_total
    v = (pixels.height * motion[1] - pixels.y * motion[2]) * -seen.inverse_total
    u, v = stored((u, v), seen.inverse_depth)
    x, y = seen.x, seen.y
    return (y[2] - y[0]) * u + (x[0] - x[2]) * v, (y[0] - y[1]) * u + (x[1] - x[0]) * v


def blend(barycentrics: Columns, values: Columns) -> Array:
    """The value on faces between those at their corners."""
    return barycentrics[0] * values[0] + barycentrics[1] * values[1] + barycentrics[2] * values[2]


def corners_at(faces: Int[Array, "F 3"], face: Int[Array, "*size"]) -> list[Int[Array, "*size"]]:
    """Vertices of the visible faces, one array a corner; those of face 0 on the background."""
    visible = jnp.maximum(face, 0)
    return [faces[:, j][visible] for j in range(3)]


def scaled(positions_clip: Float[Array, "V 4"]) -> Scaled:
    """Clip positions in units in which products stay in range, see `unit_of`.

    Positions that are not finite become zero: no visible face has them, but the background
    evaluates face 0.
    """
    finite = jnp.all(jnp.isfinite(positions_clip), axis=1)
    unit = unit_of(positions_clip)
    return Scaled([jnp.where(finite, positions_clip[:, i], 0) / unit for i in (0, 1, 3)], unit)


def unit_of(points: Float[Array, "V columns"]) -> Float[Array, ""]:
    """A power of two, by which coordinates are divided without rounding, to be two at most."""
    finite = jnp.all(jnp.isfinite(points), axis=1, keepdims=True)
    largest = jnp.max(jnp.abs(jnp.where(finite, lax.stop_gradient(points), 0)))
    return jnp.ldexp(jnp.ones_like(largest), jnp.frexp(largest)[1] - 1)


def _offset(numerator: Array, w: Array, size: Array, centre: Array) -> Array:
    """`size * numerator - centre * w`: twice the distance from the ray, in pixels times w.

    Cancels heavily for small triangles. The high halves have products without rounding error, so
    their difference has none that matters either.
    """
    high, low = _halves(numerator)
    w_high, w_low = _halves(w)
    return (size * high - centre * w_high) + (size * low - centre * w_low)


def _halves(values: Array) -> tuple[Array, Array]:
    """A part with 11 significant bits, whose multiples by image sizes are exact, and the rest."""
    stopped = lax.stop_gradient(values)
    format_ = jnp.finfo(values.dtype)
    high = lax.reduce_precision(stopped, format_.nexp, format_.nmant - 13)
    return high, values - high
