"""Textures alone: filters against float64, footprints, mappings, cubes, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import check_derivatives

import diffrast as dr
from diffrast.texture.kinds import FILTERS, WRAPS
from diffrast.texture.pyramid import layout_of, pyramid, rows_of

pytestmark = pytest.mark.usefixtures("compiled_quickly")

RNG = np.random.default_rng(0)
IMAGE = RNG.uniform(size=(37, 53, 3)).astype(np.float32)


# ------------------------------------------------------------------------------------ the oracle


def wrapped(index, size, wrap):
    if wrap == "repeat":
        return index % size
    if wrap == "mirror":
        return np.minimum(index % (2 * size), (-index - 1) % (2 * size))
    return np.clip(index, 0, size - 1)


def texel(image, row, column, wrap):
    """Row counts from the bottom."""
    height, width = image.shape[:2]
    rows = height - 1 - wrapped(row, height, wrap[1])
    return image[rows, wrapped(column, width, wrap[0])]


def bilinear(image, uv, wrap=("repeat", "repeat")):
    image, uv = np.asarray(image, float), np.asarray(uv, float)
    x, y = uv[:, 0] * image.shape[1] - 0.5, uv[:, 1] * image.shape[0] - 0.5
    column, row = (np.floor(at).astype(int) for at in (x, y))
    s, t = (x - column)[:, None], (y - row)[:, None]
    below, above = (
        (1 - s) * texel(image, row + k, column, wrap) + s * texel(image, row + k, column + 1, wrap)
        for k in range(2)
    )
    return (1 - t) * below + t * above


def halved(image):
    """A box filter to half the size, by exact areas of overlap."""
    for axis in (0, 1):
        count = image.shape[axis]
        if count == 1:
            continue
        edges = np.arange(count // 2 + 1) * count / (count // 2)
        texels = np.arange(count)
        overlap = np.minimum(edges[1:, None], texels + 1) - np.maximum(edges[:-1, None], texels)
        weights = np.maximum(overlap, 0) / (count / (count // 2))
        image = np.moveaxis(np.tensordot(weights, image, (1, axis)), 0, axis)
    return image


def levels(image):
    images = [np.asarray(image, float)]
    while images[-1].shape[:2] != (1, 1):
        images.append(halved(images[-1]))
    return images


def trilinear(image, uv, derivatives):
    size = np.array(image.shape[1::-1])[:, None]
    footprint = np.linalg.norm(derivatives * size, axis=1).max(axis=-1)
    images = levels(image)
    level = np.clip(np.log2(footprint), 0, len(images) - 1)
    low = np.floor(level).astype(int)
    colors = np.stack([bilinear(i, uv) for i in images])
    high = np.minimum(low + 1, len(images) - 1)
    point, share = np.arange(len(uv)), (level - low)[:, None]
    return (1 - share) * colors[low, point] + share * colors[high, point]


# ---------------------------------------------------------------------------------------- filters


@pytest.mark.parametrize("wrap", [*WRAPS, ("clamp", "mirror")])
def test_bilinear_and_nearest_equal_the_oracle(wrap):
    uv = RNG.uniform(-2.5, 2.5, size=(5000, 2)).astype(np.float32)
    pair = (wrap, wrap) if isinstance(wrap, str) else wrap
    got = dr.sample_texture(dr.Texture(IMAGE, wrap=wrap), uv)
    np.testing.assert_allclose(got, bilinear(IMAGE, uv, pair), atol=1e-6)
    place = uv.astype(float) * (53, 37)
    clear = np.abs(place - np.rint(place)).min(axis=1) > 1e-4
    column, row = np.floor(place[clear]).astype(int).T
    got = dr.sample_texture(dr.Texture(IMAGE, wrap=wrap, filter="nearest"), uv[clear])
    np.testing.assert_array_equal(got, texel(IMAGE, row, column, pair))


def test_corners_and_centres_of_texels():
    texture = dr.Texture([[[1.0], [2.0]], [[3.0], [4.0]]], wrap="clamp")
    at = {(0.25, 0.75): 1, (0.75, 0.75): 2, (0.25, 0.25): 3, (0.75, 0.25): 4, (0.5, 0.5): 2.5}
    np.testing.assert_array_equal(dr.sample_texture(texture, [*at])[:, 0], [*at.values()])
    np.testing.assert_array_equal(
        dr.sample_texture(texture, [(0.0, 0.0), (1.0, 1.0)])[:, 0], [3, 2]
    )


@pytest.mark.parametrize("size", [(37, 53), (64, 64), (1, 9), (1, 1)])
def test_pyramid_is_a_box_filter_that_keeps_the_mean(size):
    image = RNG.uniform(size=(*size, 2)).astype(np.float32)
    texture = dr.Texture(image, filter="trilinear")
    count = len(levels(image))
    images = jax.jit(pyramid, static_argnums=1)(texture.image, count)
    for got, want in zip(images, levels(image), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-6)
        np.testing.assert_allclose(np.mean(got, axis=(0, 1)), image.mean(axis=(0, 1)), atol=1e-6)
    rows = jax.eval_shape(lambda: rows_of([texture]))
    assert rows.shape[0] <= 4 / 3 * image[..., 0].size or min(size) == 1
    assert layout_of([texture]).levels == (count,)


def test_trilinear_equals_the_oracle():
    uv = RNG.uniform(-1.5, 1.5, size=(3000, 2)).astype(np.float32)
    scale = 2.0 ** RNG.uniform(-9, 3, size=(3000, 1, 1))
    derivatives = (scale * RNG.normal(size=(3000, 2, 2))).astype(np.float32)
    texture = dr.Texture(IMAGE, filter="trilinear")
    got = dr.sample_texture(texture, uv, derivatives=derivatives)
    np.testing.assert_allclose(got, trilinear(IMAGE, uv, derivatives.astype(float)), atol=3e-6)
    np.testing.assert_array_equal(
        dr.sample_texture(texture, uv), dr.sample_texture(dr.Texture(IMAGE), uv)
    )


@pytest.mark.parametrize("step", [1, 2, 8, 37])
def test_a_footprint_of_two_to_the_level(step):
    """A picture of 32 texels whose pixels cover `step` of them: level log2 step, in closed form."""
    image = RNG.uniform(size=(32, 32, 1)).astype(np.float32)
    derivatives = np.float32([[step / 32, 0], [0, 0.1 / 32]])
    got = dr.sample_texture(
        dr.Texture(image, filter="trilinear"), [0.3, 0.6], derivatives=derivatives
    )
    uv, level = np.array([[0.3, 0.6]]), min(np.log2(step), 5)
    low = [bilinear(levels(image)[k], uv)[0] for k in (int(level), min(int(level) + 1, 5))]
    np.testing.assert_allclose(got, low[0] + (level % 1) * (low[1] - low[0]), atol=1e-6)


def test_anisotropy_averages_along_the_longer_side():
    """Of stripes across the longer side it keeps the contrast that one place loses."""
    stripes = np.zeros((64, 64, 1), np.float32)
    stripes[::2] = 1  # rows: they change along v
    derivatives = np.float32([[8 / 64, 0], [0, 0.5 / 64]])
    uv = np.float32([[0.5, (2 * k + 1) / 128] for k in range(8)])
    blurred, sharp = (
        dr.sample_texture(
            dr.Texture(stripes, filter="trilinear", anisotropy=n),
            uv,
            derivatives=np.broadcast_to(derivatives, (8, 2, 2)),
        )[:, 0]
        for n in (1, 8)
    )
    assert np.ptp(blurred) < 0.01
    np.testing.assert_allclose(np.sort(sharp), [0] * 4 + [1] * 4, atol=1e-5)


def straight_floor(scale):
    """Coordinates on a plane one unit below the eye, through a 32² picture up to the horizon."""

    def floor(column, row):
        depth = 1 / ((row + 0.7) / 40)
        return np.stack([column / 40 * depth + 0.13 * depth, depth], axis=-1) * scale

    return floor


def tilted_floor(pitch, turn):
    """The same for an eye that looks down by the angle `pitch`, the floor turned by `turn`."""

    def floor(column, row):
        x, y = column / 40, (row - 16) / 40
        depth = 1 / (np.sin(pitch) + y * np.cos(pitch))
        across, ahead = x * depth, (np.cos(pitch) - y * np.sin(pitch)) * depth
        u = np.cos(turn) * across - np.sin(turn) * ahead
        v = np.sin(turn) * across + np.cos(turn) * ahead
        return 6 * np.stack([u, v], axis=-1)

    return floor


def floor_errors(floor, *ways):
    """Root mean square errors of a checkerboard of 64² texels against 256 samples a pixel."""
    image = np.float32((np.indices((64, 64)) // 32).sum(axis=0)[..., None] % 2)
    at = np.arange(32.0)
    column, row = np.meshgrid(at - 16 + 0.5, at + 0.5)
    h = 1e-5
    steps = [
        (floor(column + h * (1 - k), row + h * k) - floor(column - h * (1 - k), row - h * k))
        / 2
        / h
        for k in range(2)
    ]
    steps = np.stack(steps, axis=-1).astype(np.float32)
    uv = floor(column, row).astype(np.float32)
    fine = (np.arange(512) + 0.5) / 16
    many = bilinear(image, floor(*np.meshgrid(fine - 16, fine)).reshape(-1, 2))
    truth = many.reshape(32, 16, 32, 16).mean(axis=(1, 3))

    def error(options):
        got = dr.sample_texture(dr.Texture(image, **options), uv, derivatives=steps)[..., 0]
        return np.sqrt(np.mean((np.asarray(got) - truth) ** 2))

    return [error(options) for options in ways]


NEAREST, BILINEAR, MIPMAP = ({"filter": name} for name in FILTERS)


def test_mipmaps_of_a_receding_floor_are_near_to_many_samples():
    """A checkerboard up to where its squares are far smaller than pixels."""
    ways = NEAREST, BILINEAR, MIPMAP, {**MIPMAP, "anisotropy": 4}
    nearest, smooth, mipmap, sharp = floor_errors(straight_floor(8), *ways)
    assert mipmap < nearest / 5
    assert mipmap < smooth / 2
    assert sharp < 0.7 * mipmap


@pytest.mark.parametrize(
    "floor",
    [straight_floor(scale) for scale in (1.6, 3.2, 6.15, 16)]
    + [tilted_floor(pitch, turn) for pitch in (0.45, 0.7, 1.0) for turn in (0.0, 0.4)],
)
def test_two_places_along_the_footprint_suffice_for_floors(floor):
    ways = NEAREST, BILINEAR, MIPMAP, {**MIPMAP, "anisotropy": 2}
    nearest, smooth, mipmap, sharp = floor_errors(floor, *ways)
    assert mipmap < nearest / 4
    assert mipmap < smooth / 3.7
    assert sharp < nearest / 6
    assert sharp < smooth / 5


# ------------------------------------------------------------------------------------ derivatives


@pytest.mark.parametrize("anisotropy", [1, 4])
def test_derivatives_in_texels_uv_and_footprint(anisotropy):
    with jax.enable_x64(True):
        image = RNG.uniform(size=(7, 9, 2))
        uv = RNG.uniform(0, 2, size=(40, 2))
        steps = 2.0 ** RNG.uniform(-4, 0, size=(40, 1, 1)) * RNG.normal(size=(40, 2, 2))

        def colors(image, uv, steps):
            texture = dr.Texture(image, filter="trilinear", anisotropy=anisotropy, wrap="mirror")
            return dr.sample_texture(texture, uv, derivatives=steps)

        check_derivatives(colors, image, uv, steps, step=1e-7, rtol=1e-5, atol=1e-5)


def test_derivatives_of_cubes_and_mappings():
    with jax.enable_x64(True):
        images = RNG.uniform(size=(6, 4, 4, 2))
        points, normals = RNG.normal(size=(2, 30, 3))
        steps = 0.2 * RNG.normal(size=(30, 3, 2))

        def colors(images, points, normals, half_size, centre):
            mapping = dr.CubeMapping(half_size=half_size, centre=centre)
            at = dr.map_points(mapping, 0.2 * points, normals)
            cube = dr.CubeTexture(images, filter="trilinear")
            sphere = dr.SphereMapping(centre=centre, kind="longitude")
            uv = dr.map_points(sphere, points)
            plane = dr.PlanarMapping(corner=points[0], across=points[1], up=points[2])
            other = dr.map_points(plane, normals)
            return dr.sample_texture(cube, at, derivatives=steps), uv, other

        arguments = images, points, normals, np.array(1.5), np.array([0.1, 0.2, -0.1])
        check_derivatives(colors, *arguments, step=1e-7, rtol=1e-5, atol=1e-5)


def test_edges_of_a_cube_have_the_derivative_of_the_side_they_are_looked_up_on():
    edges = np.array([[1, 1, 1], [1, -1, 0.2], [-1, 0.3, -1], [0.4, -1, 1]])
    axis = np.argmax(abs(edges), axis=1)[:, None]  # the first of the largest
    inside = np.where(np.arange(3) == axis, 1, 1 - 1e-7) * edges
    with jax.enable_x64(True):
        cube = dr.CubeTexture(np.random.default_rng(1).uniform(size=(6, 4, 4, 1)))
        slopes = jax.vmap(jax.grad(lambda x: dr.sample_texture(cube, x)[0]))
        at, beside = np.split(slopes(np.concatenate([edges, inside])), 2)
        np.testing.assert_allclose(at, beside, atol=1e-5)


def test_transformations():
    texture = dr.Texture(IMAGE[:8, :8], filter="trilinear")
    uv = RNG.uniform(size=(3, 5, 2)).astype(np.float32)
    steps = 0.3 * RNG.normal(size=(3, 5, 2, 2)).astype(np.float32)

    def colors(texture, uv, steps):
        return dr.sample_texture(texture, uv, derivatives=steps)

    want = colors(texture, uv, steps)
    np.testing.assert_allclose(
        jax.jit(jax.vmap(colors, (None, 0, 0)))(texture, uv, steps), want, atol=1e-6
    )
    many = jax.tree.map(lambda x: jnp.stack([x, 2 * x, 3 * x]), texture)
    got = jax.jit(jax.vmap(colors))(many, uv, steps)
    np.testing.assert_allclose(got, np.array([[[1]], [[2]], [[3]]]) * want, atol=1e-6)


STRANGE = {
    "one texel": ((1, 1), 0.3, 0.2),
    "huge coordinates": ((4, 4), 1e30, 1e30),
    "huge footprint": ((4, 4), 0.3, 3e38),
    "infinite": ((4, 4), np.inf, np.inf),
    "not a number": ((4, 4), np.nan, np.nan),
    "no footprint": ((4, 4), 0.25, 0.0),
    "tiny footprint": ((4, 4), -1e-30, 1e-38),
}


@pytest.mark.parametrize("anisotropy", [1, 3])
@pytest.mark.parametrize("case", STRANGE)
def test_finite_with_finite_derivatives(case, anisotropy):
    size, coordinate, step = STRANGE[case]
    image = RNG.uniform(size=(*size, 1)).astype(np.float32)

    def color(image, uv, steps):
        texture = dr.Texture(image, filter="trilinear", anisotropy=anisotropy)
        return dr.sample_texture(texture, uv, derivatives=steps)[0]

    arguments = image, np.full(2, coordinate, np.float32), np.full((2, 2), step, np.float32)
    value, slopes = jax.value_and_grad(color, (0, 1, 2))(*arguments)
    assert 0 <= value <= 1
    assert all(np.isfinite(slope).all() for slope in slopes[:2])
    if np.isfinite(step):
        assert np.isfinite(slopes[2]).all()
    directions = np.full(3, coordinate, np.float32), np.full((3, 2), step, np.float32)
    cube = dr.CubeTexture(np.ones((6, *size, 1)), filter="trilinear")
    np.testing.assert_allclose(dr.sample_texture(cube, directions[0], derivatives=directions[1]), 1)


# ------------------------------------------------------------------------------------ the footprint


def test_screen_derivatives_are_those_of_a_projective_map():
    """(u w, v w, w) is linear in the pixel: of a face that reaches behind the viewer, tiny ones."""
    height, width = 12, 16
    rng = np.random.default_rng(1)
    near = [[-9, -3, 1, 4], [7, -2, 1, 3], [1, 30, 1, -5]]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    tiny = [[0.1 + 1e-4 * a, 0.2 + 1e-4 * b, 0.5, 1] for a, b in rng.normal(size=(3, 2))]
    for clip, size in ((near, 1.0), (near, 1e-20), (near, 1e20), (tiny, 1.0)):
        corners = np.array(clip) * size
        uvs = rng.normal(size=(3, 2))
        to_pixel = [[width / 2, 0, width / 2], [0, -height / 2, height / 2], [0, 0, 1]]
        screen = corners[:, [0, 1, 3]] @ np.transpose(to_pixel)
        linear = np.linalg.solve(screen, np.hstack([uvs, np.ones((3, 1))]))
        u, v, inverse = np.moveaxis(pixels @ linear, -1, 0)  # of t/w and 1/w at each pixel
        want = np.stack(
            [
                (linear[:2, i] * inverse[..., None] - t[..., None] * linear[:2, 2])
                / inverse[..., None] ** 2
                for i, t in enumerate((u, v))
            ],
            axis=-2,
        )
        shares = np.moveaxis(pixels @ np.linalg.inv(screen), -1, 0) / inverse
        fragments = dr.Fragments(
            face=jnp.zeros((height, width), jnp.int32),
            barycentrics=jnp.asarray(np.moveaxis(shares, 0, -1), jnp.float32),
            inverse_depth=jnp.asarray(inverse, jnp.float32),
        )
        got = dr.screen_derivatives(uvs, corners, [[0, 1, 2]], fragments)
        scale = np.abs(want).max(axis=(-1, -2), keepdims=True)
        inside = (shares > -0.1).all(axis=0) | (clip is tiny)
        error = (np.abs(got - want) / scale)[inside]
        assert inside.sum() > 10
        assert error.max() < (1e-4 if clip is near else 2e-2)


# --------------------------------------------------------------------------------------- mappings


def test_planar_and_projected_mapping_solve_their_equation():
    corner, across, up = RNG.normal(size=(3, 3))
    mapping = dr.PlanarMapping(corner=corner, across=across, up=up)
    u, v, w = RNG.uniform(-2, 3, size=(3, 100, 1))
    points = corner + u * across + v * up
    np.testing.assert_allclose(dr.map_points(mapping, points), np.hstack([u, v]), atol=2e-5)
    points = points + w * np.cross(across, up)
    np.testing.assert_allclose(dr.map_points(mapping, points), np.hstack([u, v]), atol=2e-5)
    inverse = np.linalg.inv(np.stack([across, up, np.cross(across, up)]))
    np.testing.assert_allclose(
        dr.map_points(mapping, points), ((points - corner) @ inverse)[:, :2], atol=2e-5
    )
    tiny = dr.PlanarMapping(corner=(0, 0, 0), across=(1e-20, 0, 0), up=(0, 1e20, 0))
    np.testing.assert_allclose(dr.map_points(tiny, (0.5e-20, 2e20, 7)), [0.5, 2], rtol=1e-6)
    flat = dr.PlanarMapping(corner=(0, 0, 0), across=(1, 1, 0), up=(2, 2, 0))
    np.testing.assert_array_equal(dr.map_points(flat, points), 0)


def test_sphere_mapping_by_the_normal():
    centre, points = RNG.normal(size=3), RNG.normal(size=(100, 3))
    n = (points - centre) / np.linalg.norm(points - centre, axis=1, keepdims=True)
    v = np.arcsin(n[:, 1]) / np.pi + 0.5
    want = np.stack([np.arcsin(n[:, 0]) / np.pi + 0.5, v], axis=1)
    np.testing.assert_allclose(
        dr.map_points(dr.SphereMapping(centre=centre), points), want, atol=1e-6
    )
    want = np.stack([np.arctan2(n[:, 0], n[:, 2]) / (2 * np.pi) + 0.5, v], axis=1)
    around = dr.SphereMapping(centre=centre, kind="longitude")
    np.testing.assert_allclose(dr.map_points(around, points), want, atol=1e-6)
    rotation = np.asarray(dr.linalg.so3_exp((0.3, -0.5, 0.7)))
    turned = dr.SphereMapping(rotation=rotation)
    np.testing.assert_allclose(
        dr.map_points(turned, n), dr.map_points(dr.SphereMapping(), n @ rotation.T), atol=1e-6
    )


@pytest.mark.parametrize("kind", ["arcsine", "longitude"])
@pytest.mark.parametrize("point", [(0, 0, 0), (1, 0, 0), (0, -1, 0), (0, 0, -1), (1e-30, 0, 0)])
def test_sphere_mapping_is_finite_at_its_poles(kind, point):
    mapping = dr.SphereMapping(kind=kind)
    point = jnp.array(point, float)
    assert np.isfinite(dr.map_points(mapping, point)).all()
    slopes = jax.jacrev(lambda p: dr.map_points(mapping, p))(point)
    assert not np.isnan(slopes).any()


def test_cube_mapping_meets_the_nearest_plane():
    half, centre = 1.7, RNG.normal(size=3)
    offset = RNG.uniform(-half, half, size=(200, 3))
    normals = RNG.normal(size=(200, 3))
    mapping = dr.CubeMapping(half_size=half, centre=centre)
    got = np.asarray(dr.map_points(mapping, centre + offset, normals))
    t = np.concatenate([(half - offset) / normals, (-half - offset) / normals], axis=1)
    t = np.min(np.where(t > 0, t, np.inf), axis=1, keepdims=True)
    np.testing.assert_allclose(got, (offset + t * normals) / half, atol=1e-4)
    np.testing.assert_allclose(np.abs(got).max(axis=1), 1, atol=1e-5)
    alone = dr.map_points(dr.CubeMapping(), offset, normals)
    np.testing.assert_allclose(alone, normals, rtol=1e-6)


# ------------------------------------------------------------------------------------------ cubes


def test_sides_of_a_cube_are_where_they_are_said_to_be():
    images = np.zeros((6, 2, 2, 3), np.float32)
    images[...] = np.arange(6)[:, None, None, None]
    images[..., 1] += [[0.1, 0.2], [0.3, 0.4]]
    cube = dr.CubeTexture(images, filter="nearest")
    ahead = {(1, 0, 0): 0, (-1, 0, 0): 1, (0, 1, 0): 2, (0, -1, 0): 3, (0, 0, 1): 4, (0, 0, -1): 5}
    for direction, number in ahead.items():
        assert dr.sample_texture(cube, 7 * np.array(direction, float))[0] == number
    # Upper right texels: up is +y but for the sides above and below.
    upper_right = {
        (2, 1, 1): 0, (-2, 1, -1): 1, (1, 2, 1): 2, (1, -2, -1): 3, (-1, 1, 2): 4, (1, 1, -2): 5,
    }  # fmt: skip
    for direction, number in upper_right.items():
        color = dr.sample_texture(cube, np.array(direction, float))
        np.testing.assert_allclose(color[:2], [number, number + 0.2], rtol=1e-6)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_cubes_have_no_seams(size):
    cube = dr.CubeTexture(RNG.uniform(size=(6, size, size, 1)), filter="trilinear")
    edge, along = RNG.permuted(np.tile([1.0, -1.0, 0], (500, 1)), axis=1), RNG.uniform(-1, 1, 500)
    signs = RNG.choice([-1.0, 1.0], size=(500, 3))
    points = signs * np.where(edge == 0, along[:, None], 1)
    corners = np.array(np.meshgrid(*[[-1.0, 1]] * 3)).reshape(3, -1).T
    points = np.vstack([points, corners])
    steps = np.broadcast_to(np.array([[0.1, 0], [0, 0.1], [0.05, 0.05]]), (len(points), 3, 2))
    colors = [
        dr.sample_texture(cube, points + 1e-6 * RNG.normal(size=points.shape), derivatives=d)
        for _ in range(5)
        for d in (None, 1e-3 * steps)
    ]
    assert np.max(np.ptp(np.stack(colors), axis=0)) < 1e-4


def test_a_smooth_function_on_a_cube_is_met_from_every_side():
    centres = (2 * np.arange(32) + 1) / 32 - 1
    s, t = np.meshgrid(centres, -centres)
    one = np.ones_like(s)
    sides = [(one, t, s), (-one, t, -s), (s, one, t), (s, -one, -t), (-s, t, one), (s, t, -one)]

    def function(d):
        d = d / np.linalg.norm(d, axis=-1, keepdims=True)
        return d @ [0.3, -0.5, 0.4] + d[..., 0] * d[..., 1]

    images = np.stack([function(np.stack(side, axis=-1)) for side in sides])[..., None]
    directions = RNG.normal(size=(2000, 3))
    got = dr.sample_texture(dr.CubeTexture(images), directions)[:, 0]
    np.testing.assert_allclose(got, function(directions), atol=8e-3)


def test_a_cross_folds_into_a_cube():
    cross = np.zeros((6, 8, 1), np.float32)
    for number, (row, column) in enumerate(((1, 2), (1, 0), (0, 1), (2, 1), (1, 3), (1, 1))):
        cross[2 * row : 2 * row + 2, 2 * column : 2 * column + 2] = 1 + number
    np.testing.assert_array_equal(
        dr.CubeTexture.from_cross(cross).images,
        np.broadcast_to(np.arange(1, 7)[:, None, None, None], (6, 2, 2, 1)),
    )


# -------------------------------------------------------------------------------------- bad input


CUBE = np.ones((6, 2, 2, 3))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dr.Texture(np.ones((4, 4))), r"image: wanted shape \(height, width, channels\)"),
        (lambda: dr.Texture(np.ones((0, 4, 3))), "image: wanted at least one texel"),
        (lambda: dr.Texture(np.full((2, 2, 3), np.nan)), "image: wanted finite numbers, got nan"),
        (lambda: dr.Texture(IMAGE, wrap="tile"), "wrap: wanted one of repeat, clamp, mirror"),
        (lambda: dr.Texture(IMAGE, wrap=("clamp",)), "wrap: wanted one name or two"),
        (lambda: dr.Texture(IMAGE, filter="cubic"), f"filter: wanted one of {', '.join(FILTERS)}"),
        (lambda: dr.Texture(IMAGE, anisotropy=17), "anisotropy: wanted at most 16, got 17"),
        (lambda: dr.Texture(IMAGE, mapping=dr.CubeMapping()), "mapping: wanted PlanarMapping, Sph"),
        (lambda: dr.CubeTexture(np.ones((5, 2, 2, 3))), r"images: wanted shape \(6, size, size"),
        (lambda: dr.CubeTexture(np.ones((6, 2, 3, 3))), r"images: wanted shape \(6, size, size"),
        (
            lambda: dr.CubeTexture(CUBE, mapping=dr.SphereMapping()),
            "mapping: wanted CubeMapping or",
        ),
        (lambda: dr.CubeTexture.from_cross(np.ones((3, 5, 1))), "cross: wanted 3 n rows and 4 n"),
        (lambda: dr.sample_texture(IMAGE, (0, 0)), "texture: wanted a Texture or CubeTexture, got"),
        (lambda: dr.sample_texture(dr.Texture(IMAGE), (0, 0, 0)), r"uv: wanted shape \(2,\), got"),
        (
            lambda: dr.sample_texture(dr.Texture(IMAGE), (0, 0), derivatives=(0, 0)),
            r"derivatives: wanted shape \(2, 2\), got \(2,\)",
        ),
        (lambda: dr.SphereMapping(kind="cylinder"), "kind: wanted one of arcsine, longitude"),
        (lambda: dr.SphereMapping(rotation=np.eye(4)), r"rotation: wanted shape \(3, 3\)"),
        (lambda: dr.CubeMapping(half_size=0.0), "half_size: wanted a number between 0 and inf"),
        (lambda: dr.PlanarMapping(corner=(0, 0), across=(1, 0, 0), up=(0, 1, 0)), "corner: wanted"),
        (lambda: dr.map_points(dr.CubeMapping(), (0, 0, 1)), "normals: wanted those of the points"),
        (lambda: dr.Material(texture=IMAGE), "texture: wanted a Texture, a CubeTexture or None"),
        (lambda: dr.Material(texture=dr.Texture(IMAGE[..., :1])), "texture: wanted three channels"),
        (
            lambda: dr.Object(dr.shapes.cube(), dr.Material(texture=dr.Texture(IMAGE))),
            "mesh: wanted uvs for a texture without a mapping, got none",
        ),
        (
            lambda: dr.Scene(objects=[], background=dr.CubeTexture(CUBE[..., :1])),
            "background: wanted three channels",
        ),
    ],
)
def test_errors_name_the_argument(make, message):
    with pytest.raises(ValueError, match=message):
        make()
