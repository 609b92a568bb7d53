"""Shadows: rays cast in float64, every scale and shading, degenerate input, no price unused."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scenes
from shadow_scenes import (
    FRAME,
    ROUND_THE_CORNER,
    SCENES,
    SIZE,
    ball,
    floor,
    lamp,
    make,
    settings,
    spot,
    sun,
)

import diffrast as dr
from diffrast import deferred, linalg, shapes

pytestmark = pytest.mark.usefixtures("compiled_quickly")

WRONG = (0.0005, 0.002)  # share of the points seen: with 512 texels, with few


# ----------------------------------------------------------------------------------- the lit points


def compare(scene, camera, shading="phong", cone=True):
    """Which points are seen, which of them the light reaches, and which it should."""
    buffers = dr.render_buffers(scene, camera, settings(shading=shading))
    seen = np.asarray(buffers.face) >= 0
    face, barycentrics = np.asarray(buffers.face)[seen], np.asarray(buffers.barycentrics)[seen]
    barycentrics = np.float64(barycentrics)
    barycentrics /= barycentrics.sum(axis=1, keepdims=True)
    positions, faces, first = [], [], 0
    for item in scene.objects:
        positions.append(linalg.transform_points(item.transform, item.mesh.vertices))
        faces.append(np.asarray(item.mesh.faces) + first)
        first += len(positions[-1])
    positions, faces = np.float64(np.concatenate(positions)), np.concatenate(faces)
    points = np.einsum("nk,nkc->nc", barycentrics, positions[faces[face]])
    normals = np.float64(buffers.normal)[seen]
    want = np.zeros(seen.shape, bool)
    light = scenes.Oracle(scene, camera.view, camera.projection).lights[0]
    light = light if cone else {**light, "type": "point"}
    want[seen] = reference.lit(light, points, face, normals, positions, faces)
    return seen, np.asarray(buffers.lit)[..., 0] > 0, want


def speckle(seen, got, want):
    """Points that differ from the truth where that is the same at 5×5 points."""

    def around(values):
        padded = np.pad(values, 2, mode="edge")
        return np.lib.stride_tricks.sliding_window_view(padded, (5, 5))

    even = np.all(around(want) == want[..., None, None], axis=(2, 3))
    return seen & (got != want) & even & np.all(around(seen), axis=(2, 3))


@pytest.mark.parametrize("name", SCENES)
def test_lit_points_equal_rays_cast_in_float64(name):
    seen, got, want = compare(*make(name))
    assert 0.1 < want[seen].mean() < 0.97
    assert np.mean(got[seen] != want[seen]) < WRONG[name == "ball"]
    assert not speckle(seen, got, want).any()
    assert not got[~seen].any()


@pytest.mark.parametrize(("faces", "resolution"), [(96, 128), (160, 256)])
def test_stairs_as_steep_as_the_light_do_not_shade_themselves(faces, resolution):
    """Whose steps are as wide as texels: these do not show how steep it is between them."""
    steps = np.cumsum(np.arange(faces) % 3 == 2)
    heights = np.broadcast_to(-3.2 / faces * steps, (faces, faces))
    scene = dr.Scene(
        objects=[floor(shapes.height_field(heights, 4.0, 4.0), 0.0)],
        lights=[sun((1.0, -1.0, 0.1), resolution=resolution)],
    )
    camera = dr.Camera.perspective(eye=(1, 3, 4), target=(0, -0.5, 0), **FRAME)
    seen, got, want = compare(scene, camera)
    assert want[seen].mean() > 0.999
    assert np.array_equal(got[seen], want[seen])


def test_shadows_fall_beyond_the_cone_where_interpolation_carries_its_light():
    """Of colours of corners, some of which are in the cone of a spot."""
    place = {"position": (0.5, 3, 1), "direction": (-0.2, -3, -0.8), "cutoff": 0.5}
    light = dr.SpotLight(**place, diffuse=(1, 1, 1), shadow=dr.Shadow())
    ground = floor(shapes.plane(8.0, 8.0, divisions=8))
    scene = dr.Scene(objects=[ball(), ground], lights=[light])
    plain = replace(scene, lights=(replace(light, shadow=None),))
    camera = dr.Camera.perspective(eye=(2, 5, 5), target=(0, -1, 0), **FRAME)
    of_corners, of_points = (
        np.asarray(dr.render(plain, camera, settings(shading=shading)))[..., 0] > 1e-4
        for shading in ("gouraud", "phong")
    )
    _, got, want = compare(scene, camera, "gouraud", cone=False)
    beyond = of_corners & ~of_points
    assert beyond.mean() > 0.1
    assert np.mean(~want[beyond]) > 0.02
    assert np.mean(got[of_corners] != want[of_corners]) < WRONG[0]


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_shadows_have_no_scale(scale):
    scene, camera = make("ball")
    large = linalg.scaling(scale)
    objects = [replace(item, transform=large @ item.transform) for item in scene.objects]
    view = camera.view.at[:3, 3].multiply(scale)
    projection = camera.projection.at[2, 3].multiply(scale)
    other = replace(camera, view=view, projection=projection, view_remainder=jnp.zeros(3))
    want = dr.render_buffers(scene, camera, settings()).lit
    got = dr.render_buffers(replace(scene, objects=tuple(objects)), other, settings()).lit
    assert np.mean(got != want) < 5e-4


@pytest.mark.parametrize("light", [sun, lambda: lamp((1.5, 4.0, 1.0))], ids=["sun", "lamp"])
def test_a_scale_by_a_power_of_two_changes_no_bit(light):
    """With edges and shadows, of pictures and derivatives: products of lengths stay in range."""
    options = dr.RenderSettings(height=24, width=24)

    def picture(move, scale):
        size = linalg.scaling(jnp.full(3, scale))
        ball_place = linalg.translation(scale * (move + jnp.array([0.1, 0.8, 0.2]))) @ size
        own = light()
        if isinstance(own, dr.PointLight):
            own = replace(own, position=scale * own.position)
        scene = dr.Scene(
            objects=[
                dr.Object(shapes.icosphere(2, 0.6), transform=ball_place),
                dr.Object(floor().mesh, transform=size @ floor(height=0.0).transform),
            ],
            lights=[own],
        )
        camera = dr.Camera.perspective(
            eye=scale * jnp.array([1.0, 3.0, 5.0]),
            target=scale * jnp.array([0.0, 0.4, 0.0]),
            fov_y=0.6,
            near=0.5 * scale,
            far=20 * scale,
        )
        return dr.render(scene, camera, options)

    @jax.jit
    def with_derivative(scale):
        way = jnp.array([0.3, 0.1, 0.2])
        return jax.jvp(lambda move: picture(move, scale), (jnp.zeros(3),), (way,))

    want = with_derivative(1.0)
    assert all(np.ptp(part) > 0.1 for part in want)
    for exponent in (-60, -40, 40, 60):
        got = with_derivative(2.0**exponent)
        jax.tree.map(np.testing.assert_array_equal, got, want)


def test_what_casts_a_shadow_need_not_be_seen():
    """The ball is behind the camera; only the floor is in view."""
    scene, _ = make("ball")
    lights = (replace(scene.lights[0], direction=jnp.array([0.0, -1, -1])),)
    camera = dr.Camera.perspective(eye=(0, -0.7, -1.05), target=(0, -1, -2), **FRAME)
    seen, got, want = compare(replace(scene, lights=lights), camera)
    assert want[seen].mean() < 0.9
    assert np.mean(got[seen] != want[seen]) < WRONG[1]


# ------------------------------------------------------------------------------------- the pictures


def three_lights(**resolution):
    lights = [sun(**resolution), dr.AmbientLight((0.1, 0.2, 0.1)), lamp((2, 3, 1.5), **resolution)]
    return dr.Scene(objects=[ball(1), floor()], lights=[*lights, spot(**resolution)])


def without_shadow(light):
    return light if isinstance(light, dr.AmbientLight) else replace(light, shadow=None)


def test_a_light_that_is_not_seen_leaves_its_ambient_part():
    scene, options = three_lights(resolution=64), settings(shading="gouraud")
    scene = replace(scene, lights=scene.lights[:3])
    got = dr.render(scene, ROUND_THE_CORNER, options)
    lit = dr.render_buffers(scene, ROUND_THE_CORNER, options).lit
    assert lit.shape == (SIZE, SIZE, 2)
    plain = [without_shadow(light) for light in scene.lights]
    none = {"diffuse": jnp.zeros(3), "specular": jnp.zeros(3)}

    def picture(lights):
        return np.asarray(
            dr.render(replace(scene, lights=tuple(lights)), ROUND_THE_CORNER, options)
        )

    base = [x if isinstance(x, dr.AmbientLight) else replace(x, **none) for x in plain]
    ambient = picture(base)
    want = ambient
    for k, number in enumerate((0, 2)):
        alone = [plain[number] if i == number else light for i, light in enumerate(base)]
        want = want + np.asarray(lit)[..., k, None] * (picture(alone) - ambient)
    np.testing.assert_allclose(got, want, atol=2e-6)


def test_batches_equal_single_views():
    scene, camera = make("ball")
    directions = jnp.array([[-0.8, -1.0, 0.3], [0.5, -1.0, -0.2]])

    def lit(direction):
        lights = (replace(scene.lights[0], direction=direction),)
        return dr.render_buffers(replace(scene, lights=lights), camera, settings()).lit

    together = jax.vmap(lit)(directions)
    for got, direction in zip(together, directions, strict=True):
        np.testing.assert_array_equal(got, lit(direction))


# --------------------------------------------------------------------------------- degenerate input


def of_precision(tree, dtype):
    return jax.tree.map(lambda x: jnp.asarray(x, dtype if x.dtype.kind == "f" else x.dtype), tree)


@pytest.mark.parametrize("bits", [32, 64])
def test_pictures_keep_the_precision_of_their_scene(bits):
    """Also that of 32 bits where 64 are enabled: a constant may ask for more, as may an integer."""
    with jax.enable_x64(True):
        scene = dr.Scene(objects=[ball(1)], lights=[sun(), lamp((1.0, 2.0, 3.0))])
        camera = dr.Camera.perspective(eye=(0, 1, 5), target=(0, 0, 0), fov_y=0.7, near=1, far=9)
        arguments = of_precision((scene, camera), f"float{bits}")
        options = dr.RenderSettings(height=8, width=8)
        gradient = jax.grad(lambda *of: dr.render(*of, options).sum(), (0, 1), allow_int=True)
        program = jax.make_jaxpr(gradient)(*arguments)
    assert program.out_avals[0].dtype == f"float{bits}"
    if bits == 32:
        assert not re.findall(r"f64\[\d", str(program))


@pytest.fixture(scope="module")
def pictures():
    """Picture and gradient as functions of where three lights are, and of the camera."""
    scene = three_lights(resolution=32)

    @jax.jit
    def picture_and_gradient(parameters, camera):
        def loss(parameters):
            first, ambient, second, third = scene.lights
            lights = (
                replace(first, direction=parameters["direction"]),
                ambient,
                replace(second, position=parameters["position"]),
                replace(third, **{k: parameters[k] for k in ("direction", "position", "cutoff")}),
            )
            transform = parameters["transform"]
            objects = (replace(scene.objects[0], transform=transform), scene.objects[1])
            moved = replace(scene, lights=lights, objects=objects)
            image = dr.render(moved, camera, settings(antialias=True))
            return jnp.mean(image**2), image

        return jax.grad(loss, has_aux=True)(parameters)

    def pictures(camera=ROUND_THE_CORNER, **changes):
        usual = {
            "direction": (-0.8, -1, 0.3),
            "position": (2, 3, 1.5),
            "cutoff": 0.6,
            "transform": np.eye(4),
        }
        return picture_and_gradient(
            {name: jnp.array(value, float) for name, value in {**usual, **changes}.items()}, camera
        )

    return pictures


AWAY = dr.Camera.perspective(eye=(3, 3, 6), target=(3, 3, 9), **FRAME)
DEGENERATE = {
    "nothing unusual": {},
    "light along the floor": {"direction": (1, 0, 0)},
    "light from below": {"direction": (0, 1, 0)},
    "no direction": {"direction": (0, 0, 0)},
    "lamp in the floor's plane": {"position": (0.3, -1, 0)},
    "lamp at a corner of the floor": {"position": (4, -1, 4)},
    "lamp inside of the ball": {"position": (0.1, 0, 0)},
    "lamp behind the camera": {"position": (30, 30, 60)},
    "narrow cone": {"cutoff": 1e-6},
    "wide cone": {"cutoff": 1.57},
    "ball without volume": {"transform": np.diag([1, 0, 1, 1])},
    "ball at one point": {"transform": np.diag([0, 0, 0, 1])},
    "nothing in view": {"camera": AWAY},
}


@pytest.mark.parametrize("case", DEGENERATE)
def test_finite_with_finite_gradients(pictures, case):
    gradient, image = pictures(**DEGENERATE[case])
    assert np.isfinite(image).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_a_lamp_in_a_closed_body_lights_nothing_outside(pictures):
    _, inside = pictures(position=(0.1, 0, 0), direction=(0, 1, 0))
    _, nowhere = pictures(position=(0, -9, 0), direction=(0, 1, 0))
    np.testing.assert_array_equal(inside, nowhere)


# ------------------------------------------------------------------------------- only what is used


@pytest.mark.parametrize("antialias", [False, True])
def test_without_shadows_there_is_no_trace_of_them(antialias):
    scene, options = three_lights(), settings(antialias=antialias)
    plain = replace(scene, lights=tuple(map(without_shadow, scene.lights)))

    def program(scene, options):
        return dr.render.lower(scene, ROUND_THE_CORNER, options).as_text(debug_info=True)

    assert "shade/shadow" in program(scene, options)
    assert "shade/shadow" not in program(plain, options)
    assert "shade/shadow" not in program(scene, replace(options, shading="unlit"))


def test_buffers_without_shadows_and_without_objects():
    empty = dr.Scene(objects=[], lights=three_lights().lights)
    assert dr.render_buffers(empty, ROUND_THE_CORNER, settings()).lit.shape == (SIZE, SIZE, 3)
    plain = replace(empty, lights=tuple(map(without_shadow, empty.lights)))
    assert dr.render_buffers(plain, ROUND_THE_CORNER, settings()).lit is None


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dr.Shadow(resolution=2.5), "resolution: wanted an integer of at least 8, got 2.5"),
        (lambda: dr.Shadow(resolution=4), "resolution: wanted an integer of at least 8, got 4"),
        (lambda: dr.Shadow(resolution=10**5), "resolution: wanted at most 8192, got 100000"),
        (lambda: dr.PointLight(position=(0, 0, 0), shadow=512), "shadow: wanted a Shadow or None"),
    ],
)
def test_errors_name_the_argument(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("very_large", [False, True])
def test_large_pictures_are_shaded_as_small_ones(monkeypatch, very_large):
    """Of the points that shadows fall on, or in batches which find these again."""
    scene = dr.Scene(objects=[ball(), floor()], lights=[sun(), lamp((2, 4, 1))])
    arguments = scene, ROUND_THE_CORNER, settings()
    small = dr.render(*arguments)
    monkeypatch.setattr(deferred, "LARGE", 0)
    if very_large:
        monkeypatch.setattr(deferred, "VERY_LARGE", 0)
    large = jax.jit(lambda *arguments: dr.render.__wrapped__(*arguments))(*arguments)
    np.testing.assert_allclose(large, small, atol=1e-6)
