"""Scenes that strain a renderer, from seeded generators; what `stability.py` draws.

A scene is a dict of float32 arrays (int32 for `faces`) whose shapes are always the same, so that
one compiled program draws all of them: an icosahedron, twelve triangles that lie about it, and
vertices that no face uses. Each stressor changes such a scene, more so the larger or the smaller
its magnitude is, and knows the magnitudes worth trying.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

import diffrast as dr

Parts = dict[str, np.ndarray]

SOUP = 12  # triangles with vertices of their own
UNUSED = 4
_BALL = dr.shapes.icosahedron(flat=False)
BALL_VERTICES, BALL_FACES = len(_BALL.vertices), len(_BALL.faces)
VERTICES, FACES = BALL_VERTICES + 3 * SOUP + UNUSED, BALL_FACES + SOUP

# What is differentiated; the other parts are given.
CONTINUOUS = ("vertices", "normals", "eye", "target", "fov_y", "direction", "lamp", "diffuse")
LENGTHS = ("vertices", "eye", "target", "lamp", "near", "far", "size")  # what a scale multiplies
POINTS = ("vertices", "eye", "target", "lamp")
VECTORS = ("normals", "up", "direction")


def plain(generator: np.random.Generator) -> Parts:
    """A scene of unit size that strains nothing, in float64."""
    rotation = random_rotation(generator)
    ball = np.asarray(_BALL.vertices, np.float64) @ rotation.T
    centre = generator.normal(size=(SOUP, 1, 3))
    soup = 0.8 * centre + 0.5 * generator.normal(size=(SOUP, 3, 3))
    unused = generator.normal(size=(UNUSED, 3))
    across = unit(np.cross(soup[:, 1] - soup[:, 0], soup[:, 2] - soup[:, 0]))
    bent = unit(across[:, None] + 0.2 * generator.normal(size=(SOUP, 3, 3)))
    faces = BALL_VERTICES + np.arange(3 * SOUP).reshape(SOUP, 3)
    return {
        "vertices": np.concatenate([ball, soup.reshape(-1, 3), unused]),
        "normals": np.concatenate([unit(ball), bent.reshape(-1, 3), unit(unused)]),
        "faces": np.concatenate([np.asarray(_BALL.faces), faces]).astype(np.int32),
        "eye": generator.uniform(3, 5) * unit(generator.normal(size=3)),
        "target": 0.2 * generator.normal(size=3),
        "up": unit(generator.normal(size=3)),
        "fov_y": np.array(generator.uniform(0.4, 0.9)),
        "near": np.array(0.3),
        "far": np.array(30.0),
        "direction": generator.normal(size=3),
        "lamp": 2.5 * unit(generator.normal(size=3)),
        "diffuse": generator.uniform(0.2, 0.9, size=3),
        "size": np.array(1.0),
        "mirror": np.array(1.0),
    }


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors of length one; zeros stay."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


def random_rotation(generator: np.random.Generator) -> np.ndarray:
    """Any rotation, (3, 3)."""
    axes = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    return axes * np.sign(np.linalg.det(axes))


# Faces --------------------------------------------------------------------------------------------


def zero_area(generator: np.random.Generator, parts: Parts, count: float) -> None:
    """So many faces without area: equal ids, equal places, or corners in one line."""
    vertices, faces = parts["vertices"], parts["faces"]
    for face in generator.permutation(FACES)[: int(count)]:
        kind = generator.integers(5)
        a, b, c = faces[face]
        if kind == 0:
            faces[face] = (a, a, b)
        elif kind == 1:
            faces[face] = (a, a, a)
        elif kind == 2:
            vertices[c] = vertices[b]
        elif kind == 3:
            vertices[c] = vertices[b] = vertices[a]
        else:
            vertices[c] = (vertices[a] + vertices[b]) / 2


def sliver(generator: np.random.Generator, parts: Parts, aspect: float) -> None:
    """Triangles, or a whole body, flat to this share of their length."""
    vertices = parts["vertices"]
    if generator.random() < 0.5:
        normal = unit(generator.normal(size=3))
        ball = vertices[:BALL_VERTICES]
        vertices[:BALL_VERTICES] = ball + (aspect - 1) * (ball @ normal)[:, None] * normal
    for a, b, c in parts["faces"][BALL_FACES:]:
        along = vertices[b] - vertices[a]
        aside = aspect * np.cross(along, unit(generator.normal(size=3)))
        vertices[c] = vertices[a] + generator.uniform(-0.2, 1.2) * along + aside


def coincident(generator: np.random.Generator, parts: Parts, distance: float) -> None:
    """Triangles at this distance from faces of the body."""
    del generator
    vertices, faces = parts["vertices"], parts["faces"]
    corners = vertices[faces[:SOUP]]
    normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    vertices[faces[BALL_FACES:]] = corners + distance * normals[:, None]


def duplicated(generator: np.random.Generator, parts: Parts, copies: float) -> None:
    """Every face so many times, by any of its corners first."""
    kept = generator.permutation(FACES)[: FACES // int(copies)]
    faces = parts["faces"][np.resize(kept, FACES)]
    first = (np.arange(3) + generator.integers(3, size=(FACES, 1))) % 3
    parts["faces"] = np.take_along_axis(faces, first, axis=1)


def inverted(generator: np.random.Generator, parts: Parts, share: float) -> None:
    """This share of the faces turned round; sometimes beside those they were."""
    faces = parts["faces"]
    if generator.random() < 0.5:
        faces[BALL_FACES:] = faces[:SOUP]
    turned = generator.random(FACES) < share
    faces[turned] = faces[turned, ::-1]


# Camera -------------------------------------------------------------------------------------------


def vertex_near_eye(generator: np.random.Generator, parts: Parts, depth: float) -> None:
    """Vertices at this depth, behind the eye if negative; at 0 in its plane or at the eye."""
    eye, forward = parts["eye"], unit(parts["target"] - parts["eye"])
    aside = np.cross(forward, unit(generator.normal(size=3)))
    for vertex in generator.permutation(VERTICES - UNUSED)[:6]:
        away = generator.choice([0.0, 0.0, abs(depth), 1.0])
        parts["vertices"][vertex] = eye + depth * forward + away * aside
    parts["near"] = np.array(generator.choice([0.3, 1e-3]))


def inside(generator: np.random.Generator, parts: Parts, distance: float) -> None:
    """The eye inside the body, at this distance from one of its faces."""
    corners = parts["vertices"][parts["faces"][generator.integers(BALL_FACES)]]
    normal = unit(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
    parts["eye"] = generator.dirichlet(np.ones(3)) @ corners - distance * normal
    parts["target"] = parts["eye"] + unit(generator.normal(size=3))
    parts["near"] = np.array(max(distance / 4, 1e-6))
    parts["fov_y"] = np.array(generator.uniform(0.5, 2.5))


def eye_in_plane(generator: np.random.Generator, parts: Parts, distance: float) -> None:
    """The eye at this distance from the planes of faces, exactly in them at zero."""
    for face in parts["faces"][BALL_FACES : BALL_FACES + 6]:
        axis = generator.integers(3)
        parts["vertices"][face, axis] = parts["eye"][axis] + distance
        parts["vertices"][face] += generator.choice([0, 1]) * np.roll([0.0, *generator.normal(
            size=2)], axis)  # fmt: skip


def field_of_view(generator: np.random.Generator, parts: Parts, degrees: float) -> None:
    """A camera with this angle of view, from as far away as fills the picture."""
    parts["fov_y"] = np.array(np.radians(degrees))
    distance = max(1.8 / np.tan(np.radians(degrees) / 2), 0.8 + 0.4 * generator.random())
    parts["eye"] = distance * unit(parts["eye"])
    parts["near"], parts["far"] = np.array(0.01 * distance), np.array(10 * distance)


def near_far(generator: np.random.Generator, parts: Parts, ratio: float) -> None:
    """Planes near and far this many times apart."""
    if generator.random() < 0.5:
        parts["near"] = parts["far"] / ratio
    else:
        parts["far"] = parts["near"] * ratio


def culled(generator: np.random.Generator, parts: Parts, distance: float) -> None:
    """Everything this far out of view: aside, behind the eye, or beyond the far plane."""
    forward = unit(parts["target"] - parts["eye"])
    aside = unit(np.cross(forward, generator.normal(size=3)))
    away = [aside, -forward, (1 + 40 / distance) * forward][generator.integers(3)]
    parts["vertices"] = parts["vertices"] + distance * away


# Light, attributes, units -------------------------------------------------------------------------


def lamp_in_surface(generator: np.random.Generator, parts: Parts, distance: float) -> None:
    """A lamp at this distance from a face, a vertex, or a point that a pixel may see."""
    corners = parts["vertices"][parts["faces"][generator.integers(FACES)]]
    weights = [np.eye(3)[0], np.ones(3) / 3, generator.dirichlet(np.ones(3))]
    away = unit(np.cross(corners[1] - corners[0], corners[2] - corners[0]))
    parts["lamp"] = weights[generator.integers(3)] @ corners + distance * away


def unused_not_finite(generator: np.random.Generator, parts: Parts, count: float) -> None:
    """Numbers that are not finite in vertices of no face; normals of 1e30, too."""
    unused = VERTICES - 1 - np.arange(int(count))
    wrong = [np.nan, np.inf, -np.inf]
    parts["vertices"][unused] = generator.choice(wrong, size=(int(count), 3))
    parts["normals"][unused] = generator.choice([*wrong, 1e30], size=(int(count), 3))


def scale(generator: np.random.Generator, parts: Parts, factor: float) -> None:
    """Another unit of length."""
    del generator
    parts |= {name: parts[name] * factor for name in LENGTHS}


def offset(generator: np.random.Generator, parts: Parts, distance: float) -> None:
    """Everything so many times its size away from the origin."""
    shift = distance * float(parts["size"]) * unit(generator.normal(size=3))
    parts |= {name: parts[name] + shift for name in POINTS}


class Stressor(NamedTuple):
    """How a scene is strained, and how much.

    Attributes:
        change: of a scene, in place.
        magnitudes: what is tried.
    """

    change: Callable[[np.random.Generator, Parts, float], None]
    magnitudes: Sequence[float]


def _powers(first: int, last: int) -> list[float]:
    return [10.0**power for power in range(first, last + 1)]


_DEPTHS = [1e-9, 1e-6, 1e-4, 1e-2, 0.3, 1.0]
# In the order in which several of them are applied: later ones keep what earlier ones made.
STRESSORS: dict[str, Stressor] = {
    "sliver": Stressor(sliver, [0.0, *_powers(-8, -1)]),
    "coincident faces": Stressor(coincident, [0.0, *_powers(-8, -1)]),
    "zero area": Stressor(zero_area, [1, 4, 12, FACES]),
    "duplicated faces": Stressor(duplicated, [2, 4, 8, 16]),
    "inverted faces": Stressor(inverted, [0.1, 0.25, 0.5, 1.0]),
    "field of view": Stressor(field_of_view, [1, 5, 20, 60, 90, 120, 150, 170, 175]),
    "near and far": Stressor(near_far, _powers(1, 7)),
    "camera inside": Stressor(inside, [*_powers(-7, -1), 0.5]),
    "vertex near eye": Stressor(vertex_near_eye, [-d for d in _DEPTHS[::-1]] + [0.0, *_DEPTHS]),
    "eye in plane": Stressor(eye_in_plane, [0.0, *_powers(-8, -1)]),
    "lamp in surface": Stressor(lamp_in_surface, [0.0, *_powers(-8, -1)]),
    "unused not finite": Stressor(unused_not_finite, [1, 2, 3, UNUSED]),
    "everything culled": Stressor(culled, _powers(1, 6)),
    "scale": Stressor(scale, _powers(-6, 6)),
    "offset": Stressor(offset, _powers(0, 6)),
}
SEVERAL = "several at once"
NAMES = (*STRESSORS, SEVERAL)


class Case(NamedTuple):
    """A scene with what it was made for."""

    stressor: str
    magnitude: float
    parts: Parts


def case(number: int, seed: int = 0) -> Case:
    """The scene of this number: stressors take turns, and so do their magnitudes."""
    generator = np.random.default_rng((seed, number))
    name = NAMES[number % len(NAMES)]
    turn = number // len(NAMES)
    parts = plain(generator)
    if name == SEVERAL:
        magnitude = float(2 + turn % 4)
        chosen = generator.permutation(len(STRESSORS))[: int(magnitude)]
        for stressor in (list(STRESSORS.values())[index] for index in sorted(chosen)):
            stressor.change(generator, parts, float(generator.choice(stressor.magnitudes)))
    else:
        stressor = STRESSORS[name]
        magnitude = float(stressor.magnitudes[turn % len(stressor.magnitudes)])
        stressor.change(generator, parts, magnitude)
    return Case(name, magnitude, single(parts))


def single(parts: Parts) -> Parts:
    """The same numbers as the renderer gets them."""
    with np.errstate(over="ignore"):
        return {
            name: np.asarray(part, np.int32 if name == "faces" else np.float32)
            for name, part in parts.items()
        }


def stacked(all_parts: Sequence[Parts]) -> Parts:
    """Scenes along a new first axis."""
    return {name: np.stack([parts[name] for parts in all_parts]) for name in all_parts[0]}


# What must not change the picture -----------------------------------------------------------------


def reordered(generator: np.random.Generator, parts: Parts) -> Parts:
    """Faces in another order."""
    return parts | {"faces": generator.permutation(parts["faces"])}


def cycled(generator: np.random.Generator, parts: Parts) -> Parts:
    """Faces by another corner first."""
    first = (np.arange(3) + generator.integers(3, size=(len(parts["faces"]), 1))) % 3
    return parts | {"faces": np.take_along_axis(parts["faces"], first, axis=1)}


def mirrored(generator: np.random.Generator, parts: Parts) -> Parts:
    """Left and right exchanged; so is the picture."""
    del generator
    return parts | {"mirror": -parts["mirror"]}


def scaled(generator: np.random.Generator, parts: Parts) -> Parts:
    """By a power of two, which rounds nothing."""
    factor = np.float32(2.0 ** generator.choice([-10, -3, 3, 10]))
    with np.errstate(over="ignore"):
        return parts | {name: parts[name] * factor for name in LENGTHS}


def turned(generator: np.random.Generator, parts: Parts) -> Parts:
    """By right angles, which round nothing."""
    axes = generator.permutation(3)
    signs = generator.choice([-1, 1], size=3)
    matrix = np.eye(3)[axes] * signs
    matrix[0] *= np.linalg.det(matrix)
    names = (*POINTS, *VECTORS)
    place = np.argmax(np.abs(matrix), axis=1)
    sign = matrix.sum(axis=1).astype(np.float32)
    return parts | {name: parts[name][..., place] * sign for name in names}


def moved(generator: np.random.Generator, parts: Parts) -> Parts:
    """Turned and shifted anyhow, and rounded."""
    rotation = random_rotation(generator)
    shift = float(parts["size"]) * generator.normal(size=3)
    with np.errstate(invalid="ignore", over="ignore"):
        points = {name: parts[name].astype(float) @ rotation.T + shift for name in POINTS}
        vectors = {name: parts[name].astype(float) @ rotation.T for name in VECTORS}
    return single(parts | points | vectors)


INVARIANCES: dict[str, Callable[[np.random.Generator, Any], Parts]] = {
    "order of faces": reordered,
    "corners of faces": cycled,
    "mirror": mirrored,
    "scale": scaled,
    "right angles": turned,
    "rigid motion": moved,
}
