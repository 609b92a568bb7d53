"""Fragments: what a pixel sees, as differentiable functions of the clip positions.

The face ids come from `coverage`, on stopped gradients; `evaluate` finds barycentrics and 1/w again
from the ids.
"""

import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from diffrast._check import ArrayInput, flag, float_array, index_array, positive_int
from diffrast._pytree import pytree_dataclass
from diffrast._stored import assemble, stored_rows
from diffrast.raster.coverage import visible_faces
from diffrast.raster.evaluate import Drawn, all_pixels, evaluate


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

    Example:
        >>> triangle = jnp.array([[-1.0, -1, 0, 1], [1.5, -1, 0, 1], [-1, 1.5, 0, 1]])
        >>> dr.rasterize(triangle, [[0, 1, 2]], height=3, width=4).face.tolist()
        [[0, 0, -1, -1], [0, 0, 0, -1], [0, 0, 0, 0]]
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
        cull_backfaces=flag("cull_backfaces", cull_backfaces),
    )
    seen = evaluate(Drawn(positions_clip, faces), all_pixels(face, positions_clip.dtype))
    return Fragments(
        face=face, barycentrics=assemble(seen.barycentrics), inverse_depth=seen.inverse_depth
    )


def with_border(
    positions_clip: Float[Array, "V 4"], height: int, width: int, border: int
) -> Float[Array, "V 4"]:
    """Clip positions for an image that is wider by `border` pixels on each side."""
    if border == 0:
        return positions_clip
    scale = np.array([width / (width + 2 * border), height / (height + 2 * border), 1, 1])
    return positions_clip * scale.astype(positions_clip.dtype)
