"""Shadows: rays cast in float64, every scale and shading, degenerate input, no price unused."""

from dataclasses import replace

import box_filter
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scenes

import diffrast as dr
from diffrast import deferred, linalg, shapes

pytestmark = pytest.mark.usefixtures("compiled_quickly")

SIZE = 96
LIGHT = {"ambient": (0.1, 0.1, 0.2), "diffuse": (0.8, 0.8, 0.7)}
FRAME = {"fov_y": 0.7, "aspect": 1.0, "near": 0.1, "far": 50.0}
ROUND_THE_CORNER = dr.Camera.perspective(eye=(3, 3, 6), target=(0, 0, 0), **FRAME)


def settings(**options):
    return dr.RenderSettings(height=SIZE, width=SIZE, **{"antialias": False, **options})


# ----------------------------------------------------------------------------------------- scenes


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


WRONG = (0.0005, 0.002)  # share of the points seen: with 512 texels, with few
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


# ----------------------------------------------------------------------------------- the lit points


def compare(scene, camera):
    """Which points are seen, which of them the light reaches, and which it should."""
    buffers = dr.render_buffers(scene, camera, settings())
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


@pytest.mark.parametrize(
    ("name", "error"), [("cubes in the light of a spot", 1.2e-4), ("hills in the evening", 1.5e-3)]
)
def test_pictures_with_outlines_equal_the_mean_over_pixels(name, error):
    """Also where cubes touch the floor, to the last digits, and on faces turned from the light.

    Without edges the errors are 2.7e-3 and 4.5e-3. On the hills the colour of rough ground turns
    within a pixel, and outlines pass from face to face.
    """
    scene, camera = make(name)
    picture = dr.render(scene, camera, settings(antialias=True))
    oracle = scenes.Oracle(scene, camera.view, camera.projection)
    want = box_filter.render_box(
        oracle.positions,
        oracle.normals,
        oracle.faces,
        oracle.view,
        oracle.projection,
        lights=[light | {"shadow": True} for light in oracle.lights],
        material=oracle.material(),
        background=np.zeros(3),
        height=SIZE,
        width=SIZE,
        shading="phong",
        lines=16,
        piercing=True,
    )
    assert np.mean(np.abs(picture - want)) < error


def test_outlines_under_parallel_projection_and_on_flat_shaded_floors():
    """Picture and derivative by the light against many samples."""
    size, step = 48, 0.01
    turned = linalg.compose(linalg.translation((0, -0.2, 0)), linalg.rotation_y(0.5))
    box = dr.Object(shapes.cube(), transform=turned @ linalg.scaling(0.5))
    tiles = floor(shapes.plane(8.0, 8.0, divisions=5))
    camera = dr.Camera.orthographic(
        eye=(3, 3, 6), target=(0, -0.3, 0), up=(0, 1, 0), height=4.0, near=0.1, far=50.0
    )

    def picture(direction, **options):
        scene = dr.Scene(objects=[box, tiles], lights=[sun(direction)])
        options = dr.RenderSettings(height=size, width=size, shading="flat", **options)
        return dr.render(scene, camera, options)

    def many_samples(direction):
        return np.asarray(picture(direction, antialias=False, samples=1024), float)

    light, way = jnp.array([-0.65, -1, -0.15]), jnp.array([0.6, 0.2, -0.7])
    got, change = jax.jit(lambda d, v: jax.jvp(picture, (d,), (v,)))(light, way)
    want = many_samples(light)
    assert np.mean(np.abs(got - want)) < 1e-4  # without edges .005
    difference = (many_samples(light + step * way) - many_samples(light - step * way)) / (2 * step)
    blurred = [
        x.reshape(12, 4, 12, 4, 3).mean(axis=(1, 3)) for x in (np.asarray(change), difference)
    ]
    assert np.linalg.norm(blurred[0] - blurred[1]) < 0.05 * np.linalg.norm(blurred[1])


def test_pairs_of_pixels_without_an_outline_are_counted():
    scene = dr.Scene(objects=[ball(2), floor()], lights=[sun(), sun((0.5, -1.0, 0.2))])
    found = dr.shadow_outlines(scene, ROUND_THE_CORNER, settings())
    assert found.edge.shape == (2, 2, SIZE, SIZE)
    assert np.all(found.pairs > 30)
    assert np.all(found.found <= found.pairs)
    assert np.all(found.found >= 0.95 * found.pairs)
    plain = replace(scene, lights=())
    assert dr.shadow_outlines(plain, ROUND_THE_CORNER, settings()) is None


@pytest.mark.parametrize("name", ["cubes in the light of a spot", "hills in the evening"])
def test_nearly_all_outlines_are_found(name):
    """The border of a spot's cone is none, nor is where a hill turns away from the light."""
    found = dr.shadow_outlines(*make(name), settings())
    assert found.pairs > 60
    assert found.found >= 0.99 * found.pairs


def test_batches_equal_single_views():
    scene, camera = make("ball")
    directions = jnp.array([[-0.8, -1.0, 0.3], [0.5, -1.0, -0.2]])

    def lit(direction):
        lights = (replace(scene.lights[0], direction=direction),)
        return dr.render_buffers(replace(scene, lights=lights), camera, settings()).lit

    together = jax.vmap(lit)(directions)
    for got, direction in zip(together, directions, strict=True):
        np.testing.assert_array_equal(got, lit(direction))


def test_rims_thinner_than_a_texel_have_outlines():
    """The light sees the faces at a smooth ring's rim edge-on: none of the texels shows them."""
    place = dr.linalg.compose(
        dr.linalg.translation((0.3, 0.2, 0.9)), dr.linalg.rotation((1, 0.3, 0.2), 0.5)
    )
    ring, floor = dr.shapes.torus(0.6, 0.2), dr.shapes.plane(12.0, 12.0)
    light = dr.DirectionalLight(direction=(-0.5, 0.3, -1), shadow=dr.Shadow(resolution=256))
    scene = dr.Scene(objects=[dr.Object(ring, transform=place), dr.Object(floor)], lights=[light])
    camera = dr.Camera.perspective(
        eye=(0.3, -3.2, 3), target=(0, 0.1, 0.4), up=(0, 0, 1), fov_y=0.8, near=0.5, far=30
    )
    found = dr.shadow_outlines(scene, camera, dr.RenderSettings(height=128, width=128))
    assert found.pairs[0] > 150
    assert found.found[0] >= 0.97 * found.pairs[0]


# --------------------------------------------------------------------------------- degenerate input


@pytest.mark.filterwarnings("ignore:scatter inputs have incompatible types:FutureWarning")
def test_outlines_are_found_in_float64_too():
    with jax.enable_x64(True):
        body = dr.shapes.cube()
        scene = dr.Scene(objects=[dr.Object(body)], lights=[sun(), lamp((1.0, 2.0, 3.0))])
        camera = dr.Camera.perspective(eye=(0, 1, 5), target=(0, 0, 0), fov_y=0.7, near=1, far=9)
        options = dr.RenderSettings(height=8, width=8)
        image = jax.eval_shape(lambda scene: dr.render(scene, camera, options), scene)
        assert image.dtype == jnp.float64


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


def test_neither_of_two_bodies_shades_the_line_where_it_pierces_the_other():
    """Both are lit in front of it: nothing in view is dark, at any sample of the line."""
    dull = dr.Material(diffuse=(1.0, 1.0, 1.0))
    sunk = dr.linalg.translation((0.13, 0.0, 0.91))
    scene = dr.Scene(
        objects=[dr.Object(dr.shapes.plane(8, 8), dull), dr.Object(dr.shapes.cube(), dull, sunk)],
        lights=[dr.DirectionalLight(direction=(0, 0.6, -0.8), shadow=dr.Shadow(resolution=128))],
        background=(1, 1, 1),
    )
    camera = dr.Camera.perspective(
        eye=(0.3, -6, 3), target=(0, -1, 0), up=(0, 0, 1), fov_y=0.4, near=0.5, far=20
    )
    image = dr.render(scene, camera, dr.RenderSettings(height=64, width=64))
    assert float(image.min()) > 0.59  # the cube's front, the least lit


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


def test_outlines_of_several_shadows_end_at_each_other():
    """Of three bars behind the camera; also at their corners."""
    turns = ((0.4, 3.0, 0.25), (1.3, 3.4, 0.3), (2.3, 3.8, 0.2))
    bars = [
        dr.Object(
            shapes.cube(),
            transform=linalg.compose(
                linalg.translation((0, height, 0)),
                linalg.rotation_y(turn),
                linalg.scaling((1.5, 0.03, width)),
            ),
        )
        for turn, height, width in turns
    ]
    floor_ = dr.Object(shapes.plane(40.0, 40.0), transform=linalg.rotation_x(-np.pi / 2))
    camera = dr.Camera.perspective(
        eye=(2.7, 2, -1.3), target=(2.6, 0, -1.5), up=(0, 0, -1), fov_y=1.3, near=0.1, far=50
    )
    scene = dr.Scene(objects=[floor_, *bars], lights=[sun((0.8, -1, -0.45))])

    def picture(**options):
        options = dr.RenderSettings(height=48, width=48, shading="flat", **options)
        return np.float64(dr.render(scene, camera, options))

    want = picture(antialias=False, samples=256)
    assert np.mean(np.abs(picture() - want)) < 3e-4  # of 16 samples 1.1e-3
