"""The loops over edges, piercing faces and outlines of shadows that find pieces, and add them.

A picture's derivative holds these loops twice, and JAX traces them four times: so what they do with
a batch is under `jax.jit`, which traces it once.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Int

from diffrast._device import anywhere, lanes
from diffrast._selection import batches_of, divided, over_batches, selected
from diffrast._stored import stored, zero_after
from diffrast.edges.blend import (
    Blended,
    Method,
    View,
    nothing,
    with_line,
    with_pieces,
    with_shadow,
)
from diffrast.edges.neighborhood import Surface, farthest_round, near_background
from diffrast.edges.piercing import LINES_AT_ONCE, PIXELS_AT_ONCE, choose_pixels, cross, lines_of
from diffrast.edges.records import Start, after_batch, has_room
from diffrast.edges.shadow_lines import LINES_AT_ONCE as SHADOWS_AT_ONCE
from diffrast.edges.shadow_lines import PIXELS_AT_ONCE as SHADOWED_AT_ONCE
from diffrast.edges.shadow_lines import Places, cross_shadows, shadow_of
from diffrast.edges.shadow_pairs import Cast
from diffrast.edges.shadow_pairs import choose_pixels as choose_shadowed
from diffrast.edges.survey import Edges, surface_of
from diffrast.edges.visibility import look
from diffrast.edges.waiting import Waiting, first_ones, instead_of_first

Add = Callable[[Int[Array, " n"], Bool[Array, " n"], Blended], Blended]


class Work(NamedTuple):
    """Edges or pixels where there may be pieces: `add(indices, exists, total)` for all batches."""

    order: Int[Array, " list"]
    size: Int[Array, ""]  # of those on the list
    at_once: int
    add: Add


def collect(view: View, method: Method, start: Start | None = None) -> Blended:
    """Find the visible pieces, and the sum of what they add to the image.

    With `start`, the `following` of earlier records, only those are made that begin there.
    """
    surface = surface_of(view, method)

    def is_wanted(total: Blended) -> Array:
        assert total.records is not None
        return has_room(total.records)

    goes_on = None if start is None else is_wanted
    # Shadows first: what they are found by need not be held any longer, then.
    work = [] if view.cast is None else [_shadows(view, view.cast, method, surface)]
    work.append(_edges(view, method, surface, goes_on))
    # Else what it is added to would be made, and held, before the image and the first list are.
    zero = stored(zero_after(work[0].size), view.image[0, 0, 0])

    def with_batches(blended: Blended, passed: Array, part: Work) -> tuple[Blended, Array]:
        order, size, at_once, add = part

        def add_batch(indices: Array, exists: Array, total: Blended) -> Blended:
            records, sums = add(indices, exists, total)
            return Blended(records and after_batch(records, exists[0]), sums)

        first = 0 if start is None else jnp.maximum(start.batch - passed, 0)
        blended = over_batches(
            order, size, at_once, add_batch, blended, first=first, goes_on=goes_on
        )
        return blended, passed + batches_of(size, at_once)

    blended, passed = nothing(view, method, start, zero), zero
    for part in work:
        blended, passed = with_batches(blended, passed, part)
    if view.topology.bodies is not None:
        blended, _ = with_batches(blended, passed, _piercing(view, method, surface))
    return blended


def _edges(
    view: View,
    method: Method,
    surface: Surface,
    goes_on: Callable[[Blended], Array] | None,
) -> Work:
    """The edges of the mesh; within a batch of them, too, only while `goes_on(total)`."""
    assert view.survey is not None
    runs, unseen = view.survey
    edges = Edges(view, surface, selected(runs > 0))
    near_bare = near_background(view.face_image)
    seen_farthest = farthest_round(view.face_image, surface)

    def add_edges(edge: Array, exists: Array, total: Blended) -> Blended:
        segments = edges.clipped(edge, exists)._replace(runs=stored(runs[edge]))
        ends, cuts = edges.cuts(segments)

        def add_pieces(state: tuple[Array, Waiting, Blended]) -> tuple[Array, Waiting, Blended]:
            n, waiting = edges.until_enough(segments, ends, cuts, *state[:2])
            pieces = first_ones(waiting, edges.at_once)
            found, left = look(
                pieces,
                segments,
                surface,
                view.face_image,
                near_bare,
                seen_farthest,
                unseen,
                view.cast,
            )
            total = with_pieces(state[2], view, method, segments, pieces, found)
            return n, instead_of_first(waiting, left), total

        def is_left(state: tuple[Array, Waiting, Blended]) -> Array:
            left = (state[0] < cuts) | (state[1].total > 0)
            return anywhere(left) if goes_on is None else left & goes_on(state[2])

        start = ends[-1] & 0, edges.none_waiting(segments), total
        return lax.while_loop(is_left, add_pieces, start)[2]

    return Work(edges.order, edges.count, edges.at_once.edges, add_edges)


def _piercing(view: View, method: Method, surface: Surface) -> Work:
    """The lines along which surfaces pierce each other."""
    bodies, width = view.topology.bodies, view.size[1]
    assert bodies is not None
    assert view.survey is not None
    assert view.survey.unseen.nearest is not None
    unseen = view.survey.unseen.nearest.reshape(-1)
    order, count = choose_pixels(view.face_image, bodies, unseen)
    lines_at_once = lanes() * LINES_AT_ONCE

    def add_pixels(number: Array, exists: Array, total: Blended) -> Blended:
        pixel = stored(jnp.stack(divided(number, width)[::-1]))
        crossings = cross(
            pixel,
            exists,
            surface,
            view.face_image,
            stored(unseen[number].astype(jnp.int32)),
        )

        def add_lines(pair: Array, exists: Array, total: Blended) -> Blended:
            shadowed = view.cast is not None
            patches = view.topology.patches
            lines = lines_of(crossings, pair, exists, patches, shadowed=shadowed)
            return with_line(total, view, method, lines)

        return over_batches(crossings.pairs, crossings.total, lines_at_once, add_lines, total)

    return Work(order, count, lanes() * PIXELS_AT_ONCE, add_pixels)


def _shadows(view: View, cast: Cast, method: Method, surface: Surface) -> Work:
    """The outlines of shadows."""
    height, width = view.size
    order, count = choose_shadowed(cast)
    shadows_at_once = lanes() * SHADOWS_AT_ONCE

    def add_pixels(number: Array, exists: Array, total: Blended) -> Blended:
        light, place = divided(number, width * height)
        weight_of_light = surface.pixels.shape[1] - cast.weight.size + light
        places = Places(
            light,
            rows=jnp.stack([weight_of_light - cast.weight.size, weight_of_light]),
            pixel=jnp.stack(divided(place, width)[::-1]),
        )
        outlines = cross_shadows(places, exists, cast, surface, view.face_image)

        def add_lines(line: Array, exists: Array, total: Blended) -> Blended:
            lines = shadow_of(outlines, line, exists, cast, surface, view.face_image)
            return with_shadow(total, view, method, lines)

        return over_batches(outlines.lines, outlines.total, shadows_at_once, add_lines, total)

    return Work(order, count, lanes() * SHADOWED_AT_ONCE, add_pixels)
