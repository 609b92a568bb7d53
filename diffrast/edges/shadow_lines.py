"""Outlines of shadows: lines along which a light's shadow planes meet the faces that are seen.

A light and an edge span a plane, and where it meets the plane of a face the shadow of the edge
falls on that face: along a straight line on the screen. It is drawn on each face that is seen at
the pixels round one, and cut to that pixel, to the face and, at a corner of the outline, where the
next line begins; then it parts areas as an edge of a mesh does.

With the face's plane (r, r') and the shadow's (p, p'), see `shadow_planes`: where the corners of
the shadow plane move, what it says of a point M = α light + β start + γ end changes by −p ·
(α dlight + β dstart + γ dend) − p' α dh of the light; and where those of the face do,
the point seen at a place of the screen moves along the line of sight.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._selection import divided, selected
from diffrast._stored import stored, stored_together
from diffrast.edges.follow import follow
from diffrast.edges.neighborhood import Surface, first_row, picked, pixels_round, steps_to, walk
from diffrast.edges.pieces import positive_part
from diffrast.edges.planes import (
    TOLERANCE,
    Columns,
    barycentrics,
    corners_of,
    dot_rows,
    edge_functions,
    edge_values,
    from_centre,
    largest,
    room_in_pixel,
)
from diffrast.edges.shadow_ends import (
    ONE_LINE,
    REACH,
    ROUNDED,
    common,
    continued,
    enter,
    past_centre,
    same_place,
    uncovered,
)
from diffrast.edges.shadow_overlap import Lines, left_by_others, overlap
from diffrast.edges.shadow_pairs import (
    DIRECTION,
    FIRST,
    NEAREST,
    ON_BOTH,
    ON_SECOND,
    SECOND,
    Cast,
    decoded,
    on_ground,
)
from diffrast.edges.shadow_planes import (
    Plane,
    behind_edge,
    edge_plane,
    end_plane,
    face_plane,
    line_of,
    meeting,
    nonzero,
    shadow_plane,
)

PIXELS_AT_ONCE = 512
LINES_AT_ONCE = 256
_EDGES = 4  # whose shadows part a pixel, at most,
_FACES = 4  # on so many faces
_BESIDE = 0.25  # pixels: how far beyond two of them a line may pass that parts them
_EDGE_ON = 1e-4  # of its size: how far a face reaches out of the plane through light and edge


class Places(NamedTuple):
    """Pixels that outlines of a light's shadows may part."""

    light: Int[Array, " n"]
    rows: Int[Array, "2 n"]  # of positions, with the light and with its weight
    pixel: Int[Array, "2 n"]  # column and row


class Outlines(NamedTuple):
    """Lines that may part pixels: of edges on faces."""

    places: Places
    face: Int[Array, "faces n"]  # on which the shadows fall
    corners: Float[Array, "3 3 faces n"]  # of them, from the pixel's centre
    edge: Int[Array, "edges n"]  # 3 * face + corner
    vertices: Int[Array, "2 edges n"]
    ends: Float[Array, "2 3 edges n"]  # of the edges, from the pixel's centre
    source: Float[Array, "3 n"]  # the light, likewise
    weight: Float[Array, " n"]  # and its h
    lit_on_right: Bool[Array, "edges faces n"]
    looks: Int[Array, "2 edges n"]  # 0 to 8: of two pixels that they part the lit and the dark one
    hider: Int[Array, "edges n"]  # what may hide where the shadow begins or ends; -1: nothing
    centre_is_lit: Bool[Array, " n"]  # in the image
    on_centre: Bool[Array, " n"]  # whether that shows what the shadows fall on
    alone: Bool[Array, " n"]  # whether there is one line only, and the centre turns to the light
    shift: Float[Array, "2 n"]  # of all lines of a pixel: see `past_centre`
    range: Float[Array, "2 edges faces n"]  # begin and end, from the point next to the centre
    lines: Int[Array, " list"]  # (edge * faces + face) * n + number of the pixel
    total: Int[Array, ""]  # of lines


class Shadow(NamedTuple):
    """Lines, one in each of n pixels."""

    pixel: Int[Array, "2 n"]
    light: Int[Array, " n"]
    used: Bool[Array, " n"]
    face: Int[Array, " n"]  # on which it lies,
    barycentrics: Columns  # and where its middle does
    look: Int[Array, "2 n"]  # 0 to 8: pixels on the right and on the left
    lit_on_right: Bool[Array, " n"]
    centre_is_lit: Bool[Array, " n"]  # in the image
    on_centre: Bool[Array, " n"]  # whether that shows this surface
    begin: Float[Array, "2 n"]  # ends, from the pixel's centre
    end: Float[Array, "2 n"]
    vertices: Int[Array, "4 2 n"]  # start and end of the edge; the face's corners; the light; and
    # twice the row of its weight
    motion: Float[Array, "4 6 n"]  # area on the right with x, y and w of these


@jax.jit
def cross_shadows(
    places: Places,
    exists: Bool[Array, " n"],
    cast: Cast,
    surface: Surface,
    face_image: Int[Array, "height_with_border width_with_border"],
) -> Outlines:
    """Find the lines at these places: of each edge on each face on which its shadow may fall."""
    light, rows, pixel = places
    faces, pixels, topology, _ = surface

    def place(vertex: Array) -> Array:
        return from_centre(pixels[:, vertex], pixel)

    # The faces round the pixel and beside its own, and those of its surface that are turned to the
    # light.
    column, row = pixel[:, None] + 1 + steps_to(jnp.arange(9, dtype=jnp.int32))[..., None]
    shown = stored(pixels_round(face_image, *pixel))
    seen = jnp.maximum(shown, 0)
    own, patch = shown[4], stored(cast.patches[seen])
    lit = stored(cast.lit[light, row, column])

    codes = stored(cast.between[light, DIRECTION[:, None], row[FIRST], column[FIRST]])
    between, on_one = decoded(codes)
    exists = exists & (between >= 0)
    on_patch = on_ground(on_one, patch[FIRST], patch[SECOND])
    on_own = exists & (on_patch == patch[4]) & (own >= 0)
    # Where no outline passes on what the centre shows, one may on what is seen beside that.
    on_other = exists & ~jnp.any(on_own, axis=0)
    other = first_row(on_other)
    grounds = on_ground(on_one, *jnp.asarray([FIRST, SECOND])[..., None])
    home = stored(jnp.where(other < len(FIRST), picked(grounds, other), 4))
    ground_patch = picked(patch, home)
    same = (shown >= 0) & (patch == ground_patch)
    counts = stored(same & cast.turned[light, seen])
    known, between = stored(((on_own | on_other) & (on_patch == ground_patch), between))
    pair, found = _unlike(between, known, _EDGES)
    looks = jnp.stack([jnp.asarray(FIRST)[pair], jnp.asarray(SECOND)[pair]])
    edge, on_one = stored(decoded(jnp.stack([picked(codes, k) for k in pair])))
    is_second, is_hidden = on_one == ON_SECOND, on_one != ON_BOTH
    near, far = on_ground(on_one, looks, looks[::-1])
    first_is_lit = jnp.stack([picked(lit, k) for k in near]) != is_second
    hider = jnp.where(is_hidden, jnp.stack([picked(shown, k) for k in far]), -1)
    hider = jnp.where(same[4], hider, own)
    shows_ground = jnp.where(is_hidden, near, looks)
    looks = lit_look, dark_look = jnp.where(first_is_lit, looks, looks[::-1])

    def beside(face: Array) -> tuple[Array, Array]:
        """The faces beside each, and whether the surface goes on there, turned to the light."""
        joined = stored(jnp.moveaxis(topology.neighbors[face], -1, 0))
        there = jnp.maximum(joined, 0)
        goes_on = (joined >= 0) & cast.turned[light, there] & (cast.patches[there] == ground_patch)
        return joined, stored(goes_on)

    joined, joins = beside(picked(seen, home))
    around = jnp.concatenate([picked(shown, home)[None], joined, shown[NEAREST[1:]]])
    turned = picked(counts, home)[None]
    falls = jnp.concatenate([turned, joins & turned, counts[NEAREST[1:]]])
    which, received = _unlike(around, falls, _FACES)
    ground_face = jnp.stack([picked(around, k) for k in which])
    is_own = received & (ground_face == own)

    caster, third = divided(jnp.maximum(edge, 0), 3)
    vertices = stored(jnp.stack([faces[caster, (third + k) % 3] for k in (1, 2)]))
    ends = [place(vertex) for vertex in vertices]
    corners = place(faces.T[:, jnp.maximum(ground_face, 0)])
    source = place(rows[0])
    weight = cast.weight[light]

    # Of each edge (rows) on each face (columns).
    ground, shadow = face_plane(corners), shadow_plane(source[:, None], weight, *ends)
    tip = place(faces[caster, third])
    above = dot_rows(shadow.normal, tip) + shadow.offset
    # Twice as far as from the other end of those that it has a vertex in common with.
    from_edges = [
        dot_rows(shadow.normal[:, :, None], end[:, None]) + shadow.offset[:, None] for end in ends
    ]
    ends_of = [end_plane(source[:, None], weight, shadow, *way) for way in (ends, ends[::-1])]
    behind = behind_edge(source[:, None], weight, shadow, *ends)
    ground = Plane(ground.normal[:, None], ground.offset[None])
    shadow, behind, *ends_of = (
        Plane(p.normal[:, :, None], p.offset[:, None]) for p in (shadow, behind, *ends_of)
    )
    enters, rises = enter(ground, source, weight, ends)
    normal, foot, inverse = stored(line_of(ground, shadow))
    # It is dark on the side of the face that casts the shadow; unless that is seen edge-on by the
    # light, when the two pixels tell.
    tells = jnp.abs(above) > _EDGE_ON * largest(tip - ends[0])
    to_lit = (steps_to(lit_look) - steps_to(dark_look))[:, :, None]
    lit_on_right = jnp.where(tells[:, None], above[:, None] <= 0, dot_rows(normal, to_lit) > 0)
    outwards = jnp.where(lit_on_right, 1, -1) * normal
    dark_sign = jnp.where(lit_on_right[:, :1], -1, 1)
    on_dark_side = stored((from_edges[0] + from_edges[1]) * dark_sign > 0)
    beyond = dot_rows(outwards, foot)  # less than this along `outwards` it is dark
    # Of an edge that hides something else the line passes elsewhere.
    outer, inner = (dot_rows(outwards, steps_to(look)[:, :, None]) - beyond for look in looks)
    passes = (inverse > 0) & (inner < _BESIDE) & (outer > -_BESIDE)
    of_pair = jnp.broadcast_to(is_own, passes.shape)
    for look in looks:
        of_pair = of_pair | (jnp.stack([picked(shown, k) for k in look])[:, None] == ground_face)
    valid = found & jnp.any(of_pair & received & passes & rises, axis=1)
    usable = valid[:, None] & received & (inverse > 0)

    # Outlines of one shadow go on in the next edge.
    meets = [same_place(end, ends) & valid[:, None] & valid for end in ends]
    linked = meets[0] | meets[1]
    body = jnp.zeros_like(caster) if topology.bodies is None else topology.bodies[caster]
    lines = Lines(
        outwards=outwards[:, :, 0],
        beyond=beyond[:, 0],
        valid=valid,
        linked=linked,
        corner=linked & on_dark_side,
        alike=(body[:, None] == body) & valid[:, None] & valid,
    )
    shared = overlap(lines, lit, counts, is_own[0])
    chosen = shared.chosen

    along = REACH * jnp.stack([-normal[1], normal[0]])
    limits = [meeting(ground, plane) for plane in (*ends_of, behind)]
    # Of those that begin or end behind something no pixel may show which one they go on in.
    at_ends = [(jnp.any(meet & chosen, axis=1) | is_hidden)[:, None] for meet in meets]
    cut = [*at_ends, enters]

    def inside(at: Array) -> list[Array]:
        x, y = at
        ends_here = [
            jnp.where(is_cut, a * x + b * y + c, 1)
            for is_cut, (a, b, c) in zip(cut, limits, strict=True)
        ]
        return room_in_pixel(x, y) + ends_here

    zero = jnp.zeros_like(source[0])
    both_ends = foot - along, foot + along
    in_pixel = positive_part(*map(inside, both_ends))
    in_pixel = common(in_pixel, left_by_others(shared, outwards, beyond, both_ends))
    values = [edge_values(corners[:, :, None], x, y, near=(zero, zero))[0] for x, y in both_ends]
    _, goes_on = beside(ground_face)
    ends_there = [
        [jnp.where(on, 1, v) for on, v in zip(goes_on, end, strict=True)] for end in values
    ]
    on_face, on_surface = positive_part(*values), positive_part(*ends_there)
    low, high = continued(
        common(in_pixel, on_face), common(in_pixel, on_surface), usable, foot, along
    )
    drawn = chosen[:, None] & usable & (low < high)
    range_ = stored(REACH * (2 * jnp.stack([low, high]) - 1))
    alone = counts[4] & (jnp.sum(drawn, axis=(0, 1)) == 1)
    passed = alone | ((range_[0] < ROUNDED) & (range_[1] > -ROUNDED))
    passed = drawn & counts[4] & passed & (jnp.abs(beyond) < ROUNDED)
    drawn_lines, total = selected(drawn.reshape(_EDGES * _FACES, -1))
    return Outlines(
        places=places,
        face=ground_face,
        corners=corners,
        edge=edge,
        vertices=vertices,
        ends=jnp.stack(ends),
        source=source,
        weight=weight,
        lit_on_right=lit_on_right,
        looks=jnp.where(first_is_lit, shows_ground, shows_ground[::-1]),
        hider=hider,
        centre_is_lit=lit[4],
        on_centre=same[4],
        alone=alone,
        shift=past_centre(outwards, beyond, passed, lit[4]),
        range=range_,
        lines=drawn_lines,
        total=total,
    )


def _unlike(values: Array, used: Array, count: int) -> tuple[Int[Array, "count n"], Array]:
    """Rows of the first values that are used and unlike each other, and whether there are so many.

    Rows that are not there are the first.
    """
    before = jnp.tri(values.shape[0], k=-1, dtype=bool)[..., None]
    again = jnp.any(before & (values[:, None] == values) & used, axis=1)
    new = used & ~again
    number = jnp.where(new, jnp.cumsum(new, axis=0) - 1, -1)
    rows = jnp.stack([first_row(number == k) for k in range(count)])
    return stored_together((jnp.where(rows < values.shape[0], rows, 0), rows < values.shape[0]))


@jax.jit
def shadow_of(
    outlines: Outlines,
    line: Int[Array, " n"],
    exists: Bool[Array, " n"],
    cast: Cast,
    surface: Surface,
    face_image: Int[Array, "height_with_border width_with_border"],
) -> Shadow:
    """These lines, and how they move."""
    faces = surface.faces
    row, place = divided(line, outlines.weight.size)
    number, column = divided(row, _FACES)

    def of_edge(values: Array) -> Array:
        return values[..., number, place]

    def one(values: Array) -> Array:
        return values[..., number, column, place]

    (light, rows_of_light, pixel), source, weight = stored_together(
        jax.tree.map(
            lambda values: values[..., place],
            (outlines.places, outlines.source, outlines.weight),
        )
    )
    face, corners = stored_together(
        (outlines.face[column, place], outlines.corners[..., column, place])
    )
    centre_is_lit, alone = outlines.centre_is_lit[place], outlines.alone[place]
    start, end = stored_together((of_edge(outlines.ends[0]), of_edge(outlines.ends[1])))
    ground, shadow = face_plane(corners), shadow_plane(source, weight, start, end)
    normal, foot, inverse = line_of(ground, shadow)
    foot = foot + stored(outlines.shift[:, place])
    along = jnp.stack([-normal[1], normal[0]])
    low, high = stored_together((one(outlines.range[0]), one(outlines.range[1])))

    whole = foot + low * along, foot + high * along
    # What hides where it begins may go on over the line, in faces that no pixel shows.
    places = jnp.stack([whole[0], foot + (low + high) / 2 * along, whole[1]], axis=1)
    there_x, there_y = stored((pixel[:, None].astype(places.dtype) + 0.5) + places)
    covering, _ = walk(jnp.stack([of_edge(outlines.hider)] * 3), there_x, there_y, surface)
    edge = of_edge(outlines.edge)
    at, hides = _before(pixel, edge, covering, face, cast, surface, face_image)
    first, last = (stored(jnp.stack([*point, _nearness(ground, *point)])) for point in whole)
    # What hides one of its sides, and ends in one line with it, leaves nothing of it to be seen;
    # unless it passes a centre that shows the ground, and is told to be on the hidden side.
    lit_on_right = one(outlines.lit_on_right)
    other_side = ONE_LINE * jnp.where(lit_on_right == centre_is_lit, -normal, normal)
    told = outlines.on_centre[place] & (jnp.hypot(*foot) < ROUNDED)
    sides = [
        jnp.stack([*side, jnp.zeros_like(foot[0])])
        for side in (other_side, jnp.where(told, other_side, -other_side))
    ]
    bare = common(*(uncovered(first + side, last + side, at, hides) for side in sides))
    bare = common(bare, _out_of(covering[::2], (first, last), pixel, surface))
    low, high = stored_together([low + part * (high - low) for part in bare])
    exists = exists & (low < high)
    x, y = middle = foot + (low + high) / 2 * along
    centre_on_right = dot_rows(foot, normal) < 0
    # What a line bounds may be dark or lit for another reason.
    wrong_side = alone & ((lit_on_right == centre_on_right) != centre_is_lit)

    # The middle as a sum of light, start and end, and as one of the face's corners.
    point = jnp.stack([x, y, jnp.ones_like(x)])
    depth = _nearness(ground, x, y)
    planes = [
        end_plane(source, weight, shadow, end, start),
        end_plane(source, weight, shadow, start, end),
        edge_plane(shadow, start, end),
    ]
    ways = [start - end, end - start, source - weight * start]
    shares = [
        (dot_rows(plane.normal, point) + plane.offset * depth)
        / nonzero(dot_rows(plane.normal, away))
        for plane, away in zip(planes, ways, strict=True)
    ]
    e, volume = edge_functions(corners, x, y)
    per_plane = (high - low) * inverse
    turn = per_plane * shadow.offset / nonzero(volume)
    motions = [-per_plane * ground.offset * share * shadow.normal for share in shares]
    weight_motion = -per_plane * ground.offset * shares[2] * shadow.offset
    corner_motions = [turn * value * ground.normal for value in e]
    rows = [motions[:2], corner_motions[:2], [corner_motions[2], motions[2]]]
    of_pairs = [jnp.concatenate([_of_screen(m, pixel) for m in row]) for row in rows]
    of_weight = jnp.zeros_like(of_pairs[0]).at[2].set(weight_motion)
    motion = jnp.stack([*of_pairs, of_weight])
    lamp, its_weight = rows_of_light
    vertices = [*of_edge(outlines.vertices), *faces[face].T, lamp, its_weight, its_weight]

    looks = of_edge(outlines.looks)
    return Shadow(
        pixel=pixel,
        light=light,
        used=exists & ~wrong_side,
        face=face,
        barycentrics=barycentrics(e),
        look=jnp.where(lit_on_right, looks, looks[::-1]),
        lit_on_right=lit_on_right,
        centre_is_lit=centre_is_lit,
        on_centre=outlines.on_centre[place],
        begin=middle - (high - low) / 2 * along,
        end=middle + (high - low) / 2 * along,
        vertices=jnp.stack(vertices).reshape(4, 2, -1),
        motion=jnp.where(exists, motion, 0),
    )


def _out_of(
    covering: Int[Array, "2 n"],
    ends: tuple[Float[Array, "3 n"], Float[Array, "3 n"]],
    pixel: Int[Array, "2 n"],
    surface: Surface,
) -> tuple[Array, Array]:
    """What parts of lines, 0 to 1, surfaces leave whose faces cover their begins and ends."""

    def corners(face: Array) -> Array:
        at = jnp.concatenate([pixel, pixel], axis=1)
        return from_centre(corners_of(face, surface.faces, surface.pixels), at)

    (x, y, nearness), (to_x, to_y, _) = (jnp.concatenate(way, axis=1) for way in (ends, ends[::-1]))
    face, zero = covering.reshape(-1), jnp.zeros_like(x)
    _, depth = edge_values(corners(face), x, y, near=(zero, zero))
    hides = (face >= 0) & (depth > nearness * (1 + TOLERANCE))
    start, way = stored((jnp.where(hides, face, -1), [[x, y], [to_x, to_y]]))
    edge, part = follow(start, surface.topology.neighbors, corners, way)
    part = jnp.where(hides, jnp.where(edge >= 0, part, 1), 0)
    low, high = part.reshape(2, -1)
    return low, 1 - high


def _before(
    pixel: Int[Array, "2 n"],
    edge: Int[Array, " n"],
    covering: Int[Array, "3 n"],
    face: Int[Array, " n"],
    cast: Cast,
    surface: Surface,
    face_image: Int[Array, "height_with_border width_with_border"],
) -> tuple[Float[Array, "3 3 faces n"], Bool[Array, "faces n"]]:
    """Corners of faces that may hide the shadows of edges on other faces, and which of them do.

    What is seen at the pixels round each, but for the surface of the other face, what is at the
    edges, and what is known to be `covering` places of the lines.
    """
    faces, pixels, topology, volume = surface
    caster, third = divided(jnp.maximum(edge, 0), 3)
    at_edge = jnp.stack([caster, topology.neighbors[caster, third]])
    around = stored(pixels_round(face_image, *pixel))
    others = jnp.concatenate([around, at_edge, covering])
    there = jnp.maximum(others, 0)
    hides = (others >= 0) & (volume[there] != 0) & (cast.patches[there] != cast.patches[face])
    return from_centre(corners_of(others, faces, pixels), pixel), stored(hides)


def _nearness(plane: Plane, x: Array, y: Array) -> Array:
    """1/w of a face's plane at points of the screen."""
    normal = plane.normal
    return -(normal[0] * x + normal[1] * y + normal[2]) / nonzero(plane.offset)


def _of_screen(motion: Array, pixel: Array) -> Array:
    """By x, y and w of the screen what is given by those from a pixel's centre."""
    x, y, w = motion
    column, row = pixel.astype(w.dtype) + 0.5
    return jnp.stack([x, y, w - column * x - row * y])
