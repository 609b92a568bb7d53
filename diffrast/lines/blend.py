"""Anti-aliased lines added up over the image, and the derivative of the sum in both directions.

Every line has a band of pixels: at each step along its longer side, from before its start to
behind its end, the few across that a rectangle of its width can touch. To each the line adds its
values times the area it covers there. Bands are numbered through and worked off a chunk at a time
until none is left.

JAX can differentiate the terms but not a loop of unknown length backwards. The derivative is linear
in the tangents, so it is written as a linear system whose solution, and that of its transpose, are
such loops again (as in `edges.derivative`).
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._linear import linear_map, linear_zeros, without_known_zeros
from diffrast._selection import batches_of
from diffrast.lines.hidden import Surface, hides
from diffrast.lines.overlap import coverage
from diffrast.lines.pixels import (
    LINES_AT_ONCE,
    blocks_of,
    lines_of_steps,
    number_steps,
)
from diffrast.lines.segments import Segments

STEPS_AT_ONCE = 1 << 14
_SLACK = 0.01  # of a pixel, for bounds of bands that are found in floating point


class Band(NamedTuple):
    """The steps of lines along their longer sides; one entry a line."""

    steps: Int[Array, "*lines"]  # steps in the image; 0 for lines not seen
    first: Int[Array, "*lines"]  # pixel along of the first
    steep: Bool[Array, "*lines"]
    along: Float[Array, "*lines"]  # of the start, in pixels
    across: Float[Array, "*lines"]
    slope: Float[Array, "*lines"]  # across over along
    key: Float[Array, "*lines"]  # depth at the start
    key_slope: Float[Array, "*lines"]  # per pixel along
    key_range: tuple[Float[Array, "*lines"], Float[Array, "*lines"]]
    reach: tuple[Float[Array, "*lines"], Float[Array, "*lines"]]  # pixels along, of both ends


class Frame(NamedTuple):
    """What is known before anything is computed."""

    height: int
    width: int
    line_width: float

    @property
    def pixels(self) -> int:
        """Their number."""
        return self.height * self.width

    @property
    def across(self) -> int:
        """Pixels of a step that a line can touch: its width and a slope of 45 degrees."""
        return math.ceil(math.sqrt(2) * self.line_width + 1 + 2 * _SLACK) + 1


class Terms(NamedTuple):
    """Lines and pixels that belong together."""

    line: Int[Array, " n"]
    place: Int[Array, " n"]  # pixel, row after row; the number of pixels where there is none
    centre: Float[Array, "n 2"]


@partial(jax.jit, static_argnames=("height", "width", "line_width"))
def add_lines(
    segments: Segments,
    values: Float[Array, "lines channels"],
    surface: Surface | None,
    *,
    height: int,
    width: int,
    line_width: float,
) -> Float[Array, "height width channels"]:
    """Sum over lines of their values times the share of each pixel that they cover.

    Differentiable in the segments' ends and in the values; the second derivative is left out.
    """
    frame = Frame(height, width, line_width)

    @jax.custom_jvp
    def total(ends: Array, values: Array, rest: Any) -> Array:
        return jax.custom_batching.sequential_vmap(partial(_total, frame))(ends, values, rest)

    def derivative(primals: Any, tangents: Any) -> tuple[Array, Array]:
        ends, values, rest = lax.stop_gradient(primals)
        d_ends, d_values = without_known_zeros(tangents[:2])
        return total(*primals), _apply_linear(frame, (ends, values, rest), d_ends, d_values)

    total.defjvp(derivative, symbolic_zeros=True)
    ends = jnp.concatenate([segments.start, segments.end], axis=1)
    image = total(ends, values, lax.stop_gradient((segments, surface)))
    return image.reshape(height, width, -1)


def _term(ends: Array, values: Array, centre: Array, line_width: float) -> Array:
    """What lines add to pixels."""
    return coverage(ends[:, :2], ends[:, 2:], centre, line_width)[:, None] * values


def _total(frame: Frame, ends: Array, values: Array, rest: Any) -> Array:
    def add(image: Array, at: Terms) -> Array:
        term = _term(ends[at.line], values[at.line], at.centre, frame.line_width)
        return image.at[at.place].add(term, mode="drop")

    image = linear_zeros((frame.pixels, values.shape[1]), values)
    return _over_terms(frame, rest, add, image)


def _push(
    frame: Frame, ends: Array, values: Array, rest: Any, d_ends: Array, d_values: Array
) -> Array:
    """Change of the image with the lines' ends and values."""

    def add(image: Array, at: Terms) -> Array:
        def term(ends: Array, values: Array) -> Array:
            return _term(ends, values, at.centre, frame.line_width)

        here = ends[at.line], values[at.line]
        _, change = jax.jvp(term, here, (d_ends[at.line], d_values[at.line]))
        return image.at[at.place].add(change, mode="drop")

    image = linear_zeros((frame.pixels, values.shape[1]), d_values)
    return _over_terms(frame, rest, add, image)


def _pull(
    frame: Frame, ends: Array, values: Array, rest: Any, cotangent: Array
) -> tuple[Array, Array]:
    """The transpose of `_push`."""

    def add(state: tuple[Array, Array], at: Terms) -> tuple[Array, Array]:
        def term(ends: Array, values: Array) -> Array:
            return _term(ends, values, at.centre, frame.line_width)

        inside = at.place < frame.pixels
        weight = jnp.where(inside[:, None], cotangent[jnp.minimum(at.place, frame.pixels - 1)], 0)
        d_ends, d_values = jax.vjp(term, ends[at.line], values[at.line])[1](weight)
        return state[0].at[at.line].add(d_ends), state[1].at[at.line].add(d_values)

    start = linear_zeros(ends.shape, cotangent), linear_zeros(values.shape, cotangent)
    return _over_terms(frame, rest, add, start)


def _apply_linear(
    frame: Frame, at: tuple[Array, Array, Any], d_ends: Array, d_values: Array
) -> Array:
    """`_push`, of which JAX knows both directions."""
    push, pull = (
        jax.custom_batching.sequential_vmap(partial(way, frame)) for way in (_push, _pull)
    )
    return linear_map(
        lambda changes, nothing: nothing + push(*at, *changes),
        lambda cotangent: pull(*at, cotangent),
        (d_ends, d_values),
        jnp.zeros((frame.pixels, d_values.shape[1]), d_values.dtype),
    )


# Bands --------------------------------------------------------------------------------------------


def _over_terms(
    frame: Frame,
    rest: tuple[Segments, Surface | None],
    add: Callable[[Any, Terms], Any],
    state: Any,
) -> Any:
    """Go once through all pixels of all bands, and add what they have to a state."""
    segments, surface = rest
    bands, block = blocks_of(_bands(frame, segments), segments.seen.shape[0], LINES_AT_ONCE)

    def in_block(n: Array, state: Any) -> Any:
        own = jax.tree.map(lambda column: column[n], bands)
        numbering = number_steps(own.steps)

        def in_chunk(chunk: Array, state: Any) -> Any:
            line, number, exists = lines_of_steps(numbering, chunk, STEPS_AT_ONCE)
            band = jax.tree.map(lambda column: column[line], own)
            row, column = _pixels(frame, band, number)
            inside = exists[:, None] & (row >= 0) & (row < frame.height)
            inside = inside & (column >= 0) & (column < frame.width)
            place = jnp.where(inside, row * frame.width + column, frame.pixels)
            if surface is not None:
                hidden = _hidden(frame, surface, band, number)
                place = jnp.where(hidden[:, None], frame.pixels, place)
            centre = jnp.stack([column, row], axis=-1).astype(band.along.dtype) + 0.5
            lines = jnp.broadcast_to((n * block + line)[:, None], place.shape)
            last = segments.seen.shape[0] - 1
            terms = Terms(
                jnp.minimum(lines, last).reshape(-1), place.reshape(-1), centre.reshape(-1, 2)
            )
            return add(state, terms)

        return lax.fori_loop(0, batches_of(numbering.total, STEPS_AT_ONCE), in_chunk, state)

    return lax.fori_loop(0, bands.steps.shape[0], in_block, state)


def _bands(frame: Frame, segments: Segments) -> Band:
    """Where the lines' rectangles can be."""
    change = segments.end - segments.start
    steep = jnp.abs(change[:, 1]) > jnp.abs(change[:, 0])

    def axis(points: Array, along: bool) -> Array:
        return jnp.where(steep == along, points[:, 1], points[:, 0])

    start, end = axis(segments.start, True), axis(segments.end, True)
    length, drift = axis(change, True), axis(change, False)
    exists = segments.seen & (length != 0)
    safe = jnp.where(exists, length, 1)
    slope = jnp.where(exists, drift, 0) / safe
    # A corner is off the end by half the width times the sine of the angle.
    margin = frame.line_width / 2 * jnp.abs(slope) / jnp.sqrt(1 + slope * slope) + _SLACK
    size = jnp.where(steep, frame.height, frame.width)
    bound = size.astype(start.dtype)
    first = jnp.floor(jnp.clip(jnp.minimum(start, end) - margin, -1, bound)).astype(jnp.int32)
    last = jnp.floor(jnp.clip(jnp.maximum(start, end) + margin, -1, bound)).astype(jnp.int32)
    first, last = jnp.maximum(first, 0), jnp.minimum(last, size - 1)
    keys = segments.keys
    return Band(
        steps=jnp.where(exists, jnp.maximum(last - first + 1, 0), 0),
        first=first,
        steep=steep,
        along=start,
        across=axis(segments.start, False),
        slope=slope,
        key=keys[:, 0],
        key_slope=(keys[:, 1] - keys[:, 0]) / safe,
        key_range=(jnp.min(keys, axis=1), jnp.max(keys, axis=1)),
        reach=(jnp.minimum(length, 0), jnp.maximum(length, 0)),
    )


def _pixels(frame: Frame, band: Band, number: Array) -> tuple[Array, Array]:
    """Rows and columns (steps, across) of steps."""
    along = (band.first + number)[:, None]
    half = frame.line_width / math.sqrt(2) + 0.5 + _SLACK
    across = _passed(frame, band, number, -half)[:, None] + jnp.arange(
        frame.across, dtype=jnp.int32
    )
    along, steep = jnp.broadcast_to(along, across.shape), band.steep[:, None]
    return jnp.where(steep, along, across), jnp.where(steep, across, along)


def _hidden(frame: Frame, surface: Surface, band: Band, number: Array) -> Array:
    """Whether a surface lies before lines at the pixels that they pass."""
    along, across = band.first + number, _passed(frame, band, number, 0.0)
    size_along, size_across = (
        jnp.where(band.steep == down, frame.height, frame.width) for down in (True, False)
    )
    along, across = jnp.clip(along, 0, size_along - 1), jnp.clip(across, 0, size_across - 1)
    row, column = jnp.where(band.steep, along, across), jnp.where(band.steep, across, along)
    run = along.astype(band.along.dtype) + 0.5 - band.along
    on_line = jnp.clip(run, *band.reach)
    key = jnp.clip(band.key + on_line * band.key_slope, *band.key_range)
    return hides(surface, row * frame.width + column, key, band.steep, jnp.abs(run - on_line))


def _passed(frame: Frame, band: Band, number: Array, aside: float) -> Array:
    """Pixel across where lines pass the middle of steps, or so much aside."""
    run = (band.first + number).astype(band.along.dtype) + 0.5 - band.along
    bound = 2.0 * (frame.height + frame.width + frame.line_width)  # beyond every image
    passed = jnp.clip(band.across + run * band.slope, -bound, bound) + aside
    return jnp.floor(passed).astype(jnp.int32)
