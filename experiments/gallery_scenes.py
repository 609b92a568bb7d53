"""The sources' shaded pictures: lights, shadows, fractals, culling, the frustum, patches."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from gallery_drawings import hill, side_by_side
from jax import Array

import diffrast as dr
from diffrast import lines as dl

WHITE = (1.0, 1.0, 1.0)
SKY = (0.9, 0.93, 1.0)
GOLDEN = (1 + np.sqrt(5)) / 2


def shaded(
    objects: Sequence[dr.Object],
    lights: Sequence[Any],
    size: int,
    *,
    eye: Sequence[float] = (6.5, -6.0, 5.2),
    target: Sequence[float] = (0, 0, 1.4),
    fov_y: float = 0.7,
    near: float = 0.1,
    far: float = 60.0,
    shading: str = "phong",
    background: Any = WHITE,
    cull: bool = False,
    up: Sequence[float] = (0, 0, 1),
) -> Array:
    camera = dr.Camera.perspective(eye=eye, target=target, up=up, fov_y=fov_y, near=near, far=far)
    # Samples instead of edges: each structure of a scene then compiles in a third of the time.
    settings = dr.RenderSettings(
        height=size, width=size, shading=shading, samples=4, antialias=False, cull_backfaces=cull
    )
    scene = dr.Scene(objects=list(objects), lights=list(lights), background=background)
    return jnp.clip(dr.render(scene, camera, settings), 0, 1)


def sun(
    direction: Sequence[float] = (0.6, 0.5, -0.75),
    diffuse: Sequence[float] = (0.85, 0.85, 0.85),
    ambient: float = 0.15,
    specular: Sequence[float] = (0, 0, 0),
    shadow: dr.Shadow | None = None,
) -> dr.DirectionalLight:
    return dr.DirectionalLight(
        direction=direction,
        ambient=(ambient,) * 3,
        diffuse=diffuse,
        specular=specular,
        shadow=shadow,
    )


def teapot(material: dr.Material | None = None, divisions: int = 10) -> dr.Object:
    return dr.Object(dr.shapes.teapot(divisions), material or dr.Material(diffuse=WHITE))


def placed(
    mesh: dr.Mesh, material: dr.Material, place: Sequence[float], scale: Sequence[float] = (1, 1, 1)
) -> dr.Object:
    placing = dr.linalg.compose(dr.linalg.translation(place), dr.linalg.scaling(scale))
    return dr.Object(mesh, material, placing)


def at(mesh: dr.Mesh, color: Sequence[float], x: float, y: float, z: float, s: float = 1.0) -> Any:
    return placed(mesh, dr.Material(diffuse=color), (x, y, z), (s, s, s))


def solids() -> list[dr.Object]:
    return [
        at(dr.shapes.cube(), (0.8, 0.3, 0.2), 0, 0, 0.8, 0.8),
        at(dr.shapes.dodecahedron(), (0.2, 0.6, 0.3), 2.4, 0.4, 0.9),
        at(dr.shapes.icosahedron(), (0.2, 0.4, 0.8), -2.2, 0.6, 0.9),
        at(dr.shapes.octahedron(), (0.85, 0.7, 0.2), 0.4, 2.6, 1.0),
        at(dr.shapes.plane(12.0, 12.0), (0.6, 0.6, 0.6), 0, 0, 0),
    ]


def culling(size: int) -> Array:
    open_tube = dr.shapes.cylinder(1.2, 3.0, caps=False)
    thing = [at(open_tube, (0.8, 0.5, 0.2), 0, 0, 1.5)]
    lights = [sun(ambient=0.3)]
    return side_by_side([shaded(thing, lights, size, cull=cull) for cull in (False, True)])


def fields_of_view(size: int) -> Array:
    view = {"eye": (3.2, -2.6, 1.5), "target": (0, 0, 0.9)}
    degrees = (45, 90, 135)
    return side_by_side(
        [shaded(solids(), [sun()], size, fov_y=np.radians(d), **view) for d in degrees]
    )


def frustum(size: int) -> Array:
    """What a camera sees, and from farther away what the clipper has left of the objects."""
    view: dict[str, Any] = {"eye": (3.5, -4.5, 2.6), "target": (0, 0.3, 0.9), "fov_y": 0.55}
    camera = dr.Camera.perspective(**view, up=(0, 0, 1), near=3.0, far=7.5)
    parts = []
    for item in solids():
        world = dr.mesh.transform(item.mesh, item.transform)
        parts.append(dr.Object(dr.clip.clip_mesh(world, camera), item.material))
    seen = shaded(parts, [sun()], size, **view)
    return side_by_side(
        [seen, shaded(parts, [sun()], size, eye=(7.5, -5.5, 6.5), target=(0, 0, 0.8))]
    )


def fractals(size: int) -> Array:
    kinds = [
        (dr.shapes.cube, 3.0, 2, (0.8, 0.3, 0.2)),
        (dr.shapes.octahedron, 2.0, 4, (0.2, 0.6, 0.3)),
        (dr.shapes.tetrahedron, 2.0, 5, (0.85, 0.7, 0.2)),
        (dr.shapes.dodecahedron, 2 + GOLDEN, 2, (0.2, 0.4, 0.8)),
    ]
    images = []
    for solid, scale, steps, color in kinds:
        mesh = dr.shapes.fractal(solid(), steps, scale)
        reach = float(jnp.linalg.norm(mesh.vertices, axis=1).max())
        eye = np.array([2.4, -2.1, 1.7]) * reach
        images.append(
            shaded(
                [dr.Object(mesh, dr.Material(diffuse=color))],
                [sun()],
                size // 2,
                eye=eye,
                target=(0, 0, 0),
                fov_y=0.6,
            )
        )
    return side_by_side(images, 2)


def buckyball_fractal(size: int) -> Array:
    mesh = dr.shapes.fractal(dr.shapes.buckyball(), 2, 1 + 3 * GOLDEN)
    ball = dr.Object(mesh, dr.Material(diffuse=(0.9, 0.5, 0.15)))
    return shaded([ball], [sun()], size, eye=(2.6, -2.3, 1.8), target=(0, 0, 0), fov_y=0.55)


def sponge(size: int) -> Array:
    view: dict[str, Any] = {"eye": (3.4, -3.0, 2.4), "target": (0, 0, 0), "fov_y": 0.75}
    camera = dr.Camera.perspective(**view, up=(0, 0, 1), near=0.1, far=60)
    lattice = dr.shapes.menger_sponge(3, flat=False)
    edges = dl.mesh_edges(lattice)
    wire = dr.draw_lines_with_depth(
        dr.world_to_clip(camera, lattice.vertices),
        edges,
        (0, 0, 0),
        height=size,
        width=size,
        background=WHITE,
        line_width=0.25,
    )
    solid = dr.Object(dr.shapes.menger_sponge(3), dr.Material(diffuse=(0.75, 0.6, 0.3)))
    return side_by_side([wire, shaded([solid], [sun()], size, **view)])


def two_lights(size: int) -> Array:
    red = sun((0.8, 0.5, -0.4), (1, 0.1, 0.05), 0.0)
    yellow = sun((-0.8, 0.3, -0.5), (0.9, 0.8, 0.1), 0.0)
    dark = {"background": (0.1, 0.1, 0.1)}
    return side_by_side(
        [shaded([teapot()], lights, size, **dark) for lights in ([red], [yellow], [red, yellow])]
    )


def infinite_and_point(size: int) -> Array:
    lamp = dr.PointLight(
        position=(0.2, -0.6, 3.2), ambient=(0.1,) * 3, diffuse=WHITE, specular=(0,) * 3
    )
    return side_by_side([shaded(solids(), [light], size) for light in (sun(), lamp)], 1)


def spot(size: int) -> Array:
    lamp = dr.SpotLight(
        position=(1.0, -2.0, 6.0),
        direction=(-0.1, 0.35, -1.0),
        cutoff=0.5,
        ambient=(0.08,) * 3,
        diffuse=WHITE,
        specular=(0, 0, 0),
    )
    floor = at(dr.shapes.plane(14.0, 14.0), (0.6, 0.6, 0.6), 0, 0, 0)
    return shaded([*solids()[:-1], floor], [lamp], size, background=(0.02, 0.02, 0.05))


def highlights(size: int) -> Array:
    light = dr.DirectionalLight(
        direction=(-0.5, 0.6, -0.7),
        ambient=(0.2, 0, 0),
        diffuse=(0.3, 0, 0),
        specular=(0.5, 0, 0),
    )
    images = []
    for shininess in (2.0, 10.0, 50.0, 250.0):
        material = dr.Material(diffuse=WHITE, specular=WHITE, shininess=shininess)
        images.append(shaded([teapot(material)], [light], size // 2))
    # The source shows its numbers as they are, not encoded as sRGB.
    return dr.color.srgb_to_linear(side_by_side(images, 2))


def contributions(size: int) -> Array:
    gold = dr.Material(diffuse=(0.75, 0.5, 0.15), specular=(0.8, 0.7, 0.5), shininess=30.0)
    parts = [(0.2, 0, 0), (0, 0.6, 0), (0, 0, 0.8), (0.2, 0.6, 0.8)]
    images = []
    for ambient, diffuse, specular in parts:
        light = sun(diffuse=(diffuse,) * 3, ambient=ambient, specular=(specular,) * 3)
        images.append(shaded([teapot(gold)], [light], size // 2, background=(0, 0, 0)))
    return side_by_side(images, 2)


def shadows(size: int) -> Array:
    cast = dr.Shadow(resolution=800)
    return side_by_side(
        [shaded(solids(), [sun(shadow=s)], size, background=SKY) for s in (cast, None)], 1
    )


def shadow_resolutions(size: int) -> Array:
    images = []
    for resolution in (50, 800):
        light = sun(shadow=dr.Shadow(resolution=resolution))
        images.append(shaded(solids(), [light], size, background=SKY))
    return side_by_side(images)


def own_normals(size: int) -> Array:
    ball = dr.shapes.icosphere(1)
    light = sun(specular=(0.4, 0.4, 0.4))
    material = dr.Material(diffuse=(0.3, 0.5, 0.8), specular=(0.5, 0.5, 0.5))
    view = {"eye": (2.2, -2.6, 1.5), "target": (0, 0, 0), "fov_y": 0.7}
    return side_by_side(
        [
            shaded([dr.Object(ball, material)], [light], size, shading=s, **view)
            for s in ("flat", "phong")
        ]
    )


def green_teapot(size: int) -> Array:
    material = dr.Material(diffuse=(0.1, 0.55, 0.2), specular=WHITE, shininess=40.0)
    light = sun((-0.75, -0.55, -0.4), (0.9, 0.9, 0.9), 0.1, (0.7, 0.7, 0.7))
    return shaded([teapot(material)], [light], size, background=(0.05, 0.05, 0.08))


def clay_teapot(size: int) -> Array:
    """Without faces that turn away the handle shows through the lid's rim."""
    material = dr.Material(diffuse=(0.7, 0.35, 0.2), specular=(0.4, 0.35, 0.3), shininess=15.0)
    light = sun((0.4, -0.2, -0.9), (0.9, 0.9, 0.9), 0.15, (0.6, 0.6, 0.6))
    view = {"eye": (-4.5, -5.5, 6.0), "cull": True, "background": (0.05, 0.05, 0.08)}
    return shaded([teapot(material)], [light], size, **view)


def pierced_patches(size: int) -> Array:
    centred = hill() - [1.5, 3.0, 0.6]
    tilt = np.asarray(dr.linalg.rotation_x(0.35))[:3, :3]
    turned = (centred * [1, 1, -1] + [0.5, 0.4, 0.7]) @ tilt.T
    objects = [
        dr.Object(dr.shapes.bezier_mesh(control[None], 24), dr.Material(diffuse=color))
        for control, color in ((centred, (0.2, 0.5, 0.85)), (turned, (0.9, 0.6, 0.15)))
    ]
    view = {"eye": (7.5, -4.5, 3.5), "target": (0, 0, 0), "fov_y": 0.85}
    return shaded(objects, [sun(ambient=0.3)], size, **view)


def head() -> dr.Mesh:
    """A sphere bent to a head: a chin, a nose and two hollows."""
    ball = dr.shapes.icosphere(4)
    v = np.array(ball.vertices)

    def bump(place: Sequence[float], width: float) -> np.ndarray:
        return np.exp(-np.sum((v - place) ** 2, axis=1) / width**2)

    r = 1 + 0.28 * bump((0, -0.99, -0.1), 0.22) + 0.1 * bump((0, -0.7, -0.75), 0.45)
    r -= 0.12 * (bump((0.36, -0.9, 0.2), 0.2) + bump((-0.36, -0.9, 0.2), 0.2))
    r -= 0.05 * bump((0, -0.9, -0.45), 0.15)
    shape = v * r[:, None] * [0.8, 0.95, 1.15]
    return dr.mesh.with_normals(dr.Mesh(vertices=shape, faces=ball.faces))


def trunk() -> dr.Mesh:
    """A tube that narrows, leans and has ribs."""
    tube = dr.shapes.cylinder(1.0, 4.0, segments=48, divisions=32, caps=False)
    x, y, z = np.array(tube.vertices).T
    height = (z + 2) / 4
    ribs = 1 + 0.06 * np.sin(9 * np.arctan2(y, x) + 4 * height) + 0.03 * np.sin(30 * height)
    r = ribs * (0.45 + 0.55 * (1 - height) ** 2)
    shape = np.stack([x * r + 0.6 * height**2, y * r, z], axis=1)
    return dr.mesh.with_normals(dr.Mesh(vertices=shape, faces=tube.faces))


def four_meshes(size: int) -> Array:
    images = []
    for mesh, color in (
        (dr.shapes.icosphere(2), (0.8, 0.8, 0.8)),
        (dr.shapes.cube(), (0.3, 0.6, 0.8)),
        (head(), (0.85, 0.65, 0.5)),
        (trunk(), (0.5, 0.35, 0.2)),
    ):
        reach = float(jnp.linalg.norm(mesh.vertices, axis=1).max())
        eye = np.array([1.4, -3.2, 0.9]) * reach
        thing = dr.Object(mesh, dr.Material(diffuse=color))
        images.append(
            shaded([thing], [sun((-0.6, 0.7, -0.5))], size // 2, eye=eye, target=(0, 0, 0))
        )
    return side_by_side(images, 2)


FIGURES = [
    ("A_fig_27", "An open tube without and with back-face culling", culling),
    ("A_fig_31", "Fields of view of 45, 90 and 135 degrees", fields_of_view),
    ("A_fig_32", "What is in the frustum, and the clipped objects from outside", frustum),
    ("A_fig_34", "Fractals of cube, octahedron, tetrahedron and dodecahedron", fractals),
    ("A_fig_35", "Fractal of the buckyball, scale 1 + 3 (1 + sqrt 5)/2", buckyball_fractal),
    ("A_fig_36", "Menger sponge of 8000 cubes, as lines and solid", sponge),
    ("A_fig_39", "White teapot in red light, yellow light, and both", two_lights),
    ("A_fig_40", "Light at infinity (top) and a point light (bottom)", infinite_and_point),
    ("A_fig_41", "Spot light", spot),
    ("A_fig_43_44", "Shininess of 2, 10, 50 and 250", highlights),
    ("A_fig_45", "Ambient, diffuse and specular parts, and their sum", contributions),
    ("A_fig_48", "With (top) and without shadows", shadows),
    ("A_fig_49", "Shadow maps of 50 and of 800 texels", shadow_resolutions),
    ("A_fig_60", "Without and with normals of its own", own_normals),
    ("C_photo_1", "Green teapot lit from the right", green_teapot),
    ("C_photo_2", "Turned, clay, another light, back faces removed", clay_teapot),
    ("C_photo_4", "Two bicubic patches piercing each other", pierced_patches),
    ("D_meshes", "Icosphere, cube, a head and a trunk of our own", four_meshes),
]
