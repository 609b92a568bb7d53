"""Colours that turn within a pixel: against many samples, in both directions, in odd scenes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_render import operations, times

import diffrast as dr
from diffrast import bending, turning, within

pytestmark = pytest.mark.usefixtures("compiled_quickly")

SHINY = {"diffuse": (0.6, 0.5, 0.4), "specular": (0.8, 0.8, 0.8), "shininess": 60.0}
RING = dr.shapes.torus(major_segments=24, minor_segments=12)


def scene(mesh=RING, material=SHINY, shift=(0.0, 0.0, 0.0), **light):
    options = {"direction": (-1.0, -1.0, -2.0), "ambient": (0.2, 0.2, 0.2)} | light
    thing = dr.Object(mesh, dr.Material(**material), dr.linalg.translation(shift))
    return dr.Scene(objects=[thing], lights=[dr.DirectionalLight(**options)])


def camera(eye=(1.2, 2.0, 2.2)):
    return dr.Camera.perspective(eye=eye, target=(0, 0, 0), fov_y=0.8, near=0.1, far=9)


def settings(size, **options):
    return dr.RenderSettings(height=size, width=size, **options)


def test_highlights_smaller_than_pixels_are_nearer_to_many_samples():
    truth = dr.render(scene(), camera(), settings(64, antialias=False, samples=256))
    sampled = dr.render(scene(), camera(), settings(64, antialias=False, samples=16))
    picture = dr.render(scene(), camera(), settings(64))
    ours, theirs = (np.asarray(image - truth) for image in (picture, sampled))
    assert np.mean(ours**2) < 0.0017**2 < np.mean(theirs**2)
    assert np.mean(abs(ours)) < 0.0005


def teapot_and_camera():
    """Faces and highlights far smaller than pixels of 64² are at its lid and its spout."""
    mesh = dr.shapes.teapot(divisions=6)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle = (low + high) / 2
    place = {"eye": middle + np.array([1.2, -4.4, 2.2]), "target": middle, "up": (0, 0, 1)}
    return mesh, dr.Camera.perspective(**place, fov_y=0.8, near=0.1, far=50)


def test_colors_turn_in_pixels_that_edges_part_as_well():
    """The rims of a teapot's lid and spout; with four points in other pixels alone .0136, .0017."""
    mesh, view = teapot_and_camera()
    truth = dr.render(scene(mesh), view, settings(64, antialias=False, samples=256))
    error = np.asarray(dr.render(scene(mesh), view, settings(64)) - truth)
    assert np.mean(error**2) < 0.0092**2
    assert np.mean(abs(error)) < 0.0013


def test_the_derivative_of_narrow_highlights_is_that_of_whole_pixels():
    """Against differences of many samples; with that of pixels' centres the error is 3.3."""
    mesh, view = teapot_and_camera()

    def picture(shift, **options):
        moved = scene(mesh, shift=jnp.array([0, 0, 1]) * shift)
        return dr.render(moved, view, settings(64, **options))

    half = 0.03  # a pixel
    exact = jax.jit(lambda shift: picture(shift, antialias=False, samples=256))
    want = (np.asarray(exact(half)) - np.asarray(exact(-half))) / (2 * half)
    got = jax.jit(lambda: jax.jvp(picture, (0.0,), (1.0,))[1])()
    coarse = np.random.default_rng(0).normal(size=(8, 6, 6, 3))
    fields = jax.image.resize(coarse, (8, 64, 64, 3), "cubic")
    want, got = (np.einsum("fhwc,hwc->f", fields, change) for change in (want, got))
    assert np.linalg.norm(got - want) < 0.4 * np.linalg.norm(want)


@pytest.mark.parametrize("rough", [0.1, 1.0])
def test_whatever_edges_are_told_of_gets_its_mean(rough):
    """The list holds all pixels chosen before the edges, each once, those that these part last."""
    rng = np.random.default_rng(2)
    height, width = 70, 90
    face = jnp.asarray(rng.integers(-1, 9, (height + 2, width + 2)), jnp.int32)
    noise = rng.uniform(size=(height + 2, width + 2, 3)) * (
        rng.uniform(size=(height + 2, width + 2, 1)) < rough
    )
    hard = jnp.asarray(0.5 + noise, jnp.float32)
    parts = rng.uniform(size=(height, width, 1)) < 0.3
    found = bending.find_turning(face, hard)
    number, plain, moving, total = bending.bending(found, hard[1:-1, 1:-1] + 0.1 * parts)
    listed = np.asarray(number[:total])
    assert 0 < plain < total <= number.size < height * width / 2
    assert len(set(listed)) == total
    assert set(np.flatnonzero(found.chosen)) <= set(listed)
    assert np.any(found.chosen)
    np.testing.assert_array_equal(parts.reshape(-1)[listed], np.arange(total) >= plain)
    sharp = np.asarray(found.sharp).reshape(-1)[listed[plain:]]
    np.testing.assert_array_equal(sharp, np.arange(plain, total) < moving)


def parameters_of(values):
    return scene(shift=values[:3], direction=jnp.array([-1.0, -1, -2]) + values[3:])


def test_both_directions_of_the_derivative_and_views_agree():
    rng = np.random.default_rng(3)
    tangent, weight = (jnp.asarray(rng.normal(size=s), jnp.float32) for s in (6, (40, 40, 3)))

    def picture(eye, values):
        return dr.render(parameters_of(values), camera(eye), settings(40))

    eyes = jnp.array([[1.2, 2.0, 2.2], [1.0, 1.5, 3.0]])
    forward = jax.jit(lambda eye: jax.jvp(lambda v: picture(eye, v), (jnp.zeros(6),), (tangent,)))
    back = jax.jit(lambda eye: jax.vjp(lambda v: picture(eye, v), jnp.zeros(6))[1](weight)[0])
    for eye in eyes:
        change = jnp.vdot(weight, forward(eye)[1])
        np.testing.assert_allclose(jnp.vdot(back(eye), tangent), change, rtol=2e-4)
    want = jax.tree.map(lambda *x: jnp.stack(x), *map(forward, eyes))
    got = jax.jit(jax.vmap(forward))(eyes)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=2e-4), got, want)


def test_what_is_added_has_its_own_derivative(monkeypatch):
    """Found in batches, against JAX's derivative of the same colours, and of vertices as well.

    But where colours at points change too fast to tell of a pixel.
    """
    found = []

    def watched(*given):
        found.append(given)
        return jnp.zeros((given[-1].chosen.number.size, 3))

    added = turning._added
    with monkeypatch.context() as patch:
        patch.setattr(turning, "_added", watched)
        patch.setattr(bending, "PARTS_AT_ONCE", 32)
        patch.setattr(bending, "_FEW", 32)
        dr.render.__wrapped__(scene(), camera(), settings(40))
        ((shade, size, (data, drawn), points),) = found
        chosen = points.chosen
        assert 32 < chosen.plain < chosen.total <= chosen.number.size
        all_seen = jnp.full(chosen.number.size, 4, jnp.int8)
        only = chosen._replace(moving=chosen.plain, total=chosen.plain)
        plain = points._replace(chosen=only, seen=all_seen)
        hard = jnp.zeros((42, 42, 3)).at[::2].set(1e9)  # so that no slope is too steep

        def colored(vertices, direction):
            attributes = (vertices, *drawn.attributes[1:])
            (light,) = data.scene.lights
            placed = drawn.placed._replace(attributes=attributes)
            lit = dr.DirectionalLight(direction=direction, ambient=light.ambient)
            moved = dr.Scene(objects=data.scene.objects, lights=[lit])
            drawn_now = drawn._replace(attributes=attributes, placed=placed)
            return data._replace(scene=moved), drawn_now

        rng = np.random.default_rng(0)
        at = drawn.attributes[0], jnp.array([-1.0, -1, -2])
        way = tuple(jnp.asarray(rng.normal(size=x.shape), jnp.float32) for x in at)

        def in_one_go(*values):
            patch.setattr(bending, "PARTS_AT_ONCE", chosen.number.size)
            first = jnp.zeros((), jnp.int32)
            parts = within.parts_of(plain.chosen, first, chosen.plain)
            colors = turning._colors(shade, size, colored(*values), plain, parts, first)
            return turning._sums(colors, plain, parts, first, jnp.full(chosen.number.size, 0.25))

        @jax.custom_jvp
        def added_to(given):
            patch.setattr(bending, "PARTS_AT_ONCE", 32)
            return added(shade, size, given, plain)

        def derivative(at, changes):
            return added_to(*at), turning._change(shade, size, *at, plain, hard, *changes)

        added_to.defjvp(derivative, symbolic_zeros=True)

        def in_batches(*values):
            return added_to(colored(*values))

        want, want_change = jax.jvp(in_one_go, at, way)
        got, change = jax.jvp(in_batches, at, way)
        np.testing.assert_allclose(got, want, atol=5e-5)
        scale = np.abs(want_change).max()
        np.testing.assert_allclose(change, want_change, atol=1e-3 * scale)
        weight = jnp.asarray(rng.normal(size=want.shape), jnp.float32)
        pulled, others = (jax.vjp(f, *at)[1](weight) for f in (in_batches, in_one_go))
        for ours, theirs in zip(pulled, others, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-3 * np.abs(theirs).max())


COLORS = {"black": 0.0, "huge": 1e37, "not finite": 3e38}  # the light doubles them


@pytest.mark.parametrize("kind", ["rough", *COLORS])
def test_odd_pictures_end_and_stay_finite(kind):
    """Where every pixel bends, or none, or where sums of colours leave their range."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=RING.vertices.shape) if kind == "rough" else RING.normals
    mesh = dr.Mesh(vertices=RING.vertices, faces=RING.faces, normals=normals)
    material = {"diffuse": (COLORS[kind],) * 3} if kind in COLORS else SHINY

    def loss(shift):
        given = scene(mesh, material, shift=shift, diffuse=(2.0, 2, 2), ambient=(0.0, 0, 0))
        return jnp.sum(dr.render(given, camera(), settings(32)) * 1e-38)

    value, gradient = jax.value_and_grad(loss)(jnp.zeros(3))
    if kind != "not finite":
        assert np.isfinite(value)
        assert np.all(np.isfinite(gradient))


def test_what_cannot_turn_has_no_part_in_the_program():
    def loops(given, **options):
        return times(operations(dr.render, given, camera(), settings(16, **options)), "while")

    smooth = loops(scene())
    for shading in ("flat", "gouraud", "unlit"):
        assert loops(scene(), shading=shading) < smooth
    assert loops(scene(), antialias=False) < loops(scene(), shading="unlit")
