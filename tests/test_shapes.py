from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from diffrast import mesh as dm
from diffrast import shapes

pytestmark = pytest.mark.usefixtures("compiled_quickly")

SOLIDS = {  # faces of the solid, corners of a face, corners of the solid, circumradius, volume
    shapes.tetrahedron: (4, 3, 4, np.sqrt(3), 8 / 3),
    shapes.cube: (6, 4, 8, np.sqrt(3), 8),
    shapes.octahedron: (8, 3, 6, 1, 4 / 3),
    shapes.icosahedron: (20, 3, 12, 1, np.sqrt(40 + 8 * np.sqrt(5)) / 3),
    shapes.dodecahedron: (12, 5, 20, 1, 2 * (5 + np.sqrt(5)) / np.sqrt(27)),
}
CLOSED = {
    "icosphere": (lambda: shapes.icosphere(2), 2),
    "uv_sphere": (lambda: shapes.uv_sphere(segments=5, rings=4), 2),
    "smallest uv_sphere": (lambda: shapes.uv_sphere(segments=3, rings=2), 2),
    "cylinder": (lambda: shapes.cylinder(segments=7, divisions=3), 2),
    "cone": (lambda: shapes.cone(segments=7), 2),
    "torus": (lambda: shapes.torus(major_segments=7, minor_segments=5), 0),
}


def smallest_angle_cosine(mesh):
    """Between the normals at a face's corners and the face's own; degenerate faces left out."""
    facets = np.asarray(dm.face_normals(mesh.vertices, mesh.faces))
    corners = np.asarray(mesh.normals)[np.asarray(mesh.faces)]
    return np.einsum("fc,fkc->fk", facets, corners)[facets.any(axis=1)].min()


# ---------------------------------------------------------------------------------------- solids


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: solid.__name__)
def test_solids_are_regular_centred_and_turned_outwards(solid):
    faces, sides, corners, circumradius, volume = SOLIDS[solid]
    mesh = solid(flat=False)
    vertices = np.asarray(mesh.vertices)
    assert mesh.normals is None
    assert vertices.shape == (corners, 3)
    assert mesh.faces.shape == (faces * (sides - 2), 3)
    assert dm.euler_characteristic(mesh) == 2
    assert dm.is_closed(mesh)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), circumradius, rtol=1e-6)
    np.testing.assert_allclose(vertices.mean(axis=0), 0, atol=1e-6)
    np.testing.assert_allclose(dm.signed_volume(mesh), volume, rtol=1e-6)
    normals = np.asarray(dm.face_normals(vertices, mesh.faces))
    assert (np.einsum("fc,fc->f", normals, vertices[mesh.faces[:, 0]]) > 0.3).all()
    # The solid's own edges are those where two planes meet; all are equally long.
    edges, pairs, _ = dm.edge_adjacency(vertices, mesh.faces)
    bent = np.sum(normals[pairs[:, 0]] * normals[pairs[:, 1]], axis=1) < 0.999
    assert bent.sum() == faces * sides // 2
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)[bent]
    np.testing.assert_allclose(lengths, lengths[0], rtol=1e-6)


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: solid.__name__)
def test_flat_solids_have_the_normals_of_their_faces(solid):
    flat, joined = solid(), solid(flat=False)
    assert flat.vertices.shape == (3 * len(flat.faces), 3)
    np.testing.assert_allclose(smallest_angle_cosine(flat), 1, rtol=1e-6)
    for mesh in (flat, joined):
        assert dm.is_closed(mesh)
        assert dm.euler_characteristic(mesh) == 2
        assert len(dm.edge_adjacency(mesh.vertices, mesh.faces).edges) == 3 * len(mesh.faces) // 2


def test_buckyball_has_equal_edges_pentagons_and_hexagons():
    mesh = shapes.buckyball(flat=False)
    vertices = np.asarray(mesh.vertices)
    assert vertices.shape == (60, 3)
    assert mesh.faces.shape == (12 * 3 + 20 * 4, 3)
    assert dm.is_closed(mesh)
    assert dm.euler_characteristic(mesh) == 2
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1, rtol=1e-6)
    normals = np.asarray(dm.face_normals(vertices, mesh.faces))
    assert (np.einsum("fc,fc->f", normals, vertices[mesh.faces[:, 0]]) > 0.8).all()
    edges, pairs, _ = dm.edge_adjacency(vertices, mesh.faces)
    bent = np.sum(normals[pairs[:, 0]] * normals[pairs[:, 1]], axis=1) < 0.999
    assert bent.sum() == 90
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)[bent]
    np.testing.assert_allclose(lengths, lengths[0], rtol=1e-5)
    assert (np.bincount(edges[bent].reshape(-1)) == 3).all()
    volume = (125 + 43 * np.sqrt(5)) / 4 * lengths[0] ** 3
    np.testing.assert_allclose(dm.signed_volume(mesh), volume, rtol=1e-5)
    assert shapes.buckyball().vertices.shape == (3 * 116, 3)


# -------------------------------------------------------------------------------------- fractals


@pytest.mark.parametrize(
    ("solid", "corners", "scale"),
    [
        (shapes.cube, 8, 3),
        (shapes.tetrahedron, 4, 2),
        (shapes.octahedron, 6, 2),
        (shapes.dodecahedron, 20, 2 + (1 + np.sqrt(5)) / 2),
        (shapes.icosahedron, 12, 3),
        (shapes.buckyball, 60, 1 + 3 * (1 + np.sqrt(5)) / 2),
    ],
)
def test_fractals_have_a_copy_at_every_corner(solid, corners, scale):
    one, joined = solid(), solid(flat=False)
    steps = 2 if corners < 60 else 1
    copies = corners**steps
    mesh = shapes.fractal(joined, steps, scale)
    assert shapes.fractal(one, 1, scale).faces.shape[0] == corners * one.faces.shape[0]
    assert mesh.faces.shape[0] == copies * one.faces.shape[0]
    volume = dm.signed_volume(one) * copies / scale ** (3 * steps)
    np.testing.assert_allclose(dm.signed_volume(mesh), volume, rtol=1e-4)
    # The j-th corner of the j-th copy is where the large solid, round their middle, has it.
    last = np.arange(corners)
    points = np.asarray(mesh.vertices).reshape(copies // corners, corners, corners, 3)
    large = np.asarray(joined.vertices) / scale ** (steps - 1)
    want = points.mean(axis=(1, 2))[:, None] + large
    np.testing.assert_allclose(points[:, last, last], want, atol=1e-5)
    assert shapes.fractal(one, 0, scale).faces.shape == one.faces.shape


@pytest.mark.parametrize("spare", [0, 3])
def test_fractals_keep_uvs_with_their_own_indices(spare):
    uvs = np.concatenate([[(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)], np.ones((spare, 2))])
    solid = shapes.tetrahedron(flat=False)
    own = dm.Mesh(
        vertices=solid.vertices,
        faces=solid.faces,
        uvs=uvs,
        uv_faces=[(0, 1, 2), (1, 2, 3), (2, 3, 0), (3, 1, 0)],
    )
    mesh = shapes.fractal(own, 2, 2.0)
    want = np.tile(uvs[np.asarray(own.uv_faces)], (16, 1, 1))
    np.testing.assert_array_equal(mesh.uvs[mesh.uv_faces], want)


def test_fractals_are_differentiable_in_their_scale():
    cube = shapes.cube(flat=False)
    slope = jax.jacfwd(lambda scale: shapes.fractal(cube, 1, scale).vertices)(2.5)
    # v_j (1 - 1/s) + v_k / s
    corners = np.asarray(cube.vertices)
    want = (corners[:, None] - corners[None]) / 2.5**2
    np.testing.assert_allclose(slope, want.reshape(-1, 3), atol=1e-6)


def test_menger_sponge_has_its_cubes_and_its_surface():
    for level in range(4):
        mesh = shapes.menger_sponge(level, flat=False)
        assert mesh.faces.shape[0] == 4 * 20**level + 8 * 8**level
        assert dm.is_closed(mesh)
        np.testing.assert_allclose(dm.signed_volume(mesh), 8 * (20 / 27) ** level, rtol=1e-4)
        vertices = np.asarray(mesh.vertices)
        np.testing.assert_allclose([vertices.min(), vertices.max()], [-1, 1])
    assert dm.euler_characteristic(shapes.menger_sponge(1, flat=False)) == 2 - 2 * 5
    whole = shapes.menger_sponge(2, interior=True, flat=False)
    assert whole.faces.shape[0] == 12 * 400
    np.testing.assert_allclose(dm.signed_volume(whole), 8 * (20 / 27) ** 2, rtol=1e-4)
    flat = shapes.menger_sponge(1)
    np.testing.assert_allclose(smallest_angle_cosine(flat), 1, rtol=1e-6)


# ---------------------------------------------------------------------------------------- curved


@pytest.mark.parametrize("name", CLOSED)
def test_closed_surfaces_are_closed_and_have_unit_normals_outwards(name):
    make, characteristic = CLOSED[name]
    mesh = make()
    assert dm.is_closed(mesh)
    assert dm.euler_characteristic(mesh) == characteristic
    assert dm.signed_volume(mesh) > 0.5
    np.testing.assert_allclose(jnp.linalg.norm(mesh.normals, axis=1), 1, rtol=1e-6)
    assert smallest_angle_cosine(mesh) > 0.4
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)
    assert (dm.face_areas(mesh.vertices, mesh.faces) > 0).all()
    if mesh.uvs is not None:
        assert mesh.uvs.min() >= 0
        assert mesh.uvs.max() <= 1


@pytest.mark.parametrize("level", [0, 1, 3])
def test_icosphere_has_its_count_of_faces_and_exact_normals(level):
    mesh = shapes.icosphere(level, 2.5)
    assert mesh.faces.shape == (20 * 4**level, 3)
    assert mesh.vertices.shape == (10 * 4**level + 2, 3)
    np.testing.assert_allclose(mesh.vertices, 2.5 * mesh.normals, rtol=1e-6)


def test_finer_surfaces_approach_their_volumes_quadratically():
    exact = {
        "icosphere": (lambda n: shapes.icosphere(n), 4 / 3 * np.pi),
        "uv_sphere": (lambda n: shapes.uv_sphere(segments=2**n * 6, rings=2**n * 3), 4 / 3 * np.pi),
        "cylinder": (lambda n: shapes.cylinder(0.5, 3.0, segments=2**n * 5), 0.75 * np.pi),
        "cone": (lambda n: shapes.cone(0.5, 3.0, segments=2**n * 5), 0.25 * np.pi),
        "torus": (
            lambda n: shapes.torus(2.0, 0.5, major_segments=2**n * 6, minor_segments=2**n * 3),
            2 * np.pi**2 * 2 * 0.25,
        ),
    }
    for name, (make, volume) in exact.items():
        errors = [1 - float(dm.signed_volume(make(n))) / volume for n in (1, 2)]
        assert 0 < errors[1] < errors[0] < 0.3, name
        assert 3.5 < errors[0] / errors[1] < 4.6, name


def test_normals_of_curved_sides_are_exact():
    cylinder = shapes.cylinder(2.0, 3.0, segments=8, divisions=2)
    side = cylinder.normals[:, 2] == 0
    assert side.sum() == 27
    np.testing.assert_allclose(
        cylinder.normals[side], cylinder.vertices[side] * jnp.array([0.5, 0.5, 0]), atol=1e-6
    )
    caps = cylinder.vertices[~side]
    np.testing.assert_array_equal(cylinder.normals[~side][:, 2], jnp.sign(caps[:, 2]))
    cone = shapes.cone(2.0, 3.0, segments=8)
    side = cone.normals[:, 2] > 0
    assert side.sum() == 17
    np.testing.assert_allclose(cone.normals[side][:, 2], 2 / np.sqrt(13), rtol=1e-6)
    np.testing.assert_array_equal(cone.normals[~side], np.tile([0, 0, -1], (9, 1)))
    torus = shapes.torus(2.0, 0.5, major_segments=6, minor_segments=5)
    middle = torus.vertices - 0.5 * torus.normals
    np.testing.assert_allclose(jnp.linalg.norm(middle, axis=1), 2, rtol=1e-6)
    np.testing.assert_allclose(middle[:, 2], 0, atol=1e-6)


def test_open_forms_leave_out_the_caps():
    assert shapes.cylinder(segments=5, caps=False).faces.shape == (10, 3)
    assert shapes.cone(segments=5, caps=False).faces.shape == (5, 3)


def test_plane_faces_up_and_carries_its_texture():
    mesh = shapes.plane(4.0, 2.0, divisions=(2, 3))
    assert mesh.faces.shape == (12, 3)
    np.testing.assert_allclose(dm.face_normals(mesh.vertices, mesh.faces)[:, 2], 1)
    np.testing.assert_allclose(
        mesh.vertices[:, :2], (mesh.uvs - 0.5) * jnp.array([4, 2]), atol=1e-6
    )
    np.testing.assert_allclose(dm.face_areas(mesh.vertices, mesh.faces).sum(), 8, rtol=1e-6)


def test_uvs_run_once_round_the_axis():
    for mesh in (shapes.uv_sphere(), shapes.cylinder(caps=False), shapes.torus()):
        angle = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0]) / (2 * np.pi)
        radius = np.linalg.norm(mesh.vertices[:, :2], axis=1)
        turns = (np.asarray(mesh.uvs[:, 0]) - angle)[radius > 1e-3]
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-5)


def test_height_field_lies_like_an_image():
    heights = np.random.default_rng(2).normal(size=(3, 5))
    mesh = shapes.height_field(heights, 4.0, 2.0)
    assert mesh.faces.shape == (16, 3)
    np.testing.assert_allclose(mesh.vertices[:, 2], heights.reshape(-1), rtol=1e-6)
    np.testing.assert_allclose(mesh.vertices[0, :2], [-2, 1])
    np.testing.assert_allclose(mesh.vertices[-1, :2], [2, -1])
    np.testing.assert_allclose(mesh.uvs[0], [0, 1])
    assert (dm.face_normals(mesh.vertices, mesh.faces)[:, 2] > 0).all()
    assert (mesh.normals[:, 2] > 0).all()
    x, y = np.meshgrid(np.linspace(-1, 1, 4), np.linspace(1, -1, 4))
    slope = shapes.height_field(0.5 * x + 0.25 * y).normals
    want = np.array([-0.5, -0.25, 1])
    np.testing.assert_allclose(slope, np.tile(want / np.linalg.norm(want), (16, 1)), atol=1e-6)


def test_sizes_and_heights_are_differentiable():
    def leaves(mesh):
        return mesh.vertices, mesh.normals

    @jax.jit
    def everything(size, heights):
        return [
            leaves(shapes.uv_sphere(size[0], segments=3, rings=3)),
            leaves(shapes.cone(size[0], size[1], segments=3)),
            leaves(shapes.torus(size[1], size[0], major_segments=3, minor_segments=3)),
            leaves(shapes.height_field(heights, size[0], size[1])),
        ]

    heights = np.random.default_rng(2).normal(size=(3, 3))
    with jax.enable_x64(True):
        check_grads(everything, (np.array([0.7, 1.3]), heights), order=1, rtol=1e-5)
    tiny = shapes.cone(1e-20, 3e-20, segments=5)
    np.testing.assert_allclose(tiny.normals, shapes.cone(1.0, 3.0, segments=5).normals, atol=1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: shapes.menger_sponge(6), "level: wanted at most 16777216 faces"),
        (lambda: shapes.fractal(shapes.cube(), 9), "iterations: wanted at most 16777216 faces"),
        (lambda: shapes.fractal(shapes.cube(), 1, 1.0), "scale: wanted a number between 1"),
        (lambda: shapes.icosphere(-1), "subdivisions: wanted an integer of at least 0, got -1"),
        (lambda: shapes.icosphere(1, 0.0), "radius: wanted a number between 0 and inf, got 0"),
        (lambda: shapes.uv_sphere(segments=2), "segments: wanted an integer of at least 3"),
        (lambda: shapes.uv_sphere(rings=1), "rings: wanted an integer of at least 2"),
        (lambda: shapes.cylinder(height=-1.0), "height: wanted a number between 0"),
        (lambda: shapes.torus(minor_radius=float("nan")), "minor_radius: wanted finite"),
        (lambda: shapes.plane(divisions=(1, 0)), "divisions: wanted an integer of at least 1"),
        (lambda: shapes.height_field(np.zeros((1, 4))), "heights: wanted at least 2 rows"),
        (lambda: shapes.height_field(np.zeros(4)), r"heights: wanted shape \(rows, columns\)"),
    ],
)
def test_shapes_refuse(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_shapes_of_known_sizes_are_known_inside_of_jit():
    """Their edges, too: else these are found at every call, and each corner gets a copy."""
    makers = [shapes.cube, shapes.tetrahedron, shapes.octahedron, shapes.icosahedron]
    makers += [shapes.dodecahedron, shapes.buckyball, shapes.plane, shapes.uv_sphere]
    makers += [shapes.cylinder, shapes.cone, shapes.torus, partial(shapes.icosphere, 1)]
    makers += [partial(shapes.height_field, np.eye(3)), partial(shapes.menger_sponge, 1)]
    makers += [lambda: shapes.fractal(shapes.cube(), 1), partial(shapes.teapot, 2)]

    def all_of_them():
        meshes = [make() for make in makers]
        assert all(mesh.topology is not None for mesh in meshes)
        return meshes

    inside, outside = jax.jit(all_of_them)(), all_of_them()
    assert jax.tree.structure(inside) == jax.tree.structure(outside)
    jax.tree.map(np.testing.assert_array_equal, inside, outside)
    traced = jax.jit(lambda size: shapes.plane(size).vertices)(2.0)
    np.testing.assert_array_equal(traced, shapes.plane().vertices)
