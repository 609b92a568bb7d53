"""Plain lines: one pixel for every step along the longer side, decided in integers (FEATURES L1).

End points snap to the sub-pixel grid of `raster.fixed_point` (1/1024 pixel up to 8192 pixels). A
line whose longer side is horizontal has one pixel in each column from that of its first point to
that of its second: the one that the line passes where it crosses the column's middle, or at the
line's end, if that comes first. Steep lines likewise, row by row. Where a line passes exactly
between two pixels the one nearer to its start is taken, lines starting at the left, steep ones at
the bottom. For whole-numbered pixels this is the midpoint algorithm (B): its decision variable is
the sign of the same expression, which is evaluated here at every step at once.

The steps of all lines are numbered through and worked off a chunk at a time until none is left, so
memory is bounded and no step is lost.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._selection import batches_of
from diffrast.lines.hidden import Surface, hides
from diffrast.lines.segments import Segments
from diffrast.raster.fixed_point import subpixel_bits

T = TypeVar("T")

LINES_AT_ONCE = 1 << 14
STEPS_AT_ONCE = 1 << 16
_NO_LINE = (1 << 31) - 1
_SURE = 8  # grid steps from a border between pixels within which float32 does not decide
_ROUNDINGS = 8  # of two depth keys that are meant to be equal


class Course(NamedTuple):
    """How lines run over the grid, from their start on; arrays of one entry a line.

    "Along" is the axis of the longer side, "across" the other one.
    """

    steep: Bool[Array, " lines"]
    pixel: Int[Array, " lines"]  # along, of the first pixel in the image
    forward: Int[Array, " lines"]  # 1 or -1: direction along
    steps: Int[Array, " lines"]  # pixels in the image's columns (rows); 0 for lines not seen
    before: Int[Array, " lines"]  # grid steps along from the start to that pixel's middle
    length: Int[Array, " lines"]  # grid steps along from start to end
    across: Int[Array, " lines"]  # pixel across of the start
    aside: Int[Array, " lines"]  # 1 or -1: direction across
    within: Int[Array, " lines"]  # grid steps of the start from its pixel's border, that way
    drift: Int[Array, " lines"]  # grid steps across from start to end
    most: Int[Array, " lines"]  # pixels across from start to end
    key: Float[Array, " lines"]  # depth at the start
    key_change: Float[Array, " lines"]  # to the end


class Step(NamedTuple):
    """Pixels of lines."""

    row: Int[Array, " steps"]
    column: Int[Array, " steps"]
    key: Float[Array, " steps"]
    steep: Bool[Array, " steps"]
    beyond: Float[Array, " steps"]  # pixels along, from the line's end to the pixel's centre


def plan(segments: Segments, *, height: int, width: int) -> Course:
    """Snap lines to the grid and find out how they run."""
    bits = subpixel_bits(height, width)
    # Measured from a pixel border near the image's middle, where float32 is finest.
    middle = np.array([width // 2, height // 2], np.int32)
    grid = [
        jnp.round((p - middle.astype(p.dtype)) * (1 << bits)).astype(jnp.int32)
        for p in lax.stop_gradient((segments.start, segments.end))
    ]
    change = grid[1] - grid[0]
    steep = jnp.abs(change[:, 1]) > jnp.abs(change[:, 0])
    swap = jnp.where(steep, change[:, 1] > 0, change[:, 0] < 0)
    start = jnp.where(swap[:, None], grid[1], grid[0])
    end = jnp.where(swap[:, None], grid[0], grid[1])
    keys = jnp.where(swap[:, None], segments.keys[:, ::-1], segments.keys)

    def axis(points: Array, along: bool) -> Array:
        return jnp.where(steep == along, points[:, 1], points[:, 0])

    a0, a1, c0, c1 = axis(start, True), axis(end, True), axis(start, False), axis(end, False)
    forward, aside = jnp.where(a1 < a0, -1, 1), jnp.where(c1 < c0, -1, 1)
    origin_along, origin_across = (
        jnp.where(steep == along, middle[1], middle[0]) for along in (True, False)
    )
    first, last = (a0 >> bits) + origin_along, (a1 >> bits) + origin_along
    size = jnp.where(steep, height, width)
    # Steps before and after the image are skipped.
    skipped = jnp.where(forward > 0, -first, first - (size - 1))
    skipped = jnp.maximum(skipped, 0)
    left = jnp.where(forward > 0, jnp.minimum(last, size - 1) - first, first - jnp.maximum(last, 0))
    pixel = first + forward * skipped
    centre = ((pixel - origin_along) << bits) + (1 << bits) // 2
    floor = (c0 >> bits) << bits
    return Course(
        steep=steep,
        pixel=pixel,
        forward=forward,
        steps=jnp.where(segments.seen, jnp.maximum(left - skipped + 1, 0), 0),
        before=forward * (centre - a0),
        length=jnp.abs(a1 - a0),
        across=(c0 >> bits) + origin_across,
        aside=aside,
        within=jnp.where(aside > 0, c0 - floor, floor + (1 << bits) - c0),
        drift=jnp.abs(c1 - c0),
        most=jnp.abs((c1 >> bits) - (c0 >> bits)),
        key=keys[:, 0],
        key_change=keys[:, 1] - keys[:, 0],
    )


def step_at(course: Course, line: Array, number: Array, bits: int) -> Step:
    """The pixel of a line's step, `number` pixels on from the first one."""
    at = jax.tree.map(lambda column: column[line], course)
    size = 1 << bits
    centre = at.before + number * size
    run = jnp.clip(centre, 0, at.length)
    safe = jnp.maximum(at.length, 1)
    dtype = at.key.dtype
    share = run.astype(dtype) / safe.astype(dtype)
    passed = at.within.astype(dtype) + run.astype(dtype) * at.drift.astype(dtype) / safe.astype(
        dtype
    )
    border = jnp.round(passed / size).astype(jnp.int32)
    rest = passed - border.astype(dtype) * size
    # Beside a border the sign is that of an exact integer; the products wrap, their difference
    # does not.
    exact = run * at.drift - (border * size - at.within) * at.length
    beyond = jnp.where(jnp.abs(rest) < _SURE, exact > 0, rest > 0)
    pixels = jnp.clip(border - 1 + beyond.astype(jnp.int32), 0, at.most)
    along, across = at.pixel + at.forward * number, at.across + at.aside * pixels
    row, column = jnp.where(at.steep, along, across), jnp.where(at.steep, across, along)
    beyond = jnp.abs(centre - run).astype(dtype) / size
    return Step(row, column, at.key + share * at.key_change, at.steep, beyond)


class Numbering(NamedTuple):
    """The steps of a block of lines, numbered through."""

    first: Int[Array, " lines"]  # number of each line's first step
    total: Int[Array, ""]


def number_steps(count: Array) -> Numbering:
    """Number the steps of lines of which each has `count`."""
    ends = jnp.cumsum(count)
    return Numbering(ends - count, ends[-1])


def lines_of_steps(numbering: Numbering, chunk: Array, size: int) -> tuple[Array, Array, Array]:
    """Line and step within it of a chunk of steps, and whether there is such a step."""
    begin = chunk * size
    begins_before = jnp.sum(numbering.first <= begin, dtype=jnp.int32)
    later = (numbering.first > begin) & (numbering.first < begin + size)
    place = jnp.where(later, numbering.first - begin, size)
    marks = jnp.zeros(size, jnp.int32).at[place].add(1, mode="drop")
    line = begins_before - 1 + jnp.cumsum(marks)
    step = begin + jnp.arange(size, dtype=jnp.int32)
    return line, step - numbering.first[line], step < numbering.total


def blocks_of(lines: T, count: int, size: int) -> tuple[T, int]:
    """Columns of `count` lines in blocks of equal size, along a new axis; and that size.

    The last block is filled up with zeros: lines without steps.
    """
    size = min(size, count)
    blocks = -(-count // size)

    def cut(column: Array) -> Array:
        return jnp.pad(column, (0, blocks * size - count)).reshape(blocks, size)

    return jax.tree.map(cut, lines), size


@partial(jax.jit, static_argnames=("height", "width"))
def last_lines(segments: Segments, *, height: int, width: int) -> Int[Array, "height width"]:
    """Number of the last line that passes through each pixel, -1 where none does."""
    course, over_steps = _steps(segments, None, height, width)

    def add(state: Array, place: Array, line: Array, key: Array) -> Array:
        return state.at[place].max(line, mode="drop")

    nothing = jnp.full(height * width, -1, jnp.int32) + _varying(course)
    return over_steps(nothing, add).reshape(height, width)


@partial(jax.jit, static_argnames=("height", "width"))
def nearest_lines(
    segments: Segments, surface: Surface | None, *, height: int, width: int
) -> Int[Array, "height width"]:
    """Number of the nearest line at each pixel, -1 where there is none before the surface.

    Of lines equally near, to within rounding, the first.
    """
    course, over_steps = _steps(segments, surface, height, width)
    dtype = segments.keys.dtype

    def nearer(state: Array, place: Array, line: Array, key: Array) -> Array:
        return state.at[place].max(key, mode="drop")

    farthest = jnp.full(height * width, -jnp.inf, dtype) + _varying(course).astype(dtype)
    nearest = over_steps(farthest, nearer)
    slack = (
        jnp.where(jnp.isfinite(nearest), jnp.abs(nearest), 0) * _ROUNDINGS * jnp.finfo(dtype).eps
    )

    def first(state: Array, place: Array, line: Array, key: Array) -> Array:
        at = jnp.minimum(place, height * width - 1)
        chosen = key >= nearest[at] - slack[at]
        return state.at[jnp.where(chosen, place, height * width)].min(line, mode="drop")

    none = jnp.full(height * width, _NO_LINE, jnp.int32) + _varying(course)
    found = over_steps(none, first)
    return jnp.where(found == _NO_LINE, -1, found).reshape(height, width)


def _varying(course: Course) -> Array:
    """A zero that varies as the lines do, for loops under `shard_map`."""
    return course.steps[0, 0] & 0


Add = Callable[[Array, Array, Array, Array], Array]


def _steps(
    segments: Segments, surface: Surface | None, height: int, width: int
) -> tuple[Course, Callable[[Array, Add], Array]]:
    """A loop over all steps of all lines, which adds pixels, lines and depth keys to a state.

    Pixels are counted row after row; what is outside the image, or hidden, counts as behind them.
    """
    course = plan(segments, height=height, width=width)
    course, block = blocks_of(course, segments.seen.shape[0], LINES_AT_ONCE)
    bits, pixels = subpixel_bits(height, width), height * width

    def over_steps(state: Array, add: Add) -> Array:
        def in_block(n: Array, state: Array) -> Array:
            own = jax.tree.map(lambda column: column[n], course)
            numbering = number_steps(own.steps)

            def in_chunk(chunk: Array, state: Array) -> Array:
                line, number, exists = lines_of_steps(numbering, chunk, STEPS_AT_ONCE)
                step = step_at(own, line, number, bits)
                inside = exists & (step.row >= 0) & (step.row < height)
                inside = inside & (step.column >= 0) & (step.column < width)
                place = jnp.where(inside, step.row * width + step.column, pixels)
                if surface is not None:
                    at = jnp.minimum(place, pixels - 1)
                    hidden = hides(surface, at, step.key, step.steep, step.beyond)
                    place = jnp.where(hidden, pixels, place)
                return add(state, place, n * block + line, step.key)

            return lax.fori_loop(0, batches_of(numbering.total, STEPS_AT_ONCE), in_chunk, state)

        return lax.fori_loop(0, course.steps.shape[0], in_block, state)

    return course, over_steps
