"""A scene seen by a camera: the stages in order.

`render` transforms vertices, rasterises, interpolates what the shading needs at the visible points
only, and shades. What a scene does not hold is not computed: see `RenderSettings` and the rooms of
each stage.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Int

from diffrast._check import instance_of
from diffrast._stored import assemble, interleaved, stored, stored_alone
from diffrast._topology import Topology
from diffrast.bending import Turning, find_turning
from diffrast.camera import Camera, central_rays, check_single
from diffrast.deferred import comes_held, shade_covered
from diffrast.edges import Cast, View, antialias_image, with_depth
from diffrast.geometry import (
    Points,
    apart_edges,
    clip_positions,
    draw,
    normals_at,
    positions_at,
    scene_topology,
    uvs_at,
    visible_points,
    world_geometry,
)
from diffrast.light import Columns, casts_shadow, normalize_columns
from diffrast.scene import Scene
from diffrast.settings import RenderSettings
from diffrast.shadows import Parted, parted, terminators
from diffrast.surface import SHADERS, World, cast_outlines, cast_shadows, glow, receive_shadows
from diffrast.texture import CubeTexture
from diffrast.texturing import paint_scene, seams, skybox
from diffrast.turning import turns


class Buffers(NamedTuple):
    """What `render_buffers` knows of every pixel centre; zeros on the background.

    Attributes:
        face: face ids, counted through the scene's objects in order, -1 on the background.
        object: index of the object, -1 on the background.
        barycentrics: perspective-correct, of the face's three corners.
        inverse_depth: 1/w.
        position: world position of the visible point.
        normal: unit world normal as the shading uses it.
        uv: texture coordinates, None if no mesh has any.
        lit: for each light that casts shadows, in the scene's order, 1 where it reaches the visible
            point and 0 elsewhere; None if there is no such light.
    """

    face: Int[Array, "height width"]
    object: Int[Array, "height width"]
    barycentrics: Float[Array, "height width 3"]
    inverse_depth: Float[Array, "height width"]
    position: Float[Array, "height width 3"]
    normal: Float[Array, "height width 3"]
    uv: Float[Array, "height width 2"] | None
    lit: Float[Array, "height width lights"] | None


@jax.jit
def render(
    scene: Scene, camera: Camera, settings: RenderSettings
) -> Float[Array, "height width 3"]:
    """Render one view.

    Differentiable in every continuous part of the scene and the camera; with `settings.antialias`
    through the visibility of edges as well (`diffrast.edges`), the second derivatives of which are
    left out, like those of what is added where colours turn within a pixel (`diffrast.turning`).
    Compiled at the first call for each structure of the scene, image size and setting.

    Args:
        scene: what is seen.
        camera: from where.
        settings: image size and method.

    Returns:
        (height, width, 3) linear RGB, not clamped; `background` where there is no object.

    Raises:
        ValueError: if the background is an image of another size, the camera is a stack, or an
            argument is another tree of arrays; of what is none JAX makes a TypeError or
            OverflowError.

    Example:
        >>> ball = dr.Object(dr.shapes.icosphere(2), dr.Material(diffuse=(0.5, 0.5, 0.5)))
        >>> scene = dr.Scene(objects=[ball], lights=[dr.DirectionalLight(direction=(0, 0, -1))])
        >>> eye, target = (0, 0, 3), (0, 0, 0)
        >>> camera = dr.Camera.perspective(eye=eye, target=target, fov_y=0.9, near=1, far=9)
        >>> settings = dr.RenderSettings(height=9, width=9, antialias=False)
        >>> dr.render(scene, camera, settings)[4, 4].round(3).tolist()
        [0.5, 0.5, 0.5]
    """
    _check_kinds(scene, camera, settings)
    side = round(settings.samples**0.5)
    height, width = settings.height * side, settings.width * side
    border = 1 if settings.antialias and scene.objects else 0
    background = _background(scene, camera, settings, border)
    if not scene.objects:
        if isinstance(scene.background, CubeTexture):
            return _pixels([background[..., c] for c in range(3)], side)
        return jnp.broadcast_to(scene.background, (settings.height, settings.width, 3))
    geometry = world_geometry(scene, settings.shading)
    clip = clip_positions(geometry, camera)
    drawn, face = draw(  # a border of one pixel shows what lies beyond the edges there
        scene,
        geometry,
        camera,
        clip,
        height,
        width,
        cull_backfaces=settings.cull_backfaces,
        border=border,
    )
    with jax.named_scope("shade"):
        bare = jax.lax.stop_gradient(drawn._replace(attributes=(), projection=None, placed=None))
        pixels = visible_points(bare, face)  # if there are shadows
        world, reached = cast_shadows(scene, camera, geometry, pixels, settings.shading)
        world = world._replace(
            paints=paint_scene(scene, geometry, clip, height, width),
            rays=None if camera.distortion is not None else central_rays(camera, height, width),
        )
        # Others look at all vertices or texels for each batch.
        in_batches = settings.shading == "phong" and not world.paints

        shader = SHADERS[settings.shading]
        behind = [background[..., c] for c in range(3)]
        color = shade_covered(
            shader,
            world,
            drawn,
            face,
            reached,
            behind,
            in_batches=in_batches,
            points=None if world.shadows is None else pixels,
        )
        held = comes_held(face, in_batches)
    if settings.antialias:
        with jax.named_scope("edges"):
            hard = interleaved(color) if held else assemble([stored_alone(c) for c in color])
            topology = scene_topology(scene)
            apart = _apart(world, topology, settings)
            turning = find_turning(face, hard) if in_batches else None
            cast = cast_outlines(world, topology, bare.positions_clip, pixels, reached)
            view = _edged_view(
                hard, world, topology, apart, clip, face, cast, background, turning, settings
            )
            finish = None
            if turning is not None:
                unshadowed = world._replace(shadows=None)
                volume = view.volume
                assert volume is not None
                finish = turns(shader, unshadowed, drawn, reached, topology, apart, volume, turning)
            image = antialias_image(
                view,
                shader=partial(_shade_points, shading=settings.shading),
                glow=partial(_glow_at, shading=settings.shading),
                cull_backfaces=settings.cull_backfaces,
                finish=finish,
            )
        if side == 1:
            return image
        color = [image[..., c] for c in range(3)]
    elif side == 1 and held:
        return interleaved(color)
    return _pixels(color, side)


@jax.jit
def render_buffers(scene: Scene, camera: Camera, settings: RenderSettings) -> Buffers:
    """What is visible at every pixel centre, before shading; `samples` is not used.

    Arguments, errors and differentiability as `render`.
    """
    _check_kinds(scene, camera, settings)
    size = (settings.height, settings.width)
    if not scene.objects:
        three = jnp.zeros((*size, 3), camera.view.dtype)
        nothing = jnp.full(size, -1, jnp.int32)
        shadows = sum(map(casts_shadow, scene.lights))
        lit = jnp.zeros((*size, shadows), three.dtype) if shadows else None
        return Buffers(nothing, nothing, three, three[..., 0], three, three, None, lit)
    geometry = world_geometry(scene, settings.shading)
    clip = clip_positions(geometry, camera)
    drawn = draw(scene, geometry, camera, clip, *size, cull_backfaces=settings.cull_backfaces)
    pixels = visible_points(*drawn)
    columns = normals_at(geometry, pixels)
    lighting = "flat" if settings.shading == "unlit" else settings.shading
    _, reached = cast_shadows(scene, camera, geometry, pixels, lighting)
    lit_parts = [part for part in reached if part is not None]
    normal, _ = normalize_columns(columns)
    covered = pixels.face >= 0
    object_of_face = geometry.object_of_face[jnp.maximum(pixels.face, 0)]

    def stacked(columns: Columns) -> Array:
        return jnp.where(covered[..., None], jnp.stack(columns, axis=-1), 0)

    return Buffers(
        face=pixels.face,
        object=jnp.where(covered, object_of_face, -1),
        barycentrics=jnp.stack(pixels.barycentrics, axis=-1),
        inverse_depth=pixels.inverse_depth,
        position=stacked(positions_at(geometry, pixels)),
        normal=stacked(normal),
        uv=None if geometry.uvs is None else stacked(uvs_at(geometry, pixels)),
        lit=stacked(lit_parts) if lit_parts else None,
    )


@jax.jit
def shadow_outlines(scene: Scene, camera: Camera, settings: RenderSettings) -> Parted | None:
    """Which edges have the outlines of the shadows in a picture, and how many are not known.

    Where a shadow begins or ends between two pixels without a known edge, the picture is jagged
    and its derivative leaves the outline out: `pairs - found` counts these, for each light.

    Args:
        scene: what is seen.
        camera: from where.
        settings: image size and method; `samples` is not used.

    Returns:
        For each light that casts shadows, in the scene's order, the edge between each pixel and the
        one on its right (0) and below it (1), as 3 * face + the corner opposite to it, -1 where
        there is none, also where one of them shows something nearer that hides where the shadow
        begins or ends; the number of pairs of pixels of one surface that a shadow parts, not folds
        of the surface, and the number of those with an edge. None without such lights or without
        objects.

    Raises:
        As `render`.
    """
    _check_kinds(scene, camera, settings)
    if not scene.objects or not any(map(casts_shadow, scene.lights)):
        return None
    geometry = world_geometry(scene, settings.shading)
    clip = clip_positions(geometry, camera)
    size = settings.height, settings.width
    drawn = draw(scene, geometry, camera, clip, *size, cull_backfaces=settings.cull_backfaces)
    pixels = visible_points(*drawn)
    lighting = "flat" if settings.shading == "unlit" else settings.shading
    world, reached = cast_shadows(scene, camera, geometry, pixels, lighting)
    topology = scene_topology(scene)
    cast = cast_outlines(world, topology, drawn[0].positions_clip, pixels, reached)
    assert cast is not None
    assert world.shadows is not None
    return parted(
        scene.lights, world.shadows, geometry, topology, pixels, cast.lit, cast.between, clip
    )


def _check_kinds(scene: Scene, camera: Camera, settings: RenderSettings) -> None:
    instance_of("scene", scene, Scene)
    check_single(camera)
    instance_of("settings", settings, RenderSettings)


def _apart(world: World, topology: Topology, settings: RenderSettings) -> Array:
    """The edges between two faces in view across which colours may jump."""
    apart = apart_edges(world.geometry, topology.edges, settings.shading)
    if settings.shading != "flat" and world.shadows is not None:
        apart = apart | terminators(world.shadows, topology.edges)
    if world.paints:
        apart = apart | seams(world.scene, world.paints, topology.edges)
    return apart


def _edged_view(
    image: Array,
    world: World,
    topology: Topology,
    apart: Array,
    positions_clip: Array,
    face: Array,
    cast: Cast | None,
    background: Array,
    turning: Turning | None,
    settings: RenderSettings,
) -> View:
    """What `antialias_image` takes."""
    geometry = world.geometry
    if settings.shading == "flat":  # every face has a colour of its own
        topology = topology._replace(patches=jnp.arange(geometry.faces.shape[0]))
    view = View(
        positions_clip=positions_clip,
        faces=geometry.faces,
        turned=geometry.faces_outward[:, 0] != geometry.faces[:, 0],
        topology=topology,
        apart=apart,
        face_image=face,
        image=image,
        background=background,
        scene=world,
        cast=cast,
        meaned=None if turning is None else turning.chosen,
    )
    return with_depth(view)


@partial(jax.jit, static_argnames="shading")
def _shade_points(
    world: World, face: Array, at: Columns, told: Array | None, *, shading: str
) -> Columns:
    points = Points(face, at, jnp.zeros_like(at[0]))
    return SHADERS[shading](world, points, receive_shadows(world, points, told))


@partial(jax.jit, static_argnames="shading")
def _glow_at(world: World, light: Array, face: Array, at: Columns, *, shading: str) -> Columns:
    return glow(shading, world, light, Points(face, at, jnp.zeros_like(at[0])))


def _background(scene: Scene, camera: Camera, settings: RenderSettings, border: int) -> Array:
    """What is seen where there is no object: a colour, or an image of all samples and a border."""
    side = round(settings.samples**0.5)
    background = scene.background
    if isinstance(background, CubeTexture):
        height, width = settings.height * side, settings.width * side
        return skybox(background, camera, height, width, border)
    if background.ndim == 1:
        return background
    if background.shape[:2] != (settings.height, settings.width):
        raise ValueError(
            f"background: wanted an image of {settings.height} rows and {settings.width} columns,"
            f" got {background.shape[0]} and {background.shape[1]}"
        )
    if side > 1:
        background = jnp.repeat(jnp.repeat(background, side, axis=0), side, axis=1)
    return jnp.pad(background, ((border, border), (border, border), (0, 0)), mode="edge")


def _pixels(color: Columns, side: int) -> Array:
    """The image of pixels from the colours of side × side samples of each."""
    if side > 1:
        color = [_box_average(channel, side) for channel in color]
    # A loop over views would else compute the colours where it puts them into place, on one core.
    return stored_alone(assemble(stored(color)))


def _box_average(channel: Array, side: int) -> Array:
    """Mean over side × side blocks, added in one fixed order."""
    height, width = channel.shape
    blocks = channel.reshape(height // side, side, width // side, side)
    return blocks.mean(axis=(1, 3))
