"""Outlines of shadows: found, drawn where they fall, and counted."""

import itertools
from dataclasses import replace
from functools import partial

import box_filter
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from reference import area_of
from shadow_scenes import (
    FRAME,
    ROUND_THE_CORNER,
    SIZE,
    at_random,
    ball,
    floor,
    make,
    settings,
    sun,
)

import diffrast as dr
from diffrast import linalg, shapes

pytestmark = pytest.mark.usefixtures("compiled_quickly")


def _mean_over_pixels(scene, camera, size, shading="phong", lines=16):
    oracle = scenes.Oracle(scene, camera.view, camera.projection)
    return box_filter.render_box(
        oracle.positions,
        oracle.normals,
        oracle.faces,
        oracle.view,
        oracle.projection,
        lights=[light | {"shadow": True} for light in oracle.lights],
        material=oracle.material(),
        height=size,
        width=size,
        shading=shading,
        lines=lines,
        piercing=True,
    )


@pytest.mark.parametrize(
    ("name", "error"), [("cubes in the light of a spot", 9.8e-5), ("hills in the evening", 8.5e-4)]
)
def test_pictures_with_outlines_equal_the_mean_over_pixels(name, error):
    """Also where cubes touch the floor, to the last digits, and on faces turned from the light.

    Without edges the errors are 2.7e-3 and 4.5e-3. On the hills the colour of rough ground turns
    within a pixel, and outlines pass from face to face.
    """
    scene, camera = make(name)
    picture = dr.render(scene, camera, settings(antialias=True))
    assert np.mean(np.abs(picture - _mean_over_pixels(scene, camera, SIZE))) < error


def test_shadows_of_several_bodies_meet_in_pixels_as_they_should():
    """Also where corners of shadows do, and where what casts them hides where they begin."""
    errors = []
    for seed in (12, 19, 20, 30, 32, 35, 36, 53):
        scene, camera = at_random(seed)
        picture = dr.render(scene, camera, dr.RenderSettings(height=32, width=32))
        errors.append(np.abs(picture - _mean_over_pixels(scene, camera, 32)))
    assert np.mean(errors) < 5.7e-4  # without edges .013, with 16 samples .0017
    assert np.sum(np.max(errors, axis=-1) > 0.1) <= 5


_PIXEL, _SLOPE, _DARK = 0.25, 0.5, 0.1 * 0.8  # of a row over a sheet; the last: ambient light


@jax.jit
def _row_over_a_sheet(covered, height):
    """A sheet over a floor, seen from above, of which it covers a part of column 10."""
    size = 16
    down = linalg.rotation_x(-np.pi / 2)
    camera = dr.Camera.orthographic(
        eye=(0, 5, 0), up=(0, 0, -1), target=(0, 0, 0), height=size * _PIXEL, near=0.1, far=20.0
    )
    place = jnp.array([0.5 + covered * _PIXEL - 2.0, height, 0.1])
    grey = dr.Material(diffuse=(0.2, 0.2, 0.2))
    sheet = dr.Object(shapes.plane(4.0, 8.0), grey, linalg.translation(place) @ down)
    light = sun((_SLOPE, -1.0, 0.0))
    scene = dr.Scene(objects=[sheet, floor(height=0.0)], lights=[light])
    return dr.render(scene, camera, dr.RenderSettings(height=size, width=size))[size // 2, :, 0]


def test_a_shadow_that_begins_under_what_casts_it():
    """A sheet over a floor, and its shadow, of which no pixel's centre may be.

    Areas and their derivative in closed form, by how much of a pixel the sheet covers, its centre
    or not, and by its height, and so by how far its shadow goes beyond it.
    """
    parts = itertools.product((0.05, 0.2, 0.4), (0.05, 0.2, 0.4))
    for covered, shaded in [*parts, (0.6, 0.02), (0.6, 0.2), (0.8, 0.1), (0.95, 0.02)]:
        at, way = (covered, shaded * _PIXEL / _SLOPE), (0.3, 0.1)
        got, change = jax.jvp(_row_over_a_sheet, at, way)
        sheet, lit = got[2], got[-1]
        want = covered * sheet + shaded * _DARK + (1 - covered - shaded) * lit
        moved = way[0] * (sheet - lit) + way[1] * _SLOPE / _PIXEL * (_DARK - lit)
        np.testing.assert_allclose(got[10], want, atol=2e-5)
        np.testing.assert_allclose(change[10], moved, rtol=1e-3)


def test_outlines_through_the_centres_of_pixels():
    """Rounding has them on either side of these: what the pixels next to them show tells."""
    parts = itertools.product((0.05, 0.1, 0.2, 0.25, 0.3, 0.4, 0.6, 0.8), (0.5, 1.5))
    for covered, end in [(c, e) for c, e in parts if c < e]:  # from where column 10 begins
        got = _row_over_a_sheet(covered, (end - covered) * _PIXEL / _SLOPE)
        sheet, lit = got[2], got[-1]
        dark, left = min(end, 1) - covered, 1 - min(end, 1)
        want = [covered * sheet + dark * _DARK + left * lit]
        want.append(lit if end < 1 else (lit + _DARK) / 2)
        np.testing.assert_allclose(got[10:12], want, atol=1e-4)


BLACK = dr.Material(ambient=(0, 0, 0), diffuse=(0, 0, 0))


def from_straight_above(size, far=20.0):
    """One unit is a pixel; x to the right, z downwards, and the middle at the origin."""
    return dr.Camera.orthographic(
        eye=(0, far / 2, 0), up=(0, 0, -1), target=(0, 0, 0), height=size, near=0.1, far=far
    )


def block(lower, upper, material=None):
    """A box from one corner to another."""
    lower, upper = jnp.stack(lower), jnp.stack(upper)
    place = linalg.translation((lower + upper) / 2) @ linalg.scaling((upper - lower) / 2)
    return dr.Object(shapes.cube(), material, place)


@pytest.mark.parametrize("along", [(0.5, -1.0, 0.0), (-0.25, -1.0, 0.0)])
def test_walls_in_whose_plane_light_and_sight_are(along):
    """The outline of a wall's shadow is in one line with the wall's edge, which hides one side.

    Area and derivative in closed form, by where the wall is: beside the box, and beyond it.
    """
    size = 12

    @jax.jit
    def column(part):
        box = block((-3.0, 0.0, -4.0), (2.0, 3.0, part), BLACK)
        scene = dr.Scene(objects=[box, floor(shapes.plane(60, 60), 0.0)], lights=[sun(along)])
        options = dr.RenderSettings(height=size, width=size)
        return dr.render(scene, from_straight_above(size), options)[..., 0]

    beyond = 8 if along[0] > 0 else 2  # a column in which all of it is dark
    for part in (0.02, 0.2, 0.45, 0.49, 0.499, 0.51, 0.52, 0.8, 0.98):
        got, change = jax.jvp(column, (part,), (1.0,))
        lit, dark = got[-1, -1], got[3, beyond]
        assert dark < 0.5 * lit
        np.testing.assert_allclose(got[6, 4:7], (1 - part) * lit, atol=1e-4)
        np.testing.assert_allclose(change[6, 4:7], -lit, atol=1e-3)
        np.testing.assert_allclose(got[6, beyond], part * dark + (1 - part) * lit, atol=1e-4)
        np.testing.assert_allclose(change[6, beyond], dark - lit, atol=1e-3)


def test_a_lit_strip_between_a_sheet_and_a_shadow():
    """It is narrower than a pixel, and no centre shows it; area and derivative in closed form."""
    size, high, slope = 12, 8.0, 0.5
    flat = linalg.rotation_x(-np.pi / 2)

    @jax.jit
    def row(covered, shaded):
        place = jnp.stack([covered - 4.0, 1.0, 0.0])  # its own shadow lies under it
        sheet = dr.Object(shapes.plane(8.0, 40.0), BLACK, linalg.translation(place) @ flat)
        # A roof behind the camera.
        place = jnp.stack([shaded + slope * high + 15.0, high, 0.0])
        roof = dr.Object(shapes.plane(30.0, 40.0), BLACK, linalg.translation(place) @ flat)
        ground = floor(shapes.plane(60, 60), 0.0)
        scene = dr.Scene(objects=[sheet, roof, ground], lights=[sun((-slope, -1.0, 0.0))])
        options = dr.RenderSettings(height=size, width=size)
        view = from_straight_above(size, far=10.0)
        return dr.render(scene, view, options)[size // 2, :, 0]

    lit = row(-4.0, 5.0)[6]
    for covered, shaded in itertools.product((0.55, 0.7, 0.95), (1.05, 1.2, 1.45)):
        got, change = jax.jvp(row, (covered, shaded), (1.0, 0.5))
        dark = got[9]
        assert dark < 0.5 * lit
        np.testing.assert_allclose(got[6], (1 - covered) * lit, atol=1e-4)
        np.testing.assert_allclose(got[7], (shaded - 1) * lit + (2 - shaded) * dark, atol=1e-4)
        np.testing.assert_allclose(change[6], -lit, atol=1e-3)
        np.testing.assert_allclose(change[7], 0.5 * (lit - dark), atol=1e-3)


def test_a_strip_between_a_shadow_and_the_end_of_a_sheet():
    """Lit or dark, on the nearer surface; no centre shows it. Closed form, with derivatives."""
    size, high, slope = 12, 8.0, 0.5
    flat = linalg.rotation_x(-np.pi / 2)

    @jax.jit
    def row(begin, covered, side):
        place = jnp.stack([covered - 4.0, 1.0, 0.0])
        sheet = dr.Object(shapes.plane(10.0, 40.0), None, linalg.translation(place) @ flat)
        # A roof behind the camera: its shadow ends or begins where the strip does.
        place = jnp.stack([begin + slope * (high - 1.0) + 15.0 * side, high, 0.0])
        roof = dr.Object(shapes.plane(30.0, 40.0), BLACK, linalg.translation(place) @ flat)
        ground = dr.Object(shapes.plane(60.0, 60.0), BLACK, flat)
        scene = dr.Scene(objects=[sheet, roof, ground], lights=[sun((-slope, -1.0, 0.0))])
        options = dr.RenderSettings(height=size, width=size)
        return dr.render(scene, from_straight_above(size, far=10.0), options)[size // 2, :, 0]

    for side, begin, covered in itertools.product(
        (-1.0, 1.0), (0.55, 0.7, 0.95), (0.05, 0.2, 0.45)
    ):
        got, change = jax.jvp(partial(row, side=side), (begin, covered), (1.0, 0.5))
        centre, strip = got[3], row(-8.0, covered, side)[3]
        assert (strip - centre) * side < -0.3
        np.testing.assert_allclose(got[6], begin * centre + (1 - begin) * strip, atol=1e-4)
        np.testing.assert_allclose(got[7], covered * strip, atol=1e-4)
        np.testing.assert_allclose(change[6], centre - strip, atol=1e-3)
        np.testing.assert_allclose(change[7], 0.5 * strip, atol=1e-3)


def test_shadows_of_boxes_seen_from_above_are_as_of_many_samples():
    """Two boxes each, and a light: corners at round places, or walls in the plane of the light."""
    size = 32
    places = np.array(
        [
            [[(-4.75, 0, -5.625), (3, 1, -0.875)], [(3, 0, 1.75), (10.875, 3, 8.375)]],
            [[(-2, 4, -1), (4, 7, 7)], [(0, 4, 2), (5.5, 8, 9.5)]],
            [[(-3.13, 0, -2.259), (0.758, 2, 2.862)], [(0.775, 2, 0.6), (9.278, 8, 6.477)]],
            [[(-7.125, 2, 3.12), (0.51, 8, 10.502)], [(-0.354, 0, -3.118), (6.893, 4, 3.515)]],
            [[(-7.494, 4, -4.249), (-2.529, 10, 1.227)], [(-4.511, 2, 2.763), (2.735, 8, 8.249)]],
        ]
    )
    slopes = [(-0.5, 0.0), (0.25, 0.5), (0.25, 0.0), (0.0, -0.25), (0.0, -0.5)]

    @partial(jax.jit, static_argnames="samples")
    def picture(boxes, slope, samples=1):
        objects = [*(block(*box) for box in boxes), floor(shapes.plane(90, 90), 0.0)]
        lights = [sun(jnp.stack([slope[0], -1.0, slope[1]]))]
        options = dr.RenderSettings(
            height=size, width=size, antialias=samples == 1, samples=samples
        )
        scene = dr.Scene(objects=objects, lights=lights)
        return dr.render(scene, from_straight_above(size, far=40.0), options)

    for boxes, slope in zip(places, slopes, strict=True):
        at = jnp.array(boxes), jnp.array(slope)
        np.testing.assert_allclose(picture(*at), picture(*at, samples=1024), atol=0.03)


def test_an_outline_that_goes_on_behind_a_sheet():
    """Seen from above; the centre of the pixel where they cross shows the sheet or the floor.

    What casts the shadow lies behind the camera: it hides nothing. Area and derivative in closed
    form, by how much of the pixel the sheet covers, and by how much of the rest is lit.
    """
    size, pixel, slope, high = 16, 0.25, 0.5, 8.0
    down = linalg.rotation_x(-np.pi / 2)
    camera = dr.Camera.orthographic(
        eye=(0, 5, 0), up=(0, 0, -1), target=(0, 0, 0), height=size * pixel, near=0.1, far=20.0
    )
    light = sun((-slope, -1.0, slope))

    @jax.jit
    def picture(covered, lit):
        edge = (2 + covered) * pixel  # of the sheet, in column 10; its shadow lies under it
        place = jnp.stack([edge - 2.0, 1.0, 0.0])
        sheet = dr.Object(shapes.plane(4.0, 12.0), BLACK, linalg.translation(place) @ down)
        front = lit * pixel - slope * high  # its shadow begins in row 8
        place = jnp.stack([slope * high, high, front + 6.0])
        roof = dr.Object(shapes.plane(24.0, 12.0), None, linalg.translation(place) @ down)
        scene = dr.Scene(objects=[sheet, roof, floor(height=0.0)], lights=[light])
        return dr.render(scene, camera, dr.RenderSettings(height=size, width=size))[..., 0]

    dark, way = 0.1 * 0.8, (0.3, -0.2)  # ambient light
    for covered, lit in itertools.product((0.3, 0.6, 0.9), (0.2, 0.45, 0.8)):
        got, change = jax.jvp(picture, (covered, lit), way)
        bright = got[0, -1]
        ground = lit * bright + (1 - lit) * dark
        np.testing.assert_allclose(got[8, 10], (1 - covered) * ground, atol=2e-5)
        moved = -way[0] * ground + (1 - covered) * way[1] * (bright - dark)
        np.testing.assert_allclose(change[8, 10], moved, rtol=1e-3)


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


def test_outlines_of_a_lamp_under_parallel_projection_are_as_bright_as_the_ground_there():
    """On large faces that come towards the viewer, where light changes from place to place."""
    size = 32
    camera = dr.Camera.orthographic(
        eye=(1, 5, 4), target=(0, -0.8, 0), up=(0, 1, 0), height=5.0, near=0.1, far=50.0
    )
    turned = linalg.compose(linalg.rotation_y(0.5), linalg.scaling(0.5))
    lamp = dr.PointLight(position=(1.3, 1.6, 0.9), shadow=dr.Shadow())
    scene = dr.Scene(objects=[dr.Object(shapes.cube(), None, turned), floor()], lights=[lamp])
    options = dr.RenderSettings(height=size, width=size, shading="flat")
    want = _mean_over_pixels(scene, camera, size, "flat", lines=64)
    error = np.abs(dr.render(scene, camera, options) - want)
    assert np.mean(error) < 3e-4
    assert np.max(error) < 0.02


def test_outlines_on_ground_of_faces_of_a_pixel_are_those_on_ground_of_two_faces():
    """Picture and derivative by the lamp; more faces lie in a pixel than are looked at.

    Also where each face has vertices of its own.
    """
    grounds = [shapes.plane(2.9, 2.9, divisions=count) for count in (1, 4, 24)]
    grounds = dr.mesh.stack_meshes([*grounds, dr.mesh.flat_shaded(grounds[1])])
    camera = dr.Camera.perspective(eye=(0.5, 3.0, 4.6), target=(-0.1, -0.4, 0), **FRAME)
    place = linalg.compose(linalg.translation((0, -0.9, 0)), linalg.rotation_x(-1.5))
    thing = dr.Object(shapes.icosphere(2, 0.42), transform=linalg.translation((0.3, 0.1, 0.2)))

    @jax.jit
    def picture_and_derivatives(ground):
        def picture(position):
            light = dr.PointLight(position=position, diffuse=(0.8, 0.75, 0.7), shadow=dr.Shadow())
            scene = dr.Scene(objects=[thing, dr.Object(ground, transform=place)], lights=[light])
            return dr.render(scene, camera, dr.RenderSettings(height=40, width=40))

        position = jnp.array([1.3, 2.1, 0.9])
        image, derivative = jax.linearize(picture, position)
        return image, jax.lax.map(derivative, jnp.eye(3))

    (image, want), *others = (
        picture_and_derivatives(jax.tree.map(lambda part, k=k: part[k], grounds)) for k in range(4)
    )
    for other, got in others:
        assert np.mean(np.abs(other - image)) < 5e-5
        assert np.linalg.norm(got - want) < 3e-3 * np.linalg.norm(want)


def test_an_outline_on_the_border_between_pixels_belongs_to_one_of_them():
    """Of a square's shadow, whose upper and lower border lie on borders of rows of pixels."""
    camera = dr.Camera.orthographic(eye=(0, 0, 20), target=(0, 0, 0), height=16.0, near=1, far=40)
    rows = [(0, 1, 2), (0, 2, 3)]
    square = np.array([[-5.7, 4, 4], [-5.7, -4, 4], [-0.9, -4, 4], [-0.9, 4, 4]])
    black = dr.Material(diffuse=(0, 0, 0))
    thing = dr.Object(dr.Mesh(vertices=square, faces=rows), black)

    @jax.jit
    def derivative(across):
        def picture(across):
            direction = jnp.array([1.0, 0.0, -1.0]).at[1].set(across)
            light = dr.DirectionalLight(direction=direction, shadow=dr.Shadow(resolution=64))
            scene = dr.Scene(objects=[thing, dr.Object(shapes.plane(72, 72))], lights=[light])
            options = dr.RenderSettings(height=16, width=16, shading="flat")
            return dr.render(scene, camera, options)[..., 0].sum(axis=1)

        return jax.jvp(picture, (across,), (1.0,))[1]

    on_border, near = np.asarray(derivative(0.0)), np.asarray(derivative(1e-4))
    for rows in (slice(0, 8), slice(8, 16)):
        np.testing.assert_allclose(np.sum(on_border[rows]), np.sum(near[rows]), rtol=0.25)


@pytest.mark.parametrize("direction", [(0.0, 0.0, -1.0), (1.0, 0.0, -1.0)])
def test_beside_walls_along_light_and_sight_through_centres_the_ground_is_lit(direction):
    """Where their shadow would begin the box has its outline; pixels there show half of each."""
    corners = np.asarray(shapes.cube().vertices) * [1.5, 1.5, 0.5] + [0, 0, 0.5]
    box = dr.Object(dr.Mesh(vertices=corners, faces=shapes.cube().faces), dr.Material())
    ground = dr.Object(shapes.plane(60, 60), dr.Material(diffuse=(0.3, 0.5, 0.7)))
    light = dr.DirectionalLight(direction=direction, shadow=dr.Shadow(resolution=128))
    camera = dr.Camera.orthographic(eye=(0, 0, 20), target=(0, 0, 0), height=8.0, near=1, far=40)
    scene = dr.Scene(objects=[box, ground], lights=[light])
    got = dr.render(scene, camera, dr.RenderSettings(height=8, width=8, shading="flat"))
    half = (got[3, 3] + got[0, 0]) / 2
    sides = [got[2, 3:5], got[5, 3:5], got[3:5, 2]] + [got[3:5, 5]] * (direction[0] == 0)
    np.testing.assert_allclose(np.stack(sides), np.tile(half, (len(sides), 2, 1)), atol=1e-3)


def test_outlines_through_centres_of_pixels_bound_their_exact_area():
    """Of quads whose shadows have sides and corners there, on a floor whose diagonal is, too."""
    quads = np.array(
        [
            ((2.5, 2.5), (5.5, 2.5), (5.5, 5.5), (2.5, 5.5)),
            ((2.5, 2.0), (5.5, 2.0), (5.5, 5.0), (2.5, 5.0)),
            ((2.5, 2.5), (4.5, 0.5), (6.5, 2.5), (4.5, 4.5)),
            ((2.5, 2.5), (5.5, 1.5), (6.5, 4.5), (3.5, 5.5)),
            ((2.5, 2.5), (5.3, 2.9), (5.5, 5.5), (2.1, 4.5)),
            ((2.0, 2.0), (5.0, 2.0), (5.0, 5.0), (2.0, 5.0)),
        ]
    )
    camera = dr.Camera.orthographic(eye=(0, 0, 20), target=(0, 0, 0), height=16.0, near=1, far=40)
    light = dr.DirectionalLight(direction=(1.0, 0.0, -1.0), shadow=dr.Shadow(resolution=64))
    options = dr.RenderSettings(height=16, width=16, shading="flat")

    def picture(quad):
        """How dark the floor is, right of the quad itself, that hovers 8 above it."""
        corners = jnp.concatenate([quad - jnp.array([8.0, 0.0]), jnp.full((4, 1), 8.0)], axis=1)
        thing = dr.Object(dr.Mesh(vertices=corners, faces=[(0, 1, 2), (0, 2, 3)]))
        scene = dr.Scene(objects=[thing, dr.Object(shapes.plane(72, 72))], lights=[light])
        image = dr.render(scene, camera, options)[:, 8:, 0]
        return 1 - image / jax.lax.stop_gradient(image[0, -1])

    def value_and_derivative(quad):
        dark, pull_back = jax.vjp(picture, quad)
        return dark, pull_back(jnp.ones_like(dark))[0]

    pictures, derivatives = jax.lax.map(value_and_derivative, jnp.asarray(quads, jnp.float32))
    steps = 1e-3 * np.eye(8).reshape(8, 4, 2)
    for quad, dark, got in zip(quads, pictures, derivatives, strict=True):
        assert np.max(dark) < 1 + 1e-5
        np.testing.assert_allclose(np.sum(dark), area_of(quad), atol=5e-3)
        want = [(area_of(quad + step) - area_of(quad - step)) / 2e-3 for step in steps]
        np.testing.assert_allclose(np.ravel(got), want, atol=1e-3)


def test_outlines_under_a_lens():
    """A lens bends where vertices are shown, not where a lamp stands, far out of what it shows."""
    size = 40
    lamp = dr.PointLight(position=(2.0, -1.5, 5.0), shadow=dr.Shadow(resolution=256))
    tiles = dr.Object(shapes.plane(4.0, 4.0, divisions=24))
    body = dr.Object(shapes.icosphere(3, 0.7), transform=linalg.translation((0.2, 0.1, 0.9)))
    scene = dr.Scene(objects=[body, tiles], lights=[lamp])
    camera = dr.Camera.opencv(
        intrinsics=[[48, 0, 20], [0, 48, 20], [0, 0, 1]],
        rotation=np.diag([1, -1, -1]) @ np.asarray(linalg.rotation_x(-0.7))[:3, :3],
        translation=(0.1, 0, 4),
        width=size,
        height=size,
        near=0.5,
        far=20,
        distortion=(-0.2, 0.05, 0, 0, 0),
    )
    got, want = (
        dr.render(scene, camera, dr.RenderSettings(height=size, width=size, **options))
        for options in ({}, {"antialias": False, "samples": 256})
    )
    assert np.mean(np.abs(got - want)) < 1.5e-3  # with the lamp's place bent, three times as much


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


def board(first, last, height):
    """From one x to another, long in the direction of z."""
    place = linalg.translation(((first + last) / 2, height, 0))
    size = linalg.scaling(((last - first) / 2, 0.01, 3))
    return dr.Object(shapes.cube(), transform=linalg.compose(place, size))


def boards(direction, lower=(-0.87, 0.13)):
    both = [board(-1.02, -0.02, 3.5), board(*lower, 2.5)]
    ground = floor(shapes.plane(40.0, 40.0), 0.0)
    return dr.Scene(objects=[ground, *both], lights=[sun(direction)])


def from_above(x=0.0):
    return dr.Camera.perspective(
        eye=(x, 2, 0), target=(0, 0, 0), up=(0, 0, -1), fov_y=1.2, near=0.1, far=50
    )


FEW_PIXELS = dr.RenderSettings(height=12, width=12, shading="flat")


@pytest.mark.parametrize("direction", [(0, -1, 0), (0, -1, 0.001), (0.02, -1, 0.01)])
@pytest.mark.parametrize("lower", [(-0.87, 0.13), (-0.05, 0.08)])
def test_outlines_of_the_lower_one_of_two_bodies_are_found(lower, direction):
    """It reaches out of the higher one's shadow, by less than a pixel, and its walls are edge-on.

    The narrow one begins many texels beyond the point in the dark from which edges are looked for.
    """
    arguments = boards(direction, lower), from_above()
    want = dr.render(*arguments, replace(FEW_PIXELS, antialias=False, samples=1024))
    got = dr.render(*arguments, FEW_PIXELS)
    assert np.mean(np.abs(np.float64(got) - want)) < 1.5e-3  # at most one column is off by .027


def test_views_with_shadows_and_edges_are_those_of_single_calls():
    """To the bit: also of what is drawn one view after another."""
    scene, cameras = boards((0.5, -1, 0.3)), [from_above(x) for x in (-0.4, 0.1, 0.5)]
    views = dr.stack_cameras(cameras)
    together = jax.vmap(lambda camera: dr.render(scene, camera, FEW_PIXELS))(views)
    for got, camera in zip(together, cameras, strict=True):
        assert len(np.unique(got)) > 5
        np.testing.assert_array_equal(got, dr.render(scene, camera, FEW_PIXELS))


def test_outlines_end_where_bodies_go_into_the_ground_and_narrow_strips_darken_nothing_else():
    """Of two boxes that pierce each other, twice, against many samples.

    An outline ran on beyond the foot of the box that casts it, over the next pixel. And behind the
    edge of one box a strip of the other, much narrower than a pixel, lies in its shadow: all that
    the pixels there show of it was dark. The errors were .17 and .28.
    """
    boxes = np.reshape(
        [
            (223, 187, -97, 259, -296, 149, -58, 199, 20, 118, 225, 432),
            (52, 19, 340, 595, -305, 88, 37, 348, -129, -201, 49, 512),
            (234, -216, -134, -507, 172, 383, -7, 214, 138, -111, 235, 137),
            (9, 92, -277, -111, 306, -177, -24, 229, -157, -341, -62, -164),
        ],
        (2, 2, 3, 4),
    )
    lights = [[-0.762, -2.227, -1.563], [-1.021, -2.174, -1.558]]
    eyes = [[0.19, 2.47, 4.306], [0.65, 2.822, 4.253]]
    ways = [[-0.038, -0.52, -0.853], [-0.119, -0.61, -0.783]]

    def picture(places, direction, eye, way, **options):
        light = dr.DirectionalLight(direction=direction, shadow=dr.Shadow(resolution=256))
        objects = [dr.Object(shapes.cube(), transform=place) for place in places]
        options = dr.RenderSettings(height=32, width=32, shading="flat", **options)
        camera = dr.Camera.perspective(
            eye=eye, direction=way, up=(0.1, 1, 0.05), fov_y=0.62, near=0.1, far=50
        )
        return dr.render(dr.Scene(objects=objects, lights=[light]), camera, options)

    many = {"antialias": False, "samples": 1024}
    drawn, sampled = (jax.jit(partial(picture, **options)) for options in ({}, many))
    for places, *others in zip(boxes, lights, eyes, ways, strict=True):
        places = jnp.array([[*place / 1000, [0, 0, 0, 1]] for place in places])
        assert np.max(np.abs(drawn(places, *others) - sampled(places, *others))) < 0.05
