"""The first pass over all edges of a mesh, which finds what may be seen beside pixels' centres."""

from typing import Any

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from diffrast._device import anywhere
from diffrast._selection import batches_of, integers, over_batches, prefix_sum
from diffrast._stored import stored, stored_together
from diffrast.edges.blend import Method, View, number_of_pixel
from diffrast.edges.neighborhood import Surface, nearest_round
from diffrast.edges.pieces import (
    Segments,
    choose_edges,
    clip_edges,
    cut,
    to_pixels,
    usual_batches,
    with_runs,
)
from diffrast.edges.piercing import bodies_round, ranks
from diffrast.edges.unseen import Survey, Unseen, uncovered, unpictured
from diffrast.edges.waiting import Waiting, all_of, behind, gathered, none_waiting

Nearest = tuple[Float[Array, " pixels"], Int[Array, " pixels"]]  # 1/w of faces, and which
Found = tuple[Any, ...]  # bits of edges' runs, and one or two of these


def surface_of(view: View, method: Method) -> Surface:
    """The faces whose edges are looked for, with their vertices in pixels."""
    pixels = stored(to_pixels(view.positions_clip, *view.size))
    volume = view.volume
    assert volume is not None
    if method.cull_backfaces:
        front = (volume < 0) if view.turned is None else (volume < 0) != view.turned
        volume = stored(jnp.where(front, volume, 0))
    return Surface(view.faces, pixels, view.topology, volume)


class Edges:
    """The edges of the mesh across which the picture may jump."""

    def __init__(self, view: View, surface: Surface, chosen: tuple[Array, Array]):
        self.height, self.width = view.size
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


def survey(view: View, method: Method) -> Survey:
    """What is to be the view's `survey`."""
    bodies = view.topology.bodies
    surface = surface_of(view, method)
    edges = Edges(view, surface, choose_edges(view.topology.edges, surface.volume, view.apart))
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
            # What turns away is mostly the far side of a body: all else goes before, above 0.
            away = surface.volume[jnp.maximum(face, 0)] >= 0
            distance = 1 / jnp.where(depth > 0, depth, 1)
            pixel = number_of_pixel(view, pieces.pixel)
            if bodies is not None and seen is not None:
                column, row = pieces.pixel
                body = ranks(bodies[jnp.maximum(face, 0)], bodies.size)
                other = jnp.any(seen[:, row, column] > body, axis=0)
                wanted, nearness = stored(((face >= 0) & other, jnp.where(away, -distance, depth)))
                near = [_nearer(near[0], pixel, wanted, face, nearness)]
            far = _nearer(far, pixel, face >= 0, face, stored(jnp.where(away, -depth, distance)))
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
    unseen = [face.reshape(size) for _, face in found]
    if bodies is not None:
        nearness = found[1][0].reshape(size)
        unseen[1] = jnp.where(nearness > 0, unseen[1], nearest_round(nearness, unseen[1]))
    held = integers(len(view.faces))
    return Survey(runs, Unseen(*(stored(face.astype(held)) for face in unseen)))


def _nearer(best: Nearest, pixel: Array, wanted: Array, face: Array, depth: Array) -> Nearest:
    """The nearest in each pixel, of what was before and of the faces that are wanted."""
    nearest, known = best
    number = jnp.where(wanted, pixel, known.size)
    nearest = nearest.at[number].max(depth, mode="drop")
    number = jnp.where(depth < nearest[number], known.size, number)
    return nearest, known.at[number].set(-1, mode="drop").at[number].max(face, mode="drop")
