"""The edges whose shadows pass between neighbouring pixels.

Of two neighbouring pixels that show one surface one may be lit and the other hidden from the light
by a face. Seen by the light, a straight line leads from the hidden point to the lit one: it is
followed from that face to the next across their common edge, to where the surface ends or turns
away from the light. Where something else hides the light just beyond, that is followed on, until
nothing does. The last edge has the outline of the shadow that passes between the two pixels,
whatever the size of faces and texels. Indices only: no derivatives.

Where they show two surfaces, each of these may be lit at one and dark at the other, too: a shadow
begins under the outline of what casts it, on the farther one, or ends shortly before the nearer one
does. There the point of the surface's plane at the other pixel, behind what that shows or beyond
the surface's end, is the lit or the dark one; before the former light has to come in. One edge is
kept of two pixels, that on the nearer surface before that on the farther one.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int, Shaped

from diffrast._device import anywhere, lanes, over_views
from diffrast._selection import divided, integers, over_batches, selected
from diffrast._stored import stored, zero_after
from diffrast._topology import Topology
from diffrast.edges.follow import covering, follow, leaves
from diffrast.edges.neighborhood import Surface, first_row, picked, walk
from diffrast.edges.pieces import depth_of, facing, scale_by_depth, to_pixels
from diffrast.edges.planes import Table, barycentrics, corners_of, edge_functions, edge_values
from diffrast.edges.shadow_pairs import (
    CODES,
    ON_BOTH,
    ON_FIRST,
    ON_SECOND,
    coded,
    decoded,
    on_ground,
)
from diffrast.geometry import Geometry, Points, positions_at
from diffrast.light import Light, casts_shadow
from diffrast.raster.evaluate import unit_of
from diffrast.shadows.cast import Shadows, by_resolution, shone_on
from diffrast.shadows.maps import Pictures
from diffrast.shadows.near import Rays, face_corners, faces_near, line_of, seen_by_light
from diffrast.shadows.views import cube_side, sides

_AT_ONCE = 256
_LOOKS = 8  # from one outline to the next
_PAST = 1e-3  # of the way: how far past what is lit, by rounding, its outline may be
_BEYOND = 1 / 64  # of the way from an outline to what is lit: where the next one is looked for

_Look = tuple[Array, Rays, Array]


class Parted(NamedTuple):
    """Neighbouring pixels that show one surface, lit at one of them only.

    Left out are those whose dark one faces away from the light, or lies beyond the cone of a spot,
    as no shadow falls there; and where no edge is known, those between which the surface folds or
    turns away from the light, as that is what parts them.
    """

    edge: Int[Array, "lights 2 height width"]  # 3 * face + corner, or -1
    pairs: Int[Array, " lights"]  # how many there are
    found: Int[Array, " lights"]  # and between how many of them an outline passes that is known


class _Lamps(NamedTuple):
    """The lights of some pictures."""

    first: Int[np.ndarray, " lights"]  # picture of each
    cube: Bool[np.ndarray, " lights"]  # six pictures, the sides of a cube
    turned: Bool[Array, "lights faces"]  # faces that turn their outside to each


def outlines(
    lights: tuple[Light, ...],
    shadows: Shadows,
    topology: Topology,
    positions_clip: Float[Array, "V 4"],
    points: Points,
    lit: Bool[Array, "lights height width"],
) -> Int[Array, "lights 2 height width"]:
    """For each light with shadows and each pixel the edges between it and the next ones.

    Args:
        lights: of the scene.
        shadows: of these lights.
        topology: of its faces.
        positions_clip: of its vertices.
        points: what each pixel sees.
        lit: whether each of the lights with shadows reaches it.

    Returns:
        `coded` edges, or -1: between the pixel and that on its right, and that below it.
    """
    casting = [light for light in lights if casts_shadow(light)]
    geometry = shadows.geometry
    positions_clip, points = lax.stop_gradient((positions_clip, points))
    found: dict[int, Array] = {}
    with jax.named_scope("outlines"):
        for pictures, (_, members) in zip(shadows.pictures, by_resolution(casting), strict=True):
            counts = [sides(casting[i]) for i in members]
            lamps = _Lamps(
                first=np.cumsum([0, *counts[:-1]]),
                cube=np.array(counts) > 1,
                turned=jnp.stack([shadows.turned[i] for i in members]),
            )
            between = over_views(_between_pixels, points.face.size)
            lit_by = lit[np.array(members)]
            edges = between(lamps, pictures, geometry, topology, positions_clip, points, lit_by)
            found.update(zip(members, edges, strict=True))
    return jnp.stack([found[i] for i in range(len(casting))])


def _between_pixels(
    lamps: _Lamps,
    pictures: Pictures,
    geometry: Geometry,
    topology: Topology,
    positions_clip: Float[Array, "V 4"],
    points: Points,
    lit: Bool[Array, "lights height width"],
) -> Int[Array, "lights 2 height width"]:
    height, width = points.face.shape
    face, bright = points.face.reshape(-1), lit.reshape(len(lamps.first), -1)
    shares = jnp.stack([part.reshape(-1) for part in points.barycentrics])
    scale = stored(scale_by_depth(depth_of(positions_clip), positions_clip))
    pixels = positions_clip * (scale / unit_of(positions_clip))[:, None]
    pixels = stored(to_pixels(pixels, height, width))

    def of_pair(number: Array) -> tuple[Array, Array]:
        """The lights of pairs, and their two pixels."""
        pair, at = divided(number, height * width)
        lamp, is_below = divided(pair, 2)
        return stored((lamp, jnp.stack([at, at + jnp.where(is_below == 0, 1, width)])))

    def grounds_of(number: Array) -> tuple[Array, Array]:
        """On the surfaces of which of them shadows may begin or end between them, -1 on none.

        First on the nearer one, then on the farther one, or the one that both show. Also the
        barycentric coordinates of where the plane of what each shows is at the other one.
        """
        lamp, at = of_pair(number)
        shown = stored(face[at])
        patch, turned = stored((topology.patches[shown], lamps.turned[lamp, shown]))
        is_lit = bright[lamp, at]
        parts = (is_lit[0] != is_lit[1]) & jnp.where(is_lit[0], turned[1], turned[0])
        corners = corners_of(shown, geometry.faces, pixels)
        row, column = (place.astype(pixels.dtype) + 0.5 for place in divided(at, width))
        _, nearness = edge_values(corners, column, row)
        values, there = edge_values(corners, column[::-1], row[::-1])
        apart = patch[0] != patch[1]
        possible, hidden = apart & turned & (there > 0), there < nearness[::-1]
        nearer, farther = (
            jnp.where(first, ON_FIRST, jnp.where(second, ON_SECOND, -1))
            for first, second in (possible & ~hidden, possible & hidden)
        )
        grounds = jnp.stack([nearer, jnp.where(~apart & parts, ON_BOTH, farther)])
        grounds = jnp.where(jnp.min(shown, axis=0) < 0, -1, grounds)
        scales = stored(scale[stored(geometry.faces.T[:, jnp.maximum(shown, 0)])])
        return stored((grounds, jnp.stack(barycentrics([*(scales * jnp.stack(values))]))))

    patch = topology.patches[points.face]
    differs = _side_by_side(lit, jnp.not_equal) | _side_by_side(patch, jnp.not_equal)
    order, count = selected(differs, lambda number: jnp.max(grounds_of(number)[0], axis=0) >= 0)

    def look(number: Array, exists: Array, codes: Array) -> Array:
        (grounds, extended), (lamp, at) = grounds_of(number), of_pair(number)

        def on(which: Array, code: Array) -> Array:
            ground = grounds[which]
            unsure = ground != ON_BOTH
            home, away = on_ground(ground, at, at[::-1])
            own = stored(face[home])
            there = on_ground(ground, extended[:, 0], extended[:, 1])
            there = jnp.where(unsure, there, shares[:, away])
            ends = [
                Points(own, list(shares[:, home]), home),
                Points(jnp.where(unsure, own, face[away]), list(there), away),
            ]
            is_lit = bright[lamp, home]
            dark, lit_end = _where(is_lit, ends[1], ends[0]), _where(is_lit, ends[0], ends[1])
            guessed = jnp.stack([unsure & is_lit, unsure & ~is_lit])
            asked = exists & (ground >= 0) & (code < 0)
            edge = _edge_between(
                lamps, lamp, asked, guessed, pictures, geometry, topology, *stored((dark, lit_end))
            )
            return jnp.where(asked, coded(edge, ground), code)

        code = lax.fori_loop(0, len(grounds), on, jnp.full_like(number, -1))
        place = jnp.where(exists, number, codes.size)
        return codes.at[place].set(code.astype(codes.dtype), mode="drop")

    held = integers(CODES * len(geometry.faces))
    none = jnp.full(differs.size, -1, held) + zero_after(count).astype(held)
    return over_batches(order, count, lanes() * _AT_ONCE, look, none).reshape(differs.shape)


def _where(chosen: Bool[Array, " n"], one: Points, other: Points) -> Points:
    """The first ones where they are chosen, else the second ones."""
    return jax.tree.map(partial(jnp.where, chosen), one, other)


def _side_by_side(
    images: Shaped[Array, "*images height width"], compare: Callable[[Array, Array], Array]
) -> Bool[Array, "*images 2 height width"]:
    """What comparing pixels with those on their right, and those below them, says; else false."""
    right = compare(images[..., 1:], images[..., :-1])
    below = compare(images[..., 1:, :], images[..., :-1, :])
    none = [(0, 0)] * (images.ndim - 2)
    right = jnp.pad(right, [*none, (0, 0), (0, 1)])
    below = jnp.pad(below, [*none, (0, 1), (0, 0)])
    return jnp.stack([right, below], axis=-3)


def parted(
    lights: tuple[Light, ...],
    shadows: Shadows,
    geometry: Geometry,
    topology: Topology,
    points: Points,
    lit: Bool[Array, "lights height width"],
    between: Int[Array, "lights 2 height width"],
    positions_clip: Float[Array, "V 4"],
) -> Parted:
    """Count the pairs between which `outlines` looked for edges, and those with one."""
    height, width = points.face.shape
    edge, _ = decoded(between)
    pixels = to_pixels(positions_clip, height, width)
    volume = facing(pixels, geometry.faces, height=height, width=width)
    shadowed = ~lit & shone_on(lights, shadows, points)
    patch = jnp.where(points.face >= 0, topology.patches[jnp.maximum(points.face, 0)], -1)
    one_surface = _side_by_side(patch, jnp.equal) & _side_by_side(lit, jnp.not_equal)

    def is_parted(turned: Array, dark: Array, pairs: Array, edges: Array) -> Array:
        pairs = pairs & (dark | _next_to(dark))
        searched = pairs & (edges < 0)
        volume_lit = jnp.where(turned, volume, 0)
        joined = _are_joined(points.face, searched, geometry, topology, pixels, volume_lit)
        return pairs & (joined | (edges >= 0))

    of_lights = zip(shadows.turned, shadowed, one_surface, edge, strict=True)
    pairs = jnp.stack([is_parted(*of_light) for of_light in of_lights])
    return Parted(
        edge, jnp.sum(pairs, axis=(1, 2, 3)), jnp.sum(pairs & (edge >= 0), axis=(1, 2, 3))
    )


def _are_joined(
    face: Int[Array, "height width"],
    asked: Bool[Array, "2 height width"],
    geometry: Geometry,
    topology: Topology,
    pixels: Table,
    volume: Float[Array, " F"],
) -> Bool[Array, "2 height width"]:
    """Whether the surface seen at a pixel goes on to the one on its right, and to that below it.

    Over faces that have a `volume`, to where the other pixel's centre shows it.
    """
    row, column = jnp.mgrid[: face.shape[0], : face.shape[1]].astype(pixels.dtype) + 0.5
    x, y = jnp.stack([column + 1, column]), jnp.stack([row, row + 1])
    end, _ = walk(
        jnp.where(asked, face, -1).reshape(1, -1),
        x.reshape(1, -1),
        y.reshape(1, -1),
        Surface(geometry.faces, pixels, topology, volume),
    )
    return asked & (end.reshape(asked.shape) == _next_to(face))


def _next_to(values: Shaped[Array, "height width"]) -> Shaped[Array, "2 height width"]:
    """What the pixels on the right of each and below it hold; of the last ones, the first do."""
    return jnp.stack([jnp.roll(values, -1, axis=1), jnp.roll(values, -1, axis=0)])


def _edge_between(
    lamps: _Lamps,
    lamp: Int[Array, " n"],
    asked: Bool[Array, " n"],
    guessed: Bool[Array, "2 n"],
    pictures: Pictures,
    geometry: Geometry,
    topology: Topology,
    dark: Points,
    bright: Points,
) -> Int[Array, " n"]:
    """The edge whose shadow passes between points in the dark and others in the light.

    Of some it is `guessed` that they are in the dark (0): there is none if they are not. Or in the
    light (1): none if no light comes in on the way there.
    """
    at_dark, at_bright = (
        stored(jnp.stack(positions_at(geometry, points))) for points in (dark, bright)
    )
    picture = stored(_picture(lamps, lamp, at_dark - pictures.plan.origin[lamps.first][lamp].T))
    seen = seen_by_light(pictures, picture)
    ends = []
    for end in (at_dark, at_bright):
        x, y, w = seen(end)
        ends.append(stored([x / jnp.where(w > 0, w, 1), y / jnp.where(w > 0, w, 1)]))
    past = stored([b + _PAST * (b - a) for a, b in zip(*ends, strict=True)])
    zero, unsure = jnp.zeros_like(at_dark[0]), guessed[0] | guessed[1]

    def corners_of(face: Array) -> Array:
        return seen(face_corners(geometry, face))

    def look(state: _Look) -> _Look:
        looks, rays, edge = state
        way = [[rays.x, rays.y], past]
        line = stored(line_of(pictures, rays, face_corners(geometry, rays.face)))
        nearby = faces_near(pictures, geometry, rays, line)
        part, _, volume = leaves(stored(seen(nearby.corners)), way)
        part = jnp.where((nearby.cut.stops > 0) & (volume != 0) & (part < 2), part, -1)
        part = stored(part)
        farthest = jnp.max(part, axis=0)
        nearest = first_row(nearby.key == jnp.max(nearby.key, axis=0))
        row = jnp.where(farthest >= 0, first_row(part == farthest), jnp.minimum(nearest, 8))
        hidden = rays.asked & ((farthest >= 0) | ((looks == 0) & ~unsure))
        # At a guessed end the light may be hidden all the way.
        at_end = rays.asked & guessed[1] & (looks > 0) & jnp.any(nearby.cut.stops > 0, axis=0)
        face = jnp.where(hidden, picked(nearby.face, row), -1)
        face = covering(face, farthest < 0, topology.neighbors, corners_of, way[0])
        following, end = follow(face, topology.neighbors, corners_of, way)

        # What hides the light there may end where something else still does.
        end = end + _BEYOND * (1 - end)
        x, y = (a + end * (b - a) for a, b in zip(*way, strict=True))
        goes_on = following >= 0
        ground = covering(rays.face, goes_on, topology.neighbors, corners_of, [x, y])
        shares = jnp.stack(barycentrics(edge_functions(corners_of(ground), x, y)[0]))
        is_there = jnp.min(shares, axis=0) >= 0
        rays = rays._replace(face=ground, barycentrics=shares, x=x, y=y, asked=goes_on & is_there)
        edge = jnp.where(unsure & (hidden | at_end), -1, edge)
        edge = jnp.where(goes_on & (is_there | ~guessed[1]), following, edge)
        return stored((looks + 1, rays, edge))

    def is_left(state: _Look) -> Array:
        return anywhere((state[0] < _LOOKS) & jnp.any(state[1].asked))

    rays = Rays(
        face=dark.face,
        barycentrics=jnp.stack(dark.barycentrics),
        picture=picture,
        x=ends[0][0],
        y=ends[0][1],
        key=zero,
        unit=zero,
        asked=asked,
    )
    start = jnp.sum(dark.face & 0), rays, jnp.full_like(dark.face, -1)
    return lax.while_loop(is_left, look, start)[-1]


def _picture(lamps: _Lamps, lamp: Int[Array, " n"], offset: Float[Array, "3 n"]) -> Array:
    """Which picture shows points, given from their lights."""
    side = jnp.where(jnp.asarray(lamps.cube)[lamp], cube_side(list(offset)), 0)
    return jnp.asarray(lamps.first, jnp.int32)[lamp] + side
