"""The pictures of strained scenes in float64, and what of them float32 can be held to.

Plain NumPy, all scenes of a batch at once, independent of the library but for the matrices of its
camera. Samples at pixel centres, homogeneous edge functions (Olano and Greer 1997), the nearest
face by 1/w, Phong's shading.

Vertices in the picture are known to a part in 2^24 of their homogeneous coordinates, and snap to
1/1024 pixel. A pixel is *clear* where neither can change what is seen: no edge and no plane near
or far within `MARGIN` pixels and the rounding of its line, no second face within the rounding of
the depth, no light so near that rounding turns it. How far a clear colour may be off is found by
shaking: the picture is drawn again with every coordinate moved by some ulps, visible points and
viewer to opposite corners of that range, and what that changes, float32 cannot know.
"""

from typing import NamedTuple

import numpy as np
from stress_scenes import Parts, unit

EPSILON = float(np.finfo(np.float32).eps)
MARGIN = 2e-3  # pixels: vertices snap to within 0.0007, and their rounding adds to it
ROUNDINGS = 8.0  # in a line, in units of EPSILON times the sum of its terms' sizes
DEPTH = 1e-5  # relative difference of 1/w that tells which face is nearer
TOLERANCE = 2e-4  # of a colour, besides
UNKNOWN = 0.02  # change by shaking from which on a colour means nothing
AMBIENT, SPECULAR, SHININESS = 0.1, 0.3, 8.0
BACKGROUND = (0.1, 0.2, 0.3)
ATTENUATION = (0.5, 0.1, 0.05)  # at distances in units of the scene's size


class Cameras(NamedTuple):
    """Matrices in float64, one each scene."""

    view: np.ndarray
    projection: np.ndarray


class Reference(NamedTuple):
    """What should be seen.

    Attributes:
        image: (batch, size, size, 3).
        clear: (batch, size, size), whether rounding cannot change which face is seen.
        bound: (batch, size, size), how far colours of clear pixels may be off.
    """

    image: np.ndarray
    clear: np.ndarray
    bound: np.ndarray


class _Seen(NamedTuple):
    face: np.ndarray  # (batch, pixels), -1 for none
    weights: np.ndarray  # perspective-correct, (batch, pixels, 3)
    clear: np.ndarray


def reference(parts: Parts, cameras: Cameras, size: int) -> Reference:
    """Draw a batch of scenes."""
    with np.errstate(all="ignore"):
        given = {name: part.astype(np.float64) for name, part in parts.items() if name != "faces"}
        faces = parts["faces"]
        eye = np.einsum("brc,bvc->bvr", cameras.view, _homogeneous(given["vertices"]))
        viewer = -np.linalg.solve(cameras.view[:, :3, :3], cameras.view[:, :3, 3:])[..., 0]
        generator = np.random.default_rng(0)
        count = len(faces)

        def draw(shake: float, corner: np.ndarray) -> tuple[_Seen, np.ndarray]:
            def shaken(values: np.ndarray) -> np.ndarray:  # alike whatever a scene's place
                return values + shake * generator.uniform(-1, 1, values.shape[1:]) * np.abs(values)

            clip = np.einsum("brc,bvc->bvr", cameras.projection, shaken(eye))
            seen = _visible(shaken(clip), given["vertices"], faces, size)
            opposite = viewer - shake * corner * np.abs(viewer)
            return seen, _shade(given, faces, seen, opposite, shake * corner)

        seen, image = draw(0.0, np.zeros(3))
        clear, change = seen.clear, np.zeros(seen.face.shape)
        for corner in np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(-1, 3):
            other, other_image = draw(4 * EPSILON, corner)
            clear = clear & (other.face == seen.face)
            change = np.maximum(change, np.abs(other_image - image).max(axis=-1))
    known, bound = held_to(image, change)
    clear &= known
    square = (count, size, size)
    return Reference(image.reshape(*square, 3), clear.reshape(square), bound.reshape(square))


def held_to(image: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels mean something, and how far these may be off.

    `change`, (...), is what shaking changes of `image`, (..., 3).
    """
    return change <= UNKNOWN, TOLERANCE * (1 + np.abs(image).max(axis=-1)) + 8 * change


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)


def _at(values: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Values (batch, V, ...) at the corners (batch, ...) of faces."""
    return values[np.arange(len(values)).reshape(-1, *[1] * (faces.ndim - 1)), faces]


def _visible(clip: np.ndarray, positions: np.ndarray, faces: np.ndarray, size: int) -> _Seen:
    """Which face is seen at the centre of each pixel."""
    corners = _at(clip, faces)  # (batch, F, 3, 4)
    vectors, depths = corners[..., [0, 1, 3]], corners[..., 2]
    normals = np.cross(vectors[:, :, [1, 2, 0]], vectors[:, :, [2, 0, 1]])
    sizes = _cross_size(vectors[:, :, [1, 2, 0]], vectors[:, :, [2, 0, 1]])
    determinant = np.sum(vectors[:, :, 0] * normals[:, :, 0], axis=-1)
    drawn = _first_of_their_kind(faces) & ~_without_area(_at(positions, faces))
    determinant[~drawn] = 0
    w = vectors[..., 2]

    # Three edges, near and far: all not negative inside.
    limits = [np.sum(normals * s[..., None], axis=2) for s in (w + depths, w - depths)]
    limit_size = np.sum(sizes * (np.abs(w) + np.abs(depths))[..., None], axis=2)
    lines = np.concatenate([normals, np.stack(limits, axis=2)], axis=2)
    lines = lines * np.sign(determinant)[..., None, None]
    line_sizes = np.concatenate([sizes, np.stack([limit_size] * 2, axis=2)], axis=2)
    centre = (2 * np.arange(size) + 1) / size - 1
    pixel = np.stack([*np.meshgrid(centre, -centre), np.ones((size, size))], axis=-1)
    pixel = pixel.reshape(-1, 3)
    value = lines @ pixel.T  # (batch, F, 5, pixels)
    step = np.hypot(lines[..., 0], lines[..., 1]) * (2 / size)
    slack = MARGIN * step[..., None] + ROUNDINGS * EPSILON * (line_sizes @ np.abs(pixel).T)
    exists = (determinant != 0)[..., None]
    inside = exists & np.all(value >= 0, axis=2)
    doubtful = np.all(value >= -slack, axis=2) & ~np.all(value > slack, axis=2)
    doubtful &= drawn[..., None]

    safe = np.where(exists, determinant[..., None], 1)
    key = np.where(inside, value[:, :, :3].sum(axis=2) / np.abs(safe), -np.inf)
    total = normals.sum(axis=2)
    slope = np.hypot(total[..., 0], total[..., 1]) * (2 / size) / np.abs(safe[..., 0])
    face = np.argmax(key, axis=1)
    nearest = np.take_along_axis(key, face[:, None], axis=1)
    slopes = slope[..., None] + np.take_along_axis(slope, face, axis=1)[:, None]
    blur = DEPTH * nearest + MARGIN * slopes
    rivals = np.isfinite(key) & (key >= nearest - blur)
    clear = ~doubtful.any(axis=1) & (rivals.sum(axis=1) <= 1)
    weights = np.take_along_axis(value[:, :, :3], face[:, None, None], axis=1)[:, 0]
    weights = np.moveaxis(weights / weights.sum(axis=1, keepdims=True), 1, 2)
    return _Seen(np.where(np.isfinite(nearest[:, 0]), face, -1), weights, clear)


def _cross_size(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sum of the sizes of the two terms of each component of a cross product."""
    a, b = np.abs(a), np.abs(b)
    first, second = [1, 2, 0], [2, 0, 1]
    return a[..., first] * b[..., second] + a[..., second] * b[..., first]


def _first_of_their_kind(faces: np.ndarray) -> np.ndarray:
    """Whether no earlier face has the same three corners: such a copy changes nothing."""
    ordered = np.sort(faces, axis=-1)
    same = np.all(ordered[:, :, None] == ordered[:, None], axis=-1)
    return ~np.any(np.tril(same, -1), axis=-1)


def _without_area(corners: np.ndarray) -> np.ndarray:
    """Whether two corners are at one place: such a face has no area for any renderer."""
    return np.any(np.all(corners == np.roll(corners, 1, axis=2), axis=3), axis=2)


def _shade(
    parts: Parts,
    faces: np.ndarray,
    seen: _Seen,
    viewer: np.ndarray,
    shift: np.ndarray,
) -> np.ndarray:
    """Phong's reflection of the sun and the lamp, (batch, pixels, 3)."""
    corners = _at(faces, np.maximum(seen.face, 0))

    def blended(values: np.ndarray) -> np.ndarray:
        return np.einsum("bpk,bpkc->bpc", seen.weights, _at(values, corners))

    position, normal = blended(parts["vertices"]), unit(blended(parts["normals"]))
    position = position + shift * np.abs(position)
    to_viewer = unit(viewer[:, None] - position)
    to_lamp = parts["lamp"][:, None] - position
    distance = np.linalg.norm(to_lamp, axis=-1, keepdims=True) / parts["size"][:, None, None]
    a, b, c = ATTENUATION
    color = np.full(position.shape, AMBIENT)
    for to_light, factor in (
        (np.broadcast_to(unit(-parts["direction"])[:, None], normal.shape), 1.0),
        (unit(to_lamp), 1 / (a + b * distance + c * distance**2)),
    ):
        cosine = np.sum(normal * to_light, axis=-1, keepdims=True)
        along = 2 * cosine * normal - to_light
        highlight = np.maximum(np.sum(along * to_viewer, axis=-1, keepdims=True), 0) ** SHININESS
        diffuse = parts["diffuse"][:, None] * np.maximum(cosine, 0)
        color = color + factor * (diffuse + SPECULAR * highlight * (cosine > 0))
    return np.where(seen.face[..., None] >= 0, color, np.array(BACKGROUND))
