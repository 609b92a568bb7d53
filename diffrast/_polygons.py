"""Polygons of any number of corners, and the triangles that they are cut into; on the host."""

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffrast import _check
from diffrast._topology import representatives


def join_indices(polygons: Sequence[Any] | np.ndarray, bound: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertex ids of all polygons end to end, and the number of corners of each.

    Raises:
        ValueError: for anything but lists of ids in [0, bound).
    """
    _check.iterable("polygons", polygons, "lists of vertex ids")
    try:
        lists = [np.asarray(polygon) for polygon in polygons]
    except ValueError as error:
        raise ValueError(f"polygons: wanted lists of vertex ids, got others ({error})") from error
    for number, ids in enumerate(lists):
        if ids.ndim != 1 or (ids.size and not np.issubdtype(ids.dtype, np.integer)):
            raise ValueError(f"polygons: wanted a list of vertex ids, got {ids} at {number}")
        if ids.size and (ids.min() < 0 or ids.max() >= bound):
            raise ValueError(
                f"polygons: wanted vertex ids in [0, {bound}), got {ids.tolist()} at {number}"
            )
    sizes = np.array([len(ids) for ids in lists], dtype=int)
    return np.concatenate([np.zeros(0, dtype=int), *lists]).astype(int), sizes


class Polygons(NamedTuple):
    """Polygons of any number of corners, end to end, with their unit normals."""

    corner: Int[np.ndarray, "corners"]  # vertex ids
    polygon: Int[np.ndarray, "corners"]  # position in the caller's list
    start: Int[np.ndarray, "polygons"]  # where each polygon begins
    size: Int[np.ndarray, "polygons"]
    normal: Float[np.ndarray, "polygons 3"]
    area: Float[np.ndarray, "polygons"]


def join_polygons(positions: np.ndarray, corner: np.ndarray, sizes: np.ndarray) -> Polygons:
    """Drop corners that repeat the next one's place, then polygons without area.

    The normal is Newell's: the direction of the area vector, which every corner has a say in.
    """
    polygon = np.repeat(np.arange(len(sizes)), sizes)
    place = representatives(positions)[corner]
    keep = place != place[_next(polygon)]
    corner, polygon = corner[keep], polygon[keep]
    if len(corner):
        area_vector, perimeter = _newell(positions, corner, polygon, len(sizes))
        area = np.linalg.norm(area_vector, axis=1)
        flat = area <= 16 * np.finfo(np.float64).eps * perimeter**2
        keep = ~flat[polygon]
        corner, polygon = corner[keep], polygon[keep]
    if not len(corner):
        raise ValueError("polygons: wanted at least one with three corners and an area, got none")
    ids, start, size = np.unique(polygon, return_index=True, return_counts=True)
    normal = area_vector[ids] / area[ids, None]
    return Polygons(corner, polygon, start, size, normal, area[ids])


def _next(polygon: np.ndarray) -> np.ndarray:
    """Index of the corner after each corner, round its polygon."""
    starts = np.flatnonzero(np.diff(polygon, prepend=-1))
    following = np.arange(1, len(polygon) + 1)
    following[np.append(starts, len(polygon))[1:] - 1] = starts
    return following


def _newell(
    positions: np.ndarray, corner: np.ndarray, polygon: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Area vector and perimeter of every polygon."""
    starts = np.flatnonzero(np.diff(polygon, prepend=-1))
    first = np.repeat(starts, np.diff(np.append(starts, len(polygon))))
    here, after = positions[corner], positions[corner[_next(polygon)]]
    origin = positions[corner[first]]
    area_vector, perimeter = np.zeros((count, 3)), np.zeros(count)
    area_vector[polygon[starts]] = (
        np.add.reduceat(np.cross(here - origin, after - origin), starts) / 2
    )
    perimeter[polygon[starts]] = np.add.reduceat(np.linalg.norm(after - here, axis=1), starts)
    return area_vector, perimeter


def triangulate(positions: np.ndarray, polygons: Polygons) -> np.ndarray:
    """Triangles as indices into `polygons.corner`, polygon after polygon, shape (faces, 3).

    A convex polygon becomes the fan round its first corner; others are cut ear by ear.
    """
    corner, polygon = polygons.corner, polygons.polygon
    following = _next(polygon)
    previous = np.argsort(following)
    index = np.repeat(np.arange(len(polygons.start)), polygons.size)
    here = positions[corner]
    turn = np.cross(here - here[previous], here[following] - here)
    is_left = np.sum(turn * polygons.normal[index], axis=1) > 0
    convex = np.logical_and.reduceat(is_left, polygons.start)

    concave = np.flatnonzero(~convex)
    return _cut(here, polygons.start, polygons.size, polygons.normal, concave)


def triangles_in_order(
    positions: Callable[[], np.ndarray], polygons: Sequence[Sequence[int]]
) -> np.ndarray:
    """Triangles (faces, 3) of lists of three vertex ids or more, two fewer than each has corners.

    They are indices into all lists end to end, polygon after polygon. A polygon becomes the fan
    round its first corner where that turns no triangle over; others are cut ear by ear. `positions`
    makes the places of vertices, and is called where a polygon has four corners or more.
    """
    size = np.array([len(ids) for ids in polygons], dtype=int)
    if not np.any(size > 3):
        return np.arange(np.sum(size)).reshape(-1, 3)
    places = positions()
    corner = np.array([*chain.from_iterable(polygons)], dtype=int)
    start, polygon = np.cumsum(size) - size, np.repeat(np.arange(len(size)), size)
    with np.errstate(invalid="ignore", over="ignore"):
        normal, _ = _newell(places, corner, polygon, len(size))
        here = places[corner]
        fans = _cut(here, start, size, normal, ())
        a, b, c = np.moveaxis(here[fans], 1, 0)
        of_fan = polygon[fans[:, 0]]
        turned_over = np.sum(np.cross(b - a, c - a) * normal[of_fan], axis=1) < 0
        return _cut(here, start, size, normal, np.unique(of_fan[turned_over]))


def _cut(
    here: np.ndarray, start: np.ndarray, size: np.ndarray, normal: np.ndarray, by_ears: Any
) -> np.ndarray:
    """Triangles of polygons with corners `here` end to end: fans, but for those cut ear by ear."""
    first = np.repeat(start, size - 2)
    triangles = np.stack([first, *(np.arange(len(first)) + k for k in (1, 2))], axis=1)
    triangles[:, 1:] += 2 * np.repeat(np.arange(len(size)), size - 2)[:, None]
    for number in by_ears:
        begin, end = start[number], start[number] + size[number]
        ears = clip_ears(_project(here[begin:end], normal[number]))
        triangles[begin - 2 * number : end - 2 * (number + 1)] = begin + np.array(ears)
    return triangles


def _project(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Drop the coordinate along which the plane is seen best, keeping the sense of rotation."""
    dropped = int(np.argmax(np.abs(normal)))
    kept = [(dropped + 1) % 3, (dropped + 2) % 3]
    return (points - points[0])[:, kept if normal[dropped] > 0 else kept[::-1]]


def clip_ears(outline: np.ndarray) -> Sequence[tuple[int, int, int]]:
    """Cut a simple counter-clockwise polygon (corners, 2) into triangles, ear by ear.

    An ear is a left turn whose triangle holds no other corner. Where an outline that crosses
    itself leaves none, the sharpest left turn is taken, so the cutting always ends.
    """
    remaining = np.arange(len(outline))
    triangles = []
    while len(remaining) > 3:
        here = outline[remaining]
        around = np.stack([np.roll(here, 1, axis=0), here, np.roll(here, -1, axis=0)], axis=1)
        turn = _cross(around[:, 1] - around[:, 0], around[:, 2] - around[:, 1])
        left = np.flatnonzero(turn > 0)
        ear = next((i for i in left if not _holds(around[i], here)), int(np.argmax(turn)))
        around_ear = np.roll(remaining, 1 - ear)[:3]
        triangles.append(_three(around_ear))
        remaining = np.delete(remaining, ear)
    return [*triangles, _three(remaining)]


def _holds(triangle: np.ndarray, points: np.ndarray) -> bool:
    """Whether a point other than its corners lies in the triangle or on its rim."""
    others = points[~np.any(np.all(points[:, None] == triangle, axis=2), axis=1)]
    sides = [_cross(triangle[k] - triangle[k - 1], others - triangle[k - 1]) for k in range(3)]
    return bool(np.any(np.all(np.stack(sides) >= 0, axis=0)))


def _three(ids: np.ndarray) -> tuple[int, int, int]:
    return int(ids[0]), int(ids[1]), int(ids[2])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
