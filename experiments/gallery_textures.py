"""The sources' textured pictures; the images on the surfaces are made by formulas."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gallery_drawings import side_by_side
from gallery_scenes import placed, shaded, sun, teapot
from jax import Array

import diffrast as dr

# Views along +x, -x, +y, -y, +z, -z from the centre of a cube: direction, and what is at the top.
SIDES = (
    ((1, 0, 0), (0, 1, 0)),
    ((-1, 0, 0), (0, 1, 0)),
    ((0, 1, 0), (0, 0, 1)),
    ((0, -1, 0), (0, 0, -1)),
    ((0, 0, 1), (0, 1, 0)),
    ((0, 0, -1), (0, 1, 0)),
)
Y_UP: dict[str, Any] = {"up": (0, 1, 0)}


def _grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates of the centres of texels."""
    u, v = (np.arange(columns) + 0.5) / columns, 1 - (np.arange(rows) + 0.5) / rows
    return np.meshgrid(u, v)


def _noise(u: np.ndarray, v: np.ndarray, seed: int, octaves: int = 5) -> np.ndarray:
    """Sum of waves in random directions that repeats with the image, about -1 to 1."""
    rng = np.random.default_rng(seed)
    total = np.zeros_like(u)
    for octave in range(octaves):
        for _ in range(4):
            across, up = rng.integers(-(2**octave), 2**octave + 1, 2)
            phase = rng.uniform(0, 2 * np.pi)
            total += np.sin(2 * np.pi * (across * u + up * v) + phase) / (4 * 1.6**octave)
    return total


def _between(share: np.ndarray, one: Any, other: Any) -> np.ndarray:
    share = np.clip(share, 0, 1)[..., None]
    return (1 - share) * np.asarray(one) + share * np.asarray(other)


def wood(size: int = 256) -> np.ndarray:
    u, v = _grid(size, size)
    rings = np.sin(2 * np.pi * (12 * v + 0.8 * _noise(u, v, 1, 3)))
    return _between(
        0.5 + 0.35 * rings + 0.2 * _noise(u, 8 * v, 2), (0.3, 0.13, 0.04), (0.6, 0.34, 0.14)
    )


def marble(size: int = 256) -> np.ndarray:
    u, v = _grid(size, size)
    veins = np.abs(np.sin(2 * np.pi * (u + v) + 3 * _noise(u, v, 3)))
    return _between(veins**0.4, (0.25, 0.28, 0.35), (0.92, 0.92, 0.9))


def tiles(size: int = 256, count: int = 1) -> np.ndarray:
    u, v = _grid(size, size)
    inner_u, inner_v = (np.abs((x * count) % 1 - 0.5) for x in (u, v))
    joint = np.maximum(inner_u, inner_v) > 0.47
    stone = _between(0.5 + 0.5 * _noise(u, v, 4), (0.55, 0.3, 0.2), (0.75, 0.5, 0.35))
    return np.where(joint[..., None], (0.85, 0.82, 0.75), stone)


def checks(count: int, one: Any, other: Any, size: int = 256) -> np.ndarray:
    u, v = _grid(size, size)
    return _between((np.floor(u * count) + np.floor(v * count)) % 2, one, other)


def page(size: int = 256) -> np.ndarray:
    """A sheet of paper with lines of writing."""
    u, v = _grid(size, size)
    line = (v * 24) % 1
    written = (line < 0.45) & (_noise(16 * u, np.floor(v * 24) / 7, 5, 3) > -0.25)
    inside = (np.abs(u - 0.5) < 0.4) & (np.abs(v - 0.5) < 0.42)
    return np.where((written & inside)[..., None], (0.15, 0.15, 0.2), (0.95, 0.94, 0.88))


def planet(size: int = 256) -> np.ndarray:
    """Land and sea, and ice at the poles, by longitude and latitude."""
    u, v = _grid(size, 2 * size)
    height = _noise(u, v, 7) - 0.05
    land = _between(3 * height, (0.15, 0.4, 0.12), (0.6, 0.5, 0.3))
    sea = _between(-2 * height, (0.1, 0.35, 0.6), (0.02, 0.08, 0.3))
    color = np.where((height > 0)[..., None], land, sea)
    return np.where((np.abs(v - 0.5) > 0.42 + 0.02 * _noise(u, v, 8))[..., None], 0.95, color)


def surroundings(size: int = 256) -> dr.CubeTexture:
    """Sky with a sun and clouds over a chequered plain, as it is seen in each direction."""
    right, up = (np.arange(size) + 0.5) / size * 2 - 1, 1 - (np.arange(size) + 0.5) / size * 2
    x, y = np.meshgrid(right, up)
    images = []
    for forward, top in SIDES:
        across = np.cross(forward, top)
        ray = x[..., None] * across + y[..., None] * np.asarray(top) + np.asarray(forward)
        ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
        height = ray[..., 1]
        flat = ray[..., ::2] / np.maximum(np.abs(height), 0.02)[..., None]
        clouds = np.clip(2 * _noise(0.11 * flat[..., 0], 0.11 * flat[..., 1], 11), 0, 1)
        clouds = clouds * np.clip(4 * height, 0, 1)
        sky = _between(2 * height, (0.8, 0.88, 0.95), (0.15, 0.35, 0.75))
        sky = _between(0.8 * clouds, sky, (1.0, 1.0, 1.0))
        glare = ray @ (np.array([0.5, 0.45, 0.74]) / np.linalg.norm([0.5, 0.45, 0.74]))
        sky = _between((glare - 0.985) * 200, sky, (1.0, 0.97, 0.8))
        fields = np.floor(flat).sum(axis=-1) % 2
        plain = _between(fields, (0.25, 0.4, 0.15), (0.5, 0.5, 0.25))
        plain = _between(1 + 12 * height, plain, (0.7, 0.78, 0.8))
        images.append(np.where((height > 0)[..., None], sky, plain))
    return dr.CubeTexture(np.stack(images).astype(np.float32), filter="trilinear")


def material(image: np.ndarray, **options: Any) -> dr.Material:
    texture = dr.Texture(image.astype(np.float32), **{"filter": "trilinear", **options})
    return dr.Material(diffuse=(1, 1, 1), texture=texture)


def box() -> dr.Mesh:
    """A cube of edge 2 with the whole image on each side."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    vertices = [
        np.asarray(forward)
        + corners[:, :1] * np.cross(top, forward)
        + corners[:, 1:] * np.asarray(top)
        for forward, top in SIDES
    ]
    faces = np.concatenate([np.array([(0, 1, 2), (0, 2, 3)]) + 4 * side for side in range(6)])
    uvs = np.tile((corners + 1) / 2, (6, 1))
    return dr.Mesh(vertices=np.concatenate(vertices), faces=faces, uvs=uvs)


def desk(size: int) -> Array:
    """Left a desk; right a sponge with another image on each of three pairs of sides."""
    oak, paper = material(wood()), material(page())
    things = [
        placed(box(), oak, (0, 0, 2.0), (2.4, 1.3, 0.08)),
        *(
            placed(box(), oak, (x, y, 0.96), (0.1, 0.1, 0.96))
            for x in (-2.2, 2.2)
            for y in (-1.1, 1.1)
        ),
        placed(dr.shapes.plane(1.0, 1.4), paper, (-0.6, -0.2, 2.09)),
        placed(dr.shapes.plane(1.0, 1.4), paper, (0.8, 0.1, 2.09)),
        placed(box(), material(marble()), (1.7, 0.7, 2.3), (0.3, 0.3, 0.22)),
        placed(dr.shapes.plane(14.0, 14.0), material(tiles(count=12)), (0, 0, 0)),
    ]
    seen = shaded(things, [sun(ambient=0.3)], size, eye=(3.6, -6.0, 4.6), target=(0, 0, 1.3))
    sponge = dr.shapes.menger_sponge(2)
    parts = []
    outward = np.abs(np.asarray(dr.mesh.face_normals(sponge.vertices, sponge.faces)))
    low, high = np.asarray(sponge.vertices).min(axis=0), np.asarray(sponge.vertices).max(axis=0)
    for axis, image in enumerate((wood(), marble(), tiles(count=9))):
        across, up = np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3]] * (high - low)
        mapping = dr.PlanarMapping(corner=low, across=across, up=up)
        faces = np.asarray(sponge.faces)[outward.argmax(axis=1) == axis]
        mesh = dr.Mesh(vertices=sponge.vertices, faces=faces)
        parts.append(dr.Object(mesh, material(image, mapping=mapping)))
    reach = float(np.abs(high).max())
    eye = tuple(reach * np.array([2.4, -3.4, 2.6]))
    return side_by_side([seen, shaded(parts, [sun(ambient=0.3)], size, eye=eye, target=(0, 0, 0))])


def resolutions(size: int) -> Array:
    """An image of few texels, the nearest one or a blend of four at every pixel."""
    coarse = checks(4, (0.8, 0.2, 0.1), (0.95, 0.9, 0.6), 16) * 0.6 + 0.4 * marble(16)
    images = [
        shaded(
            [dr.Object(dr.shapes.plane(6.0, 6.0), material(coarse, filter=kind))],
            [sun((0, 0.3, -1), ambient=0.3)],
            size,
            eye=(0.6, -5.0, 3.2),
            target=(0, -0.6, 0),
        )
        for kind in ("nearest", "bilinear")
    ]
    return side_by_side(images)


def textured_spheres(size: int) -> Array:
    """Each image on the half towards the viewer, and all of it round the ball."""
    view = {**Y_UP, "eye": (0.4, 0.9, 4.0), "target": (0, 0, 0), "background": (0.03, 0.03, 0.06)}
    light = [sun((0.5, -0.4, -0.8), ambient=0.1)]
    images = []
    for image, kind in (
        (checks(8, (0.7, 0.1, 0.1), (0.95, 0.9, 0.8)), "arcsine"),
        (planet(), "longitude"),
    ):
        surface = material(image, mapping=dr.SphereMapping(kind=kind))
        images.append(shaded([dr.Object(dr.shapes.icosphere(4), surface)], light, size, **view))
    return side_by_side(images)


def projected_teapot(size: int) -> Array:
    """The image is stretched where the surface turns away from its plane."""
    mapping = dr.PlanarMapping(corner=(-3, 0, 0), across=(6, 0, 0), up=(0, 0, 6))
    flowers = checks(16, (0.15, 0.3, 0.65), (0.93, 0.93, 0.9)) * 0.8 + 0.2 * marble()
    surface = material(flowers, mapping=mapping)
    views = ((1.0, -8.5, 3.5), (8.0, -3.0, 3.5))
    light = [sun((0.1, 0.8, -0.6), ambient=0.25)]
    return side_by_side([shaded([teapot(surface)], light, size, eye=eye) for eye in views])


def mirrored_surroundings(size: int) -> Array:
    """A cube map on three bodies, in front of itself."""
    world = surroundings()
    surface = dr.Material(diffuse=(1, 1, 1), texture=world)
    turned = dr.linalg.rotation_x(-np.pi / 2)
    images = []
    for mesh, matrix in (
        (dr.shapes.icosphere(4), np.eye(4)),
        (dr.shapes.torus(0.9, 0.4), turned),
        (dr.shapes.teapot(10), np.asarray(turned) @ np.diag([0.4, 0.4, 0.4, 1])),
    ):
        body = dr.mesh.transform(mesh, matrix)  # a texture stays with its mesh
        images.append(
            shaded(
                [dr.Object(body, surface)],
                [dr.AmbientLight((1.0, 1.0, 1.0))],
                size,
                **Y_UP,
                eye=(1.5, 0.9, 2.9),
                target=(0, 0.2, 0),
                fov_y=0.9,
                background=world,
            )
        )
    return side_by_side(images)


def texture_coordinates(size: int) -> Array:
    """Left a floor of a hundred tiles from one; middle and right meshes with several images."""
    floor = dr.Mesh(
        vertices=[(-5, -5, 0), (5, -5, 0), (5, 5, 0), (-5, 5, 0)],
        faces=[(0, 1, 2), (0, 2, 3)],
        uvs=[(0, 0), (10, 0), (10, 10), (0, 10)],
    )
    hundred = shaded(
        [dr.Object(floor, material(tiles(), anisotropy=4))],
        [sun((0, 0.3, -1), ambient=0.3)],
        size,
        eye=(0, -7.5, 2.6),
        target=(0, -1.5, 0),
        background=(0.75, 0.85, 1.0),
    )
    still = [
        placed(dr.shapes.uv_sphere(1.0, segments=48, rings=24), material(planet()), (-1.2, 0, 1)),
        placed(dr.shapes.cylinder(0.6, 1.8), material(wood()), (1.0, -0.6, 0.9)),
        placed(box(), material(marble()), (1.2, 1.4, 0.7), (0.7, 0.7, 0.7)),
        dr.Object(floor, material(checks(2, (0.2, 0.2, 0.25), (0.8, 0.8, 0.8)))),
    ]
    view = {"eye": (4.5, -5.5, 3.8), "target": (0, 0, 0.7)}
    images = [hundred, shaded(still, [sun(ambient=0.3)], size, **view)]
    used = [
        jax.image.resize(jnp.asarray(i), (size // 2, size, 3), "linear") for i in (planet(), wood())
    ]
    images.append(jnp.clip(jnp.concatenate(used), 0, 1))
    return side_by_side(images)


FIGURES = [
    ("A_fig_50", "A desk and a Menger sponge with several images", desk),
    ("A_fig_52", "An image of few texels, without and with interpolation", resolutions),
    ("A_fig_54", "Images on a ball: the half towards the viewer, all round", textured_spheres),
    ("A_fig_55", "An image projected onto the teapot", projected_teapot),
    ("A_fig_58", "A cube map on bodies, and behind them", mirrored_surroundings),
    ("A_fig_59", "Texture coordinates: a hundred tiles, several images", texture_coordinates),
]
