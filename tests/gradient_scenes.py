"""Scenes whose derivatives are compared with those of the box-filtered image: plain NumPy."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

import diffrast as dr


@dataclass(frozen=True)
class Object:
    """A mesh in world space: vertices (V, 3), faces (F, 3), normals (V, 3); it turns about `pivot`.

    `material` is a dict of RGB "ambient", "diffuse", "specular" and "shininess".
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    material: dict
    pivot: np.ndarray


@dataclass(frozen=True)
class Problem:
    """A scene to differentiate: plain NumPy. `lights` are as in `box_filter.render_box`.

    Shadows of object 0 on the plane of the last object are what steps of the first light that
    casts any are measured by. `piercing` tells that faces intersect; `nodes` is the order of
    `render_box`'s integration, `lines` how many of its lines a pixel has for derivatives, and
    `step` how many pixels these are differences over.
    """

    objects: list[Object]
    eye: tuple
    target: tuple
    fov_y: float
    window: float | None = None  # height of the view under parallel projection, instead of fov_y
    up: tuple = (0.08, 1.0, 0.03)
    near: float = 0.5
    far: float = 20.0
    lights: list = field(default_factory=lambda: LIGHTS)
    background: tuple = (0.25, 0.35, 0.5)
    shading: str = "phong"
    cull_backfaces: bool = False
    piercing: bool = False
    nodes: int = 3
    lines: int = 64
    step: float = 0.05
    size: int = 96


LIGHTS = [
    {"type": "ambient", "ambient": (0.3, 0.3, 0.35)},
    {
        "type": "directional",
        "direction": (-0.45, -0.65, -0.6),
        "ambient": (0.1, 0.1, 0.1),
        "diffuse": (0.8, 0.75, 0.7),
        "specular": (0.4, 0.4, 0.4),
    },
]
WARM = {
    "ambient": (0.7, 0.4, 0.3),
    "diffuse": (0.9, 0.6, 0.45),
    "specular": (0.5, 0.5, 0.5),
    "shininess": 8.0,
}
COLD = {
    "ambient": (0.2, 0.4, 0.35),
    "diffuse": (0.3, 0.7, 0.5),
    "specular": (0.4, 0.4, 0.4),
    "shininess": 8.0,
}


def so3_exp(w) -> np.ndarray:
    """Rotation by |w| radians about w."""
    w = np.asarray(w, np.float64)
    angle = np.linalg.norm(w)
    cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    half = np.sinc(angle / (2 * np.pi))
    return np.eye(3) + np.sinc(angle / np.pi) * cross + half**2 / 2 * cross @ cross


def _object(mesh, material, scale=1.0, turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)) -> Object:
    rotation = so3_exp(turn)
    vertices = scale * np.asarray(mesh.vertices, np.float64) @ rotation.T + shift
    normals = np.asarray(mesh.normals, np.float64) @ rotation.T
    return Object(vertices, np.asarray(mesh.faces), normals, material, np.asarray(shift, float))


def cubes() -> Problem:
    """Two separate cubes, one partly in front of the other."""
    front = _object(dr.shapes.cube(), WARM, 0.6, (0.4, 0.6, 0.2), (-0.45, -0.2, 0.9))
    back = _object(dr.shapes.cube(), COLD, 0.75, (-0.5, 0.9, 0.4), (0.5, 0.3, -1.0))
    return Problem([front, back], eye=(0.4, 0.9, 5.0), target=(0.0, 0.0, 0.0), fov_y=0.72)


def sphere() -> Problem:
    """A smooth sphere of 5,120 faces."""
    ball = _object(dr.shapes.icosphere(4), WARM, 1.0, (0.3, 0.5, 0.2), (0.05, -0.1, 0.0))
    return Problem([ball], eye=(0.4, 0.9, 5.0), target=(0.0, 0.0, 0.0), fov_y=0.6)


def torus(edge) -> Problem:
    """A smooth torus, about 70 pixels across, whose edges are about `edge` pixels long."""
    around, across = round(157 / edge), max(round(63 / edge), 8)
    mesh = dr.shapes.torus(1.0, 0.4, major_segments=around, minor_segments=across)
    ring = _object(mesh, WARM, 1.0, (-0.9, 0.35, 0.2), (0.05, -0.05, 0.0))
    options = {"nodes": 2, "lines": 32} if edge < 1 else {}
    return Problem([ring], eye=(0.4, 0.9, 5.0), target=(0.0, 0.0, 0.0), fov_y=0.72, **options)


def lattice() -> Problem:
    """A plate with square holes, bars and holes about 2.5 pixels wide, in front of nothing."""
    cells = 23
    odd = np.arange(cells) % 2 == 1
    solid = np.zeros((cells + 2, cells + 2, 3), bool)
    solid[1:-1, 1:-1, 1] = ~(odd[:, None] & odd)
    mesh = _blocks(solid)
    thing = _object(mesh, WARM, 0.1, (0.35, 0.5, 0.3), (0.0, 0.05, 0.0))
    return Problem([thing], eye=(0.4, 0.9, 5.0), target=(0.0, 0.0, 0.0), fov_y=0.72)


def _blocks(solid) -> dr.Mesh:
    """Surface of unit blocks at the cells of `solid` (no block at its borders), centred."""
    corners, normals = [], []
    for axis in range(3):
        u, v = np.eye(3)[(axis + 1) % 3] / 2, np.eye(3)[(axis + 2) % 3] / 2
        for sign in (1, -1):
            bare = np.argwhere(solid & ~np.roll(solid, -sign, axis=axis))
            normal = sign * np.eye(3)[axis]
            middle = (bare + normal / 2)[:, None]
            corners.append(
                middle + np.stack([-u - sign * v, u - sign * v, u + sign * v, sign * v - u])
            )
            normals.append(np.tile(normal, (4 * len(bare), 1)))
    vertices = np.concatenate(corners).reshape(-1, 3) - (np.array(solid.shape) - 1) / 2
    quads = np.arange(len(vertices)).reshape(-1, 4)
    faces = quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    return dr.Mesh(vertices=vertices, faces=faces, normals=np.concatenate(normals))


def piercing() -> Problem:
    """Two cubes that intersect each other."""
    first = _object(dr.shapes.cube(), WARM, 0.7, (0.4, 0.6, 0.2), (-0.3, -0.1, 0.3))
    second = _object(dr.shapes.cube(), COLD, 0.7, (-0.5, 0.9, 0.4), (0.35, 0.2, -0.1))
    eye, target = (0.4, 0.9, 5.0), (0.0, 0.0, 0.0)
    return Problem([first, second], eye=eye, target=target, fov_y=0.6, piercing=True)


def border() -> Problem:
    """A cube and a sphere that leave the image on all sides."""
    box = _object(dr.shapes.cube(), WARM, 0.9, (0.4, 0.6, 0.2), (-1.0, -0.5, 1.4))
    ball = _object(dr.shapes.icosphere(4), COLD, 1.3, (0.1, 0.2, 0.3), (1.1, 0.6, 0.0))
    return Problem([box, ball], eye=(0.2, 0.5, 5.0), target=(0.0, 0.0, 0.0), fov_y=0.45)


def hills() -> Problem:
    """Rough hills, seen from so low that they hide one another; faces of half a pixel and less."""
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 97)])
    heights = 0.15 * np.sin(5 * x) * np.cos(4 * y) + 0.05 * np.sin(13 * x + 9 * y)
    ground = _object(dr.shapes.height_field(heights), WARM, 1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    camera = {"eye": (0.0, -2.2, 0.8), "target": (0.0, 0.0, 0.0), "up": (0.0, 0.0, 1.0)}
    return Problem([ground], **camera, fov_y=0.7, nodes=2, lines=32)


def shards() -> Problem:
    """Triangles that pierce one another.

    Where they pierce each other edges begin and end at small angles, which needs short steps.
    """
    generator = np.random.default_rng(2)
    corners = generator.uniform(-0.8, 0.8, (100, 1, 3)) + generator.normal(0, 0.3, (100, 3, 3))
    mesh = dr.Mesh(vertices=corners.reshape(-1, 3), faces=np.arange(300).reshape(-1, 3))
    heap = _object(dr.mesh.flat_shaded(mesh), WARM, 1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    eye, target = (0.4, 0.9, 5.0), (0.0, 0.0, 0.0)
    return Problem([heap], eye, target, fov_y=0.6, piercing=True, lines=256, step=0.0125)


def crease() -> Problem:
    """A sphere of 320 flat faces."""
    ball = _object(dr.shapes.icosphere(2), WARM, 1.0, (0.3, 0.5, 0.2), (0.05, -0.1, 0.0))
    eye, target = (0.4, 0.9, 5.0), (0.0, 0.0, 0.0)
    return Problem([ball], eye=eye, target=target, fov_y=0.6, shading="flat")


def teapot() -> Problem:
    """A coarse teapot of four bodies; not among `SCENES`."""
    pot = dr.mesh.merge_near_vertices(dr.shapes.teapot(5), 1e-5)
    pot = dr.mesh.with_normals(pot, weighting="uniform")
    body = _object(pot, WARM, shift=(0.0, 0.0, -1.4))
    camera = {"eye": (6.5, -6.0, 3.8), "target": (0.0, 0.0, 0.0), "up": (0.0, 0.0, 1.0)}
    return Problem([body], **camera, fov_y=0.7, far=40.0, piercing=True, nodes=2)


SHADE = {
    "shadow": True,
    "ambient": (0.1, 0.1, 0.1),
    "diffuse": (0.8, 0.75, 0.7),
    "specular": (0.3, 0.3, 0.3),
}
# So dull that facets near the terminator, which turn dark at once, do not show.
DULL = WARM | {"diffuse": (0.06, 0.04, 0.03), "specular": (0.0, 0.0, 0.0)}


def _shadowed(thing, light, floor_size=9.0, **camera) -> Problem:
    """A problem of an object above a slanted floor, in ambient light and one light with shadows."""
    floor = _object(
        dr.shapes.plane(floor_size, floor_size), COLD, 1.0, (-1.5, 0.06, 0.04), (0.0, -0.9, 0.0)
    )
    view = {"eye": (0.5, 3.0, 4.6), "target": (-0.1, -0.4, 0.0), "fov_y": 0.6} | camera
    return Problem([thing, floor], lights=[LIGHTS[0], SHADE | light], **view)


def shadow_sun() -> Problem:
    """A cube over a floor, in the sun."""
    box = _object(dr.shapes.cube(), WARM, 0.45, (0.3, 0.5, 0.2), (0.35, 0.25, 0.1))
    return _shadowed(box, {"type": "directional", "direction": (-0.65, -1.0, -0.15)})


def shadow_lamp() -> Problem:
    """A smooth ball over a floor, both near a lamp; it turns about a point outside of it."""
    ball = _object(dr.shapes.icosphere(3), DULL, 0.42, (0.3, 0.5, 0.2), (0.3, 0.1, 0.2))
    ball = replace(ball, pivot=ball.pivot + np.array([-0.5, 0.3, 0.4]))
    return _shadowed(ball, {"type": "point", "position": (1.3, 2.1, 0.9)}, floor_size=2.9)


def shadow_spot() -> Problem:
    """A cube over a floor, in the cone of a spot light that is partly in view."""
    box = _object(dr.shapes.cube(), WARM, 0.35, (0.5, -0.4, 0.2), (0.25, 0.1, 0.1))
    place = {"position": (1.2, 2.3, 0.8), "direction": (-1.25, -2.9, -0.8), "cutoff": 0.42}
    return _shadowed(box, {"type": "spot", **place})


def shadow_hidden() -> Problem:
    """The shadow of a cube that is not in the image."""
    box = _object(dr.shapes.cube(), WARM, 0.55, (0.3, 0.5, 0.2), (2.7, 1.85, 0.4))
    return _shadowed(box, {"type": "directional", "direction": (-0.95, -1.0, -0.15)})


SCENES: dict[str, Callable[[], Problem]] = {
    "cubes": cubes,
    "sphere": sphere,
    "torus8": lambda: torus(8.0),
    "torus2": lambda: torus(2.0),
    "torus05": lambda: torus(0.5),
    "torus025": lambda: torus(0.25),
    "lattice": lattice,
    "piercing": piercing,
    "border": border,
    "crease": crease,
    "hills": hills,
    "shards": shards,
    "shadow_sun": shadow_sun,
    "shadow_lamp": shadow_lamp,
    "shadow_spot": shadow_spot,
    "shadow_hidden": shadow_hidden,
}
