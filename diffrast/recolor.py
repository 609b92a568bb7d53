"""Pictures of scalars to be coloured by a look-up table, without rendering again (FEATURES S7).

::

    buffers = dr.render_buffers(scene, camera, settings)
    cosines = dr.light_cosines(buffers, light)
    image = dr.recolor(cosines, buffers.face, table, background=(1, 1, 1))

The last line alone is needed for another colour of the object, its highlight or the light.
"""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from diffrast._check import ArrayInput, float_array, index_array, instance_of
from diffrast._pytree import with_field
from diffrast.color import LookUpTable, look_up
from diffrast.light import (
    DirectionalLight,
    PointLight,
    ShiningLight,
    SpotLight,
    dot_columns,
    incoming,
    normalize_columns,
)
from diffrast.render import Buffers


def light_cosines(buffers: Buffers, light: ShiningLight) -> Float[Array, "height width"]:
    """N·L at every pixel, 0 where the surface faces away and on the background (Kos 8.3).

    Differentiable in the buffers and the light's direction or position; its colours and what it
    casts of shadow play no part.
    """
    instance_of("buffers", buffers, Buffers)
    instance_of("light", light, DirectionalLight, PointLight, SpotLight)
    position = [buffers.position[..., i] for i in range(3)]
    normal, _ = normalize_columns([buffers.normal[..., i] for i in range(3)])
    direction, _ = incoming(with_field(light, "attenuation", None), position)
    cosine = jnp.broadcast_to(dot_columns(normal, direction), buffers.face.shape)
    return jnp.where(buffers.face >= 0, jnp.maximum(cosine, 0), 0)


def depths(buffers: Buffers) -> Float[Array, "height width"]:
    """Depth w of every pixel, along the viewing direction of a perspective camera; 0 if empty.

    A table from white near by to black far away makes of it a shading by distance
    (Froyen 6.2, who takes one depth for each triangle). Differentiable in the buffers.
    """
    instance_of("buffers", buffers, Buffers)
    seen = buffers.inverse_depth > 0
    return jnp.where(seen, 1, 0) / jnp.where(seen, buffers.inverse_depth, 1)


def recolor(
    values: ArrayInput,
    face: Int[Array, "height width"],
    table: LookUpTable,
    *,
    background: ArrayInput = 0.0,
) -> Float[Array, "height width channels"]:
    """Colour a picture of scalars.

    Args:
        values: (height, width).
        face: (height, width) face ids of the same picture, -1 where it is empty.
        table: colours of the values.
        background: (channels,) or a number, for empty pixels.

    Returns:
        (height, width, channels), differentiable in the values, the table and the background.

    Raises:
        ValueError: for wrong shapes.
    """
    instance_of("table", table, LookUpTable)
    values = float_array("values", values, ("height", "width"), finite=False)
    face = index_array("face", face, values.shape, minimum=-1, bound=2**31 - 1)
    background = float_array("background", background)
    channels = table.colors.shape[1]
    if background.shape not in ((), (channels,)):
        raise ValueError(
            f"background: wanted a number or shape ({channels},), got {background.shape}"
        )
    return jnp.where((face >= 0)[..., None], look_up(table, values), background)
