"""Scenes in which shadows fall, and the light of each."""

import numpy as np

import diffrast as dr
from diffrast import linalg, shapes

SIZE = 96
LIGHT = {"ambient": (0.1, 0.1, 0.2), "diffuse": (0.8, 0.8, 0.7)}
FRAME = {"fov_y": 0.7, "aspect": 1.0, "near": 0.1, "far": 50.0}
ROUND_THE_CORNER = dr.Camera.perspective(eye=(3, 3, 6), target=(0, 0, 0), **FRAME)


def settings(**options):
    return dr.RenderSettings(height=SIZE, width=SIZE, **{"antialias": False, **options})


def floor(mesh=None, height=-1.0):
    down = linalg.compose(linalg.translation((0, height, 0)), linalg.rotation_x(-np.pi / 2))
    return dr.Object(shapes.plane(8.0, 8.0) if mesh is None else mesh, transform=down)


def sun(direction=(-0.8, -1.0, 0.3), **shadow):
    return dr.DirectionalLight(direction=direction, shadow=dr.Shadow(**shadow), **LIGHT)


def lamp(position, **shadow):
    return dr.PointLight(position=position, shadow=dr.Shadow(**shadow), **LIGHT)


def spot(**shadow):
    place = {"position": (2, 3, 1.5), "direction": (-2, -3, -1.5), "cutoff": 0.6}
    return dr.SpotLight(**place, shadow=dr.Shadow(**shadow), **LIGHT)


def ball(subdivisions=3):
    return dr.Object(shapes.icosphere(subdivisions))


def sponge(level):
    """A Menger sponge of cubes, without the faces that two of them have in common."""
    cells = np.zeros((1, 3), int)
    steps = np.array([i for i in np.ndindex(3, 3, 3) if sum(k == 1 for k in i) < 2])
    for _ in range(level):
        cells = (3 * cells[:, None] + steps).reshape(-1, 3)
    filled = set(map(tuple, cells))
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    quads = []
    for axis, side in np.ndindex(3, 2):
        shift = np.eye(3, dtype=int)[axis] * (2 * side - 1)
        corners = np.roll(np.insert(square, 0, side, axis=1), axis, axis=1)
        bare = [cell for cell in cells if tuple(cell + shift) not in filled]
        quads += [(cell + corners)[:: 2 * side - 1] for cell in bare]
    vertices = 2 * np.concatenate(quads) / 3**level - 1
    first = 4 * np.arange(len(quads))[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return dr.Object(dr.Mesh(vertices=np.float32(vertices), faces=faces))


def hills():
    x, y = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40))
    rough = np.random.default_rng(0).normal(size=x.shape).cumsum(axis=0) / 120
    return shapes.height_field(0.15 * np.sin(5 * y + 1) * np.cos(4 * x) + rough, 4.0, 4.0)


def cubes():
    places = ((0, 0, 0.5), (1.5, 0.5, 0.3), (-1, 1.5, 0.4), (0.3, -1.8, 0.7))
    for x, z, size in places:
        moved = linalg.compose(linalg.translation((x, size - 1, z)), linalg.rotation_y(x + z))
        yield dr.Object(shapes.cube(), None, moved @ linalg.scaling(size))


TEAPOT_VIEW = dr.Camera.perspective(eye=(2, -8, 5), target=(0, 0, 1), up=(0, 0, 1), **FRAME)
SCENES = {  # objects, light, camera
    "ball": lambda: ([ball(), floor()], sun(resolution=128), ROUND_THE_CORNER),
    "cubes in the light of a spot": lambda: ([*cubes(), floor()], spot(), ROUND_THE_CORNER),
    "lamp in a sponge": lambda: (
        [sponge(2), floor(shapes.plane(40.0, 40.0), -1.5)],
        lamp((0.05, 0.1, -0.07)),
        dr.Camera.perspective(eye=(3, 6, 9), target=(0, 0, 0), **FRAME),
    ),
    "hills in the evening": lambda: (
        [floor(hills(), 0.0)],
        sun((-1.0, -0.15, -0.3)),
        dr.Camera.perspective(eye=(0, 3, 4), target=(0, 0, 0), **FRAME),
    ),
    "teapot": lambda: (
        [dr.Object(shapes.teapot(6)), dr.Object(shapes.plane(12.0, 12.0))],
        sun((-0.5, 0.6, -1.0)),
        TEAPOT_VIEW,
    ),
}


def make(name):
    objects, light, camera = SCENES[name]()
    return dr.Scene(objects=objects, lights=[light]), camera


def at_random(seed):
    """Two boxes and a ball over a floor, some of which pierce one another, and a lamp."""
    random = np.random.default_rng(seed)

    def box():
        size = random.uniform(0.25, 0.8)
        turn = linalg.rotation_y(random.uniform(0, 6))
        turn = turn @ linalg.scaling(size * np.append(1, random.uniform(0.5, 1.5, 2)))
        height = -1 + 1.6 * size if random.random() < 0.5 else random.uniform(-0.6, 1)
        color = dr.Material(diffuse=random.uniform(0.3, 0.9, 3))
        place = (random.uniform(-1.5, 1.5), height, random.uniform(-1.5, 1.5))
        return dr.Object(shapes.cube(), color, linalg.translation(place) @ turn)

    sphere = shapes.icosphere(2, random.uniform(0.3, 0.8))
    place = linalg.translation(random.uniform(-1.2, 1.2, 3))
    things = [box(), box(), dr.Object(sphere, dr.Material(diffuse=(0.7, 0.6, 0.5)), place), floor()]
    light = lamp(random.uniform((-3, 3, -3), (3, 6, 3)), resolution=256)
    around, up = random.uniform(0, 2 * np.pi), random.uniform(0.4, 1.2)
    eye = (7 * np.cos(around) * np.cos(up), 7 * np.sin(up), 7 * np.sin(around) * np.cos(up))
    target = random.uniform(-0.3, 0.3, 3)
    camera = dr.Camera.perspective(eye=eye, target=target, **(FRAME | {"fov_y": 0.6}))
    return dr.Scene(objects=things, lights=[light]), camera
