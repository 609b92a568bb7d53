"""The truth that the renderer is judged by: a triangle rasteriser and a Phong shader in float64.

Plain NumPy, one triangle after another, as many samples a pixel as asked for. Nothing here is
fast, and nothing depends on the library.

A face with the corners v_0, v_1, v_2, each v = (x, y, w) in clip space, is the set of sums
s_0 v_0 + s_1 v_1 + s_2 v_2 with weights s >= 0. The sample at p = (x_ndc, y_ndc, 1) sees it where
such a sum is a positive multiple of p. Scaled to be p itself, Cramer's rule gives the weights,

    s_0 = p . (v_1 x v_2) / det(v_0, v_1, v_2), and cyclically;

the sample is inside if no weight is negative. Since w is interpolated as any other attribute,

    1/w = s_0 + s_1 + s_2        z_ndc = s_0 z_0 + s_1 z_1 + s_2 z_2
    perspective-correct barycentrics = s / (s_0 + s_1 + s_2).

No vertex is ever divided by its w, so faces that pass behind the viewer need no clipping
(Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997).

Conventions: OpenGL clip space (NDC z from -1, near, to 1, far); column vectors; images
(height, width), row 0 at the top, the centre of pixel (row i, column j) at x = j + 0.5,
y = i + 0.5; faces counter-clockwise from outside; light directions point the way light travels.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

SAMPLES_AT_ONCE = 2**19
# Edges are followed to three times the image's half size: one that leaves the image still passes.
FRUSTUM = np.array(
    [[0, 0, 1, 1], [0, 0, -1, 1], [1, 0, 0, 3], [-1, 0, 0, 3], [0, 1, 0, 3], [0, -1, 0, 3]], float
)


@dataclass(frozen=True)
class Fragments:
    """What each sample sees; every array is (height * samples, width * samples, ...).

    `face` is -1 on the background, where the other values are zero. `barycentrics` are
    perspective-correct and `inverse_depth` is 1/w. `edge_distance` is the distance in pixels to
    the nearest edge, cut off at one pixel. `depth_gap` is the difference between the two nearest
    surfaces: of 1/w relative to the nearer one, or under parallel projection of z_ndc relative to
    the depth range; infinite with fewer than two surfaces. A sample with both large is no
    matter of rounding.
    """

    face: np.ndarray
    barycentrics: np.ndarray
    inverse_depth: np.ndarray
    edge_distance: np.ndarray
    depth_gap: np.ndarray


def area_of(corners):
    """Of a polygon."""
    x, y = np.moveaxis(np.asarray(corners, float), -1, 0)
    return abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2


def rasterize(
    positions_clip, faces, height, width, cull_backfaces=False, samples=1, offset=(0.5, 0.5)
) -> Fragments:
    """Find the nearest face at each of samples x samples points a pixel, and its barycentrics.

    The sample points are a regular grid; `offset` = (x, y) is their place inside their own
    cell of it. Where faces tie in depth, the first one is seen.
    """
    positions = np.asarray(positions_clip, np.float64)
    x = 2 * sample_positions(width, samples, offset[0]) / width - 1
    y = 1 - 2 * sample_positions(height, samples, offset[1]) / height
    face, barycentrics, inverse_depth, gap = _visible(positions, faces, x, y, cull_backfaces)
    distance = edge_distance(positions, faces, height, width, samples, offset)
    return Fragments(face, barycentrics, inverse_depth, distance, gap)


def sample_positions(size, samples, offset=0.5) -> np.ndarray:
    """Return the size * samples coordinates, in pixels, of the samples along an image side."""
    return (np.arange(size * samples) + offset) / samples


def _visible(positions_clip, faces, x, y, cull_backfaces):
    """Resolve the faces at the samples (y[row], x[column]) in NDC: x ascending, y descending."""
    corners = positions_clip[np.asarray(faces).reshape(-1, 3)]  # (F, 3, 4)
    vectors = corners[..., [0, 1, 3]]
    normals = np.cross(vectors[:, [1, 2, 0]], vectors[:, [2, 0, 1]])
    determinant = np.sum(vectors[:, 0] * normals[:, 0], axis=-1)
    parallel = len(np.unique(corners[..., 3])) == 1
    first, last = _boxes(vectors, x, y)
    facing = determinant > 0 if cull_backfaces else determinant != 0

    shape = (len(y), len(x))
    face, barycentrics = np.full(shape, -1), np.zeros((*shape, 3))
    inverse_depth = np.zeros(shape)
    nearest, second = np.full(shape, -np.inf), np.full(shape, -np.inf)
    for index in np.flatnonzero(facing & np.all(first < last, axis=1)):
        box = tuple(slice(*ends) for ends in zip(first[index], last[index], strict=True))
        # In this order of operations the two owners of an edge differ in sign only: no cracks.
        a, b, c = normals[index].T
        sample_x, sample_y = x[None, box[1], None], y[box[0], None, None]
        weights = (a * sample_x + b * sample_y + c) / determinant[index]  # (rows, columns, 3)
        inverse_w, depth = weights.sum(-1), weights @ corners[index, :, 2]
        inside = np.all(weights >= 0, axis=-1) & (np.abs(depth) <= 1)
        nearness = np.where(inside, -depth if parallel else inverse_w, -np.inf)

        seen = nearness > nearest[box]
        second[box] = np.maximum(second[box], np.minimum(nearness, nearest[box]))
        nearest[box] = np.maximum(nearest[box], nearness)
        face[box][seen] = index
        inverse_depth[box][seen] = inverse_w[seen]
        barycentrics[box][seen] = weights[seen] / inverse_w[seen, None]
    two = np.isfinite(second)
    gap = np.full(shape, np.inf)
    gap[two] = (nearest[two] - second[two]) / (2.0 if parallel else nearest[two])
    return face, barycentrics, inverse_depth, gap


def _boxes(vectors, x, y):
    """Ranges [first, last) of (row, column) that hold each face: everything if w <= 0 somewhere."""
    w = vectors[..., 2:]
    in_front = np.all(w > 0, axis=(1, 2))
    ndc = vectors[..., :2] / np.where(in_front[:, None, None], w, 1.0)
    low = np.where(in_front[:, None], ndc.min(axis=1) - 1e-12, -np.inf)  # wider than rounding
    high = np.where(in_front[:, None], ndc.max(axis=1) + 1e-12, np.inf)
    first = [np.searchsorted(-y, -high[:, 1], "left"), np.searchsorted(x, low[:, 0], "left")]
    last = [np.searchsorted(-y, -low[:, 1], "right"), np.searchsorted(x, high[:, 0], "right")]
    return np.stack(first, axis=-1), np.stack(last, axis=-1)


def edge_distance(
    positions_clip, faces, height, width, samples=1, offset=(0.5, 0.5), reach=1.0
) -> np.ndarray:
    """Return each sample's distance in pixels to the nearest edge of any face, at most `reach`.

    Counted are the edges inside the frustum of all faces, hidden and culled ones too, and the
    lines along which the near and far planes cut them.
    """
    x = sample_positions(width, samples, offset[0])
    y = sample_positions(height, samples, offset[1])
    distance = np.full((len(y), len(x)), float(reach))
    corners = np.asarray(positions_clip, np.float64)[np.asarray(faces).reshape(-1, 3)]
    for polygon in _clipped(corners):
        points = (polygon[:, :2] / polygon[:, 3:] * [1, -1] + 1) * [width / 2, height / 2]
        for start, end in zip(points, np.roll(points, -1, axis=0), strict=True):
            low, high = np.minimum(start, end) - reach, np.maximum(start, end) + reach
            rows = slice(*np.searchsorted(y, [low[1], high[1]]))
            columns = slice(*np.searchsorted(x, [low[0], high[0]]))
            away = _segment_distance(x[None, columns], y[rows, None], start, end)
            distance[rows, columns] = np.minimum(distance[rows, columns], away)
    return distance


def _segment_distance(x, y, start, end) -> np.ndarray:
    along = end - start
    from_x, from_y = x - start[0], y - start[1]
    fraction = (from_x * along[0] + from_y * along[1]) / (along @ along or 1.0)
    fraction = np.clip(fraction, 0, 1)
    return np.hypot(from_x - fraction * along[0], from_y - fraction * along[1])


def _clipped(corners) -> Iterator[np.ndarray]:
    """Yield the part of each face that is inside the frustum, a (n, 4) polygon with w > 0."""
    outside = np.any(corners @ FRUSTUM.T < 0, axis=1)  # (F, planes)
    for polygon, planes in zip(corners, outside, strict=True):
        for plane in FRUSTUM[planes]:
            polygon = clip_polygon(polygon, plane)
        polygon = polygon[polygon[:, 3] > 0]  # w = 0 is left only at the very eye
        if len(polygon):
            yield polygon


def clip_polygon(polygon, plane) -> np.ndarray:
    """Keep the part with point . plane >= 0 (Sutherland and Hodgman, 1974)."""
    kept = []
    for here, there in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        at_here, at_there = here @ plane, there @ plane
        if at_here >= 0:
            kept.append(here)
        if (at_here >= 0) != (at_there >= 0):
            kept.append(here + (there - here) * (at_here / (at_here - at_there)))
    return np.array(kept).reshape(-1, polygon.shape[1])


# In exact arithmetic: what is on an edge, and who owns it.


def exact_location(positions_clip, faces, height, width) -> np.ndarray:
    """Where each pixel centre lies: (F, H, W) of 1 inside, 0 on the outline, -1 outside the face.

    Floating-point numbers are rational, so this is exact for positions of any float dtype. Depth
    is not looked at. Faces without area are outside everywhere.
    """
    edges = _exact_edges(positions_clip, faces)
    location = np.full((len(edges), height, width), -1)
    for row, column, x, y in _exact_centers(height, width):
        for index, lines in enumerate(edges):
            nearest = min((a * x + b * y + c for a, b, c in lines), default=-1)
            location[index, row, column] = (nearest > 0) - (nearest < 0)
    return location


def exact_owned(positions_clip, faces, height, width) -> np.ndarray:
    """Which faces own each pixel centre, (F, H, W) bool, by the top-left rule.

    The rule is what follows from moving every centre to the right by a distance smaller than
    any number, and down by one again infinitely smaller: then none lies on an edge.
    """
    edges = _exact_edges(positions_clip, faces)
    owned = np.zeros((len(edges), height, width), bool)
    for row, column, x, y in _exact_centers(height, width):
        for index, lines in enumerate(edges):
            inside = ((a * x + b * y + c, a, -b) > (0, 0, 0) for a, b, c in lines)
            owned[index, row, column] = bool(lines) and all(inside)
    return owned


def _exact_centers(height, width) -> Iterator[tuple[int, int, Fraction, Fraction]]:
    for row, column in np.ndindex(height, width):
        yield row, column, Fraction(2 * column + 1, width) - 1, 1 - Fraction(2 * row + 1, height)


def _exact_edges(positions_clip, faces) -> list[list[np.ndarray]]:
    """For each face three lines (a, b, c) with a x_ndc + b y_ndc + c > 0 inside; none if flat."""
    numbers = np.asarray(positions_clip)[:, [0, 1, 3]]
    vectors = np.array([[Fraction(float(x)) for x in point] for point in numbers], dtype=object)
    edges = []
    for face in np.asarray(faces).tolist():
        a, b, c = vectors[face]
        lines = [_exact_cross(b, c), _exact_cross(c, a), _exact_cross(a, b)]
        determinant = a @ lines[0]
        sign = (determinant > 0) - (determinant < 0)
        edges.append([sign * line for line in lines] if sign else [])
    return edges


def _exact_cross(a, b) -> np.ndarray:
    return a[[1, 2, 0]] * b[[2, 0, 1]] - a[[2, 0, 1]] * b[[1, 2, 0]]


# Cameras.


def look_at(eye, target, up) -> np.ndarray:
    """World to eye space: the camera at the origin looks along -z, x right and y up."""
    eye, target, up = (np.asarray(v, np.float64) for v in (eye, target, up))
    back = normalize(eye - target)
    right = normalize(np.cross(up, back))
    rotation = np.stack([right, np.cross(back, right), back])
    return np.block([[rotation, -(rotation @ eye)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def perspective(fov_y, aspect, near, far) -> np.ndarray:
    """Eye to clip space; `fov_y` in radians is the whole vertical angle."""
    scale = 1 / np.tan(fov_y / 2)
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1], matrix[3, 2] = scale / aspect, scale, -1
    matrix[2, 2:] = (near + far) / (near - far), 2 * near * far / (near - far)
    return matrix


def orthographic(height, aspect, near, far) -> np.ndarray:
    """Eye to clip space by parallel projection of a window `height` units high."""
    matrix = np.diag([2 / (height * aspect), 2 / height, 2 / (near - far), 1.0])
    matrix[2, 3] = (near + far) / (near - far)
    return matrix


def towards_viewer(clip_from_world, points) -> np.ndarray:
    """Return unit vectors from points (N, 3) back along the rays of sight, for any 4x4 camera.

    All rays of sight meet in the homogeneous point that the rows x, y and w of the matrix map
    to zero: the eye, or a direction under parallel projection.
    """
    rows = clip_from_world[[0, 1, 3]]
    eye = np.array([(-1) ** k * np.linalg.det(np.delete(rows, k, axis=1)) for k in range(4)])
    if eye[3] != 0:
        return normalize(eye[:3] / eye[3] - points)
    depth_along = clip_from_world[2, :3] @ eye[:3] / clip_from_world[3, 3]
    return np.broadcast_to(normalize(-np.sign(depth_along) * eye[:3]), np.shape(points))


# Shading.


def render_phong(
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
    samples=4,
    shading="phong",
    specular="phong",
    cull_backfaces=False,
) -> np.ndarray:
    """Render linear RGB (height, width, 3), each pixel the mean of samples x samples points.

    No shadows, no clamping, and normals are not turned towards the viewer.

    Args:
        positions_world, normals: (V, 3). faces: (F, 3).
        view, projection: 4x4, world to eye and eye to clip space.
        lights: dicts with "type" "ambient", "directional" ("direction" of travel), "point"
            ("position") or "spot" ("position", "direction", "cutoff"), and RGB "ambient",
            "diffuse", "specular", each zero unless given.
        material: dict of RGB "ambient", "diffuse", "specular" and "shininess". Each value may
            also be an array of one entry a face.
        background: RGB.
        shading: "phong" lights every sample with the interpolated normal, "flat" every sample
            with the face's normal, "gouraud" the corners, whose colours it interpolates.
        specular: "phong" (r . v) or "blinn" (n . h).
    """
    positions = np.asarray(positions_world, np.float64)
    clip_from_world = np.asarray(projection, np.float64) @ np.asarray(view, np.float64)
    positions_clip = np.pad(positions, ((0, 0), (0, 1)), constant_values=1) @ clip_from_world.T

    def light_points(points, normals, face) -> np.ndarray:
        to_viewer = towards_viewer(clip_from_world, points)
        return shade(points, normals, to_viewer, lights, _at_faces(material, face), specular)

    color_at = _shader(positions[faces], np.asarray(normals, float)[faces], shading, light_points)
    x = 2 * sample_positions(width, samples) / width - 1
    bands = -(-len(x) * height * samples // SAMPLES_AT_ONCE)
    image = []
    for rows in np.array_split(np.arange(height), min(bands, height)):
        y = 1 - 2 * (rows[0] + sample_positions(len(rows), samples)) / height
        face, barycentrics, _, _ = _visible(positions_clip, faces, x, y, cull_backfaces)
        colors = np.broadcast_to(np.asarray(background, float), (*face.shape, 3)).copy()
        covered = face >= 0
        colors[covered] = color_at(face[covered], barycentrics[covered])
        image.append(colors.reshape(len(rows), samples, width, samples, 3).mean(axis=(1, 3)))
    return np.concatenate(image)


def _shader(corners, corner_normals, shading, light_points) -> Callable[..., np.ndarray]:
    """Return colors (N, 3) as a function of faces (N,) and barycentrics (N, 3)."""

    def interpolate(values, barycentrics) -> np.ndarray:
        return np.einsum("nk,nkc->nc", barycentrics, values)

    def phong(face, barycentrics) -> np.ndarray:
        normals = normalize(interpolate(corner_normals[face], barycentrics))
        return light_points(interpolate(corners[face], barycentrics), normals, face)

    def flat(face, barycentrics) -> np.ndarray:
        a, b, c = np.moveaxis(corners[face], 1, 0)
        normals = normalize(np.cross(b - a, c - a))
        return light_points(interpolate(corners[face], barycentrics), normals, face)

    if shading == "gouraud":
        face_of_corner = np.repeat(np.arange(len(corners)), 3)
        points, normals = corners.reshape(-1, 3), normalize(corner_normals.reshape(-1, 3))
        corner_colors = light_points(points, normals, face_of_corner).reshape(-1, 3, 3)
        return lambda face, barycentrics: interpolate(corner_colors[face], barycentrics)
    return {"phong": phong, "flat": flat}[shading]


def shade(points, normals, to_viewer, lights, material, specular="phong") -> np.ndarray:
    """Phong's reflection of all lights at points (N, 3) with unit normals and viewer directions."""
    color = np.zeros(np.shape(points))
    for light in lights:
        strength = {k: np.asarray(light.get(k, 0.0)) for k in ("ambient", "diffuse", "specular")}
        color += material["ambient"] * strength["ambient"]
        if light["type"] == "ambient":
            continue
        to_light = _towards_light(light, points)
        if light["type"] == "spot":
            fade = spot_fade(light, to_light)[:, None]
            strength["diffuse"] = strength["diffuse"] * fade
            strength["specular"] = strength["specular"] * fade
        cosine = np.sum(normals * to_light, axis=-1, keepdims=True)
        if specular == "phong":
            reflected = 2 * cosine * normals - to_light
            highlight = np.sum(reflected * to_viewer, axis=-1, keepdims=True)
        else:
            halfway = normalize(to_light + to_viewer)
            highlight = np.sum(normals * halfway, axis=-1, keepdims=True)
        highlight = np.maximum(highlight, 0) ** material["shininess"] * (cosine > 0)
        color += material["diffuse"] * strength["diffuse"] * np.maximum(cosine, 0)
        color += material["specular"] * strength["specular"] * highlight
    return color


def _towards_light(light, points) -> np.ndarray:
    if light["type"] == "directional":
        return np.broadcast_to(-normalize(np.asarray(light["direction"], float)), points.shape)
    return normalize(np.asarray(light["position"], float) - points)


def spot_fade(light, to_light) -> np.ndarray:
    """1 - (1 - cos a) / (1 - cos cutoff) inside the cone of a spot light, 0 outside."""
    cosine = -to_light @ normalize(np.asarray(light["direction"], float))
    return np.maximum(1 - (1 - cosine) / (1 - np.cos(float(light["cutoff"]))), 0)


def lit(light, points, face, normals, positions, faces) -> np.ndarray:
    """Which points a light reaches, by casting a ray from each against every face.

    A face that turns away from the light, on the side that the shading's normals point to, is dark.

    Args:
        light: a dict as of `render_phong`, not an ambient one.
        points: (N, 3), on the faces (N,), with normals (N, 3).
        positions, faces: (V, 3), (F, 3) of everything that casts shadows.
    """
    positions, parallel = np.asarray(positions, float), light["type"] == "directional"
    corners = positions[np.asarray(faces)]
    plane = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if parallel:
        ray = np.broadcast_to(-np.asarray(light["direction"], float), points.shape)
        across = np.linalg.svd(ray[:1])[2][1:]  # two directions perpendicular to the light's

        def seen(p) -> np.ndarray:  # homogeneous coordinates in the light's picture
            return np.concatenate([p @ across.T, np.ones((*p.shape[:-1], 1))], axis=-1)

    else:
        position = np.asarray(light["position"], float)
        ray = position - points

        def seen(p) -> np.ndarray:
            return p - position

    vectors = seen(corners)
    edges = np.cross(vectors[:, [1, 2, 0]], vectors[:, [2, 0, 1]])
    turned = np.sum(plane[face] * ray, axis=1) * np.sum(plane[face] * normals, axis=1)
    free = turned > 0
    if light["type"] == "spot":
        free &= spot_fade(light, normalize(ray)) > 0
    size = np.abs(positions - positions.mean(axis=0)).max()
    for some in np.array_split(np.flatnonzero(free), max(1, np.sum(free) * len(faces) // 2**23)):
        first, second, third = (seen(points[some]) @ edges[:, k].T >= 0 for k in range(3))
        of, by = np.nonzero((first == second) & (second == third))
        point, to_light = points[some[of]], ray[some[of]]
        along = np.sum(plane[by] * to_light, axis=1)
        with np.errstate(all="ignore"):
            at = np.sum(plane[by] * (corners[by, 0] - point), axis=1) / along
        least = 1e-9 * size / np.linalg.norm(to_light, axis=1)
        stopped = (at > least) & (at < (np.inf if parallel else 1 - 1e-9)) & (by != face[some[of]])
        free[some[of[stopped]]] = False
    return free


def _at_faces(material, face) -> dict[str, np.ndarray]:
    """Material values of each sample's face: colours (N, 3) or (3,), shininess (N, 1) or ()."""
    values = {key: np.asarray(value, np.float64) for key, value in material.items()}
    for key in ("ambient", "diffuse", "specular"):
        values[key] = values[key][face] if values[key].ndim == 2 else values[key]
    if values["shininess"].ndim:
        values["shininess"] = values["shininess"][face, None]
    return values


def normalize(vectors) -> np.ndarray:
    """Scale vectors along the last axis to unit length; zero vectors stay zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
