from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from diffrast import mesh as dm
from diffrast.files.bezier import load_bezier, save_bezier
from diffrast.shapes import bezier_mesh, evaluate, parse_bezier, teapot, teapot_patches
from diffrast.shapes.teapot import SURFACES

pytestmark = pytest.mark.usefixtures("compiled_quickly")

DATA = Path(__file__).parent / "data"
FLAT = np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0), [0.0]), axis=-1)[:, :, 0]


def bumpy(patches=1, seed=0):
    return FLAT + 0.3 * np.random.default_rng(seed).normal(size=(patches, 4, 4, 3))


def cap():
    """A patch whose first row is one point: a quarter of a dome."""
    rows = [(0, 1), (0.55, 1), (1, 0.55), (1, 0)]
    arc = np.array([[0, 1], [0.55, 1], [1, 0.55], [1, 0]])
    patch = [[[radius * x, radius * y, z] for x, y in arc] for radius, z in rows]
    return np.array([patch])


def bernstein(t):
    return np.array([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])


# ----------------------------------------------------------------------------------- evaluation


def test_positions_and_tangents_follow_their_formula():
    control, u, v = bumpy(2), np.linspace(0, 1, 5), np.linspace(1, 0, 3)[:, None]
    points = evaluate(control, u, v)
    assert points.position.shape == (2, 3, 5, 3)
    want = np.einsum("pijc,iab,jab->pabc", control, bernstein(v + 0 * u), bernstein(u + 0 * v))
    np.testing.assert_allclose(points.position, want, atol=1e-5)
    single = evaluate(control, 0.25, 1)
    assert single.normal.shape == (2, 3)
    np.testing.assert_allclose(single.position, want[:, 0, 1], atol=1e-5)
    with jax.enable_x64(True):
        wide = jax.tree.map(np.asarray, evaluate(control, u, v))

        def by_parameters(u, v):
            return evaluate(control, u, v).position

        at = tuple(grid + 0.0 for grid in np.broadcast_arrays(u, v))
        one, zero = np.ones((3, 5)), np.zeros((3, 5))
        along = jax.jit(lambda tangents: jax.jvp(by_parameters, at, tangents)[1])
        along_u, along_v = along((one, zero)), along((zero, one))
        np.testing.assert_allclose(wide.tangent_u, along_u, atol=1e-12)
        np.testing.assert_allclose(wide.tangent_v, along_v, atol=1e-12)
    cross = np.cross(wide.tangent_u, wide.tangent_v)
    cross /= np.linalg.norm(cross, axis=-1, keepdims=True)
    np.testing.assert_allclose(wide.normal, cross, atol=1e-12)


@pytest.mark.parametrize("size", [1e-20, 1.0, 1e18])
def test_normals_do_not_depend_on_scale(size):
    u = np.linspace(0, 1, 5)
    want = evaluate(cap(), u, u[:, None]).normal
    got = evaluate((cap() * size).astype(np.float32), u, u[:, None]).normal
    np.testing.assert_allclose(got, want, atol=2e-6)
    np.testing.assert_allclose(jnp.linalg.norm(got, axis=-1), 1, rtol=1e-6)


def turned(control, turns):
    """The same surface with the parameters' square turned by quarter turns."""
    return np.rot90(control, turns, axes=(1, 2))


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_normal_at_a_collapsed_row_is_the_limit(turns):
    pinched = bumpy()
    pinched[0, 0] = pinched[0, 0, 0]
    with jax.enable_x64(True):
        for control in (cap(), pinched):
            edge = [np.linspace(0, 1, 7), np.zeros(7)]
            near = [edge[0], np.full(7, 1e-5)]
            for _ in range(turns):  # parameters of the same points, after each quarter turn
                edge, near = [edge[1], 1 - edge[0]], [near[1], 1 - near[0]]
            at = evaluate(turned(control, turns), *edge).normal
            close = evaluate(turned(control, turns), *near).normal
            np.testing.assert_allclose(at, close, atol=2e-4)
    if turns == 0:
        np.testing.assert_allclose(evaluate(cap(), 0.3, 0.0).normal, [[0, 0, 1]], atol=1e-6)


def test_normal_where_both_tangents_vanish_or_are_parallel():
    corner = bumpy()
    corner[0, 0, 1] = corner[0, 1, 0] = corner[0, 0, 0]
    parallel = bumpy()
    parallel[0, 1, 0] = 1.7 * parallel[0, 0, 1] - 0.7 * parallel[0, 0, 0]
    with jax.enable_x64(True):
        for control in (corner, parallel):
            at = evaluate(control, 0.0, 0.0).normal
            np.testing.assert_allclose(at, evaluate(control, 1e-6, 1e-6).normal, atol=1e-4)
    line = np.zeros((1, 4, 4, 3)) + np.linspace(0, 1, 4)[:, None]
    np.testing.assert_array_equal(evaluate(line, 0.3, 0.2).normal, [[0, 0, 0]])


def test_mesh_is_differentiable_in_the_control_points():
    def generic(control):
        mesh = bezier_mesh(control, (2, 3))
        return mesh.vertices, mesh.normals

    def dome(apex):
        return generic(jnp.asarray(cap()).at[0, 0].set(apex))

    with jax.enable_x64(True):
        check_grads(jax.jit(generic), (bumpy(2),), order=1, rtol=1e-5)
        check_grads(jax.jit(dome), (np.array([0.1, 0.2, 1.1]),), order=1, modes="fwd", rtol=1e-5)
    values, pull = jax.vjp(jax.jit(generic), jnp.asarray(cap(), jnp.float32))
    assert np.isfinite(pull(values)[0]).all()
    known = bezier_mesh(cap(), (2, 3))
    np.testing.assert_allclose(values[0], known.vertices, atol=1e-6)
    np.testing.assert_allclose(values[1], known.normals, atol=1e-6)


# ---------------------------------------------------------------------------------------- meshes


def test_the_thesis_patch_gives_the_printed_mesh():
    rows = [line.split() for line in (DATA / "patch.dat").read_text().splitlines()]
    vertices, quads = rows[1:26], np.array(rows[26:], dtype=int)[:, 3:]
    mesh = bezier_mesh(load_bezier(DATA / "patch.bez").control_points, 4, merge_tolerance=1e-5)
    assert [[f"{x:.6f}" for x in vertex] for vertex in mesh.vertices] == [r[1:] for r in vertices]
    np.testing.assert_array_equal(mesh.faces, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3))


def test_patches_that_join_smoothly_have_one_normal_on_the_edge_they_share():
    left = bumpy(1, seed=4)[0]
    right = bumpy(1, seed=5)[0] + [3, 0, 0]
    right[:, 0] = left[:, 3]
    smooth = right.copy()
    smooth[:, 1] = left[:, 3] + 0.8 * (left[:, 3] - left[:, 2])  # collinear across the edge
    edge_left = evaluate([left], 1.0, np.linspace(0, 1, 9))
    for other, tolerance in ((smooth, 1e-5), (right, None)):
        edge_right = evaluate([other], 0.0, np.linspace(0, 1, 9))
        np.testing.assert_array_equal(edge_left.position, edge_right.position)
        apart = np.abs(edge_left.normal - edge_right.normal).max()
        assert apart < tolerance if tolerance else apart > 0.05
    slopes = [evaluate([left], 1.0, 0.3).tangent_u, evaluate([smooth], 0.0, 0.3).tangent_u]
    np.testing.assert_allclose(slopes[1], 0.8 * slopes[0], rtol=1e-4)
    joined = bezier_mesh([left, smooth], (4, 6), merge_tolerance=0)
    assert joined.vertices.shape == (2 * 35 - 7, 3)
    assert joined.uvs is None


@pytest.mark.parametrize("flip", [False, True])
def test_shared_edges_are_equal_to_the_bit_in_either_direction(flip):
    left, right = bumpy(2, seed=6)
    border = left[:, 3] if not flip else left[::-1, 3]
    right[0] = border  # a column of one is a row of the other
    mesh = bezier_mesh([left, right], 7)
    assert len(np.unique(dm.weld(mesh.vertices))) == 2 * 64 - 8


def test_divisions_and_order_of_vertices():
    mesh = bezier_mesh(bumpy(3), (2, 5))
    assert mesh.vertices.shape == (3 * 18, 3)
    assert mesh.faces.shape == (3 * 20, 3)
    want = evaluate(bumpy(3), 0.5, 0.2)
    np.testing.assert_allclose(mesh.vertices[4::18], want.position, atol=1e-6)
    np.testing.assert_allclose(mesh.uvs[4::18], np.tile([0.5, 0.2], (3, 1)))
    np.testing.assert_allclose(mesh.normals[4::18], want.normal, atol=1e-6)
    flat = bezier_mesh(FLAT[None], 3)
    np.testing.assert_allclose(
        dm.face_normals(flat.vertices, flat.faces), np.tile([0, 0, 1], (18, 1)), atol=1e-6
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((FLAT,), r"control_points: wanted shape \(patches, 4, 4, 3\), got \(4, 4, 3\)"),
        ((FLAT[None], 0), "divisions: wanted an integer of at least 1, got 0"),
        ((FLAT[None], (1, 2, 3)), "divisions: wanted one integer or two"),
    ],
)
def test_bezier_mesh_refuses(arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        bezier_mesh(*arguments)


# ---------------------------------------------------------------------------------------- teapot


def test_teapot_counts_and_size():
    patches = teapot_patches()
    assert patches.points.shape == (306, 3)
    assert patches.control_points.shape == (32, 4, 4, 3)
    np.testing.assert_array_equal(np.bincount(patches.surfaces), [12, 4, 4, 8, 4])
    mesh = teapot(6)
    assert mesh.faces.shape == (32 * 2 * 36, 3)
    assert mesh.vertices.shape == (32 * 49, 3)
    np.testing.assert_allclose(mesh.vertices[:, 2].max(), 3.15)
    np.testing.assert_allclose(mesh.vertices[:, 2].min(), 0)


def test_teapot_is_mirror_symmetric():
    points = np.round(teapot_patches().points, 6)
    there = {tuple(point) for point in points + 0.0}
    assert there == {tuple(point) for point in points * [1, -1, 1] + 0.0}


def test_teapot_normals_are_unit_point_out_and_join():
    mesh = teapot(8)
    normals, faces = np.asarray(mesh.normals), np.asarray(mesh.faces)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-6)
    facets = np.asarray(dm.face_normals(mesh.vertices, faces))
    degenerate = ~facets.any(axis=1)
    assert degenerate.sum() == 8 * 8
    along = np.einsum("fc,fkc->fk", facets, normals[faces])[~degenerate]
    assert along.min() > 0.2
    assert along.mean() > 0.97
    vertices = np.asarray(mesh.vertices)
    for pole, sign in ((vertices[:, 2].max(), 1), (0.0, -1)):
        at = (vertices[:, 2] == pole) & (np.abs(vertices[:, :2]).max(axis=1) < 1e-6)
        assert at.sum() >= 4 * 9
        np.testing.assert_allclose(normals[at], np.tile([0, 0, sign], (at.sum(), 1)), atol=1e-6)


@pytest.mark.parametrize("name", SURFACES)
def test_teapot_parts_have_no_cracks(name):
    part = teapot(5, surfaces=[name])
    _, edge_faces, _ = dm.edge_adjacency(part.vertices, part.faces)
    rims = {"body": 2, "handle": 2, "spout": 2, "lid": 1, "base": 1}[name]
    rim_edges = {"body": 20, "handle": 10, "spout": 10, "lid": 20, "base": 20}[name]
    assert (edge_faces[:, 1] < 0).sum() == rims * rim_edges
    np.testing.assert_allclose(part.normals, part.normals[dm.weld(part.vertices)], atol=5e-6)


def test_known_patches_are_merged_inside_of_jit():
    outside = bezier_mesh(cap(), 2, merge_tolerance=1e-3)
    inside = jax.jit(lambda: bezier_mesh(cap(), 2, merge_tolerance=1e-3))()
    np.testing.assert_array_equal(inside.vertices, outside.vertices)
    np.testing.assert_array_equal(inside.faces, outside.faces)


def test_teapot_refuses():
    with pytest.raises(ValueError, match="surfaces: wanted one of body, handle"):
        teapot(surfaces=["cup"])
    with pytest.raises(ValueError, match="surfaces: wanted at least one"):
        teapot(surfaces=[])
    with pytest.raises(ValueError, match="divisions: wanted an integer of at least 1"):
        teapot(0)


# ----------------------------------------------------------------------------------------- files


def test_patch_files_read_back_as_written(tmp_path):
    patches = teapot_patches()
    save_bezier(tmp_path / "pot.bez", patches)
    again = load_bezier(tmp_path / "pot.bez")
    for wrote, read in zip(patches, again, strict=True):
        np.testing.assert_array_equal(wrote, read)


PATCH = (DATA / "patch.bez").read_text()


@pytest.mark.parametrize(
    ("change", "line", "message"),
    [
        (lambda t: t.replace("3 3 0 0", "4 3 0 0"), 5, "control point number 3, an integer in"),
        (lambda t: t.replace("5 1 2 3", "5 1 two 3"), 7, "y of control point 5, got 'two'"),
        (lambda t: t.replace("5 1 2 3", "5 1 inf 3"), 7, "y of control point 5, got 'inf'"),
        (lambda t: t.replace("5 1 2 3", "5 1 2_0 3"), 7, "y of control point 5, got '2_0'"),
        (lambda t: t.replace("14 15 {", "14 1_5 {"), 18, "got '1_5'"),
        (lambda t: t.replace("14 15 {", "14 16 {"), 18, r"an integer in \[0, 16\), got '16'"),
        (lambda t: t.replace("0 0 16 0", "0 1 16 0"), 18, "the surface of patch 0"),
        (lambda t: t.replace("0 0 16 0", "0 0 12 0"), 18, "the number of control points of patch"),
        (lambda t: t.split("4 0 2")[0], 5, "control point number 4, got the end of the file"),
        (lambda t: t + "7", 19, "the end of the file, got '7'"),
        (lambda t: "16.0" + t[2:], 1, "the number of control points, got '16.0'"),
        (lambda t: "0" + t[2:], 1, "an integer of at least 1, got '0'"),
        (lambda t: "", 0, "the number of control points, got the end"),
    ],
)
def test_broken_patch_files_name_the_line(tmp_path, change, line, message):
    path = tmp_path / "broken.bez"
    path.write_text(change(PATCH))
    with pytest.raises(ValueError, match=f"broken.bez:{line}: wanted .*{message}"):
        load_bezier(path)


def test_patch_files_may_begin_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "patch.bez"
    path.write_bytes(b"\xef\xbb\xbf" + (DATA / "patch.bez").read_bytes() + b"{\xc4}")
    whole = load_bezier(DATA / "patch.bez")
    np.testing.assert_array_equal(load_bezier(path).control_points, whole.control_points)


def test_comments_may_span_lines():
    broken_over_lines = PATCH.replace("number of", "number\nof")
    assert parse_bezier(broken_over_lines).indices.shape == (1, 4, 4)
    with pytest.raises(FileNotFoundError):
        load_bezier("nowhere.bez")
