"""Cameras: worked numbers, independent formulas, derivatives, degenerate and far-away input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import check_derivatives
from scipy.spatial.transform import Rotation

from diffrast import linalg, opencv, viewing
from diffrast.camera import (
    Camera,
    clip_to_pixel,
    pixel_directions,
    pixel_rays,
    stack_cameras,
    to_opencv,
    viewpoint,
    world_to_clip,
)

pytestmark = pytest.mark.usefixtures("compiled_quickly")

RNG = np.random.default_rng(0)
DEPTHS = {"near": 1.0, "far": 9.0}


def pixels(camera, positions, *, height=100, width=200):
    return np.asarray(clip_to_pixel(world_to_clip(camera, positions), height=height, width=width))


def ndc(camera, positions):
    clip = np.asarray(world_to_clip(camera, positions))
    return clip[..., :3] / clip[..., 3:]


def perspective(**changes):
    options = {"eye": (0, 0, 5), "target": (0, 0, 0), "fov_y": np.pi / 2, "aspect": 2.0}
    return Camera.perspective(**{**options, **DEPTHS, **changes})


def orthographic(**changes):
    options = {"eye": (1, 2, 5), "target": (0, 1, 0), "height": 4.0, "aspect": 1.5}
    return Camera.orthographic(**{**options, **DEPTHS, **changes})


HOUSE_VIEW = {
    "view_reference_point": (1.5, 2, 0),
    "view_plane_normal": (0.2, 0.1, 1.0),
    "view_up": (0.1, 1, 0),
    "window": (-3.0, 5.0, -4.0, 2.0),
    "front": 3.0,
    "back": -20.0,
}


def phigs(**changes):
    options = {"projection_reference_point": (0.5, -0.3, 10.0)}
    return Camera.phigs(**{**HOUSE_VIEW, **options, **changes})


def cavalier():
    point = viewing.oblique_reference_point(HOUSE_VIEW["window"], foreshortening=1.0)
    return phigs(projection_reference_point=point, projection="parallel")


INTRINSICS = np.array([[300.0, 2.0, 90.0], [0.0, 310.0, 60.0], [0.0, 0.0, 1.0]])


def opencv_camera(**changes):
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
    options = {"intrinsics": INTRINSICS, "rotation": rotation, "translation": (0.1, -0.2, 4.0)}
    return Camera.opencv(**{**options, "width": 200, "height": 100, **DEPTHS, **changes})


# ------------------------------------------------------------------------------ closed forms


def test_the_numbers_in_the_module_docstring():
    camera = perspective()
    np.testing.assert_allclose(camera.view @ np.array([2, 1, 0, 1.0]), [2, 1, -5, 1])
    np.testing.assert_allclose(world_to_clip(camera, (2, 1, 0)), [1, 1, 4, 5], rtol=1e-6)
    np.testing.assert_allclose(pixels(camera, (2, 1, 0)), [120, 40, 0.2], rtol=1e-6)


def test_perspective_shows_its_field_of_view_and_depth_range():
    camera = perspective(fov_y=0.8, aspect=1.5)
    edge = np.tan(0.4)
    corners = np.array([[1.5 * edge, edge, 4], [-13.5 * edge, -9 * edge, -4]])
    np.testing.assert_allclose(ndc(camera, corners), [[1, 1, -1], [-1, -1, 1]], atol=1e-5)


def test_orthographic_shows_its_height_and_depth_range():
    camera = orthographic(target=(1, 2, 0))
    corners = np.array([[4.0, 4.0, 4.0], [-2.0, 0.0, -4.0]])
    np.testing.assert_allclose(ndc(camera, corners), [[1, 1, -1], [-1, -1, 1]], atol=1e-6)
    np.testing.assert_array_equal(world_to_clip(camera, corners)[:, 3], 1)


def test_spherical_view_is_the_transpose_of_the_notes():
    radius, theta, phi = 7.0, 0.7, 1.2
    (st, ct), (sp, cp) = (np.sin(theta), np.cos(theta)), (np.sin(phi), np.cos(phi))
    v = [  # A 6.1, for row vectors
        [-st, -ct * cp, ct * sp, 0],
        [ct, -st * cp, st * sp, 0],
        [0, sp, cp, 0],
        [0, 0, -radius, 1],
    ]
    options = {"radius": radius, "theta": theta, "fov_y": 1.0, **DEPTHS}
    camera = Camera.spherical(phi=phi, **options)
    np.testing.assert_allclose(camera.view, np.transpose(v), atol=1e-6)
    eye = radius * np.array([sp * ct, sp * st, cp])
    np.testing.assert_allclose(viewpoint(camera), [*eye, 1], rtol=1e-6)
    # The same through a free view direction with z up (A 16), here with another target.
    target = np.array([1.0, -2.0, 3.0])
    free = perspective(eye=target + eye, target=None, direction=-eye, up=(0, 0, 1))
    moved = Camera.spherical(phi=phi, target=target, **options)
    np.testing.assert_allclose(moved.view, free.view, atol=2e-6)
    # A pole is nothing special.
    pole = Camera.spherical(phi=0.0, **options)
    np.testing.assert_allclose(
        pole.view[:3, :3], Camera.spherical(phi=1e-7, **options).view[:3, :3], atol=1e-6
    )


def phigs_matrix_of_the_thesis(*, prp, parallel):
    """World to the thesis's volume, composed as C 2.4.4 composes it (VPD = 0)."""

    def shift(offset):
        matrix = np.eye(4)
        matrix[:3, 3] = offset
        return matrix

    vrp, vpn, vup = (
        np.array(HOUSE_VIEW[name], float)
        for name in ("view_reference_point", "view_plane_normal", "view_up")
    )
    u_min, u_max, v_min, v_max = HOUSE_VIEW["window"]
    front, back = HOUSE_VIEW["front"], HOUSE_VIEW["back"]
    rz = vpn / np.linalg.norm(vpn)
    rx = np.cross(vup, rz) / np.linalg.norm(np.cross(vup, rz))
    rotate = np.eye(4)
    rotate[:3, :3] = rx, np.cross(rz, rx), rz
    dop = np.array([(u_min + u_max) / 2, (v_min + v_max) / 2, 0]) - prp
    shear = np.eye(4)
    shear[:2, 2] = -dop[:2] / dop[2]
    window = np.array([u_max - u_min, v_max - v_min])
    if parallel:
        centre = shift([-(u_min + u_max) / 2, -(v_min + v_max) / 2, -front])
        scale = np.diag([*(2 / window), 1 / (front - back), 1])
        return scale @ centre @ shear @ rotate @ shift(-vrp)
    vrp_z = -prp[2]
    scale = np.diag([*(2 * vrp_z / (window * (vrp_z + back))), -1 / (vrp_z + back), 1])
    z_min = -(vrp_z + front) / (vrp_z + back)
    clip = np.eye(4)
    clip[2:, 2:] = [[1 / (1 + z_min), -z_min / (1 + z_min)], [-1, 0]]
    return clip @ scale @ shear @ shift(-prp) @ rotate @ shift(-vrp)


@pytest.mark.parametrize("projection", ["perspective", "parallel"])
def test_phigs_is_the_composition_of_the_thesis(projection):
    prp = np.array([0.5, -0.3, 10.0])
    matrix = phigs_matrix_of_the_thesis(prp=prp, parallel=projection == "parallel")
    points = RNG.uniform(-3, 3, (20, 3)) - [0, 0, 3]
    theirs = np.concatenate([points, np.ones((20, 1))], axis=1) @ matrix.T
    theirs = theirs[:, :3] / theirs[:, 3:]
    ours = ndc(phigs(projection=projection), points)
    np.testing.assert_allclose(ours[:, :2], theirs[:, :2], atol=1e-5)
    # Their depth runs from 0 at the front to -1 at the back.
    np.testing.assert_allclose(ours[:, 2], -1 - 2 * theirs[:, 2], atol=1e-5)


@pytest.mark.parametrize("foreshortening", [1.0, 0.5])
def test_oblique_projections_draw_depth_at_their_angle(foreshortening):
    window = (-2.0, 4.0, -1.0, 2.0)
    point = viewing.oblique_reference_point(
        window, foreshortening=foreshortening, angle=0.6, view_plane_distance=2.0
    )
    camera = Camera.phigs(
        view_reference_point=(0, 0, 0),
        view_plane_normal=(0, 0, 2),
        view_up=(0, 1, 0),
        projection_reference_point=point,
        window=window,
        view_plane_distance=2.0,
        front=5.0,
        back=-5.0,
        projection="parallel",
    )
    at_plane, behind = ndc(camera, [[1.0, 0.5, 2.0], [1.0, 0.5, -1.0]])[:, :2] * [3, 1.5]
    np.testing.assert_allclose(at_plane, [0, 0], atol=1e-6)  # the view plane keeps its place
    drawn = 3 * foreshortening * np.array([np.cos(0.6), np.sin(0.6)])
    np.testing.assert_allclose(behind - at_plane, drawn, atol=1e-5)


def test_opencv_projects_as_opencv_says_with_and_without_distortion():
    distortion = np.array([-0.2, 0.1, 0.01, -0.02, 0.03])
    points = RNG.uniform(-0.8, 0.8, (20, 3))
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
    x, y, z = (points @ rotation.T + [0.1, -0.2, 4.0]).T
    a, b = x / z, y / z
    straight = np.stack([a, b, np.ones(20)]).T @ INTRINSICS.T
    np.testing.assert_allclose(
        pixels(opencv_camera(), points), np.c_[straight[:, :2], 1 / z], rtol=1e-5
    )
    k1, k2, p1, p2, k3 = distortion
    r2 = a**2 + b**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent = np.stack(
        [
            a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a**2),
            b * radial + p1 * (r2 + 2 * b**2) + 2 * p2 * a * b,
            np.ones(20),
        ]
    ).T
    np.testing.assert_allclose(
        pixels(opencv_camera(distortion=distortion), points)[:, :2],
        (bent @ INTRINSICS.T)[:, :2],
        rtol=1e-5,
    )


def test_distortion_folds_nothing_into_the_picture():
    camera = opencv_camera(rotation=np.eye(3), translation=np.zeros(3))
    camera = dataclasses.replace(camera, distortion=jnp.array([-0.4, 0.0, 0.0, 0.0, 0.0]))
    angles = np.linspace(0.0, np.pi, 200)[1:-1]
    points = np.stack([np.sin(angles), np.zeros(198), np.cos(angles)], axis=-1)
    # Along an arc from straight ahead to straight behind the picture runs outward, then mirrored
    # inward from the other side, as without distortion; on the way it never turns round.
    x, _, _, w = np.asarray(world_to_clip(camera, points)).T
    angle = np.unwrap(np.arctan2(x - (2 * 90 / 200 - 1) * w, w))
    assert (np.diff(angle) > 0).all()
    on_and_behind = jnp.array([[0.0, 0, 0, 1], [0, 0, 1, 1], [1, 2, 0, 1], [1, 2, 3, 1]])
    loss = jax.jit(jax.grad(lambda d: (opencv.distort(on_and_behind, d) ** 2).sum()))
    gradient = loss(camera.distortion)
    assert np.isfinite(gradient).all()


def test_to_opencv_undoes_opencv():
    camera = opencv_camera(distortion=np.arange(5) / 50)
    parameters = to_opencv(camera, height=100, width=200)
    np.testing.assert_allclose(parameters.intrinsics, INTRINSICS, rtol=1e-5, atol=1e-5)
    again = Camera.opencv(**parameters._asdict(), width=200, height=100, **DEPTHS)
    for ours, theirs in zip(jax.tree.leaves(again), jax.tree.leaves(camera), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)
    centred = to_opencv(perspective(), height=100, width=200)
    np.testing.assert_allclose(
        centred.intrinsics, [[50, 0, 100], [0, 50, 50], [0, 0, 1]], rtol=1e-6
    )


# ---------------------------------------------------------------------------- viewer and rays

CAMERAS = {
    "perspective": (perspective, True),
    "orthographic": (orthographic, False),
    "phigs": (phigs, True),
    "phigs_parallel": (lambda: phigs(projection="parallel"), False),
    "cavalier": (cavalier, False),
    "opencv": (opencv_camera, True),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_viewpoint_and_rays_agree_with_the_projection(name):
    make, finite = CAMERAS[name]
    camera = make()
    viewer = np.asarray(viewpoint(camera))
    assert viewer[3] == (1 if finite else 0)
    points = np.asarray(
        [
            camera.view[:3, :3].T @ (p - camera.view[:3, 3])
            for p in RNG.uniform(-1, 1, (5, 3)) - [0, 0, 5]
        ]
    )
    towards = viewer[:3] - viewer[3] * points
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    before, after = ndc(camera, points), ndc(camera, points + 0.3 * towards)
    np.testing.assert_allclose(before[:, :2], after[:, :2], atol=2e-5)  # same pixel
    assert (after[:, 2] < before[:, 2]).all()  # and nearer
    rays = np.asarray(pixel_rays(camera, height=6, width=8)).reshape(-1, 3)
    start = viewer[:3] if finite else points[0]
    along = ndc(camera, start + rays * np.linspace(3, 9, 48)[:, None])
    along = along if finite else along - ndc(camera, start)
    x, y = np.meshgrid((np.arange(8) + 0.5) / 4 - 1, 1 - (np.arange(6) + 0.5) / 3)
    wanted = np.stack([x, y], axis=-1).reshape(-1, 2) * finite
    np.testing.assert_allclose(along[:, :2], wanted, atol=3e-5)


LENSES = {
    "usual": (-0.2, 0.1, 0.01, -0.02, 0.03),
    "barrel": (-0.3, 0.12, 0.001, 0.0005, -0.02),
    "no bending": (0.0, 0.0, 0.0, 0.0, 0.0),
    "pincushion": (0.3, 0.2, 0.002, 0.001, 0.1),
    "cone within the picture": (-0.4, 0.0, 0.0, 0.0, 0.0),
    "strong": (5.0, 10.0, 0.1, 0.1, 30.0),
}
FOLDED = {
    "shift at the cone": (-0.4, 0.0, 0.01, -0.005, 0.0),
    "shift alone": (0.0, 0.0, 0.5, -0.7, 0.0),
    "narrow cone": (-1e6, 0.0, 0.0, 0.0, 0.0),
    "huge": (1e10, -1e20, 1e8, -1e5, 1e30),
}
WIDE = np.array([[60.0, 1.0, 90.0], [0.0, 50.0, 55.0], [0.0, 0.0, 1.0]])
both_directions = jax.jit(lambda camera: pixel_directions(camera, height=50, width=100, border=1))


@pytest.mark.parametrize("lens", LENSES)
def test_rays_of_a_distorted_camera_lead_to_the_centres_of_pixels(lens):
    """Also where the picture shows what lies beyond the cone; points near, far and at infinity."""
    camera = opencv_camera(distortion=np.array(LENSES[lens]), intrinsics=WIDE, width=100, height=50)
    rays, _ = both_directions(camera)
    want = np.stack(np.meshgrid(np.arange(-1, 101) + 0.5, np.arange(-1, 51) + 0.5), axis=-1)
    eye = linalg.apply_matrix(camera.view[:3, :3], rays)
    eye = jnp.concatenate([eye, jnp.zeros_like(rays[..., :1])], axis=-1)
    assert (eye[..., 2] < 0).all()
    clip = linalg.apply_matrix(camera.projection, opencv.distort(eye, camera.distortion))
    infinity = clip_to_pixel(clip, height=50, width=100)
    np.testing.assert_allclose(infinity[..., :2], want, atol=1e-4)
    for distance in (1.0, 1e5):
        near = pixels(camera, viewpoint(camera)[:3] + distance * rays, height=50, width=100)
        np.testing.assert_allclose(near[..., :2], want, atol=5e-4)  # places are rounded as well
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda x: x.astype(np.float64), camera)
        rays, _ = both_directions(exact)
        near = pixels(exact, viewpoint(exact)[:3] + rays, height=50, width=100)
        np.testing.assert_allclose(near[..., :2], want, atol=1e-10)


def test_rays_change_from_pixel_to_pixel_as_told():
    with jax.enable_x64(True):
        camera = opencv_camera(distortion=np.array(LENSES["usual"]))
        straight = dataclasses.replace(camera, distortion=None)
        for one in (camera, straight):
            rays, steps = jax.jit(lambda c: pixel_directions(c, height=300, width=600))(one)
            steps = np.broadcast_to(steps, (*rays.shape[:2], 2, 3))[1:-1, 1:-1]
            across = (rays[1:-1, 2:] - rays[1:-1, :-2]) / 2
            down = (rays[2:, 1:-1] - rays[:-2, 1:-1]) / 2
            want = np.stack([across, down], axis=-2)
            np.testing.assert_allclose(steps, want, atol=1e-4 * np.abs(want).max())
        bent = dataclasses.replace(camera, distortion=jnp.zeros(5))
        flat, bent = (pixel_rays(one, height=10, width=20) for one in (straight, bent))
        np.testing.assert_allclose(bent, flat, atol=1e-14)


def test_derivatives_of_the_rays_of_a_distorted_camera():
    """The first ones and the second: by the view, the projection and the lens."""

    def directions(camera):
        return pixel_directions(camera, height=5, width=7)

    def slopes(lens):
        def size(lens):
            return jnp.sum(jnp.sin(directions(dataclasses.replace(camera, distortion=lens))[0]))

        return jax.grad(size)(lens)

    with jax.enable_x64(True):
        camera = opencv_camera(
            distortion=np.array(LENSES["barrel"]), intrinsics=WIDE, width=100, height=50
        )
        check_derivatives(directions, camera, step=1e-7, rtol=1e-5, atol=1e-5)
        check_derivatives(slopes, camera.distortion, step=1e-7, rtol=1e-5, atol=1e-4)


def test_rays_are_finite_where_the_lens_folds():
    @jax.jit
    def slopes(camera):
        def size(camera):
            return sum(jnp.mean(x**2) for x in pixel_directions(camera, height=50, width=100))

        return pixel_rays(camera, height=50, width=100), jax.grad(size)(camera)

    for lens in FOLDED.values():
        camera = opencv_camera(distortion=np.array(lens), intrinsics=WIDE, width=100, height=50)
        for one in (camera, dataclasses.replace(camera, projection=jnp.zeros((4, 4)))):
            rays, gradient = slopes(one)
            np.testing.assert_allclose(jnp.linalg.norm(rays, axis=-1), 1, rtol=1e-5)
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient)), lens


def test_viewpoint_of_a_projection_without_a_centre_is_zero():
    camera = Camera(view=np.eye(4), projection=np.zeros((4, 4)))
    np.testing.assert_array_equal(viewpoint(camera), 0)
    gradient = jax.jit(jax.grad(lambda c: viewpoint(c).sum()))(camera)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


# -------------------------------------------------------------------------------- degenerate


DERIVATIVES_OF_LOOK_AT = [
    jax.jit(transform(viewing.look_at, (0, 1, 2))) for transform in (jax.jacfwd, jax.jacrev)
]


@pytest.mark.parametrize(
    ("eye", "up"),
    [
        ((0, 0, 0), (0, 1, 0)),  # nowhere to look
        ((0, 3, 0), (0, 1, 0)),  # looking down along up
        ((1, 2, 3), (2, 4, 6)),
        ((1, 2, 3), (0.1, 0.2, 0.3)),
        ((1, 2, 3), (0, 0, 0)),
        ((1, 2, 3), (0.1, 0.2, 0.3000001)),  # nearly parallel
    ],
)
def test_degenerate_views_are_rigid_with_finite_derivatives(eye, up):
    view = viewing.look_at(eye, (0, 0, 0), up)
    np.testing.assert_allclose(view[:3, :3] @ view[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.linalg.det(view) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(view[:3, 3], -view[:3, :3] @ np.array(eye), atol=1e-6)
    arguments = tuple(jnp.asarray(a, jnp.float32) for a in (eye, (0, 0, 0), up))
    for derivatives in DERIVATIVES_OF_LOOK_AT:
        assert all(np.isfinite(derivative).all() for derivative in derivatives(*arguments))


@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_views_have_no_favourite_unit(scale):
    eye, target, up = np.array([[1, 2, 3], [0.5, 0, 0], [0, 1, 0.2]], np.float32)
    unit = viewing.look_at(eye, target, up)
    np.testing.assert_allclose(
        viewing.look_at(eye * scale, target * scale, up / scale)[:3, :3], unit[:3, :3], atol=1e-6
    )


def test_points_in_and_behind_the_plane_of_the_eye():
    clip = jnp.array([[1.0, 2, 3, 0], [1, 2, 3, 1e-30], [0, 0, 0, 0], [1e-15, 0, 0, 1e-15]])
    where, derivative = jax.jvp(
        lambda c: clip_to_pixel(c, height=10, width=10), (clip,), (jnp.ones_like(clip),)
    )
    np.testing.assert_array_equal(where[:3], 0)
    np.testing.assert_allclose(where[3], [10, 5, 1e15], rtol=1e-5)
    assert np.isfinite(derivative).all()
    np.testing.assert_allclose(pixels(perspective(), (2, 1, 10)), [80, 60, -0.2], rtol=1e-5)


# -------------------------------------------------------------------------- far from the origin


@pytest.mark.parametrize("make", [perspective, orthographic])
def test_a_model_a_million_units_away_looks_as_it_does_at_the_origin(make):
    offset = np.array([1e6, -2e6, 5e5], np.float32)
    points = RNG.integers(-16, 16, (50, 3)).astype(np.float32) / 8
    eye, target = np.array([2, 3, 6], np.float32), np.array([0, 0.5, 0], np.float32)
    here = make(eye=eye, target=target)
    there = jax.jit(lambda e, t: make(eye=e, target=t))(eye + offset, target + offset)
    wanted = pixels(here, points)
    got = pixels(there, points + offset)
    np.testing.assert_allclose(got[:, :2], wanted[:, :2], atol=5e-3)
    if make is perspective:
        np.testing.assert_allclose(viewpoint(there), [*(eye + offset), 1], atol=0.1)


def test_equal_positions_give_equal_bits():
    copies = np.repeat(RNG.normal(size=(17, 3)), 7, axis=0).astype(np.float32)
    clip = np.asarray(jax.jit(world_to_clip)(orthographic(), copies)).reshape(17, 7, 4)
    assert (clip == clip[:, :1]).all()


# ------------------------------------------------------------------------------- derivatives


def test_derivatives_of_the_constructors():
    points = RNG.uniform(-1, 1, (4, 3))

    def by_perspective(eye, target, up, fov_y, aspect, near, far):
        options = {"fov_y": fov_y, "aspect": aspect, "near": near, "far": far}
        camera = Camera.perspective(eye=eye, target=target, up=up, **options)
        return world_to_clip(camera, points), viewpoint(camera)

    def by_phigs(vrp, vpn, vup, prp, window, distance, front, back):
        camera = Camera.phigs(
            view_reference_point=vrp,
            view_plane_normal=vpn,
            view_up=vup,
            projection_reference_point=prp,
            window=window,
            view_plane_distance=distance,
            front=front,
            back=back,
            projection="parallel",
        )
        return world_to_clip(camera, points)

    with jax.enable_x64(True):
        eye, target, up = np.array([[3.0, 2.0, 5.0], [0.1, -0.2, 0.3], [0.1, 1.0, 0.2]])
        check_derivatives(by_perspective, eye, target, up, 0.9, 1.3, 0.5, 9.0)
        window = np.array([-2.0, 1.0, -1.0, 3.0])
        arguments = (target, eye, up, np.array([0.3, 0.2, 4.0]), window, 0.4, 2.0, -5.0)
        check_derivatives(by_phigs, *arguments)


def test_derivatives_of_the_stages_in_every_field():
    points = RNG.uniform(-1, 1, (4, 3))

    def stages(camera, points):
        clip = world_to_clip(camera, points)
        return clip, clip_to_pixel(clip, height=10, width=20) / 10

    with jax.enable_x64(True):
        camera = opencv_camera(distortion=np.array([-0.2, 0.1, 0.01, -0.02, 0.03]))
        check_derivatives(stages, camera, points)
        straight = dataclasses.replace(camera, distortion=None)
        check_derivatives(viewpoint, straight)


# ------------------------------------------------------------------------------------ stacks


def test_stacks_map_over_their_cameras():
    eyes = RNG.normal(size=(3, 3)) + 5
    cameras = [perspective(eye=eye) for eye in eyes]
    stacked = stack_cameras(cameras)
    assert stacked.view.shape == (3, 4, 4)
    mapped = jax.vmap(lambda eye: perspective(eye=eye))(jnp.asarray(eyes))
    points = RNG.normal(size=(7, 3))
    clip = jax.vmap(world_to_clip, (0, None))(stacked, points)
    for index, camera in enumerate(cameras):
        np.testing.assert_allclose(clip[index], world_to_clip(camera, points), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(mapped.view[index], camera.view, atol=1e-6)
    with pytest.raises(
        ValueError, match=r"camera: wanted a single camera, got a stack of shape \(3,"
    ):
        world_to_clip(stacked, points)


def test_precision_follows_the_input():
    assert world_to_clip(perspective(), (0.0, 0.0, 0.0)).dtype == np.float32
    with jax.enable_x64(True):
        camera = perspective(eye=np.array([0.1, 0.2, 5.0]))
        assert world_to_clip(camera, (0.0, 0.0, 0.0)).dtype == np.float64
        assert viewpoint(camera).dtype == np.float64


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Camera(view=np.eye(3), projection=np.eye(4)), "view: wanted shape"),
        (lambda: Camera(view=np.eye(4), projection=np.ones((2, 4, 4))), "projection: wanted shape"),
        (lambda: Camera(view=np.eye(4) * np.nan, projection=np.eye(4)), "view: wanted finite"),
        (lambda: opencv_camera(distortion=np.ones(4)), r"distortion: wanted shape \(5,\)"),
        (lambda: perspective(fov_y=np.pi), "fov_y: wanted a number between 0 and 3.14159, got"),
        (lambda: perspective(fov_y=np.nan), "fov_y: wanted finite numbers"),
        (lambda: perspective(near=0.0), "near: wanted a number between 0 and inf, got 0"),
        (lambda: perspective(far=0.5), "far: wanted a number between 1 and inf, got 0.5"),
        (lambda: perspective(aspect=-1.0), "aspect: wanted a number between 0"),
        (lambda: perspective(eye=(0, 0)), r"eye: wanted shape \(3,\), got \(2,\)"),
        (lambda: perspective(direction=(0, 0, 1)), "target, direction: .* got both"),
        (lambda: perspective(target=None), "target, direction: .* got none"),
        (lambda: orthographic(height=0.0), "height: wanted a number between 0"),
        (lambda: phigs(window=(1.0, 0.0, 0.0, 1.0)), "window: wanted its minimum"),
        (lambda: phigs(projection="fisheye"), "projection: wanted one of perspective, parallel"),
        (lambda: phigs(view_plane_distance=11.0), "view_plane_distance: wanted"),
        (lambda: phigs(front=11.0), "front: wanted"),
        (lambda: phigs(back=4.0), "back: wanted"),
        (lambda: opencv_camera(rotation=-np.eye(3)), "rotation: wanted a rotation matrix"),
        (lambda: opencv_camera(intrinsics=np.ones((3, 3))), "intrinsics: wanted a last row"),
        (
            lambda: opencv_camera(intrinsics=INTRINSICS * [[0.0], [1.0], [1.0]]),
            "intrinsics: wanted focal lengths other than zero, got",
        ),
        (lambda: opencv_camera(width=0), "width: wanted an integer of at least 1"),
        (lambda: to_opencv(orthographic(), height=4, width=4), "wanted a perspective camera"),
        (lambda: stack_cameras([]), "cameras: wanted at least one"),
        (
            lambda: stack_cameras([perspective(), opencv_camera(distortion=np.ones(5))]),
            "cameras: wanted equal fields and shapes, .* at index 1",
        ),
    ],
)
def test_errors_name_the_argument(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_known_numbers_are_checked_inside_of_jit():
    with pytest.raises(ValueError, match="far: wanted a number between 5 and inf, got 1"):
        jax.jit(lambda: perspective(near=5.0, far=1.0))()
    options = {"distance": 1.0, "near": 1.0, "far": 5.0}
    with pytest.raises(ValueError, match="window: wanted its minimum"):
        jax.jit(lambda: viewing.perspective_projection(window=(1, -1, -1, 1), **options))()
