"""Many views: those of single calls, to the bit, for any chunk and number of devices."""

import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrast as dr
from diffrast import shapes, views

pytestmark = pytest.mark.default_compilation

SETTINGS = dr.RenderSettings(height=12, width=16, antialias=False)
MESH = shapes.icosphere(1)
TURNS = np.linspace(0, 6, 5).astype(np.float32)


def camera(turn):
    eye = jnp.stack([3 * jnp.sin(turn), jnp.ones_like(turn), 3 * jnp.cos(turn)])
    return dr.Camera.perspective(eye=eye, target=(0, 0, 0), fov_y=0.9, near=0.1, far=10.0)


def scene(direction=(-0.4, -0.5, -1.0)):
    shiny = dr.Object(MESH, dr.Material(specular=(0.5, 0.5, 0.5)))
    return dr.Scene(objects=[shiny], lights=[dr.DirectionalLight(direction=direction)])


CAMERAS = dr.stack_cameras([camera(turn) for turn in TURNS])
KEYS = jax.random.split(jax.random.key(0), 5)
DIRECTION = jnp.array([-0.4, -0.5, -1.0])


@pytest.fixture(scope="module")
def singles():
    return np.stack([dr.render(scene(), camera(turn), SETTINGS) for turn in TURNS])


@pytest.mark.parametrize("options", [{}, {"chunk": 1}, {"chunk": 3}])
def test_views_are_those_of_single_calls(singles, options):
    np.testing.assert_array_equal(dr.render_views(scene(), CAMERAS, SETTINGS, **options), singles)


def test_vmap_under_map_gives_single_images(singles):
    def image(turn):
        return dr.render(scene(), camera(turn), SETTINGS)

    images = jax.jit(lambda turns: jax.lax.map(jax.vmap(image), turns))(TURNS[:4].reshape(2, 2))
    np.testing.assert_array_equal(images.reshape(singles[:4].shape), singles[:4])


def test_they_come_in_order_a_chunk_at_a_time(singles):
    seen = []
    stream = views.stream_views(views.image_of, CAMERAS, (scene(), SETTINGS), chunk=4)
    for which, images in stream:
        assert len(which) == len(images) <= 4
        np.testing.assert_array_equal(images, singles[which.start : which.stop])
        seen += which
    assert seen == list(range(5))


def lit_from(objects, view):
    direction, turn = view
    lights = [dr.DirectionalLight(direction=direction)]
    return dr.render(dr.Scene(objects=objects, lights=lights), camera(turn), SETTINGS)


def test_anything_may_differ_from_view_to_view():
    directions = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    objects = [dr.Object(MESH)]
    got = views.map_views(lit_from, (directions, TURNS), objects)
    for i in (0, 4):
        np.testing.assert_array_equal(got[i], lit_from(objects, (directions[i], TURNS[i])))


def show(turn, mesh):
    return dr.render(dr.Scene(objects=[dr.Object(mesh)]), camera(turn), SETTINGS)


def test_meshes_of_unequal_sizes_are_padded():
    cube = shapes.cube()
    two = dr.mesh.merge([MESH, dr.mesh.transform(cube, dr.linalg.translation((1.1, 0.9, 0.2)))])
    meshes = [cube, two]
    stack = dr.mesh.stack_meshes(meshes)
    got = views.map_views(show, stack, TURNS[1])
    for image, mesh in zip(got, meshes, strict=True):
        np.testing.assert_array_equal(image, show(TURNS[1], mesh))
    # One body and two, edges that no face has and faces that have no edges.
    edges, bodies = stack.topology.edges, stack.topology.bodies
    numbers = [np.unique(n[: len(m.faces)]) for n, m in zip(bodies, meshes, strict=True)]
    assert [len(n) for n in numbers] == [1, 2]
    used = [np.asarray(row)[:, 0] >= 0 for row in edges.faces]
    assert [row.sum() for row in used] == [18, 138]
    assert np.all(stack.topology.neighbors[0, len(cube.faces) :] == -1)
    with pytest.raises(ValueError, match="meshes: wanted normals on all or none of 2"):
        dr.mesh.stack_meshes([MESH, dr.Mesh(vertices=cube.vertices, faces=cube.faces)])
    with pytest.raises(ValueError, match="wanted known vertices and faces"):
        jax.jit(lambda x: dr.mesh.stack_meshes([dr.mesh.transform(MESH, x)]))(jnp.eye(4))


def wave(frequency, place):
    return jnp.sin(frequency * place + jnp.arange(7.0))


def test_sums_of_gradients():
    function = jax.value_and_grad(lambda frequency, place: jnp.sum(wave(frequency, place)))
    places = np.linspace(0, 1, 41, dtype=np.float32)
    got = views.sum_views(function, places, 3.0)
    traced = jax.jit(lambda frequency: views.sum_views(function, places, frequency))(3.0)
    each = np.sum([function(3.0, place) for place in places], axis=0)
    np.testing.assert_allclose(got, each, rtol=1e-5)
    np.testing.assert_allclose(traced, each, rtol=1e-5)


def test_gradient_through_the_views(singles):
    @jax.jit
    @jax.value_and_grad
    def loss(direction):
        return jnp.sum(dr.render_views(scene(direction), CAMERAS, SETTINGS) ** 2)

    value, gradient = loss(DIRECTION)
    np.testing.assert_allclose(value, np.sum(singles**2), rtol=1e-5)
    step = 1e-2 * gradient / jnp.linalg.norm(gradient)
    difference = (loss(DIRECTION + step)[0] - loss(DIRECTION - step)[0]) / 2
    np.testing.assert_allclose(difference, gradient @ step, rtol=2e-2)


def slope(direction, camera):
    return jax.grad(lambda d: jnp.sum(dr.render(scene(d), camera, SETTINGS) ** 2))(direction)


MANY_DEVICES = """
import jax, numpy as np
jax.config.update("jax_num_cpu_devices", 8)
import diffrast as dr
import test_views as t
from diffrast import views

images, sums, gradients = [], [], []
for devices in (None, jax.devices()[:3], jax.devices()):  # more of them than views
    images.append(dr.render_views(t.scene(), t.CAMERAS, t.SETTINGS, devices=devices))
for devices in (None, *(jax.devices()[:n] for n in (1, 2, 4, 8))):
    many = np.linspace(0, 1, 41, dtype=np.float32)
    sums.append(views.sum_views(t.wave, many, np.float32(3), devices=devices))
for devices in (None, jax.devices()):
    many = jax.tree.map(lambda x: np.resize(x, (19, *x.shape[1:])), t.CAMERAS)
    gradients.append(views.sum_views(t.slope, many, t.DIRECTION, devices=devices))
for found in (images, sums, gradients):
    for other in found[1:]:
        jax.tree.map(np.testing.assert_array_equal, other, found[0])
"""


def test_the_number_of_devices_changes_no_bit():
    subprocess.run([sys.executable, "-c", MANY_DEVICES], check=True, cwd="tests")


PLACED = """
import jax, numpy as np
jax.config.update("jax_num_cpu_devices", 4)
import test_views as t
from diffrast import _chunks, views
from jax.sharding import NamedSharding, PartitionSpec

devices = jax.devices()
places = np.linspace(0, 1, 5, dtype=np.float32)
mesh = jax.make_mesh((4,), ("some",))
everywhere, split = (NamedSharding(mesh, PartitionSpec(*axis)) for axis in ((), ("some",)))
for work in (views.map_views, views.sum_views):
    want = work(t.wave, places, np.float32(3))
    for where in (devices[1], everywhere):
        three = jax.device_put(np.float32(3), where)
        for on in (None, devices, devices[2:]):
            got = work(t.wave, jax.device_put(places, where), three, devices=on)
            np.testing.assert_array_equal(got, want)
        got = jax.jit(lambda x: x * work(t.wave, places, three))(1.0)
        np.testing.assert_array_equal(got, want)
    rows = np.arange(28, dtype=np.float32).reshape(4, 7)
    product = lambda rows, place: rows * place
    got = work(product, places, jax.device_put(rows, split), devices=devices[:2])
    np.testing.assert_array_equal(got, work(product, places, rows))
    programs = _chunks._program.cache_info().misses
    with jax.default_device(devices[3]):  # needs a program of its own
        got = work(t.wave, places, np.float32(3))
    np.testing.assert_array_equal(got, want)
    assert got.devices() == {devices[3]}
    assert _chunks._program.cache_info().misses == programs + 1
"""


def test_what_views_share_may_lie_on_any_device():
    subprocess.run([sys.executable, "-c", PLACED], check=True, cwd="tests")


TWO_PROCESSES = """
import sys
import jax, numpy as np
jax.config.update("jax_cpu_collectives_implementation", "gloo")
jax.distributed.initialize(sys.argv[1], 2, int(sys.argv[2]))
import test_views as t
from diffrast import views

places = np.linspace(0, 1, 21, dtype=np.float32)
for work in (views.map_views, views.sum_views):
    got = work(t.wave, places, np.float32(3), devices=jax.devices())
    want = np.asarray(work(t.wave, places, np.float32(3)))
    for shard in got.addressable_shards:
        np.testing.assert_array_equal(shard.data, want[shard.index])
"""


def test_the_number_of_processes_changes_no_bit():
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    command = [sys.executable, "-c", TWO_PROCESSES, address]
    both = [subprocess.Popen([*command, str(i)], cwd="tests") for i in range(2)]
    assert [process.wait(timeout=120) for process in both] == [0, 0]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: dr.render_views(scene(), camera(0.0), SETTINGS), "cameras: wanted a stack"),
        (
            lambda: dr.render_views(scene(), CAMERAS, SETTINGS, chunk=0),
            "chunk: wanted an integer of at least 1, got 0",
        ),
        (
            lambda: dr.render_views(scene(), CAMERAS, SETTINGS, devices=[]),
            "devices: wanted at least one, got none",
        ),
        (
            lambda: views.map_views(wave, TURNS, 1.0, devices=jax.devices()[:1] * 2),
            "devices: wanted each one once, got",
        ),
        (
            lambda: views.map_views(lit_from, (TURNS, TURNS[:3])),
            "views: wanted arrays with a common leading axis",
        ),
        (
            lambda: jax.jit(lambda v: list(views.stream_views(wave, v, 1.0)))(TURNS),
            "views: wanted known numbers",
        ),
        (
            lambda: jax.grad(lambda s: views.sum_views(lambda _, turn: s * turn, TURNS))(3.0),
            "function: wanted one that uses no traced values but its arguments",
        ),
        (
            lambda: jax.jit(lambda s: views.map_views(lambda _, turn: s * turn, TURNS))(3.0),
            "function: wanted one that uses no traced values but its arguments",
        ),
        (
            lambda: views.map_views(lambda _, key: jax.random.normal(key), KEYS),
            "views: wanted arrays of numbers, got random keys",
        ),
    ],
)
def test_errors_name_the_argument(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_random_keys_and_known_numbers_inside_of_jit():
    def drawn(key, turn):
        return turn * jax.random.uniform(key)

    outside = views.map_views(drawn, TURNS, KEYS[0])
    np.testing.assert_allclose(outside, TURNS * jax.random.uniform(KEYS[0]), rtol=1e-6)
    inside = jax.jit(lambda: views.map_views(lambda scale, turn: scale * turn, TURNS, 2.0))()
    np.testing.assert_array_equal(inside, 2 * TURNS)


def test_functions_may_return_numbers_and_nothing():
    def some(_, turn):
        return turn, 2.5, 3, None

    rows, halves, counts, nothing = views.map_views(some, TURNS)
    np.testing.assert_array_equal(rows, TURNS)
    assert (halves.tolist(), counts.tolist(), nothing) == ([2.5] * 5, [3] * 5, None)
    total, *rest = views.sum_views(some, TURNS)
    np.testing.assert_allclose(total, np.sum(TURNS), rtol=1e-6)
    assert rest == [12.5, 15, None]
    assert views.sum_views(lambda _, turn: None, TURNS) is None


def test_no_views_give_no_images():
    none = jax.tree.map(lambda x: x[:0], CAMERAS)
    assert dr.render_views(scene(), none, SETTINGS).shape == (0, 12, 16, 3)
