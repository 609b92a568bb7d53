"""A scene seen by a camera: the stages in order.

`render` transforms vertices, rasterises, interpolates what the shading needs at the visible points
only, and shades. What a scene does not hold is not computed: see `RenderSettings` and the rooms of
each stage.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from diffrast import _check
from diffrast._check import ArrayInput
from diffrast._pytree import pytree_dataclass, set_field, static
from diffrast._stored import assemble, stored, stored_rows
from diffrast._topology import Edges, Topology, traced_topology
from diffrast.camera import Camera, viewpoint, world_to_clip
from diffrast.edges import Shader, View, antialias_image
from diffrast.interpolate import interpolate_columns
from diffrast.light import (
    AmbientLight,
    Columns,
    DirectionalLight,
    Light,
    PointLight,
    normalize_columns,
)
from diffrast.linalg import mirrors, transform_normals, transform_points
from diffrast.material import Material
from diffrast.mesh import Mesh, face_normals, vertex_normals
from diffrast.raster.coverage import visible_faces
from diffrast.raster.fragments import evaluate_fragments, with_border
from diffrast.shade import Reflectance, Surface, needs, phong

_SAME_NORMAL = 1e-5  # of their size: normals on both sides of a seam that need no edge

SHADINGS = ("phong", "gouraud", "flat", "unlit")


@pytree_dataclass
class Object:
    """A mesh of one material, placed in the world.

    Attributes:
        mesh: in its own coordinates.
        material: its reflectances.
        transform: (4, 4) object to world, traced and differentiable; normals follow by its inverse
            transpose, and what was outside stays outside where it mirrors.
    """

    mesh: Mesh
    material: Material
    transform: Float[Array, "4 4"]

    def __init__(
        self, mesh: Mesh, material: Material | None = None, transform: ArrayInput | None = None
    ) -> None:
        if not isinstance(mesh, Mesh):
            raise ValueError(f"mesh: wanted a Mesh, got {type(mesh).__name__}")
        material = Material() if material is None else material
        if not isinstance(material, Material):
            raise ValueError(f"material: wanted a Material, got {type(material).__name__}")
        if transform is None:
            transform = jnp.eye(4, dtype=mesh.vertices.dtype)
        set_field(self, "mesh", mesh)
        set_field(self, "material", material)
        set_field(self, "transform", _check.float_array("transform", transform, (4, 4)))


@pytree_dataclass
class Scene:
    """Objects, lights and what is seen where there is no object.

    Attributes:
        objects: any number of `Object`s.
        lights: any number of lights.
        background: (3,) linear RGB, or a (height, width, 3) image.
    """

    objects: tuple[Object, ...]
    lights: tuple[Light, ...]
    background: Float[Array, "*size 3"]

    def __init__(
        self,
        *,
        objects: tuple[Object, ...] | list[Object],
        lights: tuple[Light, ...] | list[Light] = (),
        background: ArrayInput = (0.0, 0.0, 0.0),
    ) -> None:
        for name, items, kinds in (
            ("objects", objects, (Object,)),
            ("lights", lights, (AmbientLight, DirectionalLight, PointLight)),
        ):
            if not isinstance(items, tuple | list):
                raise ValueError(f"{name}: wanted a tuple or list, got {type(items).__name__}")
            for i, item in enumerate(items):
                if not isinstance(item, kinds):
                    wanted = " or ".join(kind.__name__ for kind in kinds)
                    raise ValueError(f"{name}[{i}]: wanted {wanted}, got {type(item).__name__}")
        background = _check.float_array("background", background)
        if background.ndim not in (1, 3) or background.shape[-1] != 3:
            raise ValueError(
                f"background: wanted shape (3,) or (height, width, 3), got {background.shape}"
            )
        set_field(self, "objects", tuple(objects))
        set_field(self, "lights", tuple(lights))
        set_field(self, "background", background)


@pytree_dataclass
class RenderSettings:
    """How to render. All static: another value compiles another program.

    Attributes:
        height: rows of the image.
        width: columns of the image.
        shading: "phong" interpolates normals, "gouraud" the colours of vertices, "flat" takes the
            normals of the faces, and "unlit" shows the diffuse reflectance without any light.
        cull_backfaces: drop faces whose corners turn clockwise to the viewer.
        samples: samples a pixel, a square number, on a regular grid, averaged with equal weights.
        antialias: give edges their exact share of each sample's square, and the derivative its part
            through what is visible where. Without it edges are jagged, the derivative is that of
            the shading alone, and `render` compiles in half the time.
    """

    height: int = static()
    width: int = static()
    shading: str = static(default="phong")
    cull_backfaces: bool = static(default=False)
    samples: int = static(default=1)
    antialias: bool = static(default=True)

    def __post_init__(self) -> None:
        set_field(self, "height", _check.positive_int("height", self.height))
        set_field(self, "width", _check.positive_int("width", self.width))
        _check.one_of("shading", self.shading, SHADINGS)
        set_field(self, "cull_backfaces", bool(self.cull_backfaces))
        set_field(self, "antialias", bool(self.antialias))
        side = round(_check.positive_int("samples", self.samples) ** 0.5)
        if side * side != self.samples:
            raise ValueError(f"samples: wanted a square number, got {self.samples}")


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
    """

    face: Int[Array, "height width"]
    object: Int[Array, "height width"]
    barycentrics: Float[Array, "height width 3"]
    inverse_depth: Float[Array, "height width"]
    position: Float[Array, "height width 3"]
    normal: Float[Array, "height width 3"]
    uv: Float[Array, "height width 2"] | None


@jax.jit
def render(
    scene: Scene, camera: Camera, settings: RenderSettings
) -> Float[Array, "height width 3"]:
    """Render one view.

    Differentiable in every continuous part of the scene and the camera; with `settings.antialias`
    through the visibility of edges as well (`diffrast.edges`), the second derivatives of which are
    left out. Compiled at the first call for each structure of the scene, image size and setting.

    Args:
        scene: what is seen.
        camera: from where.
        settings: image size and method.

    Returns:
        (height, width, 3) linear RGB, not clamped; `background` where there is no object.

    Raises:
        ValueError: if the background is an image of another size, or the camera is a stack.
    """
    side = round(settings.samples**0.5)
    height, width = settings.height * side, settings.width * side
    background = scene.background
    if background.ndim == 3 and background.shape[:2] != (settings.height, settings.width):
        raise ValueError(
            f"background: wanted an image of {settings.height} rows and {settings.width} columns,"
            f" got {background.shape[0]} and {background.shape[1]}"
        )
    if background.ndim == 3 and side > 1:
        background = jnp.repeat(jnp.repeat(background, side, axis=0), side, axis=1)
    if not scene.objects:
        return jnp.broadcast_to(scene.background, (settings.height, settings.width, 3))
    geometry = _world_geometry(scene, settings.shading)
    clip = _clip_positions(geometry, camera)
    size, seen_clip = (height, width), clip
    if settings.antialias:  # a border of one pixel shows what lies beyond the edges there
        size, seen_clip = (height + 2, width + 2), with_border(clip, height, width, 1)
        if background.ndim == 3:
            background = jnp.pad(background, ((1, 1), (1, 1), (0, 0)), mode="edge")
    pixels = _visible(geometry, seen_clip, *size, settings.cull_backfaces)
    with jax.named_scope("shade"):
        color = _SHADERS[settings.shading](scene, camera, geometry, pixels)
        covered = pixels.face >= 0
        color = [jnp.where(covered, color[c], background[..., c]) for c in range(3)]
    if settings.antialias:
        with jax.named_scope("edges"):
            image = assemble(stored(color))
            image = _with_edges(image, scene, camera, geometry, clip, pixels, background, settings)
        if side == 1:
            return image
        color = [image[..., c] for c in range(3)]
    if side > 1:
        color = [_box_average(channel, side) for channel in color]
    return assemble(stored(color))


@jax.jit
def render_buffers(scene: Scene, camera: Camera, settings: RenderSettings) -> Buffers:
    """What is visible at every pixel centre, before shading; `samples` is not used.

    Arguments and differentiability as `render`.
    """
    size = (settings.height, settings.width)
    if not scene.objects:
        three = jnp.zeros((*size, 3), scene.background.dtype)
        nothing = jnp.full(size, -1, jnp.int32)
        return Buffers(nothing, nothing, three, three[..., 0], three, three, None)
    geometry = _world_geometry(scene, settings.shading)
    clip = _clip_positions(geometry, camera)
    pixels = _visible(geometry, clip, *size, settings.cull_backfaces)
    if settings.shading == "flat" or geometry.normals is None:
        columns = _flat_normals(geometry, pixels.face)
    else:
        columns = _at_pixels(geometry.normals, geometry, pixels)
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
        position=stacked(_at_pixels(geometry.positions, geometry, pixels)),
        normal=stacked(normal),
        uv=None if geometry.uvs is None else stacked(_at_pixels(geometry.uvs, geometry, pixels)),
    )


# Geometry -----------------------------------------------------------------------------------------


class _Geometry(NamedTuple):
    """All objects of a scene as one mesh in the world."""

    positions: Float[Array, "V 3"]
    faces: Int[Array, "F 3"]
    faces_outward: Int[Array, "F 3"]  # turned round where a transform mirrors
    normals: Float[Array, "V 3"] | None  # None for flat and unlit shading
    uvs: Float[Array, "V 2"] | None
    object_of_face: Int[Array, " F"]
    object_of_vertex: Int[Array, " V"]


class _Pixels(NamedTuple):
    """Points on faces: the pixels of an image, or a row of them."""

    face: Int[Array, "*size"]
    barycentrics: Columns
    inverse_depth: Float[Array, "*size"]


def _world_geometry(scene: Scene, shading: str) -> _Geometry:
    with jax.named_scope("geometry"):
        positions, faces, faces_outward, normals, uvs = [], [], [], [], []
        smooth = shading in ("phong", "gouraud")
        textured = any(item.mesh.uvs is not None for item in scene.objects)
        first_vertex = 0
        for item in scene.objects:
            mesh = item.mesh
            positions.append(transform_points(item.transform, mesh.vertices))
            faces.append(mesh.faces + first_vertex)
            turned = jnp.where(mirrors(item.transform), faces[-1][:, ::-1], faces[-1])
            faces_outward.append(turned)
            first_vertex += mesh.vertices.shape[0]
            if smooth:
                own = mesh.normals
                if own is None:
                    own = vertex_normals(mesh.vertices, mesh.faces)
                normals.append(transform_normals(item.transform, own))
            if textured:
                own = mesh.uvs
                none = jnp.zeros_like(mesh.vertices[:, :2])
                uvs.append(none if own is None else own)
        all_faces = jnp.concatenate(faces)

        def joined(parts: list[Array]) -> Array:
            return stored_rows(jnp.concatenate(parts))

        counts = np.arange(len(scene.objects), dtype=np.int32)
        return _Geometry(
            joined(positions),
            all_faces,
            jnp.concatenate(faces_outward),
            joined(normals) if smooth else None,
            joined(uvs) if textured else None,
            jnp.asarray(np.repeat(counts, [o.mesh.faces.shape[0] for o in scene.objects])),
            jnp.asarray(np.repeat(counts, [o.mesh.vertices.shape[0] for o in scene.objects])),
        )


def _clip_positions(geometry: _Geometry, camera: Camera) -> Float[Array, "V 4"]:
    with jax.named_scope("project"):
        return stored_rows(world_to_clip(camera, geometry.positions))


def _visible(
    geometry: _Geometry, positions_clip: Array, height: int, width: int, cull_backfaces: bool
) -> _Pixels:
    with jax.named_scope("rasterize"):
        face = visible_faces(
            jax.lax.stop_gradient(positions_clip),
            geometry.faces_outward if cull_backfaces else geometry.faces,
            height=height,
            width=width,
            cull_backfaces=cull_backfaces,
        )
    with jax.named_scope("fragments"):
        return _Pixels(face, *evaluate_fragments(positions_clip, geometry.faces, face))


def _at_pixels(attribute: Array, geometry: _Geometry, pixels: _Pixels) -> Columns:
    columns = [attribute[:, i] for i in range(attribute.shape[1])]
    return interpolate_columns(columns, geometry.faces, pixels.face, pixels.barycentrics)


def _flat_normals(geometry: _Geometry, face: Array) -> Columns:
    normals = face_normals(geometry.positions, geometry.faces_outward)
    visible = jnp.maximum(face, 0)
    return [normals[:, i][visible] for i in range(3)]


# Edges --------------------------------------------------------------------------------------------


def _with_edges(
    image: Array,
    scene: Scene,
    camera: Camera,
    geometry: _Geometry,
    positions_clip: Array,
    pixels: _Pixels,
    background: Array,
    settings: RenderSettings,
) -> Array:
    topology = _scene_topology(scene, geometry)
    if settings.shading == "flat":  # every face has a colour of its own
        topology = topology._replace(patches=jnp.arange(geometry.faces.shape[0]))
    view = View(
        positions_clip=positions_clip,
        faces=geometry.faces,
        turned=geometry.faces_outward[:, 0] != geometry.faces[:, 0],
        topology=topology,
        apart=_apart(geometry, topology.edges, settings.shading),
        face_image=pixels.face,
        image=image,
        background=background,
        scene=(scene, camera, geometry),
    )
    return antialias_image(
        view,
        shader=_shade_points(settings.shading),
        cull_backfaces=settings.cull_backfaces,
    )


def _shade_points(shading: str) -> Shader:
    def shade(seen: tuple[Scene, Camera, _Geometry], face: Array, at: Columns) -> Columns:
        scene, camera, geometry = seen
        no_depth = jnp.zeros_like(at[0])
        return _SHADERS[shading](scene, camera, geometry, _Pixels(face, at, no_depth))

    return shade


def _scene_topology(scene: Scene, geometry: _Geometry) -> Topology:
    meshes = [item.mesh for item in scene.objects]
    own = [
        traced_topology(m.vertices, m.faces) if m.topology is None else m.topology for m in meshes
    ]
    first_faces = np.cumsum([0] + [m.faces.shape[0] for m in meshes])
    first_vertices = np.cumsum([0] + [m.vertices.shape[0] for m in meshes])

    def moved(faces: Array, by: int) -> Array:
        return jnp.where(faces >= 0, faces + by, -1)

    edges = [
        part.edges._replace(faces=moved(part.edges.faces, int(first)))
        for part, first in zip(own, first_faces, strict=False)
    ]
    bodies = [jnp.zeros_like(t.patches) if t.bodies is None else t.bodies for t in own]

    def numbered(parts: list[Array]) -> Array:
        return jnp.concatenate([p + int(v) for p, v in zip(parts, first_vertices, strict=False)])

    return Topology(
        Edges(*(jnp.concatenate(column) for column in zip(*edges, strict=True))),
        jnp.concatenate(
            [moved(t.neighbors, int(f)) for t, f in zip(own, first_faces, strict=False)]
        ),
        numbered([t.patches for t in own]),
        None if len(own) == 1 and own[0].bodies is None else numbered(bodies),
    )


def _apart(geometry: _Geometry, edges: Edges, shading: str) -> Array:
    """Edges between two faces whose colours may differ there though both are seen."""
    if shading == "flat":
        return jnp.ones_like(edges.seam)
    if geometry.normals is None:
        return jnp.zeros_like(edges.seam)
    differs = jnp.zeros_like(edges.seam)
    for k in range(2):
        corner = edges.corners // 3 if k == 0 else edges.corners % 3
        vertex = [geometry.faces[jnp.maximum(edges.faces[:, i], 0), corner[:, i]] for i in range(2)]
        one, other = (geometry.normals[v] for v in vertex)
        largest = jnp.max(jnp.abs(one), axis=1) + jnp.max(jnp.abs(other), axis=1)
        differs = differs | (jnp.max(jnp.abs(one - other), axis=1) > _SAME_NORMAL * largest)
    return edges.seam & differs


# Shading ------------------------------------------------------------------------------------------


def _shade_phong(
    scene: Scene, camera: Camera, geometry: _Geometry, pixels: _Pixels, flat: bool = False
) -> Columns:
    if flat:
        normal = _flat_normals(geometry, pixels.face)
    else:
        assert geometry.normals is not None
        normal = _at_pixels(geometry.normals, geometry, pixels)
    reflectance = _reflectance(scene, geometry.object_of_face, pixels.face)
    with_position, with_viewer = needs(scene.lights, reflectance.specular is not None)
    position = _at_pixels(geometry.positions, geometry, pixels) if with_position else None
    to_viewer = _to_viewer(camera, position) if with_viewer else None
    return phong(Surface(normal, position, to_viewer), reflectance, scene.lights)


def _shade_flat(scene: Scene, camera: Camera, geometry: _Geometry, pixels: _Pixels) -> Columns:
    return _shade_phong(scene, camera, geometry, pixels, flat=True)


def _shade_gouraud(scene: Scene, camera: Camera, geometry: _Geometry, pixels: _Pixels) -> Columns:
    assert geometry.normals is not None
    vertices = jnp.arange(geometry.positions.shape[0])
    reflectance = _reflectance(scene, geometry.object_of_vertex, vertices)
    position = [geometry.positions[:, i] for i in range(3)]
    normal = [geometry.normals[:, i] for i in range(3)]
    _, with_viewer = needs(scene.lights, reflectance.specular is not None)
    to_viewer = _to_viewer(camera, position) if with_viewer else None
    color = phong(Surface(normal, position, to_viewer), reflectance, scene.lights)
    return _at_pixels(jnp.stack(color, axis=-1), geometry, pixels)


def _shade_unlit(scene: Scene, camera: Camera, geometry: _Geometry, pixels: _Pixels) -> Columns:
    diffuse = _reflectance(scene, geometry.object_of_face, pixels.face).diffuse
    return [jnp.broadcast_to(channel, pixels.face.shape) for channel in diffuse]


_SHADERS: dict[str, Callable[..., Columns]] = {
    "phong": _shade_phong,
    "gouraud": _shade_gouraud,
    "flat": _shade_flat,
    "unlit": _shade_unlit,
}


def _box_average(channel: Array, side: int) -> Array:
    """Mean over side × side blocks, added in one fixed order."""
    height, width = channel.shape
    blocks = channel.reshape(height // side, side, width // side, side)
    return blocks.mean(axis=(1, 3))


def _to_viewer(camera: Camera, position: Columns | None) -> Columns:
    assert position is not None
    eye = viewpoint(camera)
    return normalize_columns([eye[i] - eye[3] * position[i] for i in range(3)])[0]


def _reflectance(scene: Scene, object_of: Array, index: Array) -> Reflectance:
    """Material at each point: numbers if there is one object, else looked up by object."""
    materials = [item.material for item in scene.objects]
    specular = [m.specular for m in materials if m.specular is not None]
    if len(materials) == 1:
        material = materials[0]
        return Reflectance(
            [material.ambient[c] for c in range(3)],
            [material.diffuse[c] for c in range(3)],
            None if material.specular is None else [material.specular[c] for c in range(3)],
            material.shininess if specular else None,
        )
    which = object_of[jnp.maximum(index, 0)]

    def looked_up(values: list[Array]) -> Columns:
        table = jnp.stack(values)
        return [table[:, c][which] for c in range(3)]

    none = jnp.zeros(3, scene.background.dtype)
    return Reflectance(
        looked_up([m.ambient for m in materials]),
        looked_up([m.diffuse for m in materials]),
        looked_up([none if m.specular is None else m.specular for m in materials])
        if specular
        else None,
        jnp.stack([m.shininess for m in materials])[which] if specular else None,
    )
