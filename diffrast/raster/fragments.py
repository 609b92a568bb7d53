"""Fragments: what a pixel sees, as differentiable functions of the clip positions.

The face ids come from `coverage`, on stopped gradients. Barycentrics and 1/w are evaluated again
from the ids by ordinary arithmetic, so every transformation of JAX applies.

With vertices moved so that the pixel's ray is the axis, X_i = x_i - px w_i and Y_i = y_i - py w_i,
the edge function e_0 = X_1 Y_2 - X_2 Y_1 is proportional to the perspective-correct barycentric
coordinate of corner 0, and so on in turn, for every sign of w. Nothing is divided before the sum.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from diffrast._check import ArrayInput, float_array, index_array, positive_int
from diffrast._pytree import pytree_dataclass
from diffrast._stored import assemble, stored, stored_rows
from diffrast.raster.coverage import visible_faces


@pytree_dataclass
class Fragments:
    """The nearest surface at every pixel centre.

    Attributes:
        face: face ids, -1 on the background. Not differentiable.
        barycentrics: perspective-correct barycentric coordinates of the face's corners, 0 on the
            background. Differentiable in the clip positions, for fixed faces.
        inverse_depth: 1/w (for a perspective camera, one over the depth along the viewing
            direction), 0 on the background. Differentiable likewise.
    """

    face: Int[Array, "height width"]
    barycentrics: Float[Array, "height width 3"]
    inverse_depth: Float[Array, "height width"]


def rasterize(
    positions_clip: ArrayInput,
    faces: ArrayInput,
    *,
    height: int,
    width: int,
    cull_backfaces: bool = False,
    border: int = 0,
) -> Fragments:
    """Find the nearest face at every pixel centre, and where on it the pixel looks.

    Every centre inside a closed or joined surface belongs to exactly one face of the sheet: edges
    are decided exactly, in 1/1024 pixel fixed point (up to 8192 pixels; coarser beyond), with a
    top-left rule for centres on an edge. Vertices may lie behind the eye and anywhere else; only
    what lies between the near and far plane (-w <= z <= w) is drawn. Equal depths go to the face
    drawn first, the same in every run. A face with a vertex that is not finite is not drawn.

    Args:
        positions_clip: (V, 4) clip coordinates x, y, z, w, as OpenGL's: x and y point right and up.
        faces: (F, 3) vertex indices, counter-clockwise to the viewer on front faces.
        height: rows of the image. Row 0 is the top; pixel (i, j) has its centre at j + 0.5 right
            of the left and i + 0.5 below the top border.
        width: columns of the image.
        cull_backfaces: drop faces that turn clockwise to the viewer.
        border: pixels to see beyond each side of the image; `antialias` wants one.

    Returns:
        The fragments, of height + 2 border rows and width + 2 border columns. Barycentrics and
        inverse depth are differentiable in `positions_clip`.

    Raises:
        ValueError: for wrong shapes, indices out of range, no faces, and clip positions that are
            not finite (while tracing, faces with such positions are not drawn).
    """
    positions_clip = float_array("positions_clip", positions_clip, ("V", 4))
    faces = index_array("faces", faces, ("F", 3), bound=positions_clip.shape[0])
    if faces.shape[0] == 0:
        raise ValueError("faces: wanted at least one face, got none")
    height, width = positive_int("height", height), positive_int("width", width)
    border = positive_int("border", border, minimum=0)
    positions_clip = stored_rows(with_border(positions_clip, height, width, border))
    face = visible_faces(
        lax.stop_gradient(positions_clip),
        faces,
        height=height + 2 * border,
        width=width + 2 * border,
        cull_backfaces=bool(cull_backfaces),
    )
    barycentrics, inverse_depth = evaluate_fragments(positions_clip, faces, face)
    return Fragments(face=face, barycentrics=assemble(barycentrics), inverse_depth=inverse_depth)


def with_border(
    positions_clip: Float[Array, "V 4"], height: int, width: int, border: int
) -> Float[Array, "V 4"]:
    """Clip positions for an image that is wider by `border` pixels on each side."""
    if border == 0:
        return positions_clip
    scale = np.array([width / (width + 2 * border), height / (height + 2 * border), 1, 1])
    return positions_clip * scale.astype(positions_clip.dtype)


def evaluate_fragments(
    positions_clip: Float[Array, "V 4"],
    faces: Int[Array, "F 3"],
    face: Int[Array, "height width"],
) -> tuple[list[Float[Array, "height width"]], Float[Array, "height width"]]:
    """Barycentric coordinates, one array a corner, and 1/w of given faces; 0 where face is -1."""
    height, width = face.shape
    covered = face >= 0
    corners = corners_at(faces, face)
    dtype = positions_clip.dtype
    # Pixel centres in half pixels from the image centre: integers, so products with half-length
    # factors are exact.
    x_centre = (2 * jnp.arange(width) + 1 - width).astype(dtype)[None, :]
    y_centre = (height - 1 - 2 * jnp.arange(height)).astype(dtype)[:, None]
    (x_vertex, y_vertex, w_vertex), unit = _scaled_columns(positions_clip)

    x, y, w = [], [], []
    for j in range(3):
        w_corner = w_vertex[corners[j]]
        x.append(_offset(x_vertex[corners[j]], w_corner, width, x_centre))
        y.append(_offset(y_vertex[corners[j]], w_corner, height, y_centre))
        w.append(w_corner)
    edge = [
        x[1] * y[2] - x[2] * y[1],
        x[2] * y[0] - x[0] * y[2],
        x[0] * y[1] - x[1] * y[0],
    ]
    total = edge[0] + edge[1] + edge[2]
    valid = covered & (total != 0)
    inverse_total = jnp.where(valid, 1, 0) / jnp.where(valid, total, 1)
    barycentrics = stored([e * inverse_total for e in edge])
    depth = barycentrics[0] * w[0] + barycentrics[1] * w[1] + barycentrics[2] * w[2]
    positive = valid & (depth > 0)
    inverse_depth = jnp.where(positive, 1 / unit, 0) / jnp.where(positive, depth, 1)
    return barycentrics, inverse_depth


def corners_at(faces: Int[Array, "F 3"], face: Int[Array, "*size"]) -> list[Int[Array, "*size"]]:
    """Vertices of the visible faces, one array a corner; those of face 0 on the background."""
    visible = jnp.maximum(face, 0)
    return [faces[:, j][visible] for j in range(3)]


def _scaled_columns(positions_clip: Array) -> tuple[list[Array], Array]:
    """Columns x, y, w in units of about the largest of them, so that products stay in range.

    The unit, also returned, is a power of two: the division rounds nothing. Positions that are not
    finite become zero: no visible face has them, but the background evaluates face 0.
    """
    finite = jnp.all(jnp.isfinite(positions_clip), axis=1)
    columns = [jnp.where(finite, positions_clip[:, i], 0) for i in (0, 1, 3)]
    largest = jnp.max(jnp.abs(lax.stop_gradient(jnp.stack(columns))))
    unit = jnp.ldexp(jnp.ones_like(largest), jnp.frexp(largest)[1] - 1)
    return [column / unit for column in columns], unit


def _offset(numerator: Array, w: Array, size: int, centre: Array) -> Array:
    """`size * numerator - centre * w`: twice the distance from the ray, in pixels times w.

    Cancels heavily for small triangles. The high halves have products without rounding error, so
    their difference has none that matters either.
    """
    high, low = _halves(numerator)
    w_high, w_low = _halves(w)
    return (size * high - centre * w_high) + (size * low - centre * w_low)


def _halves(values: Array) -> tuple[Array, Array]:
    """A part with 11 significant bits, whose multiples by image sizes are exact, and the rest."""
    stopped = lax.stop_gradient(values)
    format_ = jnp.finfo(values.dtype)
    high = lax.reduce_precision(stopped, format_.nexp, format_.nmant - 13)
    return high, values - high
