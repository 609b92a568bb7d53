"""A scene as one mesh in the world, and the points of it that are seen."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float, Int

from diffrast._stored import stored, stored_rows
from diffrast._topology import Edges, Topology, traced_topology
from diffrast._varying import varying_zero
from diffrast.camera import Camera, pivoted_matrix, world_to_clip
from diffrast.edges.planes import largest
from diffrast.interpolate import interpolate_columns
from diffrast.light import Columns
from diffrast.linalg import (
    apply_matrix,
    mirrors,
    norm,
    normal_matrix,
    transform_normals,
    transform_points,
    where_finite,
)
from diffrast.mesh import face_normals, vertex_normals
from diffrast.raster.coverage import visible_faces
from diffrast.raster.evaluate import (
    Carried,
    Drawn,
    Pixels,
    Placed,
    Placement,
    Projection,
    all_pixels,
    evaluate,
)
from diffrast.raster.fragments import with_border
from diffrast.scene import Object, Scene

FEW_OBJECTS = 16  # what their transforms move is summed over the picture, for each of them
_SAME_NORMAL = 1e-5  # of their size: normals on both sides of a seam that need no edge


class Geometry(NamedTuple):
    """All objects of a scene as one mesh in the world."""

    positions: Float[Array, "V 3"]
    faces: Int[Array, "F 3"]
    faces_outward: Int[Array, "F 3"]  # turned round where a transform mirrors
    normals: Float[Array, "V 3"] | None  # None for flat and unlit shading
    uvs: Float[Array, "T 2"] | None
    uv_faces: Int[Array, "F 3"]  # which of the uvs the corners have
    object_of_face: Int[Array, " F"]
    object_of_vertex: Int[Array, " V"]


class Points(NamedTuple):
    """Points on faces: the pixels of an image, or a row of them."""

    face: Int[Array, "*size"]
    barycentrics: Columns
    inverse_depth: Float[Array, "*size"]
    position: Columns | None = None  # world positions, if they are interpolated already
    normal: Columns | None = None  # likewise
    place: Columns | None = None  # of pixels: half pixels to the right of the centre, and above it


def world_geometry(scene: Scene, shading: str) -> Geometry:
    """All objects in the world, with what this shading needs of them."""
    with jax.named_scope("geometry"):
        positions, faces, faces_outward, normals, uvs, uv_faces = [], [], [], [], [], []
        smooth = shading in ("phong", "gouraud")
        textured = any(item.mesh.uvs is not None for item in scene.objects)
        own_uvs = any(item.mesh.uv_faces is not None for item in scene.objects)
        first_vertex = first_uv = 0
        for item in scene.objects:
            mesh = item.mesh
            positions.append(where_finite(partial(transform_points, item.transform), mesh.vertices))
            faces.append(mesh.faces + first_vertex)
            turned = jnp.where(mirrors(item.transform), faces[-1][:, ::-1], faces[-1])
            faces_outward.append(turned)
            first_vertex += mesh.vertices.shape[0]
            if smooth:
                turn = partial(transform_normals, item.transform)
                normals.append(where_finite(turn, _own_normals(item)))
            if textured:
                own = mesh.uvs
                none = jnp.zeros_like(mesh.vertices[:, :2])
                uvs.append(none if own is None else own)
            if own_uvs:
                corners = mesh.faces if mesh.uv_faces is None else mesh.uv_faces
                uv_faces.append(corners + first_uv)
                first_uv += uvs[-1].shape[0]
        all_faces = jnp.concatenate(faces)

        def joined(parts: list[Array]) -> Array:
            return stored_rows(jnp.concatenate(parts))

        counts = np.arange(len(scene.objects), dtype=np.int32)
        return Geometry(
            joined(positions),
            all_faces,
            jnp.concatenate(faces_outward),
            joined(normals) if smooth else None,
            joined(uvs) if textured else None,
            jnp.concatenate(uv_faces) if own_uvs else all_faces,
            jnp.asarray(np.repeat(counts, [o.mesh.faces.shape[0] for o in scene.objects])),
            jnp.asarray(np.repeat(counts, [o.mesh.vertices.shape[0] for o in scene.objects])),
        )


def _own_normals(item: Object) -> Array:
    mesh = item.mesh
    return vertex_normals(mesh.vertices, mesh.faces) if mesh.normals is None else mesh.normals


def _placed(scene: Scene, geometry: Geometry) -> Placed:
    """Where objects come from, for derivatives by their transforms."""
    placements, positions, normals, fixed = [], [], [], []
    for item in scene.objects:
        transform, vertices = item.transform, item.mesh.vertices
        positions.append(where_finite(lambda points: points, vertices))
        attributes = [_placed_by(transform_points, transform, vertices)]
        turn = None
        if geometry.normals is not None:
            turn, own = normal_matrix(transform), _own_normals(item)
            normals.append(where_finite(partial(_shortened, turn), own))
            attributes.append(_placed_by(transform_normals, transform, own))
        placements.append(Placement(transform[:3], turn))
        fixed.append(attributes)
    return Placed(
        tuple(placements),
        geometry.object_of_face,
        stored_rows(jnp.concatenate(positions)),
        stored_rows(jnp.concatenate(normals)) if normals else None,
        tuple(stored_rows(jnp.concatenate(parts)) for parts in zip(*fixed, strict=True)),
    )


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _placed_by(function: Callable[..., Array], transform: Array, vectors: Array) -> Array:
    """What a transform makes of vectors, with their derivative and without its own."""
    return where_finite(partial(function, transform), vectors)


@partial(_placed_by.defjvp, symbolic_zeros=True)
def _placed_derivative(
    function: Callable[..., Array], primals: Any, tangents: Any
) -> tuple[Array, Any]:
    transform, vectors = primals
    placed = _placed_by(function, transform, vectors)  # whose derivative, again, is this one
    if isinstance(tangents[1], SymbolicZero):
        return placed, SymbolicZero.from_primal_value(placed)
    own = partial(where_finite, partial(function, transform))
    return placed, jax.jvp(own, (vectors,), (tangents[1],))[1]


def _shortened(matrix: Array, normals: Array) -> Array:
    """Normals of which a matrix makes unit vectors."""
    length = norm(apply_matrix(matrix, normals))[..., None]
    return jnp.where(length > 0, normals / jnp.where(length > 0, length, 1), 0)


def clip_positions(geometry: Geometry, camera: Camera) -> Float[Array, "V 4"]:
    """All vertices as the camera sees them."""
    with jax.named_scope("project"):
        return stored_rows(world_to_clip(camera, geometry.positions))


def draw(
    scene: Scene,
    geometry: Geometry,
    camera: Camera,
    positions_clip: Array,
    height: int,
    width: int,
    *,
    cull_backfaces: bool,
    border: int = 0,
) -> tuple[Drawn, Int[Array, "_ _"]]:
    """What is drawn in an image with so many pixels round it, and the face that each pixel sees."""
    seen_clip = with_border(positions_clip, height, width, border)
    with jax.named_scope("rasterize"):
        face = visible_faces(
            jax.lax.stop_gradient(seen_clip),
            geometry.faces_outward if cull_backfaces else geometry.faces,
            height=height + 2 * border,
            width=width + 2 * border,
            cull_backfaces=cull_backfaces,
        )
    attributes = [geometry.positions]
    if geometry.normals is not None:
        attributes.append(geometry.normals)
    projection = placed = None
    if camera.distortion is None:
        matrix, pivot = pivoted_matrix(camera)
        seen_matrix = with_border(matrix.T, height, width, border).T
        projection = Projection(seen_matrix[np.array([0, 1, 3])], pivot)
        if len(scene.objects) <= FEW_OBJECTS:
            placed = _placed(scene, geometry)
    return Drawn(seen_clip, geometry.faces, tuple(attributes), projection, placed), face


def points_at(drawn: Drawn, pixels: Pixels, carried: Carried | None = None) -> Points:
    """What pixels see of what is drawn; `carried` as for `evaluate`."""
    with jax.named_scope("fragments"):
        seen = evaluate(drawn, pixels, carried)
        points = Points(pixels.face, seen.barycentrics, seen.inverse_depth, *seen.attributes)
        return points._replace(place=[pixels.x, pixels.y])


def visible_points(drawn: Drawn, face: Array) -> Points:
    """What all pixels of an image see."""
    return points_at(drawn, all_pixels(face, drawn.positions_clip.dtype))


def at_points(attribute: Array, geometry: Geometry, points: Points) -> Columns:
    """Values at the vertices, (V, C), interpolated at points."""
    columns = [attribute[:, i] for i in range(attribute.shape[1])]
    # Not before the barycentrics are found: what these are made of need not be kept meanwhile.
    face = stored(points.face, points.barycentrics[0])
    return interpolate_columns(columns, geometry.faces, face, points.barycentrics)


def positions_at(geometry: Geometry, points: Points) -> Columns:
    """World positions of points."""
    if points.position is not None:
        return points.position
    return at_points(geometry.positions, geometry, points)


def normals_at(geometry: Geometry, points: Points) -> Columns:
    """World normals at points, of any length: those of the vertices, if there are any."""
    if geometry.normals is None:
        return flat_normals(geometry, points.face)
    if points.normal is not None:
        return points.normal
    return at_points(geometry.normals, geometry, points)


def uvs_at(geometry: Geometry, points: Points) -> Columns:
    """Texture coordinates at points."""
    assert geometry.uvs is not None
    columns = [geometry.uvs[:, i] for i in range(2)]
    return interpolate_columns(columns, geometry.uv_faces, points.face, points.barycentrics)


def flat_normals(geometry: Geometry, face: Array) -> Columns:
    """Unit normals of faces."""
    normals = face_normals(geometry.positions, geometry.faces_outward)
    visible = jnp.maximum(face, 0)
    return [normals[:, i][visible] for i in range(3)]


def scene_topology(scene: Scene) -> Topology:
    """Which faces of the scene meet where; objects have no edges in common."""
    meshes = [item.mesh for item in scene.objects]
    own = [
        traced_topology(m.vertices, m.faces) if m.topology is None else m.topology for m in meshes
    ]
    first_faces = np.cumsum([0] + [m.faces.shape[0] for m in meshes])
    first_vertices = np.cumsum([0] + [m.vertices.shape[0] for m in meshes])

    def moved(faces: Array, by: int) -> Array:
        return jnp.where(faces >= 0, faces + by, -1) if by else faces

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


def apart_edges(geometry: Geometry, edges: Edges, shading: str) -> Array:
    """Edges between two faces whose colours may differ there though both are seen."""
    if shading == "flat":
        return jnp.ones_like(edges.seam)
    if geometry.normals is None:
        return jnp.zeros_like(edges.seam)
    seams = edges, jax.lax.stop_gradient(geometry.normals), geometry.faces
    return jax.lax.cond(jnp.any(edges.seam), _bent_seams, _no_seams, *seams)


def _no_seams(edges: Edges, normals: Array, faces: Array) -> Array:
    return jnp.zeros_like(edges.seam) | (varying_zero((edges, normals, faces)) != 0)


def _bent_seams(edges: Edges, normals: Array, faces: Array) -> Array:
    """Those seams on whose sides the normals at the same place differ."""
    corner = jnp.stack([edges.corners // 3, edges.corners % 3])  # (2 ends, E, 2 faces)
    vertex = faces[jnp.maximum(edges.faces, 0), corner]
    one, other = jnp.moveaxis(normals.T[:, vertex], -1, 0)  # (3, 2 ends, E) each
    apart = largest(one - other) > _SAME_NORMAL * (largest(one) + largest(other))
    return edges.seam & jnp.any(apart, axis=0)
