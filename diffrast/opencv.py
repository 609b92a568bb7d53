"""OpenCV's camera model in this library's terms: K [R | t] and lens distortion.

OpenCV's camera has x right, y down and z forward; eye space here has x right, y up and z backward.
Pixels are those of `diffrast.camera`.
"""

from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike
from jaxtyping import Float

from diffrast._check import ArrayInput, float_array, is_concrete, positive_int
from diffrast._stored import stored
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
    if is_concrete(intrinsics):
        (a, b, _), (c, d, _), last = known = np.asarray(intrinsics, np.float64)
        if np.any(last != (0, 0, 1)):
            raise ValueError(f"intrinsics: wanted a last row (0, 0, 1), got {last.tolist()}")
        if a * d == b * c:
            raise ValueError(
                f"intrinsics: wanted focal lengths other than zero, got {known.tolist()}"
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
    x, y, depth = positions_eye[..., 0], -positions_eye[..., 1], -positions_eye[..., 2]
    limit = _radial_limit(distortion)
    offset = norm(jnp.stack([x, y], axis=-1))
    scale = jnp.where(depth * limit > offset, depth, offset / limit)
    safe = jnp.where(scale > 0, scale, 1)
    radial, across, up = _lens(x / safe, y / safe, distortion)
    x = x * radial + scale * across
    y = y * radial + scale * up
    return positions_eye.at[..., 0].set(x).at[..., 1].set(-y)


Pair: TypeAlias = tuple[Float[Array, "*batch"], Float[Array, "*batch"]]


def undistort(place: Pair, distortion: Float[Array, "5"]) -> tuple[Pair, tuple[Pair, Pair]]:
    """What a lens shows at places of its picture: undoes `distort`.

    A start from a table of the radial part is followed by Newton's steps, each halved until it
    helps, and by two plain ones. Only these are differentiated: they have all derivatives of the
    inverse up to the third. Where the lens folds, so that several points are seen at a place, it
    may be any of them, or one seen nearby: always finite.

    Args:
        place: distorted x / depth, to the right, and y / depth, downwards.
        distortion: of the lens.

    Returns:
        x / depth and y / depth of the point; and how both change with the first of the place, and
        with the second.
    """
    limit = _radial_limit(distortion)
    x, y = _root(*lax.stop_gradient((place, distortion)), limit)
    for _ in range(2):
        off, inverse = _newton((x, y), place, distortion, limit)
        across, up = _times(inverse, off)
        size = 1 + jnp.maximum(jnp.abs(x), jnp.abs(y))
        ended = jnp.maximum(jnp.abs(across), jnp.abs(up)) < 1e-2 * size
        x, y = stored((x - jnp.where(ended, across, 0), y - jnp.where(ended, up, 0)))
    return (x, y), _newton((x, y), place, distortion, limit)[1]


def _root(place: Pair, distortion: Array, limit: Array) -> Pair:
    """The start of `undistort`: to within rounding, where Newton's steps get there.

    Where the lens folds they may not get there from within the cone; then they begin beyond it.
    """
    tangents = jnp.asarray(_tangents(distortion.dtype))
    inside = tangents < limit
    last = limit * _lens(limit, jnp.zeros_like(limit), distortion)[0]
    last = jnp.where(last > 0, last, 1)
    shown = tangents * _lens(tangents, jnp.zeros_like(tangents), distortion)[0]
    shown = jnp.where(inside, lax.cummax(jnp.where(inside, shown, 0)), last)
    radius = norm(jnp.stack(place, axis=-1))
    somewhere = jnp.where(radius > 0, radius, 1)
    found = jnp.interp(radius, shown, jnp.minimum(tangents, limit))
    scale = jnp.where(radius < last, found / somewhere, limit / last)
    error, root = _search((scale * place[0], scale * place[1]), place, distortion, limit)
    scale = limit * jnp.maximum(1 / somewhere, 1 / last)
    beyond = [
        jnp.where(_ended(error, place), *both)
        for both in zip(root, (scale * place[0], scale * place[1]), strict=True)
    ]
    again, other = _search((beyond[0], beyond[1]), place, distortion, limit)
    x, y = (jnp.where(again < error, new, old) for new, old in zip(other, root, strict=True))
    return x, y


def _search(start: Pair, place: Pair, distortion: Array, limit: Array) -> tuple[Array, Pair]:
    """Up to eight of Newton's steps, each halved until it helps: squared errors, and where."""

    def ahead(x: Array, y: Array) -> tuple[Array, ...]:
        """A place, its squared error, and the step from there."""
        off, inverse = _newton((x, y), place, distortion, limit)
        across, up = _times(inverse, off)
        return stored((x, y, off[0] * off[0] + off[1] * off[1], -across, -up))

    def goes_on(state: tuple[Array, ...]) -> Array:
        return (state[0] < 8) & ~jnp.all(_ended(state[3], place))

    def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
        count, x, y, error, across, up = state
        new = ahead(x + across, y + up)
        better, ended = new[2] < error, _ended(error, place)
        # A pixel that has arrived stays, so that it does not depend on the others.
        shorter = (x, y, error, *(jnp.where(ended, part, part / 2) for part in (across, up)))
        better = better & ~ended
        return count + 1, *(jnp.where(better, n, o) for n, o in zip(new, shorter, strict=True))

    _, x, y, error, _, _ = lax.while_loop(goes_on, step, (jnp.zeros((), jnp.int32), *ahead(*start)))
    return error, (x, y)


def _ended(error: Array, place: Pair) -> Array:
    """Whether a squared error is as small as rounding."""
    near = 4 * jnp.finfo(error.dtype).eps
    return error <= near * near * (1 + place[0] * place[0] + place[1] * place[1])


def _newton(
    at: Pair, place: Pair, distortion: Array, limit: Array
) -> tuple[Pair, tuple[Pair, Pair]]:
    """How far the lens shows a point from a place; and the inverse of its derivative, by columns.

    Beyond the cone, where it is proportional to the distance from the axis, the derivative along
    that distance is the constant one. An inverse that is not known is zero.
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = at
    offset = norm(jnp.stack(at, axis=-1))
    scale = jnp.maximum(offset / limit, 1)
    a, b = x / scale, y / scale
    radial, across, up = _lens(a, b, distortion)
    u, v = a * radial + across, b * radial + up
    r2 = a * a + b * b
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    ux = radial + a * a * slope + 2 * p1 * b + 6 * p2 * a
    both = a * b * slope + 2 * p1 * a + 2 * p2 * b
    vy = radial + b * b * slope + 6 * p1 * b + 2 * p2 * a
    beyond = jnp.where(scale > 1, 1, 0) / (limit * limit)
    more_u, more_v = beyond * (u - ux * a - both * b), beyond * (v - both * a - vy * b)
    ux, uy = ux + more_u * a, both + more_u * b
    vx, vy = both + more_v * a, vy + more_v * b
    off, (ux, uy, vx, vy) = stored(((scale * u - place[0], scale * v - place[1]), (ux, uy, vx, vy)))
    area = ux * vy - uy * vx
    known = jnp.abs(area) > jnp.finfo(area.dtype).eps * (ux * ux + uy * uy + vx * vx + vy * vy)
    inverse = jnp.where(known, 1, 0) / jnp.where(known, area, 1)
    return off, ((vy * inverse, -vx * inverse), (-uy * inverse, ux * inverse))


def _times(columns: tuple[Pair, Pair], pair: Pair) -> Pair:
    (ax, ay), (bx, by) = columns
    return ax * pair[0] + bx * pair[1], ay * pair[0] + by * pair[1]


def _lens(a: Array, b: Array, distortion: Array) -> tuple[Array, Array, Array]:
    """The radial factor at a point of the plane at depth 1, and the shift that is added."""
    k1, k2, p1, p2, k3 = distortion
    r2 = a * a + b * b
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    across = 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    up = p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    return radial, across, up


def _tangents(dtype: np.dtype) -> np.ndarray:
    """Of angles from the axis: where growth is looked at."""
    return np.tan(np.linspace(0, 0.49 * np.pi, 500)).astype(dtype)


def _radial_limit(distortion: Array) -> Array:
    """Tangent of the angle from the axis up to which r (1 + k1 r^2 + k2 r^4 + k3 r^6) grows."""
    k1, k2, _, _, k3 = lax.stop_gradient(distortion)
    tangents = _tangents(distortion.dtype)
    r2 = tangents**2
    shrinks = 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) <= 0
    first = jnp.where(jnp.any(shrinks), jnp.argmax(shrinks), len(tangents))
    return jnp.asarray(tangents)[jnp.maximum(first - 1, 1)]
