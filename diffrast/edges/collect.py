"""The loops over edges, piercing faces and outlines of shadows that find pieces, and add them.

A picture's derivative holds these loops twice, and JAX traces them four times: so what they do with
a batch is under `jax.jit`, which traces it once.
"""

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from diffrast._device import anywhere, lanes
from diffrast._selection import batches_of, divided, over_batches, prefix_sum, selected
from diffrast._stored import stored, stored_together, zero_after
from diffrast.edges.blend import (
    Blended,
    Method,
    View,
    nothing,
    number_of_pixel,
    with_line,
    with_pieces,
    with_shadow,
)
from diffrast.edges.neighborhood import Surface, near_background
from diffrast.edges.pieces import (
    Segments,
    choose_edges,
    clip_edges,
    cut,
    to_pixels,
    usual_batches,
    with_runs,
)
from diffrast.edges.piercing import (
    LINES_AT_ONCE,
    PIXELS_AT_ONCE,
    bodies_round,
    choose_pixels,
    cross,
    lines_of,
    ranks,
)
from diffrast.edges.records import Start, after_batch, has_room
from diffrast.edges.shadow_lines import LINES_AT_ONCE as SHADOWS_AT_ONCE
from diffrast.edges.shadow_lines import PIXELS_AT_ONCE as SHADOWED_AT_ONCE
from diffrast.edges.shadow_lines import Cast, Places, cross_shadows, shadow_of
from diffrast.edges.shadow_lines import choose_pixels as choose_shadowed
from diffrast.edges.visibility import Survey, Unseen, look, uncovered, unpictured
from diffrast.edges.waiting import (
    Waiting,
    all_of,
    behind,
    first_ones,
    gathered,
    instead_of_first,
    none_waiting,
)

Nearest = tuple[Float[Array, " pixels"], Int[Array, " pixels"]]  # 1/w of faces, and which
Found = tuple[Any, ...]  # bits of edges' runs, and one or two of these
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
    surface = _surface(view, method)

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


def survey(view: View, method: Method) -> Survey:
    """What is to be the view's `survey`."""
    bodies = view.topology.bodies
    surface = _surface(view, method)
    edges = _Edges(view, surface, choose_edges(view.topology.edges, surface.volume, view.apart))
    seen = None if bodies is None else bodies_round(view.face_image, bodies)

    def add_edges(edge: Array, exists: Array, total: Found) -> Found:
        segments = edges.clipped(edge, exists)
        ends, cuts = edges.cuts(segments)

        def add_pieces(state: tuple[Array, Waiting, Array, Found]) -> Any:
            n, waiting, last, (runs, far, *near) = state
            n, waiting = edges.until_enough(segments, ends, cuts, n, waiting)
            pieces = all_of(waiting)
            runs, last = with_runs(runs, last, pieces, segments, edge)
            face, depth = stored_together(
                unpictured(pieces, segments, surface.volume, view.face_image)
            )
            pixel = number_of_pixel(view, pieces.pixel)
            if bodies is not None and seen is not None:
                column, row = pieces.pixel
                body = ranks(bodies[jnp.maximum(face, 0)], bodies.size)
                other = jnp.any(seen[:, row, column] > body, axis=0)
                near = [_nearer(near[0], pixel, stored((face >= 0) & other), face, depth)]
            far = _nearer(far, pixel, face >= 0, face, -depth)
            return n, waiting._replace(total=waiting.total & 0), last, (runs, far, *near)

        def is_left(state: tuple[Array, Waiting, Array, Found]) -> Array:
            return anywhere(state[0] < cuts)

        zero = ends[-1] & 0
        start = zero, edges.none_waiting(segments), zero - 1, total
        return lax.while_loop(is_left, add_pieces, start)[-1]

    size = edges.height, edges.width
    nowhere = jnp.full(edges.height * edges.width, -1, view.face_image.dtype) + (edges.count & 0)
    none = nowhere.astype(view.positions_clip.dtype) - jnp.inf, nowhere
    no_runs = jnp.zeros(view.apart.size, jnp.uint32) + (edges.count & 0).astype(jnp.uint32)
    start: Found = (no_runs, *[none] * (1 if bodies is None else 2))
    runs, *found = over_batches(edges.order, edges.count, edges.at_once.edges, add_edges, start)
    # Held by all that follows: numbers of few faces take two bytes.
    few = jnp.int16 if view.faces.shape[0] <= jnp.iinfo(jnp.int16).max else jnp.int32
    unseen = [face.reshape(size) for _, face in found]
    if bodies is not None:
        unseen[1] = _or_next_to(found[1][0].reshape(size), unseen[1])
    return Survey(runs, Unseen(*(stored(face.astype(few)) for face in unseen)))


def _or_next_to(depth: Array, face: Array) -> Array:
    """The faces of pixels, and where there is none the nearest of the 3×3 round the pixel."""

    def nearer(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
        is_one = one[0] >= other[0]
        return jnp.where(is_one, one[0], other[0]), jnp.where(is_one, one[1], other[1])

    height, width = face.shape
    best = jnp.pad(depth, 1, constant_values=-jnp.inf), jnp.pad(face, 1, constant_values=-1)
    best = reduce(nearer, [(best[0][k : k + height], best[1][k : k + height]) for k in range(3)])
    best = stored_together(best)
    _, next_to = reduce(
        nearer, [(best[0][:, k : k + width], best[1][:, k : k + width]) for k in range(3)]
    )
    return jnp.where(face >= 0, face, next_to)


def _nearer(best: Nearest, pixel: Array, wanted: Array, face: Array, depth: Array) -> Nearest:
    """The nearest in each pixel, of what was before and of the faces that are wanted."""
    nearest, known = best
    number = jnp.where(wanted, pixel, known.size)
    nearest = nearest.at[number].max(depth, mode="drop")
    number = jnp.where(depth < nearest[number], known.size, number)
    return nearest, known.at[number].set(-1, mode="drop").at[number].max(face, mode="drop")


def _surface(view: View, method: Method) -> Surface:
    """The faces whose edges are looked for, with their vertices in pixels."""
    height, width = view.image.shape[0] - 2, view.image.shape[1] - 2
    pixels = stored(to_pixels(view.positions_clip, height, width))
    volume = view.volume
    assert volume is not None
    if method.cull_backfaces:
        front = (volume < 0) if view.turned is None else (volume < 0) != view.turned
        volume = stored(jnp.where(front, volume, 0))
    return Surface(view.faces, pixels, view.topology, volume)


class _Edges:
    """The edges of the mesh across which the picture may jump."""

    def __init__(self, view: View, surface: Surface, chosen: tuple[Array, Array]):
        self.height, self.width = view.image.shape[0] - 2, view.image.shape[1] - 2
        self.view, self.surface = view, surface
        self.order, self.count = chosen
        self.z = stored(view.positions_clip[:, 2])
        self.at_once = usual_batches(view.apart.size, self.height * self.width)

    def clipped(self, edge: Array, exists: Array) -> Segments:
        """Edges within the view."""
        segments: Segments = clip_edges(
            edge,
            exists,
            self.surface.topology.edges,
            self.surface.faces,
            self.surface.pixels,
            self.z,
            self.surface.volume,
            height=self.height,
            width=self.width,
        )
        return segments

    def cuts(self, segments: Segments) -> tuple[Array, Array]:
        """Sums of how many pieces edges have, and how many cuts make them."""
        ends = prefix_sum(segments.places)
        return ends, batches_of(ends[-1], self.at_once.cut)

    def none_waiting(self, segments: Segments) -> Waiting:
        """Room for the pieces that may wait."""
        return none_waiting(segments, self.at_once.cut + self.at_once.pieces)

    def until_enough(
        self, segments: Segments, ends: Array, cuts: Array, n: Array, waiting: Waiting
    ) -> tuple[Array, Waiting]:
        """Cut on, from cut `n`, until as many pieces that may be seen wait as are taken at once."""
        at_once, size = self.at_once, {"height": self.height, "width": self.width}

        def add_cut(state: tuple[Array, Waiting]) -> tuple[Array, Waiting]:
            n, waiting = state
            pieces = cut(segments, ends, n * at_once.cut, at_once=at_once.cut, **size)
            pieces = uncovered(pieces, segments, self.surface, self.view.face_image)
            return n + 1, behind(waiting, *gathered(pieces))

        def are_few(state: tuple[Array, Waiting]) -> Array:
            return (state[0] < cuts) & (state[1].total < at_once.pieces)

        return lax.while_loop(are_few, add_cut, (n, waiting))


def _edges(
    view: View,
    method: Method,
    surface: Surface,
    goes_on: Callable[[Blended], Array] | None,
) -> Work:
    """The edges of the mesh; within a batch of them, too, only while `goes_on(total)`."""
    assert view.survey is not None
    runs, unseen = view.survey
    edges = _Edges(view, surface, selected(runs > 0))
    near_bare = near_background(view.face_image)

    def add_edges(edge: Array, exists: Array, total: Blended) -> Blended:
        segments = edges.clipped(edge, exists)._replace(runs=stored(runs[edge]))
        ends, cuts = edges.cuts(segments)

        def add_pieces(state: tuple[Array, Waiting, Blended]) -> tuple[Array, Waiting, Blended]:
            n, waiting = edges.until_enough(segments, ends, cuts, *state[:2])
            pieces = first_ones(waiting, edges.at_once)
            found, left = look(pieces, segments, surface, view.face_image, near_bare, unseen)
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
    bodies, width = view.topology.bodies, view.image.shape[1] - 2
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
            lines = lines_of(crossings, pair, exists, view.topology.patches)
            return with_line(total, view, method, lines)

        return over_batches(crossings.pairs, crossings.total, lines_at_once, add_lines, total)

    return Work(order, count, lanes() * PIXELS_AT_ONCE, add_pixels)


def _shadows(view: View, cast: Cast, method: Method, surface: Surface) -> Work:
    """The outlines of shadows."""
    height, width = view.image.shape[0] - 2, view.image.shape[1] - 2
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
            return with_shadow(total, view, method, shadow_of(outlines, line, exists, view.faces))

        return over_batches(outlines.lines, outlines.total, shadows_at_once, add_lines, total)

    return Work(order, count, lanes() * SHADOWED_AT_ONCE, add_pixels)
