"""A scene as one mesh in the world, and the points of it that are seen."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float, Int

from diffrast._stored import stored, stored_rows
from diffrast._topology import Edges, Topology, bent_seams, traced_topology
from diffrast._varying import varying_zero
from diffrast.camera import Camera, pivoted_matrix, world_to_clip
from diffrast.interpolate import interpolate_columns
from diffrast.light import Columns
from diffrast.linalg import (
    _normal_turn,
    apply_matrix,
    mirrors,
    norm,
    normalize,
    where_finite,
)
from diffrast.mesh import Mesh, face_normals, vertex_normals
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
from diffrast.scene import Scene

FEW_OBJECTS = 32  # what their transforms move is summed over the picture, for each of them


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
        meshes = [item.mesh for item in scene.objects]
        vertices = [mesh.vertices for mesh in meshes]
        transforms = jnp.stack([item.transform for item in scene.objects])
        object_of_face = _owner([mesh.faces for mesh in meshes])
        faces = _numbered([mesh.faces for mesh in meshes], vertices)
        mirrored = jax.vmap(mirrors)(transforms)
        turned_round = mirrored[object_of_face][:, None] if len(meshes) > 1 else mirrored
        normals = uvs = uv_faces = None
        if shading in ("phong", "gouraud"):
            own = [_own_normals(mesh) for mesh in meshes]
            normals = stored_rows(_in_world(_turned, _turns(transforms), own))
        if any(mesh.uvs is not None for mesh in meshes):
            own = [jnp.zeros_like(m.vertices[:, :2]) if m.uvs is None else m.uvs for m in meshes]
            uvs = stored_rows(jnp.concatenate(own))
            if any(mesh.uv_faces is not None for mesh in meshes):
                corners = [m.faces if m.uv_faces is None else m.uv_faces for m in meshes]
                uv_faces = _numbered(corners, own)
        return Geometry(
            stored_rows(_in_world(_moved, transforms[:, :3], vertices)),
            faces,
            jnp.where(turned_round, faces[:, ::-1], faces),
            normals,
            uvs,
            faces if uv_faces is None else uv_faces,
            jnp.asarray(object_of_face),
            jnp.asarray(_owner(vertices)),
        )


def _owner(parts: Sequence[Any]) -> np.ndarray:
    """Which object each row of the joined parts is of."""
    counts = [part.shape[0] for part in parts]
    return np.repeat(np.arange(len(counts), dtype=np.int32), counts)


def _numbered(parts: Sequence[Array], counted: Sequence[Any]) -> Int[Array, "rows *size"]:
    """Indices into an array of each object, joined, as indices into these arrays, joined as well.

    Negative ones are none and stay so.
    """
    joined = jnp.concatenate(parts)
    if len(parts) == 1:
        return joined
    first = np.cumsum([0] + [rows.shape[0] for rows in counted], dtype=np.int32)[_owner(parts)]
    return joined + jnp.where(joined < 0, 0, first.reshape(-1, *[1] * (joined.ndim - 1)))


def _in_world(
    function: Callable[..., Array], matrices: Float[Array, "objects rows columns"], parts: list
) -> Float[Array, "V 3"]:
    """`function(matrix, vectors)` for the vectors of each object, joined; see `where_finite`.

    Of several objects each vector has a matrix of its own: the program does not grow with them.
    """
    if len(parts) == 1:
        return where_finite(partial(function, matrices[0]), parts[0])
    of_each = partial(jax.vmap(function), matrices[_owner(parts)])
    return where_finite(of_each, jnp.concatenate(parts))


def _moved(matrix: Array, points: Array) -> Array:
    """Points where the rows of an affine matrix put them."""
    return apply_matrix(matrix[:, :3], points) + matrix[:, 3]


_turns = jax.vmap(_normal_turn)


def _turned(matrix: Array, normals: Array) -> Array:
    """Unit normals, turned by the matrix that turns normals."""
    return normalize(apply_matrix(matrix, normals))


def _known(values: Array) -> Array:
    """Zeros in place of what is not finite: nothing shows it, but background looks at face 0."""
    return jnp.where(jnp.isfinite(values), values, 0)


def _own_normals(mesh: Mesh) -> Array:
    return vertex_normals(mesh.vertices, mesh.faces) if mesh.normals is None else mesh.normals


def _placed(scene: Scene, geometry: Geometry) -> Placed:
    """Where objects come from, for derivatives by their transforms."""
    transforms = [item.transform for item in scene.objects]
    vertices, matrices = [item.mesh.vertices for item in scene.objects], jnp.stack(transforms)
    turns: list[Array | None] = [None] * len(transforms)
    attributes, normals = [_placed_by(_moved, matrices[:, :3], vertices)], None
    if geometry.normals is not None:
        turns = [_normal_turn(transform) for transform in transforms]
        own, matrices = [_own_normals(item.mesh) for item in scene.objects], _turns(matrices)
        attributes.append(_placed_by(_turned, matrices, own))
        normals = stored_rows(_known(_in_world(_shortened, matrices, own)))
    return Placed(
        tuple(Placement(m[:3], turn) for m, turn in zip(transforms, turns, strict=True)),
        geometry.object_of_face,
        stored_rows(_known(jnp.concatenate(vertices))),
        normals,
        tuple(map(stored_rows, attributes)),
    )


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _placed_by(function: Callable[..., Array], matrices: Array, parts: list[Array]) -> Array:
    """`_in_world` with the derivative by the vectors and without that by the matrices."""
    return _in_world(function, matrices, parts)


@partial(_placed_by.defjvp, symbolic_zeros=True)
def _placed_derivative(
    function: Callable[..., Array], primals: Any, tangents: Any
) -> tuple[Array, Any]:
    matrices, parts = primals
    placed = _placed_by(function, *primals)  # whose derivative, again, is this one
    changes = {k: t for k, t in enumerate(tangents[1]) if not isinstance(t, SymbolicZero)}
    if not changes:
        return placed, SymbolicZero.from_primal_value(placed)

    def of_moving(*own: Array) -> Array:
        moving = dict(zip(changes, own, strict=True))
        return _in_world(function, matrices, [moving.get(k, part) for k, part in enumerate(parts)])

    moving = tuple(parts[k] for k in changes)
    return placed, jax.jvp(of_moving, moving, tuple(changes.values()))[1]


def _shortened(matrix: Array, normals: Array) -> Array:
    """Normals of which a matrix makes unit vectors."""
    length = norm(apply_matrix(matrix, normals))
    known = length > 0
    safe = jnp.where(known, length, 1)
    # Each for itself: what transposes a broadcast length takes ten times as long on a CPU.
    return jnp.stack([jnp.where(known, normals[..., i] / safe, 0) for i in range(3)], axis=-1)


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
    attributes = [_known(geometry.positions)]
    if geometry.normals is not None:
        attributes.append(_known(geometry.normals))
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
    known = _known(attribute)
    columns = [known[:, i] for i in range(known.shape[1])]
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
    normals = face_normals(_known(geometry.positions), geometry.faces_outward)
    visible = jnp.maximum(face, 0)
    return [normals[:, i][visible] for i in range(3)]


def scene_topology(scene: Scene) -> Topology:
    """Which faces of the scene meet where; objects have no edges in common."""
    meshes = [item.mesh for item in scene.objects]
    own = [
        traced_topology(m.vertices, m.faces) if m.topology is None else m.topology for m in meshes
    ]
    faces, vertices = [m.faces for m in meshes], [m.vertices for m in meshes]
    edges = Edges(
        *(jnp.concatenate(column) for column in zip(*(t.edges for t in own), strict=True))
    )
    bodies = [jnp.zeros_like(t.patches) if t.bodies is None else t.bodies for t in own]
    return Topology(
        edges._replace(faces=_numbered([t.edges.faces for t in own], faces)),
        _numbered([t.neighbors for t in own], faces),
        _numbered([t.patches for t in own], vertices),
        None if len(own) == 1 and own[0].bodies is None else _numbered(bodies, vertices),
    )


def apart_edges(geometry: Geometry, edges: Edges, shading: str) -> Array:
    """Edges between two faces whose colours may differ there though both are seen."""
    if shading == "flat":
        return jnp.ones_like(edges.seam)
    if geometry.normals is None:
        return jnp.zeros_like(edges.seam)
    seams = edges, jax.lax.stop_gradient(geometry.normals), geometry.faces
    bent = partial(bent_seams, xp=jnp)
    return jax.lax.cond(jnp.any(edges.seam), bent, _no_seams, *seams)


def _no_seams(edges: Edges, normals: Array, faces: Array) -> Array:
    return jnp.zeros_like(edges.seam) | (varying_zero((edges, normals, faces)) != 0)
