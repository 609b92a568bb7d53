"""Perspective-correct attributes of the visible points."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from diffrast._check import ArrayInput, float_array, index_array
from diffrast._stored import assemble
from diffrast.raster import Fragments
from diffrast.raster.fragments import corners_at


def interpolate(
    attributes: ArrayInput, faces: ArrayInput, fragments: Fragments
) -> Float[Array, "height width channels"]:
    """Interpolate vertex attributes at every pixel.

    Args:
        attributes: (V, C) values at the vertices.
        faces: (F, 3) the faces that were rasterised.
        fragments: result of `rasterize`.

    Returns:
        (height, width, C) values, 0 on the background. Differentiable in `attributes` and in the
        fragments' barycentrics.

    Raises:
        ValueError: for wrong shapes and indices out of range.
    """
    attributes = float_array("attributes", attributes, ("V", "C"), finite=False)
    faces = index_array("faces", faces, ("F", 3), bound=attributes.shape[0])
    barycentrics = [fragments.barycentrics[..., j] for j in range(3)]
    if attributes.shape[1] == 0:
        return jnp.zeros((*fragments.face.shape, 0), attributes.dtype)
    columns = interpolate_columns(
        [attributes[:, c] for c in range(attributes.shape[1])],
        faces,
        fragments.face,
        barycentrics,
    )
    return assemble(columns)


def interpolate_columns(
    columns: list[Float[Array, " V"]],
    faces: Int[Array, "F 3"],
    face: Int[Array, "*size"],
    barycentrics: list[Float[Array, "*size"]],
) -> list[Float[Array, "*size"]]:
    """Interpolate attributes kept apart, which XLA fuses far better than stacked ones."""
    b0, b1, b2 = barycentrics
    i0, i1, i2 = corners_at(faces, face)
    return [b0 * column[i0] + b1 * column[i1] + b2 * column[i2] for column in columns]
