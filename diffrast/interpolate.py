"""Perspective-correct attributes of the visible points, and their derivatives by the pixel.

Along the screen 1/w and t/w of an attribute t are linear over a face, with slopes that only depend
on the face: they are found once for each (`face_slopes`). From

    dt/dx = w (d(t/w)/dx - t d(1/w)/dx)

follows the derivative at any point of it. Neighbouring pixels play no part, so it is as good at an
outline and on a face of a single pixel as anywhere.
"""

import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from diffrast._check import ArrayInput, float_array, index_array, instance_of, positive_int
from diffrast._stored import assemble, stored
from diffrast.raster import Fragments
from diffrast.raster.evaluate import blend, corners_at


def interpolate(
    attributes: ArrayInput, faces: ArrayInput, fragments: Fragments
) -> Float[Array, "height width channels"]:
    """Interpolate vertex attributes at every pixel.

    Args:
        attributes: (V, C) values at the vertices.
        faces: (F, 3) the faces that were rasterised.
        fragments: result of `rasterize`, of these faces.

    Returns:
        (height, width, C) values, 0 on the background. Differentiable in `attributes` and in the
        fragments' barycentrics.

    Raises:
        ValueError: for wrong shapes and indices out of range.

    Example:
        >>> triangle = jnp.array([[-1.0, -1, 0, 1], [3, -1, 0, 1], [-1, 3, 0, 1]])
        >>> fragments = dr.rasterize(triangle, [[0, 1, 2]], height=2, width=2)
        >>> across = jnp.array([[0.0], [8], [0]])  # over twice the width of the image
        >>> dr.interpolate(across, [[0, 1, 2]], fragments)[..., 0].tolist()
        [[1.0, 3.0], [1.0, 3.0]]
    """
    instance_of("fragments", fragments, Fragments)
    attributes = float_array("attributes", attributes, ("V", "C"), finite=False)
    faces = index_array("faces", faces, ("F", 3), bound=attributes.shape[0])
    face = _face_of(fragments, faces)
    barycentrics = [fragments.barycentrics[..., j] for j in range(3)]
    if attributes.shape[1] == 0:
        return jnp.zeros((*face.shape, 0), attributes.dtype)
    columns = interpolate_columns(
        [attributes[:, c] for c in range(attributes.shape[1])],
        faces,
        face,
        barycentrics,
    )
    return assemble(columns)


def _face_of(fragments: Fragments, faces: Int[Array, "F 3"]) -> Int[Array, "height width"]:
    """What the pixels show, if these faces can have been drawn."""
    size = ("height", "width")
    return index_array("fragments.face", fragments.face, size, minimum=-1, bound=faces.shape[0])


def interpolate_columns(
    columns: list[Float[Array, " V"]],
    faces: Int[Array, "F 3"],
    face: Int[Array, "*size"],
    barycentrics: list[Float[Array, "*size"]],
) -> list[Float[Array, "*size"]]:
    """Interpolate attributes kept apart, which XLA fuses far better than stacked ones."""
    corners = corners_at(faces, face)
    return [blend(barycentrics, [column[corner] for corner in corners]) for column in columns]


def screen_derivatives(
    attributes: ArrayInput,
    positions_clip: ArrayInput,
    faces: ArrayInput,
    fragments: Fragments,
    *,
    border: int = 0,
) -> Float[Array, "height width channels 2"]:
    """How interpolated vertex attributes change from pixel to pixel: their footprint.

    Args:
        attributes: (V, C) values at the vertices.
        positions_clip: (V, 4) as given to `rasterize`.
        faces: (F, 3) likewise.
        fragments: result of `rasterize`.
        border: as given to `rasterize`.

    Returns:
        (height, width, C, 2) derivatives by x, to the right, and by y, downwards, for one pixel; 0
        on the background and on faces seen exactly edge-on. Differentiable in the attributes, the
        positions and the barycentrics, for fixed faces.

    Raises:
        ValueError: for wrong shapes and indices out of range.
    """
    instance_of("fragments", fragments, Fragments)
    attributes = float_array("attributes", attributes, ("V", "C"), finite=False)
    count = attributes.shape[0]
    positions_clip = float_array("positions_clip", positions_clip, (count, 4), finite=False)
    faces = index_array("faces", faces, ("F", 3), bound=count)
    border = positive_int("border", border, minimum=0)
    face = _face_of(fragments, faces)
    height, width = (size - 2 * border for size in face.shape)
    slopes = face_slopes(attributes, faces, positions_clip, faces, height, width)
    barycentrics = [fragments.barycentrics[..., j] for j in range(3)]
    columns = [attributes[:, c] for c in range(attributes.shape[1])]
    values = interpolate_columns(columns, faces, face, barycentrics)
    found = slopes_at(slopes, face, barycentrics, values)
    pairs = jnp.stack([jnp.stack(pair, axis=-1) for pair in found], axis=-2)
    return jnp.where((face >= 0)[..., None, None], pairs, 0)


def face_slopes(
    attributes: Float[Array, "A C"],
    corners: Int[Array, "F 3"],
    positions_clip: Float[Array, "V 4"],
    faces: Int[Array, "F 3"],
    height: int,
    width: int,
) -> Float[Array, "F columns"]:
    """What `slopes_at` needs of each face, one row a face.

    Everything is relative: positions to the corner with the largest w and to the face's extent on
    the screen, so that neither scale nor place of a face cost precision. Rows of faces that have no
    area on the screen, or a vertex that is not finite, are zero.

    Args:
        attributes: values that the corners of faces share.
        corners: which of them each corner has.
        positions_clip: of the vertices.
        faces: which of these each corner is.
        height: rows of the image without a border.
        width: its columns.
    """
    epsilon = jnp.finfo(positions_clip.dtype).eps
    finite = jnp.all(jnp.isfinite(positions_clip), axis=1)
    half = jnp.array([width / 2, -height / 2, 1], positions_clip.dtype)
    place = jnp.where(finite[:, None], positions_clip[:, jnp.array([0, 1, 3])], 0) * half
    vertex = place[faces]  # (F, 3 corners, x y w)
    farthest = jnp.argmax(jnp.abs(lax.stop_gradient(vertex[..., 2])), axis=1)[:, None, None]
    origin = jnp.take_along_axis(vertex, farthest, axis=1)
    unit = lax.stop_gradient(origin[..., 2:])
    seen = (unit[..., 0] != 0) & jnp.all(finite[faces], axis=1, keepdims=True)
    vertex, origin = (v / jnp.where(unit != 0, unit, 1) for v in (vertex, origin))
    w, depth = vertex[..., 2], jnp.where(seen, origin[..., 2], 1)
    x, y = (vertex[..., i] - origin[..., i] / depth * w for i in range(2))
    extent = jnp.max(jnp.abs(lax.stop_gradient(jnp.stack([x, y]))), axis=(0, 2))[:, None]
    seen = seen & (extent > epsilon * epsilon) & (extent < jnp.inf)
    extent = jnp.where(seen, extent, 1)
    x, y = x / extent, y / extent

    def turn(a: Array, b: Array) -> Array:
        return jnp.roll(a, -1, axis=1) * jnp.roll(b, -2, axis=1) - (
            jnp.roll(a, -2, axis=1) * jnp.roll(b, -1, axis=1)
        )

    volume = jnp.sum(w * turn(x, y), axis=1, keepdims=True)
    seen = seen & (jnp.abs(volume) > epsilon)
    inverse = jnp.where(seen, 1, 0) / jnp.where(seen, volume, 1)
    shares = jnp.stack([turn(y, w), turn(w, x)], axis=1) * (inverse / extent)[..., None]
    limit = 1 / epsilon**2  # beyond that products overflow, and coordinates have no fraction
    values = jnp.clip(attributes, -limit, limit)[corners]
    slopes = jnp.sum(shares[..., None] * values[:, None], axis=2)  # (F, 2, C)
    return jnp.concatenate(
        [slopes.reshape(slopes.shape[0], -1), jnp.sum(shares, axis=2), w], axis=1
    )


def slopes_at(
    slopes: Float[Array, "F columns"],
    face: Int[Array, "*size"],
    barycentrics: list[Float[Array, "*size"]],
    values: list[Float[Array, "*size"]],
) -> list[list[Float[Array, "*size"]]]:
    """Derivatives of attributes by the pixel's x and y at points, one pair an attribute.

    Args:
        slopes: of `face_slopes`.
        face: of each point.
        barycentrics: of the point there.
        values: of the attributes there.
    """
    count = len(values)
    columns = [slopes[:, i][jnp.maximum(face, 0)] for i in range(slopes.shape[1])]
    limit = 1 / jnp.finfo(slopes.dtype).eps ** 2
    w = stored(sum(barycentrics[j] * columns[2 * count + 2 + j] for j in range(3)))
    return [
        [
            w * (columns[k * count + c] - jnp.clip(t, -limit, limit) * columns[2 * count + k])
            for k in range(2)
        ]
        for c, t in enumerate(values)
    ]
