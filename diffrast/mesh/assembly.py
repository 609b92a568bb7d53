"""Meshes made of polygons and of other meshes."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from diffrast import _check, _polygons, _topology
from diffrast._check import ArrayInput
from diffrast._topology import Topology
from diffrast.linalg import mirrors, normalize, transform_normals, transform_points
from diffrast.mesh.triangles import Mesh, host_arrays, uv_faces_of


def from_polygons(
    vertices: ArrayInput,
    polygons: Sequence[ArrayInput] | np.ndarray,
    surfaces: ArrayInput | None = None,
    *,
    weighting: str = "uniform",
) -> Mesh:
    """Triangle mesh of polygons with any number of corners, smooth within each surface.

    Vertices are split where surfaces meet, and their normals are averaged within a surface only
    (FEATURES G7; Kos 7.1). A corner at the place of the next one is skipped, and so is a polygon
    that is left with fewer than three corners or without area. Convex polygons become fans,
    concave ones are cut ear by ear. Made on the host: differentiate with respect to the vertices
    of the result.

    Args:
        vertices: shape (vertices, 3).
        polygons: the vertex ids of each polygon, counter-clockwise from outside.
        surfaces: an integer for every polygon, its surface (smoothing group); `None` makes all
            polygons one surface.
        weighting: what a polygon counts for in the average: "uniform", as in the source, or
            "area".

    Raises:
        ValueError: for indices out of range, and when no polygon has an area.
    """
    positions_device = _check.float_array("vertices", vertices, ("vertices", 3))
    if not _check.is_concrete(positions_device):
        raise ValueError("vertices: wanted known numbers, got a traced array")
    _check.one_of("weighting", weighting, ("uniform", "area"))
    positions = np.asarray(positions_device, dtype=np.float64)
    corners, sizes = _polygons.join_indices(polygons, len(positions))
    try:
        group = np.zeros(len(sizes), dtype=int) if surfaces is None else np.asarray(surfaces)
    except ValueError as error:
        raise ValueError(f"surfaces: wanted an integer for each polygon ({error})") from error
    if group.shape != sizes.shape or not np.issubdtype(group.dtype, np.integer):
        raise ValueError(
            f"surfaces: wanted an integer for each of {len(sizes)} polygons, got shape"
            f" {group.shape}, dtype {group.dtype}"
        )
    group = group.astype(np.int64)  # next to which others would become floats
    joined = _polygons.join_polygons(positions, corners, sizes)
    triangles = _polygons.triangulate(positions, joined)
    # One vertex for every vertex id and surface that occur together.
    pairs, owner = np.unique(
        np.stack([joined.corner, group[joined.polygon]], axis=1), axis=0, return_inverse=True
    )
    weights = joined.area if weighting == "area" else np.ones_like(joined.area)
    share = np.repeat(joined.normal * (weights / weights.max())[:, None], joined.size, axis=0)
    normals = np.zeros((len(pairs), 3))
    np.add.at(normals, owner, share)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    with _check.staying_known(positions_device):
        return Mesh(
            vertices=positions_device[pairs[:, 0]],
            faces=jnp.asarray(owner[triangles]),
            normals=jnp.asarray(normals / np.where(length > 0, length, 1), positions_device.dtype),
        )


@_check.known_of_known
def merge(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of all the faces, in order. Differentiable in all of them.

    Raises:
        ValueError: for an empty list, or where some meshes have normals (or uvs) and some not.
    """
    _check_alike(meshes)
    offsets = np.cumsum([0, *(mesh.vertices.shape[0] for mesh in meshes)])
    uv_faces = None
    if any(mesh.uv_faces is not None for mesh in meshes):
        counts = [0 if mesh.uvs is None else mesh.uvs.shape[0] for mesh in meshes]
        uv_faces = jnp.concatenate(
            [uv_faces_of(m) + int(n) for m, n in zip(meshes, np.cumsum([0, *counts]), strict=False)]
        )
    faces = [mesh.faces + int(offset) for mesh, offset in zip(meshes, offsets, strict=False)]
    return Mesh(
        vertices=jnp.concatenate([mesh.vertices for mesh in meshes]),
        faces=jnp.concatenate(faces),
        normals=_joined([mesh.normals for mesh in meshes]),
        uvs=_joined([mesh.uvs for mesh in meshes]),
        uv_faces=uv_faces,
    )


def stack_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh with a leading axis, of meshes of any sizes: for `jax.vmap` and `dr.views`.

    All get as many vertices and faces as the largest has. What is added is never seen: faces whose
    corners are one vertex, which belong to no edge.

    Args:
        meshes: whose arrays are known, not traced. Texture coordinates and normals on all or none.

    Returns:
        A mesh whose arrays all have a leading axis, as `jax.vmap` takes and gives it. Not
        differentiable here: change the positions of the result.

    Raises:
        ValueError: for an empty list, where some meshes have normals (or uvs) and some not, and
            for traced arrays.
    """
    _check_alike(meshes)
    for mesh in meshes:
        host_arrays(mesh.vertices, mesh.faces)
    own_uvs = any(mesh.uv_faces is not None for mesh in meshes)
    alike = [replace(mesh, uv_faces=uv_faces_of(mesh) if own_uvs else None) for mesh in meshes]
    topologies = [mesh.topology for mesh in alike if mesh.topology is not None]  # all of them
    if any(topology.bodies is not None for topology in topologies):
        alike = [
            replace(mesh, topology=_with_bodies(topology))
            for mesh, topology in zip(alike, topologies, strict=True)
        ]

    def stacked(path: tuple[jax.tree_util.GetAttrKey, ...], *arrays: Array) -> Array:
        names = [key.name for key in path]
        no_face = names in (["topology", "edges", "faces"], ["topology", "neighbors"])
        size = max(array.shape[0] for array in arrays)
        rows = []
        for array in arrays:
            last = array[-1:] if jnp.issubdtype(array.dtype, jnp.floating) else -int(no_face)
            more = jnp.broadcast_to(last, (size - array.shape[0], *array.shape[1:]))
            rows.append(jnp.concatenate([array, more.astype(array.dtype)]))
        return jnp.stack(rows)

    return jax.tree_util.tree_map_with_path(stacked, *alike)


@_check.known_of_known
def transform(mesh: Mesh, matrix: ArrayInput) -> Mesh:
    """Apply a 4×4 affine matrix, differentiable in mesh and matrix.

    Normals follow by the inverse transpose. A mirroring matrix (negative determinant) turns the
    faces round, so that they stay counter-clockwise from outside.
    """
    _check.instance_of("mesh", mesh, Mesh)
    matrix = _check.float_array("matrix", matrix, (4, 4))

    def turned(faces: Array) -> Array:
        return jnp.where(mirrors(matrix), faces[:, ::-1], faces)

    return Mesh(
        vertices=transform_points(matrix, mesh.vertices),
        faces=turned(mesh.faces),
        normals=None if mesh.normals is None else transform_normals(matrix, mesh.normals),
        uvs=mesh.uvs,
        uv_faces=None if mesh.uv_faces is None else turned(mesh.uv_faces),
    )


def split_uvs(mesh: Mesh) -> Mesh:
    """The same mesh with one uv a vertex: vertices with several are split; on the host.

    What a file format or a program with one index array wants. Differentiate with respect to the
    vertices of the result.
    """
    _check.instance_of("mesh", mesh, Mesh)
    if mesh.uvs is None or mesh.uv_faces is None:
        return mesh
    _, faces = host_arrays(mesh.vertices, mesh.faces)
    _, uv_faces = host_arrays(mesh.uvs, mesh.uv_faces)
    pairs, index = np.unique(
        np.stack([faces, uv_faces], axis=-1).reshape(-1, 2), axis=0, return_inverse=True
    )
    vertex, uv = pairs.T
    with _check.staying_known(mesh):
        return Mesh(
            vertices=mesh.vertices[vertex],
            faces=jnp.asarray(index.reshape(-1, 3)),
            normals=None if mesh.normals is None else mesh.normals[vertex],
            uvs=mesh.uvs[uv],
        )


def merge_near_vertices(mesh: Mesh, tolerance: ArrayLike) -> Mesh:
    """Make one vertex of those linked by steps of at most `tolerance`; on the host.

    The vertex with the lowest id stands for its group, with the average of the group's normals
    and its own uv. Faces that lose a corner are dropped, and so are vertices without faces; the
    rest is numbered in the order in which faces name them (FEATURES G5; Kos 12.4).

    Args:
        mesh: positions must be known, not traced.
        tolerance: distance in the unit of the vertices; 0 merges equal positions only.

    Raises:
        ValueError: for a traced mesh, and a tolerance below 0 or one that leaves no face.
    """
    _check.instance_of("mesh", mesh, Mesh)
    distance = _check.distance("tolerance", tolerance)
    vertices, faces = host_arrays(mesh.vertices, mesh.faces)
    leader = _topology.clusters(vertices.astype(np.float64), distance)
    corners = leader[faces]
    proper = np.all(corners != np.roll(corners, 1, axis=1), axis=1)
    corners = corners[proper]
    if len(corners) == 0:
        raise ValueError(f"tolerance: wanted one that leaves a face, got {distance}")
    used, first_use, index = np.unique(corners, return_index=True, return_inverse=True)
    order = np.argsort(first_use)
    kept = used[order]
    with _check.staying_known(mesh):
        normals = None
        if mesh.normals is not None:
            normals = normalize(jnp.zeros_like(mesh.normals).at[leader].add(mesh.normals))[kept]
        uvs, uv_faces = mesh.uvs, mesh.uv_faces
        if uvs is not None and uv_faces is None:
            uvs = uvs[kept]
        return Mesh(
            vertices=mesh.vertices[kept],
            faces=jnp.asarray(np.argsort(order)[index].reshape(-1, 3)),
            normals=normals,
            uvs=uvs,
            uv_faces=None if uv_faces is None else uv_faces[proper],
        )


def _with_bodies(topology: Topology) -> Topology:
    """The same with a number for the body of each face, even if all are of one."""
    if topology.bodies is not None:
        return topology
    return topology._replace(bodies=jnp.zeros_like(topology.patches))


def _check_alike(meshes: Sequence[Mesh]) -> None:
    _check.all_instances("meshes", meshes, Mesh)
    if len(meshes) == 0:
        raise ValueError("meshes: wanted at least one mesh, got none")
    for name in ("normals", "uvs"):
        missing = [k for k, mesh in enumerate(meshes) if getattr(mesh, name) is None]
        if 0 < len(missing) < len(meshes):
            raise ValueError(
                f"meshes: wanted {name} on all or none of {len(meshes)}, got none on number"
                f" {missing[0]}"
            )


def _joined(parts: Sequence[Array | None]) -> Array | None:
    arrays = [part for part in parts if part is not None]
    return jnp.concatenate(arrays) if arrays else None
