"""Coverage on a CPU: faces drawn one after another into a depth buffer.

A loop over faces that each touch a few dozen neighbouring pixels beats every scheme that
sorts faces into tiles: a block of pixels stays in the first cache level, nothing is binned, and no
work list has a capacity. The loops are `lax` loops, compiled, over vectorised blocks:

* faces of up to 40×48 pixels: one block each, of the smallest size in `BLOCKS` that holds it;
* all others: rows of tiles, each row only as wide as the edges leave it, without the tiles that are
  known to be hidden by what is drawn already. Vertices may lie behind the eye, and the near and the
  far plane are tested at every pixel.

Each pixel holds its depth key and face id as the two parts of one complex number, so that one store
updates both; the id is kept as the bits of a normal float.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from diffrast._selection import batches_of, divided
from diffrast._stored import stored, stored_together
from diffrast.raster.edge_functions import (
    TILE,
    Edge,
    Image,
    Plane,
    Sweep,
    bias,
    corners_of,
    each_edge,
    edge_value,
    evaluate,
    set_up,
    triangle_slopes,
)
from diffrast.raster.fixed_point import (
    BLOCKS,
    LARGE,
    Vertices,
    classify_faces,
    first_centre,
    group_by_class,
    maximum3,
    minimum3,
    pixel_range,
    snap_vertices,
    subpixel_bits,
)

CHUNK = 128
_MARGIN = tuple(max(sizes) for sizes in zip(TILE, *BLOCKS, strict=True))
_END = (1 << 31) - 1  # no tile
_ROUNDINGS = 4  # of a key and its bound over a tile, which may differ


def draw_one_by_one(
    positions_clip: Float[Array, "V 4"],
    faces: Int[Array, "F 3"],
    *,
    height: int,
    width: int,
    cull_backfaces: bool,
) -> tuple[Int[Array, "height width"], Float[Array, "height width"]]:
    """Ids and depth keys of the nearest faces; under `vmap` the views one after another."""

    @jax.custom_batching.sequential_vmap
    def draw(positions_clip: Array, faces: Array) -> tuple[Array, Array]:
        vertices = snap_vertices(positions_clip, height=height, width=width)
        classes = classify_faces(
            vertices, faces, height=height, width=width, cull_backfaces=cull_backfaces
        )
        order, starts = group_by_class(classes)
        image = Image(height, width, subpixel_bits(height, width))
        buffer = _empty_buffer(image, positions_clip.dtype, starts[0] & 0)
        for size, block in enumerate(BLOCKS):
            buffer = _draw_blocks(
                buffer, vertices, faces, order, (starts[size], starts[size + 1]), block, image
            )
        span = starts[LARGE], starts[LARGE + 1]
        buffer = _draw_sweeps(buffer, vertices, faces, order, span, image, cull_backfaces)
        return stored(_face_ids(buffer)[:height, :width]), buffer.real[:height, :width]

    return draw(positions_clip, faces)


# Indices that are known not to be negative: one operation less each ------------------------------


def _block(table: Array, corner: tuple[Array, Array], shape: tuple[int, ...]) -> Array:
    return lax.dynamic_slice(table, corner, shape, allow_negative_indices=False)


def _put(table: Array, block: Array, corner: tuple[Array, Array]) -> Array:
    return lax.dynamic_update_slice(table, block, corner, allow_negative_indices=False)


def _entry(column: Array, i: Array) -> Array:
    return lax.dynamic_index_in_dim(column, i, -1, keepdims=False, allow_negative_indices=False)


# The depth buffer ---------------------------------------------------------------------------------


def _empty_buffer(image: Image, dtype: jnp.dtype, zero: Array) -> Array:
    """Depth keys of -inf and ids of -1; `zero` makes them vary as the data do under `shard_map`."""
    # Blocks begin inside the image and may reach beyond it.
    shape = (image.height + _MARGIN[0], image.width + _MARGIN[1])
    background = _id_as_float(jnp.full(shape, -1) + zero, dtype)
    return lax.complex(jnp.full(shape, -jnp.inf, dtype), background)


def _id_as_float(face: Array, dtype: jnp.dtype) -> Array:
    integer = jnp.int32 if dtype == jnp.float32 else jnp.int64
    one = lax.bitcast_convert_type(jnp.ones((), dtype), integer)
    return lax.bitcast_convert_type(face.astype(integer) + one, dtype)


def _face_ids(buffer: Array) -> Array:
    bits = lax.bitcast_convert_type(
        buffer.imag, jnp.int32 if buffer.dtype == jnp.complex64 else jnp.int64
    )
    one = lax.bitcast_convert_type(jnp.ones((), buffer.real.dtype), bits.dtype)
    return (bits - one).astype(jnp.int32)


def _resolve(
    buffer: Array, corner: tuple[Array, Array], inside: Array, key: Array, face: Array
) -> Array:
    """Keep, at each pixel of a block, the larger key; the first drawn of equal ones."""
    old = _block(buffer, corner, inside.shape)
    tag = jnp.broadcast_to(_id_as_float(face, key.dtype), key.shape)
    new = jnp.where(inside & (key > old.real), lax.complex(key, tag), old)
    return _put(buffer, new, corner)


def _pixel_grid(block: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.ogrid[: block[0], : block[1]]
    return columns.astype(np.int32), rows.astype(np.int32)


# Faces that fit one block -------------------------------------------------------------------------


def _draw_blocks(
    buffer: Array,
    vertices: Vertices,
    faces: Array,
    order: Array,
    span: tuple[Array, Array],
    block: tuple[int, int],
    image: Image,
) -> Array:
    """Draw faces whose pixels fit one block."""
    bits = image.bits
    columns, rows = _pixel_grid(block)
    inverse_w = 1 / jnp.where(vertices.w > 0, vertices.w, 1)
    x_pixel, y_pixel = vertices.x * inverse_w, vertices.y * inverse_w
    keys = vertices.rank * inverse_w

    def draw(i: Array, buffer: Array) -> Array:
        face = _entry(order, i)
        corners = list(_block(faces, (face, jnp.zeros_like(face)), (1, 3))[0])
        x_fixed, y_fixed, x, y, values = (
            [_entry(column, c) for c in corners]
            for column in (vertices.x_fixed, vertices.y_fixed, x_pixel, y_pixel, keys)
        )
        column, _ = pixel_range(minimum3(x_fixed), x_fixed[0], size=image.width, bits=bits)
        row, _ = pixel_range(minimum3(y_fixed), y_fixed[0], size=image.height, bits=bits)
        x_origin = (column << bits) + first_centre(image.width, bits)
        y_origin = (row << bits) + first_centre(image.height, bits)

        twice_area = (x_fixed[1] - x_fixed[0]) * (y_fixed[2] - y_fixed[0]) - (
            x_fixed[2] - x_fixed[0]
        ) * (y_fixed[1] - y_fixed[0])
        sign = jnp.where(twice_area > 0, 1, -1)
        outside = jnp.zeros((), jnp.int32)
        for j in range(3):
            start, end = (j + 1) % 3, (j + 2) % 3
            a = (y_fixed[start] - y_fixed[end]) * sign
            b = (x_fixed[end] - x_fixed[start]) * sign
            value = a * (x_origin - x_fixed[start]) + b * (y_origin - y_fixed[start])
            value = (value - bias(a, b)) >> bits
            outside = outside | (value + a * columns + b * rows)  # the sign bit of any edge

        dx, dy = triangle_slopes(x, y, values)
        x_offset = column.astype(x[0].dtype) + (1 - image.width) / 2 - x[0]
        y_offset = row.astype(x[0].dtype) + (1 - image.height) / 2 - y[0]
        key = values[0] + dx * x_offset + dy * y_offset
        key = key + dx * lax.convert_element_type(columns, dx.dtype)
        key = key + dy * lax.convert_element_type(rows, dy.dtype)
        key = jnp.clip(key, minimum3(values), maximum3(values))
        return _resolve(buffer, (row, column), outside >= 0, key, face)

    return lax.fori_loop(*span, draw, buffer)


# Faces of any size --------------------------------------------------------------------------------


def _draw_sweeps(
    buffer: Array,
    vertices: Vertices,
    faces: Array,
    order: Array,
    span: tuple[Array, Array],
    image: Image,
    cull_backfaces: bool,
) -> Array:
    """Draw faces of any size: rows of tiles, each as wide as the edges leave it.

    Faces are set up a chunk at a time, vectorised; a flat loop then walks over the chunk's tiles.
    The smallest key of each tile is kept, and tiles that hide the face are passed over.
    """
    columns, rows = _pixel_grid(TILE)
    lowest_keys = jnp.full(_tile_counts(image), -jnp.inf, buffer.real.dtype) + buffer.real[0, 0] * 0
    first, stop = span

    def draw_chunk(n: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        slots = first + n * CHUNK + jnp.arange(CHUNK, dtype=jnp.int32)
        chunk = order[jnp.minimum(slots, order.shape[0] - 1)]
        sweeps = stored_together(set_up(corners_of(vertices, faces, chunk), image, cull_backfaces))
        walk = _plan_walk(sweeps, slots < stop, image)

        def hidden(tile: _Tile, lowest_keys: Array) -> Array:
            key = Plane(*(member[0, tile.face] for member in sweeps.planes))
            corner = evaluate(key, tile.column, tile.row, 0, 0)
            nearest = corner + sum(
                jnp.maximum(slope * (size - 1), 0)
                for slope, size in ((key.dx, TILE[1]), (key.dy, TILE[0]))
            )
            nearest = jnp.clip(nearest, *(bound[tile.face] for bound in sweeps.key_range))
            nearest = nearest + jnp.abs(nearest) * (_ROUNDINGS * jnp.finfo(nearest.dtype).eps)
            return nearest <= lowest_keys[tile.place]

        def draw(state: tuple[_Tile, Array, Array]) -> tuple[_Tile, Array, Array]:
            tile, buffer, lowest_keys = state
            sweep, face = jax.tree.map(lambda x: _entry(x, tile.face), (sweeps, chunk))
            outside = jnp.zeros((), jnp.int32)
            for edge in each_edge(sweep.edges):
                value = edge_value(edge, tile.column, tile.row)
                outside = outside | (value + edge.a * columns + edge.b * rows)
            key, *limits = (
                evaluate(Plane(*plane), tile.column, tile.row, columns, rows)
                for plane in zip(*sweep.planes, strict=True)
            )
            key = jnp.clip(key, *sweep.key_range)
            for limit in limits:
                outside = outside | jnp.where(limit >= 0, 0, -1)
            corner = tile.row, tile.column
            buffer = _resolve(buffer, corner, outside >= 0, key, face)
            lowest = _smallest(_block(buffer, corner, TILE).real)
            lowest_keys = _put(lowest_keys, lowest[None, None], tile.place)

            def advance(state: tuple[_Tile, Array]) -> tuple[_Tile, Array]:
                tile = _tile_at(walk.after(state[0].number), image)
                return tile, (tile.number < _END) & hidden(tile, lowest_keys)

            tile = lax.while_loop(lambda state: state[1], advance, (tile, tile.number < _END))[0]
            return tile, buffer, lowest_keys

        start = _tile_at(walk.first, image), *state
        return lax.while_loop(lambda state: state[0].number < _END, draw, start)[1:]

    chunks = batches_of(stop - first, CHUNK)
    return lax.fori_loop(0, chunks, draw_chunk, (buffer, lowest_keys))[0]


def _smallest(block: Array) -> Array:
    """Minimum over a block, halved row by row, which XLA vectorises as it does no reduction."""
    while block.shape[0] > 1:
        half = block.shape[0] // 2
        block = jnp.minimum(block[:half], block[half:])
    return jnp.min(block)


def _tile_counts(image: Image) -> tuple[int, int]:
    """Tiles along rows and columns, in powers of two."""

    def count(size: int, tile: int) -> int:
        return 1 << (-(-size // tile) - 1).bit_length()

    return count(image.height, TILE[0]), count(image.width, TILE[1])


class _Tile(NamedTuple):
    """A tile of a face, found where the walk goes on: in the loop each part is one operation."""

    number: Array  # see `_Walk`
    face: Array  # in the chunk
    place: tuple[Array, Array]  # row and column of tiles
    row: Array  # of its first pixel
    column: Array


def _tile_at(number: Array, image: Image) -> _Tile:
    rows, columns = _tile_counts(image)
    row, column = divided(number, columns)
    face, row = divided(row, rows)
    return _Tile(number, face, (row, column), row * TILE[0], column * TILE[1])


class _Walk(NamedTuple):
    """The tiles of a chunk's faces: one number a tile, counted by face, row and column of tiles."""

    first: Array
    last_in_row: Array
    first_of_next: Array
    columns: int

    def after(self, tile: Array) -> Array:
        row, _ = divided(tile, self.columns)
        return jnp.where(tile < self.last_in_row[row], tile + 1, self.first_of_next[row])


def _plan_walk(sweeps: Sweep, drawn: Array, image: Image) -> _Walk:
    """Which tiles of each row of tiles the edges may leave inside."""
    dtype = sweeps.edges.anchor_x.dtype
    tile_rows, tile_columns = _tile_counts(image)
    row = jnp.arange(tile_rows, dtype=jnp.int32) * TILE[0]
    first = sweeps.columns[0].astype(dtype)[:, None]
    last = sweeps.columns[1].astype(dtype)[:, None]
    left, right = first, last
    for edge in each_edge(sweeps.edges):
        edge = Edge(*(column[:, None] for column in edge))
        # Where the edge crosses zero in its best row of the band, with a pixel of slack.
        y = row.astype(dtype) + jnp.where(edge.b > 0, TILE[0] - 1, 0) - edge.anchor_y
        crossing = edge.anchor_x + edge.run * y
        left = jnp.maximum(left, jnp.where(edge.a > 0, crossing - 1, first))
        right = jnp.minimum(right, jnp.where(edge.a < 0, crossing + 1, last))
    used = (left <= right) & drawn[:, None]
    used = used & (row + TILE[0] > sweeps.rows[0][:, None]) & (row <= sweeps.rows[1][:, None])
    left = jnp.floor(jnp.clip(left, first, last)).astype(jnp.int32) // TILE[1]
    right = jnp.ceil(jnp.clip(right, first, last)).astype(jnp.int32) // TILE[1]
    start = jnp.arange(CHUNK * tile_rows, dtype=jnp.int32) * tile_columns
    first_tile = jnp.where(used.reshape(-1), start + left.reshape(-1), _END)
    following = lax.cummin(first_tile, reverse=True)
    return _Walk(
        following[0],
        start + right.reshape(-1),
        jnp.concatenate([following[1:], jnp.full(1, _END, jnp.int32)]),
        tile_columns,
    )
