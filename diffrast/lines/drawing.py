"""Line drawings: points, lines between them, colours (FEATURES L1-L3, L6)."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from diffrast import _check
from diffrast._check import ArrayInput
from diffrast._pytree import pytree_dataclass
from diffrast.lines.blend import add_lines
from diffrast.lines.hidden import Surface, from_middle, surface_of
from diffrast.lines.pixels import last_lines, nearest_lines
from diffrast.lines.segments import Segments, segments_from_clip, segments_from_pixels
from diffrast.raster import Fragments


class FittedPoints(NamedTuple):
    """Points of a drawing in the image that suits them."""

    points: Float[Array, "points 2"]  # pixels: x right, y down
    height: int
    width: int


@pytree_dataclass
class LineFragments:
    """The nearest line at every pixel.

    Attributes:
        line: numbers of lines, -1 where there is none. Not differentiable.
        position: where on the line, from 0 at its first point to 1 at its second, with perspective:
            attributes of the two points mix by it. 0 where there is no line. Differentiable in the
            clip positions, for fixed lines.
        inverse_depth: 1/w there, 0 where there is no line. Differentiable likewise.
    """

    line: Int[Array, "height width"]
    position: Float[Array, "height width"]
    inverse_depth: Float[Array, "height width"]


def fit_points(points: ArrayInput, *, size: int, margin: float = 0.95) -> FittedPoints:
    """Choose the size of an image from the ranges of a drawing, and put the drawing into it.

    The larger range gets `size` pixels, the other one in proportion, at least one; the drawing
    fills `margin` of the image, and the middle of its ranges is that of the image (FEATURES L3;
    Van Houdt 2). Differentiable in the points, for a fixed size and place of the drawing.

    Args:
        points: (points, 2), y up, in any unit; known numbers.
        size: pixels of the larger side.
        margin: share of the image that is filled, above 0 and at most 1.

    Raises:
        ValueError: for traced points, no points, or points all at one place.
    """
    points = _check.float_array("points", points, ("points", 2))
    size = _check.positive_int("size", size)
    margin = _check.static_number("margin", margin)
    if not 0 < margin <= 1:
        raise ValueError(f"margin: wanted a share above 0 and of at most 1, got {margin}")
    if not _check.is_concrete(points) or points.shape[0] == 0:
        got = "a traced array" if points.shape[0] else "no points"
        raise ValueError(f"points: wanted known numbers, from which the size follows, got {got}")
    numbers = np.asarray(points, np.float64)
    low, high = numbers.min(axis=0), numbers.max(axis=0)
    extent = high - low
    if not extent.max() > 0:
        raise ValueError(f"points: wanted at least two different places, got {low.tolist()} only")
    width, height = (max(1, round(size * side / extent.max())) for side in extent.tolist())
    factor = margin * size / extent.max()
    middle = np.array([width / 2, height / 2])
    # Centred before scaling, so that a drawing far from the origin keeps its digits.
    centre = jnp.asarray((low + high) / 2, points.dtype)
    scale = jnp.asarray([factor, -factor], points.dtype)
    return FittedPoints(
        (points - centre) * scale + jnp.asarray(middle, points.dtype), height, width
    )


def draw_lines(
    points: ArrayInput,
    lines: ArrayInput,
    colors: ArrayInput = (1.0, 1.0, 1.0),
    *,
    height: int,
    width: int,
    background: ArrayInput = (0.0, 0.0, 0.0),
    line_width: float = 1.0,
    antialias: bool = True,
) -> Float[Array, "height width 3"]:
    """Draw lines in the plane of the image.

    With `antialias` a line covers each pixel by the exact area that a rectangle of its length and
    width has in common with it (FEATURES L2); shares add up, to at most one, and colours mix by
    them. That image is differentiable in points, colours and background. Without, a line is one
    pixel for each step along its longer side, whatever its width (FEATURES L1), later lines cover
    earlier ones, and the image is differentiable in colours and background.

    Args:
        points: (points, 2) in pixels: x to the right and y down from the image's top left corner,
            so that the middle of pixel (row i, column j) is (j + 0.5, i + 0.5). They may lie
            anywhere. Not all of a line between two points more than 10^10 pixels away (in float32),
            whose digits do not tell where it crosses the image, need be drawn.
        lines: (lines, 2) numbers of the points that each line joins.
        colors: (lines, 3) or (3,) linear RGB.
        height: rows of the image.
        width: columns of the image.
        background: (3,) or an image (height, width, 3) to draw on.
        line_width: of anti-aliased lines, in pixels.
        antialias: see above.

    Raises:
        ValueError: for wrong shapes, numbers that are not finite, and indices out of range.

    Example:
        >>> picture = dr.draw_lines([[0.0, 1.0], [3.0, 1.0]], [[0, 1]], height=2, width=3)
        >>> picture[..., 0].tolist()  # half of its width in either row
        [[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]]
    """
    points = _check.float_array("points", points, ("points", 2))
    lines, height, width = _checked_lines(lines, points.shape[0], height, width)
    style = _style(height, width, line_width, antialias)
    return _drawn(points, lines, None, colors, background, style)


def draw_lines_with_depth(
    positions_clip: ArrayInput,
    lines: ArrayInput,
    colors: ArrayInput = (1.0, 1.0, 1.0),
    *,
    height: int,
    width: int,
    faces: ArrayInput | None = None,
    fragments: Fragments | None = None,
    background: ArrayInput = (0.0, 0.0, 0.0),
    line_width: float = 1.0,
    antialias: bool = True,
) -> Float[Array, "height width 3"]:
    """Draw lines in space, behind and before what triangles show (FEATURES L6).

    As `draw_lines`, but what lies behind the triangles is hidden: a line on a surface is visible,
    see `rasterize_lines`. Without `antialias` the nearest line covers the others; with it all that
    are not hidden by triangles mix. Lines may run through the near plane and behind the eye.
    Differentiable in `positions_clip` with `antialias`, for fixed parts hidden.

    Args:
        positions_clip: (points, 4) clip coordinates, as `world_to_clip` gives them.
        lines: (lines, 2) numbers of points.
        colors: (lines, 3) or (3,) linear RGB.
        height: rows of the image.
        width: columns of the image.
        faces: (faces, 3) numbers of points of triangles, or None for none.
        fragments: what `rasterize(positions_clip, faces, ...)` found, given with `faces`.
        background: (3,) or an image (height, width, 3): what the triangles look like.
        line_width: of anti-aliased lines, in pixels.
        antialias: see above.

    Raises:
        ValueError: for wrong shapes, indices out of range, fragments of another size, and faces
            without fragments or the other way round.
    """
    positions_clip = _check.float_array("positions_clip", positions_clip, ("points", 4))
    lines, height, width = _checked_lines(lines, positions_clip.shape[0], height, width)
    surface = _surface(positions_clip, faces, fragments, height, width)
    style = _style(height, width, line_width, antialias)
    return _drawn(positions_clip, lines, surface, colors, background, style)


def rasterize_lines(
    positions_clip: ArrayInput,
    lines: ArrayInput,
    *,
    height: int,
    width: int,
    faces: ArrayInput | None = None,
    fragments: Fragments | None = None,
) -> LineFragments:
    """Find the nearest line at every pixel, and where on it (FEATURES L1, L6).

    A line has one pixel for each step along its longer side, decided exactly in the fixed point of
    `rasterize`. Depth is 1/w, linear along the line on the screen; -z/w for parallel projections.
    Lines equally near go to the first. A line that lies on a triangle is seen: it is hidden by what
    is nearer than it by more than the triangle's depth changes over a pixel.

    Args:
        positions_clip: (points, 4) clip coordinates; points may lie behind the eye.
        lines: (lines, 2) numbers of points.
        height: rows of the image.
        width: columns of the image.
        faces: (faces, 3) numbers of points of triangles that may hide lines, or None.
        fragments: what `rasterize(positions_clip, faces, ...)` found, given with `faces`.

    Returns:
        The fragments; `position` and `inverse_depth` are differentiable in `positions_clip`.

    Raises:
        ValueError: as `draw_lines_with_depth`, and for no lines.
    """
    positions_clip = _check.float_array("positions_clip", positions_clip, ("points", 4))
    lines, height, width = _checked_lines(lines, positions_clip.shape[0], height, width)
    if lines.shape[0] == 0:
        raise ValueError("lines: wanted at least one line, got none")
    surface = _surface(positions_clip, faces, fragments, height, width)
    points, lines, count = _filled_up(positions_clip, lines)
    return _fragments(points, lines, count, surface, height=height, width=width)


@partial(jax.jit, static_argnames=("height", "width"))
def _fragments(
    positions_clip: Array,
    lines: Array,
    count: Array,
    surface: Surface | None,
    *,
    height: int,
    width: int,
) -> LineFragments:
    """Where pixels look at their lines: where the line crosses the pixel's column or row."""
    segments = _segments(positions_clip, lines, count, height, width)
    line = nearest_lines(segments, surface, height=height, width=width)
    covered, at = line >= 0, jnp.maximum(line, 0)
    change = jnp.abs(segments.end - segments.start)[at]
    steep = change[..., 1] > change[..., 0]
    x_pixel, y_pixel = from_middle(height, width, positions_clip.dtype)
    ends, depths = [], []
    for k in range(2):
        point = positions_clip[lines[at, k]]
        w = point[..., 3]
        x = point[..., 0] * (width / 2) - x_pixel * w
        y = point[..., 1] * (height / 2) - y_pixel * w
        ends.append(jnp.where(steep, y, x))
        depths.append(w)
    difference = ends[0] - ends[1]
    defined = covered & (difference != 0)
    position = jnp.where(defined, ends[0], 0) / jnp.where(defined, difference, 1)
    position = jnp.where(
        covered, jnp.clip(position, *jnp.moveaxis(segments.interval[at], -1, 0)), 0
    )
    depth = depths[0] + position * (depths[1] - depths[0])
    positive = covered & (depth > 0)
    inverse_depth = jnp.where(positive, 1, 0) / jnp.where(positive, depth, 1)
    return LineFragments(line=line, position=position, inverse_depth=inverse_depth)


class _Style(NamedTuple):
    height: int
    width: int
    line_width: float
    antialias: bool


def _style(height: int, width: int, line_width: float, antialias: bool) -> _Style:
    line_width = _check.static_number("line_width", line_width)
    if not line_width > 0:
        raise ValueError(f"line_width: wanted a number between 0 and inf, got {line_width}")
    return _Style(height, width, line_width, _check.flag("antialias", antialias))


def _drawn(
    points: Array,
    lines: Array,
    surface: Surface | None,
    colors: ArrayInput,
    background: ArrayInput,
    style: _Style,
) -> Array:
    count, dtype = lines.shape[0], points.dtype
    colors = _check.float_array("colors", colors).astype(dtype)
    if colors.shape not in ((3,), (count, 3)):
        raise ValueError(f"colors: wanted shape (3,) or ({count}, 3), got {colors.shape}")
    background = _check.float_array("background", background).astype(dtype)
    size = (style.height, style.width)
    if background.shape not in ((3,), (*size, 3)):
        raise ValueError(
            f"background: wanted shape (3,) or ({size[0]}, {size[1]}, 3), got {background.shape}"
        )
    if count == 0:
        return jnp.broadcast_to(background, (*size, 3))
    points, lines, used = _filled_up(points, lines)
    if colors.ndim == 2:
        colors = jnp.pad(colors, ((0, lines.shape[0] - count), (0, 0)))
    return _picture(points, lines, used, surface, colors, background, style=style)


def _filled_up(points: Array, lines: Array) -> tuple[Array, Array, Array]:
    """Points and lines up to the next power of two, and how many lines are used.

    So drawings of nearly the same size share a compiled program.
    """
    sizes = [1 << max(4, (array.shape[0] - 1).bit_length()) for array in (points, lines)]
    used = jnp.asarray(lines.shape[0], jnp.int32)
    points = jnp.pad(points, ((0, sizes[0] - points.shape[0]), (0, 0)), mode="edge")
    return points, jnp.pad(lines, ((0, sizes[1] - lines.shape[0]), (0, 0))), used


def _segments(points: Array, lines: Array, used: Array, height: int, width: int) -> Segments:
    make = segments_from_pixels if points.shape[1] == 2 else segments_from_clip
    segments = make(points, lines, height=height, width=width)
    return segments._replace(
        seen=segments.seen & (jnp.arange(lines.shape[0], dtype=jnp.int32) < used)
    )


@partial(jax.jit, static_argnames=("style",))
def _picture(
    points: Array,
    lines: Array,
    used: Array,
    surface: Surface | None,
    colors: Array,
    background: Array,
    *,
    style: _Style,
) -> Array:
    height, width, line_width, antialias = style
    segments = _segments(points, lines, used, height, width)
    size = {"height": height, "width": width}
    if not antialias:
        if points.shape[1] == 2:
            line = last_lines(segments, **size)
        else:
            line = nearest_lines(segments, surface, **size)
        shown = colors if colors.ndim == 1 else colors[jnp.maximum(line, 0)]
        return jnp.where((line >= 0)[..., None], shown, background)
    ones = jnp.ones((lines.shape[0], 1), points.dtype)
    values = ones if colors.ndim == 1 else jnp.concatenate([colors, ones], axis=1)
    sums = add_lines(segments, values, surface, **size, line_width=line_width)
    share = sums[..., -1:]
    mixed = colors * share if colors.ndim == 1 else sums[..., :3]
    over = share > 1  # a share of one has its derivative
    return background * (1 - jnp.where(over, 1, share)) + mixed / jnp.where(over, share, 1)


def _checked_lines(
    lines: ArrayInput, points: int, height: int, width: int
) -> tuple[Array, int, int]:
    height, width = _check.positive_int("height", height), _check.positive_int("width", width)
    return _check.index_array("lines", lines, ("lines", 2), bound=points), height, width


def _surface(
    positions_clip: Array,
    faces: ArrayInput | None,
    fragments: Fragments | None,
    height: int,
    width: int,
) -> Surface | None:
    if (faces is None) != (fragments is None):
        given, missing = ("fragments", "faces") if faces is None else ("faces", "fragments")
        raise ValueError(f"{missing}: wanted them together with {given}, got None")
    if faces is None or fragments is None:
        return None
    indices = _check.index_array("faces", faces, ("faces", 3), bound=positions_clip.shape[0])
    _check.instance_of("fragments", fragments, Fragments)
    if fragments.face.shape != (height, width):
        raise ValueError(
            f"fragments: wanted those of {height} rows and {width} columns, got"
            f" {fragments.face.shape[0]} and {fragments.face.shape[1]}"
        )
    return surface_of(positions_clip, indices, fragments)
