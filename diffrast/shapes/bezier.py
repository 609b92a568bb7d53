"""Bicubic Bézier patches (FEATURES G5; Kos 5 and 12.4).

A patch is 4×4 control points. `control_points[row, column]` follows the order of the thesis's
files and its converter: u runs along a row (over the columns), v from row to row,

    P(u, v) = Σᵢ Σⱼ control_points[i, j] Bᵢ(v) Bⱼ(u),   u, v in [0, 1],

and the outside is where ∂P/∂u × ∂P/∂v points. With u and v the other way round, as the formula of
the thesis's section 5.1 has them, the same files turn inside out.

Where a row of control points collapses to one point (the pole of a lid), ∂P/∂u vanishes and with
it the cross product N. On the way to such a point N keeps a direction, which is that of the first
derivative of N that does not vanish. Coming from inside the patch along (s, t),

    N ≈ ε (DPᵤ × Pᵥ + Pᵤ × DPᵥ),  and  ε² DPᵤ × DPᵥ  where Pᵤ and Pᵥ vanish both,

with D = s ∂/∂u + t ∂/∂v. Derivatives are formed from differences of control points, so that a
collapsed row gives exactly zero.
"""

from collections.abc import Sequence
from functools import partial, reduce
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import ArrayLike
from jaxtyping import Float, Int

from diffrast import _check
from diffrast._check import ArrayInput
from diffrast._tokens import Tokens
from diffrast.linalg import normalize
from diffrast.mesh import Mesh, merge_near_vertices
from diffrast.shapes._grid import grid_faces, grid_uvs, two_counts


class PatchPoints(NamedTuple):
    """Points of patches; for parameters of shape (...) the axes are (patches, ..., 3)."""

    position: Float[Array, "patches *samples 3"]
    tangent_u: Float[Array, "patches *samples 3"]  # ∂P/∂u
    tangent_v: Float[Array, "patches *samples 3"]  # ∂P/∂v
    normal: Float[Array, "patches *samples 3"]  # unit, along ∂P/∂u × ∂P/∂v


class BezierPatches(NamedTuple):
    """Patches that share control points, each belonging to a surface of the object."""

    points: Float[np.ndarray, "points 3"]
    indices: Int[np.ndarray, "patches 4 4"]
    surfaces: Int[np.ndarray, "patches"]

    @property
    def control_points(self) -> Float[np.ndarray, "patches 4 4 3"]:
        """The points of each patch."""
        return self.points[self.indices]


def evaluate(control_points: ArrayInput, u: ArrayInput, v: ArrayInput) -> PatchPoints:
    """Positions, tangents and exact unit normals of bicubic patches.

    Differentiable in everything. The normal is zero only where the patch has no tangent plane.

    Args:
        control_points: shape (patches, 4, 4, 3), see the module for their order.
        u: parameter along a row; u and v broadcast against each other.
        v: parameter from row to row.
    """
    control = _check.float_array("control_points", control_points, ("patches", 4, 4, 3))
    u, v = _check.float_array("u", u), _check.float_array("v", v)
    parameters = jnp.broadcast_arrays(u, 1 - u, v, 1 - v)
    return _evaluate_traced(control, *parameters, epsilon=_epsilon(control))


def bezier_mesh(
    control_points: ArrayInput,
    divisions: int | tuple[int, ...] = 10,
    *,
    merge_tolerance: ArrayLike | None = None,
) -> Mesh:
    """Triangle mesh of bicubic patches with their exact normals.

    Patches follow one another, in each the vertices row after row: with n divisions along u and m
    along v, patch p has the (n + 1)(m + 1) vertices from p (n + 1)(m + 1) on and 2 n m faces, none
    left out where a row collapses. Vertices of edges that two patches share are equal to the bit
    when the control points are known numbers; they are computed in float64 then. Texture
    coordinates are (u, v) in each patch. Differentiable in the control points.

    Args:
        control_points: shape (patches, 4, 4, 3), see the module for their order.
        divisions: cells along u and v, or (along u, along v).
        merge_tolerance: merge vertices up to this distance apart as `merge_near_vertices` does,
            averaging normals and dropping texture coordinates; for known numbers only. `None`
            merges nothing.
    """
    control = _check.float_array("control_points", control_points, ("patches", 4, 4, 3))
    if control.shape[0] == 0:
        raise ValueError("control_points: wanted at least one patch, got none")
    columns, rows = two_counts("divisions", divisions)
    if merge_tolerance is not None:
        _check.distance("merge_tolerance", merge_tolerance)
    # u and 1 − u both rounded once: exact mirror images, as u and v are on edges that meet.
    uvs, mirrored = grid_uvs(columns, rows), grid_uvs(columns, rows)[::-1]
    parameters = (uvs[:, 0], mirrored[:, 0], uvs[:, 1], mirrored[:, 1])
    if _check.is_concrete(control):
        numbers = np.asarray(control, dtype=np.float64)
        exact = _evaluate(numbers, *parameters, epsilon=_epsilon(control), xp=np)
        with _check.staying_known(control):
            points = PatchPoints(*(jnp.asarray(values, control.dtype) for values in exact))
    else:
        rounded = [jnp.asarray(values, control.dtype) for values in parameters]
        points = _evaluate_traced(control, *rounded, epsilon=_epsilon(control))
    patches, samples = points.position.shape[:2]
    faces = grid_faces(columns, rows) + samples * np.arange(patches)[:, None, None]
    with _check.staying_known(points):
        mesh = Mesh(
            vertices=points.position.reshape(-1, 3),
            faces=faces.reshape(-1, 3),
            normals=points.normal.reshape(-1, 3),
            uvs=np.tile(uvs, (patches, 1)) if merge_tolerance is None else None,
        )
    return mesh if merge_tolerance is None else merge_near_vertices(mesh, merge_tolerance)


def parse_bezier(text: str, name: str = "text") -> BezierPatches:
    """Read the thesis's patch format.

    A line with the numbers of points, patches and surfaces; for every point its number and three
    coordinates; for every patch its number, surface, number of points (16) and their numbers, row
    after row. Anything in braces is a comment.

    Raises:
        ValueError: naming `name` and the line, for anything else.
    """
    _check.instance_of("text", text, str)
    tokens = Tokens(text, name)
    points = tokens.integer("the number of control points", 1)
    patches = tokens.integer("the number of patches", 1)
    surfaces = tokens.integer("the number of surfaces", 1, 1 << 31)
    # Lists grow with what is read: the numbers above may be any.
    coordinates: list[list[float]] = []
    for number in range(points):
        tokens.integer(f"control point number {number}", number, number + 1)
        coordinates.append([tokens.number(f"{axis} of control point {number}") for axis in "xyz"])
    indices: list[list[int]] = []
    owners: list[int] = []
    for number in range(patches):
        tokens.integer(f"patch number {number}", number, number + 1)
        owners.append(tokens.integer(f"the surface of patch {number}", 0, surfaces))
        tokens.integer(f"the number of control points of patch {number}", 16, 17)
        wanted = f"a control point of patch {number}"
        indices.append([tokens.integer(wanted, 0, points) for _ in range(16)])
    tokens.end()
    corners = np.array(indices, np.int32).reshape(-1, 4, 4)
    return BezierPatches(np.array(coordinates), corners, np.array(owners, np.int32))


def _evaluate(
    control: Any, u: Any, rest_u: Any, v: Any, rest_v: Any, *, epsilon: float, xp: Any
) -> PatchPoints:
    """Evaluate at u and v, given with 1 − u and 1 − v.

    Args:
        control: shape (patches, 4, 4, 3).
        u: this and the next three are of one shape.
        rest_u: 1 − u.
        v: see u.
        rest_v: 1 − v.
        epsilon: relative rounding error of the control points; vectors within it of parallel are.
        xp: `numpy` or `jax.numpy`.
    """
    # Differences first, scaling after: a fused multiply-add would spoil the exact zeros.
    along_u, along_v = control[:, :, 1:] - control[:, :, :-1], control[:, 1:] - control[:, :-1]
    bend_u, bend_v = along_u[:, :, 1:] - along_u[:, :, :-1], along_v[:, 1:] - along_v[:, :-1]
    twist = along_u[:, 1:] - along_u[:, :-1]
    size = xp.max(xp.abs(control - control[:, :1, :1]), axis=(1, 2, 3), keepdims=True)
    if xp is jnp:
        size = lax.stop_gradient(size)  # it cancels
    size = xp.where(size > 0, size, 1)
    parameters = (u, rest_u, v, rest_v)
    p_u, p_v, p_uu, p_uv, p_vv = (
        degrees * _blend(net / size, parameters, xp)
        for degrees, net in ((3, along_u), (3, along_v), (6, bend_u), (9, twist), (6, bend_v))
    )
    inward_u, inward_v = (rest_u - u)[..., None], (rest_v - v)[..., None]
    d_u, d_v = inward_u * p_uu + inward_v * p_uv, inward_u * p_uv + inward_v * p_vv
    normal = xp.zeros_like(p_u)
    for terms in ([(d_u, d_v)], [(d_u, p_v), (p_u, d_v)], [(p_u, p_v)]):
        vector = sum(xp.cross(a, b) for a, b in terms)
        largest = sum(_length(a, xp) * _length(b, xp) for a, b in terms)
        normal = xp.where(_length(vector, xp) > epsilon * largest, vector, normal)
    size = size.reshape(-1, *(1,) * u.ndim, 1)
    return PatchPoints(_blend(control, parameters, xp), size * p_u, size * p_v, _unit(normal, xp))


_evaluate_traced = jax.jit(partial(_evaluate, xp=jnp), static_argnames="epsilon")


def _blend(net: Any, parameters: Sequence[Any], xp: Any) -> Any:
    """Sum a control net (patches, rows, columns, 3) over products of Bernstein polynomials.

    On the host terms are added in an order that makes edges of neighbours equal to the bit; XLA
    fuses products into sums as it likes, so there the shortest program is as good.

    Args:
        net: control points or their differences.
        parameters: u, 1 − u, v, 1 − v.
        xp: `numpy` or `jax.numpy`.
    """
    u, rest_u, v, rest_v = parameters
    rows, columns = net.shape[1:3]
    in_row, of_rows = _bernstein(u, rest_u, columns - 1, xp), _bernstein(v, rest_v, rows - 1, xp)
    if xp is jnp:
        return jnp.einsum("r...,c...,prcx->p...x", of_rows, in_row, net, precision="highest")
    net = net.reshape(net.shape[0], rows, columns, *(1,) * u.ndim, 3)
    return _fold(_fold(net * in_row[..., None], axis=2) * of_rows[..., None], axis=1)


def _bernstein(t: Any, rest: Any, degree: int, xp: Any) -> Any:
    """Bernstein polynomials of t, with 1 − t given; a mirrored t mirrors them to the bit."""
    if degree == 1:
        return xp.stack([rest, t])
    if degree == 2:
        return xp.stack([rest * rest, 2 * (t * rest), t * t])
    both = 3 * (t * rest)
    return xp.stack([rest * rest * rest, both * rest, both * t, t * t * t])


def _fold(terms: Any, axis: int) -> Any:
    """Sum from both ends to the middle, so that a list and its mirror image round alike."""
    count = terms.shape[axis]
    first = [terms[(slice(None),) * axis + (k,)] for k in range(count)]
    pairs = [first[k] + first[count - 1 - k] for k in range(count // 2)]
    return reduce(add, pairs + first[count // 2 : (count + 1) // 2])


def _epsilon(control: Array) -> float:
    return 16 * float(jnp.finfo(control.dtype).eps)


def _length(vectors: Any, xp: Any) -> Any:
    return xp.sqrt(xp.sum(vectors * vectors, axis=-1, keepdims=True))


def _unit(vectors: Any, xp: Any) -> Any:
    if xp is jnp:
        return normalize(vectors)
    length = _length(vectors, np)
    return vectors / np.where(length > 0, length, 1)
