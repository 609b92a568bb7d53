"""The explicit clipper, and barycentric coordinates by the three routes of the source (V1)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import check_derivatives

import diffrast as dr
from diffrast import mesh as dm
from diffrast.clip import FRUSTUM, clip_lines, clip_mesh, clip_triangles

pytestmark = pytest.mark.usefixtures("compiled_quickly")


def area(points):
    x, y = np.asarray(points, np.float64).T
    return (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def flat(points):
    """Triangles in the plane of the picture, at w = 1."""
    points = np.asarray(points, np.float64)
    return np.concatenate(
        [points, np.zeros_like(points[:, :1]), np.ones_like(points[:, :1])], axis=1
    )


def test_triangles_keep_their_sense_and_their_exact_area():
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (300, 2))
    faces = np.arange(300).reshape(-1, 3)
    cut = clip_triangles(flat(points), faces)
    assert cut.corners.shape == (100, 9, 4)
    counts = np.asarray(cut.sizes)
    assert set(counts) == {0, 3, 4, 5, 6, 7}
    for face, corners, count in zip(faces, np.asarray(cut.corners), counts, strict=True):
        whole = area(points[face])
        # Areas by many samples: the clipped part, with its sign, is the part inside.
        grid = (np.stack(np.meshgrid(*[np.arange(200)] * 2), axis=-1) + 0.5) / 100 - 1
        a, b, c = points[face]
        sides = [
            (q - p)[0] * (grid[..., 1] - p[1]) - (q - p)[1] * (grid[..., 0] - p[0])
            for p, q in ((a, b), (b, c), (c, a))
        ]
        inside = np.all(np.stack(sides) * np.sign(whole) >= 0, axis=0).mean() * 4
        got = area(corners[:count, :2]) if count else 0.0
        np.testing.assert_allclose(got, inside * np.sign(whole), atol=0.02)
        assert (np.abs(corners[:count, :2]) <= 1 + 1e-6).all()
        assert (corners[count:] == 0).all()
    shares = np.asarray(cut.barycentrics)
    rebuilt = np.einsum("fkc,fcx->fkx", shares, flat(points)[faces])
    np.testing.assert_allclose(rebuilt, cut.corners, atol=1e-5)


def test_behind_the_eye_and_on_the_planes():
    camera = dr.Camera.perspective(eye=(0, 0, 0), direction=(0, 0, -1), fov_y=1.2, near=0.5, far=9)
    points = np.array([[0.0, -1, 4], [3, 1, -8], [-3, 1, -8], [0, 0, 3], [1, 0, 2], [0, 1, 2]])
    cut = clip_triangles(dr.world_to_clip(camera, points), [[0, 1, 2], [3, 4, 5]])
    assert np.asarray(cut.sizes).tolist()[1] == 0
    corners = np.asarray(cut.corners)[0][: int(cut.sizes[0])]
    assert (corners @ np.array(FRUSTUM).T >= -1e-5).all()
    assert (corners[:, 3] > 0.49).all()
    whole = flat([[-1, -1], [1, -1], [1, 1]])
    same = clip_triangles(whole, [[0, 1, 2]])
    assert int(same.sizes[0]) == 3
    np.testing.assert_array_equal(same.corners[0, :3], whole)


def test_what_only_touches_the_frustum_is_not_seen():
    points = flat([[1, 0], [2, 1], [2, -1], [1, 0.5], [1, -0.5], [0, 0], [1, 1], [1, 3], [0, 1]])
    faces = [[0, 2, 1], [3, 4, 1], [5, 0, 8], [5, 2, 0], [6, 7, 1], [0, 1, 7]]
    cut = clip_triangles(points, faces)
    np.testing.assert_array_equal(cut.sizes, [0, 0, 3, 3, 0, 0])  # the third whole, half the next
    for corners in np.asarray(cut.corners)[2:4, :3]:
        assert len(np.unique(corners, axis=0)) == 3
    lines = clip_lines(points, [[0, 1], [1, 0], [0, 5], [0, 3], [6, 7], [5, 5]])
    np.testing.assert_array_equal(lines.seen, [False, False, True, True, False, True])
    np.testing.assert_array_equal(np.asarray(lines.ends)[~np.asarray(lines.seen)], 0)
    camera = dr.Camera.orthographic(eye=(0, 0, 5), target=(0, 0, 0), height=2.0, near=1, far=9)
    with pytest.raises(ValueError, match="mesh: wanted one with a part in the camera's frustum"):
        clip_mesh(dr.Mesh(vertices=points[:3, :3], faces=[[0, 2, 1]]), camera)


def test_neighbours_share_their_new_corners():
    points = flat([[-1.7, -0.31], [1.9, 0.77], [0.3, 3.1], [0.1, -2.9]])
    cut = clip_triangles(points, [[0, 1, 2], [1, 0, 3]])
    sets = [
        {tuple(p) for p in np.asarray(cut.corners)[k][: int(cut.sizes[k])].tolist()} for k in (0, 1)
    ]
    assert len(sets[0] & sets[1]) == 2


def test_clipping_is_differentiable():
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-2, 2, (9, 3)), rng.uniform(0.5, 2, (9, 1))], axis=1)

    def corners(points):
        cut = clip_triangles(points, np.arange(9).reshape(3, 3))
        ends = clip_lines(points, [[0, 1], [2, 3], [4, 5]]).ends
        return jnp.sin(cut.corners), cut.barycentrics, ends

    with jax.enable_x64(True):
        check_derivatives(corners, points, step=1e-6)


def test_lines_are_cut_to_the_frustum():
    points = flat([[-3, 0.5], [3, 0.5], [0, 0], [0.5, 0.5], [2, 2], [3, -1], [0, 2], [2.5, 0]])
    cut = clip_lines(points, [[0, 1], [2, 3], [4, 5], [6, 7]])
    np.testing.assert_array_equal(cut.seen, [True, True, False, False])
    np.testing.assert_allclose(
        cut.ends[:2, :, :2], [[[-1, 0.5], [1, 0.5]], [[0, 0], [0.5, 0.5]]], atol=1e-6
    )
    np.testing.assert_allclose(cut.positions[0], [1 / 3, 2 / 3], atol=1e-6)
    np.testing.assert_array_equal(cut.ends[1, 1], points[3])


def test_a_mesh_cut_by_a_camera_keeps_its_attributes():
    camera = dr.Camera.orthographic(eye=(0, 0, 5), target=(0, 0, 0), height=1.0, near=0, far=10)
    ball = dr.shapes.icosphere(2)
    part = clip_mesh(ball, camera)
    vertices = np.asarray(part.vertices)
    assert np.abs(vertices[:, :2]).max() <= 0.5 + 1e-6
    np.testing.assert_allclose(jnp.linalg.norm(part.normals, axis=1), 1, rtol=1e-5)
    # Front and back are both there, and each covers the window.
    normals = np.asarray(dm.face_normals(part.vertices, part.faces))
    areas = np.asarray(dm.face_areas(part.vertices, part.faces))
    np.testing.assert_allclose(areas @ np.abs(normals[:, 2]), 2, rtol=1e-4)
    with pytest.raises(ValueError, match="mesh: wanted one with a part in the camera's frustum"):
        clip_mesh(dm.transform(ball, dr.linalg.translation((9, 0, 0))), camera)


def test_a_mesh_that_is_cut_keeps_uvs_with_their_own_indices():
    # Of (x, y) in a square they are ((x + 1)/2, (y + 1)/2), in any order, and one twice.
    square = dm.Mesh(
        vertices=[(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)],
        faces=[(0, 1, 2), (0, 2, 3)],
        uvs=[(0.0, 1.0), (1.0, 1.0), (0.0, 0.0), (1.0, 0.0), (0.0, 0.0)],
        uv_faces=[(2, 3, 1), (4, 1, 0)],
    )
    camera = dr.Camera.orthographic(eye=(0.3, 0, 5), target=(0.3, 0, 0), height=2, near=0, far=10)
    part = clip_mesh(square, camera)
    np.testing.assert_allclose(part.uvs, (part.vertices[:, :2] + 1) / 2, atol=1e-6)


# --------------------------------------------------------------------------- barycentric (V1)


def by_inverse(p, a, b, c):
    beta, gamma = np.linalg.inv(np.stack([b - a, c - a], axis=1)) @ (p - a)
    return np.array([1 - beta - gamma, beta, gamma])


def by_cramer(p, a, b, c):
    def det(u, v):
        return u[0] * v[1] - u[1] * v[0]

    whole = det(b - a, c - a)
    beta, gamma = det(p - a, c - a) / whole, det(b - a, p - a) / whole
    return np.array([1 - beta - gamma, beta, gamma])


def by_lines(p, a, b, c):
    """The geometric solution: values of the sides' line equations."""

    def f(q, r, at):
        return (q[1] - r[1]) * at[0] + (r[0] - q[0]) * at[1] + q[0] * r[1] - r[0] * q[1]

    beta, gamma = f(c, a, p) / f(c, a, b), f(a, b, p) / f(a, b, c)
    return np.array([1 - beta - gamma, beta, gamma])


def test_three_routes_to_barycentric_coordinates_agree():
    rng = np.random.default_rng(2)
    for p, *corners in rng.normal(size=(100, 4, 2)):
        want = by_inverse(p, *corners)
        np.testing.assert_allclose(by_cramer(p, *corners), want, atol=1e-9 * np.abs(want).max())
        np.testing.assert_allclose(by_lines(p, *corners), want, atol=1e-9 * np.abs(want).max())
    # The source's numbers, in the plane and in space.
    example = [np.array(v, float) for v in ((4, 4), (4, 6), (2, 1), (6, 3))]
    for route in (by_inverse, by_cramer, by_lines):
        np.testing.assert_allclose(route(*example), [0.5, 0.25, 0.25])
    matrix = np.array([[1.0, 2, 1], [1, 5, -3], [0, 1, 1]])
    np.testing.assert_allclose(np.linalg.solve(matrix, [1.4, 1, 0.8]), [0.2, 0.4, 0.4])


def test_fragments_have_the_barycentric_coordinates_of_the_routes():
    corners = np.array([[-0.8, -0.7], [0.9, -0.2], [-0.1, 0.85]])
    found = dr.rasterize(flat(corners), [[0, 1, 2]], height=12, width=12)
    for i, j in np.argwhere(np.asarray(found.face) == 0):
        p = np.array([(2 * j + 1) / 12 - 1, 1 - (2 * i + 1) / 12])
        for route in (by_inverse, by_cramer, by_lines):
            np.testing.assert_allclose(found.barycentrics[i, j], route(p, *corners), atol=1e-5)
