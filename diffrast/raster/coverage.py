"""Coverage and depth: which face each pixel sees.

Two forms see the same: faces are drawn one by one on a CPU (`one_by_one`), all at once elsewhere
(`all_at_once`). A program holds one of them, that for the device for which it is compiled.
"""

from functools import partial

import jax
from jax import Array, lax
from jaxtyping import Float, Int

from diffrast._device import draws_on_cpu
from diffrast.raster.all_at_once import draw_at_once
from diffrast.raster.one_by_one import draw_one_by_one


@partial(jax.jit, static_argnames=("height", "width", "cull_backfaces"))
def visible_faces(
    positions_clip: Float[Array, "V 4"],
    faces: Int[Array, "F 3"],
    *,
    height: int,
    width: int,
    cull_backfaces: bool,
) -> Int[Array, "height width"]:
    """Id of the nearest face at every pixel centre, -1 where there is none.

    Not differentiable: pass stopped gradients. Under `vmap` the views are drawn one after another
    on a CPU, all at once elsewhere.
    """
    return _draw(positions_clip, faces, height, width, cull_backfaces)[0]


@partial(jax.jit, static_argnames=("size",))
def faces_and_depths(
    positions_clip: Float[Array, "V 4"], faces: Int[Array, "F 3"], *, size: int
) -> tuple[Int[Array, "size size"], Float[Array, "size size"]]:
    """Ids as `visible_faces` gives them, of front and back faces, and the depth keys.

    The key is 1/w, or -z/w where all vertices have the same w; -inf where there is no face.
    """
    return _draw(positions_clip, faces, size, size, False)


def _draw(
    positions_clip: Array, faces: Array, height: int, width: int, cull_backfaces: bool
) -> tuple[Array, Array]:
    cpu, default = (
        partial(way, height=height, width=width, cull_backfaces=cull_backfaces)
        for way in (draw_one_by_one, draw_at_once)
    )
    if draws_on_cpu():  # there is nothing else, and tracing both takes time
        return cpu(positions_clip, faces)
    return lax.platform_dependent(positions_clip, faces, cpu=cpu, default=default)
