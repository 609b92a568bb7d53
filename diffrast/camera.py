"""World to eye to clip to pixel: every convention of the pipeline's geometry, and the cameras.

- The world is right-handed, and points are columns: `projection @ view @ (x, y, z, 1)`.
- Eye space: the camera is at the origin, looks along -z, x points right and y up.
- Clip space is OpenGL's: what is shown has -w <= x, y, z <= w. Divided by w it is NDC: x right, y
  up, z from -1 at near to +1 at far. A perspective camera has clip w = depth = -z of eye space; a
  parallel one has w = 1.
- Pixels: x right and y down in pixels from the top left corner of the image. Pixel (row i,
  column j) covers [j, j + 1] x [i, i + 1] and has its centre at (j + 0.5, i + 0.5).

In numbers: a camera at (0, 0, 5) that looks at the origin with y up, fov_y = pi / 2, aspect = 2,
near = 1, far = 9, and the world point (2, 1, 0):

    eye    (2, 1, -5)              right, above, and 5 in front
    clip   (1, 1, 4, 5)            x = 2 / (aspect tan(fov_y / 2)), y = 1 / tan(fov_y / 2), w = 5
    NDC    (0.2, 0.2, 0.8)
    pixel  (120, 40), 1/w = 0.2    in an image 200 wide and 100 high: (0.2 + 1) 100, (1 - 0.2) 50

OpenCV's camera has x right, y down, z forward. Its intrinsics are understood in the pixels above,
so a centred camera has (cx, cy) = (width / 2, height / 2). Calibrations whose pixel centres lie at
whole numbers (OpenCV's own) need 0.5 added to cx and cy.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from diffrast import _compensated, opencv, viewing
from diffrast._check import (
    ArrayInput,
    all_instances,
    float_array,
    instance_of,
    positive_int,
    real_number,
)
from diffrast._pytree import pytree_dataclass, set_field
from diffrast._stored import stored
from diffrast.linalg import apply_matrix, dot, normalize, null_vector, where_finite


@pytree_dataclass
class Camera:
    """A view and a projection; see the module's docstring for their conventions.

    Every field is traced and differentiable. A stack of cameras has leading axes in every field:
    make one with `stack_cameras` or `jax.vmap` over a constructor.

    Attributes:
        view: world to eye space.
        projection: eye to clip space.
        distortion: OpenCV's k1, k2, p1, p2, k3 of a perspective camera, applied to x / depth and
            y / depth of every vertex; edges between vertices stay straight. Beyond the angle from
            the axis at which the radial polynomial stops growing it continues linearly, so that
            nothing far outside the picture, or behind the camera, is folded into it. None: no
            operation at all.
        view_remainder: the digits of the view's translation that its floating-point format cannot
            hold, which matter for a camera a million units from the origin. The constructors that
            place a camera fill it in; zero otherwise.

    Raises:
        ValueError: for wrong shapes and for numbers that are not finite.
    """

    view: Float[Array, "*batch 4 4"]
    projection: Float[Array, "*batch 4 4"]
    distortion: Float[Array, "*batch 5"] | None
    view_remainder: Float[Array, "*batch 3"]

    def __init__(
        self,
        *,
        view: ArrayInput,
        projection: ArrayInput,
        distortion: ArrayInput | None = None,
        view_remainder: ArrayInput | None = None,
    ) -> None:
        view = float_array("view", view, ("...", 4, 4))
        batch = view.shape[:-2]
        if distortion is not None:
            distortion = float_array("distortion", distortion, (*batch, 5))
        if view_remainder is None:
            view_remainder = jnp.zeros((*batch, 3), view.dtype)
        remainder = float_array("view_remainder", view_remainder, (*batch, 3))
        set_field(self, "view", view)
        set_field(self, "projection", float_array("projection", projection, (*batch, 4, 4)))
        set_field(self, "distortion", distortion)
        set_field(self, "view_remainder", remainder)

    @classmethod
    def perspective(
        cls,
        *,
        eye: ArrayInput,
        target: ArrayInput | None = None,
        direction: ArrayInput | None = None,
        up: ArrayInput = (0.0, 1.0, 0.0),
        fov_y: ArrayLike,
        aspect: ArrayLike = 1.0,
        near: ArrayLike,
        far: ArrayLike,
    ) -> "Camera":
        """A perspective camera at `eye`; differentiable in every argument. FEATURES T2, T4.

        Args:
            eye: position in the world.
            target: a point to look at; or else
            direction: a direction to look in. What happens where these or `up` are degenerate is
                told at `viewing.view_axes`: the result is always finite.
            up: what is up in the picture.
            fov_y: angle between the lower and the upper edge of the picture, in radians.
            aspect: width over height of the picture.
            near: depth of the nearest points shown, above zero.
            far: depth of the farthest points shown.
        """
        projection = viewing.field_of_view_projection(fov_y, aspect, near, far)
        eye = _vector("eye", eye)
        return _placed(viewing.axes_towards(eye, target, direction, up), eye, projection)

    @classmethod
    def orthographic(
        cls,
        *,
        eye: ArrayInput,
        target: ArrayInput | None = None,
        direction: ArrayInput | None = None,
        up: ArrayInput = (0.0, 1.0, 0.0),
        height: ArrayLike,
        aspect: ArrayLike = 1.0,
        near: ArrayLike,
        far: ArrayLike,
    ) -> "Camera":
        """A camera with parallel rays perpendicular to the picture; see `perspective`.

        Args:
            eye: the point that near and far are measured from, in the middle of the picture.
            target: a point to look at; or else
            direction: a direction to look in.
            up: what is up in the picture.
            height: of the part of space shown, in world units.
            aspect: width over height of the picture.
            near: depth of the nearest points shown; may be negative.
            far: depth of the farthest points shown.
        """
        window = viewing.centred_window(height, aspect)
        projection = viewing.parallel_projection(window=window, distance=1.0, near=near, far=far)
        eye = _vector("eye", eye)
        return _placed(viewing.axes_towards(eye, target, direction, up), eye, projection)

    @classmethod
    def spherical(
        cls,
        *,
        radius: ArrayLike,
        theta: ArrayLike,
        phi: ArrayLike,
        target: ArrayInput = (0.0, 0.0, 0.0),
        fov_y: ArrayLike,
        aspect: ArrayLike = 1.0,
        near: ArrayLike,
        far: ArrayLike,
    ) -> "Camera":
        """A perspective camera on a sphere round `target`, looking at it, z up. FEATURES T2.

        The eye is at `target + radius (sin phi cos theta, sin phi sin theta, cos phi)`: theta is
        the angle from the x axis, phi from the z axis, in radians. For a target at the origin the
        view is the transpose of A 6.1's V. Unlike a camera with an up vector it turns smoothly
        across the poles.
        """
        distance = real_number("radius", radius, above=0.0)
        target_eye = jnp.stack([jnp.zeros_like(distance), jnp.zeros_like(distance), -distance])
        projection = viewing.field_of_view_projection(fov_y, aspect, near, far)
        axes = viewing.spherical_axes(theta, phi)
        return _placed(axes, _vector("target", target), projection, target_eye)

    @classmethod
    def phigs(
        cls,
        *,
        view_reference_point: ArrayInput,
        view_plane_normal: ArrayInput,
        view_up: ArrayInput,
        projection_reference_point: ArrayInput,
        window: ArrayInput,
        view_plane_distance: ArrayLike = 0.0,
        front: ArrayLike,
        back: ArrayLike,
        projection: str = "perspective",
    ) -> "Camera":
        """A camera in the terms of PHIGS and GKS-3D. FEATURES T3, C 2.4.

        The view reference coordinates (u, v, n) have their origin at VRP, n along VPN, and v along
        VUP as far as that is perpendicular to n; u = v x n. The picture is seen from where n is
        large: the projection reference point lies on that side of the view plane.

        Args:
            view_reference_point: VRP, in the world.
            view_plane_normal: VPN, in the world, towards the viewer; its length plays no role.
            view_up: VUP, in the world.
            projection_reference_point: PRP in (u, v, n): the eye of a perspective camera. Of a
                parallel one it gives the direction of projection, towards the window's centre;
                `viewing.oblique_reference_point` makes one for cavalier and cabinet projections.
            window: u_min, u_max, v_min, v_max in the view plane.
            view_plane_distance: VPD, n of the view plane.
            front: n of the front clipping plane.
            back: n of the back clipping plane, below front.
            projection: "perspective" or "parallel".
        """
        reference = _vector("projection_reference_point", projection_reference_point)
        matrix = viewing.phigs_projection(
            projection_reference_point=reference,
            window=window,
            view_plane_distance=view_plane_distance,
            front=front,
            back=back,
            projection=projection,
        )
        normal, up = _vector("view_plane_normal", view_plane_normal), _vector("view_up", view_up)
        axes = viewing.view_axes(-normal, up)
        point = _vector("view_reference_point", view_reference_point)
        return _placed(axes, point, matrix, -reference)

    @classmethod
    def opencv(
        cls,
        *,
        intrinsics: ArrayInput,
        rotation: ArrayInput,
        translation: ArrayInput,
        width: int,
        height: int,
        near: ArrayLike,
        far: ArrayLike,
        distortion: ArrayInput | None = None,
    ) -> "Camera":
        """A camera in the terms of OpenCV: K [R | t]. FEATURES T4.

        Differentiable in every array. The module's docstring tells where the pixels' centres are.

        Args:
            intrinsics: K (3, 3) in pixels, last row (0, 0, 1); skew is allowed, focal lengths of
                zero are not.
            rotation: R (3, 3), from the world to x right, y down, z forward.
            translation: t (3,), the world's origin in those coordinates.
            width: of the image that K is meant for, in pixels.
            height: of that image.
            near: depth of the nearest points shown, above zero.
            far: depth of the farthest points shown.
            distortion: k1, k2, p1, p2, k3, or None for none.

        Raises:
            ValueError: for wrong shapes, numbers that are not finite, sizes and depths out of
                range, a matrix that is known not to be such a K, and one that is known to be no
                rotation.
        """
        view = opencv.view_from_opencv(rotation, translation)
        projection = opencv.projection_from_opencv(
            intrinsics=intrinsics, width=width, height=height, near=near, far=far
        )
        return cls(view=view, projection=projection, distortion=distortion)


def to_opencv(camera: Camera, *, height: int, width: int) -> opencv.OpenCVParameters:
    """The camera in the terms of OpenCV, for an image of this size: undoes `Camera.opencv`.

    Raises:
        ValueError: for a camera known not to be a perspective one with clip w = depth.
    """
    check_single(camera)
    parameters = opencv.parameters_from_matrices(
        camera.view, camera.projection, height=height, width=width
    )
    return parameters._replace(distortion=camera.distortion)


def stack_cameras(cameras: Sequence[Camera]) -> Camera:
    """One camera whose fields hold those of `cameras` along a new leading axis.

    Raises:
        ValueError: for no cameras, or cameras that do not all have the same fields and shapes.
    """
    all_instances("cameras", cameras, Camera)
    if not cameras:
        raise ValueError("cameras: wanted at least one, got none")
    shapes = [jax.tree.map(jnp.shape, vars(camera)) for camera in cameras]
    for index, other in enumerate(shapes):
        if other != shapes[0]:
            raise ValueError(
                f"cameras: wanted equal fields and shapes, got {shapes[0]} at index 0 and {other}"
                f" at index {index}"
            )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)


# ----------------------------------------------------------------------------------- the stages


def world_to_clip(camera: Camera, positions_world: ArrayInput) -> Float[Array, "*batch 4"]:
    """Clip positions (..., 4) of world positions (..., 3), differentiable in both.

    The view is applied in twice the working precision, so that a model a million units from the
    origin, seen from nearby, is as steady as one at the origin. Equal positions give equal bits.
    """
    check_single(camera)
    positions_world = float_array("positions_world", positions_world, ("...", 3), finite=False)
    return _world_to_clip(camera, positions_world)


@jax.jit
def _world_to_clip(camera: Camera, positions_world: Array) -> Array:
    remainder = jnp.append(camera.view_remainder, 0)

    def project(positions_eye: Array) -> Array:
        if camera.distortion is not None:
            positions_eye = opencv.distort(positions_eye, camera.distortion)
        return apply_matrix(camera.projection, positions_eye)

    positions_eye = where_finite(
        lambda points: _compensated.affine(camera.view, remainder, points), positions_world
    )
    return where_finite(project, positions_eye)


def direction_to_clip(camera: Camera, direction: Float[Array, "*batch 3"]) -> Array:
    """Clip positions (..., 4) of the points at infinity in world directions (..., 3)."""
    return apply_matrix(camera.projection[:, :3], apply_matrix(camera.view[:3, :3], direction))


def clip_to_pixel(
    positions_clip: ArrayInput, *, height: int, width: int
) -> Float[Array, "*batch 3"]:
    """Pixel x, pixel y and 1/w (..., 3) of clip positions (..., 4).

    A point in the plane of the eye, w = 0 to within rounding, has no pixel: it gives zeros, with
    zero gradient. Behind the eye 1/w is negative and the pixel is that of the mirrored point.

    Example:
        >>> eye, target = (0, 0, 4), (0, 0, 0)
        >>> camera = dr.Camera.perspective(eye=eye, target=target, fov_y=np.pi / 2, near=1, far=9)
        >>> clip = dr.world_to_clip(camera, jnp.array([[0.0, 0, 0], [2, 2, 0]]))
        >>> dr.clip_to_pixel(clip, height=64, width=64).round(4).tolist()
        [[32.0, 32.0, 0.25], [48.0, 16.0, 0.25]]
    """
    positions_clip = float_array("positions_clip", positions_clip, ("...", 4), finite=False)
    size = positive_int("width", width) / 2, positive_int("height", height) / 2
    x, y, _, w = jnp.moveaxis(positions_clip, -1, 0)
    # Where this fails, x / w^2 could overflow in a derivative.
    tiny = float(jnp.finfo(w.dtype).eps) ** 2
    defined = jnp.abs(w) > tiny * jnp.maximum(jnp.abs(x), jnp.abs(y))
    inverse = 1 / jnp.where(defined, w, 1)
    pixels = [(x * inverse + 1) * size[0], (1 - y * inverse) * size[1], inverse]
    return jnp.where(defined[..., None], jnp.stack(pixels, axis=-1), 0)


@jax.jit
def viewpoint(camera: Camera) -> Float[Array, "4"]:
    """Where the picture is seen from: a homogeneous world point (x, y, z, w).

    A perspective camera has its eye, with w = 1; a parallel one the direction towards the viewer,
    with w = 0, oblique or not. So for every camera the unit vector from p to the viewer is
    `normalize(viewpoint[:3] - viewpoint[3] * p)`. A projection without a centre gives zeros.

    Raises:
        ValueError: for a stack of cameras, or another tree of arrays; of what is none JAX makes
            a TypeError or OverflowError.
    """
    check_single(camera)
    matrix, pivot = pivoted_matrix(camera)
    point = null_vector(matrix[np.array([0, 1, 3])])
    point = jnp.where(dot(matrix[2], point) > 0, -point, point)
    size = jnp.where(point[3] != 0, jnp.abs(point[3]), jnp.max(jnp.abs(point[:3])))
    finite = jnp.sign(point[3])  # 1 or 0 exactly
    return jnp.append(point[:3] / jnp.where(size > 0, size, 1) + finite * pivot, finite)


def pixel_rays(camera: Camera, *, height: int, width: int) -> Float[Array, "height width 3"]:
    """Unit world direction, away from the viewer, of what is seen at every pixel's centre.

    With distortion it is that of the point at infinity, or at any distance, that is drawn there.
    Differentiable in the camera.
    """
    return normalize(pixel_directions(camera, height=height, width=width)[0])


def pixel_directions(
    camera: Camera, *, height: int, width: int, border: int = 0
) -> tuple[Float[Array, "_ _ 3"], Float[Array, "*pixels 2 3"]]:
    """`pixel_rays` of any length, also of pixels beyond the image; and their derivatives.

    The second are those by a step to the next column, and to the next row: the same everywhere,
    (2, 3), for a camera without distortion, else one for each pixel.
    """
    check_single(camera)
    height, width = positive_int("height", height), positive_int("width", width)
    columns, rows = (
        (np.arange(-border, size + border) + 0.5 - size / 2).astype(camera.view.dtype)
        for size in (width, height)
    )
    if camera.distortion is not None:
        return _distorted_directions(camera, columns, rows, height, width)
    centre, *steps = central_rays(camera, height, width)
    rays = centre + columns[:, None] * steps[0] + rows[:, None, None] * steps[1]
    return rays, jnp.stack(steps)


def central_rays(camera: Camera, height: int, width: int) -> Float[Array, "3 3"]:
    """The ray of the picture's centre, and what a step to the next column or row adds to it.

    So any pixel's ray, a world direction away from the viewer, of any length, without distortion.
    """
    centre, steps, depth = _directions(pivoted_matrix(camera)[0][:, :3], height, width)
    rays = jnp.concatenate([centre[None], steps])
    return jnp.where(dot(centre, depth) < 0, -rays, rays)


def _directions(
    to_clip: Float[Array, "4 3"], height: int, width: int
) -> tuple[Array, Array, Array]:
    """Of the picture's middle, by a step to the next column and row; and the depth's row."""
    first, second, depth, last = to_clip
    # The ray lies in the plane of its column, first - x last, and in that of its row.
    steps = jnp.stack(
        [jnp.cross(second, last) * (2 / width), jnp.cross(first, last) * (2 / height)]
    )
    return jnp.cross(first, second), steps, depth


def _distorted_directions(
    camera: Camera, columns: np.ndarray, rows: np.ndarray, height: int, width: int
) -> tuple[Array, Array]:
    """`pixel_directions` in eye space, bent back there, then turned to the world."""
    assert camera.distortion is not None
    centre, steps, _ = _directions(camera.projection[:, :3], height, width)
    x, y, z = camera.view[:3, :3]
    turn = jnp.stack([jnp.cross(y, z), jnp.cross(z, x), jnp.cross(x, y)])  # inverse, but for size
    turn = turn * jnp.where(dot(turn[0], x) < 0, -1, 1)

    ray = [
        centre[i] + columns * steps[0, i] + rows[:, None] * steps[1, i] for i in range(3)
    ]  # (rows, columns) each
    inverse = jnp.where(ray[2] != 0, -1, 0) / jnp.where(ray[2] != 0, ray[2], 1)
    shown = stored((ray[0] * inverse, -ray[1] * inverse))
    (a, b), change = opencv.undistort(shown, camera.distortion)
    changes = []
    for step in steps:  # of what is shown, then of the direction
        moved = [
            (step[0] + shown[0] * step[2]) * inverse,
            -(step[1] - shown[1] * step[2]) * inverse,
        ]
        by_a, by_b = (
            (change[0][i] * moved[0] + change[1][i] * moved[1])[..., None] for i in (0, 1)
        )
        changes.append(by_a * turn[0] - by_b * turn[1])
    rays = a[..., None] * turn[0] - b[..., None] * turn[1] - turn[2]
    return rays, jnp.stack(changes, axis=-2)


# -------------------------------------------------------------------------------------- details


def _vector(name: str, value: ArrayInput) -> Array:
    return float_array(name, value, (3,))


def _placed(
    axes: Array, point: Array, projection: Array, position_eye: Array | None = None
) -> Camera:
    view, remainder = viewing.place(axes, point, position_eye)
    return Camera(view=view, projection=projection, view_remainder=remainder)


def check_single(camera: Camera) -> None:
    """Check a camera that is no stack."""
    instance_of("camera", camera, Camera)
    if camera.view.ndim != 2:
        raise ValueError(
            f"camera: wanted a single camera, got a stack of shape {camera.view.shape[:-2]};"
            " use jax.vmap or render_views"
        )


def pivoted_matrix(camera: Camera) -> tuple[Float[Array, "4 4"], Float[Array, "3"]]:
    """World to clip for positions relative to a pivot near the eye, and the pivot.

    The pivot carries no gradient; it keeps large translations out of what follows.
    """
    eye = null_vector(jax.lax.stop_gradient(camera.view)[:3])
    pivot = eye[:3] / jnp.where(eye[3] != 0, eye[3], 1)
    pivot = jnp.where((eye[3] != 0) & jnp.isfinite(pivot), pivot, 0)
    offset = _compensated.affine(camera.view, jnp.append(camera.view_remainder, 0), pivot)
    view = jnp.concatenate([camera.view[:, :3], offset[:, None]], axis=1)
    return apply_matrix(camera.projection, view.T).T, pivot
