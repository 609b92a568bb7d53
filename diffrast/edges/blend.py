"""Exact areas of pixels beyond edges: the anti-aliased image, and records of what made it.

A piece of an edge parts off the area S beyond it as its pixel's centre sees it (see `areas`); there
the picture shows what is on the other side: pixel += S (colour right - colour left).
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._device import draws_on_cpu
from diffrast._stored import stepped, stored, stored_together, zero_after
from diffrast._topology import Topology, by_three
from diffrast.edges.areas import area_beyond, motion_of_edge, motion_of_inner_edge
from diffrast.edges.pieces import Pieces, Segments
from diffrast.edges.piercing import Line
from diffrast.edges.records import Records, Start, no_records, with_lines, with_rows
from diffrast.edges.rim import colors_along, mean_of_rows
from diffrast.edges.shadow_lines import Shadow
from diffrast.edges.shadow_pairs import Cast, light_told
from diffrast.edges.unseen import Survey
from diffrast.edges.visibility import BACKGROUND, SNAPPED, Seen

LEFT_STEPS = 256  # to a pixel's area: `Sums.left` is kept in two bytes a pixel
_NO_JUMP = 1e-5  # of the colours, which are as rounding leaves them

Shader = Callable[[Any, Array, list[Array], Array | None], list[Array]]
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
    volume: Float[Array, " F"] | None = None  # of faces: `facing`; 0 of none that can be drawn
    cast: Cast | None = None  # shadows; then lights and their weights follow the positions
    # Pixels that get the mean colour of the surface at their centre elsewhere.
    meaned: Bool[Array, "height width"] | None = None
    survey: Survey | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the pictures without their border."""
        return self.image.shape[0] - 2, self.image.shape[1] - 2

    @property
    def pictured(self) -> bool:
        """Whether the background is a picture."""
        return self.background.ndim == 3

    @property
    def colors(self) -> int:
        """How many colours pieces part: those of the image, and of a background that is one."""
        return self.face_image.size * (2 if self.pictured else 1)


class Method(NamedTuple):
    """How edges are drawn; all static.

    Attributes:
        shader: colours of points on faces, `shader(scene, face, barycentrics, told)`, with whether
            lights reach them as `light_told` knows, None without shadows; None takes the colours of
            pixels beside the edge instead.
        glow: what one light adds to the colours, `glow(scene, light, face, barycentrics)`.
        cull_backfaces: whether only front faces are drawn.
        capacity: rows of the records; 0 for a picture alone, of which nothing is recorded.
    """

    shader: Shader | None
    glow: Glow | None
    cull_backfaces: bool
    capacity: int


class Sums(NamedTuple):
    """What the pieces do to the picture."""

    added: Float[Array, "pixels channels"]
    range: tuple[Array, Array]  # least and greatest colours that each pixel holds
    left: Int[Array, " pixels"] | None  # area that what is at their centres leaves, in steps


class Blended(NamedTuple):
    """The pieces, and what they add up to; None of what is not asked for."""

    records: Records | None
    sums: Sums | None


def nothing(view: View, method: Method, start: Start | None, zero: Array) -> Blended:
    """No pieces yet; `zero` is a number that varies with the view as what is added does."""
    channels, dtype = view.image.shape[2], view.image.dtype
    records = left = None
    own = cropped(view.image, view.image.shape) + zero.astype(dtype)
    if method.capacity:
        records = no_records(method.capacity, channels, dtype, start, zero)
        left = jnp.zeros(own.shape[0], jnp.int16) + zero.astype(jnp.int16)
    if start is not None:
        return Blended(records, None)
    return Blended(records, Sums(jnp.zeros_like(own) + zero.astype(dtype), (own, own), left))


def _place(view: View, pixel: Array, look: Array | int) -> Array:
    """Index in the image with its border of one of the 3×3 pixels round pixels."""
    row, column = by_three(look)
    return (pixel[1] + row) * view.image.shape[1] + pixel[0] + column


def number_of_pixel(view: View, pixel: Array) -> Array:
    """Index of pixels in the image without its border."""
    return pixel[1] * view.size[1] + pixel[0]


def _colors(image: Array, place: Int[Array, " n"]) -> Float[Array, "channels n"]:
    """What an image shows there."""
    return image.reshape(-1, image.shape[2])[place].T


def _shade(
    view: View,
    method: Method,
    told: Int[Array, "lights points"] | None,
    *points: tuple[Int[Array, " n"], list[Float[Array, " n"]]],
) -> list[Float[Array, "channels n"]]:
    """Colours of points on faces, several of each piece at once."""
    assert method.shader is not None
    face, barycentrics = jax.tree.map(lambda *parts: jnp.concatenate(parts), *points)
    barycentrics = _on_faces(view, face, barycentrics)
    colors = stored_together(method.shader(view.scene, face, barycentrics, told))
    return jnp.split(jnp.stack(colors), len(points), axis=1)


def _on_faces(
    view: View, face: Int[Array, " n"], barycentrics: list[Float[Array, " n"]]
) -> list[Float[Array, " n"]]:
    """Barycentric coordinates of the faces as they are, given those of the scaled ones."""
    if view.scale is None:
        return barycentrics
    scale = stored(view.scale[view.faces[jnp.maximum(face, 0)]])
    barycentrics = [part * scale[:, i] for i, part in enumerate(barycentrics)]
    total = barycentrics[0] + barycentrics[1] + barycentrics[2]
    inverse_total = 1 / jnp.where(total > 0, total, 1)
    return [part * inverse_total for part in barycentrics]


def _where(chosen: Array, first: list[Array], second: list[Array]) -> list[Array]:
    """The first of two barycentric coordinates where that is chosen, else the second."""
    return [jnp.where(chosen, *both) for both in zip(first, second, strict=True)]


def _told(
    view: View, cast: Cast, pixel: Int[Array, "2 n"], found: Seen, points: int
) -> tuple[Int[Array, "lights points"], Bool[Array, "3 n"]]:
    """What pixels tell of the light in front and beyond, the first of each piece's points.

    Beside creases: what is at a fold may be in its shadow, which no pixel may show; so of folds
    only that it is dark beyond, if no outline parts that in the pixel, and that it is lit where the
    pixel's centre shows what is there: the colour that the area loses is the centre's, however
    narrow a strip lies in the dark. Where
    an outline may cross a crease, both sides have the light of the pixel's centre, and so has what
    lies beyond a fold through the centre, where the outline may be the same line. Of points whose
    colours are not used no light is asked.

    Also beyond which folds no pixel shows a shadow, and no outline is drawn: one may begin there,
    but ends not far away; and in front and beyond of which some do, and others do not: it is not
    the shading that changes there.
    """
    (front, in_front, _), (beyond, around, parted_beyond) = (
        light_told(cast, view.face_image, pixel, side.face) for side in (found.front, found.beyond)
    )
    column, row = pixel + 1
    here = cast.lit[:, row, column].astype(front.dtype)
    shown = found.front.is_centre | found.beyond.is_centre
    crossed = ~found.fold & shown & (front < 0) & (beyond < 0)
    front, beyond = jnp.where(crossed, here, jnp.stack([front, beyond]))
    on_edge = found.fold & found.beyond.is_centre & (jnp.abs(found.centre_depth) < SNAPPED)
    beyond = jnp.where(on_edge & (beyond < 0), here, beyond)
    front = jnp.where(found.fold, -1, front)
    asked = found.fold & ~found.beyond.is_centre
    beyond = jnp.where(asked & ((beyond > 0) | parted_beyond), -1, beyond)
    inwards = jnp.where(found.rim.smooth | found.rim.alone, -1, jnp.zeros_like(front))
    parts = [front, beyond] + [inwards] * (points - 2)
    told = jnp.concatenate([jnp.where(found.visible, part, 0) for part in parts], axis=1)
    lit_around = asked & jnp.any(around > 0, axis=0) & ~jnp.any(parted_beyond, axis=0)
    parted = [jnp.any(part == -1, axis=0) for part in (in_front, around)]
    return told, stored(jnp.stack([lit_around, *parted]))


def with_pieces(
    total: Blended,
    view: View,
    method: Method,
    segments: Segments,
    pieces: Pieces,
    found: Seen,
) -> Blended:
    """Add pieces of edges."""
    rim = found.rim
    looks = (found.front.look, found.beyond.look, rim.inner)
    places = [_place(view, pieces.pixel, look) for look in looks]
    near, behind, inner = stored_together([_colors(view.image, place) for place in places])
    centre, bare = _place(view, pieces.pixel, 4), view.background
    is_bare = found.beyond.face == BACKGROUND
    if view.pictured:  # what empty pixels beside this one show is not what is behind this one
        shown = view.face_image.reshape(-1)[places[1]]
        is_bare = is_bare | ((found.beyond.face < 0) & (shown < 0))
        bare = _colors(bare, centre)
        places[1] = jnp.where(is_bare, view.face_image.size + centre, places[1])
    else:
        bare = bare[:, None]
    behind = jnp.where(is_bare, bare, behind)
    front = near
    outward = jnp.where(found.front_on_right, -1, 1)
    across = found.end - found.begin
    area, length = outward * area_beyond(found.begin, found.end), jnp.hypot(*across)
    area, length = stored_together((area, length))
    smooth = replaced = steep = jnp.zeros_like(found.visible)
    at_centre = [side.is_centre for side in (found.front, found.beyond)]
    if method.shader is None:
        jump = behind - front
        value = area * jump
    else:
        smooth, alone = rim.smooth, rim.alone
        points = [found.front[:2], found.beyond[:2], rim.bend, rim.far, rim.beside]
        told = None
        if view.cast is not None and found.half_way is not None:
            told, (lit_around, *parted) = _told(view, view.cast, pieces.pixel, found, len(points))
            smooth, alone = (given & ~parted[0] for given in (smooth, alone))
            at_centre = [own & ~part for own, part in zip(at_centre, parted, strict=True)]
            points[1] = points[1][0], _where(lit_around, found.half_way, points[1][1])
        front, beyond, bend, far, beside = _shade(view, method, told, *points)
        behind = jnp.where(found.beyond.face >= 0, beyond, behind)
        integral, moved, steep = colors_along(
            rim, found.centre_depth, front, bend, far, near, inner, beside
        )
        follows, carried = smooth & ~alone, alone
        if view.meaned is not None:
            meaned = stored(view.meaned.reshape(-1)[number_of_pixel(view, pieces.pixel)])
            carried = carried & ~(smooth & meaned)  # what is round a lip is part of that mean
        jump = behind - jnp.where(follows | carried, moved, front)
        if method.capacity:  # what is inwards of a thin face moves with its inner edge
            inner_edge, inner_motion, before_eye = motion_of_inner_edge(
                view.positions_clip, view.size, segments, pieces, found
            )
            thin = follows & rim.thin & before_eye
            opening = stored(jnp.where(thin, (front + bend) / 2 - moved, 0))
            jump = jump - opening
        replaced = (follows | (alone & steep)) & (found.front.look == 4)
        turn = length * (integral - mean_of_rows(rim.reaches) * near)
        own = stored(_colors(view.image, centre))
        value = jnp.where(smooth, area * (behind - near) + turn, area * (behind - front))
        if view.meaned is not None:
            first, second = (meaned & own for own in at_centre)
            value = jnp.where(first, area * (behind - own), value)
            value = jnp.where(second, value + area * (own - behind), value)
        value = jnp.where(found.wrong_side, value + front - own, value)
    jump, value, front, behind = stored_together((jump, value, front, behind))
    size = reduce(jnp.maximum, jnp.abs(behind) + jnp.abs(front))
    used = found.visible & (found.fold | (reduce(jnp.maximum, jnp.abs(jump)) > _NO_JUMP * size))
    held = front, behind, jnp.where(smooth, inner, front)
    rim_length = jnp.where(used & replaced, length, 0)
    rim_length = jnp.where(steep, -rim_length, rim_length)
    leaves = area, found.front.look, found.beyond.look
    sums, pixel = _with_values(total.sums, view, pieces.pixel, used, value, held, leaves)
    start, end = segments.vertices[:, pieces.segment]
    rows = (
        jnp.stack([pixel, *places, start, end], axis=-1),
        jump.T,
        jnp.stack([area, rim_length], axis=-1),
        stored(outward * motion_of_edge(segments, pieces, found)).T,
    )
    records = with_rows(total.records, used, rows)
    if method.capacity and method.shader is not None:
        integers = jnp.stack([pixel, *places, *inner_edge], axis=-1)
        rows = integers, opening.T, jnp.zeros_like(rows[2]), stored(inner_motion).T
        records = with_rows(records, used & thin, rows)
    return Blended(records, sums)


def with_line(total: Blended, view: View, method: Method, line: Line) -> Blended:
    """Add lines where surfaces pierce each other."""
    area = stored(area_beyond(line.begin, line.end))
    places = [_place(view, line.pixel, look) for look in line.look]
    if method.shader is None:
        right, left = stored_together([_colors(view.image, place) for place in places])
    else:
        points = [(line.face[i], [b[i] for b in line.barycentrics]) for i in range(2)]
        told = None
        if view.cast is not None and line.half_way is not None:
            told, lit_around = _lit_by_pixels(view, view.cast, line)
            for i, (face, on_line) in enumerate(points):
                half_way = [b[i] for b in line.half_way]
                points[i] = face, _where(lit_around[i], half_way, on_line)
        right, left = _shade(view, method, told, *points)
    jump = stored(right - left)
    value = area * jump
    leaves = area, line.look[1], line.look[0]
    sums, own = _with_values(total.sums, view, line.pixel, line.used, value, (right, left), leaves)
    corners = view.faces[line.face].transpose(0, 2, 1).reshape(3, 2, -1)
    motion = line.motion.reshape(3, 6, -1)
    use = jnp.stack([line.used] * 3)
    records = with_lines(total.records, use, own, places, jump.T, area, corners, motion)
    return Blended(records, sums)


def _lit_by_pixels(
    view: View, cast: Cast, line: Line
) -> tuple[Int[Array, "lights points"], list[Bool[Array, " n"]]]:
    """What pixels tell of the light on both sides: of what the centre shows, and that it is dark.

    On the line itself a shadow may begin that is all but out of sight. Also on which sides no pixel
    shows one, and no outline is drawn.
    """
    told, lit_around = [], []
    for look, face in zip(line.look, line.face, strict=True):
        _, around, parted = light_told(cast, view.face_image, line.pixel, face)
        asked = (look != 4) & ((around > 0) | parted)
        told.append(jnp.where(line.used, jnp.maximum(jnp.where(asked, -1, around), -1), 0))
        lit_around.append(stored(jnp.any(asked, axis=0) & ~jnp.any(parted, axis=0)))
    return jnp.concatenate(told, axis=1), lit_around


def with_shadow(total: Blended, view: View, method: Method, line: Shadow) -> Blended:
    """Add lines across which a light begins."""
    assert method.glow is not None
    assert view.cast is not None
    area = stored(area_beyond(line.begin, line.end))
    barycentrics = _on_faces(view, line.face, line.barycentrics)
    colors = method.glow(view.scene, line.light, line.face, barycentrics)
    glow = jnp.stack(stored_together(colors))
    to_lit = jnp.where(line.lit_on_right, 1, -1)
    jump = stored(to_lit * glow)
    own = stored(_colors(view.image, _place(view, line.pixel, 4)))
    value = area * jump
    # How dark the ground is that the centre does not show is not known.
    darkens = jnp.where(line.on_centre, line.centre_is_lit, area * to_lit < 0)
    held = own, jnp.where(darkens, jnp.where(line.on_centre, own - glow, 0), own + glow)
    leaves = area, line.look[1], line.look[0]
    sums, number = _with_values(total.sums, view, line.pixel, line.used, value, held, leaves)
    places = [_place(view, line.pixel, look) for look in line.look]
    use = jnp.stack([line.used] * 3 + [line.used & view.cast.parallel])
    vertices, motion = line.vertices, line.motion
    records = with_lines(total.records, use, number, places, jump.T, area, vertices, motion)
    return Blended(records, sums)


def _with_values(
    total: Sums | None,
    view: View,
    pixel: Int[Array, "2 n"],
    used: Bool[Array, " n"],
    value: Float[Array, "channels n"],
    held: Sequence[Float[Array, "channels n"]],
    leaves: tuple[Float[Array, " n"], Int[Array, " n"], Int[Array, " n"]],
) -> tuple[Sums | None, Int[Array, " n"]]:
    """Add values to pixels and widen the range of their colours; also the pixels' numbers.

    What one of the 3×3 pixels shows leaves an area to what another one does.
    """
    number = stored(jnp.where(used, number_of_pixel(view, pixel), view.face_image.size))
    if total is None:
        return None, number
    added = total.added.at[number].add(stored(value).T, mode="drop")
    low, high = total.range
    low = low.at[number].min(stored(reduce(jnp.minimum, held)).T, mode="drop")
    high = high.at[number].max(stored(reduce(jnp.maximum, held)).T, mode="drop")
    left = total.left
    if left is not None:
        area, here, there = leaves
        share = jnp.where(here == 4, area, 0) - jnp.where(there == 4, area, 0)
        steps = stored(jnp.round(LEFT_STEPS * share).astype(left.dtype))
        left = left.at[number].add(steps, mode="drop")
    return Sums(added, (low, high), left), number


def with_sums(
    image: Array, sums: Sums, *, in_place: bool = False
) -> Float[Array, "height width channels"]:
    """The image, of which a border is cut off, with what is added; no pixel beyond what it holds.

    In place it is what is added that is written over: one more image can be more than memory is
    kept for. What comes out of one loop XLA writes over only in another. The factor is for what is
    done with the image next: XLA's CPU code for sums of images alone takes 18 times as long as that
    with a number in them.
    """
    shape = image.shape[0] - 2, image.shape[1] - 2, image.shape[2]
    added, low, high = (part.reshape(shape) for part in (sums.added, *sums.range))

    def within(added: Array) -> Array:
        return jnp.clip(image[1:-1, 1:-1] + added, low, high)

    if not (in_place and draws_on_cpu()):
        return within(added)
    witness = sums.added[0, 0]
    return (1 + zero_after(witness)) * stepped(within, added, witness)


def cropped(colors: Array, shape: tuple[int, ...]) -> Array:
    """Colours of pixels with a border of one, without it."""
    return colors.reshape(shape)[1:-1, 1:-1].reshape(-1, shape[-1])
