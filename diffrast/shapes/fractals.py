"""Fractals in space: copies of a solid at its own corners, and the Menger sponge (FEATURES G4).

Van Houdt 17.
"""

import itertools

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from diffrast import _check
from diffrast.mesh import Mesh, flat_shaded, weld

_MOST_FACES = 1 << 24


@_check.known_of_known
def fractal(mesh: Mesh, iterations: int, scale: ArrayLike = 3.0) -> Mesh:
    """Replace a solid by smaller ones at its corners, some times over.

    Each step replaces every solid by h copies, `scale` times smaller, the j-th of which has its
    j-th corner where the large one has it; h is the number of corners at different places, so i
    steps make h^i copies. The source uses scales of 3 for the cube, 2 for octahedron and
    tetrahedron, 2 + (1 + √5)/2 for the dodecahedron and 1 + 3 (1 + √5)/2 for the buckyball.

    Differentiable in the vertices and in the scale.

    Args:
        mesh: centred at the origin. Corner-split meshes do: corners at one place count as one.
            While its vertices are being traced each of them counts.
        iterations: number of steps i; 0 gives the mesh.
        scale: how much smaller each step's copies are, above 1.

    Raises:
        ValueError: for more than 2^24 faces.
    """
    _check.instance_of("mesh", mesh, Mesh)
    iterations = _check.positive_int("iterations", iterations, minimum=0, maximum=24)
    scale = _check.real_number("scale", scale, above=1.0)
    vertices = mesh.vertices
    corners = np.arange(vertices.shape[0])
    if _check.is_concrete(vertices):
        corners = np.unique(np.asarray(weld(vertices)))
    copies = len(corners) ** iterations
    if copies * mesh.faces.shape[0] > _MOST_FACES:
        raise ValueError(
            f"iterations: wanted at most {_MOST_FACES} faces, got {len(corners)}^{iterations}"
            f" copies of {mesh.faces.shape[0]}"
        )
    centres, size = jnp.zeros((1, 3), vertices.dtype), jnp.ones((), vertices.dtype)
    for _ in range(iterations):
        smaller = size / scale.astype(size.dtype)
        moved = centres[:, None] + (size - smaller) * vertices[corners]
        centres, size = moved.reshape(-1, 3), smaller
    count = vertices.shape[0]
    faces = mesh.faces + count * np.arange(copies, dtype=np.int32)[:, None, None]

    def repeated(values: ArrayLike | None) -> ArrayLike | None:
        return None if values is None else jnp.tile(values, (copies, 1))

    return Mesh(
        vertices=(centres[:, None] + size * vertices).reshape(-1, 3),
        faces=faces.reshape(-1, 3),
        normals=repeated(mesh.normals),
        uvs=repeated(mesh.uvs) if mesh.uv_faces is None else mesh.uvs,  # those of all copies
        uv_faces=repeated(mesh.uv_faces),
    )


@_check.known_of_known
def menger_sponge(level: int, *, interior: bool = False, flat: bool = True) -> Mesh:
    """Menger sponge with corners (±1, ±1, ±1): 20^level cubes, each 3^-level as large.

    A cube is parted into 27, of which the one in the middle and those in the middle of its faces
    are taken away; and so on with those that are left.

    Args:
        level: how often; 0 gives a cube, 3 the source's 8000 cubes.
        interior: keep faces between two cubes. Without them there are 4·20^level + 8·8^level
            triangles instead of 12·20^level, and the mesh bounds the solid.
        flat: each triangle has its own corners and the face's normal; else cubes share vertices
            and there are no normals.

    Raises:
        ValueError: for more than 2^24 faces.
    """
    level = _check.positive_int("level", level, minimum=0, maximum=24)
    interior, flat = _check.flag("interior", interior), _check.flag("flat", flat)
    if 12 * 20**level > _MOST_FACES:
        raise ValueError(f"level: wanted at most {_MOST_FACES} faces, got 12·20^{level}")
    side = 3**level
    middle = np.arange(side) // 3 ** np.arange(level)[:, None] % 3 == 1  # of each subdivision
    counts = middle[:, :, None, None].astype(np.int8)
    counts = counts + middle[:, None, :, None] + middle[:, None, None, :]
    solid = np.all(counts < 2, axis=0)
    squares = []
    for axis, forward in itertools.product(range(3), (False, True)):
        shown = solid.copy()
        if not interior:
            beyond = np.zeros_like(solid)
            here = [slice(None)] * 3
            there = [slice(None)] * 3
            here[axis], there[axis] = (
                (slice(None, -1), slice(1, None)) if forward else (slice(1, None), slice(None, -1))
            )
            beyond[tuple(here)] = solid[tuple(there)]
            shown &= ~beyond
        cell = np.argwhere(shown)
        around = np.zeros((4, 3), int)
        around[:, axis] = forward
        around[[1, 2], (axis + 1) % 3] = 1
        around[[2, 3], (axis + 2) % 3] = 1
        corners = cell[:, None] + (around if forward else around[::-1])
        squares.append(corners @ np.array([(side + 1) ** 2, side + 1, 1]))
    places, faces = np.unique(np.concatenate(squares), return_inverse=True)
    grid = np.stack(np.unravel_index(places, (side + 1,) * 3), axis=1)
    faces = faces.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    mesh = Mesh(vertices=2 * grid / side - 1, faces=faces)
    return flat_shaded(mesh) if flat else mesh
