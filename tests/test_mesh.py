import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from diffrast import _topology
from diffrast import mesh as dm
from diffrast._polygons import clip_ears
from diffrast.linalg import compose, rotation_y, scaling, translation
from diffrast.mesh import Mesh

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float32)
TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=np.float32)
TETRAHEDRON_FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
CUBE_QUADS = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)


def cube(offset=(0, 0, 0)):
    return dm.from_polygons(CUBE + np.array(offset, np.float32), CUBE_QUADS)


def grid(count, seed=0):
    """A bumpy square of 2 * count² faces."""
    x, y = np.meshgrid(np.arange(count + 1.0), np.arange(count + 1.0))
    z = np.random.default_rng(seed).normal(size=x.shape) * 0.3
    i = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).reshape(-1)
    quads = np.stack([i, i + 1, i + count + 2, i + count + 1], axis=1)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), faces


# ------------------------------------------------------------------------------------- the class


def test_mesh_converts_and_keeps_types():
    mesh = Mesh(vertices=TETRAHEDRON.tolist(), faces=TETRAHEDRON_FACES)
    assert mesh.vertices.dtype == jnp.float32
    assert mesh.faces.dtype == jnp.int32
    assert mesh.normals is None
    assert mesh.uvs is None
    assert len(jax.tree.leaves(mesh)) == 2 + 5  # of them in the topology
    with jax.enable_x64(True):
        assert Mesh(vertices=CUBE.astype(np.float64), faces=[[0, 1, 2]]).vertices.dtype == "float64"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": SQUARE[:, :2]}, r"vertices: wanted shape \(vertices, 3\), got \(4, 2\)"),
        ({"vertices": SQUARE * np.nan}, "vertices: wanted finite"),
        ({"vertices": np.zeros((0, 3))}, "vertices: wanted at least one"),
        ({"faces": [[0, 1, 4]]}, r"faces: wanted indices in \[0, 4\), got 4"),
        ({"faces": [[0, 1, -1]]}, r"faces: wanted indices in \[0, 4\), got -1"),
        ({"faces": [[0.0, 1.0, 2.0]]}, "faces: wanted integers"),
        ({"faces": [[0, 1, 2, 3]]}, r"faces: wanted shape \(faces, 3\)"),
        ({"faces": np.zeros((0, 3), int)}, "faces: wanted at least one"),
        ({"normals": SQUARE[:3]}, r"normals: wanted shape \(4, 3\), got \(3, 3\)"),
        ({"uvs": SQUARE}, r"uvs: wanted shape \(4, 2\), got \(4, 3\)"),
        ({"uvs": np.full((4, 2), np.inf)}, "uvs: wanted finite"),
    ],
)
def test_mesh_refuses(change, message):
    with pytest.raises(ValueError, match=message):
        Mesh(**{"vertices": SQUARE, "faces": [[0, 1, 2], [0, 2, 3]], **change})


def test_mesh_passes_through_transformations():
    mesh = cube()

    @jax.jit
    def volume(vertices):
        return dm.signed_volume(dataclasses.replace(mesh, vertices=vertices))

    np.testing.assert_allclose(volume(mesh.vertices), 8, rtol=1e-6)
    batch = jnp.stack([mesh.vertices, 2 * mesh.vertices])
    np.testing.assert_allclose(jax.vmap(volume)(batch), [8, 64], rtol=1e-6)
    many = jax.vmap(lambda s: dm.transform(mesh, scaling(s)))(jnp.array([1.0, 3.0]))
    assert many.vertices.shape == (2, 8, 3)


# --------------------------------------------------------------------------------------- normals


@pytest.mark.parametrize("size", [1e-20, 1.0, 1e18])
def test_normals_of_any_scale(size):
    vertices = (CUBE * np.float32(size)).astype(np.float32)
    faces = cube().faces
    flat = dm.face_normals(vertices, faces)
    np.testing.assert_allclose(np.abs(flat).max(axis=1), 1, rtol=1e-6)
    for weighting, tolerance in (("area", 0.35), ("angle", 1e-6), ("uniform", 0.35)):
        smooth = dm.vertex_normals(vertices, faces, weighting=weighting)
        np.testing.assert_allclose(jnp.linalg.norm(smooth, axis=1), 1, rtol=1e-6)
        np.testing.assert_allclose(smooth, CUBE / np.sqrt(3), atol=tolerance)


def test_small_faces_count_by_their_area_far_below_float_range():
    # Two corners of areas 1 : 1e-24; with squared float32 lengths the second would be lost
    # or, where it is alone at a vertex, give no normal at all.
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1e-22, 0], [0, 0, 1e-22]], np.float32)
    normals = dm.vertex_normals(vertices, [[0, 1, 2], [0, 3, 4]])
    np.testing.assert_allclose(normals[:3], np.tile([0, 0, 1], (3, 1)))
    np.testing.assert_allclose(normals[3:], np.tile([1, 0, 0], (2, 1)))


def test_weightings_against_their_definitions():
    rng = np.random.default_rng(3)
    rim = np.array([[np.cos(t), np.sin(t), 0] for t in (0, 0.7, 1.9, 3.1, 5.0)])
    vertices = np.concatenate([[[0, 0, 0.8]], rim * rng.uniform(0.5, 2, (5, 1))])
    faces = np.array([[0, 1 + k, 1 + (k + 1) % 5] for k in range(5)])
    first, second = vertices[faces[:, 1]] - vertices[0], vertices[faces[:, 2]] - vertices[0]
    area_vector = np.cross(first, second)
    area = np.linalg.norm(area_vector, axis=1, keepdims=True)
    lengths = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    angle = np.arccos(np.sum(first * second, axis=1) / lengths)[:, None]
    unit = area_vector / area
    for weighting, weight in (("area", area), ("angle", angle), ("uniform", 1.0)):
        want = np.sum(unit * weight, axis=0)
        got = dm.vertex_normals(vertices, faces, weighting=weighting)[0]
        np.testing.assert_allclose(got, want / np.linalg.norm(want), atol=2e-6)
    np.testing.assert_allclose(dm.face_areas(vertices, faces), area[:, 0] / 2, rtol=1e-5)


@jax.jit
def all_normals(vertices, faces, weld):
    smooth = [dm.vertex_normals(vertices, faces, weighting=w, weld=weld) for w in dm.WEIGHTINGS]
    return jnp.stack(smooth), dm.face_normals(vertices, faces)


@jax.jit
def normals_and_derivatives(vertices, faces):
    """Values, tangents along a shift plus a change of scale, and a gradient."""
    size = jnp.max(jnp.abs(vertices))

    def normals(positions):
        return all_normals(positions, faces, jnp.arange(len(vertices)))

    values, shifted = jax.jvp(normals, (vertices,), (jnp.ones_like(vertices) * size,))
    scaled = jax.jvp(normals, (vertices,), (vertices,))[1]
    gradient = jax.vjp(normals, vertices)[1](values)[0] * size
    return values, shifted, scaled, gradient


def test_normals_have_exact_derivatives():
    vertices, faces = grid(2)
    weld = np.arange(len(vertices))
    weld[8] = 0

    @jax.jit
    def everything(positions):
        return all_normals(positions, faces, weld), dm.face_areas(positions, faces)

    with jax.enable_x64(True):
        check_grads(everything, (vertices,), order=1, rtol=1e-6)


@pytest.mark.parametrize("size", [1e-20, 1.0, 1e18])
def test_degenerate_faces_have_zero_normals_and_finite_derivatives(size):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 1, 0]], np.float32)
    vertices = jnp.asarray(vertices * size, jnp.float32)
    faces = np.array([[0, 0, 0], [0, 1, 1], [0, 1, 2], [0, 1, 3]])
    values, *derivatives = normals_and_derivatives(vertices, faces)
    want = [[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 1]]
    np.testing.assert_array_equal(values[1], want)
    np.testing.assert_array_equal(dm.face_areas(vertices, faces)[:3], [0, 0, 0])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((values, derivatives)))
    # Neither shifting nor scaling a model turns a normal.
    assert all(np.abs(x).max() < 1e-5 for x in jax.tree.leaves(derivatives[:2]))


# --------------------------------------------------------------------------- welding, splitting


def test_weld_finds_the_first_vertex_at_the_same_place():
    places = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    ids = np.random.default_rng(1).integers(0, 20, 100)
    want = np.array([np.flatnonzero(ids == i)[0] for i in ids])
    np.testing.assert_array_equal(dm.weld(places[ids]), want)
    np.testing.assert_array_equal(jax.jit(dm.weld)(places[ids]), want)
    signed_zeros = np.array([[0.0, 1, -0.0], [-0.0, 1, 0.0], [0, 1, 1e-30]], np.float32)
    np.testing.assert_array_equal(dm.weld(signed_zeros), [0, 0, 2])
    np.testing.assert_array_equal(jax.jit(dm.weld)(signed_zeros), [0, 0, 2])


def test_split_mesh_smooths_like_the_joined_one():
    joined = dm.with_normals(cube(), weighting="angle")
    split = dm.flat_shaded(joined)
    assert split.vertices.shape == (36, 3)
    np.testing.assert_allclose(
        split.normals.reshape(-1, 3, 3),
        jnp.repeat(dm.face_normals(CUBE, joined.faces)[:, None], 3, 1),
    )
    corners = joined.faces.reshape(-1)
    smooth = dm.with_normals(split, weighting="angle").normals
    np.testing.assert_allclose(smooth, joined.normals[corners], atol=1e-6)
    apart = dm.with_normals(split, weld=False).normals
    np.testing.assert_allclose(apart, split.normals, atol=1e-6)


def test_smoothing_can_be_differentiated_through_the_welding():
    split = dm.flat_shaded(cube())

    def spread(vertices):
        return dm.with_normals(dataclasses.replace(split, vertices=vertices)).normals[:, 0].sum()

    gradient = jax.jit(jax.grad(spread))(split.vertices * jnp.array([1.0, 1.3, 0.7]))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 1e-3


# ------------------------------------------------------------------------------------- polygons


def test_surfaces_split_vertices_and_average_within_themselves():
    smooth = dm.from_polygons(CUBE, CUBE_QUADS)
    assert smooth.vertices.shape == (8, 3)
    np.testing.assert_allclose(smooth.normals, CUBE / np.sqrt(3), rtol=1e-6)
    faceted = dm.from_polygons(CUBE, CUBE_QUADS, surfaces=np.arange(6))
    assert faceted.vertices.shape == (24, 3)
    np.testing.assert_allclose(
        faceted.normals[faceted.faces[:, 0]], dm.face_normals(faceted.vertices, faceted.faces)
    )
    # Sides in one surface, lids in two others: the normals of a cylinder.
    sides = dm.from_polygons(CUBE, CUBE_QUADS, surfaces=[7, 7, 7, 7, -1, 2])
    assert sides.vertices.shape == (16, 3)
    assert set(np.round(np.abs(sides.normals[:, 2]), 6)) == {0.0, 1.0}


def test_uniform_average_ignores_area_and_triangulation():
    box = CUBE * np.array([1, 2, 5], np.float32)
    np.testing.assert_allclose(
        dm.from_polygons(box, CUBE_QUADS).normals, CUBE / np.sqrt(3), rtol=1e-6
    )
    area = dm.from_polygons(box, CUBE_QUADS, weighting="area").normals
    want = CUBE * np.array([10, 5, 2])
    np.testing.assert_allclose(area, want / np.linalg.norm(want, axis=1)[:, None], rtol=1e-6)


def test_degenerate_corners_and_polygons_are_skipped():
    vertices = np.concatenate([SQUARE, SQUARE[:1], [[2, 0, 0]]])
    polygons = [[0, 4, 1, 1, 2, 3], [0, 1, 5], [0, 4], [], [2, 2, 2], [0, 1, 0]]
    mesh = dm.from_polygons(vertices, polygons, surfaces=np.arange(6))
    assert mesh.faces.shape == (2, 3)
    np.testing.assert_allclose(dm.face_areas(mesh.vertices, mesh.faces).sum(), 1)
    np.testing.assert_allclose(mesh.normals, np.tile([0, 0, 1], (4, 1)))


def test_concave_polygons_are_covered_once():
    comb = [[0, 0], [7, 0], [7, 3], [6, 3], [6, 1], [5, 1], [5, 3], [3, 3], [3, 1], [1, 1], [1, 3]]
    star = np.array([[np.cos(t), np.sin(t)] for t in np.arange(10) * np.pi / 5])
    star *= np.where(np.arange(10) % 2, 0.3, 1)[:, None]
    tee = [[0, 0], [1, 0], [2, 0], [2, 1], [1, 1], [1, 2], [1, 3], [0, 3], [0, 1]]
    for outline in (np.array(comb), star, np.array(tee)):
        x, y = outline.T
        area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2
        for turn in (0.0, 1.0, 2.5):
            cosine, sine = np.cos(turn), np.sin(turn)
            points = np.stack([cosine * x, y, -sine * x], axis=1)
            mesh = dm.from_polygons(points, [np.arange(len(points))])
            assert len(mesh.faces) == len(points) - 2
            a, b, c = np.asarray(mesh.vertices)[np.asarray(mesh.faces)].swapaxes(0, 1)
            facing = np.cross(b - a, c - a) @ np.array([sine, 0, cosine]) / 2
            assert facing.min() > -1e-6
            np.testing.assert_allclose(facing.sum(), area, rtol=1e-5)
            np.testing.assert_allclose(mesh.normals[0], [sine, 0, cosine], atol=1e-6)


def test_ears_are_cut_from_a_polygon_that_crosses_itself():
    assert len(clip_ears(np.array([[0, 0], [2, 2], [2, 0], [0, 2], [1, 3.0]]))) == 3


@pytest.mark.parametrize(
    ("polygons", "options", "message"),
    [
        ([[0, 1, 4]], {}, r"polygons: wanted vertex ids in \[0, 4\), got \[0, 1, 4\] at 0"),
        ([[0, 1, 2], [0, 1, -1]], {}, "at 1"),
        ([[0.5, 1, 2]], {}, "polygons: wanted a list of vertex ids"),
        ([[0, 1, 1]], {}, "polygons: wanted at least one with three corners"),
        ([], {}, "polygons: wanted at least one"),
        ([[0, 1, 2]], {"surfaces": [0, 1]}, "surfaces: wanted an integer for each of 1"),
        ([[0, 1, 2]], {"weighting": "angle"}, "weighting: wanted one of uniform, area"),
    ],
)
def test_from_polygons_refuses(polygons, options, message):
    with pytest.raises(ValueError, match=message):
        dm.from_polygons(SQUARE, polygons, **options)


# ---------------------------------------------------------------------------- merge, transform


def test_merge_keeps_order_and_derivatives():
    a, b = dm.flat_shaded(cube()), dm.with_normals(Mesh(vertices=SQUARE, faces=[[0, 1, 2]]))
    both = dm.merge([a, b])
    np.testing.assert_array_equal(both.vertices[both.faces[-1]], SQUARE[:3])
    np.testing.assert_array_equal(both.normals[:36], a.normals)
    assert both.uvs is None
    with pytest.raises(ValueError, match="wanted normals on all or none of 2, got none on"):
        dm.merge([a, Mesh(vertices=SQUARE, faces=[[0, 1, 2]])])
    with pytest.raises(ValueError, match="at least one mesh"):
        dm.merge([])
    moved = jax.grad(lambda v: dm.merge([dataclasses.replace(a, vertices=v), b]).vertices.sum())
    np.testing.assert_array_equal(moved(a.vertices), np.ones((36, 3)))


@pytest.mark.parametrize("factors", [(1.0, 2.0, 3.0), (-1.0, 2.0, 3.0), (-1e-15, -1e-15, -1e-15)])
def test_transform_keeps_normals_perpendicular_and_outside_outside(factors):
    matrix = rotation_y(0.4) @ scaling(factors)
    moved = jax.jit(dm.transform)(dm.flat_shaded(cube()), matrix)
    unit = moved.vertices / np.abs(factors).max()
    np.testing.assert_allclose(
        dm.face_normals(unit, moved.faces), moved.normals[moved.faces[:, 0]], atol=1e-6
    )
    volume = dm.signed_volume(dataclasses.replace(moved, vertices=unit))
    want = 8 * np.prod(np.abs(factors) / np.abs(factors).max())
    np.testing.assert_allclose(volume, want, rtol=1e-5)


def test_transform_is_differentiable():
    mesh = dm.with_normals(Mesh(vertices=TETRAHEDRON, faces=TETRAHEDRON_FACES))
    matrix = np.asarray(rotation_y(0.3)) + 0.1 * np.arange(16).reshape(4, 4) / 16
    matrix[3] = [0, 0, 0, 1]

    @jax.jit
    def moved(matrix, vertices):
        out = dm.transform(dataclasses.replace(mesh, vertices=vertices), matrix)
        return out.vertices, out.normals

    with jax.enable_x64(True):
        wide = (matrix.astype(np.float64), TETRAHEDRON.astype(np.float64))
        check_grads(moved, wide, order=1, rtol=1e-5)


def test_near_vertices_merge_in_chains_and_keep_first_use_order():
    vertices = np.array([[9, 9, 9], [0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)
    jitter = np.array([[0.05, 0, 0], [0.1, 0, 0]])
    mesh = Mesh(
        vertices=np.concatenate([vertices, vertices[1] + jitter]),
        faces=[[3, 6, 2], [3, 2, 4], [1, 5, 2]],
        normals=np.tile([[0.0, 0, 1]], (7, 1)),
        uvs=np.arange(14).reshape(7, 2),
    )
    merged = dm.merge_near_vertices(mesh, 0.06)
    np.testing.assert_array_equal(merged.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(merged.vertices, vertices[[3, 1, 2, 4]])
    np.testing.assert_array_equal(merged.uvs, mesh.uvs[jnp.array([3, 1, 2, 4])])
    np.testing.assert_allclose(jnp.linalg.norm(merged.normals, axis=1), 1)
    assert dm.merge_near_vertices(mesh, 0.04).vertices.shape == (6, 3)
    with pytest.raises(ValueError, match="tolerance: wanted a distance of at least 0, got -1"):
        dm.merge_near_vertices(mesh, -1)


def test_merging_many_vertices_agrees_with_all_pairs():
    points = np.random.default_rng(5).uniform(size=(300, 3))
    label = np.arange(300)
    near = np.linalg.norm(points[:, None] - points, axis=2) <= 0.07
    for _ in range(300):
        label = np.where(near, label[None], 300).min(axis=1)
    np.testing.assert_array_equal(_topology.clusters(points, 0.07), label)


# ------------------------------------------------------------------------------------- topology


def edge_oracle(vertices, faces):
    """Undirected edges between positions → the faces that have them."""
    owners = {}
    for number, face in enumerate(faces):
        places = [tuple(vertices[i]) for i in face]
        if len(set(places)) == 3:
            for k in range(3):
                owners.setdefault(frozenset((places[k], places[k - 1])), []).append(number)
    return owners


@pytest.mark.parametrize("split", [False, True])
def test_edges_of_manifold_meshes(split):
    vertices, faces = grid(4)
    mesh = Mesh(vertices=vertices, faces=np.concatenate([faces, [[0, 0, 1]]]))
    if split:
        mesh = dm.flat_shaded(mesh)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    edges, edge_faces, opposite = dm.edge_adjacency(mesh.vertices, mesh.faces)
    oracle = edge_oracle(vertices, faces)
    assert len(edges) == len(oracle)
    for (start, end), pair, across in zip(edges, edge_faces, opposite, strict=True):
        key = frozenset((tuple(vertices[start]), tuple(vertices[end])))
        assert sorted(f for f in pair if f >= 0) == sorted(oracle[key])
        first = list(faces[pair[0]])
        place = first.index(start)
        assert first[(place + 1) % 3] == end
        assert first[(place + 2) % 3] == across[0]
        assert (pair[1] < 0) == (across[1] < 0)
        if pair[1] >= 0:
            assert across[1] in faces[pair[1]]
            assert tuple(vertices[across[1]]) not in key


def test_boundary_and_closedness():
    square = Mesh(vertices=SQUARE, faces=[[0, 1, 2], [0, 2, 3]])
    _, edge_faces, _ = dm.edge_adjacency(square.vertices, square.faces)
    assert (edge_faces[:, 1] < 0).sum() == 4
    assert dm.euler_characteristic(square) == 1
    assert not dm.is_closed(square)
    solid = cube()
    assert dm.is_closed(solid)
    assert dm.is_closed(dm.flat_shaded(solid))
    assert dm.euler_characteristic(dm.flat_shaded(solid)) == 2
    turned = dataclasses.replace(solid, faces=solid.faces.at[0].set(solid.faces[0, ::-1]))
    assert not dm.is_closed(turned)
    np.testing.assert_allclose(dm.signed_volume(solid), 8)


@pytest.mark.parametrize("turn", [0.0, 0.3])
@pytest.mark.parametrize("offset", [(2, 2, 0), (-2, 2, 0), (2, 0, 0)])
def test_edges_that_two_cubes_share_pair_faces_of_one_cube(offset, turn):
    two = dm.transform(dm.merge([cube(), cube(offset)]), rotation_y(turn))
    # Rotating breaks exact equality of positions: restore it.
    two = dm.merge_near_vertices(two, 1e-4)
    edges, edge_faces, _ = dm.edge_adjacency(two.vertices, two.faces)
    assert (edge_faces >= 0).all()
    assert len(edges) == 36
    assert (edge_faces[:, 0] // 12 == edge_faces[:, 1] // 12).all()


def test_topology_needs_known_positions():
    solid = cube()
    with pytest.raises(ValueError, match="wanted known vertices and faces, got traced"):
        jax.jit(lambda v: dm.edge_adjacency(v, solid.faces)[0])(solid.vertices)


def test_indices_that_jax_would_cut_off_are_out_of_range():
    wide = np.array([[2**32, 2**32 + 1, 2**32 + 2]])
    with pytest.raises(ValueError, match=r"faces: wanted indices in \[0, 3\), got 4294967296"):
        dm.Mesh(vertices=np.eye(3), faces=wide)
    large = dm.Mesh(vertices=np.array([[2**40, 0, 0], [0, 1, 0], [0, 0, 1]]), faces=[[0, 1, 2]])
    assert large.vertices[0, 0] == 2.0**40


def test_no_vertices_and_no_faces_left():
    assert len(dm.weld(np.zeros((0, 3)))) == 0
    with pytest.raises(ValueError, match="tolerance: wanted one that leaves a face, got 9"):
        dm.merge_near_vertices(cube(), 9)


def test_known_meshes_are_made_inside_of_jit():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])

    def meshes():
        uvs, uv_faces = np.zeros((3, 2)), [[0, 1, 2], [2, 1, 0]]
        made = dm.from_polygons(corners, [[0, 1, 2, 3]])
        with_uvs = Mesh(vertices=made.vertices, faces=made.faces, uvs=uvs, uv_faces=uv_faces)
        turned = dm.transform(made, compose(rotation_y(1), scaling(2), translation((0, 0, 1))))
        edited = turned, dm.with_normals(made), dm.flat_shaded(made), dm.merge([made, turned])
        assert all(mesh.topology is not None for mesh in edited)
        return made, dm.split_uvs(with_uvs), dm.merge_near_vertices(made, 1e-3), *edited

    for inside, outside in zip(jax.jit(meshes)(), meshes(), strict=True):
        assert jax.tree.structure(inside) == jax.tree.structure(outside)
        for one, other in zip(*map(jax.tree.leaves, (inside, outside)), strict=True):
            np.testing.assert_array_equal(one, other)
