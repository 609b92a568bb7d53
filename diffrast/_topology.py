"""Who touches whom in a mesh: welding, edges, surfaces. No derivatives.

Topology is discrete and is made once per mesh, by NumPy on the host, outside anything that JAX
traces; only `traced_topology` is for meshes whose arrays are known no earlier. `diffrast.mesh`
checks the arguments, converts between JAX and NumPy, and is the public face of this file.
"""

from functools import reduce
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Int

_SAME_NORMAL = 1e-5  # of their size: normals on both sides of a seam that need no edge


class EdgeAdjacency(NamedTuple):
    """Every edge once, with the faces that meet there; all arrays are int32.

    Attributes:
        edges: vertex ids (start, end) of the edge, as the first face has them and in the
            direction in which that face, seen from outside, goes round counter-clockwise.
        edge_faces: ids of the face on the left of the edge and of the one beyond it; −1 where
            nothing is beyond (a boundary).
        opposite: for each of the two faces the vertex that is not on the edge; −1 likewise.
    """

    edges: Int[np.ndarray, "edges 2"]
    edge_faces: Int[np.ndarray, "edges 2"]
    opposite: Int[np.ndarray, "edges 2"]


class Edges(NamedTuple):
    """Every edge once, as rasterising needs it; arrays of integers that JAX may trace.

    Attributes:
        faces: the two faces of each edge; −1 in second place where there is none.
        corners: for each of the two faces, 3 i + j if the edge starts at its corner i and ends
            at its corner j.
        seam: whether the two faces have vertices of their own at the edge, so that attributes may
            jump there.
    """

    faces: Int[Any, "edges 2"]
    corners: Int[Any, "edges 2"]
    seam: Bool[Any, "edges"]


class Topology(NamedTuple):
    """How the faces of a mesh hang together.

    Attributes:
        edges: every edge once.
        neighbors: the faces across the three edges of each face, −1 where there is none.
        patches: a number for each face, the same for faces that hang together over edges at which
            attributes are continuous: by shared vertices, or by ones that are alike.
        bodies: the same for faces that hang together by vertices at the same place; None if all
            do.
    """

    edges: Edges
    neighbors: Int[Any, "faces 3"]
    patches: Int[Any, "faces"]
    bodies: Int[Any, "faces"] | None


class HalfEdges(NamedTuple):
    """The directed edges of all faces with three distinct corners, three to a face."""

    corners: Int[np.ndarray, "half_edges 3"]  # start, end and opposite vertex as in `faces`
    face: Int[np.ndarray, "half_edges"]
    low_to_high: Bool[np.ndarray, "half_edges"]  # direction, by welded vertex id
    key: Int[np.ndarray, "half_edges"]  # equal for the half-edges of one edge


def representatives(positions: Any, xp: Any = np) -> Any:
    """Index of the first row that equals each row of `positions`.

    Args:
        positions: shape (vertices, 3).
        xp: `numpy`, or `jax.numpy` for positions that are being traced.
    """
    positions = xp.where(positions == 0, 0, positions)  # −0 and 0 are one place
    order = xp.lexsort(positions.T)  # stable: equal rows stay in the order of their index
    ordered = positions[order]
    changes = xp.any(ordered[1:] != ordered[:-1], axis=1)
    group = xp.concatenate([xp.zeros(len(order[:1]), dtype=int), xp.cumsum(changes)])
    first = order[xp.searchsorted(group, group)]
    return first[xp.argsort(order)].astype(np.int32)


def by_three(number: Any) -> tuple[Any, Any]:
    """Quotient and remainder of numbers from 0 to 31; of a division XLA makes a pass of its own."""
    quotient = number * 11 >> 5
    return quotient, number - 3 * quotient


def third_corner(edge: Any) -> Any:
    """The corner of faces that is not on their edges, which are given as in `Edges.corners`."""
    first, second = by_three(edge)
    return 3 - first - second


def half_edges(positions: np.ndarray, faces: np.ndarray) -> HalfEdges:
    """Directed edges over vertices welded by exact position.

    A face two of whose corners lie at one place has no inside; it is left out, so that its
    neighbours meet each other.
    """
    welded = representatives(positions)[faces]
    proper = np.all(welded != np.roll(welded, 1, axis=1), axis=1)
    faces, welded = faces[proper], welded[proper].astype(np.int64)
    corners = np.stack([faces, np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=2)
    start, end = welded.reshape(-1), np.roll(welded, -1, axis=1).reshape(-1)
    key = np.minimum(start, end) * len(positions) + np.maximum(start, end)
    return HalfEdges(corners.reshape(-1, 3), np.repeat(np.flatnonzero(proper), 3), start < end, key)


def edge_adjacency(positions: np.ndarray, faces: np.ndarray) -> EdgeAdjacency:
    """Pair the half-edges of every edge; see `diffrast.mesh.edge_adjacency`."""
    half = half_edges(positions, faces)
    _, group, counts = np.unique(half.key, return_inverse=True, return_counts=True)
    turn = np.zeros(len(group))
    crowded = np.flatnonzero(counts[group] > 2)
    if crowded.size:
        turn[crowded] = _turns(positions.astype(np.float64), half, group, crowded)
    # Stable: the two half-edges of an ordinary edge stay in the order of their faces.
    order = np.lexsort((~half.low_to_high & (turn > 0), turn, group))
    place = np.arange(len(order)) - (np.cumsum(counts) - counts)[group[order]]
    is_first = place % 2 == 0
    has_partner = is_first & (place + 1 < counts[group[order]])
    first = order[is_first]
    partner = order[np.flatnonzero(is_first) + has_partner[is_first]]
    beyond = has_partner[is_first]
    edge_faces = np.stack([half.face[first], np.where(beyond, half.face[partner], -1)], axis=1)
    opposite = np.stack(
        [half.corners[first, 2], np.where(beyond, half.corners[partner, 2], -1)], axis=1
    )
    edges = half.corners[first, :2]
    return EdgeAdjacency(*(a.astype(np.int32) for a in (edges, edge_faces, opposite)))


class Attributes(NamedTuple):
    """What vertices have of their own, if they do."""

    normals: np.ndarray | None
    uvs: np.ndarray | None


def topology_of(
    positions: np.ndarray, faces: np.ndarray, attributes: Attributes | None = None
) -> Topology:
    """How a mesh hangs together, for rasterising; `attributes` are `None` if they are not known."""
    adjacency = edge_adjacency(positions, faces)
    welded = representatives(positions)
    ends = welded[adjacency.edges]
    corners = []
    for side in range(2):
        at = welded[faces[np.maximum(adjacency.edge_faces[:, side], 0)]]
        start, end = (np.argmax(at == ends[:, k : k + 1], axis=1) for k in range(2))
        corners.append(3 * start + end)
    packed = np.stack(corners, axis=1).astype(np.int32)
    beyond = adjacency.edge_faces[:, 1]
    other = faces[
        np.maximum(beyond, 0)[:, None], np.stack([packed[:, 1] // 3, packed[:, 1] % 3], 1)
    ]
    seam = (beyond >= 0) & np.any(other != adjacency.edges, axis=1)
    neighbors = np.full(faces.shape, -1, np.int32)
    for side in range(2):
        paired = beyond >= 0
        sides = third_corner(packed[paired, side])
        neighbors[adjacency.edge_faces[paired, side], sides] = adjacency.edge_faces[
            paired, 1 - side
        ]
    edges = Edges(adjacency.edge_faces, packed, seam)
    bodies = _joined(welded[faces], len(positions))
    whole = bool(np.all(bodies == bodies[0]))
    alike = np.zeros((0, 3), int)
    if attributes is not None and np.any(seam):
        alike = _alike(positions, faces, edges, attributes)
    patches = _joined(np.concatenate([faces, alike]), len(positions))[: len(faces)]
    return Topology(edges, neighbors, patches, None if whole else bodies)


def _alike(
    positions: np.ndarray, faces: np.ndarray, edges: Edges, attributes: Attributes
) -> np.ndarray:
    """Vertices on both sides of seams over which attributes go on, three a row as faces have them.

    Vertices without normals have those of their faces.
    """
    normals, uvs = attributes
    if normals is None:
        normals = _smooth_normals(positions, faces)
    alike = edges.seam & ~bent_seams(edges, normals, faces)
    one, other = np.moveaxis(_at_ends(edges, faces), -1, 0)
    if uvs is not None:
        alike &= np.all(uvs[one] == uvs[other], axis=(0, 2))
    return np.stack([one[0], other[0], one[1]], axis=1)[alike]


def bent_seams(edges: Edges, normals: Any, faces: Any, xp: Any = np) -> Any:
    """Those seams on whose sides the normals at the same place differ.

    Args:
        edges: of the faces.
        normals: shape (vertices, 3), of the size of one.
        faces: three vertex ids each.
        xp: `numpy`, or `jax.numpy` for arrays that are being traced.
    """
    vertex = _at_ends(edges, faces, xp)
    one, other = xp.moveaxis(normals.T[:, vertex], -1, 0)

    def largest(vectors: Any) -> Any:
        return reduce(xp.maximum, [abs(row) for row in vectors])

    apart = largest(one - other) > _SAME_NORMAL * (largest(one) + largest(other))
    return edges.seam & xp.any(apart, axis=0)


def _at_ends(edges: Edges, faces: Any, xp: Any = np) -> Any:
    """Vertices that the two faces of edges have at their ends, shape (2 ends, edges, 2 faces)."""
    corner = xp.stack([edges.corners // 3, edges.corners % 3])
    return faces[xp.maximum(edges.faces, 0), corner]


def _smooth_normals(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals at vertices, by the area of the faces there; zero where they cancel."""
    a, b, c = np.moveaxis(positions.astype(np.float64)[faces], 1, 0)
    area_vector = np.cross(b - a, c - a)
    sums = np.zeros(positions.shape)
    for corner in range(3):
        np.add.at(sums, faces[:, corner], area_vector)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return sums / np.where(length > 0, length, 1)


def _joined(faces: np.ndarray, count: int) -> np.ndarray:
    """The least of the vertices that hang together with each face."""
    labels = np.arange(count, dtype=np.int32)
    while True:
        before, labels = labels, labels.copy()
        roots = before[faces]
        np.minimum.at(labels, roots, np.min(roots, axis=1)[:, None])
        labels = labels[labels]
        if np.array_equal(labels, before):
            return labels[faces[:, 0]]


def traced_topology(positions: Array, faces: Array) -> Topology:
    """How a mesh whose arrays are being traced hangs together: sorted in every call.

    There are three edges a face; those that are not used have no faces. Where more than two faces
    meet at an edge they pair in the order of their index.
    """
    welded = representatives(positions, jnp)[faces]
    count = faces.shape[0]
    start, end = welded.reshape(-1), jnp.roll(welded, -1, axis=1).reshape(-1)
    proper = jnp.repeat(jnp.all(welded != jnp.roll(welded, 1, axis=1), axis=1), 3)
    low, high = jnp.minimum(start, end), jnp.maximum(start, end)
    low = jnp.where(proper, low, positions.shape[0])
    order = jnp.lexsort((high, low))
    low, high = low[order], high[order]
    index = jnp.arange(3 * count)
    begins = jnp.append(True, (low[1:] != low[:-1]) | (high[1:] != high[:-1]))
    place = index - lax.cummax(jnp.where(begins, index, 0))
    first = (place % 2 == 0) & proper[order]
    following = jnp.minimum(index + 1, 3 * count - 1)
    paired = first & ~begins[following] & (following > index)
    one, other = order, order[following]
    reverse = start[one] != start[other]
    there, back = other % 3, (other % 3 + 1) % 3
    opposite = jnp.where(reverse, 3 * back + there, 3 * there + back)
    corner = 3 * (one % 3) + (one % 3 + 1) % 3
    vertices = faces.reshape(-1)
    ends = [vertices[3 * (one // 3) + c] for c in (corner // 3, corner % 3)]
    others = [vertices[3 * (other // 3) + c] for c in (opposite // 3, opposite % 3)]
    seam = paired & ((ends[0] != others[0]) | (ends[1] != others[1]))
    columns = [jnp.where(first, one // 3, -1), jnp.where(paired, other // 3, -1)]

    edges = Edges(
        jnp.stack(columns, axis=1).astype(jnp.int32),
        jnp.stack([corner, opposite], axis=1).astype(jnp.int32),
        seam,
    )
    neighbors = jnp.full((count, 3), -1, jnp.int32)
    for side in range(2):
        sides = third_corner(edges.corners[:, side])
        own = jnp.where(paired, edges.faces[:, side], count)
        neighbors = neighbors.at[own, sides].set(edges.faces[:, 1 - side], mode="drop")
    patches, bodies = (_traced_joined(f, positions.shape[0]) for f in (faces, welded))
    return Topology(edges, neighbors, patches, bodies)


def _traced_joined(faces: Array, count: int) -> Array:
    """`_joined` of faces that are being traced."""

    def join(state: tuple[Array, Array]) -> tuple[Array, Array]:
        labels, _ = state
        roots = labels[faces]
        joined = labels.at[roots].min(jnp.min(roots, axis=1)[:, None])
        return joined[joined], labels

    labels = jnp.arange(count, dtype=jnp.int32) + 0 * faces[0, 0]
    labels, _ = lax.while_loop(lambda s: jnp.any(s[0] != s[1]), join, (labels, labels - 1))
    return labels[faces[:, 0]]


def _turns(
    positions: np.ndarray, half: HalfEdges, group: np.ndarray, crowded: np.ndarray
) -> np.ndarray:
    """Angle of each face about its edge, where more than two faces meet there.

    Looking along the edge from its lower to its higher vertex, solid lies between a face that
    goes high to low and the next one, at a larger angle, that goes low to high. Counting angles
    from a face of the first kind, neighbours in the order of angles bound one wedge of solid.
    """
    backward = ~half.low_to_high[crowded]
    order = np.lexsort((~backward, group[crowded]))
    _, first = np.unique(group[crowded][order], return_index=True)
    sizes = np.diff(np.append(first, len(order)))
    reference = np.empty(len(order), dtype=int)
    reference[order] = np.repeat(order[first], sizes)

    corners = half.corners[crowded]
    low = np.where(backward, corners[:, 1], corners[:, 0])
    high = np.where(backward, corners[:, 0], corners[:, 1])
    axis = positions[high] - positions[low]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    arm = positions[corners[:, 2]] - positions[low]
    arm -= np.sum(arm * axis, axis=1, keepdims=True) * axis
    zero = arm[reference]
    sine = np.sum(np.cross(axis, zero) * arm, axis=1)
    # Rounding keeps faces that lie on one another at the same angle.
    angle = np.round(np.arctan2(sine, np.sum(zero * arm, axis=1)) % (2 * np.pi), 6)
    full = np.round(2 * np.pi, 6)
    return np.where(backward, np.where(angle == full, 0, angle), np.where(angle == 0, full, angle))


def clusters(positions: np.ndarray, tolerance: float) -> np.ndarray:
    """Lowest index of the vertices linked to each vertex by steps of at most `tolerance`."""
    label = np.arange(len(positions))
    first, second = _near_pairs(positions, tolerance)
    while np.any(label[first] != label[second]):
        lowest = np.minimum(label[first], label[second])
        np.minimum.at(label, first, lowest)
        np.minimum.at(label, second, lowest)
        label = label[label]
    return label


def _near_pairs(positions: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of vertices at most `tolerance` apart, except between copies of one place.

    Sweeps along a direction askew to everything: points that are near have near heights.
    """
    first_copy = representatives(positions)
    copies = np.flatnonzero(first_copy != np.arange(len(first_copy)))
    pairs = [(copies, first_copy[copies])]
    places = np.flatnonzero(first_copy == np.arange(len(first_copy)))
    height = positions[places] @ np.array([0.6123, 0.5417, 0.5761])
    order = np.argsort(height)
    places, height = places[order], height[order]
    step = 1
    while step < len(places) and np.any(height[step:] - height[:-step] <= tolerance):
        candidate = np.flatnonzero(height[step:] - height[:-step] <= tolerance)
        first, second = places[candidate], places[candidate + step]
        near = np.linalg.norm(positions[first] - positions[second], axis=1) <= tolerance
        pairs.append((first[near], second[near]))
        step += 1
    return np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs])
