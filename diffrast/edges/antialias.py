"""The stage that gives an image its edges; see `blend` for the method."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float

from diffrast.edges.blend import Blended, Method, Shader, View, apply_linear, collect, linear_zeros
from diffrast.edges.pieces import to_pixels


def antialias_image(
    view: View, *, shader: Shader | None, cull_backfaces: bool
) -> Float[Array, "height width channels"]:
    """Give an image its edges, in value and in derivative, and cut off its border of one pixel.

    Args:
        view: what is drawn, and the image without edges.
        shader: see `Method`.
        cull_backfaces: whether only front faces are drawn.
    """
    height, width, channels = view.image.shape[0] - 2, view.image.shape[1] - 2, view.image.shape[2]
    capacity = max(4096, 1024 * math.ceil(height * width / 8 / 1024))
    method = Method(shader, cull_backfaces, capacity)
    gather = jax.custom_batching.sequential_vmap(lambda view: collect(view, method))

    def with_edges(image: Array, found: Blended) -> Array:
        added, low, high = (
            part.reshape(height, width, channels) for part in (found.added, *found.range)
        )
        return jnp.clip(image[1:-1, 1:-1] + added, low, high)

    @jax.custom_jvp
    def blended(image: Array, positions_clip: Array, rest: View) -> Array:
        now = rest._replace(image=image, positions_clip=positions_clip)
        return with_edges(image, gather(now))

    def derivative(primals: Any, tangents: Any) -> tuple[Array, Array]:
        image, positions_clip, rest = primals
        d_image, d_clip = tangents[:2]
        if isinstance(d_image, SymbolicZero):
            d_image = linear_zeros(image.shape, d_clip)
        if isinstance(d_clip, SymbolicZero):
            d_clip = linear_zeros(positions_clip.shape, d_image)
        now = lax.stop_gradient(rest._replace(image=image, positions_clip=positions_clip))
        found = gather(now)
        x, y, _, w = to_pixels(d_clip, height, width)
        points = jnp.stack([x, y, w], axis=-1)
        d_out = apply_linear(now, method, found, points, d_image.reshape(-1, channels))
        return with_edges(image, found), d_out.reshape(height, width, channels)

    blended.defjvp(derivative, symbolic_zeros=True)
    return blended(view.image, view.positions_clip, lax.stop_gradient(view))
