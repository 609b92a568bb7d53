"""Coverage on a GPU: all pixels of all faces, of all views, side by side.

Faces are cut into blocks of 8×8 pixels, or of 4×4 where they are many for the picture. These are
numbered through, and every pixel of some ten thousand blocks finds out by itself whether it is
inside and how near. The nearest key at a pixel of the image is a scattered maximum; of the faces
that have it, the first drawn is a scattered minimum. Keys are stored, not computed twice, so that
what is equal stays equal, and nothing depends on the order in which a GPU works.

The arithmetic is that of `one_by_one`: a face of the small classes counts its depth from its first
pixel, a large one from the corner of a tile; of equal keys the smaller class has been drawn first.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from diffrast._selection import batches_of
from diffrast._stored import stored
from diffrast.raster.edge_functions import (
    TILE,
    Edge,
    Image,
    Plane,
    corners_of,
    each_edge,
    edge_value,
    set_up,
    triangle_slopes,
)
from diffrast.raster.fixed_point import (
    CULLED,
    LARGE,
    Vertices,
    classify_faces,
    maximum3,
    minimum3,
    snap_vertices,
    subpixel_bits,
)

_BLOCKS = 4, 8  # rows and columns, divisors of those of a tile
_FACES_AT_ONCE = 1 << 20
_PIXELS_AT_ONCE = 1 << 23  # of blocks
_NONE = (1 << 31) - 1  # rank where there is no face


class _Faces(NamedTuple):
    """Faces, ready to be drawn; they lie along the last axis of every member."""

    view: Array
    rank: Array  # in the order in which one face after another would be drawn
    small: Array  # whether depth is evaluated from the first pixel on
    column: Array  # of the first block
    row: Array
    across: Array  # blocks side by side
    edges: Edge
    key: Plane  # counted from a point given in pixels from the image's centre
    key_range: tuple[Array, Array]
    limits: Plane  # not negative between the near and the far plane


def draw_at_once(
    positions_clip: Float[Array, "V 4"],
    faces: Int[Array, "F 3"],
    *,
    height: int,
    width: int,
    cull_backfaces: bool,
) -> tuple[Int[Array, "height width"], Float[Array, "height width"]]:
    """Ids and depth keys of the nearest faces; under `vmap` all views at once."""
    image = Image(height, width, subpixel_bits(height, width))

    @jax.custom_batching.custom_vmap
    def draw(positions_clip: Array, faces: Array) -> tuple[Array, Array]:
        return _draw_views(positions_clip, faces, image, cull_backfaces)

    @draw.def_vmap
    def draw_more(
        size: int, batched: list[bool], positions_clip: Array, faces: Array
    ) -> tuple[tuple[Array, Array], tuple[bool, bool]]:
        """Views of views are views; a mesh that is the same for all stays one."""
        given, table = (
            x if is_batched else x[None]
            for x, is_batched in zip((positions_clip, faces), batched, strict=True)
        )
        views = given.shape[1]
        given = jnp.broadcast_to(given, (size, *given.shape[1:]))
        if table.shape[:2] != (1, 1):
            table = jnp.broadcast_to(table, (size, views, *table.shape[2:]))
        given, table = (x.reshape(-1, *x.shape[2:]) for x in (given, table))
        shape = size, views, height, width
        return tuple(x.reshape(shape) for x in draw(given, table)), (True, True)

    ids, keys = draw(positions_clip[None], faces[None])
    return ids[0], keys[0]


def _draw_views(
    positions_clip: Float[Array, "views V 4"],
    faces: Int[Array, "meshes F 3"],
    image: Image,
    cull_backfaces: bool,
) -> tuple[Int[Array, "views height width"], Float[Array, "views height width"]]:
    """Views of meshes with faces of their own, or with the same."""
    views, vertex_count = positions_clip.shape[:2]
    face_count, pixel_count = faces.shape[1], views * image.height * image.width
    if max(pixel_count, views * max(face_count, vertex_count), face_count * CULLED) > _NONE:
        raise ValueError(
            f"positions_clip: wanted fewer at once, got {views} views of {face_count} faces in"
            f" {image.height} × {image.width} pixels"
        )
    snap = partial(snap_vertices, height=image.height, width=image.width)
    vertices = Vertices(*(column.reshape(-1) for column in jax.vmap(snap)(positions_clip)))
    vertices = stored(vertices)
    many = face_count * _BLOCKS[0] ** 2 > image.height * image.width
    side = _BLOCKS[0] if many else _BLOCKS[1]
    # The blocks of all of them can be counted.
    most_blocks = (image.height // side + 2) * (image.width // side + 2)
    faces_at_once = min(views * face_count, _FACES_AT_ONCE, _NONE // most_blocks)
    usual = 2 * faces_at_once + 4 * most_blocks  # so that mostly one batch is all
    blocks_at_once = min(1 << (usual - 1).bit_length(), _PIXELS_AT_ONCE // side**2)

    def draw_faces(n: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        number = n * faces_at_once + jnp.arange(faces_at_once, dtype=jnp.int32)
        view, face = jnp.divmod(jnp.minimum(number, views * face_count - 1), face_count)
        corners = faces[view if faces.shape[0] > 1 else 0, face]
        corners = stored(corners + (view * vertex_count)[:, None])
        classes = classify_faces(
            vertices, corners, height=image.height, width=image.width, cull_backfaces=cull_backfaces
        )
        rank = classes * face_count + face
        some, blocks = _ready(vertices, corners, classes, view, rank, image, cull_backfaces, side)
        blocks = jnp.where(number < views * face_count, blocks, 0)
        ends = stored(jnp.cumsum(blocks))
        starts = ends - blocks

        def draw_blocks(m: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            block = m * blocks_at_once + jnp.arange(blocks_at_once, dtype=jnp.int32)
            owner = jnp.searchsorted(ends, block, side="right", method="scan_unrolled")
            owner = stored(jnp.minimum(owner, faces_at_once - 1))
            inside, place, key = _pixels(some, owner, block - starts[owner], image, side)
            place = jnp.where(inside & (block < ends[-1])[:, None, None], place, pixel_count)
            ranks = jnp.broadcast_to(some.rank[owner][:, None, None], place.shape)
            return _nearest(state, *(part.reshape(-1) for part in (place, key, ranks)))

        return lax.fori_loop(0, batches_of(ends[-1], blocks_at_once), draw_blocks, state)

    zero = vertices.x_fixed[0] & 0  # varies as the data do
    nothing = _ordered(jnp.full(pixel_count, -jnp.inf, positions_clip.dtype))
    state = nothing + zero.astype(nothing.dtype), jnp.full(pixel_count, _NONE) + zero
    chunks = -(-views * face_count // faces_at_once)
    state = draw_faces(zero, state) if chunks == 1 else lax.fori_loop(0, chunks, draw_faces, state)
    keys, ranks = state
    ids = jnp.where(ranks == _NONE, -1, ranks % face_count)
    shape = views, image.height, image.width
    return ids.reshape(shape), _number(keys, positions_clip.dtype).reshape(shape)


def _ready(
    vertices: Vertices,
    corners: Int[Array, "F 3"],
    classes: Int[Array, " F"],
    view: Array,
    rank: Array,
    image: Image,
    cull_backfaces: bool,
    side: int,
) -> tuple[_Faces, Int[Array, " F"]]:
    """Faces, and of how many blocks of so many rows and columns they are."""
    number = jnp.arange(rank.size, dtype=jnp.int32)
    sweep = set_up(corners_of(vertices, corners, number), image, cull_backfaces)
    (column, last_column), (row, last_row) = sweep.columns, sweep.rows
    small = classes < LARGE
    drawn = (classes < CULLED) & (column <= last_column) & (row <= last_row)
    column, row = (jnp.where(small, first, first // side * side) for first in (column, row))
    across, down = (last_column - column) // side + 1, (last_row - row) // side + 1

    inverse_w = 1 / jnp.where(vertices.w > 0, vertices.w, 1)
    x, y, values = (
        list((numerator * inverse_w)[corners.T])
        for numerator in (vertices.x, vertices.y, vertices.rank)
    )
    key, *limits = (Plane(*plane) for plane in zip(*sweep.planes, strict=True))
    from_centre = key._replace(x=jnp.zeros_like(x[0]), y=jnp.zeros_like(y[0]))
    from_corner = Plane(values[0], *triangle_slopes(x, y, values), x[0], y[0])
    bounds = minimum3(values), maximum3(values)
    key, bounds = jax.tree.map(
        partial(jnp.where, small), (from_corner, bounds), (from_centre, sweep.key_range)
    )
    limits = jax.tree.map(lambda *parts: jnp.stack(parts), *limits)
    faces = _Faces(view, rank, small, column, row, across, sweep.edges, key, bounds, limits)
    return stored(faces), stored(jnp.where(drawn, across * down, 0))


def _pixels(
    faces: _Faces, owner: Int[Array, " n"], number: Int[Array, " n"], image: Image, side: int
) -> tuple[Array, Array, Array]:
    """Of all pixels of blocks, counted within their faces: whether inside, which, and the key."""
    own = stored(jax.tree.map(lambda column: column[..., owner], faces))
    column = own.column + number % own.across * side
    row = own.row + number // own.across * side
    corner_column = jnp.where(own.small, own.column, column // TILE[1] * TILE[1])
    corner_row = jnp.where(own.small, own.row, row // TILE[0] * TILE[0])
    starts = stored([edge_value(edge, column, row) for edge in each_edge(own.edges)])
    dtype = own.key.value.dtype
    x = corner_column.astype(dtype) + (1 - image.width) / 2
    y = corner_row.astype(dtype) + (1 - image.height) / 2
    planes = [own.key._replace(x=x - own.key.x, y=y - own.key.y)]
    planes += [Plane(*plane)._replace(x=x, y=y) for plane in zip(*own.limits, strict=True)]
    planes = [p._replace(value=p.value + p.dx * p.x + p.dy * p.y) for p in planes]
    planes, low, high = stored((planes, *own.key_range))

    def spread(x: Array) -> Array:
        return x[:, None, None]

    columns = jnp.arange(side, dtype=jnp.int32)
    rows = columns[:, None]
    outside = jnp.zeros((), jnp.int32)
    for start, edge in zip(starts, each_edge(own.edges), strict=True):
        outside = outside | (spread(start) + spread(edge.a) * columns + spread(edge.b) * rows)
    rows, columns = spread(row) + rows, spread(column) + columns
    down, along = rows - spread(corner_row), columns - spread(corner_column)
    key, near, far = (
        spread(plane.value) + spread(plane.dx) * along + spread(plane.dy) * down for plane in planes
    )
    key = jnp.clip(key, spread(low), spread(high))
    inside = (outside >= 0) & (near >= 0) & (far >= 0) & (key > -jnp.inf)
    inside = inside & (rows < image.height) & (columns < image.width)
    place = (spread(own.view) * image.height + rows) * image.width + columns
    return inside, place, _ordered(key)


def _nearest(
    state: tuple[Array, Array], place: Array, key: Array, rank: Array
) -> tuple[Array, Array]:
    """Keep of each pixel the largest key, and of its faces that with the lowest rank."""
    keys, ranks = state
    key = stored(key)
    now = stored(keys.at[place].max(key, mode="drop"))
    ranks = jnp.where(now > keys, _NONE, ranks)
    winner = now.at[place].get(mode="fill", fill_value=0) == key
    return now, ranks.at[jnp.where(winner, place, keys.size)].min(rank, mode="drop")


# Keys as integers in the same order, which a GPU compares in one step -----------------------------


def _ordered(key: Array) -> Array:
    integer = jnp.int32 if key.dtype == jnp.float32 else jnp.int64
    bits = lax.bitcast_convert_type(jnp.where(key == 0, 0, key), integer)
    return jnp.where(bits < 0, bits ^ jnp.iinfo(integer).max, bits)


def _number(ordered: Array, dtype: jnp.dtype) -> Array:
    bits = jnp.where(ordered < 0, ordered ^ jnp.iinfo(ordered.dtype).max, ordered)
    return lax.bitcast_convert_type(bits, dtype)
