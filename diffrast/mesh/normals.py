"""Normals and areas of faces, and normals of vertices.

The area vector of a face is half the cross product of two edges; each corner adds it to its vertex,
and the sum is normalised. To keep float32 from under- or overflowing, the cross product is taken of
edges divided by the face's size s, and enters the sum with the factor (s / S)², where S is the
largest s at that vertex: the factors common to a vertex cancel.
"""

from dataclasses import replace
from functools import partial, reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from diffrast import _check, _topology
from diffrast._check import ArrayInput
from diffrast._stored import stored_rows
from diffrast.linalg import dot, norm, normalize
from diffrast.mesh.triangles import Mesh, arrays, corner_positions, uv_faces_of

WEIGHTINGS = ("area", "angle", "uniform")


def face_normals(vertices: ArrayInput, faces: ArrayInput) -> Float[Array, "faces 3"]:
    """Unit normals of the faces; zero, with zero derivative, for a face without area.

    Differentiable in `vertices`.
    """
    return _face_normals(*arrays(vertices, faces))


def face_areas(vertices: ArrayInput, faces: ArrayInput) -> Float[Array, "faces"]:
    """Areas of the faces, differentiable in `vertices` (derivative zero where the area is)."""
    return _face_areas(*arrays(vertices, faces))


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
    positions, indices = arrays(vertices, faces)
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


@_check.known_of_known
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
    # Which vertices are alike is another matter with these, where it can be found.
    known = _check.is_concrete(mesh.vertices) and _check.is_concrete(mesh.faces)
    return replace(mesh, normals=normals, topology=None if known else mesh.topology)


_weld = weld  # `weld` is also the name of an option


@_check.known_of_known
def flat_shaded(mesh: Mesh) -> Mesh:
    """Give each face its own three vertices, with the face's normal as theirs."""
    _check.instance_of("mesh", mesh, Mesh)
    corners = mesh.faces.reshape(-1)
    normals = _face_normals(mesh.vertices, mesh.faces)
    return Mesh(
        vertices=mesh.vertices[corners],
        faces=jnp.arange(corners.shape[0]).reshape(-1, 3),
        normals=jnp.repeat(normals, 3, axis=0),
        uvs=None if mesh.uvs is None else mesh.uvs[uv_faces_of(mesh).reshape(-1)],
    )


def _scaled_edges(vertices: Array, faces: Array) -> tuple[Array, Array, Array]:
    """Two edges of every face from its first corner, divided by the face's size; the size."""
    a, b, c = corner_positions(vertices, faces)
    edges = jnp.stack([b - a, c - a])
    # One by one: a reduction is a call of a library on a CPU, and takes ten times as long.
    extents = jnp.abs(lax.stop_gradient(edges))
    size = reduce(jnp.maximum, [edge[:, i] for edge in extents for i in range(3)])
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
        normals = area_vector
    else:
        normals = normalize(area_vector)
        ones = jnp.ones(faces.shape, normals.dtype)
        weights = _corner_angles(first, second) if weighting == "angle" else ones
    sums = jnp.zeros_like(vertices)
    for corner in range(3):
        sums = sums.at[owners[:, corner]].add(normals * weights[:, corner, None])
    sums = stored_rows(sums)  # which its transpose looks up for each face
    unit = normalize(sums)
    return unit if groups is None else unit[groups]


def _corner_angles(first: Array, second: Array) -> Array:
    """Angles at the three corners, shape (faces, 3); 0 where an edge has no length."""
    edges = normalize(jnp.stack([first, second - first, -second], axis=1))  # a→b, b→c, c→a
    arriving = -jnp.roll(edges, 1, axis=1)
    sine, cosine = norm(jnp.cross(edges, arriving)), dot(edges, arriving)
    undefined = (sine == 0) & (cosine == 0)
    return jnp.arctan2(sine, jnp.where(undefined, 1, cosine))
