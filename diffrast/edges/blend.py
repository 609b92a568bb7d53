"""Exact areas of pixels beyond edges: the anti-aliased image, and records of what made it.

A piece of an edge from y0 to y1, relative to its pixel's centre, parts off the area beyond it as
the centre sees it; there the picture shows what is on the other side. With q the position of a
direction along the unit square's perimeter, 0 to 4,

    S = wrap(q(y1) - q(y0)) / 4 - (y0 × y1) / 2,    pixel += S (colour right - colour left),

which adds up exactly over the pieces of any outline. To first order dS is minus the piece's normal
times the motion of its middle: linear in the positions, without a singularity.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._selection import over_batches, prefix_sum
from diffrast._stored import stored
from diffrast._topology import Topology
from diffrast.edges.neighborhood import blocks_with_background
from diffrast.edges.pieces import (
    CUT_AT_ONCE,
    EDGES_AT_ONCE,
    PIECES_AT_ONCE,
    Pieces,
    Segments,
    Waiting,
    behind,
    choose_edges,
    clip_edges,
    cut,
    facing,
    first_ones,
    gathered,
    instead_of_first,
    none_waiting,
    to_pixels,
)
from diffrast.edges.piercing import (
    LINES_AT_ONCE,
    PIXELS_AT_ONCE,
    Line,
    choose_pixels,
    cross,
    lines_of,
)
from diffrast.edges.rim import BESIDE
from diffrast.edges.shadow_lines import PIXELS_AT_ONCE as SHADOWED_AT_ONCE
from diffrast.edges.shadow_lines import Cast, Shadow, cross_shadows, shadow_of
from diffrast.edges.shadow_lines import choose_pixels as choose_shadowed
from diffrast.edges.visibility import BACKGROUND, Seen, look, uncovered

_NO_JUMP = 1e-5  # of the colours, which are as rounding leaves them

Shader = Callable[[Any, Array, list[Array]], list[Array]]
Glow = Callable[[Any, Array, Array, list[Array]], list[Array]]


class View(NamedTuple):
    """What is drawn, and the picture without edges; both pictures with a border of one pixel."""

    positions_clip: Float[Array, "V 4"]  # of the view without its border
    faces: Int[Array, "F 3"]
    turned: Bool[Array, " F"] | None  # faces that count as turned round where back faces are culled
    topology: Topology
    apart: Bool[Array, " edges"]  # whether colours may jump across an edge that is no outline
    face_image: Int[Array, "height_with_border width_with_border"]
    image: Float[Array, "height_with_border width_with_border channels"]
    background: Float[Array, "*size channels"]  # one colour, or a picture like `image`
    scene: Any  # passed on to the shader
    scale: Float[Array, " V"] | None = None  # of homogeneous coordinates: `scale_by_depth`
    cast: Cast | None = None  # shadows; then lights and their weights follow the positions


class Method(NamedTuple):
    """How edges are drawn; all static.

    Attributes:
        shader: colours of points on faces, `shader(scene, face, barycentrics)`; None takes the
            colours of pixels beside the edge instead.
        glow: what one light adds to the colours, `glow(scene, light, face, barycentrics)`.
        cull_backfaces: whether only front faces are drawn.
        capacity: rows of the records.
    """

    shader: Shader | None
    glow: Glow | None
    cull_backfaces: bool
    capacity: int


class Records(NamedTuple):
    """Visible pieces, as many as there are rows; the first `total` are in use, or all."""

    total: Int[Array, ""]  # number of visible pieces
    integers: Int[Array, "capacity 6"]  # pixel, pixels of front, beyond, rim; two vertices
    jump: Float[Array, "capacity channels"]  # of the colour outwards, as the piece moves
    weights: Float[Array, "capacity 2"]  # area beyond as the pixel's centre sees it; rim's length
    motion: Float[Array, "capacity 6"]  # of the area with x, y, w of the two vertices


class Sums(NamedTuple):
    """What the pieces do to the picture."""

    added: Float[Array, "pixels channels"]
    range: tuple[Array, Array]  # least and greatest colours that each pixel holds
    rims: Float[Array, " pixels_with_border"]  # length of smooth rims about a pixel's centre


class Blended(NamedTuple):
    """The pieces, and what they add up to; None where only more records are asked for."""

    records: Records
    sums: Sums | None


def perimeter(x: Array, y: Array) -> Array:
    """Where the ray through (x, y) leaves the unit square, 0 to 4 along its perimeter."""
    across, along = jnp.abs(x), jnp.abs(y)
    largest = jnp.maximum(across, along)
    inverse = 0.5 / jnp.where(largest > 0, largest, 1)
    return jnp.where(
        across >= along,
        jnp.where(x >= 0, 0, 2) + jnp.where(x >= 0, y, -y) * inverse,
        jnp.where(y > 0, 1, 3) + jnp.where(y > 0, -x, x) * inverse,
    )


def _area(begin: Array, end: Array) -> Array:
    """Part of the pixel beyond a piece, positive if that is on the right."""
    turn = perimeter(*end) - perimeter(*begin)
    turn = turn - 4 * jnp.round(turn / 4)
    return turn / 4 - (begin[0] * end[1] - begin[1] * end[0]) / 2


def _motion(segments: Segments, pieces: Pieces, seen: Seen) -> Array:
    """Derivative of the area by x, y, w of the edge's start and of its end, shape (6, n)."""
    of = pieces.segment
    across, down = seen.begin[1] - seen.end[1], seen.end[0] - seen.begin[0]
    shares = jnp.stack([1 - seen.middle, seen.middle]) * segments.weights[:, of]
    inside = segments.range[:, of]
    vertex = shares * jnp.stack([1 - inside, inside])  # (start and end, clipped ends, n)
    x, y = segments.ends[:, 0, of], segments.ends[:, 1, of]
    total = jnp.sum(vertex, axis=1)
    moment = jnp.sum(vertex * (across * x + down * y), axis=1)
    return jnp.stack([total * across, total * down, -moment], axis=1).reshape(6, -1)


def collect(view: View, method: Method, first: Array | None = None) -> Blended:
    """Find the visible pieces, and the sum of what they add to the image.

    With `first`, the number of a visible piece, only records are made, from that piece on.
    """
    height, width = view.image.shape[0] - 2, view.image.shape[1] - 2
    edges = view.topology.edges
    pixels = to_pixels(view.positions_clip, height, width)
    volume = facing(pixels, view.faces)
    if method.cull_backfaces:
        front = (volume < 0) if view.turned is None else (volume < 0) != view.turned
        volume = stored(jnp.where(front, volume, 0))
    order, edge_count = choose_edges(edges, volume, view.apart)
    bare_blocks = blocks_with_background(view.face_image)

    def add_edges(edge: Array, exists: Array, total: Blended) -> Blended:
        segments = clip_edges(
            edge, exists, edges, view.faces, pixels, volume, height=height, width=width
        )
        ends = prefix_sum(segments.parts)

        cuts = (ends[-1] + CUT_AT_ONCE - 1) // CUT_AT_ONCE

        def add_cut(state: tuple[Array, Waiting]) -> tuple[Array, Waiting]:
            n, waiting = state
            pieces = cut(segments, ends, n * CUT_AT_ONCE, height=height, width=width)
            pieces = uncovered(pieces, segments, view.faces, pixels, view.face_image)
            return n + 1, behind(waiting, *gathered(pieces))

        def are_few(state: tuple[Array, Waiting]) -> Array:
            return (state[0] < cuts) & (state[1].total < PIECES_AT_ONCE)

        def add_pieces(state: tuple[Array, Waiting, Blended]) -> tuple[Array, Waiting, Blended]:
            n, waiting = lax.while_loop(are_few, add_cut, state[:2])
            pieces = first_ones(waiting)
            found, left = look(
                pieces,
                segments,
                view.faces,
                pixels,
                view.topology,
                volume,
                view.face_image,
                bare_blocks,
            )
            total = _with_pieces(state[2], view, method, segments, pieces, found, first)
            return n, instead_of_first(waiting, left), total

        def is_left(state: tuple[Array, Waiting, Blended]) -> Array:
            return (state[0] < cuts) | (state[1].total > 0)

        start = ends[-1] & 0, none_waiting(segments), total
        return lax.while_loop(is_left, add_pieces, start)[2]

    # Made of the image: else what it is added to would be made, and held, before the image is.
    zero = stored(edge_count & 0, view.image[0, 0, 0])
    nothing = _nothing(view, method, first, zero)
    blended = over_batches(order, edge_count, EDGES_AT_ONCE, add_edges, nothing)
    if view.topology.bodies is not None:
        blended = _add_piercing(blended, view, method, pixels, volume, first)
    if view.cast is not None:
        blended = _add_shadows(blended, view, view.cast, method, pixels, first)
    return blended


def _add_piercing(
    total: Blended, view: View, method: Method, pixels: Array, volume: Array, first: Array | None
) -> Blended:
    """Add the lines along which surfaces pierce each other."""
    bodies, width = view.topology.bodies, view.image.shape[1] - 2
    assert bodies is not None
    order, count = choose_pixels(view.face_image, bodies)

    def add_pixels(number: Array, exists: Array, total: Blended) -> Blended:
        pixel = stored(jnp.stack([number % width, number // width]))
        crossings = cross(pixel, exists, view.faces, pixels, view.topology, volume, view.face_image)

        def add_lines(pair: Array, exists: Array, total: Blended) -> Blended:
            return _with_line(total, view, method, lines_of(crossings, pair, exists), first)

        return over_batches(crossings.pairs, crossings.total, LINES_AT_ONCE, add_lines, total)

    return over_batches(order, count, PIXELS_AT_ONCE, add_pixels, total)


def _add_shadows(
    total: Blended, view: View, cast: Cast, method: Method, pixels: Array, first: Array | None
) -> Blended:
    """Add the outlines of shadows."""
    height, width = view.image.shape[0] - 2, view.image.shape[1] - 2
    order, count = choose_shadowed(cast)

    def add_pixels(number: Array, exists: Array, total: Blended) -> Blended:
        pixel = jnp.stack([number % width, number // width % height])
        light = number // (width * height)
        weight_of_light = pixels.shape[1] - cast.weight.size + light
        column = weight_of_light - cast.weight.size
        outlines = cross_shadows(
            light, column, pixel, exists, cast, view.faces, pixels, view.face_image
        )

        def add_lines(n: Array, total: Blended) -> Blended:
            line = shadow_of(outlines, n, column, weight_of_light, pixel, view.faces)
            return _with_shadow(total, view, method, pixel, light, line, first)

        most = jnp.max(jnp.sum(outlines.exists, axis=0))
        return lax.fori_loop(0, most, add_lines, total)

    return over_batches(order, count, SHADOWED_AT_ONCE, add_pixels, total)


def _nothing(view: View, method: Method, first: Array | None, zero: Array) -> Blended:
    """No pieces yet; `zero` is a number that varies with the view as what is added does."""
    rows, channels, dtype = method.capacity, view.image.shape[2], view.image.dtype
    records = Records(
        zero,
        jnp.zeros((rows, 6), jnp.int32) + zero,
        jnp.zeros((rows, channels), dtype) + zero,
        jnp.zeros((rows, 2), dtype) + zero,
        jnp.zeros((rows, 6), dtype) + zero,
    )
    if first is not None:
        return Blended(records, None)
    own, rims = cropped(view.image, view.image.shape), jnp.zeros(view.face_image.size, dtype)
    return Blended(records, Sums(jnp.zeros_like(own) + zero, (own, own), rims + zero))


def _place(view: View, pixel: Array, look: Array | int) -> Array:
    """Index in the image with its border of one of the 3×3 pixels round pixels."""
    return (pixel[1] + look // 3) * view.image.shape[1] + pixel[0] + look % 3


def _shade(
    view: View, method: Method, *points: tuple[Int[Array, " n"], list[Float[Array, " n"]]]
) -> list[Array]:
    """Colours of points on faces, several of each piece at once."""
    assert method.shader is not None
    face, barycentrics = jax.tree.map(lambda *parts: jnp.concatenate(parts), *points)
    if view.scale is not None:
        scale = stored(view.scale[view.faces[jnp.maximum(face, 0)]])
        barycentrics = [part * scale[:, i] for i, part in enumerate(barycentrics)]
        total = barycentrics[0] + barycentrics[1] + barycentrics[2]
        barycentrics = [part / jnp.where(total > 0, total, 1) for part in barycentrics]
    colors = jnp.stack(method.shader(view.scene, face, barycentrics), axis=-1)
    return jnp.split(colors, len(points))


def _with_pieces(
    total: Blended,
    view: View,
    method: Method,
    segments: Segments,
    pieces: Pieces,
    found: Seen,
    first: Array | None,
) -> Blended:
    """Add pieces of edges."""
    rim = found.rim
    flat = view.image.reshape(-1, view.image.shape[2])
    looks = (found.front.look, found.beyond.look, rim.inner)
    places = [_place(view, pieces.pixel, look) for look in looks]
    near, behind, inner = stored([flat[i] for i in places])
    bare = view.background
    if bare.ndim > 1:
        bare = bare.reshape(flat.shape)[_place(view, pieces.pixel, 4)]
    behind = jnp.where((found.beyond.face == BACKGROUND)[:, None], bare, behind)
    front = near
    outward = jnp.where(found.front_on_right, -1, 1)
    area = outward * _area(found.begin, found.end)
    length = jnp.hypot(found.end[0] - found.begin[0], found.end[1] - found.begin[1])
    smooth = jnp.zeros_like(found.visible)
    if method.shader is None:
        jump = behind - front
        value = area[:, None] * jump
    else:
        points = found.front[:2], found.beyond[:2], rim.bend, rim.far, rim.beside
        front, beyond, bend, far, beside = _shade(view, method, *points)
        behind = jnp.where(found.beyond.face[:, None] >= 0, beyond, behind)
        smooth = rim.smooth
        integral, moved = _along(found, front, bend, far, near, inner, beside)
        jump = behind - jnp.where(smooth[:, None], moved, front)
        mean = integral - rim.depth[:, None] * near
        value = jnp.where(
            smooth[:, None],
            area[:, None] * (behind - near) + length[:, None] * mean,
            area[:, None] * jump,
        )
        own = flat[_place(view, pieces.pixel, 4)]
        value = jnp.where(found.wrong_side[:, None], value + front - own, value)
    jump, value, front, behind = stored((jump, value, front, behind))
    size = jnp.max(jnp.abs(behind) + jnp.abs(front), axis=1)
    used = found.visible & (found.fold | (jnp.max(jnp.abs(jump), axis=1) > _NO_JUMP * size))
    held = jnp.stack([front, behind, jnp.where(smooth[:, None], inner, front)])
    rim_length = jnp.where(used & smooth & (found.front.look == 4), length, 0)
    sums, pixel = _with_values(total.sums, view, pieces.pixel, used, value, held)
    if sums is not None:
        sums = sums._replace(rims=sums.rims.at[places[0]].add(rim_length))
    start, end = segments.vertices[:, pieces.segment]
    rows = (
        jnp.stack([pixel, *places, start, end], axis=-1),
        jump,
        jnp.stack([area, rim_length], axis=-1),
        stored(outward * _motion(segments, pieces, found)).T,
    )
    return Blended(_with_rows(total.records, used, rows, first), sums)


def _with_line(
    total: Blended, view: View, method: Method, line: Line, first: Array | None
) -> Blended:
    """Add lines where surfaces pierce each other."""
    area = _area(line.begin, line.end)
    places = [_place(view, line.pixel, look) for look in line.look]
    if method.shader is None:
        right, left = (view.image.reshape(-1, view.image.shape[2])[i] for i in places)
    else:
        points = [(line.face[i], [b[i] for b in line.barycentrics]) for i in range(2)]
        right, left = _shade(view, method, *points)
    jump = stored(right - left)
    value = area[:, None] * jump
    held = jnp.stack([right, left])
    sums, own = _with_values(total.sums, view, line.pixel, line.used, value, held)
    corners = view.faces[line.face].transpose(0, 2, 1).reshape(3, 2, -1)
    motion = line.motion.reshape(3, 6, -1)
    use = jnp.stack([line.used] * 3)
    records = _with_lines(total.records, use, own, places, jump, area, corners, motion, first)
    return Blended(records, sums)


def _with_shadow(
    total: Blended,
    view: View,
    method: Method,
    pixel: Array,
    light: Array,
    line: Shadow,
    first: Array | None,
) -> Blended:
    """Add one line in each pixel across which a light begins."""
    assert method.glow is not None
    assert view.cast is not None
    area = _area(line.begin, line.end)
    glow = jnp.stack(method.glow(view.scene, light, line.face, line.barycentrics), axis=-1)
    jump = stored(jnp.where(line.lit_on_right, 1, -1)[:, None] * glow)
    own = view.image.reshape(-1, view.image.shape[2])[_place(view, pixel, 4)]
    to_other = jnp.where(line.centre_is_lit, -1, 1)[:, None] * glow
    value = area[:, None] * jump + jnp.where(line.wrong_side[:, None], to_other, 0)
    held = jnp.stack([own, own + to_other])
    sums, number = _with_values(total.sums, view, pixel, line.used, value, held)
    places = [_place(view, pixel, look) for look in line.look]
    use = jnp.stack([line.used] * 3 + [line.used & view.cast.parallel])
    records = _with_lines(
        total.records, use, number, places, jump, area, line.vertices, line.motion, first
    )
    return Blended(records, sums)


def _with_lines(
    records: Records,
    used: Array,
    pixel: Array,
    places: list[Array],
    jump: Array,
    area: Array,
    vertices: Array,
    motion: Array,
    first: Array | None,
) -> Records:
    """Record lines that move with more vertices, as several rows each: two in every row."""
    rows = [
        (
            jnp.stack([pixel, places[1], places[0], places[0], *vertices[i]], axis=-1),
            jump,
            jnp.stack([area * (i == 0), jnp.zeros_like(area)], axis=-1),
            stored(motion[i].T),
        )
        for i in range(len(used))
    ]
    joined = tuple(jnp.concatenate(column) for column in zip(*rows, strict=True))
    return _with_rows(records, used.reshape(-1), joined, first)


def _with_values(
    total: Sums | None, view: View, pixel: Array, used: Array, value: Array, held: Array
) -> tuple[Sums | None, Array]:
    """Add values to pixels and widen the range of their colours; also the pixels' numbers."""
    number = stored(jnp.where(used, pixel[1] * (view.image.shape[1] - 2) + pixel[0], 0))
    if total is None:
        return None, number
    added = total.added.at[number].add(jnp.where(used[:, None], value, 0))
    low, high = total.range
    low = low.at[number].min(jnp.where(used[:, None], jnp.min(held, axis=0), jnp.inf))
    high = high.at[number].max(jnp.where(used[:, None], jnp.max(held, axis=0), -jnp.inf))
    return total._replace(added=added, range=(low, high)), number


def _with_rows(
    records: Records, used: Array, rows: tuple[Array, ...], first: Array | None
) -> Records:
    """Write rows behind those in use, as far as there is room."""
    capacity = records.jump.shape[0]
    ends = prefix_sum(used.astype(jnp.int32))
    slot = records.total + ends - 1 - (0 if first is None else first)
    slot = jnp.where(used & (slot >= 0), slot, capacity)
    columns = (
        old.at[slot].set(new.astype(old.dtype), mode="drop")
        for old, new in zip(records[1:], rows, strict=True)
    )
    return Records(records.total + ends[-1], *columns)


def _along(
    seen: Seen, front: Array, bend: Array, far: Array, near: Array, inner: Array, beside: Array
) -> tuple[Array, Array]:
    """The colour of a smooth surface from its rim to where the pixel ends.

    Its integral over this depth; and the colour that counts as the rim moves. As a point at a
    fixed depth keeps its colour, that is the one at the far end, less what the derivative of the
    next pixel, which stands for this one's, says of it: as far as its colour is carried along, that
    is its slope.
    """
    rim = seen.rim
    first, depth = rim.first[:, None], rim.depth[:, None]
    centre = jnp.clip(seen.centre_depth[:, None], first, depth)
    bends = first < depth
    far = jnp.clip(far, jnp.minimum(bend, inner), jnp.maximum(bend, inner))
    far = jnp.where(bends, far, bend)
    # A shadow may begin where the slope is taken.
    most = 2 * jnp.ptp(jnp.stack([front, bend, far, inner]), axis=0)
    rise = jnp.clip(depth * (inner - beside) / BESIDE, -most, most)
    # Seen from ever flatter above, it changes with the square root of the depth.
    mean = jnp.where(rim.single, 1 / 2, 2 / 3)[:, None]
    passes = centre > first
    near = jnp.where(passes, near, bend)
    integral = (
        first * (front + bend) / 2
        + (centre - first) * (bend + mean * (near - bend))
        + (depth - centre) * (near + jnp.where(passes, 1 / 2, mean) * (far - near))
    )
    return integral, far - rise


def cropped(colors: Array, shape: tuple[int, ...]) -> Array:
    """Colours of pixels with a border of one, without it."""
    return colors.reshape(shape)[1:-1, 1:-1].reshape(-1, shape[-1])
