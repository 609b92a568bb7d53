"""Triangles over vertices, and what is known at these."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from diffrast import _check, _topology
from diffrast._check import ArrayInput
from diffrast._pytree import pytree_dataclass, set_field
from diffrast._topology import Attributes, Topology


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
            own_uvs = uvs if uv_faces is None else None
            topology = topology_where_known(positions, indices, normals, own_uvs)
        elif not isinstance(topology, Topology):
            _check.instance_of("topology", topology, Topology)
        elif topology.patches.shape[0] != indices.shape[0]:
            raise ValueError(
                f"topology: wanted that of {indices.shape[0]} faces, got one of"
                f" {topology.patches.shape[0]}; pass None where faces change"
            )
        set_field(self, "topology", topology)


def topology_where_known(
    vertices: Array, faces: Array, normals: Array | None, uvs: Array | None
) -> Topology | None:
    """Of vertices and faces that are known, `None` of others; `uvs` are the vertices' own."""
    if not (_check.is_concrete(vertices) and _check.is_concrete(faces)):
        return None
    attributes = None
    if _check.is_concrete(normals) and _check.is_concrete(uvs):
        attributes = Attributes(*(None if a is None else np.asarray(a) for a in (normals, uvs)))
    topology = _topology.topology_of(np.asarray(vertices), np.asarray(faces), attributes)
    with _check.staying_known(vertices, faces):
        return jax.tree.map(jnp.asarray, topology)


def arrays(vertices: ArrayInput, faces: ArrayInput) -> tuple[Array, Array]:
    """Vertices and faces as arrays, checked."""
    positions = _check.float_array("vertices", vertices, ("vertices", 3))
    return positions, _check.index_array("faces", faces, ("faces", 3), bound=positions.shape[0])


def host_arrays(vertices: Array, faces: Array) -> tuple[np.ndarray, np.ndarray]:
    """The same for NumPy; traced ones are an error."""
    if not (_check.is_concrete(vertices) and _check.is_concrete(faces)):
        raise ValueError(
            "mesh: wanted known vertices and faces, got traced arrays (topology is made on the"
            " host: call this outside jit, grad and vmap)"
        )
    return np.asarray(vertices), np.asarray(faces)


def corner_positions(vertices: Array, faces: Array) -> tuple[Array, Array, Array]:
    """Of the first, second and third corner of all faces."""
    return vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]


def uv_faces_of(mesh: Mesh) -> Array:
    """Which of the uvs the corners have, `uv_faces` or not."""
    return mesh.faces if mesh.uv_faces is None else mesh.uv_faces
