"""What transforms of few objects move is summed over pictures; of many, by their vertices.

Both must be the same derivative, forward and backward, once and twice, and that of the picture.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrast as dr
from diffrast import deferred, geometry

pytestmark = pytest.mark.usefixtures("compiled_quickly")

SETTINGS = dr.RenderSettings(height=20, width=24, antialias=False)
SHEET, BALL = dr.shapes.plane(2.0, 2.0), dr.shapes.icosphere(1)
UNEVEN = dr.linalg.compose(
    dr.linalg.translation((-1.0, 0.1, 0.2)), dr.linalg.scaling((0.5, 1.2, 0.7))
)
MIRRORED = dr.linalg.compose(
    dr.linalg.translation((0.9, -0.2, 0.1)), dr.linalg.scaling((-0.8, 0.8, 0.8))
)
FLAT = dr.linalg.compose(dr.linalg.rotation((0.2, 1, 0), 0.3), dr.linalg.scaling((1.0, 1.0, 0.0)))
START = {
    "transforms": [UNEVEN, MIRRORED, FLAT],
    "vertices": BALL.vertices,
    "eye": jnp.array([0.3, 0.4, 5.0]),
}


def picture(parameters):
    ball = dr.Mesh(vertices=parameters["vertices"], faces=BALL.faces)  # normals follow its vertices
    meshes = [ball, BALL, SHEET]
    material = dr.Material(diffuse=(0.7, 0.5, 0.3), specular=(0.3, 0.3, 0.3), shininess=5.0)
    objects = [
        dr.Object(mesh, material, transform)
        for mesh, transform in zip(meshes, parameters["transforms"], strict=True)
    ]
    lights = [
        dr.DirectionalLight(direction=(-0.3, -0.5, -1), ambient=(0.1, 0.1, 0.1)),
        dr.PointLight(position=(1.0, 2.0, 3.0), diffuse=(0.5, 0.5, 0.5)),
    ]
    camera = dr.Camera.perspective(
        eye=parameters["eye"], target=(0, 0, 0), up=(0, 1, 0), fov_y=0.7, near=0.5, far=20
    )
    return dr.render(dr.Scene(objects=objects, lights=lights), camera, SETTINGS)


def in_doubles(tree):
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), jnp.float64), tree)


def derivatives(parameters, way, weights):
    """The picture, its change, a gradient and that gradient's change."""

    def loss(parameters):
        return jnp.sum(weights * picture(parameters) ** 2)

    moved, slope = jax.jvp(picture, (parameters,), (way,))
    gradient, bend = jax.jvp(jax.grad(loss), (parameters,), (way,))
    return moved, slope, gradient, bend


@pytest.fixture(scope="module")
def doubles():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def by_vertices(doubles):
    """Arguments of `derivatives`, and what it gives where objects count as many."""
    rng = np.random.default_rng(0)
    start = in_doubles(START)
    way = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), start)
    arguments = start, way, jnp.asarray(rng.normal(size=(20, 24, 3)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(geometry, "FEW_OBJECTS", 0)
        found = jax.jit(derivatives)(*arguments)
    jax.clear_caches()
    return arguments, found


@pytest.mark.parametrize("way", ["in one go", "in batches"])
def test_derivatives_are_those_by_vertices(by_vertices, monkeypatch, way):
    arguments, wanted = by_vertices
    if way == "in batches":
        monkeypatch.setattr(deferred, "LARGE", 0)
        monkeypatch.setattr(deferred, "RUNS_AT_ONCE", 4)
    found = jax.jit(derivatives)(*arguments)
    jax.clear_caches()
    assert np.mean(found[0] != 0) > 0.2
    for some, expected in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert np.linalg.norm(expected) > 0
        assert np.linalg.norm(some - expected) < 1e-9 * np.linalg.norm(expected)


@pytest.mark.parametrize("moving", [[1], [0, 2]])
def test_objects_that_do_not_move_have_no_part(by_vertices, moving):
    """The change of the picture is that of those transforms that change."""
    (start, way, _), _ = by_vertices

    def moved(*transforms):
        given = list(start["transforms"])
        for number, transform in zip(moving, transforms, strict=True):
            given[number] = transform
        return picture(start | {"transforms": given})

    def moved_all(*transforms):
        return picture(start | {"transforms": list(transforms)})

    some = [[tree["transforms"][k] for k in moving] for tree in (start, way)]
    still = [w if k in moving else 0 * w for k, w in enumerate(way["transforms"])]
    found = jax.jit(lambda: jax.jvp(moved, *map(tuple, some))[1])()
    wanted = jax.jit(lambda: jax.jvp(moved_all, tuple(start["transforms"]), tuple(still))[1])()
    assert np.linalg.norm(wanted) > 0
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-10 * np.abs(wanted).max())


@pytest.mark.parametrize("amount", [0.0, np.nan])
def test_what_is_out_of_sight_spoils_nothing(amount):
    """An object behind the camera whose place has an infinite derivative, or is none."""

    def of_all(offsets):
        behind = 20 + jnp.sqrt(amount * offsets[2, 2])
        last = dr.linalg.translation(jnp.stack([offsets[2, 0], offsets[2, 1], behind]))
        transforms = [*map(dr.linalg.translation, offsets[:2]), last]
        return jnp.sum(picture(START | {"transforms": transforms}) ** 2)

    offsets = jnp.array([[-0.8, 0.1, 0.0], [0.9, 0.0, 0.0], [0.0, 0.0, 1.0]])
    loss, change = jax.jit(lambda: jax.jvp(of_all, (offsets,), (jnp.ones((3, 3)),)))()
    gradient = jax.jit(jax.grad(of_all))(offsets)[:2]
    assert loss > 0
    assert np.isfinite(change)
    assert np.isfinite(gradient).all()
    assert np.all(np.any(gradient != 0, axis=1))


def test_derivatives_are_those_of_the_picture(by_vertices):
    (start, way, _), _ = by_vertices
    still = jnp.zeros((4, 4))  # the flat sheet would turn over
    way = [*way["transforms"][:2], still]

    def moved(amount):
        transforms = [t + amount * w for t, w in zip(start["transforms"], way, strict=True)]
        return picture(start | {"transforms": transforms})

    step = 1e-6
    shifted = jax.jit(moved)
    difference = np.asarray(shifted(step) - shifted(-step)) / (2 * step)
    _, slope = jax.jit(lambda: jax.jvp(moved, (0.0,), (1.0,)))()
    same_face = np.abs(difference) < 1e2  # no outline passed the pixel's centre
    assert same_face.mean() > 0.99
    np.testing.assert_allclose(np.asarray(slope)[same_face], difference[same_face], atol=1e-5)
