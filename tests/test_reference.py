"""The oracle against closed forms."""

import numpy as np
import pytest
import reference
from box_filter import pixel_weights, render_box
from box_shadow import Runs, Shadow, apart, facing

FOV = 0.9
EYE = (0.0, 0.0, 4.0)
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
WHITE = {"ambient": (1, 1, 1), "diffuse": (1, 1, 1), "specular": (1, 1, 1), "shininess": 8.0}


def to_clip(positions, view=None, projection=None):
    view = reference.look_at(EYE, (0, 0, 0), (0, 1, 0)) if view is None else view
    projection = reference.perspective(FOV, 1.0, 0.1, 100) if projection is None else projection
    return np.pad(positions, ((0, 0), (0, 1)), constant_values=1.0) @ (projection @ view).T


def render_square(lights, material=WHITE, normals=None, **options):
    normals = np.tile([0.0, 0, 1], (4, 1)) if normals is None else normals
    view = reference.look_at(EYE, (0, 0, 0), (0, 1, 0))
    projection = reference.perspective(FOV, 1.0, 0.1, 100)
    return reference.render_phong(
        SQUARE, normals, SQUARE_FACES, view, projection, lights=lights, material=material,
        **{"height": 8, "width": 8, "samples": 1} | options,
    )  # fmt: skip


def sphere(rings=48, segments=96):
    polar = np.linspace(0, np.pi, rings + 1)[:, None]
    around = np.linspace(0, 2 * np.pi, segments + 1)
    xyz = np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0 * around
    a = (np.arange(rings)[:, None] * (segments + 1) + np.arange(segments)).ravel()
    below = a + segments + 1
    faces = [np.stack([a, below, below + 1], 1), np.stack([a, below + 1, a + 1], 1)]
    return np.stack(xyz, axis=-1).reshape(-1, 3), np.concatenate(faces)


def test_area_of_a_projected_square():
    fragments = reference.rasterize(to_clip(SQUARE), SQUARE_FACES, 20, 20, samples=32)
    side = 1 / (4 * np.tan(FOV / 2))  # half a side at distance 4, in NDC
    assert np.mean(fragments.face >= 0) == pytest.approx(side**2, abs=4 / 640)
    np.testing.assert_allclose(fragments.inverse_depth[fragments.face >= 0], 1 / 4)
    np.testing.assert_allclose(fragments.barycentrics.sum(-1), fragments.face >= 0, atol=1e-12)


def test_pixel_centres_and_row_order():
    clip = np.array([[-1, 1, 0, 1], [-1, 0.5, 0, 1], [-0.5, 1, 0, 1]])  # NDC: the upper left corner
    fragments = reference.rasterize(clip, [[0, 1, 2]], 8, 4)
    assert np.argwhere(fragments.face == 0).tolist() == [[0, 0]]
    # Pixel (0, 0) of 8 x 4: x_ndc = -3/4, y_ndc = 7/8.
    np.testing.assert_allclose(fragments.barycentrics[0, 0], [0.25, 0.25, 0.5])
    moved = reference.rasterize(clip, [[0, 1, 2]], 8, 4, offset=(0.0, 1.0))
    np.testing.assert_allclose(moved.barycentrics[0, 0], [0.5, 0.5, 0.0])


def test_silhouette_of_a_sphere():
    vertices, faces = sphere()
    clip = to_clip(vertices)
    seen = [reference.rasterize(clip, faces, 64, 64, cull, samples=4).face for cull in (0, 1)]
    np.testing.assert_array_equal(*seen)  # on a closed surface back faces change nothing
    radius = np.tan(np.arcsin(1 / 4)) / np.tan(FOV / 2) * 32
    assert np.sqrt(np.sum(seen[0] >= 0) / 16 / np.pi) == pytest.approx(radius, rel=2e-3)


def test_perspective_correct_midpoint():
    near_w, far_w = 1.0, 3.0
    ndc = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    w = np.array([near_w, far_w, far_w, near_w])[:, None]
    clip = np.hstack([ndc * w, 0 * w, w])
    fragments = reference.rasterize(clip, SQUARE_FACES, 3, 3)
    # Halfway on the screen, 1/w is the mean, and the far side has weight (1/3) / (1 + 1/3).
    assert fragments.inverse_depth[1, 1] == pytest.approx((1 / near_w + 1 / far_w) / 2)
    corners = SQUARE_FACES[fragments.face[1, 1]]
    assert fragments.barycentrics[1, 1] @ (ndc[corners, 0] > 0) == pytest.approx(1 / 4)


def test_plane_that_passes_behind_the_viewer():
    ground = np.array([[-500, -1, 600], [500, -1, 600], [0, -1, -900]], float)
    clip = to_clip(ground, view=np.eye(4), projection=reference.perspective(FOV, 1.0, 0.1, 1e4))
    assert np.any(clip[:, 3] < 0)
    fragments = reference.rasterize(clip, [[0, 1, 2]], 16, 16)
    y_ndc = 1 - 2 * (np.arange(16) + 0.5) / 16
    expected = np.maximum(-y_ndc, 0) * np.tan(FOV / 2)  # 1/w = slope of the ray / height
    np.testing.assert_array_equal(fragments.face >= 0, np.tile(expected[:, None] > 0, (1, 16)))
    np.testing.assert_allclose(fragments.inverse_depth, np.tile(expected[:, None], (1, 16)))


@pytest.mark.parametrize("parallel", [False, True])
def test_piercing_triangles(parallel):
    # Two planes z = +- x / 2 cross at x = 0; to the left one is nearer, to the right the other.
    projection = reference.orthographic(2, 1.0, 0.1, 10) if parallel else None
    slope = SQUARE * [3, 3, 0] + np.outer(SQUARE[:, 0] * 1.5, [0, 0, 1])
    both = np.concatenate([slope, slope * [1, 1, -1]])
    faces = np.concatenate([SQUARE_FACES, SQUARE_FACES + 4])
    fragments = reference.rasterize(to_clip(both, projection=projection), faces, 10, 10)
    np.testing.assert_array_equal(fragments.face[:, :5] >= 2, True)
    np.testing.assert_array_equal(fragments.face[:, 5:] < 2, True)
    assert np.all(fragments.face[:, 5:] >= 0)
    x = 1 / 10  # NDC of the pixels right of the crossing
    if parallel:  # two surfaces x apart, of a depth range of 9.9
        expected = x / 9.9
    else:  # x_world = x tan (4 - z), z = +- x_world / 2, inverse depths 1 / (4 - z)
        half = x * np.tan(FOV / 2) / 2
        expected = 1 - (1 - half) / (1 + half)
    np.testing.assert_allclose(fragments.depth_gap[:, 5], expected)


def test_near_and_far_plane_cut_per_sample():
    wall = np.array([[-1, -9, 2], [-1, 9, 2], [-1, 9, -50], [-1, -9, -50]], float)  # x = -1
    projection = reference.perspective(np.pi / 2, 1.0, 2.0, 8.0)
    clip = to_clip(wall, view=np.eye(4), projection=projection)
    fragments = reference.rasterize(clip, SQUARE_FACES, 2, 200)
    x_ndc = 2 * (np.arange(200) + 0.5) / 200 - 1
    np.testing.assert_array_equal(fragments.face[0] >= 0, (x_ndc > -1 / 2) & (x_ndc < -1 / 8))
    # The planes cut the wall at the pixel borders x = 50 and 87.5.
    np.testing.assert_allclose(
        fragments.edge_distance[0, [49, 50, 51, 87]], [0.5, 0.5, 1, 0], atol=1e-12
    )


def test_edge_distance():
    clip = np.array([[-1, -1, 0, 1], [0.5, -1, 0, 1], [0.5, 0.5, 0, 1]], np.float32)
    distance = reference.edge_distance(clip, [[0, 1, 2]], 8, 8, reach=20.0)
    centers = np.stack(np.meshgrid(np.arange(8) + 0.5, np.arange(8) + 0.5), axis=-1)
    corners = np.array([(0, 8), (6, 8), (6, 2)], float)
    along = np.linspace(0, 1, 2001)[:, None]
    outline = [c + along * (d - c) for c, d in zip(corners, np.roll(corners, -1, 0), strict=True)]
    away = np.linalg.norm(centers[:, :, None] - np.concatenate(outline), axis=-1).min(axis=-1)
    np.testing.assert_allclose(distance, away, atol=2e-3)
    capped = reference.rasterize(clip, [[0, 1, 2]], 8, 8).edge_distance
    np.testing.assert_allclose(capped, np.minimum(distance, 1))


def test_edge_that_crosses_w_zero():
    # The edge from (0, -1, -1) to (0, -1, 1) is seen below the viewer from the horizon downwards.
    ground = np.array([[0, -1, -2], [0, -1, 2], [5, -1, 0]], float)
    projection = reference.perspective(np.pi / 2, 1.0, 0.5, 100)
    clip = to_clip(ground, view=np.eye(4), projection=projection)
    distance = reference.edge_distance(clip, [[0, 1, 2]], 16, 16, reach=3.0)
    # It ends at y_ndc = -1/2, row 12; a perpendicular of one pixel from columns 6 and 9.
    np.testing.assert_allclose(distance[13:, [7, 8]], 0.5)
    np.testing.assert_allclose(distance[9, 7], np.hypot(0.5, 2.5))


def test_culling_and_scale():
    clip = to_clip(SQUARE)
    reversed_faces = SQUARE_FACES[:, ::-1]
    seen = reference.rasterize(clip, SQUARE_FACES, 9, 8, cull_backfaces=True)
    assert np.all(reference.rasterize(clip, reversed_faces, 9, 8, cull_backfaces=True).face == -1)
    assert np.any(reference.rasterize(clip, reversed_faces, 9, 8).face >= 0)
    for scale in (1e-20, 1e20):
        scaled = reference.rasterize(clip * scale, SQUARE_FACES, 9, 8)
        np.testing.assert_array_equal(scaled.face, seen.face)
        np.testing.assert_allclose(scaled.inverse_depth * scale, seen.inverse_depth)
    nothing = reference.rasterize(clip, np.zeros((0, 3), int), 9, 8)
    assert np.all(nothing.face == -1)
    assert np.all(nothing.depth_gap == np.inf)


def test_exact_ownership_of_shared_edges():
    # A fan of eight faces round the middle; its diagonals run through pixel centres.
    around = [(2, 0), (2, 2), (0, 2), (-2, 2), (-2, 0), (-2, -2), (0, -2), (2, -2)]
    positions = np.array([(0.0, 0.0), *around]) / 4
    clip = np.hstack([positions, np.tile([0.0, 1.0], (9, 1))]).astype(np.float32)
    faces = np.array([[0, k, k % 8 + 1] for k in range(1, 9)])
    owned = reference.exact_owned(clip, faces, 8, 8)
    location = reference.exact_location(clip, faces, 8, 8)
    interior = np.zeros((8, 8), bool)
    interior[2:6, 2:6] = True
    np.testing.assert_array_equal(owned.sum(0), interior)
    assert np.all(owned <= (location >= 0))
    np.testing.assert_array_equal(reference.exact_owned(clip, faces[:, ::-1], 8, 8), owned)
    assert not np.any(reference.exact_owned(clip, [[0, 0, 1]], 8, 8))


def test_exact_top_left_rule():
    # A square with its corners on the pixel centres 1 and 3 owns its left and top edges only.
    low, high = 2 * 1.5 / 8 - 1, 2 * 3.5 / 8 - 1
    corners = [(low, -high), (high, -high), (high, -low), (low, -low)]
    clip = np.array([(*corner, 0, 1) for corner in corners])
    owned = reference.exact_owned(clip, SQUARE_FACES, 8, 8)
    assert np.argwhere(owned.any(0)).tolist() == [[1, 1], [1, 2], [2, 1], [2, 2]]
    assert not np.any(owned.all(0))
    location = reference.exact_location(clip, SQUARE_FACES, 8, 8).max(axis=0)
    assert np.sum(location == 0) == 9  # the outline and the diagonal


def test_exact_agrees_with_float_off_the_edges():
    clip = np.random.default_rng(0).uniform(-1, 1, (4, 3, 4)).astype(np.float32)
    clip[..., 2] = 0  # some w are negative
    for corners in clip:
        fragments = reference.rasterize(corners, [[0, 1, 2]], 12, 12)
        location = reference.exact_location(corners, [[0, 1, 2]], 12, 12)[0]
        np.testing.assert_array_equal(fragments.face == 0, location == 1)


def test_cameras_look_back_at_the_viewer():
    view = reference.look_at((1, 2, 3), (0, 0.5, 0), (0, 1, 0))
    points = np.array([[0.3, 0.1, 0.2], [5, 5, -5]])
    to_eye = reference.towards_viewer(reference.perspective(0.8, 1.5, 0.1, 9) @ view, points)
    np.testing.assert_allclose(to_eye, reference.normalize(np.array([1, 2, 3]) - points))
    back = reference.normalize(np.array([1, 1.5, 3]))
    parallel = reference.towards_viewer(reference.orthographic(3, 1.5, 0.1, 9) @ view, points)
    np.testing.assert_allclose(parallel, [back, back])
    center = to_clip(np.array([[0, 0.5, 0]]), view, reference.orthographic(3, 1.5, 0.1, 9))
    np.testing.assert_allclose(center[0, :2], 0, atol=1e-15)


@pytest.mark.parametrize("shading", ["phong", "gouraud", "flat"])
def test_lambert_square(shading):
    light = {"type": "directional", "direction": (0, -3, -4), "ambient": (0.1, 0, 0),
             "diffuse": (0.5, 1, 2)}  # fmt: skip
    skylight = {"type": "ambient", "ambient": (0, 0, 0.3)}
    material = WHITE | {"ambient": (0.5, 1, 1), "diffuse": (1, 0.5, 0.25)}
    image = render_square([light, skylight], material, shading=shading, background=(7, 8, 9))
    np.testing.assert_allclose(image[4, 4], [0.05 + 0.5 * 0.8, 0.5 * 0.8, 0.3 + 0.5 * 0.8])
    np.testing.assert_array_equal(image[0, 0], [7, 8, 9])
    behind = render_square([light | {"direction": (0, 0, 1)}], shading=shading)
    np.testing.assert_allclose(behind[4, 4], [0.1, 0, 0])


def test_highlights_and_point_light():
    points, normals = np.zeros((1, 3)), np.array([[0.0, 0, 1]])
    to_viewer = np.array([[0, 0.6, 0.8]])
    light = {"type": "point", "position": (0, 0, 5), "specular": (1, 1, 1)}
    phong = reference.shade(points, normals, to_viewer, [light], WHITE)
    blinn = reference.shade(points, normals, to_viewer, [light], WHITE, "blinn")
    np.testing.assert_allclose(phong, 0.8**8)  # r = n
    np.testing.assert_allclose(blinn, (1.8 / np.sqrt(0.6**2 + 1.8**2)) ** 8)  # n . h
    below = light | {"position": (0, 1, -1e-9)}
    np.testing.assert_array_equal(reference.shade(points, normals, to_viewer, [below], WHITE), 0)
    slanted = light | {"position": (0, 4, 3), "diffuse": (1, 1, 1), "specular": (0, 0, 0)}
    np.testing.assert_allclose(reference.shade(points, normals, to_viewer, [slanted], WHITE), 0.6)


def test_interpolated_normals_and_colours():
    outward = reference.normalize(SQUARE + np.array([0, 0, 1]))
    light = {"type": "directional", "direction": (0, 0, -1), "diffuse": (1, 1, 1)}
    phong = render_square([light], normals=outward, shading="phong", height=9, width=9)
    gouraud = render_square([light], normals=outward, shading="gouraud", height=9, width=9)
    flat = render_square([light], normals=outward, shading="flat", height=9, width=9)
    np.testing.assert_allclose(phong[4, 4], 1)
    np.testing.assert_allclose(gouraud[4, 4], 1 / np.sqrt(3))
    np.testing.assert_allclose(flat[4, 4], 1)


def test_materials_by_face_and_box_filter():
    colors = np.array([[1.0, 0, 0], [0, 0, 1]])
    material = WHITE | {"ambient": colors, "shininess": np.array([1.0, 2.0])}
    lights = [{"type": "ambient", "ambient": (1, 1, 1)}]
    fine = render_square(lights, material, height=32, width=32)
    np.testing.assert_allclose(fine[20, 18], colors[0])
    np.testing.assert_allclose(fine[12, 14], colors[1])
    filtered = render_square(lights, material, samples=4)
    np.testing.assert_allclose(filtered, fine.reshape(8, 4, 8, 4, 3).mean(axis=(1, 3)))


def test_bands_do_not_show(monkeypatch):
    lights = [{"type": "ambient", "ambient": (1, 1, 1)}]
    whole = render_square(lights, samples=3)
    monkeypatch.setattr(reference, "SAMPLES_AT_ONCE", 100)
    np.testing.assert_array_equal(render_square(lights, samples=3), whole)


# Hard shadows under the box filter.

SHADOW_COLORS = {
    "ambient": (0.1, 0.1, 0.2),
    "diffuse": (0.7, 0.6, 0.5),
    "specular": (0.3, 0.3, 0.3),
}
ABOVE = {"position": (2.2, 2.5, 1.0), "direction": (-2.2, -3.2, -1.3), "cutoff": 0.6}
CASTING = {
    "directional": {"type": "directional", "direction": (-0.8, -1.0, 0.3)},
    "point": {"type": "point", "position": ABOVE["position"]},
    "spot": {"type": "spot", **ABOVE},
}


def ball_over_floor():
    """Positions, normals, faces and camera of a coarse ball above a square, slightly tilted."""
    ball, ball_faces = sphere(5, 8)
    floor = (SQUARE * 2.5)[:, [0, 2, 1]] * [1, 1, -1] + np.array([0, -1, 0])
    positions = np.concatenate([0.6 * ball, floor + 0.1 * floor[:, :1] * [0, 1, 0]])
    normals = np.concatenate([ball, np.tile(reference.normalize(np.array([-0.1, 1, 0])), (4, 1))])
    faces = np.concatenate([ball_faces, SQUARE_FACES + len(ball)])
    view = reference.look_at((1.5, 2.5, 4.5), (0, -0.4, 0), (0.1, 1, 0))
    return positions, normals, faces, view, reference.perspective(0.7, 1.0, 0.1, 50)


def sampled(lights, samples, shading, size=48):
    """What `samples` x `samples` rays a pixel see, each lit or not as `reference.lit` says."""
    positions, normals, faces, view, projection = ball_over_floor()
    clip = to_clip(positions, view, projection)
    fragments = reference.rasterize(clip, faces, size, size, samples=samples)
    seen = fragments.face >= 0
    face, barycentrics = fragments.face[seen], fragments.barycentrics[seen]
    points, normal = (
        np.einsum("nk,nkc->nc", barycentrics, values[faces[face]])
        for values in (positions, normals)
    )
    if shading == "flat":
        a, b, c = np.moveaxis(positions[faces[face]], 1, 0)
        normal = np.cross(b - a, c - a)
    normal = reference.normalize(normal)
    to_viewer = reference.towards_viewer(projection @ view, points)
    everywhere, casting = apart(lights)
    color = reference.shade(points, normal, to_viewer, everywhere, WHITE)
    for light in casting:
        lit = reference.lit(light, points, face, normal, positions, faces)
        color += lit[:, None] * reference.shade(points, normal, to_viewer, [light], WHITE)
    image = np.full((*seen.shape, 3), 0.3)
    image[seen] = color
    return image.reshape(size, samples, size, samples, 3).mean(axis=(1, 3))


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize(
    ("kinds", "shading"), [(["directional", "point"], "phong"), (["spot"], "flat")]
)
def test_box_filtered_shadows_equal_rays(kinds, shading, upright):
    positions, normals, faces, view, projection = ball_over_floor()
    lights = [CASTING[kind] | SHADOW_COLORS | {"shadow": True} for kind in kinds]
    plain = [light | {"shadow": False} for light in lights]
    lights.append({"type": "ambient", "ambient": (0.1, 0.2, 0.1)})

    def box(lights):
        return render_box(
            positions, normals, faces, view, projection, lights=lights, material=WHITE,
            background=(0.3, 0.3, 0.3), height=48, width=48, lines=16, shading=shading,
            upright=upright,
        )  # fmt: skip

    image = box(lights)
    errors = [np.abs(image - sampled(lights, samples, shading)) for samples in (3, 9)]
    assert np.mean(np.abs(image - box([*plain, lights[-1]]))) > 0.02
    assert errors[1].max() < 0.05
    assert errors[1].mean() < 0.0005
    assert errors[1].mean() < errors[0].mean() / 3


@pytest.mark.parametrize("kind", CASTING)
def test_lit_parts_of_lines_equal_rays(kind):
    light, size, tiny = CASTING[kind], 150, 1e-7
    positions, _, faces, view, projection = ball_over_floor()
    clip = to_clip(positions, view, projection)
    fragments = reference.rasterize(clip, faces, size, size, offset=(0.31, 0.77))
    seen = fragments.face >= 0
    face, barycentrics = fragments.face[seen], fragments.barycentrics[seen]
    points = np.einsum("nk,nkc->nc", barycentrics, positions[faces[face]])
    row, column = np.nonzero(seen)
    runs = Runs(row, column + 0.31 - tiny, column + 0.31 + tiny, face)
    weights = pixel_weights(clip[faces], size, size)
    found = Shadow(light, positions[faces], weights, np.arange(size) + 0.77).lit(runs)
    got = np.zeros(seen.shape, bool)
    got[found.line, found.start.astype(int)] = True

    a, b, c = np.moveaxis(positions[faces[face]], 1, 0)
    normal = np.cross(b - a, c - a)
    got = got[seen] & facing(light, positions[faces], face, normal)
    if kind == "spot":
        to_light = reference.normalize(np.array(light["position"]) - points)
        got &= reference.spot_fade(light, to_light) > 0
    want = reference.lit(light, points, face, normal, positions, faces)
    assert 0.2 < want.mean() < 0.9
    np.testing.assert_array_equal(got, want)
