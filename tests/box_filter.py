"""The truth under a box filter: every pixel the mean of the shaded scene over the pixel's square.

Float64 and NumPy only. Each row of pixels is cut by jittered lines, and along each line the
integral is exact but for the shading: the ends of all faces' spans and the pixel borders cut the
line into intervals with one nearest face each, and Gauss's rule integrates its colour. An image is
therefore a continuous function of the scene, and as the lines stay where they are from call to
call, so are differences of images: `gradient_reference` makes derivatives of them.

Faces are clipped at the near and far planes, so that every corner left has w > 0. Depth along a
line is compared by 1/w, which is affine on the screen (by -z_ndc under parallel projection).
A light with "shadow": True casts hard shadows, whose ends `box_shadow` finds on every line.
Conventions and shading are those of `reference`.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from box_shadow import Runs, Shadow, apart, expand, facing
from reference import _at_faces, _shader, clip_polygon, shade, towards_viewer

NEAR_FAR = np.array([[0.0, 0, 1, 1], [0, 0, -1, 1]])
SPANS_AT_ONCE = 2**15
NODES_AT_ONCE = 2**14


class _Pieces(NamedTuple):
    """What is left of the faces in front of the viewer, as triangles on the screen.

    `corners` (T, 3, 2) are in pixels, sorted by y; `nearness` (T, 3) are the coefficients of
    1/w or -z_ndc as a function of (x, y, 1); `face` (T,) is where a piece comes from.
    """

    corners: np.ndarray
    nearness: np.ndarray
    face: np.ndarray


def render_box(
    positions_world,
    normals,
    faces,
    view,
    projection,
    *,
    lights,
    material,
    background=(0.0, 0.0, 0.0),
    height,
    width,
    lines=32,
    nodes=3,
    shading="phong",
    specular="phong",
    cull_backfaces=False,
    piercing=False,
    upright=False,
    seed=0,
) -> np.ndarray:
    """Render linear RGB (height, width, 3), each pixel the mean over its square.

    The arguments that `reference.render_phong` has too mean the same.

    Args:
        positions_world, normals, faces, view, projection: geometry and camera.
        lights, material, background, height, width, shading, specular, cull_backfaces: as there,
            but lights may also have "shadow": True.
        lines: lines of integration a row of pixels, one at a random height in each stratum.
        nodes: of Gauss's rule in each interval that has one face in one pixel.
        piercing: whether faces may intersect each other; without it an interval is given to the
            face that is nearest at its middle.
        upright: whether the lines run from top to bottom and `lines` counts those of a column:
            better for outlines that are nearly level, which level lines seldom meet.
        seed: of the lines' heights.
    """
    positions = np.asarray(positions_world, np.float64)
    faces = np.asarray(faces).reshape(-1, 3)
    clip_from_world = np.asarray(projection, np.float64) @ np.asarray(view, np.float64)
    positions_clip = np.pad(positions, ((0, 0), (0, 1)), constant_values=1) @ clip_from_world.T

    if upright:  # the image mirrored about its diagonal
        positions_clip = positions_clip[:, [1, 0, 2, 3]] * [-1, -1, 1, 1]
        height, width = width, height
    weights = pixel_weights(positions_clip[faces], height, width)
    pieces = _pieces(positions_clip[faces], weights, height, width, cull_backfaces, upright)
    y = _line_heights(height, lines, seed)

    corners, corner_normals = positions[faces], np.asarray(normals, float)[faces]

    def colors_of(lights, casting=False) -> Callable[..., np.ndarray]:
        def light_points(points, normals, face) -> np.ndarray:
            to_viewer = towards_viewer(clip_from_world, points)
            color = shade(points, normals, to_viewer, lights, _at_faces(material, face), specular)
            return color * facing(lights[0], corners, face, normals)[:, None] if casting else color

        return _shader(corners, corner_normals, shading, light_points)

    everywhere, casting = apart(lights)
    layers = [(colors_of(everywhere), lambda runs: runs)]
    for light in casting:
        layers.append((colors_of([light], True), Shadow(light, corners, weights, y).lit))
    image = np.zeros((3, height * width))
    gauss, gauss_weights = np.polynomial.legendre.leggauss(nodes)
    rule = (gauss + 1) / 2, gauss_weights / (2 * lines)
    for found in _visible_runs(pieces, y, width, piercing):
        empty = found.face < 0
        bare = Runs(*(column[empty] for column in found))
        area = np.bincount(_pixels(bare, lines, width), bare.end - bare.start, height * width)
        image += np.asarray(background, float)[:, None] * (area / lines)
        seen = Runs(*(column[~empty] for column in found))
        for color_at, shone_at in layers:
            shone = shone_at(seen)
            pixel = _pixels(shone, lines, width)
            count = len(pixel)
            for some in np.array_split(np.arange(count), -(-count * nodes // NODES_AT_ONCE) or 1):
                line, start, end, face = (column[some] for column in shone)
                length = (end - start)[:, None]
                x = (start[:, None] + length * rule[0]).ravel()
                index = np.repeat(face, nodes)
                a, b, c = np.moveaxis(weights[index], -1, 0)
                s = a * x[:, None] + b * np.repeat(y[line], nodes)[:, None] + c
                colors = color_at(index, s / s.sum(axis=-1, keepdims=True))
                colors = np.einsum("nkc,nk->cn", colors.reshape(-1, nodes, 3), length * rule[1])
                for channel in range(3):
                    image[channel] += np.bincount(pixel[some], colors[channel], height * width)
    image = np.moveaxis(image.reshape(3, height, width), 0, -1)
    return (np.swapaxes(image, 0, 1) if upright else image).copy()


def _pixels(runs, lines, width) -> np.ndarray:
    column = np.minimum((runs.start + runs.end) / 2, width - 0.5).astype(int)
    return runs.line // lines * width + column


def _line_heights(height, lines, seed) -> np.ndarray:
    """Ascending heights, one a stratum; two strata mirror each other, so that ramps are exact."""
    jitter = np.random.default_rng(seed).random((height * lines + 1) // 2)
    jitter = np.stack([jitter, 1 - jitter], axis=1).ravel()[: height * lines]
    return (np.arange(height * lines) + jitter) / lines


def pixel_weights(corners_clip, height, width) -> np.ndarray:
    """Barycentrics over w of faces (F, 3, 4) by pixel coordinates (x, y, 1): (F, 3, 3).

    Faces seen exactly edge-on have zeros.
    """
    vectors = corners_clip[..., [0, 1, 3]]
    edges = np.cross(vectors[:, [1, 2, 0]], vectors[:, [2, 0, 1]])
    determinant = np.sum(vectors[:, 0] * edges[:, 0], axis=-1)[:, None, None]
    edges = np.where(determinant != 0, edges / np.where(determinant != 0, determinant, 1), 0)
    ndc_from_pixel = np.array([[2 / width, 0, -1], [0, -2 / height, 1], [0, 0, 1]])
    return edges @ ndc_from_pixel


def _pieces(corners_clip, weights, height, width, cull_backfaces, mirrored) -> _Pieces:
    vectors = corners_clip[..., [0, 1, 3]]
    determinant = np.linalg.det(vectors)
    determinant = -determinant if mirrored else determinant
    facing = determinant > 0 if cull_backfaces else determinant != 0
    beyond = corners_clip @ NEAR_FAR.T < 0  # (F, 3, planes)
    whole = np.flatnonzero(facing & ~np.any(beyond, axis=(1, 2)))
    cut = np.flatnonzero(facing & np.any(beyond, axis=(1, 2)) & ~np.any(beyond.all(axis=1), axis=1))
    face, corners = [whole], [corners_clip[whole]]
    for index in cut:
        polygon = corners_clip[index]
        for plane in NEAR_FAR:
            polygon = clip_polygon(polygon, plane)
        polygon = polygon[polygon[:, 3] > 0]
        fan = [polygon[[0, k, k + 1]] for k in range(1, len(polygon) - 1)]
        face.append(np.full(len(fan), index))
        corners.append(np.reshape(fan, (-1, 3, 4)))
    face, corners = np.concatenate(face), np.concatenate(corners)

    parallel = len(np.unique(corners_clip[..., 3])) == 1
    values = -corners_clip[..., 2] if parallel else np.ones(corners_clip.shape[:2])
    nearness = np.einsum("fk,fkc->fc", values, weights)[face]
    screen = (corners[..., :2] / corners[..., 3:] * [1, -1] + 1) * [width / 2, height / 2]
    order = np.argsort(screen[..., 1], axis=1, kind="stable")
    screen = np.take_along_axis(screen, order[..., None], axis=1)
    inside = (screen[..., 0].max(axis=1) > 0) & (screen[..., 0].min(axis=1) < width)
    inside &= (screen[:, 2, 1] > 0) & (screen[:, 0, 1] < height)
    return _Pieces(screen[inside], nearness[inside], face[inside])


def _visible_runs(pieces, y, width, piercing) -> Iterator[Runs]:
    """Yield runs of one face, -1 for none, in one pixel, by batches."""
    first = np.searchsorted(y, pieces.corners[:, 0, 1], "left")
    last = np.searchsorted(y, pieces.corners[:, 2, 1], "left")
    active = np.cumsum(np.bincount(first, minlength=len(y) + 1))
    active -= np.cumsum(np.bincount(last, minlength=len(y) + 1))
    load = np.cumsum(active[: len(y)] + width // 2)
    for lines in np.split(np.arange(len(y)), np.flatnonzero(np.diff(load // SPANS_AT_ONCE)) + 1):
        begin, stop = lines[0], lines[-1] + 1
        index = np.flatnonzero((first < stop) & (last > begin))
        low = np.maximum(first[index], begin)
        owner, offset = expand(np.minimum(last[index], stop) - low)
        yield _batch(pieces, index[owner], low[owner] + offset, lines, y, width, piercing)


def _batch(pieces, index, line, lines, y, width, piercing) -> Runs:
    """Resolve the spans of pieces `index` on `line`, for the lines `lines`."""
    start, end = _span_ends(pieces.corners[index], y[line])
    start, end = np.maximum(start, 0.0), np.minimum(end, width)
    kept = start < end
    index, line, start, end = index[kept], line[kept], start[kept], end[kept]
    slope, level, constant = pieces.nearness[index].T
    level = level * y[line] + constant

    # Cut every line at the ends of spans and at the borders of pixels.
    stride = 2.0 * width + 2
    border = np.repeat(lines - lines[0], width + 1) * stride + np.tile(
        np.arange(width + 1), len(lines)
    )
    base = (line - lines[0]) * stride
    keys = [base + start, base + end, border]
    if piercing:
        keys.append(_crossings(base, start, end, slope, level))
    keys = np.concatenate(keys)
    order = np.argsort(keys)
    rank = np.empty(len(keys), np.int64)
    rank[order] = np.arange(len(keys))
    cuts = keys[order]
    row = (cuts[:-1] // stride).astype(np.int64)
    left = cuts[:-1] - row * stride
    right = cuts[1:] - row * stride  # beyond the width after a line's last cut

    # The nearest face in the middle of each interval.
    middle = (left + right) / 2
    low = rank[: len(index)]
    owner, offset = expand(np.maximum(rank[len(index) : 2 * len(index)] - low, 0))
    interval = low[owner] + offset
    near = slope[owner] * middle[interval] + level[owner]
    best = np.full(len(middle), -np.inf)
    np.maximum.at(best, interval, near)
    won = np.flatnonzero(near == best[interval])[::-1]  # the first of equals is written last
    face = np.full(len(middle), -1)
    face[interval[won]] = pieces.face[index[owner[won]]]

    # Join what one face has in one pixel.
    kept = np.flatnonzero((right > left) & (left < width))
    row, left, right, face = row[kept], left[kept], right[kept], face[kept]
    cell = np.floor((left + right) / 2)
    new = (np.diff(row) != 0) | (np.diff(cell) != 0) | (np.diff(face) != 0)
    opens = np.concatenate([[True], new]) if len(row) else new
    closes = np.concatenate([new, [True]]) if len(row) else new
    return Runs(row[opens] + lines[0], left[opens], right[closes], face[opens])


def _span_ends(corners, y) -> tuple[np.ndarray, np.ndarray]:
    """Where lines at heights y enter and leave triangles whose corners are sorted by y."""
    a, b, c = np.moveaxis(corners, 1, 0)
    upper = (y < b[:, 1])[:, None]
    one = _edge_x(a, c, y)
    other = _edge_x(np.where(upper, a, b), np.where(upper, b, c), y)
    return np.minimum(one, other), np.maximum(one, other)


def _edge_x(high, low, y) -> np.ndarray:
    rise = low[:, 1] - high[:, 1]
    fraction = (y - high[:, 1]) / np.where(rise > 0, rise, 1.0)
    return high[:, 0] + fraction * (low[:, 0] - high[:, 0])


def _crossings(base, start, end, slope, level) -> np.ndarray:
    """Keys (`base` + x) of the points at which two spans on one line are equally near."""
    order = np.argsort(base + start)
    base, start, end, slope, level = (v[order] for v in (base, start, end, slope, level))
    after = np.arange(len(base)) + 1
    counts = np.maximum(np.searchsorted(base + start, base + end, "left") - after, 0)
    i, offset = expand(counts)
    j = after[i] + offset
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (level[j] - level[i]) / (slope[i] - slope[j])
        inside = (x > np.maximum(start[i], start[j])) & (x < np.minimum(end[i], end[j]))
    return base[i[inside]] + x[inside]
