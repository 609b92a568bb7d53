"""The Platonic solids and the buckyball (FEATURES G1, G3; Van Houdt 8, 17), centred at the origin.

Sizes are the source's where it has round numbers: cube and tetrahedron have corners at (±1, ±1,
±1), the tetrahedron four of the cube's eight; octahedron, icosahedron, dodecahedron and buckyball
have their corners on the unit sphere.

Every solid comes in two forms with the same edges and silhouettes. By default each triangle has
its own three corners with the face's normal, so that a solid looks faceted in every kind of
shading. With `flat=False` faces share their vertices (a cube has 8) and there are no normals: the
form to count, copy, subdivide, or fit by moving vertices. Faces are counter-clockwise from outside.
"""

import numpy as np

from diffrast import _check
from diffrast.mesh import Mesh, flat_shaded


@_check.known_of_known
def cube(*, flat: bool = True) -> Mesh:
    """Cube with corners (±1, ±1, ±1): edges of length 2, 12 triangles."""
    corners = [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    squares = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return _solid(np.array(corners), np.array(squares), flat)


@_check.known_of_known
def tetrahedron(*, flat: bool = True) -> Mesh:
    """Tetrahedron on four corners of the cube: edges of length 2√2."""
    corners = [[1, -1, -1], [-1, 1, -1], [1, 1, 1], [-1, -1, 1]]
    return _solid(np.array(corners), np.array([[0, 1, 2], [1, 3, 2], [0, 2, 3], [0, 3, 1]]), flat)


@_check.known_of_known
def octahedron(*, flat: bool = True) -> Mesh:
    """Octahedron with corners ±1 on the axes: edges of length √2."""
    corners = [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1], [0, 0, 1]]
    side = np.arange(4)
    following = (side + 1) % 4
    upper = np.stack([side, following, np.full(4, 5)], axis=1)
    lower = np.stack([following, side, np.full(4, 4)], axis=1)
    return _solid(np.array(corners), np.concatenate([upper, lower]), flat)


@_check.known_of_known
def icosahedron(*, flat: bool = True) -> Mesh:
    """Icosahedron in the unit sphere, two corners on the z axis: 20 faces."""
    return _solid(*icosahedron_arrays(), flat)


@_check.known_of_known
def dodecahedron(*, flat: bool = True) -> Mesh:
    """Dodecahedron in the unit sphere, the dual of `icosahedron`: 12 pentagons, 36 triangles."""
    corners, triangles = icosahedron_arrays()
    centres = corners[triangles].sum(axis=1)
    # One pentagon round each corner of the icosahedron; its faces come in four rings of five.
    top, above, below, bottom = np.arange(20).reshape(4, 5)
    upper = [top, np.roll(top, 1), np.roll(above, 1), np.roll(below, 1), above]
    lower = [above, np.roll(below, 1), np.roll(bottom, 1), bottom, below]
    rings = [top[None], np.stack(upper, axis=1), np.stack(lower, axis=1), bottom[None, ::-1]]
    unit = centres / np.linalg.norm(centres, axis=1, keepdims=True)
    return _solid(unit, np.concatenate(rings), flat)


@_check.known_of_known
def buckyball(*, flat: bool = True) -> Mesh:
    """Truncated icosahedron in the unit sphere: 12 pentagons, 20 hexagons, 116 triangles.

    Its corners are the points that part each edge of an icosahedron in three (Van Houdt 17).
    """
    corners, triangles = icosahedron_arrays()
    count = len(corners)
    start, end = triangles, np.roll(triangles, -1, axis=1)
    # The corner on edge (a, b) that is nearer to a has number a * count + b.
    places = np.unique(start * count + end)
    nearer, farther = places // count, places % count
    points = (2 * corners[nearer] + corners[farther]) / 3
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    near_start, near_end = (
        np.searchsorted(places, a * count + b) for a, b in ((start, end), (end, start))
    )
    hexagons = np.stack([near_start, near_end], axis=2).reshape(-1, 6)
    # Round a corner a of the icosahedron, from the edge towards b to the next one that way.
    following = np.zeros((count, count), int)
    following[start, end] = np.roll(triangles, 1, axis=1)
    rim = [triangles[np.argmax(triangles == a) // 3] for a in range(count)]
    first = [np.roll(face, -int(np.argmax(face == a)))[1] for a, face in enumerate(rim)]
    around = [np.array(first)]
    for _ in range(4):
        around.append(following[np.arange(count), around[-1]])
    pentagons = np.searchsorted(
        places, np.arange(count)[:, None] * count + np.stack(around, axis=1)
    )
    mesh = Mesh(vertices=points, faces=np.concatenate([_fans(pentagons), _fans(hexagons)]))
    return flat_shaded(mesh) if _check.flag("flat", flat) else mesh


def icosahedron_arrays() -> tuple[np.ndarray, np.ndarray]:
    """Corners (12, 3) on the unit sphere and faces (20, 3): pole, ring, ring, pole."""
    angle = np.arange(10) * np.pi / 5
    ring = np.stack([np.cos(angle), np.sin(angle), np.where(np.arange(10) % 2, -0.5, 0.5)], axis=1)
    pole = np.array([[0, 0, np.sqrt(5) / 2]])
    corners = np.concatenate([pole, ring[::2], ring[1::2], -pole]) * 2 / np.sqrt(5)
    side = np.arange(5)
    upper, lower = 1 + side, 6 + side
    upper_next, lower_next = np.roll(upper, -1), np.roll(lower, -1)
    faces = [
        [np.full(5, 0), upper, upper_next],
        [upper, lower, upper_next],
        [upper_next, lower, lower_next],
        [np.full(5, 11), lower_next, lower],
    ]
    return corners, np.concatenate([np.stack(ring_faces, axis=1) for ring_faces in faces])


def _solid(corners: np.ndarray, polygons: np.ndarray, flat: bool) -> Mesh:
    """Cut equal convex polygons into fans."""
    mesh = Mesh(vertices=corners, faces=_fans(polygons))
    return flat_shaded(mesh) if _check.flag("flat", flat) else mesh


def _fans(polygons: np.ndarray) -> np.ndarray:
    """Triangles (faces, 3) of convex polygons with equally many corners."""
    sides = range(1, polygons.shape[1] - 1)
    return np.stack([polygons[:, [0, k, k + 1]] for k in sides], axis=1).reshape(-1, 3)
