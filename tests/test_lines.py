"""Lines: their pixels, the area they cover, their depth, and the derivative of all that has one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import check_derivatives

import diffrast as dr
from diffrast import lines as dl
from diffrast.lines.overlap import coverage
from diffrast.lines.pixels import plan, step_at
from diffrast.lines.segments import segments_from_pixels
from diffrast.raster.fixed_point import subpixel_bits

pytestmark = pytest.mark.usefixtures("compiled_quickly")

SIZE = 24  # one size for most pictures, so that few programs are compiled


def plain(points, lines, colors=(1.0, 1.0, 1.0), size=SIZE, **options):
    return np.asarray(
        dr.draw_lines(points, lines, colors, height=size, width=size, antialias=False, **options)
    )


def lit(image):
    """Pixels as (column, row)."""
    return {(int(j), int(i)) for i, j in np.argwhere(np.any(image > 0, axis=-1))}


def area_in_box(polygon, corner):
    """Area of a convex polygon inside a unit square, by clipping, in float64."""
    for axis in range(2):
        for sign, border in ((1, corner[axis]), (-1, corner[axis] + 1)):
            kept = []
            for k in range(len(polygon)):
                here, after = polygon[k - 1], polygon[k]
                d = [sign * (p[axis] - border) for p in (here, after)]
                if (d[0] >= 0) != (d[1] >= 0):
                    kept.append(here + d[0] / (d[0] - d[1]) * (after - here))
                if d[1] >= 0:
                    kept.append(after)
            polygon = kept
    if len(polygon) < 3:
        return 0.0
    x, y = np.array(polygon).T
    return abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def rectangle(start, end, width):
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    along = (end - start) / np.linalg.norm(end - start)
    side = np.array([-along[1], along[0]]) * width / 2
    return [start - side, end - side, end + side, start + side]


# --------------------------------------------------------------------------------------- plain


def midpoint(ends, steps):
    """B's incremental midpoint algorithm, all segments at a time; other octants by symmetry.

    Yields column and row of every segment's pixel at each step, and which segments have one.
    """
    x0, y0, x1, y1 = ends.T * np.array([[1], [-1], [1], [-1]])  # y up
    steep = abs(y1 - y0) > abs(x1 - x0)
    x0, y0, x1, y1 = (np.where(steep, a, b) for a, b in ((y0, x0), (x0, y0), (y1, x1), (x1, y1)))
    swap = x0 > x1
    x0, y0, x1, y1 = (np.where(swap, a, b) for a, b in ((x1, x0), (y1, y0), (x0, x1), (y0, y1)))
    dx, dy, up = x1 - x0, abs(y1 - y0), np.where(y1 < y0, -1, 1)
    y, d = y0, dx - 2 * dy  # twice the decision variable f(x0 + 1, y0 + 1/2)
    for k in range(steps):
        x = x0 + k
        yield k <= dx, np.where(steep, y, x), -np.where(steep, x, y)
        y = y + np.where(d < 0, up, 0)
        d = d + np.where(d < 0, 2 * (dx - dy), -2 * dy)


def test_a_million_integer_segments_equal_the_midpoint_algorithm():
    count, size = 1_000_000, 24
    ends = np.random.default_rng(0).integers(0, size, (count, 4)).astype(np.int32)
    points = (ends.reshape(-1, 2) + 0.5).astype(np.float32)
    pairs = jnp.arange(2 * count).reshape(-1, 2)
    segments = segments_from_pixels(jnp.asarray(points), pairs, height=size, width=size)
    course = plan(segments, height=size, width=size)
    sides = np.abs(ends[:, 2:] - ends[:, :2])
    np.testing.assert_array_equal(course.steps, sides.max(axis=1) + 1)
    at = jax.jit(lambda k: step_at(course, jnp.arange(count), k, subpixel_bits(size, size)))
    for k, (exists, column, row) in enumerate(midpoint(ends, size)):
        step = at(k)
        np.testing.assert_array_equal(np.asarray(step.column)[exists], column[exists])
        np.testing.assert_array_equal(np.asarray(step.row)[exists], row[exists])


def test_drawn_pixels_are_those_of_the_midpoint_algorithm():
    ends = np.random.default_rng(1).integers(0, SIZE, (6, 4))
    image = plain((ends.reshape(-1, 2) + 0.5), np.arange(12).reshape(-1, 2))
    want = {(int(x[i]), int(y[i])) for on, x, y in midpoint(ends, SIZE) for i in np.flatnonzero(on)}
    assert lit(image) == want


def test_upright_level_and_single_points_have_their_pixels():
    points = [[2.5, 3.5], [2.5, 9.5], [12.2, 4.9], [5.1, 4.1], [17.3, 20.8], [17.3, 20.8]]
    image = plain(points, [[0, 1], [2, 3], [4, 5]])
    want = {(2, i) for i in range(3, 10)} | {(j, 4) for j in range(5, 13)} | {(17, 20)}
    assert lit(image) == want


def test_real_end_points_give_one_connected_pixel_a_step():
    rng = np.random.default_rng(2)
    for points in rng.uniform(0, SIZE, (30, 2, 2)):
        pixels = np.array(sorted(lit(plain(points, [[0, 1]]))))
        sides = np.abs(np.floor(points[1]) - np.floor(points[0]))
        longer = int(abs(points[1, 1] - points[0, 1]) > abs(points[1, 0] - points[0, 0]))
        assert len(pixels) == sides[longer] + 1 == len(np.unique(pixels[:, longer]))
        order = pixels[np.argsort(pixels[:, longer])]
        assert np.abs(np.diff(order, axis=0)).max(initial=0) <= 1
        # No pixel's centre is farther than half a pixel from the line, but at its ends.
        slope = (points[1] - points[0])[1 - longer] / (points[1] - points[0])[longer]
        middle = order[1:-1] + 0.5
        passed = points[0, 1 - longer] + slope * (middle[:, longer] - points[0, longer])
        assert np.abs(passed - middle[:, 1 - longer]).max(initial=0) <= 0.5 + 1e-3
        np.testing.assert_array_equal(plain(points, [[0, 1]]), plain(points, [[1, 0]]))


def test_lines_beyond_the_image_show_what_is_in_it():
    near = plain([[-40.0, -17.4], [60.0, 42.6]], [[0, 1]])
    far = plain([[-40e3, -24e3 + 6.6], [60e3, 36e3 + 6.6]], [[0, 1]])
    assert lit(near) == lit(far)
    assert len(lit(near)) == SIZE
    outside = [[-5.0, -1.0], [50.0, -1.0], [30.0, -9.0], [30.0, 90.0], [-1e30, 3.0], [-1e30, 9.0]]
    assert not lit(plain(outside, [[0, 1], [2, 3], [4, 5]]))


@pytest.mark.parametrize("size", [8192, 8193, 16384])
def test_lines_reach_the_borders_of_the_widest_pictures(size):
    for ends in ([[-9000.0, 1.5], [20000.0, 1.5]], [[20.0, 1.5], [-3.0, 1.5]]):
        image = dr.draw_lines(ends, [[0, 1]], height=4, width=size, antialias=False)
        row, column = np.ogrid[:4, :size]
        np.testing.assert_array_equal(
            np.any(np.asarray(image) > 0, axis=-1), (row == 1) & (column <= max(ends)[0])
        )


def test_the_last_line_drawn_is_on_top_and_none_is_lost():
    count = 50_000  # more than are worked off at a time, all through the same pixels
    points = np.tile([[0.5, 5.5], [23.5, 5.5]], (count, 1))
    colors = np.zeros((count, 3))
    colors[:, 0] = np.arange(1, count + 1) / count
    image = plain(points, np.arange(2 * count).reshape(-1, 2), colors)
    np.testing.assert_array_equal(image[5, :, 0], 1)
    empty = plain(np.zeros((1, 2)), np.zeros((0, 2), int), background=(0.25, 0.5, 1.0))
    np.testing.assert_array_equal(empty, np.broadcast_to([0.25, 0.5, 1], (SIZE, SIZE, 3)))


# ------------------------------------------------------------------------------------- coverage


@pytest.mark.parametrize("width", [0.2, 1.0, 3.5])
def test_coverage_is_the_exact_area_anywhere_in_a_large_image(width):
    rng = np.random.default_rng(3)
    count = 1000
    start, end = rng.uniform(0, 2000, (2, count, 2)).astype(np.float32)
    start[::5] *= 1e-3
    end[::7, 0] = start[::7, 0]
    end[::11] = start[::11] + rng.normal(size=end[::11].shape)
    end[3::11] = np.round(end[3::11])
    on_line = start + rng.uniform(-0.05, 1.05, (count, 1)) * (end - start)
    corner = np.floor(on_line + width * rng.normal(size=(count, 2)))
    got = jax.jit(coverage, static_argnums=3)(start, end, (corner + 0.5).astype(np.float32), width)
    pairs = zip(start, end, corner, strict=True)
    want = [area_in_box(rectangle(a, b, width), c) for a, b, c in pairs]
    assert 0.2 < np.mean(np.array(want) > 0) < 1
    np.testing.assert_allclose(got, want, atol=1e-6)


def test_anti_aliased_lines_cover_all_their_pixels_by_their_area():
    rng = np.random.default_rng(4)
    points = rng.uniform(-6, SIZE + 6, (10, 2)).astype(np.float32)
    points[1] = points[0] + 1e-3
    for k in range(5):
        image = dr.draw_lines(points, [[2 * k, 2 * k + 1]], height=SIZE, width=SIZE)
        polygon = rectangle(points[2 * k], points[2 * k + 1], 1.0)
        want = [[area_in_box(polygon, (j, i)) for j in range(SIZE)] for i in range(SIZE)]
        np.testing.assert_allclose(image[..., 0], want, atol=1e-6)


def test_a_line_cut_in_pieces_is_the_same_line():
    ends = np.array([[2.3, 3.1], [20.9, 11.7]])
    cuts = np.sort(np.append(np.random.default_rng(5).uniform(0, 1, 40_000), [0, 1]))
    points = ends[0] + cuts[:, None] * (ends[1] - ends[0])
    pieces = np.stack([np.arange(40_001), np.arange(1, 40_002)], axis=1)
    whole = dr.draw_lines(ends, [[0, 1]], height=SIZE, width=SIZE)
    joined = dr.draw_lines(points, pieces, height=SIZE, width=SIZE)
    np.testing.assert_allclose(joined, whole, atol=2e-3)  # float32 adds up 10,000 areas a pixel


def test_colors_mix_by_area_over_the_background():
    points = np.array([[0.0, 5.25], [24.0, 5.25], [0.0, 5.75], [24.0, 5.75]])
    colors = np.array([[1.0, 0, 0], [0, 1.0, 0]])
    options = {"height": SIZE, "width": SIZE, "background": (0.2, 0.4, 0.6), "line_width": 0.5}
    image = np.asarray(dr.draw_lines(points, [[0, 1], [2, 3]], colors, **options))
    np.testing.assert_allclose(image[5], np.tile([0.5, 0.5, 0], (SIZE, 1)), atol=1e-6)
    np.testing.assert_allclose(image[4], np.tile([0.2, 0.4, 0.6], (SIZE, 1)), atol=1e-6)
    one = np.asarray(dr.draw_lines(points, [[0, 1]], colors[0], **options))
    np.testing.assert_allclose(one[5], np.tile([0.6, 0.2, 0.3], (SIZE, 1)), atol=1e-6)
    often = dr.draw_lines(points, [[0, 1]] * 5, colors[0], **options)
    np.testing.assert_allclose(often[5], np.tile([1, 0, 0], (SIZE, 1)), atol=1e-6)


def test_drawings_are_differentiable_in_points_and_colors():
    rng = np.random.default_rng(6)
    points = rng.uniform(2, 10, (10, 2))
    points[4] = points[5]  # no line at all
    points[6], points[7] = [2.0, 4.0], [8.0, 4.0]
    points[8], points[9] = [5.0, 3.0], [5.0, 8.0]
    colors = rng.uniform(0, 0.5, (5, 3))
    lines = np.arange(10).reshape(5, 2)

    def picture(points, colors, background):
        return dr.draw_lines(points, lines, colors, height=12, width=12, background=background)

    with jax.enable_x64(True):
        # Level lines between two rows of pixels are no harder than others.
        check_derivatives(
            lambda shift, *rest: picture(points + shift, *rest),
            np.full((10, 2), 0.013) * (np.arange(10) != 4)[:, None] * (np.arange(10) != 5)[:, None],
            colors,
            np.array([0.1, 0.2, 0.3]),
            step=1e-6,
        )


def test_lines_that_meet_borders_of_pixels_have_all_of_their_derivative():
    """The sum of all shares is the length of a line of width one."""

    @jax.jit
    @jax.grad
    def change(points):
        return jnp.sum(dr.draw_lines(points, [[0, 1]], height=12, width=12)[..., 0])

    with jax.enable_x64(True):
        for start, end in (
            ((1, 1), (9, 9)),
            ((1, 2), (10, 11)),
            ((1, 2.5), (10, 2.5)),  # covers pixels of one row, and all of each
            ((1, 2), (10, 2)),
            ((2.5, 10), (2.5, 3)),
            ((1.4, 1.7), (4.4, 5.7)),  # a corner of the rectangle where four pixels meet
        ):
            points = np.array([start, end], np.float64)
            way = np.subtract(*points) / np.linalg.norm(np.subtract(*points))
            np.testing.assert_allclose(change(points), [way, -way], atol=1e-9)


def test_second_derivatives_take_the_first_one_of_the_picture():
    """Where a loss is least they are its square; that of the lines themselves is left out."""
    points, way = jnp.array([[3.0, 4.0], [20.0, 13.5]]), jnp.array([[0.5, -1.0], [0.3, 0.7]])

    def picture(points):
        return dr.draw_lines(points, np.array([[0, 1]]), height=16, width=24)

    target, change = jax.jvp(picture, (points,), (way,))

    def loss(points):
        return jnp.sum((picture(points) - target) ** 2) / 2

    bend = jax.jvp(jax.grad(loss), (points,), (way,))[1]
    np.testing.assert_allclose(jnp.vdot(bend, way), jnp.vdot(change, change), rtol=1e-5)


def test_second_derivatives_are_the_same_where_only_the_points_have_one():
    def loss(t):
        points = jnp.array([[3.0, 4.0], [20.0, 13.5]]) + jnp.sin(t)
        lines, colors = np.array([[0, 1]]), t * jnp.ones((1, 3))
        return jnp.sum(dr.draw_lines(points, lines, colors, height=16, width=24) ** 2)

    def slope(t):
        return jax.jvp(loss, (t,), (1.0,))[1]

    t = jnp.float32(0.4)
    bend = jax.jvp(jax.grad(loss), (t,), (1.0,))[1]
    np.testing.assert_allclose(jax.jvp(slope, (t,), (1.0,))[1], bend, rtol=1e-5)
    np.testing.assert_allclose(jax.grad(slope)(t), bend, rtol=1e-5)


def test_level_and_upright_lines_have_derivatives():
    # A pixel half covered changes by the length of the line in it, one at an end by the width.
    start, end = (jnp.array([p]) for p in ([2.5, 5.0], [8.5, 5.0]))

    def shares(start, end, swap):
        centres = jnp.array([[6.5, 4.5], [6.5, 5.5], [8.5, 4.5]])
        turn = [1, 0] if swap else [0, 1]
        ends = (jnp.tile(p[:, jnp.array(turn)], (3, 1)) for p in (start, end))
        return coverage(*ends, centres[:, jnp.array(turn)], 1.0)

    along = (6.5 - 2.5) / 6
    for swap in (False, True):
        np.testing.assert_allclose(shares(start, end, swap), [0.5, 0.5, 0.25], atol=1e-6)
        slopes = np.stack(jax.jacrev(shares, (0, 1))(start, end, swap), axis=1)[:, :, 0]
        np.testing.assert_allclose(slopes[0] + slopes[1], 0, atol=1e-5)
        np.testing.assert_allclose(slopes[:2, :, 0], 0, atol=1e-5)
        np.testing.assert_allclose(slopes[1, :, 1], [1 - along, along], atol=1e-5)
        np.testing.assert_allclose(slopes[2, 1, 0], 0.5, atol=1e-5)


# ---------------------------------------------------------------------------------------- depth

SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def cameras():
    options = {"eye": (0.7, 0.4, 5.0), "target": (0, 0, 0), "near": 0.5, "far": 50.0}
    return {
        "perspective": dr.Camera.perspective(**options, fov_y=0.6),
        "parallel": dr.Camera.orthographic(**options, height=3.0),
    }


@pytest.mark.parametrize("kind", ["perspective", "parallel"])
def test_lines_respect_the_depth_of_triangles(kind):
    points = np.array(
        [[-1.4, 0.2, 1], [1.4, 0.2, 1], [-1.4, 0, -1], [1.4, 0, -1], [0.3, 0.6, 2], [0.3, 0.6, -2]]
    )
    positions = dr.world_to_clip(cameras()[kind], np.concatenate([SQUARE, points]))
    lines = np.array([[4, 5], [6, 7], [8, 9], [0, 1], [1, 2], [2, 3], [3, 0], [0, 2]])
    size = {"height": 48, "width": 48}
    solid = dr.rasterize(positions, FACES, **size)
    found = dr.rasterize_lines(positions, lines, **size, faces=FACES, fragments=solid)
    nothing = dataclasses.replace(solid, face=jnp.full_like(solid.face, -1))
    alone = dr.rasterize_lines(positions, lines, **size, faces=FACES, fragments=nothing)
    line, covered = np.asarray(found.line), np.asarray(solid.face) >= 0
    counts = [np.bincount(np.asarray(f.line).ravel() + 1, minlength=9)[1:] for f in (found, alone)]
    assert counts[0][0] == counts[1][0]  # before
    assert not np.any(covered & (line == 1))  # behind, and still seen beside the square
    assert 0 < counts[0][1] < counts[1][1]
    piercing = alone.line == 2
    seen = np.mean((line == 2)[piercing])
    assert 0.2 < seen < 0.8
    for own in range(3, 8):  # on it: nothing is lost
        assert counts[0][own] == counts[1][own], own
    # What is seen of the piercing line is what lies before the square.
    depth = np.asarray(found.position)[line == 2] * -4 + 2
    assert depth.min() > -0.15


def test_nearest_line_wins_and_its_depth_is_that_of_the_line():
    camera = cameras()["perspective"]
    points = np.array([[-1.0, -0.4, -1], [1, 0.5, 1.5], [-1, 1, 1.0], [1.1, -1, -2]])
    positions = dr.world_to_clip(camera, points)
    lines = np.array([[0, 1], [2, 3]])
    both, *single = (
        dr.rasterize_lines(positions, part, height=48, width=48)
        for part in (lines, lines[:1], lines[1:])
    )
    depths = np.stack([np.asarray(f.inverse_depth) for f in single])
    np.testing.assert_array_equal(both.inverse_depth, depths.max(axis=0))
    np.testing.assert_array_equal(
        both.line, np.where(depths.max(axis=0) > 0, depths.argmax(axis=0), -1)
    )
    t = np.asarray(single[0].position)[single[0].line == 0]
    w = 1 / depths[0][single[0].line == 0]
    clip = np.asarray(positions)
    np.testing.assert_allclose(w, clip[0, 3] + t * (clip[1, 3] - clip[0, 3]), rtol=1e-5)
    assert t.min() < 0.03
    assert t.max() > 0.97
    # With perspective the middle of the picture of a line is not the line's middle.
    column = (single[0].line == 0).argmax(axis=0)
    at = np.flatnonzero((single[0].line == 0).any(axis=0))
    x = (at + 0.5) / 24 - 1
    point = points[0] + np.asarray(single[0].position)[column[at], at][1:-1, None] * (
        points[1] - points[0]
    )
    seen = np.asarray(dr.world_to_clip(camera, point))
    np.testing.assert_allclose(seen[:, 0] / seen[:, 3], x[1:-1], atol=1e-4)


def test_lines_through_the_eye_plane_are_cut_not_lost():
    camera = dr.Camera.perspective(eye=(0, 0, 0), direction=(0, 0, -1), fov_y=1.5, near=0.1, far=20)
    points = np.array(
        [[0.5, -0.5, -4.0], [0.5, -0.5, 3.0], [-9, 0.3, -2], [9, 0.3, -2], [0, 0, 5], [1, 0, 9]]
    )
    positions = dr.world_to_clip(camera, points)
    lines = np.array([[0, 1], [2, 3], [4, 5]])

    def picture(positions):
        return dr.draw_lines_with_depth(positions, lines, height=SIZE, width=SIZE)

    image, slope = jax.value_and_grad(lambda p: jnp.sum(picture(p) ** 2))(positions)
    assert np.isfinite(slope).all()
    assert image > 20
    found = np.asarray(dr.rasterize_lines(positions, lines, height=SIZE, width=SIZE).line)
    assert set(np.unique(found)) == {-1, 0, 1}
    assert (found == 1).sum() == SIZE
    assert (found[-1] == 0).any()  # down to the image's border, as it comes closer


def test_a_wireframe_leaves_out_what_is_hidden():
    cube = dr.shapes.cube(flat=False)
    assert dl.mesh_edges(cube).shape == (12, 2)
    assert dl.mesh_edges(dr.shapes.cube()).shape == (12, 2)
    assert dl.mesh_edges(cube, flat=True).shape == (18, 2)
    scene = dr.Scene(objects=[dr.Object(cube, dr.Material(diffuse=(1, 0.5, 0.25)))])
    options = {"target": (0, 0, 0), "fov_y": 0.8, "near": 1, "far": 20}
    camera = dr.Camera.perspective(eye=(3.0, 2.5, 4.0), **options)
    image = np.asarray(dr.wireframe(scene, camera, height=48, width=48))
    clip = dr.world_to_clip(camera, cube.vertices)
    corners = np.asarray(dr.camera.clip_to_pixel(clip, height=48, width=48))[:, :2]
    hidden = int(np.argmin(np.asarray(cube.vertices) @ [3.0, 2.5, 4.0]))
    seen = [edge for edge in dl.mesh_edges(cube) if hidden not in edge]
    length = sum(np.linalg.norm(corners[a] - corners[b]) for a, b in seen)
    assert len(seen) == 9
    np.testing.assert_allclose(image[..., 0].sum(), length, rtol=0.02)
    np.testing.assert_allclose(image, image[..., :1] * [1, 0.5, 0.25], atol=1e-6)


def test_a_sliver_in_a_crease_hides_none_of_it():
    corners = np.array([[0, 0, 0], [2, 0, 0], [1, 0, 0], [1, 2, 0], [1, 0, 2], [0.5, 0, 0]])
    slivers = [[1, 0, 2], [2, 0, 5]]
    faces = [[0, 1, 3], *slivers, [0, 4, 5], [5, 4, 2], [2, 4, 1]]
    bent = dr.Mesh(vertices=corners * 0.3 + 0.7, faces=faces)
    found = {tuple(sorted(edge)) for edge in dl.mesh_edges(bent).tolist()}
    assert {(0, 5), (2, 5), (1, 2)} <= found
    assert not {(0, 1), (0, 2)} & found
    corners[4] = [1, -2, 0]  # in one plane there is no crease
    level = dl.mesh_edges(dr.Mesh(vertices=corners, faces=faces))
    found = {tuple(sorted(edge)) for edge in level.tolist()}
    assert found == {(0, 3), (1, 3), (0, 4), (1, 4)}


def test_faces_of_a_mirrored_object_hide_what_they_hid():
    camera = dr.Camera.perspective(eye=(3, 2.5, 4), target=(0, 0, 0), fov_y=0.8, near=1, far=20)

    def image(transform):
        scene = dr.Scene(objects=[dr.Object(dr.shapes.cube(), transform=transform)])
        return dr.wireframe(scene, camera, height=24, width=24, cull_backfaces=True)

    mirrored = np.diag([-1.0, 1, 1, 1])  # the same cube
    np.testing.assert_allclose(image(mirrored), image(np.eye(4)), atol=1e-5)


def test_wireframes_of_known_meshes_are_drawn_inside_of_transformations():
    scene = dr.Scene(objects=[dr.Object(dr.shapes.cube())])

    def image(eye):
        camera = dr.Camera.perspective(eye=eye, target=(0, 0, 0), fov_y=1.0, near=1.0, far=9.0)
        return dr.wireframe(scene, camera, height=12, width=12)

    eye = jnp.array([1.0, 2, 4])
    single = image(eye)
    np.testing.assert_allclose(jax.jit(image)(eye), single, atol=1e-6)
    np.testing.assert_allclose(jax.lax.map(image, eye[None])[0], single, atol=1e-6)


@pytest.mark.parametrize("far", [1e6, 1e12, 1e30])
def test_either_end_of_a_line_may_be_far_away(far):
    weights = np.arange(8)[:, None, None]

    def total(points, lines):
        image = dr.draw_lines(points, lines, height=8, width=4)
        return jnp.sum(weights * image), image

    points = jnp.array([[2.0, 4.25], [-far, 4.25]])
    slopes, image = jax.grad(total, has_aux=True)(points, [[0, 1]])
    reversed_slopes, reversed_image = jax.grad(total, has_aux=True)(points, [[1, 0]])
    np.testing.assert_allclose(image[4, :3, 0], [0.75, 0.75, 0], atol=1e-6)
    np.testing.assert_allclose(reversed_image, image, atol=1e-6)
    np.testing.assert_allclose(reversed_slopes, slopes, rtol=1e-4, atol=1e-6)


def test_wireframes_of_no_objects_are_checked_too():
    camera = dr.Camera.perspective(eye=(0, 0, 4), target=(0, 0, 0), fov_y=1.0, near=1.0, far=9.0)
    size = {"height": 4, "width": 6}
    picture = np.random.default_rng(0).uniform(size=(4, 6, 3)).astype(np.float32)
    scene = dr.Scene(objects=[], background=picture)
    np.testing.assert_array_equal(dr.wireframe(scene, camera, **size), picture)
    with pytest.raises(ValueError, match="camera: wanted a single camera, got a stack"):
        dr.wireframe(scene, dr.stack_cameras([camera, camera]), **size)
    for wrong in (picture[:1], picture[:, :4]):
        with pytest.raises(ValueError, match=r"background: wanted shape \(3,\) or \(4, 6"):
            dr.wireframe(dr.Scene(objects=[], background=wrong), camera, **size)
    with pytest.raises(ValueError, match="line_width: wanted a number between 0 and inf, got -1"):
        dr.wireframe(scene, camera, **size, line_width=-1.0)


def test_normals_show_in_a_wireframe():
    shown = dl.normal_lines(SQUARE, np.tile([0.0, 0, 1], (4, 1)), 0.5)
    np.testing.assert_array_equal(shown.lines, [[0, 4], [1, 5], [2, 6], [3, 7]])
    np.testing.assert_allclose(shown.points[4:], SQUARE + np.array([0, 0, 0.5]))
    np.testing.assert_array_equal(
        dl.polygon_edges([[0, 1, 2, 3], [2, 1, 4]]),
        [[0, 1], [0, 3], [1, 2], [1, 4], [2, 3], [2, 4]],
    )


# ------------------------------------------------------------------------------------- drawings


def test_the_size_of_a_drawing_follows_its_ranges():
    fitted = dl.fit_points([[10.0, 1.0], [18.0, 3.0], [14.0, 5.0]], size=200)
    assert (fitted.height, fitted.width) == (100, 200)
    np.testing.assert_allclose(fitted.points, [[5, 97.5], [195, 50], [100, 2.5]], atol=1e-4)
    flat = dl.fit_points([[0.0, 7.0], [2.0, 7.0]], size=50, margin=1.0)
    assert (flat.height, flat.width) == (1, 50)
    np.testing.assert_allclose(flat.points, [[0, 0.5], [50, 0.5]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: plain(np.zeros((2, 2)), [[0, 2]]), r"lines: wanted indices in \[0, 2\)"),
        (lambda: plain(np.zeros((2, 3)), [[0, 1]]), r"points: wanted shape \(points, 2\)"),
        (
            lambda: plain(np.zeros((2, 2)), [[0, 1]], np.ones(4)),
            r"colors: wanted shape \(3,\) or \(1, 3\)",
        ),
        (lambda: plain(np.zeros((2, 2)), [[0, 1]], background=1.0), "background: wanted shape"),
        (lambda: plain(np.zeros((2, 2)), [[0, 1]], line_width=0.0), "line_width: wanted a number"),
        (lambda: dl.fit_points(np.ones((3, 2)), size=9), "points: wanted at least two different"),
        (lambda: dl.fit_points(np.eye(2), size=9, margin=1.5), "margin: wanted a share"),
        (
            lambda: dr.rasterize_lines(np.ones((2, 4)), [[0, 1]], height=2, width=2, faces=FACES),
            "fragments: wanted them together with faces",
        ),
        (
            lambda: dr.rasterize_lines(np.ones((2, 4)), np.zeros((0, 2), int), height=2, width=2),
            "lines: wanted at least one",
        ),
    ],
)
def test_lines_refuse(call, message):
    with pytest.raises(ValueError, match=message):
        call()
