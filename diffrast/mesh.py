"""Triangle meshes: normals, smoothing groups, edge adjacency, merging, transforms.

A `Mesh` is arrays only. What varies continuously (normals, areas, volume) is JAX code,
differentiable in the positions and indifferent to their scale: a model measured in 1e-20 units or
in 1e20 has the same normals. What is discrete (welding, edges, triangulation) is made on the host
by `diffrast._topology`.

Normals. The area vector of a face is half the cross product of two edges; each corner adds it to
its vertex, and the sum is normalised. To keep float32 from under- or overflowing, the cross
product is taken of edges divided by the face's size s, and enters the sum with the factor
(s / S)², where S is the largest s at that vertex: the factors common to a vertex cancel.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from diffrast import _check, _topology
from diffrast._check import ArrayInput
from diffrast._pytree import pytree_dataclass, set_field
from diffrast._topology import EdgeAdjacency as EdgeAdjacency
from diffrast._topology import Topology as Topology
from diffrast.linalg import dot, mirrors, norm, normalize, transform_normals, transform_points

WEIGHTINGS = ("area", "angle", "uniform")


@pytree_dataclass
class Mesh:
    """Triangles over shared vertices. Traced and differentiable in all but `faces`.

    Vertices may be shared between faces, or each face may have its own (a corner-split mesh, the
    usual way to store flat-shaded solids): edges are found between positions, not indices.

    Attributes:
        vertices: positions, any unit of length.
        faces: three vertex ids each, counter-clockwise seen from outside.
        normals: unit vectors pointing out, or `None`; `with_normals` makes smooth ones, and
            `flat_shaded` those of the faces.
        uvs: texture coordinates, v upwards, or `None`; one for each vertex, or any number of them
            with `uv_faces`.
        uv_faces: which of the uvs each corner of a face has (FEATURES X2), so that a vertex may
            have several; `None` where it is the vertex's own.
        topology: which faces meet where, found from the vertices and faces where they are known,
            and kept by `dataclasses.replace(mesh, vertices=...)`; for other faces pass
            `topology=None`. A mesh that is made of traced vertices has none: rendering it finds
            it anew in every call.

    Raises:
        ValueError: for arrays of other shapes, numbers that are not finite, indices out of
            range, and a mesh without vertices or faces.
    """

    vertices: Float[Array, "vertices 3"]
    faces: Int[Array, "faces 3"]
    normals: Float[Array, "vertices 3"] | None
    uvs: Float[Array, "coordinates 2"] | None
    uv_faces: Int[Array, "faces 3"] | None
    topology: Topology | None

    def __init__(
        self,
        *,
        vertices: ArrayInput,
        faces: ArrayInput,
        normals: ArrayInput | None = None,
        uvs: ArrayInput | None = None,
        uv_faces: ArrayInput | None = None,
        topology: Topology | None = None,
    ) -> None:
        positions = _check.float_array("vertices", vertices, ("vertices", 3))
        count = positions.shape[0]
        if count == 0:
            raise ValueError("vertices: wanted at least one vertex, got none")
        indices = _check.index_array("faces", faces, ("faces", 3), bound=count)
        if indices.shape[0] == 0:
            raise ValueError("faces: wanted at least one face, got none")
        if normals is not None:
            normals = _check.float_array("normals", normals, (count, 3))
        if uvs is not None:
            own = count if uv_faces is None else "coordinates"
            uvs = _check.float_array("uvs", uvs, (own, 2))
        if uv_faces is not None:
            if uvs is None:
                raise ValueError("uv_faces: wanted uvs that they count, got None")
            shape = indices.shape
            uv_faces = _check.index_array("uv_faces", uv_faces, shape, bound=uvs.shape[0])
        set_field(self, "vertices", positions)
        set_field(self, "faces", indices)
        set_field(self, "normals", normals)
        set_field(self, "uvs", uvs)
        set_field(self, "uv_faces", uv_faces)
        if topology is None:
            topology = _topology_of(positions, indices)
        elif not isinstance(topology, Topology):
            _check.instance_of("topology", topology, Topology)
        elif topology.patches.shape[0] != indices.shape[0]:
            raise ValueError(
                f"topology: wanted that of {indices.shape[0]} faces, got one of"
                f" {topology.patches.shape[0]}; pass None where faces change"
            )
        set_field(self, "topology", topology)


def face_normals(vertices: ArrayInput, faces: ArrayInput) -> Float[Array, "faces 3"]:
    """Unit normals of the faces; zero, with zero derivative, for a face without area.

    Differentiable in `vertices`.
    """
    return _face_normals(*_arrays(vertices, faces))


def face_areas(vertices: ArrayInput, faces: ArrayInput) -> Float[Array, "faces"]:
    """Areas of the faces, differentiable in `vertices` (derivative zero where the area is)."""
    return _face_areas(*_arrays(vertices, faces))


def vertex_normals(
    vertices: ArrayInput,
    faces: ArrayInput,
    *,
    weighting: str = "area",
    weld: ArrayInput | None = None,
) -> Float[Array, "vertices 3"]:
    """Unit normals at the vertices: normalised weighted sums of the normals of the faces there.

    Differentiable in `vertices`. A vertex without faces, or whose faces cancel, has zero.

    Args:
        vertices: shape (vertices, 3).
        faces: shape (faces, 3).
        weighting: what a face counts for at its corner. "area": its area. "angle": the angle
            between its two edges there (Thürmer and Wüthrich 1998), independent of how a flat
            polygon is cut into triangles. "uniform": one (Gouraud; FEATURES G7).
        weld: for every vertex the one whose faces it shares, as `weld(vertices)` gives it;
            `None` keeps vertices at one place apart.
    """
    positions, indices = _arrays(vertices, faces)
    _check.one_of("weighting", weighting, WEIGHTINGS)
    if weld is not None:
        weld = _check.index_array("weld", weld, (positions.shape[0],), bound=positions.shape[0])
    return _vertex_normals(positions, indices, weld, weighting)


def weld(vertices: ArrayInput) -> Int[Array, "vertices"] | Int[np.ndarray, "vertices"]:
    """Index of the first vertex at exactly the same position, for every vertex.

    Computed by NumPy where the positions are known, in JAX (without derivative) while they are
    being traced.
    """
    positions = _check.float_array("vertices", vertices, ("vertices", 3))
    if _check.is_concrete(positions):
        return _topology.representatives(np.asarray(positions))
    return _topology.representatives(lax.stop_gradient(positions), jnp)


def with_normals(mesh: Mesh, *, weighting: str = "area", weld: bool = True) -> Mesh:
    """The same mesh with smooth vertex normals; see `vertex_normals`.

    Args:
        mesh: its own normals, if any, are replaced.
        weighting: "area", "angle" or "uniform".
        weld: whether vertices at exactly the same position (a texture seam, a corner-split mesh)
            count as one and get one normal.
    """
    _check.instance_of("mesh", mesh, Mesh)
    _check.one_of("weighting", weighting, WEIGHTINGS)
    groups = jnp.asarray(_weld(mesh.vertices)) if _check.flag("weld", weld) else None
    normals = _vertex_normals(mesh.vertices, mesh.faces, groups, weighting)
    return Mesh(
        vertices=mesh.vertices,
        faces=mesh.faces,
        normals=normals,
        uvs=mesh.uvs,
        uv_faces=mesh.uv_faces,
        topology=mesh.topology,
    )


_weld = weld  # `weld` is also the name of an option


def flat_shaded(mesh: Mesh) -> Mesh:
    """Give each face its own three vertices, with the face's normal as theirs."""
    _check.instance_of("mesh", mesh, Mesh)
    corners = mesh.faces.reshape(-1)
    normals = _face_normals(mesh.vertices, mesh.faces)
    return Mesh(
        vertices=mesh.vertices[corners],
        faces=jnp.arange(corners.shape[0]).reshape(-1, 3),
        normals=jnp.repeat(normals, 3, axis=0),
        uvs=None if mesh.uvs is None else mesh.uvs[_uv_faces(mesh).reshape(-1)],
    )


def split_uvs(mesh: Mesh) -> Mesh:
    """The same mesh with one uv a vertex: vertices with several are split; on the host.

    What a file format or a program with one index array wants. Differentiate with respect to the
    vertices of the result.
    """
    _check.instance_of("mesh", mesh, Mesh)
    if mesh.uvs is None or mesh.uv_faces is None:
        return mesh
    _, faces = _host_arrays(mesh.vertices, mesh.faces)
    _, uv_faces = _host_arrays(mesh.uvs, mesh.uv_faces)
    pairs, index = np.unique(
        np.stack([faces, uv_faces], axis=-1).reshape(-1, 2), axis=0, return_inverse=True
    )
    vertex, uv = pairs.T
    return Mesh(
        vertices=mesh.vertices[vertex],
        faces=jnp.asarray(index.reshape(-1, 3)),
        normals=None if mesh.normals is None else mesh.normals[vertex],
        uvs=mesh.uvs[uv],
    )


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
    corners, sizes = _topology.join_indices(polygons, len(positions))
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
    joined = _topology.join_polygons(positions, corners, sizes)
    triangles = _topology.triangulate(positions, joined)
    # One vertex for every vertex id and surface that occur together.
    pairs, owner = np.unique(
        np.stack([joined.corner, group[joined.polygon]], axis=1), axis=0, return_inverse=True
    )
    weights = joined.area if weighting == "area" else np.ones_like(joined.area)
    share = np.repeat(joined.normal * (weights / weights.max())[:, None], joined.size, axis=0)
    normals = np.zeros((len(pairs), 3))
    np.add.at(normals, owner, share)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(
        vertices=positions_device[pairs[:, 0]],
        faces=jnp.asarray(owner[triangles]),
        normals=jnp.asarray(normals / np.where(length > 0, length, 1), positions_device.dtype),
    )


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
            [_uv_faces(m) + int(n) for m, n in zip(meshes, np.cumsum([0, *counts]), strict=False)]
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
        _host_arrays(mesh.vertices, mesh.faces)
    own_uvs = any(mesh.uv_faces is not None for mesh in meshes)
    alike = [replace(mesh, uv_faces=_uv_faces(mesh) if own_uvs else None) for mesh in meshes]
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
    vertices, faces = _host_arrays(mesh.vertices, mesh.faces)
    leader = _topology.clusters(vertices.astype(np.float64), distance)
    corners = leader[faces]
    proper = np.all(corners != np.roll(corners, 1, axis=1), axis=1)
    corners = corners[proper]
    if len(corners) == 0:
        raise ValueError(f"tolerance: wanted one that leaves a face, got {distance}")
    used, first_use, index = np.unique(corners, return_index=True, return_inverse=True)
    order = np.argsort(first_use)
    kept = used[order]
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


def edge_adjacency(vertices: ArrayInput, faces: ArrayInput) -> EdgeAdjacency:
    """Every edge once, with the two faces that share it, over vertices welded by position.

    Made on the host, about 0.1 s for 100,000 faces. Where more than two faces meet at an edge
    (cubes that touch along it), the edge occurs once for each pair of faces that bound a wedge of
    solid between them. A face two of whose corners lie at one place is left out.
    """
    return _topology.edge_adjacency(*_host_arrays(*_arrays(vertices, faces)))


def euler_characteristic(mesh: Mesh) -> int:
    """Vertices − edges + faces over welded vertices: 2 for a sphere, 0 for a torus."""
    _check.instance_of("mesh", mesh, Mesh)
    vertices, faces = _host_arrays(mesh.vertices, mesh.faces)
    half = _topology.half_edges(vertices, faces)
    welded = _topology.representatives(vertices)
    corners = np.unique(welded[half.corners])
    return len(corners) - len(np.unique(half.key)) + len(half.key) // 3


def is_closed(mesh: Mesh) -> bool:
    """Whether the mesh bounds a solid: every edge is passed as often one way as the other."""
    _check.instance_of("mesh", mesh, Mesh)
    half = _topology.half_edges(*_host_arrays(mesh.vertices, mesh.faces))
    _, edge = np.unique(half.key, return_inverse=True)
    return not np.any(np.bincount(edge, weights=np.where(half.low_to_high, 1, -1)))


def signed_volume(mesh: Mesh) -> Float[Array, ""]:
    """Volume inside a closed mesh, negative where faces are clockwise from outside.

    Differentiable in the positions.

    Example:
        >>> float(dr.mesh.signed_volume(dr.shapes.cube()))
        8.0
    """
    _check.instance_of("mesh", mesh, Mesh)
    a, b, c = _corners(mesh.vertices - jnp.mean(mesh.vertices, axis=0), mesh.faces)
    return jnp.sum(dot(a, jnp.cross(b, c))) / 6


def _arrays(vertices: ArrayInput, faces: ArrayInput) -> tuple[Array, Array]:
    positions = _check.float_array("vertices", vertices, ("vertices", 3))
    return positions, _check.index_array("faces", faces, ("faces", 3), bound=positions.shape[0])


def _topology_of(vertices: Array, faces: Array) -> Topology | None:
    if not (_check.is_concrete(vertices) and _check.is_concrete(faces)):
        return None
    topology = _topology.topology_of(np.asarray(vertices), np.asarray(faces))
    return jax.tree.map(jnp.asarray, topology)


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


def _host_arrays(vertices: Array, faces: Array) -> tuple[np.ndarray, np.ndarray]:
    if not (_check.is_concrete(vertices) and _check.is_concrete(faces)):
        raise ValueError(
            "mesh: wanted known vertices and faces, got traced arrays (topology is made on the"
            " host: call this outside jit, grad and vmap)"
        )
    return np.asarray(vertices), np.asarray(faces)


def _uv_faces(mesh: Mesh) -> Array:
    return mesh.faces if mesh.uv_faces is None else mesh.uv_faces


def _joined(parts: Sequence[Array | None]) -> Array | None:
    arrays = [part for part in parts if part is not None]
    return jnp.concatenate(arrays) if arrays else None


def _corners(vertices: Array, faces: Array) -> tuple[Array, Array, Array]:
    return vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]


def _scaled_edges(vertices: Array, faces: Array) -> tuple[Array, Array, Array]:
    """Two edges of every face from its first corner, divided by the face's size; the size."""
    a, b, c = _corners(vertices, faces)
    edges = jnp.stack([b - a, c - a])
    size = jnp.max(jnp.abs(lax.stop_gradient(edges)), axis=(0, 2))
    first, second = edges / jnp.where(size > 0, size, 1)[:, None]
    return first, second, size


@jax.jit
def _face_normals(vertices: Array, faces: Array) -> Array:
    first, second, _ = _scaled_edges(vertices, faces)
    return normalize(jnp.cross(first, second))


@jax.jit
def _face_areas(vertices: Array, faces: Array) -> Array:
    first, second, size = _scaled_edges(vertices, faces)
    return size * (size * norm(jnp.cross(first, second))) / 2


@partial(jax.jit, static_argnames="weighting")
def _vertex_normals(vertices: Array, faces: Array, groups: Array | None, weighting: str) -> Array:
    owners = faces if groups is None else groups[faces]
    first, second, size = _scaled_edges(vertices, faces)
    area_vector = jnp.cross(first, second)
    if weighting == "area":
        largest = jnp.zeros_like(size, shape=vertices.shape[0]).at[owners].max(size[:, None])
        largest = jnp.where(largest > 0, largest, 1)
        weights = (size[:, None] / largest[owners]) ** 2
        shares = area_vector[:, None] * weights[..., None]
    else:
        normals = normalize(area_vector)
        angles = _corner_angles(first, second) if weighting == "angle" else 1.0
        shares = jnp.broadcast_to(normals[:, None], (*faces.shape, 3)) * angles
    sums = jnp.zeros_like(vertices).at[owners].add(shares)
    unit = normalize(sums)
    return unit if groups is None else unit[groups]


def _corner_angles(first: Array, second: Array) -> Array:
    """Angles at the three corners, shape (faces, 3, 1); 0 where an edge has no length."""
    edges = normalize(jnp.stack([first, second - first, -second], axis=1))  # a→b, b→c, c→a
    arriving = -jnp.roll(edges, 1, axis=1)
    sine, cosine = norm(jnp.cross(edges, arriving)), dot(edges, arriving)
    undefined = (sine == 0) & (cosine == 0)
    return jnp.arctan2(sine, jnp.where(undefined, 1, cosine))[..., None]
