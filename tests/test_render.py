"""Rendering: the oracle's pictures and derivatives, every transformation, no needless work."""

import re
from collections import Counter
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scenes
from jax.flatten_util import ravel_pytree
from scenes import HEIGHT, WIDTH, settings
from scipy.linalg import expm

import diffrast as dr
from diffrast import linalg, shapes
from diffrast.camera import pixel_rays, viewpoint

pytestmark = pytest.mark.usefixtures("compiled_quickly")

NOISE = np.random.default_rng(0).uniform(size=(HEIGHT, WIDTH, 3)).astype(np.float32)

# ----------------------------------------------------------------------------------- the pictures

STYLES = {
    "phong": (settings(), scenes.BACKGROUND),
    "gouraud": (settings(shading="gouraud"), scenes.BACKGROUND),
    "flat": (settings(shading="flat", cull_backfaces=True), NOISE),
    "unlit": (settings(shading="unlit"), scenes.BACKGROUND),
}


def assert_equals_the_oracle(scene, camera, options):
    truth = scenes.oracle(scene, camera)
    clear = truth.clear()
    assert clear.mean() > 0.95
    got, want = dr.render(scene, camera, options), truth.image(options)
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(np.asarray(got)[clear], want[clear], atol=1e-5)


@pytest.mark.parametrize("view", scenes.CAMERAS)
@pytest.mark.parametrize("style", STYLES)
def test_image_equals_the_oracle(style, view):
    options, background = STYLES[style]
    assert_equals_the_oracle(scenes.many_objects(background), scenes.CAMERAS[view](), options)


@pytest.mark.parametrize("index", range(3))
def test_each_light_alone_equals_the_oracle(index):
    scene = scenes.many_objects()
    dark = jax.tree.map(jnp.zeros_like, scene.lights)
    dark = [replace(dark[0]), replace(dark[1], direction=(0, 0, -1)), replace(dark[2])]
    dark[index] = scene.lights[index]
    assert_equals_the_oracle(replace(scene, lights=dark), scenes.perspective(), settings())


def test_samples_of_a_dull_surface_without_normals_are_averaged():
    ball = shapes.icosphere(1)
    item = dr.Object(dr.Mesh(vertices=ball.vertices, faces=ball.faces))
    light = dr.DirectionalLight(direction=(-0.5, -1.0, -1.5), diffuse=(0.4, 0.7, 0.5))
    scene = dr.Scene(objects=[item], lights=[light], background=NOISE)
    camera, options = scenes.perspective((0.6, 1.2, 3.5)), settings(samples=16)
    truth = scenes.oracle(scene, camera)
    image, want = np.asarray(dr.render(scene, camera, options)), truth.image(options, samples=4)
    clear = truth.clear(samples=4)
    assert clear.mean() > 0.8
    np.testing.assert_allclose(image[clear], want[clear], atol=1e-5)
    # Elsewhere a sample of sixteen may be seen otherwise.
    assert np.mean(np.abs(image - want).max(axis=-1) > 1e-5) < 0.002
    np.testing.assert_allclose(image, want, atol=1.1 / 16)


def test_culling_drops_the_inside_of_open_objects_only():
    scene, camera = scenes.many_objects(), scenes.perspective()
    truth = scenes.oracle(scene, camera)
    seen = [truth.fragments(cull_backfaces=cull).face for cull in (False, True)]
    dropped = seen[0] != seen[1]
    assert dropped.sum() > 20
    assert np.all(truth.object_of_face[seen[0][dropped]] == 2)


def test_what_is_out_of_view_leaves_exactly_the_background():
    camera, background = scenes.perspective(), np.float32(scenes.BACKGROUND)
    for shift in ((0, 0, 20.0), (50.0, 0, 0), (0, 0, -100.0), (0, -3.5, 0.0)):
        image = dr.render(scenes.one_object(shift), camera, settings())
        np.testing.assert_array_equal(image, np.broadcast_to(background, image.shape))


@pytest.mark.parametrize("background", [scenes.BACKGROUND, NOISE], ids=["colour", "image"])
def test_empty_scene(background):
    background = np.float32(background)
    scene = dr.Scene(objects=[], lights=scenes.one_object().lights, background=background)
    image = dr.render(scene, scenes.perspective(), settings(samples=4))
    np.testing.assert_array_equal(image, np.broadcast_to(background, (HEIGHT, WIDTH, 3)))
    buffers = dr.render_buffers(scene, scenes.perspective(), settings())
    np.testing.assert_array_equal([buffers.face, buffers.object], -1)
    assert buffers.position.shape == buffers.normal.shape == (HEIGHT, WIDTH, 3)
    assert not any(np.any(x) for x in (buffers.position, buffers.normal, buffers.inverse_depth))


# ------------------------------------------------------------------------------------ the buffers


@pytest.mark.parametrize("view", scenes.CAMERAS)
def test_buffers_equal_the_oracle(view):
    scene, camera = scenes.many_objects(), scenes.CAMERAS[view]()
    truth = scenes.oracle(scene, camera)
    want, clear = truth.fragments(), truth.clear()
    buffers = dr.render_buffers(scene, camera, settings())
    assert buffers.uv is None
    got = {k: np.asarray(v)[clear] for k, v in buffers._asdict().items() if v is not None}
    face, barycentrics = want.face[clear], want.barycentrics[clear]
    np.testing.assert_array_equal(got["face"], face)
    object_ = np.where(face < 0, -1, truth.object_of_face[face])
    np.testing.assert_array_equal(got["object"], object_)
    np.testing.assert_allclose(got["inverse_depth"], want.inverse_depth[clear], atol=1e-6)
    # The oracle's faces of the mirrored object are turned round; the library keeps the mesh's.
    own = np.where(object_[:, None] == 1, barycentrics[:, ::-1], barycentrics)
    np.testing.assert_allclose(got["barycentrics"], own, atol=2e-4)
    corners = truth.faces[face]
    position = np.einsum("nk,nkc->nc", barycentrics, truth.positions[corners])
    np.testing.assert_allclose(got["position"], position, atol=1e-4)
    normal = reference.normalize(np.einsum("nk,nkc->nc", barycentrics, truth.normals[corners]))
    np.testing.assert_allclose(got["normal"], normal, atol=3e-4)

    covered = np.asarray(buffers.face) >= 0
    length = np.linalg.norm(buffers.normal, axis=-1)
    np.testing.assert_allclose(length, covered, atol=1e-6)
    np.testing.assert_allclose(np.sum(buffers.barycentrics, axis=-1), covered, atol=1e-6)
    # A point lies on its pixel's ray: it is seen in the direction of the ray.
    eye, rays = viewpoint(camera), pixel_rays(camera, height=HEIGHT, width=WIDTH)
    to_viewer = eye[:3] - eye[3] * buffers.position
    np.testing.assert_allclose(np.cross(to_viewer, rays)[covered], 0, atol=1e-5)


def test_buffers_of_a_rectangle_in_closed_form():
    tetrahedron = shapes.tetrahedron(flat=False)
    scene = dr.Scene(
        objects=[
            dr.Object(shapes.plane(4.0, 2.0), transform=linalg.translation((0.0, 0.0, 1.0))),
            dr.Object(tetrahedron, transform=linalg.translation((0.0, 4.0, 0.0))),
        ]
    )
    camera = dr.Camera.perspective(
        eye=(0, 0, 5), target=(0, 0, 0), fov_y=np.pi / 2, aspect=WIDTH / HEIGHT, near=1, far=9
    )
    buffers = dr.render_buffers(scene, camera, settings(shading="flat"))
    x = (2 * (np.arange(WIDTH) + 0.5) / WIDTH - 1) * 4 * WIDTH / HEIGHT
    y = (1 - 2 * (np.arange(HEIGHT)[:, None] + 0.5) / HEIGHT) * 4
    inside = (np.abs(x) < 2) & (np.abs(y) < 1)
    seen = np.asarray(buffers.object)
    assert np.all((seen == 0) == inside)
    assert np.any(seen == 1)
    position = np.stack(np.broadcast_arrays(x, y, 1.0), axis=-1)
    known = {k: v for k, v in buffers._asdict().items() if v is not None}
    got = {k: np.asarray(v)[inside] for k, v in known.items()}
    np.testing.assert_allclose(got["position"], position[inside], atol=1e-5)
    np.testing.assert_allclose(got["uv"], (position[inside][:, :2] / [4, 2]) + 0.5, atol=1e-5)
    np.testing.assert_allclose(got["normal"], np.tile([0, 0, 1.0], (inside.sum(), 1)), atol=1e-6)
    np.testing.assert_allclose(got["inverse_depth"], 1 / 4, rtol=1e-6)
    # What has no texture coordinates has zeros.
    np.testing.assert_array_equal(np.asarray(buffers.uv)[seen != 0], 0)


# ------------------------------------------------------------------------------- transformations


def varied(tree):
    """Three copies, stacked, a little different from each other."""
    steps = 0.05 * np.arange(3, dtype=np.float32)
    return jax.tree.map(lambda x: jnp.stack([x + step for step in steps]), tree)


def render_parts(parts):
    scene = scenes.one_object()
    item = dr.Object(scene.objects[0].mesh, parts["material"], parts["transform"])
    return dr.render(
        replace(scene, objects=(item,), lights=parts["lights"]), parts["camera"], settings()
    )


@pytest.mark.parametrize("batched", [("camera",), ("transform",), ("lights", "material")], ids=str)
def test_vmap_is_a_stack_of_single_renders(batched):
    scene = scenes.one_object()
    item = scene.objects[0]
    eyes = ((0.6, 1.2, 6.0), (-3.0, 1.0, 4.0), (0.0, -4.0, 3.0))
    alone = {
        "camera": scenes.perspective(),
        "transform": item.transform,
        "lights": scene.lights,
        "material": item.material,
    }
    stacks = {
        **{name: varied(part) for name, part in alone.items()},
        "camera": dr.stack_cameras([scenes.perspective(eye) for eye in eyes]),
    }
    parts = {name: (stacks if name in batched else alone)[name] for name in alone}
    in_axes = {name: 0 if name in batched else None for name in alone}
    images = jax.vmap(render_parts, in_axes=(in_axes,))(parts)
    for index, image in enumerate(images):
        one = {name: jax.tree.map(lambda x, i=index: x[i], stacks[name]) for name in batched}
        np.testing.assert_allclose(image, render_parts({**alone, **one}), atol=1e-5)
    assert np.abs(images[1] - images[0]).max() > 0.03


# ------------------------------------------------------------------------------------ derivatives


def rigid_motion(twist):
    velocity, (x, y, z) = twist[:3], twist[3:]
    generator = np.array([[0, -z, y, 0], [z, 0, -x, 0], [-y, x, 0, 0], [0, 0, 0, 0.0]])
    generator[:3, 3] = velocity
    return expm(generator)


def changed_lights(lights, direction, position):
    return (
        replace(lights[0], direction=lights[0].direction + direction),
        replace(lights[1], position=lights[1].position + position),
    )


def test_jacobian_equals_central_differences_of_the_oracle():
    """In camera pose, direction and position of lights, with nothing but walls in view."""
    scene, camera = scenes.room(), scenes.inside()

    @jax.jit
    def jacobian(parameters):
        def image(parameters):
            twist, direction, position = jnp.split(parameters, [6, 9])
            lights = changed_lights(scene.lights, direction, position)
            moved = replace(camera, view=linalg.compose(linalg.se3_exp(twist), camera.view))
            image = dr.render(replace(scene, lights=lights), moved, settings())
            return image, image

        return jax.jacfwd(image, has_aux=True)(parameters)

    def truth(parameters):
        twist, direction, position = np.split(parameters, [6, 9])
        view = rigid_motion(twist) @ np.asarray(camera.view, float)
        oracle = scenes.Oracle(scene, view, camera.projection)
        oracle.lights[0]["direction"] = oracle.lights[0]["direction"] + direction
        oracle.lights[1]["position"] = oracle.lights[1]["position"] + position
        return oracle

    fragments = truth(np.zeros(12)).fragments()
    assert fragments.face.min() >= 0
    assert fragments.edge_distance.min() > 0.005
    slopes, image = jacobian(jnp.zeros(12))
    np.testing.assert_allclose(image, truth(np.zeros(12)).image(settings()), atol=1e-5)
    step = 1e-6
    for slope, change in zip(np.moveaxis(slopes, -1, 0), step * np.eye(12), strict=True):
        ahead, behind = truth(change).image(settings()), truth(-change).image(settings())
        difference = (ahead - behind) / (2 * step)
        size = np.abs(difference).max()
        assert size > 0.05
        np.testing.assert_allclose(slope, difference, atol=1e-3 * size)


def test_derivatives_in_everything_agree_to_second_order():
    """In float64: a loss, its slope forward and backward, and the slope of its gradient."""
    with jax.enable_x64(True):
        scene, camera = scenes.room(), scenes.inside()
        item, point_light = scene.objects[0], scene.lights[1]
        mesh, looks = item.mesh, (item.material, item.transform)
        start, unravel = ravel_pytree(
            (mesh.vertices, mesh.normals, looks, point_light, (camera.view, camera.projection))
        )
        weights = np.random.default_rng(1).normal(size=(HEIGHT, WIDTH, 3))

        def loss(parameters):
            vertices, normals, looks, light, (view, projection) = unravel(parameters)
            moved = dr.Mesh(vertices=vertices, faces=mesh.faces, normals=normals)
            scene = dr.Scene(objects=[dr.Object(moved, *looks)], lights=[light])
            image = dr.render(scene, dr.Camera(view=view, projection=projection), settings())
            assert image.dtype == jnp.float64
            return jnp.mean(weights * image**2)

        @jax.jit
        def derivatives(parameters, direction):
            return jax.jvp(jax.value_and_grad(loss), (parameters,), (direction,))

        direction = np.random.default_rng(2).normal(size=start.shape)
        step = 1e-6
        (_, gradient), (slope, curvature) = derivatives(start, direction)
        ahead, _ = derivatives(start + step * direction, direction)
        behind, _ = derivatives(start - step * direction, direction)
        np.testing.assert_allclose(gradient @ direction, slope, rtol=1e-10)
        np.testing.assert_allclose((ahead[0] - behind[0]) / (2 * step), slope, rtol=1e-5)
        difference = (ahead[1] - behind[1]) / (2 * step)
        assert np.isfinite(gradient).all()
        assert np.abs(difference).max() > 1e-3
        np.testing.assert_allclose(curvature, difference, atol=1e-5 * np.abs(difference).max())


@pytest.mark.parametrize("shading", ["phong", "gouraud"])
def test_vertices_of_no_face_may_hold_anything(shading):
    """The derivatives are those of the mesh without them, by what all vertices share, too."""
    scene, camera = scenes.one_object(), scenes.perspective()
    item = scene.objects[0]
    mesh, beside = item.mesh, np.float32([[np.nan, 1, 1], [np.inf, -np.inf, 0], [1, 2, -np.inf]])
    weights = jnp.asarray(NOISE)

    @jax.jit
    def gradient(vertices, normals):
        def loss(vertices, normals, transform, camera):
            mesh = dr.Mesh(vertices=vertices, faces=item.mesh.faces, normals=normals)
            moved = replace(scene, objects=[dr.Object(mesh, item.material, transform)])
            return jnp.vdot(weights, dr.render(moved, camera, settings(shading=shading)))

        return jax.grad(loss, argnums=(0, 1, 2, 3))(vertices, normals, item.transform, camera)

    want = gradient(mesh.vertices, mesh.normals)
    got = gradient(*(np.concatenate([own, beside]) for own in (mesh.vertices, mesh.normals)))
    for by_vertices in got[:2]:
        np.testing.assert_array_equal(by_vertices[-3:], 0)
    same = (got[0][:-3], got[1][:-3], *got[2:])
    for one, other in zip(jax.tree.leaves(same), jax.tree.leaves(want), strict=True):
        assert np.isfinite(one).all()
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4 * np.abs(other).max())


@pytest.mark.parametrize("shading", ["phong", "gouraud", "flat"])
@pytest.mark.parametrize("number", [0, 50])
def test_faces_whose_vertices_are_not_finite_are_left_out(shading, number):
    """Also the first one, at which the background looks: the derivatives are those without it."""
    scene, camera = scenes.one_object(), scenes.perspective()
    item, weights = scene.objects[0], jnp.asarray(NOISE)
    own = np.asarray(item.mesh.faces)
    lost = own[number, 0]

    def gradient(vertices, faces):
        def loss(vertices, transform, camera, lights):
            mesh = dr.Mesh(vertices=vertices, faces=faces, normals=item.mesh.normals)
            item_there = dr.Object(mesh, item.material, transform)
            moved = replace(scene, objects=[item_there], lights=lights)
            return jnp.vdot(weights, dr.render(moved, camera, settings(shading=shading)))

        of_all = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))
        return of_all(vertices, item.transform, camera, scene.lights)

    got = gradient(item.mesh.vertices.at[lost].set(jnp.nan), own)
    want = gradient(item.mesh.vertices, own[~np.any(own == lost, axis=1)])
    for one, other in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        assert np.isfinite(one).all()
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4 * np.abs(other).max())


# ------------------------------------------------------------------------------- only what is used


PIXELS = f"{HEIGHT}x{WIDTH}xf32"
VERTICES = 46


def operations(function, *arguments):
    """How often each operation stands in the program, by its name and the type of its result."""
    counts, open_regions = Counter(), []
    for line in function.lower(*arguments).as_text().splitlines():
        name, types = re.search(r"stablehlo\.(\w+)", line), re.findall(r"tensor<([^>]*)>", line)
        if name and line.endswith("({"):  # its type stands where its region closes
            open_regions.append(name[1])
        elif line.strip().startswith("}) :"):
            counts[open_regions.pop(), types[-1]] += 1
        elif name and types:
            counts[name[1], types[-1]] += 1
    return counts


def times(counts, *names):
    return sum(count for (name, _), count in counts.items() if name in names)


def ball(material=None):
    mesh = shapes.uv_sphere(segments=7, rings=5)
    assert mesh.vertices.shape[0] == VERTICES
    assert mesh.uvs is not None
    return dr.Object(mesh, material)


SHINY = {"specular": (0.5, 0.5, 0.5)}
LIGHTS = {
    "ambient": {"color": (1, 1, 1)},
    "directional": {"direction": (0, 0, -1)},
    "point": {"position": (1, 2, 3)},
}
# Values fetched at every pixel: for the fragments x, y, w of three corners; then the normals'
# components at three corners (but one for a face), then the positions'. Roots: one to normalise.
PRICES = {  # lights, material, shading: values fetched, roots, exponentials at every pixel
    "dull under a directional light": (["directional"], {}, "phong", (9 + 9, 1, 0)),
    "ambient light only": (["ambient"], {}, "phong", (0, 0, 0)),
    "ambient light only, shiny": (["ambient"], SHINY, "phong", (0, 0, 0)),
    "ambient light added": (["ambient", "directional"], {}, "phong", (9 + 9, 1, 0)),
    "point light": (["point"], {}, "phong", (9 + 9 + 9, 2, 0)),
    "shiny": (["directional"], SHINY, "phong", (9 + 9, 2, 1)),
    "flat": (["directional"], {}, "flat", (3, 1, 0)),
    "gouraud": (["point"], SHINY, "gouraud", (9 + 9, 0, 0)),
    "unlit": (["point"], SHINY, "unlit", (0, 0, 0)),
}


@pytest.mark.parametrize("case", PRICES)
def test_the_program_holds_only_what_the_scene_needs(case):
    names, material, shading, price = PRICES[case]
    kinds = {
        "ambient": dr.AmbientLight, "directional": dr.DirectionalLight, "point": dr.PointLight,
    }  # fmt: skip
    lights = [kinds[name](**LIGHTS[name]) for name in names]
    scene = dr.Scene(objects=[ball(dr.Material(**material))], lights=lights)
    counts = operations(dr.render, scene, scenes.perspective(), settings(shading=shading))
    at_pixels = ("gather", "sqrt", "exponential")
    assert tuple(counts[name, PIXELS] for name in at_pixels) == price
    if not material or shading == "unlit" or names == ["ambient"]:
        assert times(counts, "exponential", "log") == 0
    if shading == "unlit" or names == ["ambient"]:
        assert times(counts, "sqrt") == 0
    # Nothing reads the texture coordinates.
    assert not any(
        kind.startswith((f"{VERTICES}x2x", f"{HEIGHT}x{WIDTH}x2x")) for _, kind in counts
    )


def test_a_gradient_in_lights_only_has_no_part_for_the_geometry():
    scene = dr.Scene(
        objects=[ball(dr.Material(**SHINY))],
        lights=[dr.DirectionalLight(direction=(0, 0, -1)), dr.PointLight(position=(1, 2, 3))],
    )
    camera = scenes.perspective()

    def loss(lights, vertices):
        item = replace(scene.objects[0], mesh=replace(scene.objects[0].mesh, vertices=vertices))
        return jnp.sum(dr.render(replace(scene, objects=[item], lights=lights), camera, settings()))

    arguments = scene.lights, scene.objects[0].mesh.vertices
    counts = [operations(jax.jit(jax.grad(loss, n)), *arguments) for n in (0, 1)]
    to_vertices = [c["scatter", f"{VERTICES}xf32"] for c in counts]
    assert to_vertices[0] == 0
    assert to_vertices[1] > 0


def test_other_values_are_not_compiled_again():
    scene, camera = scenes.one_object(), scenes.perspective()
    dr.render(scene, camera, settings())
    compiled = dr.render._cache_size()
    others = (scenes.one_object(shift=(0.1, 0.2, 0.3)), camera), (scene, scenes.parallel())
    for other in others:
        dr.render(*other, settings())
    assert dr.render._cache_size() == compiled


# --------------------------------------------------------------------------------------- bad input


MESH = shapes.cube


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dr.Object("cube"), "mesh: wanted a Mesh, got str"),
        (lambda: dr.Object(MESH(), "red"), "material: wanted a Material, got str"),
        (lambda: dr.Object(MESH(), transform=np.eye(3)), r"transform: wanted shape \(4, 4\)"),
        (lambda: dr.Object(MESH(), transform=np.full((4, 4), np.nan)), "transform: wanted finite"),
        (lambda: dr.Scene(objects=dr.Object(MESH())), "objects: wanted a tuple or list, got Obje"),
        (lambda: dr.Scene(objects=[MESH()]), r"objects\[0\]: wanted Object, got Mesh"),
        (
            lambda: dr.Scene(objects=[], lights=[dr.AmbientLight((1, 1, 1)), "sun"]),
            r"lights\[1\]: wanted AmbientLight or DirectionalLight or .* or SpotLight, got str",
        ),
        (lambda: dr.Scene(objects=[], background=(1, 1)), r"background: wanted shape \(3,\) or"),
        (lambda: dr.Scene(objects=[], background=np.ones((2, 3))), "background: wanted shape"),
        (lambda: dr.Scene(objects=[], background=(0, np.inf, 0)), "background: wanted finite"),
        (lambda: dr.RenderSettings(height=0, width=5), "height: wanted an integer of at least 1"),
        (lambda: dr.RenderSettings(height=5, width=2.5), "width: wanted an integer of at least 1"),
        (lambda: settings(shading="toon"), "shading: wanted one of phong, gouraud, flat, unlit"),
        (lambda: settings(samples=8), "samples: wanted a square number, got 8"),
        (lambda: settings(samples=0), "samples: wanted an integer of at least 1, got 0"),
    ],
)
def test_errors_name_the_argument(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_background_of_another_size_is_an_error():
    scene = replace(scenes.one_object(), background=NOISE[:, :-1])
    message = "background: wanted an image of 48 rows and 64 columns, got 48 and 63"
    with pytest.raises(ValueError, match=message):
        dr.render(scene, scenes.perspective(), settings())


@pytest.mark.parametrize("function", [dr.render, dr.render_buffers])
def test_a_stack_of_cameras_is_an_error(function):
    cameras = dr.stack_cameras([scenes.perspective(), scenes.perspective()])
    for scene in (scenes.one_object(), dr.Scene(objects=[])):
        with pytest.raises(ValueError, match=r"camera: wanted a single camera, got a stack of"):
            function(scene, cameras, settings())
