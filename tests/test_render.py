"""Rendering: the oracle's pictures and derivatives, every transformation, no needless work."""

import re
from collections import Counter
from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
import reference
import scenes
from jax.flatten_util import ravel_pytree
from scenes import HEIGHT, WIDTH, settings
from scipy.linalg import expm

import diffrast as dr
from diffrast import linalg, shapes
from diffrast._stored import assemble, stored, stored_rows
from diffrast.camera import pixel_rays, viewpoint

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


def test_dull_surface_without_normals_equals_the_oracle():
    ball = shapes.icosphere(1)
    item = dr.Object(dr.Mesh(vertices=ball.vertices, faces=ball.faces))
    light = dr.DirectionalLight(direction=(-0.5, -1.0, -1.5), diffuse=(0.4, 0.7, 0.5))
    scene = dr.Scene(objects=[item], lights=[light])
    assert_equals_the_oracle(scene, scenes.perspective(), settings())


def test_samples_are_averaged_as_in_the_oracle():
    scene, camera = scenes.many_objects(NOISE), scenes.perspective()
    options, truth = settings(samples=16), scenes.oracle(scene, camera)
    image, want = np.asarray(dr.render(scene, camera, options)), truth.image(options, samples=4)
    clear = truth.clear(samples=4)
    assert clear.mean() > 0.8
    np.testing.assert_allclose(image[clear], want[clear], atol=1e-5)
    # Elsewhere one sample of sixteen may be seen otherwise.
    wrong = np.abs(image - want).max(axis=-1) > 1e-5
    assert wrong.mean() < 0.002
    np.testing.assert_allclose(image, want, atol=1.1 * image.max() / 16)


def test_culling_drops_the_inside_of_open_objects_only():
    scene, camera = scenes.many_objects(), scenes.perspective()
    truth = scenes.oracle(scene, camera)
    seen = [truth.fragments(cull_backfaces=cull).face for cull in (False, True)]
    dropped = seen[0] != seen[1]
    assert 20 < dropped.sum()
    assert np.all(truth.object_of_face[seen[0][dropped]] == 2)


def test_what_is_out_of_view_leaves_exactly_the_background():
    camera = scenes.perspective()
    for shift in ((0, 0, 20.0), (50.0, 0, 0), (0, 0, -100.0), (0, 0, 5.5)):
        image = dr.render(scenes.one_object(shift), camera, settings())
        np.testing.assert_array_equal(image, np.broadcast_to(scenes.BACKGROUND, image.shape))


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
    eye, rays = np.asarray(viewpoint(camera)), np.asarray(
        pixel_rays(camera, height=HEIGHT, width=WIDTH)
    )
    if eye[3]:
        beside = np.cross(np.asarray(buffers.position) - eye[:3], rays)
        np.testing.assert_allclose(beside[covered], 0, atol=2e-5)


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
    got = {k: np.asarray(v)[inside] for k, v in buffers._asdict().items()}
    np.testing.assert_allclose(got["position"], position[inside], atol=1e-5)
    np.testing.assert_allclose(got["uv"], (position[inside][:, :2] / [4, 2]) + 0.5, atol=1e-5)
    np.testing.assert_allclose(got["normal"], np.tile([0, 0, 1.0], (inside.sum(), 1)), atol=1e-6)
    np.testing.assert_allclose(got["inverse_depth"], 1 / 4, rtol=1e-6)
    # What has no texture coordinates has zeros.
    np.testing.assert_array_equal(np.asarray(buffers.uv)[seen != 0], 0)


# ------------------------------------------------------------------------------- transformations


def axes(tree, axis):
    return jax.tree.map(lambda _: axis, tree)


def varied(tree, count=3):
    """Stacked copies of a tree, a little different from each other."""
    rng = np.random.default_rng(1)
    return jax.tree.map(
        lambda x: x + jnp.asarray(rng.uniform(0, 0.1, (count, *x.shape)), x.dtype), tree
    )


def lookups(case):
    """Stacked arguments (objects' transforms, materials, lights, camera), and their axes."""
    scene, camera = scenes.one_object(), scenes.perspective()
    item = scene.objects[0]
    parts = {
        "transform": item.transform,
        "material": item.material,
        "lights": scene.lights,
        "camera": camera,
    }
    for name in case:
        parts[name] = varied(parts[name])
    if "camera" in case:
        eyes = ((0.6, 1.2, 6.0), (-3.0, 1.0, 4.0), (0.0, -4.0, 3.0))
        parts["camera"] = dr.stack_cameras([scenes.perspective(eye) for eye in eyes])
    return parts, {name: axes(part, 0 if name in case else None) for name, part in parts.items()}


def render_parts(parts):
    scene = scenes.one_object()
    item = dr.Object(scene.objects[0].mesh, parts["material"], parts["transform"])
    scene = replace(scene, objects=(item,), lights=parts["lights"])
    return dr.render(scene, parts["camera"], settings())


@pytest.mark.parametrize(
    "case", [("camera",), ("transform",), ("lights", "material")], ids=" and ".join
)
def test_vmap_is_a_stack_of_single_renders(case):
    parts, in_axes = lookups(case)
    images = jax.vmap(render_parts, in_axes=(in_axes,))(parts)
    assert images.shape == (3, HEIGHT, WIDTH, 3)
    for index, image in enumerate(images):
        single = {
            name: jax.tree.map(lambda x: x[index], part) if name in case else part
            for name, part in parts.items()
        }
        np.testing.assert_allclose(image, render_parts(single), atol=1e-5)
    assert np.abs(images[0] - images[1]).max() > 0.01


def test_other_values_are_not_compiled_again():
    scene, camera = scenes.one_object(), scenes.perspective()
    dr.render(scene, camera, settings())
    compiled = dr.render._cache_size()
    brighter, other = jax.tree.map(lambda x: x if x.dtype == jnp.int32 else 1.1 * x, scene), None
    other = scenes.parallel()
    images = [dr.render(s, c, settings()) for s in (scene, brighter) for c in (camera, other)]
    assert dr.render._cache_size() == compiled
    assert len({float(image.sum()) for image in images}) == 4
    dr.render(scene, camera, settings(shading="unlit"))
    assert dr.render._cache_size() == compiled + 1


# ------------------------------------------------------------------------------------ derivatives


def moved_room(parameters):
    """The room, its camera moved by a twist, its lights where the parameters say."""
    scene, camera = scenes.room(), scenes.inside()
    directional, point = scene.lights
    lights = (
        replace(directional, direction=directional.direction + parameters["direction"]),
        replace(point, position=point.position + parameters["position"]),
    )
    return replace(scene, lights=lights), camera


def test_jacobian_equals_central_differences_of_the_oracle():
    zero = {"direction": jnp.zeros(3), "position": jnp.zeros(3), "twist": jnp.zeros(6)}
    flat, unravel = ravel_pytree(zero)

    @jax.jit
    def jacobian(flat):
        def image(flat):
            parameters = unravel(flat)
            scene, camera = moved_room(parameters)
            view = linalg.se3_exp(parameters["twist"]) @ camera.view
            image = dr.render(scene, replace(camera, view=view), settings())
            return image, image

        return jax.jacfwd(image, has_aux=True)(flat)

    def truth(flat):
        parameters = jax.tree.map(np.asarray, unravel(np.zeros(12)))
        parts = np.split(flat, [3, 6])
        parameters = dict(zip(zero, parts, strict=True))
        scene, camera = scenes.room(), scenes.inside()
        velocity, (x, y, z) = parts[2][:3], parts[2][3:]
        generator = np.array([[0, -z, y, 0], [z, 0, -x, 0], [-y, x, 0, 0], [0, 0, 0, 0.0]])
        generator[:3, 3] = velocity
        oracle = scenes.Oracle(scene, expm(generator) @ np.asarray(camera.view, float), camera.projection)
        lights = oracle.lights()
        lights[0]["direction"] = lights[0]["direction"] + parameters["direction"]
        lights[1]["position"] = lights[1]["position"] + parameters["position"]
        oracle.lights = lambda: lights
        return oracle, oracle.image(settings())

    still, want = truth(np.zeros(12))
    fragments = still.fragments()
    assert fragments.face.min() >= 0
    assert fragments.edge_distance.min() > 0.005
    slope, image = jacobian(flat)
    np.testing.assert_allclose(image, want, atol=1e-5)
    step = 1e-6
    for index, direction in enumerate(step * np.eye(12)):
        difference = (truth(direction)[1] - truth(-direction)[1]) / (2 * step)
        size = np.abs(difference).max()
        assert size > 0.05
        np.testing.assert_allclose(slope[..., index], difference, atol=1e-3 * size, err_msg=index)
