"""View and projection matrices: where the camera stands, and what part of space it shows.

A view takes the world to eye space: the camera at the origin, looking along -z, x to the right, y
up. A projection takes eye space to OpenGL's clip space, -w <= x, y, z <= w for what is shown.

Every projection here is a window in a plane in front of the eye: with the window's centre (a, b)
and half sizes (h, k) at distance d, the eye-space point (x, y, z) has

    clip x = (d x + a z) / h,    clip y = (d y + b z) / k,

and clip w = -z (perspective: rays through the eye) or clip w = d (parallel: rays in the direction
from the eye to the window's centre, oblique where a or b is not zero).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from diffrast import _compensated
from diffrast._check import ArrayInput, float_array, is_concrete, one_of, real_number
from diffrast.linalg import dot, norm, normalize

# --------------------------------------------------------------------------------------- views


def look_at(eye: ArrayInput, target: ArrayInput, up: ArrayInput) -> Float[Array, "4 4"]:
    """View matrix of a camera at `eye` (3,) that looks at `target` (3,). FEATURES T2.

    See `look_along`. Where `eye == target` the camera looks along the world's -z.
    """
    eye = float_array("eye", eye, (3,))
    return look_along(eye, float_array("target", target, (3,)) - eye, up)


def look_along(eye: ArrayInput, direction: ArrayInput, up: ArrayInput) -> Float[Array, "4 4"]:
    """View matrix of a camera at `eye` (3,) that looks along `direction` (3,). FEATURES T2.

    Differentiable in all three. With the world's z as `up` this is the eye system of A 16.
    """
    return place(view_axes(direction, up), float_array("eye", eye, (3,)))[0]


def view_axes(direction: ArrayInput, up: ArrayInput) -> Float[Array, "3 3"]:
    """Rows right, up and backward of a camera that looks along `direction` with `up` upward.

    The lengths of both vectors play no role. A zero direction counts as the world's -z. An `up`
    that is zero, or parallel to the direction to within rounding, is replaced by the world axis
    that is most nearly perpendicular to the direction (the first of equals); there the result has
    no derivative with respect to `up`.
    """
    direction = float_array("direction", direction, (3,))
    return _axes(direction, float_array("up", up, (3,)))


@jax.jit
def _axes(direction: Array, up: Array) -> Array:
    fallback = jnp.array([0, 0, 1], direction.dtype)
    backward = jnp.where(jnp.any(direction != 0), normalize(-direction), fallback)
    axis = jax.nn.one_hot(jnp.argmin(jnp.abs(backward)), 3, dtype=backward.dtype)
    across = jax.lax.stop_gradient(norm(jnp.cross(normalize(up), backward)))
    usable = across > 4 * jnp.finfo(across.dtype).eps
    right = normalize(jnp.cross(jnp.where(usable, normalize(up), axis), backward))
    # The product of nearly parallel vectors is not exactly perpendicular to them: straighten it.
    right = normalize(right - dot(right, backward) * backward)
    return jnp.stack([right, jnp.cross(backward, right), backward])


def axes_towards(
    eye: Float[Array, "3"],
    target: ArrayInput | None,
    direction: ArrayInput | None,
    up: ArrayInput,
) -> Float[Array, "3 3"]:
    """`view_axes` of a camera that looks at a target or in a direction: one of them is given."""
    if target is not None and direction is None:
        direction = float_array("target", target, (3,)) - eye
    elif target is not None or direction is None:
        count = "none" if direction is None else "both"
        raise ValueError(f"target, direction: wanted one of the two, got {count}")
    return view_axes(direction, up)


@jax.jit
def place(
    axes: Float[Array, "3 3"],
    point: Float[Array, "3"],
    position_eye: Float[Array, "3"] | None = None,
) -> tuple[Float[Array, "4 4"], Float[Array, "3"]]:
    """View matrix of a camera with these axes that has `point` at `position_eye` of its eye space.

    By default that is the origin: `point` is the eye. The second result is what rounding took
    from the translation `position_eye - axes @ point`; see `Camera.view_remainder`. It has no
    derivative.
    """
    column = jnp.zeros_like(point) if position_eye is None else -position_eye
    linear = jnp.concatenate([axes, column[:, None]], axis=1)
    offset = -_compensated.affine(linear, jnp.zeros_like(point), point)
    remainder = -_compensated.affine_parts(linear, jnp.zeros_like(point), point)[1]
    upper = jnp.concatenate([axes, offset[:, None]], axis=1)
    view = jnp.concatenate([upper, jnp.array([[0, 0, 0, 1]], upper.dtype)])
    return view, jax.lax.stop_gradient(remainder)


def spherical_axes(theta: ArrayLike, phi: ArrayLike) -> Float[Array, "3 3"]:
    """Rows right, up and backward of a camera in the direction (theta, phi) from its target.

    Backward is (sin phi cos theta, sin phi sin theta, cos phi); right has no z component. Defined
    at the poles too. The first three columns of A 6.1's V, transposed.
    """
    theta, phi = real_number("theta", theta), real_number("phi", phi)
    (ct, st), (cp, sp) = (jnp.cos(theta), jnp.sin(theta)), (jnp.cos(phi), jnp.sin(phi))
    zero = jnp.zeros_like(st)
    return jnp.array([[-st, ct, zero], [-ct * cp, -st * cp, sp], [ct * sp, st * sp, cp]])


# --------------------------------------------------------------------------------- projections


def perspective_projection(
    *, window: ArrayInput, distance: ArrayLike, near: ArrayLike, far: ArrayLike
) -> Float[Array, "4 4"]:
    """Projection through the eye onto a window, differentiable in everything.

    Args:
        window: left, right, bottom, top of the window in eye-space units.
        distance: of the window's plane from the eye, above zero.
        near: depth of the nearest points shown, above zero.
        far: depth of the farthest points shown, above near.
    """
    x, y = _window_rows(window, real_number("distance", distance, above=0.0))
    return jnp.stack([x, y, *perspective_depth_rows(near, far)])


def parallel_projection(
    *, window: ArrayInput, distance: ArrayLike, near: ArrayLike, far: ArrayLike
) -> Float[Array, "4 4"]:
    """Projection along parallel rays onto a window, differentiable in everything.

    Args:
        window: left, right, bottom, top of the window in eye-space units.
        distance: of the window's plane from the eye, above zero. It matters for oblique
            projections only: the rays run in the direction from the eye to the window's centre.
        near: depth of the nearest points shown; may be negative.
        far: depth of the farthest points shown, above near.
    """
    near, far = _depth_range(near, far, lowest=-np.inf)
    distance = real_number("distance", distance, above=0.0)
    x, y = (row / distance for row in _window_rows(window, distance))
    z = jnp.array([0, 0, 2 / (near - far), (near + far) / (near - far)])
    return jnp.stack([x, y, z, jnp.array([0, 0, 0, 1], z.dtype)])


def field_of_view_projection(
    fov_y: ArrayLike, aspect: ArrayLike, near: ArrayLike, far: ArrayLike
) -> Float[Array, "4 4"]:
    """Perspective projection of a field of view `fov_y` high, in radians."""
    height = 2 * jnp.tan(real_number("fov_y", fov_y, above=0.0, below=np.pi) / 2)
    window = centred_window(height, aspect)
    return perspective_projection(window=window, distance=1.0, near=near, far=far)


def centred_window(height: ArrayLike, aspect: ArrayLike) -> Float[Array, "4"]:
    """Left, right, bottom, top of a window round the axis; aspect is width over height."""
    height = real_number("height", height, above=0.0)
    aspect = real_number("aspect", aspect, above=0.0)
    return jnp.stack([-aspect * height, aspect * height, -height, height]) / 2


def phigs_projection(
    *,
    projection_reference_point: ArrayInput,
    window: ArrayInput,
    view_plane_distance: ArrayLike,
    front: ArrayLike,
    back: ArrayLike,
    projection: str,
) -> Float[Array, "4 4"]:
    """Projection of a camera in the terms of PHIGS, whose eye space has its origin at the PRP.

    See `Camera.phigs` for the arguments.
    """
    one_of("projection", projection, ("perspective", "parallel"))
    reference = float_array("projection_reference_point", projection_reference_point, (3,))
    u, v, n = reference
    front = real_number("front", front, below=_known(n) if projection == "perspective" else np.inf)
    back = real_number("back", back, below=_known(front))
    plane = real_number("view_plane_distance", view_plane_distance, below=_known(n))
    window = float_array("window", window, (4,)) - jnp.stack([u, u, v, v])
    make = perspective_projection if projection == "perspective" else parallel_projection
    return make(window=window, distance=n - plane, near=n - front, far=n - back)


def oblique_reference_point(
    window: ArrayInput,
    *,
    foreshortening: ArrayLike,
    angle: ArrayLike = np.pi / 4,
    view_plane_distance: ArrayLike = 0.0,
) -> Float[Array, "3"]:
    """Projection reference point of a parallel projection that shows depth obliquely.

    Lines that run away from the viewer, perpendicular to the view plane, are drawn at `angle`
    (radians, counter-clockwise from the u axis) and with `foreshortening` times their length: 1 is
    the cavalier projection, 1/2 the cabinet projection. FEATURES T3.

    Args:
        window: u_min, u_max, v_min, v_max, as in `Camera.phigs`.
        foreshortening: drawn length over true length.
        angle: of the receding lines in the picture.
        view_plane_distance: as in `Camera.phigs`.
    """
    u_min, u_max, v_min, v_max = float_array("window", window, (4,))
    shift = real_number("foreshortening", foreshortening)
    angle = real_number("angle", angle)
    plane = real_number("view_plane_distance", view_plane_distance)
    return jnp.stack(
        [
            (u_min + u_max) / 2 + shift * jnp.cos(angle),
            (v_min + v_max) / 2 + shift * jnp.sin(angle),
            plane + 1,
        ]
    )


def perspective_depth_rows(
    near: ArrayLike, far: ArrayLike
) -> tuple[Float[Array, "4"], Float[Array, "4"]]:
    """Rows z and w of a perspective projection that shows depths from near to far."""
    near, far = _depth_range(near, far, lowest=0.0)
    ratio = near / (near - far)  # before the product, which could overflow
    z = jnp.array([0, 0, (near + far) / (near - far), 2 * far * ratio])
    return z, jnp.array([0, 0, -1, 0], z.dtype)


def _depth_range(near: ArrayLike, far: ArrayLike, *, lowest: float) -> tuple[Array, Array]:
    """Check that lowest < near < far."""
    near = real_number("near", near, above=lowest)
    return near, real_number("far", far, above=_known(near, default=lowest))


def _known(number: Array, default: float = np.inf) -> float:
    """The value of a number that bounds another; the default while it is traced."""
    return float(number) if is_concrete(number) else default


def _window_rows(window: ArrayInput, distance: Array) -> tuple[Array, Array]:
    """Rows x and y of the projection onto a window."""
    left, right, bottom, top = window = float_array("window", window, (4,))
    if is_concrete(window) and not np.all(np.asarray(window)[::2] < np.asarray(window)[1::2]):
        raise ValueError(
            "window: wanted its minimum, maximum in x, then in y, each minimum below its maximum,"
            f" got {np.asarray(window).tolist()}"
        )
    zero = jnp.zeros_like(left)
    across, upward = (right - left) / 2, (top - bottom) / 2
    x = jnp.stack([distance / across, zero, (left + right) / 2 / across, zero])
    y = jnp.stack([zero, distance / upward, (bottom + top) / 2 / upward, zero])
    return x, y
