"""Textures in scenes: what is seen, shared, filtered, differentiated, and what is not computed."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import check_derivatives
from jax.flatten_util import ravel_pytree
from scipy.ndimage import binary_erosion
from test_render import operations, times

import diffrast as dr
from diffrast import shapes

pytestmark = pytest.mark.usefixtures("compiled_quickly")

SIZE = 16
RNG = np.random.default_rng(0)
IMAGE = RNG.uniform(size=(16, 16, 3)).astype(np.float32)
LIGHT = dr.DirectionalLight(direction=(-0.3, -0.4, -1), ambient=(0.2, 0.1, 0.3))
CAMERA = dr.Camera.perspective(eye=(0.4, 0.3, 3), target=(0, 0, 0), fov_y=0.9, near=0.5, far=20)
WHITE = {"diffuse": (1, 1, 1)}


def settings(**options):
    return dr.RenderSettings(**{"height": SIZE, "width": SIZE, "antialias": False, **options})


def textured(mesh, texture, transform=None, **material):
    return dr.Object(mesh, dr.Material(**{**WHITE, **material, "texture": texture}), transform)


# -------------------------------------------------------------------------------- what is seen


def test_unlit_shows_what_sample_texture_gives():
    texture = dr.Texture(IMAGE, filter="trilinear", wrap="mirror")
    mesh = shapes.uv_sphere(segments=12, rings=8)
    scene = dr.Scene(objects=[textured(mesh, texture, diffuse=(0.9, 0.5, 0.7))])
    clip = dr.world_to_clip(CAMERA, mesh.vertices)
    fragments = dr.rasterize(clip, mesh.faces, height=SIZE, width=SIZE)
    uv = dr.interpolate(mesh.uvs, mesh.faces, fragments)
    steps = dr.screen_derivatives(mesh.uvs, clip, mesh.faces, fragments)
    want = dr.sample_texture(texture, uv, derivatives=steps) * np.float32([0.9, 0.5, 0.7])
    want = np.where(fragments.face[..., None] >= 0, want, 0)
    got = dr.render(scene, CAMERA, settings(shading="unlit"))
    np.testing.assert_allclose(got, want, atol=2e-6)


@pytest.mark.parametrize("shading", ["phong", "gouraud"])
def test_a_texture_multiplies_diffuse_and_ambient_light_but_no_highlight(shading):
    plain = {"specular": (0.5, 0.4, 0.3), "shininess": 5.0, "ambient": (0.5, 0.6, 0.7)}
    image = np.broadcast_to(np.float32([0.2, 0.5, 0.9]), (4, 4, 3))
    mesh = shapes.uv_sphere(segments=12, rings=8)
    scene = dr.Scene(objects=[textured(mesh, dr.Texture(image), **plain)], lights=[LIGHT])
    product = {"diffuse": (0.2, 0.5, 0.9), "ambient": (0.1, 0.3, 0.63)}
    want = replace(scene, objects=[dr.Object(mesh, dr.Material(**{**plain, **product}))])
    images = [dr.render(s, CAMERA, settings(shading=shading)) for s in (scene, want)]
    np.testing.assert_allclose(*images, atol=2e-6)


def test_many_textures_of_all_kinds_in_one_scene():
    """Also objects that have none, that share an image, that have uvs with their own indices."""
    other = RNG.uniform(size=(5, 9, 3)).astype(np.float32)
    cube = dr.CubeTexture(RNG.uniform(size=(6, 4, 4, 3)))
    square, ball = shapes.plane(), shapes.icosphere(1, 0.5)
    own = dr.Mesh(
        vertices=square.vertices, faces=square.faces, uvs=[(0, 0), (2, 0), (0, 3), (1, 1), (2, 2)],
        uv_faces=[(0, 1, 3), (4, 2, 0)],
    )  # fmt: skip
    shared, sphere = dr.Texture(IMAGE), dr.Texture(other, mapping=dr.SphereMapping())
    kinds = [
        (shapes.uv_sphere(0.5, segments=10, rings=6), shared),
        (square, dr.Texture(other)),
        (square, shared),
        (ball, sphere),
        (ball, cube),
        (own, dr.Texture(IMAGE[:3])),
        (shapes.cube(), None),
    ]
    objects = []
    for number, (mesh, texture) in enumerate(kinds):
        place = dr.linalg.translation((number % 3 - 1.0, number // 3 - 1.0, -0.1 * number))
        size = dr.linalg.scaling((0.6, 0.6, 0.6))
        objects.append(textured(mesh, texture, dr.linalg.compose(place, size)))
    scene = dr.Scene(objects=objects)
    assert scene.shared == (0, 1, 0, 3, 4, 5, 6)
    options = settings(shading="unlit", height=48, width=48)
    image = np.asarray(dr.render(scene, CAMERA, options))
    buffers = dr.render_buffers(scene, CAMERA, options)
    for number, item in enumerate(objects):
        seen = np.asarray(buffers.object) == number
        assert seen.sum() > 20
        texture, uv = item.material.texture, buffers.uv[seen]
        faces = np.asarray(buffers.face)[seen] - sum(
            o.mesh.faces.shape[0] for o in objects[:number]
        )
        shares = np.asarray(buffers.barycentrics)[seen]
        if item.mesh.uvs is not None:
            corners = item.mesh.faces if item.mesh.uv_faces is None else item.mesh.uv_faces
            want = np.einsum("nk,nkc->nc", shares, item.mesh.uvs[corners[faces]])
            np.testing.assert_allclose(uv, want, atol=1e-5)
        if texture is sphere:
            inverse = dr.linalg.invert(item.transform)
            own = dr.linalg.transform_points(inverse, buffers.position[seen])
            uv = dr.map_points(texture.mapping, own)
        if texture is cube:
            normals = item.mesh.vertices[item.mesh.faces[faces]]
            uv = np.einsum("nk,nkc->nc", shares, normals)
        want = 1 if texture is None else dr.sample_texture(texture, uv)
        np.testing.assert_allclose(image[seen], np.broadcast_to(want, (seen.sum(), 3)), atol=2e-5)


def test_images_are_held_once_and_their_gradient_is_one():
    texture = dr.Texture(IMAGE)
    pair = [textured(shapes.plane(), texture) for _ in range(2)]
    scene = dr.Scene(objects=pair, lights=[LIGHT])
    apart = dr.Scene(objects=[pair[0], textured(shapes.plane(), dr.Texture(IMAGE + 0))])
    assert scene.shared == (0, 0)
    assert apart.shared == (0, 1)
    images = [leaf for leaf in jax.tree.leaves(scene) if leaf.shape == IMAGE.shape]
    assert len(images) == 1
    again = jax.tree.map(lambda x: x + 0, scene)
    first, second = (item.material.texture.image for item in again.objects)
    assert first is second
    assert replace(again, lights=()).shared == (0, 0)
    stacked = jax.tree.map(lambda x: jnp.stack([x, x]), scene)
    assert stacked.objects[1].material.texture.image.shape == (2, *IMAGE.shape)


def test_uvs_with_their_own_indices_survive():
    mesh = shapes.icosahedron(flat=False)
    uvs, uv_faces = RNG.uniform(size=(9, 2)), RNG.integers(9, size=(20, 3))
    own = dr.Mesh(vertices=mesh.vertices, faces=mesh.faces, uvs=uvs, uv_faces=uv_faces)
    own = dr.mesh.with_normals(own)
    split = dr.mesh.split_uvs(own)
    assert split.uv_faces is None
    for name, faces in (("uvs", own.uv_faces), ("normals", own.faces), ("vertices", own.faces)):
        got = getattr(split, name)[split.faces]
        np.testing.assert_array_equal(got, getattr(own, name)[faces])
    both = dr.mesh.merge([own, dr.mesh.split_uvs(own)])
    faces = np.vstack([uv_faces, 9 + np.asarray(dr.mesh.split_uvs(own).faces)])
    np.testing.assert_array_equal(both.uv_faces, faces)
    np.testing.assert_array_equal(dr.mesh.flat_shaded(own).uvs, uvs.astype("f4")[uv_faces.ravel()])


def test_normals_that_differ_from_the_geometry_shade_it():
    """FEATURES X5: a flat square whose corners' normals are those of a ball shades as one."""
    square = shapes.plane(divisions=8)
    bent = np.asarray(square.vertices) * [0.8, 0.8, 0] + [0, 0, 1]
    normals = bent / np.linalg.norm(bent, axis=1, keepdims=True)
    item = dr.Object(replace(square, normals=normals), dr.Material(**WHITE))
    scene = dr.Scene(objects=[item], lights=[dr.DirectionalLight(direction=(0.5, 0, -1))])
    rays = np.asarray(dr.camera.pixel_rays(CAMERA, height=SIZE, width=SIZE))
    position = [0.4, 0.3, 3] - rays * 3 / rays[..., 2:]
    seen = np.abs(position[..., :2]).max(axis=-1) < 0.9
    assert seen.sum() > 50
    want = position[seen] * [0.8, 0.8, 0] + [0, 0, 1]
    want /= np.linalg.norm(want, axis=1, keepdims=True)
    cosine = want @ (np.array([-0.5, 0, 1]) / np.sqrt(1.25))
    image = np.asarray(dr.render(scene, CAMERA, settings()))[seen]
    np.testing.assert_allclose(image[:, 0], cosine, atol=0.01)
    assert np.ptp(cosine) > 0.2


def test_skybox_in_the_background():
    cube = dr.CubeTexture(RNG.uniform(size=(6, 4, 4, 3)))
    scene = dr.Scene(objects=[dr.Object(shapes.cube())], background=cube)
    rays = dr.camera.pixel_rays(CAMERA, height=2 * SIZE, width=2 * SIZE)
    fine = np.asarray(dr.sample_texture(cube, rays))
    image = dr.render(scene, CAMERA, settings(height=2 * SIZE, width=2 * SIZE, shading="unlit"))
    empty = np.all(np.asarray(image) != np.float32(0.8), axis=-1)
    assert 50 < empty.sum() < empty.size - 50
    np.testing.assert_allclose(np.asarray(image)[empty], fine[empty], atol=1e-5)
    alone = dr.render(dr.Scene(objects=[], background=cube), CAMERA, settings(samples=4))
    want = fine.reshape(SIZE, 2, SIZE, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(alone, want, atol=1e-5)


def test_skybox_seen_through_a_lens():
    cube = dr.CubeTexture(RNG.uniform(size=(6, 16, 16, 3)), filter="trilinear")
    camera = replace(CAMERA, distortion=jnp.array([-0.2, 0.1, 0.01, -0.02, 0.03]))
    small = dr.Object(shapes.cube(), transform=dr.linalg.scaling((0.5, 0.5, 0.5)))
    scene = dr.Scene(objects=[small], background=cube)
    rays, steps = dr.camera.pixel_directions(camera, height=32, width=32)
    want = dr.sample_texture(cube, rays, derivatives=np.swapaxes(steps, -1, -2))
    options = settings(height=32, width=32, shading="unlit", antialias=True)
    image = np.asarray(dr.render(scene, camera, options))
    outside = np.asarray(image == image[16, 16]).all(axis=-1) == 0
    empty = binary_erosion(outside, np.ones((5, 5)))  # not at the outlines
    assert 50 < empty.sum() < empty.size - 50
    np.testing.assert_allclose(image[empty], np.asarray(want)[empty], atol=1e-5)
    straight = dr.sample_texture(cube, dr.camera.pixel_rays(CAMERA, height=32, width=32))
    assert np.abs(straight - want).max() > 0.1


def test_derivatives_of_a_skybox_seen_through_a_lens():
    """By the lens, the view and the texels, of smooth sides: against differences in float64."""
    with jax.enable_x64(True):
        images = 0.5 + 0.3 * np.sin(np.arange(6 * 8 * 8 * 3).reshape(6, 8, 8, 3) / 29)
        make = dr.Camera.perspective
        straight = make(eye=(0.4, 0.3, 3), target=(0, 0, 0), fov_y=0.9, near=0.5, far=20)

        def image(images, view, lens):
            camera = replace(straight, view=view, distortion=lens)
            scene = dr.Scene(objects=[], background=dr.CubeTexture(images, filter="trilinear"))
            return dr.render(scene, camera, settings())

        lens = np.array([-0.2, 0.1, 0.01, -0.02, 0.03])
        arguments = images, straight.view, lens
        check_derivatives(image, *arguments, step=1e-7, rtol=1e-5, atol=1e-5)


def test_edges_of_a_textured_scene():
    """With edges it is nearer to many samples: also at a seam of uvs on shared vertices."""
    cube = dr.CubeTexture(np.stack([np.full((2, 2, 3), 0.1 * n) for n in range(6)]))
    box = shapes.cube(flat=False)
    uvs = [(0.1, 0.1), (0.4, 0.1), (0.1, 0.4), (0.6, 0.6), (0.9, 0.6), (0.6, 0.9)]
    uv_faces = np.arange(12)[:, None] // 2 % 2 * 3 + np.arange(3)
    image = np.zeros((8, 8, 3), np.float32)
    image[:4, 4:] = 1
    mesh = replace(box, uvs=uvs, uv_faces=uv_faces)
    scene = dr.Scene(objects=[textured(mesh, dr.Texture(image))], background=cube)
    camera = dr.Camera.perspective(eye=(2, 1.5, 3), target=(0, 0, 0), fov_y=0.9, near=0.5, far=20)
    edges, many = (
        dr.render(scene, camera, settings(shading="unlit", **options))
        for options in ({"antialias": True}, {"samples": 256})
    )
    assert jnp.mean(jnp.abs(edges - many)) < 5e-4


# ------------------------------------------------------------------------------------ derivatives


def test_derivatives_in_texels_uvs_geometry_and_camera():
    with jax.enable_x64(True):
        eye = dr.Camera.perspective(eye=(0.4, 0.3, 3), target=(0, 0, 0), fov_y=0.9, near=1, far=9)
        square = shapes.plane(6.0, 6.0)
        texture = dr.Texture(RNG.uniform(size=(6, 6, 3)), filter="trilinear")
        start, unravel = ravel_pytree((texture.image, square.uvs, square.vertices, eye.view))
        weights = RNG.normal(size=(SIZE, SIZE, 3))

        def loss(parameters):
            image, uvs, vertices, view = unravel(parameters)
            mesh = dr.Mesh(vertices=vertices, faces=square.faces, uvs=uvs)
            item = textured(mesh, replace(texture, image=image))
            scene = dr.Scene(objects=[item], lights=[LIGHT])
            camera = dr.Camera(view=view, projection=eye.projection)
            return jnp.mean(weights * dr.render(scene, camera, settings()))

        @jax.jit
        def slopes(parameters, direction):
            value, slope = jax.jvp(loss, (parameters,), (direction,))
            return value, slope, jax.grad(loss)(parameters)

        direction, step = RNG.normal(size=start.shape), 1e-7
        _, slope, gradient = slopes(start, direction)
        ahead, behind = (slopes(start + s * step * direction, direction)[0] for s in (1, -1))
        assert abs(slope) > 1e-4
        np.testing.assert_allclose(gradient @ direction, slope, rtol=1e-9)
        np.testing.assert_allclose((ahead - behind) / (2 * step), slope, rtol=1e-4)


def test_finite_in_degenerate_scenes():
    """Faces without area, behind the viewer, one texel, huge uvs, NaN where no face looks."""
    vertices = np.array(
        [[-1, -1, 0], [1, -1, 0], [0, 1, 0], [0, 1, 0], [5, 1, 9], [-5, 1, 9], [9, 9, 9]],
        np.float32,
    )
    faces = np.array([[2, 3, 2], [0, 1, 2], [2, 3, 4], [0, 4, 5], [0, 1, 5]])
    uvs = np.array([(0, 0), (1e30, 0), (0, -1e30), (1, 1), (2, 2), (3, 3), (np.nan, 0)], np.float32)
    images = [IMAGE[:1, :1], IMAGE]

    @jax.jit
    def slopes(vertices, uvs, images, view):
        def loss(vertices, uvs, images, view):
            mesh = dr.Mesh(vertices=vertices, faces=faces, uvs=uvs)
            first = dr.Texture(images[0], filter="trilinear")
            sphere = dr.Texture(images[1], mapping=dr.SphereMapping(), filter="trilinear")
            objects = [textured(mesh, first), textured(mesh, sphere)]
            scene = dr.Scene(objects=objects, lights=[LIGHT])
            camera = dr.Camera(view=view, projection=CAMERA.projection)
            return jnp.sum(dr.render(scene, camera, settings()))

        return jax.value_and_grad(loss, argnums=(0, 1, 2, 3))(vertices, uvs, images, view)

    value, gradients = slopes(vertices, uvs, images, CAMERA.view)
    assert np.isfinite(value)
    for path, leaf in jax.tree.leaves_with_path(gradients):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)


# ------------------------------------------------------------------------------- only what is used


def test_a_scene_pays_for_the_textures_it_has_only():
    mesh = shapes.uv_sphere(segments=7, rings=5)
    pixels = f"{SIZE}x{SIZE}x"

    def counts(texture, **options):
        scene = dr.Scene(objects=[textured(mesh, texture)], lights=[LIGHT])
        return operations(dr.render, scene, CAMERA, settings(**options))

    plain = counts(None)
    bare = dr.Scene(
        objects=[dr.Object(replace(mesh, uvs=None), dr.Material(**WHITE))], lights=[LIGHT]
    )
    assert times(plain, "gather") == times(
        operations(dr.render, bare, CAMERA, settings()), "gather"
    )
    assert not any(
        kind.startswith((f"{mesh.vertices.shape[0]}x2x", pixels + "2x")) for _, kind in plain
    )

    def added(texture):
        found = counts(texture)
        fetched = found["gather", pixels + "3xf32"] - plain["gather", pixels + "3xf32"]
        numbers = found["gather", pixels + "f32"] - plain["gather", pixels + "f32"]
        return fetched, numbers

    # Texels in threes, and each of two coordinates at three corners.
    assert added(dr.Texture(IMAGE, filter="nearest")) == (1, 6)
    assert added(dr.Texture(IMAGE)) == (4, 6)
    assert added(dr.Texture(IMAGE, filter="trilinear"))[0] == 8
    logarithms = times(counts(dr.Texture(IMAGE)), "log", "log_plus_one", "atan2")
    assert logarithms == 0


# --------------------------------------------------------------------------------------- bad input


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"uv_faces": [(0, 1, 4), (0, 1, 2)]}, r"uv_faces: wanted indices in \[0, 4\), got 4 at"),
        ({"uv_faces": [(0, 1, 2)]}, r"uv_faces: wanted shape \(2, 3\), got \(1, 3\)"),
        ({"uvs": None, "uv_faces": [(0, 1, 2)] * 2}, "uv_faces: wanted uvs that they count, got"),
        ({"uvs": [(0, 0)]}, r"uvs: wanted shape \(4, 2\), got \(1, 2\)"),
    ],
)
def test_errors_name_the_argument(change, message):
    with pytest.raises(ValueError, match=message):
        replace(shapes.plane(), **change)
