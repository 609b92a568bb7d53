"""Shading the pixels that see something.

A picture alone is shaded in one go, a large one only if it shows a face. With its derivative there
are hundreds of values for each pixel between faces and colours, more than memory can pass along in
good time: so the image is cut into runs of pixels, runs without a face are left out, and the others
are shaded in batches that stay in cache. A reverse pass goes through the batches again and begins
by repeating each. Very large pictures are shaded so without a derivative, too: temporary memory of
more than 32 MB is given back after each call, and a new one costs more than the shading.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Int

from diffrast._device import draws_on_cpu
from diffrast._selection import compacted
from diffrast._stored import stored, zero_after
from diffrast._varying import varying_alike, varying_zero
from diffrast.geometry import Points, points_at, visible_points
from diffrast.light import Columns
from diffrast.raster.evaluate import Drawn, Pixels, carry, pixels_at, scaled
from diffrast.shadows import Reached

RUN = 32  # pixels
RUNS_AT_ONCE = 1024
LARGE = 90_000  # pixels: what smaller images need is fast to store
VERY_LARGE = 5 << 16  # pixels: the same without a derivative


class _Runs(NamedTuple):
    """The runs of an image's pixels, row by row, that hold something."""

    chosen: Int[Array, " places"]  # numbers of runs, ascending; behind the last one of no run
    total: Int[Array, ""]  # that hold something


class _Inputs(NamedTuple):
    """Arguments of `shade_covered`."""

    data: Any
    drawn: Drawn
    face: Int[Array, "height width"]
    reached: Reached
    background: Columns
    points: Points | None


Shade: TypeAlias = Callable[[Any, Points, Reached], Columns]


def shade_covered(
    shade: Shade,
    data: Any,
    drawn: Drawn,
    face: Int[Array, "height width"],
    reached: Reached,
    background: Columns,
    *,
    in_batches: bool,
    points: Points | None = None,
) -> Columns:
    """Colours of the pixels that see a face and of those that see the background, in whole images.

    Args:
        shade: colours of points, one array a channel; its first argument is `data`.
        data: a tree of all arrays that it uses. Differentiated in batches, each array costs a pass
            over it for every batch.
        drawn: what is drawn.
        face: that each pixel sees, -1 for none.
        reached: by each light, 1 or 0; images.
        background: numbers or images.
        in_batches: whether large images, or their derivatives, may be.
        points: what the pixels see, if that is known: without attributes and without a derivative.
    """
    inputs = _Inputs(data, drawn, face, reached, background, points)
    if not comes_held(face, in_batches):
        return _in_one_go(shade, inputs._replace(points=None))

    @jax.custom_jvp
    def colors(inputs: _Inputs) -> Columns:
        def shaded(inputs: _Inputs) -> Columns:
            way = _in_batches if face.size > VERY_LARGE else _in_one_go
            zero = varying_zero(inputs)
            return [c + zero.astype(c.dtype) for c in way(shade, inputs)]

        seen = jnp.max(inputs.face) >= 0
        return lax.cond(seen, shaded, _background_alone, inputs)

    def derivative(primals: Any, tangents: Any) -> tuple[Columns, Columns]:
        leaves, tree = jax.tree.flatten(primals[0])
        changes = jax.tree.leaves(tangents[0])
        moving = [i for i, change in enumerate(changes) if not isinstance(change, SymbolicZero)]

        def of_moving(*values: Array) -> Columns:
            given = dict(zip(moving, values, strict=True))
            parts = [given.get(i, leaf) for i, leaf in enumerate(leaves)]
            return _in_batches(shade, jax.tree.unflatten(tree, parts))

        return jax.jvp(of_moving, [leaves[i] for i in moving], [changes[i] for i in moving])

    colors.defjvp(derivative, symbolic_zeros=True)
    return colors(inputs)


def comes_held(face: Array, in_batches: bool) -> bool:
    """Whether the colours of `shade_covered` come out of a condition: each in a buffer."""
    return in_batches and face.size > LARGE and draws_on_cpu()


def _in_one_go(shade: Shade, inputs: _Inputs) -> Columns:
    points = inputs.points or visible_points(inputs.drawn, inputs.face)
    if not draws_on_cpu():
        # The derivatives of shading and of what is seen would become one kernel, with more sums
        # and images than a GPU has registers for.
        position, normal = map(lax.optimization_barrier, (points.position, points.normal))
        points = points._replace(position=position, normal=normal)
    colors = shade(inputs.data, points, inputs.reached)
    return _before_background(colors, inputs)


def _background_alone(inputs: _Inputs) -> Columns:
    zero = varying_zero(inputs).astype(inputs.background[0].dtype)
    return _before_background([zero] * 3, inputs)


def _before_background(colors: Columns, inputs: _Inputs) -> Columns:
    numbers = [leaf for leaf in jax.tree.leaves(inputs) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    dtype = jnp.result_type(*numbers)
    pairs = zip(colors, inputs.background, strict=True)
    return [jnp.where(inputs.face >= 0, c, behind).astype(dtype) for c, behind in pairs]


def _in_batches(shade: Shade, inputs: _Inputs) -> Columns:
    data, drawn, face, reached = inputs[:4]
    runs, seen = _covered_runs(face), face.reshape(-1)
    # Held for the reverse pass: a byte each.
    parts = jax.tree.map(lambda part: _taken(_in_runs(part > 0, False), runs), reached)
    # What vertices move is collected by faces: of few in every batch, of many in one go.
    many = drawn.faces.shape[0] > RUN * RUNS_AT_ONCE
    drawn = drawn._replace(scaled=scaled(drawn.positions_clip))
    data, drawn, seen, parts, runs = varying_alike((data, drawn, seen, parts, runs))
    dtype = drawn.positions_clip.dtype

    def pixels_of(chosen: Array) -> Pixels:
        number = chosen[..., None] * RUN + jnp.arange(RUN)
        number = number.reshape(*chosen.shape[:-1], -1)
        own = seen.at[number].get(mode="fill", fill_value=-1)
        pixels = pixels_at(own, *jnp.divmod(number, face.shape[1]), face.shape, dtype)
        return pixels._replace(x=stored(pixels.x), y=stored(pixels.y))

    chosen = runs.chosen.reshape(-1, RUNS_AT_ONCE)
    carried = carry(drawn, pixels_of(chosen)) if many else None

    def shade_batch(batch: Any) -> Columns:
        _, chosen, carried, reached = batch
        reached = jax.tree.map(lambda part: part.astype(dtype), reached)
        return shade(data, points_at(drawn, pixels_of(chosen), carried), reached)

    def no_colors(batch: Any) -> Columns:
        return [jnp.zeros(RUNS_AT_ONCE * RUN, dtype) + 0 * runs.total] * 3

    # The reverse pass repeats a batch in one condition and transposes it in another; what the
    # first hands to the second is copied. With a checkpoint of its own that is no value in
    # between, but all tables that the batch reads: less where there are few faces.
    again = shade_batch if many else jax.checkpoint(shade_batch, prevent_cse=False)

    def step(batch: Any) -> Columns:
        return lax.cond(batch[0] < runs.total, again, no_colors, batch)

    first = jnp.arange(chosen.shape[0]) * RUNS_AT_ONCE + 0 * runs.total
    colors = lax.map(jax.checkpoint(step, prevent_cse=False), (first, chosen, carried, parts))
    return _before_background([_put_back(color, runs, face.shape) for color in colors], inputs)


def _covered_runs(face: Array) -> _Runs:
    in_runs = _in_runs(face, -1)
    covered = jnp.max(in_runs, axis=1) >= 0
    count = covered.shape[0]
    number = jnp.arange(-(-count // RUNS_AT_ONCE) * RUNS_AT_ONCE)
    chosen, total = compacted(covered, jnp.arange(count, dtype=jnp.int32))
    chosen = jnp.pad(chosen, (0, number.size - count))
    return _Runs(jnp.where(number < total, chosen, count + number), total)


def _in_runs(image: Array, fill: float) -> Array:
    size = -(-image.size // RUN) * RUN
    flat = jnp.pad(image.reshape(-1), (0, size - image.size), constant_values=fill)
    return flat.reshape(-1, RUN)


def _taken(in_runs: Array, runs: _Runs) -> Array:
    taken = in_runs.at[runs.chosen].get(mode="fill", fill_value=0)
    return taken.reshape(-1, RUNS_AT_ONCE * RUN)


def _put_back(values: Array, runs: _Runs, shape: tuple[int, ...]) -> Array:
    size = shape[0] * shape[1]
    rows = jnp.zeros((-(-size // RUN), RUN), values.dtype) + zero_after(values[0, 0])
    # The transpose of an addition is a gather, which needs no zeros to begin with.
    rows = rows.at[runs.chosen].add(
        values.reshape(-1, RUN), mode="drop", indices_are_sorted=True, unique_indices=True
    )
    return rows.reshape(-1)[:size].reshape(shape)
