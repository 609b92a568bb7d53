"""Wireframes: the edges of a scene's meshes, with hidden ones removed (FEATURES L6, L7)."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from diffrast import _check
from diffrast._check import ArrayInput
from diffrast._polygons import join_indices
from diffrast._topology import EdgeAdjacency, edge_adjacency
from diffrast.camera import Camera, check_single, world_to_clip
from diffrast.linalg import normalize, transform_normals, transform_points
from diffrast.lines.drawing import draw_lines, draw_lines_with_depth
from diffrast.mesh import Mesh, transform, vertex_normals
from diffrast.raster import rasterize
from diffrast.scene import Object, Scene
from diffrast.texture import CubeTexture
from diffrast.texturing import skybox

_FLAT = 1e-5  # sine of the angle between the planes of two faces that count as one polygon


class SpaceLines(NamedTuple):
    """Lines in space."""

    points: Float[Array, "points 3"]
    lines: Int[Array, "lines 2"]


def mesh_edges(mesh: Mesh, *, flat: bool = False) -> Int[np.ndarray, "edges 2"]:
    """Vertex numbers of every edge of a mesh, once; found on the host.

    Args:
        mesh: of known vertices and faces. Faces meet where positions are equal.
        flat: whether to count edges between two faces in one plane, which a polygon has none of. A
            face without area lies in the plane of the one beyond its longest side.
    """
    _check.instance_of("mesh", mesh, Mesh)
    flat = _check.flag("flat", flat)
    if not (_check.is_concrete(mesh.vertices) and _check.is_concrete(mesh.faces)):
        raise ValueError(
            "mesh: wanted known vertices and faces, got traced arrays; find the edges outside jit"
        )
    positions, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    adjacency = edge_adjacency(positions, faces)
    if flat:
        return adjacency.edges
    eps = float(jnp.finfo(mesh.vertices.dtype).eps)
    normals = _normals_through_slivers(positions, faces, adjacency, eps)
    one, other = (normals[np.maximum(adjacency.edge_faces[:, k], 0)] for k in range(2))
    flat_there = (np.linalg.norm(np.cross(one, other), axis=1) <= _FLAT) & (
        np.sum(one * other, axis=1) > 0
    )
    return adjacency.edges[~flat_there | (adjacency.edge_faces[:, 1] < 0)]


def _normals_through_slivers(
    positions: np.ndarray, faces: np.ndarray, adjacency: EdgeAdjacency, eps: float
) -> np.ndarray:
    """Unit normals of faces; one without area has that of the face beyond its longest side.

    Zero where there is none. No area is what rounding of the positions by `eps` may make.
    """
    corners = positions[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    across = np.cross(sides[:, 0], sides[:, 1])
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    rounding = 4 * eps * np.abs(corners).max(axis=(1, 2)) * longest
    thin = np.linalg.norm(across, axis=1) <= rounding
    across[thin] = 0
    with _check.staying_known(across):
        normals = np.array(normalize(across))
    # Of each face the one beyond its longest side: the last one that is written.
    ends = positions[adjacency.edges]
    order = np.argsort(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), kind="stable")
    joined = adjacency.edge_faces[order]
    joined = np.stack([joined, joined[:, ::-1]], axis=1).reshape(-1, 2)
    joined = joined[joined[:, 0] >= 0]
    beyond = np.full(len(faces), -1)
    beyond[joined[:, 0]] = joined[:, 1]
    while True:
        ready = np.flatnonzero(thin & (beyond >= 0) & ~thin[beyond])
        if not ready.size:
            return normals
        normals[ready] = normals[beyond[ready]]
        thin[ready] = False


def polygon_edges(polygons: Sequence[ArrayInput] | np.ndarray) -> Int[np.ndarray, "edges 2"]:
    """Vertex numbers of every side of polygons, once, whichever way it is passed.

    Args:
        polygons: the vertex numbers of each polygon, of any number of corners.
    """
    corner, sizes = join_indices(polygons, np.iinfo(np.int32).max)
    begins = np.repeat(np.cumsum(sizes) - sizes, sizes)
    place = np.arange(len(corner)) - begins
    following = corner[begins + (place + 1) % np.maximum(np.repeat(sizes, sizes), 1)]
    sides = np.sort(np.stack([corner, following], axis=1), axis=1)
    return np.unique(sides[sides[:, 0] != sides[:, 1]], axis=0).astype(np.int32)


def normal_lines(vertices: ArrayInput, normals: ArrayInput, length: ArrayInput) -> SpaceLines:
    """Lines that show normals: from each vertex, `length` long, along its normal (FEATURES L7).

    Differentiable in everything.

    Args:
        vertices: (vertices, 3).
        normals: (vertices, 3), unit vectors.
        length: in the unit of the vertices.
    """
    vertices = _check.float_array("vertices", vertices, ("vertices", 3))
    normals = _check.float_array("normals", normals, (vertices.shape[0], 3))
    length = _check.float_array("length", length, ())
    count = vertices.shape[0]
    tips = vertices + length * normals
    lines = np.stack([np.arange(count), np.arange(count) + count], axis=1).astype(np.int32)
    return SpaceLines(jnp.concatenate([vertices, tips]), jnp.asarray(lines))


def wireframe(
    scene: Scene,
    camera: Camera,
    *,
    height: int,
    width: int,
    hidden: bool = False,
    cull_backfaces: bool = False,
    edges: Sequence[ArrayInput] | None = None,
    color: ArrayInput | None = None,
    normal_length: float | None = None,
    line_width: float = 1.0,
    antialias: bool = True,
) -> Float[Array, "height width 3"]:
    """Draw the edges of a scene's meshes (FEATURES L6, L7; Van Houdt 7-10, Kos 3).

    Edges have the diffuse colour of their object's material. Differentiable in vertices,
    transforms, camera, colours and background where `antialias` is on; which parts are hidden has
    no derivative.

    Args:
        scene: its objects and background; lights play no role.
        camera: from where it is seen.
        height: rows of the image.
        width: columns of the image.
        hidden: draw edges behind faces, too.
        cull_backfaces: faces that turn away hide nothing.
        edges: for each object the (edges, 2) vertex numbers to join; None takes all edges but those
            between two faces in one plane (`mesh_edges`), which needs meshes of known vertices.
        color: (3,) linear RGB of all lines, instead of the materials'.
        normal_length: draw the vertices' normals, too, this long in world units.
        line_width: of anti-aliased lines, in pixels.
        antialias: see `draw_lines`.

    Raises:
        ValueError: for wrong shapes, a stack of cameras, and traced meshes without `edges`.
    """
    _check.instance_of("scene", scene, Scene)
    check_single(camera)
    hidden = _check.flag("hidden", hidden)
    cull_backfaces = _check.flag("cull_backfaces", cull_backfaces)
    if color is not None:
        color = _check.float_array("color", color, (3,))
    if normal_length is not None:
        _check.float_array("normal_length", normal_length, ())
    if edges is not None and not isinstance(edges, Sequence):
        raise ValueError(f"edges: wanted a list or None, got {type(edges).__name__}")
    if edges is not None and len(edges) != len(scene.objects):
        raise ValueError(
            f"edges: wanted those of {len(scene.objects)} objects, got {len(edges)} entries"
        )
    points, lines, colors, faces = [], [], [], []
    first = 0
    for number, item in enumerate(scene.objects):
        positions = transform_points(item.transform, item.mesh.vertices)
        own = mesh_edges(item.mesh) if edges is None else edges[number]
        parts = [
            SpaceLines(
                positions, _check.index_array("edges", own, ("edges", 2), bound=len(positions))
            )
        ]
        outward = transform(item.mesh, item.transform).faces if cull_backfaces else item.mesh.faces
        faces.append(outward + first)
        if normal_length is not None:
            parts.append(normal_lines(positions, _world_normals(item), normal_length))
        for part in parts:
            points.append(part.points)
            lines.append(part.lines + first)
            colors.append(jnp.broadcast_to(item.material.diffuse, (part.lines.shape[0], 3)))
            first += part.points.shape[0]
    height, width = _check.positive_int("height", height), _check.positive_int("width", width)
    background, size = scene.background, {"height": height, "width": width}
    if isinstance(background, CubeTexture):
        background = skybox(background, camera, height, width)
    if not points:
        no_points, no_lines = jnp.zeros((0, 2), background.dtype), np.zeros((0, 2), np.int32)
        return draw_lines(
            no_points,
            no_lines,
            height=height,
            width=width,
            background=background,
            line_width=line_width,
            antialias=antialias,
        )
    positions_clip = world_to_clip(camera, jnp.concatenate(points))
    joined = jnp.concatenate(faces)
    fragments = None
    if not hidden:
        fragments = rasterize(positions_clip, joined, **size, cull_backfaces=cull_backfaces)
    return draw_lines_with_depth(
        positions_clip,
        jnp.concatenate(lines),
        jnp.concatenate(colors) if color is None else color,
        **size,
        faces=None if hidden else joined,
        fragments=fragments,
        background=background,
        line_width=line_width,
        antialias=antialias,
    )


def _world_normals(item: Object) -> Array:
    mesh = item.mesh
    normals = vertex_normals(mesh.vertices, mesh.faces) if mesh.normals is None else mesh.normals
    return normalize(transform_normals(item.transform, normals))
