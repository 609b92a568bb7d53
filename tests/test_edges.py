"""The stage that anti-aliases edges: its derivative as a linear map, its limits, its cost."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import area_of

import diffrast as dr
from diffrast._selection import prefix_sum
from diffrast._topology import topology_of, traced_topology
from diffrast.edges.antialias import with_depth
from diffrast.edges.blend import Method, View
from diffrast.edges.collect import collect
from diffrast.edges.derivative import apply_linear
from diffrast.edges.neighborhood import Surface, walk
from diffrast.edges.pieces import (
    AtOnce,
    Pieces,
    clip_edges,
    cut,
    facing,
    to_pixels,
    usual_batches,
    with_runs,
)
from diffrast.edges.rim import _border
from diffrast.edges.survey import survey
from diffrast.edges.waiting import Waiting, first_ones

pytestmark = pytest.mark.usefixtures("compiled_quickly")

SETTINGS = dr.RenderSettings(height=20, width=24, antialias=True)
LIGHTS = [dr.DirectionalLight(direction=(-0.4, -0.5, -1.0))]
MESH = dr.shapes.torus(1.0, 0.4, major_segments=9, minor_segments=6)


@pytest.fixture(scope="module")
def seen():
    """Clip positions of the mesh, and the faces that pixels and border see."""
    clip = dr.world_to_clip(camera(), MESH.vertices)
    draw = functools.partial(dr.rasterize, height=20, width=24, border=1)
    return clip, jax.jit(draw)(clip, MESH.faces).face


def camera(eye=(0.3, 2.0, 3.0)):
    return dr.Camera.perspective(eye=eye, target=(0, 0, 0), fov_y=0.9, near=0.1, far=30.0)


def view_of(mesh, camera, colors, apart=False):
    """A view of 20 × 24 pixels with a colour for each face, and at last for the background."""
    clip = dr.world_to_clip(camera, mesh.vertices)
    face = dr.rasterize(clip, mesh.faces, height=20, width=24, border=1).face
    view = View(
        positions_clip=clip,
        faces=mesh.faces,
        turned=None,
        topology=mesh.topology,
        apart=jnp.full_like(mesh.topology.edges.seam, apart),
        face_image=face,
        image=colors[face],
        background=colors[-1],
        scene=None,
    )
    return with_depth(view)


def image_of(objects, sun, view, size, **options):
    settings = dr.RenderSettings(height=size, width=size, **options)
    scene = dr.Scene(objects=objects, lights=[sun])
    return np.float64(jax.jit(dr.render)(scene, view, settings))


def picture(vertices, camera):
    mesh = dataclasses.replace(MESH, vertices=vertices)
    return dr.render(dr.Scene(objects=[dr.Object(mesh)], lights=LIGHTS), camera, SETTINGS)


@jax.jit
def picture_and_gradient(vertices, camera):
    """The picture, and the derivatives of its sum."""
    image, pull = jax.vjp(picture, vertices, camera)
    return image, pull(jnp.ones_like(image))


@pytest.mark.default_compilation
def test_views_may_be_mapped():
    """The picture alone, too, equals that of which the derivative is asked."""
    eyes = [(0.3, 2.0, 3.0), (1.5, 1.0, -2.0)]
    cameras = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(camera(eye) for eye in eyes))
    together = jax.jit(jax.vmap(picture, in_axes=(None, 0)))(MESH.vertices, cameras)
    for one, eye in zip(together, eyes, strict=True):
        image, _ = picture_and_gradient(MESH.vertices, camera(eye))
        np.testing.assert_allclose(one, image, atol=1e-6)


@pytest.mark.parametrize("case", ["flat", "point", "edge-on", "behind", "inside", "huge", "tiny"])
def test_values_and_derivatives_are_finite(case):
    vertices, eye = MESH.vertices, (0.3, 2.0, 3.0)
    if case == "flat":
        vertices = vertices * jnp.array([1.0, 0.0, 1.0])
    elif case == "point":
        vertices = vertices * 0
    elif case == "edge-on":
        vertices, eye = vertices * jnp.array([1.0, 0.0, 1.0]), (0.0, 0.0, 3.0)
    elif case == "behind":
        vertices = vertices + jnp.array([0.3, 2.0, 6.0])
    elif case == "inside":
        eye = (1.0, 0.05, 0.1)
    elif case == "huge":
        vertices = vertices * 1e6
    elif case == "tiny":
        vertices = vertices * 1e-6
    for leaf in jax.tree.leaves(picture_and_gradient(vertices, camera(eye))):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            assert np.all(np.isfinite(leaf))


def test_a_mesh_without_edges_shows_nothing():
    """Faces of one vertex each have none."""
    mesh = dr.Mesh(vertices=[(0, 0, 0), (1, 0, 0)], faces=[[0, 0, 0], [1, 1, 1]])
    light = dr.DirectionalLight(direction=(0, -1, 0), shadow=dr.Shadow(resolution=8))
    scene = dr.Scene(objects=[dr.Object(mesh)], lights=[light], background=(0.1, 0.2, 0.3))
    view, sizes = camera((0.3, 2.0, 3.0)), dr.RenderSettings(height=8, width=8)
    image, change = jax.jvp(lambda view: dr.render(scene, view, sizes), (view,), (view,))
    np.testing.assert_array_equal(image, np.tile(np.float32(scene.background), (8, 8, 1)))
    np.testing.assert_array_equal(change, np.zeros((8, 8, 3)))


@pytest.mark.parametrize("level", [1, 2])
def test_outlines_at_faces_seen_edge_on_count_once(level):
    """Both sides of such a face end in one place, and hardly one behind the other."""
    ball, rng = dr.shapes.icosphere(level), np.random.default_rng(level)
    corners = np.float64(ball.vertices)[ball.faces]
    white = dr.Object(ball, dr.Material(ambient=(1, 1, 1), diffuse=(0, 0, 0)))
    scene = dr.Scene(objects=[white], lights=[dr.AmbientLight(color=(1, 1, 1))])
    sizes = {"height": 16, "width": 16}
    smooth = jax.jit(lambda view: dr.render(scene, view, dr.RenderSettings(**sizes)))
    settings = dr.RenderSettings(**sizes, antialias=False, samples=24**2)
    sampled = jax.jit(lambda view: dr.render(scene, view, settings))
    for a, b, c in corners[rng.choice(len(corners), 12, replace=False)]:
        along = (b - a) + rng.normal() * (c - a)
        along *= 4 / np.linalg.norm(along)
        place = {"target": (0, 0, 0), "up": rng.normal(size=3), "near": 0.1, "far": 9}
        near = dr.Camera.perspective(eye=(a + b + c) / 3 + along, fov_y=0.55, **place)
        parallel = dr.Camera.orthographic(eye=along, height=2.2, **place)
        for view in (near, parallel):
            np.testing.assert_allclose(smooth(view), sampled(view), atol=0.03)


@pytest.mark.parametrize("whole", [False, True])
def test_boxes_in_a_row_have_no_seam(whole):
    """The sides in which they touch are not seen, and nor are the edges of these."""
    cube = dr.shapes.cube()
    moves = [dr.linalg.translation((x, 0, 0)) for x in (-2.0, 0.0, 2.0)]
    if whole:
        row = dr.mesh.merge([dr.mesh.transform(cube, move) for move in moves])
        # Made anew its boxes hang together.
        row = dr.Mesh(vertices=row.vertices, faces=row.faces, normals=row.normals)
        boxes = [dr.Object(row, dr.Material(diffuse=(0.8, 0.7, 0.5)))]
    else:
        boxes = [
            dr.Object(cube, dr.Material(diffuse=color), move)
            for move, color in zip(moves, np.eye(3), strict=True)
        ]
    scene = dr.Scene(objects=boxes, lights=[dr.DirectionalLight(direction=(-0.3, -0.5, -1))])
    smooth = jax.jit(lambda view: dr.render(scene, view, SETTINGS))
    settings = dataclasses.replace(SETTINGS, antialias=False, samples=24**2)
    sampled = jax.jit(lambda view: dr.render(scene, view, settings))
    # From the last, a pixel of one box's edges holds a corner of the next that no pixel shows.
    eyes = ((0, 5, 5), (5, 5, 5), (-5, 5, 5), (1.5, 3, 7), (-3.1, 7, 2))
    for eye in eyes:
        place = {"eye": eye, "target": (0, 0, 0), "up": (0, 1, 0), "near": 0.1, "far": 20}
        near = dr.Camera.perspective(fov_y=0.8, **place)
        for view in (near, dr.Camera.orthographic(height=6, **place)):
            np.testing.assert_allclose(smooth(view), sampled(view), atol=0.03)


def test_tiles_side_by_side_have_one_edge_in_common():
    """Planes that are bodies of their own: colours are what their areas make them.

    From above in closed form, whichever of the two comes first, and wherever the line between them
    is, through centres of pixels, too; derivatives by their common place.
    """
    size, black = 8, dr.Material(ambient=(0, 0, 0))
    view = dr.Camera.orthographic(eye=(0, 0, 5), target=(0, 0, 0), height=size, near=1, far=9)
    settings = dr.RenderSettings(height=size, width=size)
    tile = dr.shapes.plane(20.0, 20.0)

    def row(line, first_is_black, lift):
        materials = [black, dr.Material(ambient=(1, 1, 1))]
        sides = [-10.0, 10.0] if first_is_black else [10.0, -10.0]
        tiles = [
            dr.Object(tile, material, dr.linalg.translation(jnp.stack([line + side, 0.0, z])))
            for material, side, z in zip(materials, sides, (0.0, lift), strict=True)
        ]
        scene = dr.Scene(objects=tiles, lights=[dr.AmbientLight((1.0, 1.0, 1.0))])
        return dr.render(scene, view, settings)[3, :, 0]

    value_and_change = jax.jit(
        lambda line, lift, black_left: jax.jvp(
            lambda line: row(line, black_left, lift), (line,), (1.0,)
        ),
        static_argnums=2,
    )
    borders = np.arange(size) - size / 2
    for line, lift, black_left in itertools.product(
        (0.1, 0.25, 0.5, 0.77, 1.0), (0.0, 0.3), (True, False)
    ):
        got, change = value_and_change(line, lift, black_left)
        share = np.clip(line - borders, 0, 1)
        rate = np.where((line > borders) & (line <= borders + 1), 1.0, 0.0)
        np.testing.assert_allclose(got, 1 - share if black_left else share, atol=1e-4)
        if line != 1.0:  # a kink, on the border of two pixels
            np.testing.assert_allclose(change, -rate if black_left else rate, atol=1e-4)


def test_tiles_seen_from_aside_are_as_exact_as_many_samples():
    colors = np.random.default_rng(0).uniform(0.1, 0.9, (9, 3))
    flat = dr.linalg.rotation_x(-np.pi / 2)
    tiles = [
        dr.Object(
            dr.shapes.plane(1.0, 1.0),
            dr.Material(ambient=color),
            dr.linalg.compose(dr.linalg.translation((k // 3 - 1.0, 0, k % 3 - 1.0)), flat),
        )
        for k, color in enumerate(colors)
    ]
    scene = dr.Scene(objects=tiles, lights=[dr.AmbientLight((1.0, 1.0, 1.0))])
    view = dr.Camera.perspective(
        eye=(1.3, 2.7, 2.1), target=(0, 0, 0), fov_y=0.8, aspect=1.0, near=0.1, far=20.0
    )
    settings = dr.RenderSettings(height=32, width=32)
    samples = dataclasses.replace(settings, antialias=False, samples=24**2)
    got, want = (dr.render(scene, view, options) for options in (settings, samples))
    np.testing.assert_allclose(got, want, atol=0.02)


def test_strips_between_bodies_that_no_centre_shows():
    """Two boxes of unequal heights over a floor, seen from above, and the gap between them.

    It is narrower than a pixel and passes no centre. In closed form, with derivatives by the place
    of each box; black floor, one box of red and one of green.
    """
    size = 12
    view = dr.Camera.orthographic(eye=(0, 0, 9), target=(0, 0, 0), height=size, near=1, far=19)
    settings = dr.RenderSettings(height=size, width=size)
    colors = [dr.Material(ambient=color) for color in ((1, 0, 0), (0, 1, 0), (0, 0, 0))]

    @jax.jit
    def row(ends, heights):
        """The left box ends at the first, the right one begins at the other."""
        boxes = [
            dr.linalg.compose(
                dr.linalg.translation(jnp.stack([end + side, 0.0, height / 2])),
                dr.linalg.scaling(jnp.stack([4.0, 4.0, height / 2])),
            )
            for end, side, height in zip(ends, (-4.0, 4.0), heights, strict=True)
        ]
        meshes = (dr.shapes.cube(), dr.shapes.cube(), dr.shapes.plane(30, 30))
        objects = [
            dr.Object(*thing) for thing in zip(meshes, colors, (*boxes, np.eye(4)), strict=True)
        ]
        scene = dr.Scene(objects=objects, lights=[dr.AmbientLight((1.0, 1.0, 1.0))])
        return dr.render(scene, view, settings)[6, :, :2]

    borders = np.arange(size) - size / 2
    both = jax.jit(lambda *given: (row(*given), jax.jacfwd(row)(*given)))
    places = ((0.1, 0.45), (0.47, 0.49), (0.51, 0.56), (0.6, 0.98), (0.3, 0.4), (0.6, 1.4))
    for ends, heights in itertools.product(places, ((1.0, 2.0), (2.0, 0.5))):
        got, change = both(jnp.array(ends), jnp.array(heights))
        red, green = (np.clip(end - borders, 0, 1) for end in ends)
        inside = [(end > borders) & (end < borders + 1) for end in ends]
        want = np.stack([red, 1 - green], axis=1)
        np.testing.assert_allclose(got, want, atol=1e-4)
        rates = np.zeros((size, 2, 2))
        rates[:, 0, 0], rates[:, 1, 1] = inside[0], -1.0 * inside[1]
        np.testing.assert_allclose(change, rates, atol=1e-4)


def test_boxes_seen_from_straight_above_have_exact_edges():
    """Black walls, seen edge-on, of white boxes on a floor whose diagonals pass by their corners.

    What is seen in a pixel is a product of shares of its row and its column, also where corners
    lie at its centre and edges near the picture's border.
    """
    size, rng = 16, np.random.default_rng(0)
    view = dr.Camera.orthographic(eye=(0, 0, 20), target=(0, 0, 0), height=size, near=1, far=60)
    above = dr.DirectionalLight(direction=(0, 0, -1))
    settings = dr.RenderSettings(height=size, width=size, shading="flat")
    grey = dr.Object(dr.shapes.plane(60, 60), dr.Material(diffuse=(0.5, 0.5, 0.5)))
    white = dr.Material(diffuse=(1.0, 1.0, 1.0))
    # Only that depths are no round numbers.
    higher = dr.Object(dr.shapes.cube(), white, dr.linalg.translation((100, 0, 20)))

    @jax.jit
    def from_above(low, high):
        placed = dr.linalg.compose(
            dr.linalg.translation((low + high) / 2), dr.linalg.scaling((high - low) / 2)
        )
        objects = [dr.Object(dr.shapes.cube(), white, placed), grey, higher]
        return dr.render(dr.Scene(objects=objects, lights=[above]), view, settings)[..., 0]

    at = np.arange(size) - size / 2
    for start, more in rng.integers((-15, -15, 1), (4, 4, 5), (200, 2, 3)):
        low = start / (2, 2, 1)
        high = low + (np.abs(more) + 2) / (2, 2, 1)
        columns, rows = (
            np.maximum(np.minimum(high[i], at + 1) - np.maximum(low[i], at), 0) for i in range(2)
        )
        want = 0.5 + 0.5 * rows[::-1, None] * columns
        np.testing.assert_allclose(from_above(low, high), want, atol=0.01)


def test_bodies_that_lie_in_one_another_have_no_line_in_common():
    """A cube twice, in two colours: nothing changes where nothing does with one in view."""
    cube = dr.shapes.cube()
    twice = [dr.Object(cube, dr.Material(diffuse=c)) for c in ((1, 0, 0), (0, 0, 1))]
    settings = dataclasses.replace(SETTINGS, shading="unlit")
    shift = jnp.array([0.3, 0.2, 0.1])

    @jax.jit
    def moved(second):
        def image(s):
            places = (s * shift, second + s * shift)
            objects = [
                dataclasses.replace(item, transform=dr.linalg.translation(place))
                for item, place in zip(twice, places, strict=True)
            ]
            return dr.render(dr.Scene(objects=objects), camera(), settings)

        return jax.jvp(image, (0.0,), (1.0,))[1].sum(axis=-1)

    behind_the_camera = 2 * jnp.array([0.3, 2.0, 3.0])
    one, two = moved(behind_the_camera), moved(jnp.zeros(3))
    np.testing.assert_allclose(two[one == 0], 0, atol=1e-4)
    assert np.sum(one == 0) > 200


@pytest.mark.parametrize(("shading", "share"), [("flat", 0.5), ("phong", 1.0)])
def test_faces_of_a_pixel_that_pierce_and_hide_one_another_are_as_exact_as_16_samples(
    shading, share
):
    """Two balls that pierce one another, a ring round them, and a floor behind."""
    red, blue = (dr.Material(diffuse=color) for color in ((0.9, 0.5, 0.4), (0.3, 0.5, 0.9)))
    one = dr.linalg.translation((-0.5, 0, 0)) @ dr.linalg.scaling(0.8)
    other = dr.linalg.translation((0.5, 0.2, 0.3)) @ dr.linalg.scaling(0.6)
    lying = dr.linalg.translation((0, -0.6, 0)) @ dr.linalg.rotation_x(-np.pi / 2)
    objects = [
        dr.Object(dr.shapes.icosphere(4), red, one),
        dr.Object(dr.shapes.icosphere(4), red, other),
        dr.Object(dr.shapes.torus(1.2, 0.12, major_segments=64, minor_segments=16), blue),
        dr.Object(dr.shapes.plane(8.0, 8.0), None, lying),
    ]
    sun = dr.DirectionalLight(direction=(-0.8, -1, -0.5), diffuse=(0.8,) * 3, ambient=(0.1,) * 3)
    view = dr.Camera.perspective(eye=(1, 1.5, 4), target=(0, 0, 0), fov_y=0.7, near=0.1, far=50.0)
    drawn = functools.partial(image_of, objects, sun, view, 80, shading=shading)
    many, some = (drawn(antialias=False, samples=samples) for samples in (256, 16))
    assert abs(drawn() - many).mean() < share * abs(some - many).mean()


SMOOTH = {
    "ball": dr.shapes.icosphere(4),
    "coarse ring": dr.shapes.torus(0.8, 0.35, major_segments=24, minor_segments=12),
}


@pytest.mark.parametrize(
    ("name", "size", "error"), [("ball", 64, 0.0011), ("coarse ring", 128, 0.0022)]
)
def test_colors_that_turn_at_a_rim_count_by_the_area_that_shows_them(name, size, error):
    """A pixel reaches less far inwards from the ends of an edge than from its middle."""
    sun = dr.DirectionalLight(direction=(-1, -1, -2), ambient=(0.1,) * 3)
    thing = dr.Object(SMOOTH[name], dr.Material(specular=(0.5,) * 3))
    view = dr.Camera.perspective(eye=(1.2, 2, 3), target=(0, 0, 0), fov_y=0.7, near=0.1, far=99.0)

    drawn = functools.partial(image_of, [thing], sun, view, size)
    apart = drawn() - drawn(antialias=False, samples=256)
    assert np.sqrt((apart**2).mean()) < error


def test_what_thin_faces_hide_shows_no_edge():
    """The faces in front are so thin that the pixels beside the edge may see none of them."""
    wall = dr.shapes.plane(8.0, 8.0, divisions=(2, 130))
    tilted = dr.linalg.translation((0.0, 0.0, -0.1)) @ dr.linalg.rotation_z(0.05)
    objects = [
        dr.Object(wall, dr.Material(diffuse=(1.0, 1.0, 1.0))),
        dr.Object(dr.shapes.plane(1.0, 1.0), dr.Material(diffuse=(0.0, 0.0, 0.0)), tilted),
    ]
    settings = dataclasses.replace(SETTINGS, shading="unlit")
    image = dr.render(dr.Scene(objects=objects), camera((0.0, 0.0, 3.0)), settings)
    np.testing.assert_allclose(image, 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("eye", "error"),
    [
        ((0.6, -2.2, 1.1), 0.006),
        ((1.2, 1.8, 0.9), 0.004),
        ((2.3, 0.0, 0.7), 0.0015),
        ((-2.1, -1.0, 0.1), 0.003),
    ],
)
def test_where_one_surface_ends_another_may_lie_beyond(eye, error):
    """A black teapot before a white background: what shows through it would be white.

    From the last two sides what lies behind shows at no pixel's centre nearby.
    """
    pot = dr.shapes.teapot(divisions=6)
    middle = (pot.vertices.min(axis=0) + pot.vertices.max(axis=0)) / 2
    radius = np.linalg.norm(pot.vertices - middle, axis=1).max()
    camera = dr.Camera.perspective(
        eye=middle + radius * np.array(eye),
        target=middle,
        up=(0, 0, 1),
        fov_y=0.8,
        near=0.1,
        far=50.0,
    )
    black = dr.Material(diffuse=(0, 0, 0), specular=(0, 0, 0), ambient=(0, 0, 0))
    scene = dr.Scene(
        objects=[dr.Object(pot, black)],
        lights=[dr.DirectionalLight(direction=(-1, -1, -2))],
        background=(1, 1, 1),
    )
    image, exact = (
        dr.render(scene, camera, dr.RenderSettings(height=96, width=96, **options))
        for options in ({}, {"antialias": False, "samples": 256})
    )
    assert np.sqrt(np.mean((image - exact) ** 2)) < error


@functools.cache
def area_of_square_on_the_screen():
    """Its four corners, in pixels, to the area of 16 × 16 pixels that shows it."""

    @jax.jit
    def drawn(corners):
        x, y = corners[:, 0] / 8 - 1, 1 - corners[:, 1] / 8
        clip = jnp.stack([x, y, 0 * x, jnp.ones_like(x)], axis=1)
        faces = jnp.array([[0, 1, 2], [0, 2, 3]])
        face = dr.rasterize(clip, faces, height=16, width=16, border=1).face
        image = jnp.where(face >= 0, 1.0, 0.0)[..., None]
        return dr.antialias(image, clip, faces, face)[..., 0]

    return drawn


@pytest.mark.parametrize(
    "corners",
    [
        ((3, 3), (11, 3), (11, 12), (3, 12)),
        ((3, 3.5), (11.25, 3.5), (11.25, 12), (3, 12)),
        ((5, 5), (6, 5), (6, 6), (5, 6)),
        ((2, 5), (12, 5), (12, 6), (2, 6)),
        ((2, 2), (10, 2), (14, 10), (6, 10)),
        ((8, 2), (14, 8), (8, 14), (2, 8)),
        ((3.5, 3.5), (11.5, 3.5), (11.5, 12.5), (3.5, 12.5)),
        ((3.5005, 3.5), (11.4995, 3.5), (11.5002, 12.5001), (3.4999, 12.4995)),
        ((3.499, 3.498), (11.501, 3.502), (11.502, 12.499), (3.5, 12.501)),
        ((8.5, 2.5), (13.5, 7.5), (8.5, 12.5), (3.5, 7.5)),
        ((2.5, 3.5), (13.5, 3.5), (13.5, 9), (13.5, 13.5)),
        ((2, 5.5), (12, 5.5), (12, 5.75), (2, 5.75)),
        ((5.5, 2), (5.8, 2), (5.8, 11), (5.5, 11)),
    ],
)
def test_edges_on_borders_and_through_centres_of_pixels_bound_their_exact_area(corners):
    """Also where a corner is at a centre: which side this is on the rasteriser tells."""
    at, image = np.array(corners, np.float32), area_of_square_on_the_screen()
    np.testing.assert_allclose(np.sum(image(at)), area_of(at), atol=1e-3)
    got = jax.grad(lambda corners: image(corners).sum())(at)
    steps = 1e-3 * np.eye(8).reshape(8, 4, 2)
    want = [(area_of(at + step) - area_of(at - step)) / 2e-3 for step in steps]
    np.testing.assert_allclose(np.ravel(got), want, atol=1e-4)


@functools.partial(jax.jit, static_argnames="faces")
def white_faces(corners, faces):
    """The share of 24 × 24 pixels that faces cover, their corners in pixels, and depths."""
    x, y = corners[:, 0] / 12 - 1, 1 - corners[:, 1] / 12
    clip = jnp.stack([x, y, corners[:, 2], jnp.ones_like(x)], axis=1)
    face = dr.rasterize(clip, np.array(faces), height=24, width=24, border=1).face

    def white(_, face, barycentrics):
        return jnp.where(face >= 0, 1.0, 0.0)[:, None]

    image = white(None, face.reshape(-1), None).reshape(26, 26, 1)
    return dr.antialias(image, clip, np.array(faces), face, shader=white)[..., 0]


def way_past_a_centre(random, width, longest):
    """Ends of a line that passes a pixel's centre nearer than that, and the unit vector across it.

    Also how many times as long it is as its part before the centre.
    """
    centre, angle = random.integers(4, 20, 2) + 0.5, random.uniform(0, 2 * np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    before, after = random.uniform(1, longest, 2)
    middle = centre + random.uniform(-width, width) * across
    return middle - before * along, middle + after * along, across, (before + after) / before


@pytest.mark.parametrize("ends", [0.0, 0.7])
@pytest.mark.parametrize("width", [3e-4, 1e-3, 2e-3, 4e-3])
def test_needles_through_centres_of_pixels_fill_none(width, ends):
    """Thinner than vertices move on the rasteriser's grid, which may have them beyond either edge.

    One end is as wide as `ends` times the other.
    """
    random, faces = np.random.default_rng(3), ((0, 1, 2), (0, 2, 3))
    for _ in range(60):
        first, last, across, grows = way_past_a_centre(random, width, 12)
        wide = width * grows
        last = last + random.uniform() * width * across
        corners = [first, first + ends * wide * across, last, last - wide * across]
        corners = np.pad(np.array(corners, np.float32), ((0, 0), (0, 1)))
        image = white_faces(corners[:: random.choice([-1, 1])], faces)
        assert image.min() > -1e-4
        assert image.max() < 3 * wide


@pytest.mark.parametrize("width", [0.05, 0.1, 0.3])
def test_rods_with_ends_near_centres_of_pixels_cover_their_exact_area(width):
    """Where an edge begins, the next face of its own side is less than rounding away from it."""
    random = np.random.default_rng(4)
    sides = [(k, (k + 1) % 3, 3 + (k + 1) % 3) for k in range(3)]
    sides += [(k, 3 + (k + 1) % 3, 3 + k) for k in range(3)]
    faces = ((0, 2, 1), (3, 4, 5), *sides)
    for _ in range(40):
        first, last, across, _ = way_past_a_centre(random, width, 3)
        turn = random.uniform(0, 2 * np.pi) + np.arange(3) * 2 * np.pi / 3
        aside, depth = width / 2 * np.cos(turn), 0.01 * np.sin(turn)
        ends = [end + aside[:, None] * across for end in (first, last)]
        corners = np.column_stack([np.concatenate(ends), np.tile(depth, 2)])
        image = white_faces(corners.astype(np.float32), faces)
        area = np.ptp(aside) * np.linalg.norm(last - first)
        assert abs(image.sum() - area) < 0.02


def test_bodies_that_pierce_on_borders_and_through_centres_of_pixels_part_their_exact_area():
    """A slope rises out of level ground along a column of pixels, in its middle or beside it."""
    corners = np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [9.0, 9.0, 0.0], [-9.0, 9.0, 0.0]])
    rising = corners + np.stack([0 * corners[:, 0], 0 * corners[:, 0], corners[:, 0]], axis=1)
    ground, slope = (dr.Mesh(vertices=v, faces=[(0, 1, 2), (0, 2, 3)]) for v in (corners, rising))
    black, white = (dr.Material(diffuse=(grey,) * 3) for grey in (0.0, 1.0))
    view = dr.Camera.orthographic(eye=(0, 0, 20), target=(0, 0, 0), height=16.0, near=1, far=40)
    settings = dr.RenderSettings(height=16, width=16, shading="unlit")

    def rows(up):
        lifted = dr.Object(ground, black, dr.linalg.translation(jnp.array([0.0, 0, 1]) * up))
        scene = dr.Scene(objects=[lifted, dr.Object(slope, white)])
        return dr.render(scene, view, settings)[..., 0].sum(axis=1)

    lifts = jnp.array([0.0, 0.25, 0.5, 1.0])
    images, changes = jax.lax.map(lambda up: jax.jvp(rows, (up,), (jnp.ones_like(up),)), lifts)
    # Where the diagonals of both pass through a pixel's centre, .0012 is left.
    np.testing.assert_allclose(images, np.repeat(8 - lifts[:, None], 16, axis=1), atol=2e-3)
    np.testing.assert_allclose(changes, -1, atol=2e-4)


def test_needles_that_pierce_a_wall_end_where_they_go_into_it():
    """A triangle that stands alone, of which a strip is seen between its edge and the wall."""
    size, pixel = 32, 2 / 32
    red, blue = np.array((0.9, 0.2, 0.1)), np.array((0.1, 0.3, 0.9))
    wall = dr.Object(dr.shapes.plane(9.0, 9.0), dr.Material(diffuse=blue))
    view = dr.Camera.orthographic(height=2.0, eye=(0, 0, 5), target=(0, 0, 0), near=0.1, far=9.0)
    settings = dr.RenderSettings(height=size, width=size, shading="unlit")

    @functools.partial(jax.jit, static_argnames="settings")
    def drawn(tip, way, settings):
        needle = dr.Mesh(vertices=jnp.stack([*ends, tip]) + pixel * way, faces=[[0, 1, 2]])
        objects = [wall, dr.Object(needle, dr.Material(diffuse=red))]
        return dr.render(dr.Scene(objects=objects), view, settings)

    @jax.jit
    def change(tip, way):
        return jax.jvp(lambda way: drawn(tip, way, settings), (still,), (way,))[1]

    ends, still = jnp.array([[-0.03, -0.8, 0.4], [0.05, 0.8, 0.4]]), jnp.zeros(3)
    for width in (0.03, 0.1, 0.3):
        tip, area = jnp.array([0.01 + width * pixel / 0.4, 0, -0.6]), 1.28 * width / pixel
        image = drawn(tip, still, settings)
        many = drawn(tip, still, dataclasses.replace(settings, antialias=False, samples=1024))
        np.testing.assert_allclose(image, many, atol=0.01)
        np.testing.assert_allclose((image - blue).sum(axis=(0, 1)), area * (red - blue), rtol=0.01)
        # To the side, up, and nearer: then more of it comes out of the wall.
        across, up, nearer = (change(tip, way) for way in jnp.eye(3))
        moment = np.einsum("hwc,h->c", up, -np.arange(size))
        np.testing.assert_allclose(moment, area * (red - blue), rtol=0.01)
        for part, gained in ((across, 0), (up, 0), (nearer, 2.4 * width)):
            total = part.sum(axis=(0, 1))
            np.testing.assert_allclose(total, gained * (red - blue), rtol=0.01, atol=0.005)


def test_part_of_a_body_that_no_centre_shows_may_lie_behind_another_one():
    """Where the outline of a ring leads from one row of its faces to the next."""
    sun = dr.DirectionalLight(direction=(-1, -0.5, -2), ambient=(0.2,) * 3)
    ring = dr.Object(dr.shapes.torus(), dr.Material(specular=(0.5,) * 3))
    place = {"target": (0, 0, 0), "up": (0, 0, 1), "near": 0.1, "far": 40.0}
    view = dr.Camera.perspective(eye=(2, 2, 3), fov_y=0.7, **place)
    drawn = functools.partial(image_of, [ring], sun, view, 128)
    assert abs(drawn() - drawn(antialias=False, samples=256)).max() < 0.08


@pytest.mark.parametrize("straight", [False, True])
def test_straight_ways_end_where_the_surface_does(straight):
    """Others lead round a hole, the middle one of 3×3 squares."""
    x, y = np.meshgrid(np.arange(4.0), np.arange(4.0))
    corner = [4 * row + column for row, column in np.ndindex(3, 3) if (row, column) != (1, 1)]
    faces = np.array([[(a, a + 1, a + 5), (a, a + 5, a + 4)] for a in corner]).reshape(-1, 3)
    points = np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
    pixels = jnp.asarray(points, jnp.float32)
    topology = jax.tree.map(jnp.asarray, topology_of(points.T, faces))
    faces = jnp.asarray(faces)
    surface = Surface(faces, pixels, topology, facing(pixels, faces, height=3, width=3))
    start = jnp.array([6])  # left of the hole
    reached, there = walk(start, jnp.array([2.3]), jnp.array([0.6]), surface, straight=straight)
    assert there.all()
    assert reached == (-1 if straight else 5)  # above it, on the right


def test_a_face_without_area_does_not_double_the_outline():
    """An octahedron with faces as thin as a line along its outline is as it is without them."""
    turn = np.asarray(dr.linalg.rotation((1.0, 2.0, 3.0), 0.1), np.float64)[:3, :3]
    x, y, z = turn.T
    corners = np.array([x, y, -x, -y, z, -z])
    middles = (corners[:4] + np.roll(corners[:4], -1, axis=0)) / 2
    around = [(i, (i + 1) % 4) for i in range(4)]
    upper = [(a, b, 4) for a, b in around]
    whole = upper + [(b, a, 5) for a, b in around]
    split = upper + [f for a, b in around for f in ((b, a, 6 + a), (b, 6 + a, 5), (6 + a, a, 5))]
    settings = dataclasses.replace(SETTINGS, shading="unlit")

    def drawn(faces):
        mesh = dr.Mesh(vertices=np.concatenate([corners, middles]), faces=faces)
        return dr.render(dr.Scene(objects=[dr.Object(mesh)]), camera((0.1, 0.2, 3.0)), settings)

    image, other = drawn(whole), drawn(split)
    assert np.sum((image > 0.1) & (image < 0.7)) > 60
    np.testing.assert_allclose(other, image, atol=1e-4)


def clipped_edges(clip, size):
    """Vertices of loose triangles in pixels, which way these face, and their clipped edges."""
    faces = jnp.arange(len(clip)).reshape(-1, 3)
    pixels = to_pixels(clip, size, size)
    volume = facing(pixels, faces, height=size, width=size)
    edges = traced_topology(clip, faces).edges
    number = jnp.arange(faces.size)
    segments = clip_edges(
        number,
        number >= 0,
        edges,
        faces,
        pixels,
        clip[:, 2],
        volume,
        height=size,
        width=size,
    )
    return pixels, volume, segments


@pytest.mark.parametrize("distance", [1e-2, 1e-4, 1e-6, 1e-9])
def test_faces_with_a_vertex_near_the_eye_are_what_they_are_in_float64(distance):
    """Which way they face, and where their edges end in the picture."""
    size, near = 64, 1e-4
    points = np.random.default_rng(5).uniform((-2, -2, 0.5), (2, 2, 5), size=(100, 3, 3))
    points[:, 2] *= distance
    clip = np.concatenate([points, points[..., 2:]], axis=2).reshape(-1, 4)
    clip[:, 2] -= 2 * near
    clip = jnp.asarray(clip, jnp.float32)
    pixels, volume, found = clipped_edges(clip, size)
    exact = np.asarray(jnp.stack([*pixels, clip[:, 2]]), np.float64)
    truth = np.linalg.det(exact[:3].T.reshape(-1, 3, 3))
    np.testing.assert_allclose(volume, truth, rtol=1e-3)

    start, end = exact[:, np.asarray(found.vertices)].swapaxes(0, 1)
    x, y, w, z = start
    dx, dy, dw, dz = end - start
    # Inside the frustum a + t b >= 0.
    planes = [(w + z, dw + dz), (x, dx), (y, dy), (size * w - x, size * dw - dx)]
    planes += [(w - z, dw - dz), (size * w - y, size * dw - dy)]
    crossings = [(-a / np.where(b == 0, 1, b), b) for a, b in planes]
    low = np.max([np.where(b > 0, t, -1) for t, b in crossings], axis=0)
    high = np.min([np.where(b < 0, t, 2) for t, b in crossings], axis=0)
    seen = np.asarray(found.parts) > 0
    assert np.sum(seen) > 100
    at = [start + np.clip(t, 0, 1) * (end - start) for t in (low, high)]
    wanted = np.stack([p[:2] / p[2] for p in at])
    np.testing.assert_allclose(found.ends[..., seen], wanted[..., seen], atol=1e-3)


def test_pleats_finer_than_pixels_show_a_mean_of_colours():
    """Whatever the edges of their folds have in common, no colour counts less than nothing."""
    size, pleats = 6, 150
    first = np.arange(pleats)
    x = np.stack([first, first + 1.2], axis=1).ravel() * (2.6 / pleats) - 1.3
    z = np.tile([0.0, 0.02], pleats)
    rows = [np.stack([x, np.full_like(x, y), z, np.ones_like(x)], axis=1) for y in (-1.3, 1.3)]
    clip = jnp.asarray(np.concatenate(rows), jnp.float32)
    sides = np.arange(x.size - 1)[:, None]
    lower, upper = np.array([0, 1, x.size]), np.array([1, x.size + 1, x.size])
    faces = np.concatenate([sides + lower, sides + upper])
    face = dr.rasterize(clip, faces, height=size, width=size, border=1).face
    colors = jax.random.uniform(jax.random.key(0), (size + 2, size + 2, 1))
    weights = jax.jit(jax.jacobian(lambda colors: dr.antialias(colors, clip, faces, face)))(colors)
    assert weights.min() > -0.02  # of a sum in steps
    np.testing.assert_allclose(weights.sum(axis=(3, 4, 5)), 1, atol=1e-5)


def test_no_piece_is_lost_however_few_records_there_are(monkeypatch):
    """Wherever they end, among edges or lines where bodies pierce each other."""
    sizes = AtOnce(edges=64, cut=1024, pieces=512, few=32, parts=16)
    monkeypatch.setattr("diffrast.edges.survey.usual_batches", lambda *_: sizes)
    monkeypatch.setattr("diffrast.edges.collect.PIXELS_AT_ONCE", 16)
    turned = dr.mesh.transform(MESH, dr.linalg.rotation((1.0, 0.2, 0.0), 1.2))
    mesh = dr.mesh.merge([MESH, turned])
    color = jnp.asarray(np.random.default_rng(3).uniform(size=(len(mesh.faces) + 1, 3)))
    view = view_of(mesh, camera(), color.astype(jnp.float32), apart=True)
    clip, face = view.positions_clip, view.face_image

    @functools.partial(jax.jit, static_argnums=0)
    def results(capacity):
        method = Method(None, None, False, capacity)
        found = view._replace(survey=survey(view, method))
        records, sums = collect(found, method)

        def change(points, colors):
            return apply_linear(found, method, records, sums.left, points, (colors, colors))

        points = jnp.ones((len(clip), 3)) * 0.1
        colors = jnp.ones((face.size, 3)) * jnp.arange(3.0)
        pushed, pull = jax.vjp(change, points, colors)
        return (
            records.total,
            sums.added,
            pushed,
            pull(jnp.sin(jnp.arange(pushed.size)).reshape(pushed.shape)),
        )

    many = results(4096)
    for capacity in (100, 390):  # less than a batch finds, and more; the last end among the lines
        few = results(capacity)
        assert 2 * capacity < many[0] == few[0]
        for a, b in zip(jax.tree.leaves(many[1:]), jax.tree.leaves(few[1:]), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("many_views", [False, True])
def test_few_pieces_are_looked_at_in_parts(many_views, monkeypatch):
    """Which follow each other to the bit, as pieces have to that add up to an outline's area."""
    monkeypatch.setattr("diffrast.edges.pieces.views_fill_lanes", lambda: many_views)
    ranges = np.float32([[0.1, 0.25, 0.7], [0.2, 0.6, 0.75]])
    at_once = usual_batches(100, 100)
    assert at_once.few * at_once.parts <= at_once.pieces
    number = jnp.arange(at_once.pieces + at_once.cut)
    places = jnp.minimum(number, 2)
    pieces = Pieces(places, jnp.stack([number, number]), jnp.asarray(ranges)[:, places], number < 0)
    few = first_ones(Waiting(pieces, jnp.int32(3)), at_once)
    count = int(few.exists.sum())
    begin, end = np.asarray(few.range)[:, :count].reshape(2, 3, -1)
    assert begin.shape[1] > 1
    assert np.all(begin < end)
    assert np.array_equal(begin[:, 1:], end[:, :-1])
    assert np.array_equal([begin[:, 0], end[:, -1]], ranges)
    assert np.array_equal(few.segment[:count], np.repeat(np.arange(3), begin.shape[1]))
    many = first_ones(Waiting(pieces, number[-1]), at_once)
    assert np.array_equal(many.range, pieces.range[:, : at_once.pieces])


def test_topology_is_the_same_whether_traced_or_not():
    for mesh in (MESH, dr.shapes.cube(), dr.shapes.icosphere(1)):
        host = topology_of(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        traced = jax.jit(traced_topology)(mesh.vertices, mesh.faces)
        assert np.array_equal(host.neighbors, traced.neighbors)
        assert np.array_equal(host.patches, traced.patches)
        used = np.asarray(traced.edges.faces[:, 0]) >= 0

        def rows(edges, used):
            pairs = np.sort(np.asarray(edges.faces)[used], axis=1)
            return sorted(map(tuple, np.column_stack([pairs, np.asarray(edges.seam)[used]])))

        assert rows(host.edges, slice(None)) == rows(traced.edges, used)
    assert np.all(np.asarray(dr.shapes.cube().topology.neighbors) >= 0)


def test_faces_with_vertices_of_their_own_are_one_surface_where_these_are_alike():
    def surfaces(mesh):
        return len(np.unique(mesh.topology.patches))

    cube, ball = dr.shapes.cube(), dr.shapes.icosphere(1)
    split = dr.mesh.flat_shaded(ball)
    bare = dr.Mesh(vertices=cube.vertices, faces=cube.faces)  # with its faces' normals
    uvs = np.stack([np.arange(len(cube.vertices)), np.zeros(len(cube.vertices))], axis=1)
    assert (surfaces(cube), surfaces(bare)) == (6, 6)
    assert surfaces(dataclasses.replace(cube, uvs=uvs, topology=None)) == 12
    assert surfaces(dr.mesh.with_normals(cube)) == 1
    assert (surfaces(ball), surfaces(split), surfaces(dr.mesh.with_normals(split))) == (1, 80, 1)


def test_topology_of_other_faces_is_refused():
    with pytest.raises(ValueError, match="topology"):
        dataclasses.replace(MESH, faces=MESH.faces[:-1])


def test_edges_cost_nothing_where_they_are_off():
    scene = dr.Scene(objects=[dr.Object(MESH)], lights=LIGHTS)
    off = dataclasses.replace(SETTINGS, antialias=False)
    text = dr.render.lower(scene, camera(), off).as_text(debug_info=True)
    assert "/edges/" not in text
    assert "/edges/" in dr.render.lower(scene, camera(), SETTINGS).as_text(debug_info=True)


# The stage alone ----------------------------------------------------------------------------------


def test_behind_an_edge_is_the_background_of_its_own_pixel():
    """A pixel of which a body covers the share a is a color + (1 - a) background, if that is a
    picture, too; a is that of a white body before black.
    """
    rng = np.random.default_rng(0)
    color, backgrounds = jnp.array([0.9, 0.1, 0.5]), jnp.asarray(rng.random((2, 16, 16, 3)))
    options = dr.RenderSettings(height=16, width=16, shading="unlit")
    body = dr.shapes.plane(2.0, 2.0), dr.linalg.rotation_z(0.3)

    def picture(shift, color, background, options=options):
        mesh, turn = body
        material, place = dr.Material(diffuse=color), dr.linalg.translation(shift) @ turn
        scene = dr.Scene(objects=[dr.Object(mesh, material, place)], background=background)
        view = dr.Camera.perspective(eye=(0, 0, 4), target=(0, 0, 0), fov_y=0.9, near=1, far=9)
        return dr.render(scene, view, options)

    def share(shift):
        return picture(shift, jnp.ones(3), jnp.zeros(3))

    def want(shift, color, background):
        covered = share(shift)
        return covered * color + (1 - covered) * background

    at = jnp.array([0.1, 0.05, 0.0]), color, backgrounds[0]
    change = jnp.array([0.5, -0.3, 0.2]), jnp.array([-0.4, 0.2, 0.6]), backgrounds[1]
    got, d_got = jax.jit(lambda at, way: jax.jvp(picture, at, way))(at, change)
    expected, d_expected = jax.jit(lambda at, way: jax.jvp(want, at, way))(at, change)
    np.testing.assert_allclose(got, expected, atol=2e-6)
    np.testing.assert_allclose(d_got, d_expected, atol=2e-5)
    samples = dataclasses.replace(options, samples=1024, antialias=False)
    np.testing.assert_allclose(got, picture(*at, options=samples), atol=2e-3)

    weights = jnp.asarray(rng.normal(size=got.shape), got.dtype)
    back = jax.jit(jax.grad(lambda at: jnp.vdot(weights, picture(*at))))(at)
    together = sum(jnp.vdot(*pair) for pair in zip(back, change, strict=True))
    np.testing.assert_allclose(together, jnp.vdot(weights, d_got), rtol=1e-4)


COLORS = 0.5 + 0.5 * jnp.sin(2 * MESH.vertices)  # of the vertices; the background is white


def test_both_directions_of_the_derivative_agree(seen):
    clip, face = seen
    random = np.random.default_rng(1)

    def noise(*shape):
        return jnp.asarray(random.normal(size=shape), jnp.float32)

    def stage(image, clip):
        return dr.antialias(image, clip, MESH.faces, face, topology=MESH.topology, creases="all")

    @jax.jit
    def pushed(at, change):
        return jax.jvp(stage, at, change)[1]

    @jax.jit
    def pulled(at, cotangent):
        return jax.vjp(stage, *at)[1](cotangent)

    at, change = ((noise(*face.shape, 3), x) for x in (clip, noise(*clip.shape)))
    cotangent = noise(20, 24, 3)
    moved = pushed(at, change)

    def reverse():
        return sum(map(np.vdot, pulled(at, cotangent), change))

    first = reverse()
    assert abs(np.vdot(moved, cotangent) - first) < 1e-4 * (
        np.linalg.norm(moved) * np.linalg.norm(cotangent)
    )
    assert first == reverse() == reverse()


def own_picture(vertices, height, width, **options):
    clip = dr.world_to_clip(camera(), vertices)
    size = {"height": height, "width": width}
    fragments = dr.rasterize(clip, MESH.faces, border=1 if options else 0, **size)
    image = dr.interpolate(COLORS, MESH.faces, fragments)
    image = jnp.where(fragments.face[..., None] >= 0, image, 1.0)
    if not options:
        return image
    return dr.antialias(image, clip, MESH.faces, fragments.face, background=1.0, **options)


def colors_at(colors, face, barycentrics):
    return jnp.einsum("njc,nj->nc", colors[MESH.faces[face]], barycentrics)


SHIFT = jnp.array([1.0, 0.3, 0.0])
FINE = 16


@jax.jit
def sampled(s):
    fine = own_picture(MESH.vertices + s * SHIFT, 40 * FINE, 48 * FINE)
    return fine.reshape(40, FINE, 48, FINE, 3).mean(axis=(1, 3))


@pytest.mark.parametrize(
    ("options", "image_error", "derivative_error"),
    [
        ({"shader": colors_at, "data": COLORS, "topology": MESH.topology}, 0.0015, 0.03),
        ({"topology": None}, 0.005, 0.1),
    ],
)
def test_a_picture_of_ones_own_gets_its_edges(options, image_error, derivative_error):
    """Against many samples a pixel, and the derivative against differences of these."""
    step = 0.02
    weights = jnp.sin(jnp.arange(40.0)[:, None, None] / 10 + jnp.arange(48.0)[:, None] / 14)

    @jax.jit
    def with_edges(s):
        return jax.jvp(
            lambda s: own_picture(MESH.vertices + s * SHIFT, 40, 48, **options), (s,), (1.0,)
        )

    image, change = with_edges(0.0)
    assert jnp.mean(jnp.abs(image - sampled(0.0))) < image_error
    truth = jnp.sum(weights * (sampled(step) - sampled(-step))) / (2 * step)
    assert abs(jnp.sum(weights * change) - truth) < derivative_error * abs(truth)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": jnp.zeros((5, 6))}, "image: wanted shape"),
        (
            {"image": jnp.zeros((2, 6, 3)), "face": jnp.zeros((2, 6), int)},
            "image: wanted a channel",
        ),
        ({"face": jnp.zeros((5, 5), int)}, "face: wanted shape"),
        ({"face": jnp.full((5, 6), 99999)}, "face: wanted indices"),
        ({"background": (1.0, 2.0)}, "background: wanted"),
        ({"topology": dr.shapes.cube().topology}, "topology: wanted that of"),
        ({"creases": "some"}, "creases: wanted one of"),
        ({"shader": lambda data, face, _: 1.0}, r"shader: wanted shape \(\d+, 3\), got \(\)"),
        ({"shader": lambda data, face, _: face}, r"shader: wanted shape \(\d+, 3\)"),
        ({"shader": lambda data, face, _: None}, "shader: wanted an array of numbers"),
    ],
)
def test_bad_arguments_of_the_stage_are_named(change, message):
    arguments = {
        "image": jnp.zeros((5, 6, 3)),
        "positions_clip": jnp.ones((len(MESH.vertices), 4)),
        "faces": MESH.faces,
        "face": jnp.zeros((5, 6), int),
    }
    with pytest.raises(ValueError, match=message):
        dr.antialias(**(arguments | change))


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4, 2.0, 4.4])
@pytest.mark.parametrize("depth", [-0.3, 0.0, 0.2, 0.45])
def test_depths_at_which_a_rim_takes_the_colour_that_it_carries_along(angle, depth):
    """Of a colour that grows with the depth the pixel then loses its inner area."""
    inward = np.array([np.cos(angle), np.sin(angle)])
    border, weight = _border(jnp.array([depth]), jnp.asarray(inward)[:, None])
    x, y = np.meshgrid(*[(np.arange(2000) + 0.5) / 2000 - 0.5] * 2)
    inner = x * inward[0] + y * inward[1] + depth > 0
    steps = np.linspace(-1, 1, 20001)
    on_rim = -depth * inward[:, None] + steps * np.array([[-inward[1]], [inward[0]]])
    chord = 2 * np.mean(np.max(np.abs(on_rim), axis=0) <= 0.5)
    found = weight * border[0] + (1 - weight) * border[1]
    np.testing.assert_allclose(found * chord, inner.mean(), atol=2e-3)


def cut_edges(size, number):
    """The edges of random triangles, and all pieces of a picture that they are cut into."""
    points = np.random.default_rng(4).uniform((-2, -2, 1), (2, 2, 3), size=(number, 3, 3))
    points[1::2] = points[1::2, :1] + 0.1 * (points[1::2] - points[1::2, :1])  # small ones
    clip = np.concatenate([points, points[..., 2:]], axis=2).reshape(-1, 4)
    clip[:, 2] -= 1
    _, _, segments = clipped_edges(jnp.asarray(clip, jnp.float32), size)

    def pieces_of(segments):
        ends = prefix_sum(segments.places)
        at_once = int(ends[-1]) + 1
        return cut(segments, ends, jnp.int32(0), at_once=at_once, height=size, width=size)

    return segments, pieces_of


def test_runs_that_hold_pieces_are_cut_again():
    """Those alone, into the same pieces, however pieces are noted; edges are of 1 to 90 pieces."""
    segments, pieces_of = cut_edges(90, 40)
    pieces = pieces_of(segments)
    parts, edge = np.asarray(segments.parts), np.asarray(pieces.segment)
    assert parts.max() > 64
    assert 0 < parts[parts > 0].min() < 32
    random = np.random.default_rng(0)
    wanted = np.asarray(pieces.exists) & (random.uniform(size=parts.size) < 0.5)[edge]
    wanted &= random.uniform(size=edge.size) < 0.2
    found = [column[..., np.flatnonzero(wanted)] for column in pieces]
    runs, last = jnp.zeros(parts.size, jnp.uint32), jnp.int32(-1)
    for first in range(0, wanted.sum(), 50):  # and 7 that do not exist
        number = np.arange(first, first + 57)
        noted = Pieces(*(column[..., np.minimum(number, wanted.sum() - 1)] for column in found))
        noted = noted._replace(exists=jnp.asarray(number < min(first + 50, wanted.sum())))
        runs, last = with_runs(runs, last, noted, segments, jnp.arange(parts.size))

    length = np.maximum(np.asarray(segments.run_length), 1)
    order = np.arange(edge.size) - (np.cumsum(parts) - parts)[edge]
    expected = np.zeros(parts.size, np.uint32)
    run = order // length[edge]
    np.bitwise_or.at(expected, edge[wanted], np.uint32(1) << run[wanted].astype(np.uint32))
    np.testing.assert_array_equal(runs, expected)

    again = pieces_of(segments._replace(runs=runs))
    assert again.exists.size < 0.6 * edge.size
    in_runs = np.asarray(pieces.exists) & ((expected[edge] >> run.astype(np.uint32)) % 2 > 0)
    assert in_runs.sum() > wanted.sum()
    for new, old in zip(again[:3], pieces[:3], strict=True):
        np.testing.assert_array_equal(
            np.asarray(new)[..., np.asarray(again.exists)], np.asarray(old)[..., in_runs]
        )


def test_edges_behind_a_face_are_not_cut_again():
    ball = dr.shapes.icosphere(2)
    wall = dr.Mesh(vertices=[[-9, -9, 1.5], [9, -9, 1.5], [0, 9, 1.5]], faces=[[0, 1, 2]])
    mesh = dr.mesh.merge([dr.Mesh(vertices=ball.vertices, faces=ball.faces), wall])
    edges = view_of(mesh, camera(eye=(0.0, 0.0, 3.0)), jnp.zeros((len(mesh.faces) + 1, 3)))
    assert int(edges.face_image.min()) >= len(ball.faces)
    assert not np.any(survey(edges, Method(None, None, False, 0)).runs)
