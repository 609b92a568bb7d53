"""The textures of a scene at the points that are seen.

Textures that are mapped and filtered in one way make a group, whose texels lie in one array: what a
group costs at a point does not depend on how many textures it holds. Which groups there are is
known from the scene's structure, so a scene has no operation of a kind of texture that it lacks,
and what does not change from point to point (pyramids, coordinates at the vertices, slopes of
faces) is made once, by `paint_scene`.
"""

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from diffrast._stored import stored
from diffrast._topology import Edges
from diffrast.camera import Camera, pixel_directions
from diffrast.geometry import Geometry, Points
from diffrast.interpolate import face_slopes, interpolate_columns, slopes_at
from diffrast.light import Columns
from diffrast.mesh import vertex_normals
from diffrast.scene import Object, Scene
from diffrast.texture import AnyTexture, CubeTexture, Texture
from diffrast.texture.kinds import texels
from diffrast.texture.mapping import attribute_count, coordinates, vertex_attributes
from diffrast.texture.pyramid import layout_of, rows_of
from diffrast.texture.sampling import Slopes, sample, sample_texture


class _Group(NamedTuple):
    """Textures that are mapped and filtered in one way; static but for their texels."""

    textures: list[AnyTexture]  # one of each image
    owners: list[int]  # the first object with each image, see `Scene.shared`
    image_of_object: list[int]  # which of them each object shows, -1 for none


class Paint(NamedTuple):
    """A group of textures, ready to be looked up."""

    rows: Float[Array, "texels 3"]
    attributes: Float[Array, "A C"]  # what is interpolated
    corners: Int[Array, "F 3"]  # which of them the corners of faces have
    slopes: Float[Array, "F columns"] | None  # see `face_slopes`


Paints: TypeAlias = tuple[Paint, ...]


def paint_scene(
    scene: Scene, geometry: Geometry, positions_clip: Array, height: int, width: int
) -> Paints:
    """Everything about textures that points have in common; empty without textures.

    Args:
        scene: with its materials.
        geometry: of the scene.
        positions_clip: (V, 4) of the image without its border.
        height: rows of that image, samples apart.
        width: its columns.
    """
    paints = []
    with jax.named_scope("textures"):
        for textures, _, image_of_object in _groups(scene):
            attributes, corners = _attributes(scene, geometry, textures[0], image_of_object)
            slopes = None
            if textures[0].filter == "trilinear":
                slopes = stored(
                    face_slopes(attributes, corners, positions_clip, geometry.faces, height, width)
                )
            paints.append(Paint(stored(rows_of(textures)), attributes, corners, slopes))
    return tuple(paints)


def texel_colors(
    scene: Scene, paints: Paints, geometry: Geometry, points: Points
) -> Columns | None:
    """What multiplies the diffuse and ambient reflectance at points; None without textures."""
    colors: Columns | None = None
    with jax.named_scope("textures"):
        for group, paint in zip(_groups(scene), paints, strict=True):
            color = _group_colors(group, paint, geometry, points)
            if min(group.image_of_object) < 0:
                object_of = geometry.object_of_face[jnp.maximum(points.face, 0)]
                shown = jnp.asarray(np.array(group.image_of_object) >= 0)[object_of]
                other = [jnp.ones_like(part) for part in color] if colors is None else colors
                color = [jnp.where(shown, a, b) for a, b in zip(color, other, strict=True)]
            colors = color
    return colors


def seams(scene: Scene, paints: Paints, edges: Edges) -> Bool[Array, " edges"]:
    """Edges whose two faces show different places of a texture there."""
    found = jnp.zeros_like(edges.seam)
    for (textures, *_), paint in zip(_groups(scene), paints, strict=True):
        kind = textures[0]
        repeats = isinstance(kind, Texture) and [wrap == "repeat" for wrap in kind.wrap]
        for k in range(2):
            corner = edges.corners // 3 if k == 0 else edges.corners % 3
            one, other = (
                paint.attributes[paint.corners[jnp.maximum(edges.faces[:, i], 0), corner[:, i]]]
                for i in range(2)
            )
            apart = one - other
            if repeats and apart.shape[1] == 2:
                apart = jnp.where(jnp.array(repeats), apart - jnp.round(apart), apart)
            found = found | jnp.any(apart != 0, axis=1)
    return found & (edges.faces[:, 1] >= 0)


def skybox(
    texture: CubeTexture, camera: Camera, height: int, width: int, border: int = 0
) -> Float[Array, "_ _ 3"]:
    """What each pixel sees of a cube texture that is infinitely far away.

    Differentiable in the texels and the camera, its distortion included.
    """
    with jax.named_scope("skybox"):
        rays, steps = pixel_directions(camera, height=height, width=width, border=border)
        derivatives = jnp.broadcast_to(jnp.swapaxes(steps, -1, -2), (*rays.shape, 2))
        return stored(sample_texture(texture, rays, derivatives=derivatives))


def _groups(scene: Scene) -> list[_Group]:
    groups: dict[tuple[object, ...], _Group] = {}
    for number, item in enumerate(scene.objects):
        texture = item.material.texture
        if texture is None:
            continue
        nothing = _Group([], [], [-1] * len(scene.objects))
        group = groups.setdefault(_way(texture), nothing)
        owner = scene.shared[number]
        if owner not in group.owners:
            group.owners.append(owner)
            group.textures.append(texture)
        group.image_of_object[number] = group.owners.index(owner)
    return list(groups.values())


def _way(texture: AnyTexture) -> tuple[object, ...]:
    """Everything static about a texture but its size."""
    mapping = texture.mapping
    way: tuple[object, ...] = (type(texture), type(mapping), texture.filter)
    if isinstance(texture, Texture):
        way = (*way, texture.wrap, texture.anisotropy, getattr(mapping, "kind", None))
    return (*way, attribute_count(mapping), texels(texture).dtype)


def _attributes(
    scene: Scene, geometry: Geometry, kind: AnyTexture, image_of_object: list[int]
) -> tuple[Array, Array]:
    """What a group interpolates, and which of it each corner has; zeros for other objects."""
    if kind.mapping is None:
        assert geometry.uvs is not None
        return geometry.uvs, geometry.uv_faces

    def own(item: Object, image: int) -> Array:
        mesh, texture = item.mesh, item.material.texture
        if image < 0 or texture is None or texture.mapping is None:
            return jnp.zeros_like(mesh.vertices, shape=(mesh.vertices.shape[0], count))
        normals = mesh.normals
        if normals is None and isinstance(kind, CubeTexture):
            normals = vertex_normals(mesh.vertices, mesh.faces)
        return vertex_attributes(texture.mapping, mesh.vertices, normals)

    count = attribute_count(kind.mapping)
    parts = [own(*pair) for pair in zip(scene.objects, image_of_object, strict=True)]
    return stored(jnp.concatenate(parts)), geometry.faces


def _group_colors(group: _Group, paint: Paint, geometry: Geometry, points: Points) -> Columns:
    """Colours of a group's textures at points; of its first one at points of other objects."""
    kind, which = group.textures[0], None
    if len(group.textures) > 1:
        table = jnp.asarray(np.maximum(group.image_of_object, 0).astype(np.int32))
        which = stored(table[geometry.object_of_face[jnp.maximum(points.face, 0)]])
    columns = [paint.attributes[:, i] for i in range(paint.attributes.shape[1])]
    found = interpolate_columns(columns, paint.corners, points.face, points.barycentrics)
    found = stored(found)  # else all corners' are kept until the slopes are there
    at: Columns = stored(coordinates(kind.mapping, found))
    slopes = None
    if paint.slopes is not None:
        by_pixel = slopes_at(paint.slopes, points.face, points.barycentrics, found)
        slopes = _slopes(kind, found, by_pixel)
    layout = layout_of(group.textures)
    color = stored(sample(kind, layout, paint.rows, which, at, slopes))
    return [color[..., c] for c in range(3)]


def _slopes(kind: AnyTexture, attributes: Columns, slopes: Slopes) -> Slopes:
    """Derivatives of texture coordinates from those of what is interpolated."""

    def at(attributes: Columns) -> Columns:
        return coordinates(kind.mapping, attributes)

    by_axis = [jax.jvp(at, (attributes,), ([pair[k] for pair in slopes],))[1] for k in range(2)]
    return [[x, y] for x, y in zip(*by_axis, strict=True)]
