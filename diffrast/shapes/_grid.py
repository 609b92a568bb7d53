"""Grids of quadrilaterals, the topology of every curved surface here."""

import numpy as np

from diffrast import _check


def grid_faces(columns: int, rows: int) -> np.ndarray:
    """Two triangles for each cell of a grid of (rows + 1) × (columns + 1) vertices, int32.

    Vertices are numbered row after row. Faces are counter-clockwise where the direction of
    growing column turns left into that of growing row; cells follow one another along a row.
    """
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
    quads = first[:, None] + np.array([0, 1, columns + 2, columns + 1])
    return split_quads(quads)


def split_quads(quads: np.ndarray) -> np.ndarray:
    """Cut quadrilaterals (n, 4) along their first diagonal: (2 n, 3), int32."""
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).astype(np.int32)


def grid_uvs(columns: int, rows: int) -> np.ndarray:
    """Texture coordinates of the grid's vertices: u along a row, v from row to row."""
    u, v = np.meshgrid(np.arange(columns + 1) / columns, np.arange(rows + 1) / rows)
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def unit_circle(segments: int) -> np.ndarray:
    """Points (cos, sin) at equal angles, the first one again at the end: (segments + 1, 2).

    First and last are equal to the bit, so that a surface closes over its texture's seam.
    """
    angle = 2 * np.pi * (np.arange(segments + 1) % segments) / segments
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def two_counts(name: str, value: int | tuple[int, ...]) -> tuple[int, int]:
    """One count for both directions, or one for each."""
    pair = value if isinstance(value, tuple) else (value, value)
    if len(pair) != 2:
        raise ValueError(f"{name}: wanted one integer or two, got {value}")
    return _check.positive_int(name, pair[0]), _check.positive_int(name, pair[1])
