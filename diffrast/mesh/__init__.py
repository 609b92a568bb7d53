"""Triangle meshes: normals, smoothing groups, edge adjacency, merging, transforms.

A `Mesh` is arrays only. What varies continuously (normals, areas, volume) is JAX code,
differentiable in the positions and indifferent to their scale: a model measured in 1e-20 units or
in 1e20 has the same normals. What is discrete (welding, edges, triangulation) is made on the host
by `diffrast._topology`.
"""

from diffrast._topology import EdgeAdjacency as EdgeAdjacency
from diffrast._topology import Topology as Topology
from diffrast.mesh.assembly import from_polygons as from_polygons
from diffrast.mesh.assembly import merge as merge
from diffrast.mesh.assembly import merge_near_vertices as merge_near_vertices
from diffrast.mesh.assembly import split_uvs as split_uvs
from diffrast.mesh.assembly import stack_meshes as stack_meshes
from diffrast.mesh.assembly import transform as transform
from diffrast.mesh.measures import edge_adjacency as edge_adjacency
from diffrast.mesh.measures import euler_characteristic as euler_characteristic
from diffrast.mesh.measures import is_closed as is_closed
from diffrast.mesh.measures import signed_volume as signed_volume
from diffrast.mesh.normals import WEIGHTINGS as WEIGHTINGS
from diffrast.mesh.normals import face_areas as face_areas
from diffrast.mesh.normals import face_normals as face_normals
from diffrast.mesh.normals import flat_shaded as flat_shaded
from diffrast.mesh.normals import vertex_normals as vertex_normals
from diffrast.mesh.normals import weld as weld
from diffrast.mesh.normals import with_normals as with_normals
from diffrast.mesh.triangles import Mesh as Mesh
