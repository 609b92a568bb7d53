"""The stage that gives an image its edges; see `blend` for the method."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import zero_from_primal
from jaxtyping import Float, Int

from diffrast import _check
from diffrast._check import ArrayInput
from diffrast._device import over_views
from diffrast._linear import without_known_zeros
from diffrast._stored import stored
from diffrast._topology import Topology, traced_topology
from diffrast.edges.blend import Blended, Glow, Method, Shader, View, with_sums
from diffrast.edges.collect import collect
from diffrast.edges.derivative import ROWS_AT_ONCE, apply_linear
from diffrast.edges.pieces import depth_of, facing, scale_by_depth, to_pixels
from diffrast.edges.shadow_pairs import with_lights
from diffrast.edges.survey import survey
from diffrast.raster.evaluate import unit_of

CREASES = ("none", "seams", "all")


class Finish(NamedTuple):
    """What is done with a picture that has its edges; see `diffrast.turning`.

    Attributes:
        data: a tree of arrays that it takes.
        draw: `draw(data, picture)`, the finished picture and what its derivative is made of.
        change: `change(data, made_of, changes, colors)`, linear in the changes of the data and of
            the colours that the image without edges has at its pixels' centres: the change of what
            these pixels show.
    """

    data: Any
    draw: Callable[[Any, Array], tuple[Array, Any]]
    change: Callable[[Any, Any, Any, Array], Array]


PointShader = Callable[[Any, Int[Array, " n"], Float[Array, "n 3"]], Float[Array, "n channels"]]


def antialias(
    image: ArrayInput,
    positions_clip: ArrayInput,
    faces: ArrayInput,
    face: Int[Array, "height_with_border width_with_border"],
    *,
    background: ArrayInput = 0.0,
    topology: Topology | None = None,
    creases: str = "seams",
    cull_backfaces: bool = False,
    shader: PointShader | None = None,
    data: Any = None,
) -> Float[Array, "height width channels"]:
    """Give an image that was shaded pixel by pixel its edges, in value and in derivative.

    Where an outline, a boundary or a crease passes through a pixel, both sides get their exact
    share of its area, and the result is differentiable in `positions_clip` through that share: this
    is how geometry has a derivative through what is visible. Everything is drawn with a border of
    one pixel, so that edges that leave the image lose nothing::

        fragments = dr.rasterize(positions_clip, mesh.faces, height=h, width=w, border=1)
        image = my_shading(fragments)                       # (h + 2, w + 2, channels)
        image = dr.antialias(image, positions_clip, mesh.faces, fragments.face,
                             topology=mesh.topology)        # (h, w, channels)

    What comes before must shade each pixel by itself, as any function of what it sees: colours of
    neighbouring pixels are taken for those of the surfaces there. Blur, resample or denoise
    afterwards. Number and meaning of the channels are free.

    Args:
        image: (height + 2, width + 2, channels), differentiable.
        positions_clip: (V, 4) as given to `rasterize`, differentiable; its second derivative
            through visibility is left out.
        faces: (F, 3) likewise.
        face: (height + 2, width + 2) face ids, -1 on the background, as `rasterize` gives them.
        background: (channels,) or a number: what empty pixels show; or a picture like `image`.
        topology: `Mesh.topology`. Without it edges are found in each call, by sorting, and joined
            where clip positions are equal.
        creases: between which faces, both in view, colours may jump: those that have vertices of
            their own at the common edge ("seams"), any ("all", for flat shading), or "none".
        cull_backfaces: as given to `rasterize`.
        shader: colours (n, channels) of points on faces, `shader(data, face, barycentrics)`, for
            exact colours at the edges; it needs no derivative. Without it those of the pixels
            beside them are taken: several times the error where colours change from pixel to pixel.
        data: a tree of arrays for the shader, which cannot use traced arrays otherwise.

    Returns:
        (height, width, channels).

    Raises:
        ValueError: for wrong shapes, indices out of range, an unknown choice, and a shader
            that makes no such colours.
    """
    image = _check.float_array("image", image, ("height + 2", "width + 2", "channels"))
    positions_clip = _check.float_array("positions_clip", positions_clip, ("V", 4))
    faces = _check.index_array("faces", faces, ("F", 3), bound=positions_clip.shape[0])
    face = _check.index_array("face", face, image.shape[:2], minimum=-1, bound=faces.shape[0])
    if min(image.shape) < 1 or min(image.shape[:2]) < 3:
        raise ValueError(
            "image: wanted a channel and a border of one pixel round at least one pixel,"
            f" got shape {image.shape}"
        )
    _check.one_of("creases", creases, CREASES)
    cull_backfaces = _check.flag("cull_backfaces", cull_backfaces)
    if topology is not None:
        _check.instance_of("topology", topology, Topology)
    if shader is not None and not callable(shader):
        raise ValueError(f"shader: wanted a function or None, got {type(shader).__name__}")
    background = _check.float_array("background", background).astype(image.dtype)
    if background.shape != image.shape:
        if background.shape not in ((), image.shape[2:]):
            raise ValueError(
                f"background: wanted a number or shape {image.shape[2:]} or {image.shape}, got"
                f" {background.shape}"
            )
        background = jnp.broadcast_to(background, image.shape[2:])
    if topology is None:
        topology = traced_topology(positions_clip, faces)
    elif topology.patches.shape != faces.shape[:1]:
        raise ValueError(
            f"topology: wanted that of {faces.shape[0]} faces, got one of"
            f" {topology.patches.shape[0]}"
        )
    seam = jnp.asarray(topology.edges.seam)
    if creases == "all":
        topology = topology._replace(patches=jnp.arange(faces.shape[0]))
    view = View(
        positions_clip=positions_clip,
        faces=faces,
        turned=None,
        topology=topology,
        apart=seam if creases == "seams" else jnp.full_like(seam, creases == "all"),
        face_image=face,
        image=image,
        background=background,
        scene=data,
    )
    own = None if shader is None else _by_columns(shader, image)
    return antialias_image(with_depth(view), shader=own, cull_backfaces=cull_backfaces)


def _by_columns(shader: PointShader, image: Array) -> Shader:
    channels, dtype = image.shape[2], image.dtype

    def shade(data: Any, face: Array, barycentrics: list[Array], _: Array | None) -> list[Array]:
        colors = shader(data, face, jnp.stack(barycentrics, axis=-1))
        colors = _check.float_array("shader", colors, (face.size, channels)).astype(dtype)
        return [colors[:, c] for c in range(channels)]

    return shade


def with_depth(view: View) -> View:
    """The view with what tells which of its faces are nearer, and which side each turns to the eye.

    Lights and their weights follow its positions, then, if it has shadows.
    """
    height, width = view.size
    depth, unit = depth_of(view.positions_clip), unit_of(view.positions_clip)
    scale = scale_by_depth(depth, view.positions_clip) / unit
    if view.topology.bodies is None and view.cast is None:
        # It moves nothing but lines in which planes meet.
        scale = lax.stop_gradient(scale)
    positions_clip = view.positions_clip * scale[:, None]

    def volume_of(positions_clip: Array, faces: Array) -> Array:
        pixels = stored(to_pixels(positions_clip, height, width))
        volume = facing(pixels, faces, height=height, width=width)
        z, w = positions_clip[:, 2:].T
        first, second, third = jnp.where(z < -w, 1, jnp.where(z > w, 2, 0))[faces.T]
        return jnp.where((first & second & third) > 0, 0, volume)  # before near or beyond far

    volume = over_views(volume_of, height * width)(lax.stop_gradient(positions_clip), view.faces)
    if view.cast is not None:
        cast, rows = with_lights(view.cast, depth, unit)
        positions_clip = jnp.concatenate([positions_clip, rows])
        view = view._replace(cast=cast)
    return view._replace(positions_clip=positions_clip, scale=scale, volume=volume)


def antialias_image(
    view: View,
    *,
    shader: Shader | None,
    glow: Glow | None = None,
    cull_backfaces: bool,
    finish: Finish | None = None,
) -> Float[Array, "height width channels"]:
    """Give an image its edges, in value and in derivative, and cut off its border of one pixel.

    Args:
        view: what is drawn, and the image without edges; a result of `with_depth`.
        shader: see `Method`.
        glow: likewise; needed if the view has shadows.
        cull_backfaces: whether only front faces are drawn.
        finish: what is done with it next, before anything is differentiated.
    """
    if not view.apart.size:  # faces of one vertex each
        return view.image[1:-1, 1:-1]
    (height, width), channels = view.size, view.image.shape[2]
    capacity = ROWS_AT_ONCE * max(4, height * width // (11 * ROWS_AT_ONCE))
    method = Method(shader, glow, cull_backfaces, capacity)

    find = over_views(lambda view: survey(view, method), height * width)
    view = view._replace(survey=find(lax.stop_gradient(view)))

    def gather(view: View, method: Method) -> Blended:
        found: Blended = over_views(lambda view: collect(view, method), height * width)(view)
        return found

    def finished(picture: Array, data: Any) -> tuple[Array, Any]:
        return (picture, None) if finish is None else finish.draw(data, picture)

    @jax.custom_jvp
    def blended(
        image: Array, positions_clip: Array, background: Array, rest: View, data: Any
    ) -> Array:
        now = rest._replace(image=image, positions_clip=positions_clip, background=background)
        _, sums = gather(now, method._replace(capacity=0))
        assert sums is not None
        return finished(with_sums(image, sums), data)[0]

    @jax.custom_jvp
    def recorded(
        image: Array, positions_clip: Array, background: Array, rest: View, data: Any
    ) -> tuple[Array, tuple[Any, ...]]:
        """The same, and what its derivative is made of."""
        now = rest._replace(image=image, positions_clip=positions_clip, background=background)
        records, sums = gather(now, method)
        assert sums is not None
        picture, made_of = finished(with_sums(image, sums, in_place=True), data)
        return picture, (records, sums.left, made_of)

    def derivative(primals: Any, tangents: Any) -> tuple[tuple[Array, Any], Array]:
        image, positions_clip, background, rest, data = primals
        d_bare = tangents[2] if view.pictured else ()
        d_image, d_clip, d_bare, _ = without_known_zeros((*tangents[:2], d_bare, tangents[4]))
        # With a derivative of its own: a second one takes the first one of the picture, too.
        out, made_of = recorded(*primals)
        now = rest._replace(image=image, positions_clip=positions_clip, background=background)
        now, data, (records, left, found) = lax.stop_gradient((now, data, made_of))
        d_means = d_image
        if finish is not None:
            d_means = finish.change(data, found, tangents[4], d_image)
        points = to_pixels(d_clip, height, width).T
        colors = d_image.reshape(-1, channels), d_means.reshape(-1, channels)
        if view.pictured:
            bare = d_bare.reshape(-1, channels)
            colors = jax.tree.map(lambda of_image: jnp.concatenate([of_image, bare]), colors)
        d_out = apply_linear(now, method, records, left, points, colors)
        return (out, made_of), d_out.reshape(height, width, channels)

    def of_picture(primals: Any, tangents: Any) -> tuple[Array, Array]:
        (out, _), d_out = derivative(primals, tangents)
        return out, d_out

    def of_recorded(primals: Any, tangents: Any) -> tuple[Any, Any]:
        out, d_out = derivative(primals, tangents)
        return out, (d_out, jax.tree.map(zero_from_primal, out[1]))

    blended.defjvp(of_picture, symbolic_zeros=True)
    recorded.defjvp(of_recorded, symbolic_zeros=True)
    data = None if finish is None else finish.data
    # A background of one colour moves with the image, which shows it.
    background = view.background if view.pictured else lax.stop_gradient(view.background)
    return blended(view.image, view.positions_clip, background, lax.stop_gradient(view), data)
