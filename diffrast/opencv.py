"""OpenCV's camera model in this library's terms: K [R | t] and lens distortion.

OpenCV's camera has x right, y down and z forward; eye space here has x right, y up and z backward.
Pixels are those of `diffrast.camera`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from diffrast._check import ArrayInput, float_array, is_concrete, positive_int
from diffrast.linalg import norm
from diffrast.viewing import perspective_depth_rows


class OpenCVParameters(NamedTuple):
    """What OpenCV calls K, R and t, and its distCoeffs."""

    intrinsics: Float[Array, "3 3"]
    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]
    distortion: Float[Array, "5"] | None


def view_from_opencv(rotation: ArrayInput, translation: ArrayInput) -> Float[Array, "4 4"]:
    """View matrix of a camera with these extrinsics; see `Camera.opencv`."""
    rotation = float_array("rotation", rotation, (3, 3))
    if is_concrete(rotation):
        known = np.asarray(rotation, np.float64)
        if np.abs(known @ known.T - np.eye(3)).max() > 1e-3 or np.linalg.det(known) < 0:
            raise ValueError(f"rotation: wanted a rotation matrix, got {known.tolist()}")
    offset = float_array("translation", translation, (3,))
    x, y, z = jnp.concatenate([rotation, offset[:, None]], axis=1)
    return jnp.stack([x, -y, -z, jnp.array([0, 0, 0, 1], x.dtype)])


def projection_from_opencv(
    *, intrinsics: ArrayInput, width: int, height: int, near: ArrayLike, far: ArrayLike
) -> Float[Array, "4 4"]:
    """Projection of a camera with this intrinsic matrix; see `Camera.opencv`."""
    intrinsics = float_array("intrinsics", intrinsics, (3, 3))
    if is_concrete(intrinsics) and np.any(np.asarray(intrinsics)[2] != (0, 0, 1)):
        raise ValueError(
            f"intrinsics: wanted a last row (0, 0, 1), got {np.asarray(intrinsics)[2].tolist()}"
        )
    x = 2 * intrinsics[0] / positive_int("width", width)
    y = 2 * intrinsics[1] / positive_int("height", height)
    zero = jnp.zeros_like(x[0])
    x = jnp.stack([x[0], -x[1], 1 - x[2], zero])
    y = jnp.stack([-y[0], y[1], y[2] - 1, zero])
    return jnp.stack([x, y, *perspective_depth_rows(near, far)])


def parameters_from_matrices(
    view: Float[Array, "4 4"], projection: Float[Array, "4 4"], *, height: int, width: int
) -> OpenCVParameters:
    """Undo `view_from_opencv` and `projection_from_opencv`; there is no distortion in these."""
    wanted = (0, 0, -1, 0)
    if is_concrete(projection) and np.any(np.asarray(projection)[3] != wanted):
        raise ValueError(
            f"camera: wanted a perspective camera, with a last row of the projection {wanted}, got"
            f" {np.asarray(projection)[3].tolist()}"
        )
    x = projection[0] * positive_int("width", width) / 2
    y = projection[1] * positive_int("height", height) / 2
    intrinsics = jnp.stack(
        [
            jnp.stack([x[0], -x[1], width / 2 - x[2]]),
            jnp.stack([-y[0], y[1], height / 2 + y[2]]),
            jnp.array([0, 0, 1], x.dtype),
        ]
    )
    rigid = jnp.stack([view[0], -view[1], -view[2]])
    return OpenCVParameters(intrinsics, rigid[:, :3], rigid[:, 3], None)


def distort(
    positions_eye: Float[Array, "*batch 4"], distortion: Float[Array, "5"]
) -> Float[Array, "*batch 4"]:
    """Bend eye-space positions so that their projection shows the lens's distortion.

    With d = depth the point (x, y, d) becomes (d a, d b, d), where (a, b) is the distorted (x / d,
    y / d). Outside of the cone in which the lens model grows, d in this is the depth at which the
    point would lie on the cone: positive, whatever the true depth.
    """
    k1, k2, p1, p2, k3 = distortion
    x, y, depth = positions_eye[..., 0], -positions_eye[..., 1], -positions_eye[..., 2]
    limit = _radial_limit(distortion)
    offset = norm(jnp.stack([x, y], axis=-1))
    scale = jnp.where(depth * limit > offset, depth, offset / limit)
    safe = jnp.where(scale > 0, scale, 1)
    a, b = x / safe, y / safe
    r2 = a * a + b * b
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    x = x * radial + scale * (2 * p1 * a * b + p2 * (r2 + 2 * a * a))
    y = y * radial + scale * (p1 * (r2 + 2 * b * b) + 2 * p2 * a * b)
    return positions_eye.at[..., 0].set(x).at[..., 1].set(-y)


def _radial_limit(distortion: Array) -> Array:
    """Tangent of the angle from the axis up to which r (1 + k1 r^2 + k2 r^4 + k3 r^6) grows."""
    k1, k2, _, _, k3 = jax.lax.stop_gradient(distortion)
    tangents = np.tan(np.linspace(0, 0.49 * np.pi, 500)).astype(distortion.dtype)
    r2 = tangents**2
    shrinks = 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) <= 0
    first = jnp.where(jnp.any(shrinks), jnp.argmax(shrinks), len(tangents))
    return jnp.asarray(tangents)[jnp.maximum(first - 1, 1)]
