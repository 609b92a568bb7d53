"""Pictures and derivatives of many samples a pixel, and how far renderers are from them.

No treatment of edges is in them: a picture of 256 samples a pixel is jagged at a sixteenth of a
pixel, and its derivative by a motion is a central difference over half a pixel. Several such
pictures may be averaged, whose samples lie between one another's: what sets these apart tells how
exact their mean is.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import renderer
from renderer import PARAMETERS, POSE, Peer, Task, in_floats

import diffrast as dr

STEP = 0.5  # of differences, in pixels
# A picture of parameters, and of how far its samples are shifted, (right, down) in pixels.
Draw = Callable[[jax.Array, tuple[float, float]], jax.Array]


@dataclasses.dataclass(frozen=True)
class Exact:
    """What renderers should find.

    Attributes:
        images: (pictures, size, size, 3), to be averaged.
        slopes: (pictures, fields, parameters), of sums of the pictures weighted by `fields`.
        fields: smooth, random, (fields, size, size, 3).
        scale: (parameters,), changes by which the parameters move things by a pixel or so; slopes
            are by these units.
    """

    images: np.ndarray
    slopes: np.ndarray
    fields: np.ndarray
    scale: np.ndarray

    def errors(self, image: np.ndarray, slopes: np.ndarray | None = None) -> dict[str, float]:
        """How far a picture, and slopes by `scale`, are from the mean."""
        difference = image - self.images.mean(axis=0)
        result = {
            "rmse": float(np.sqrt((difference**2).mean())),
            "mean_difference": float(np.abs(difference).mean()),
        }
        if slopes is not None:
            wanted = self.slopes.mean(axis=0)
            norms = np.linalg.norm(slopes) * np.linalg.norm(wanted)
            result["gradient_error"] = relative_error(slopes, wanted)
            result["gradient_cosine"] = float(np.vdot(slopes, wanted) / norms) if norms else 0.0
        return result

    def own_errors(self) -> dict[str, float]:
        """About how far the mean of several pictures may be off: half what its halves are apart."""
        odd = _bits(len(self.images)).sum(axis=1) % 2 == 1  # halves with the same mean shift
        half = dataclasses.replace(self, images=self.images[odd], slopes=self.slopes[odd])
        errors = half.errors(self.images[~odd].mean(axis=0), self.slopes[~odd].mean(axis=0))
        return {name: errors[name] / 2 for name in ("rmse", "mean_difference", "gradient_error")}


def exact(
    draw: Draw, size: int, scale: np.ndarray, *, samples: int, pictures: int = 1, fields: int = 1
) -> Exact:
    """Draw many samples a pixel.

    Args:
        draw: the picture, of `samples` a pixel on a regular grid.
        size: its rows and columns.
        scale: (parameters,), changes of a pixel or so.
        samples: a pixel of one picture.
        pictures: how many, a power of two, each shifted by other fractions of the distance of two
            samples (Hammersley's points).
        fields: how many random ones.
    """
    weights = smooth_fields(size, fields)
    bits = _bits(pictures)
    powers = 2 ** np.arange(bits.shape[1])
    shifts = np.stack([bits @ powers, bits @ powers[::-1]], axis=1) + 0.5
    shifts = (shifts / pictures - 0.5) / samples**0.5
    images, found = [], []
    for shift in shifts.tolist():
        images.append(np.asarray(draw(jnp.zeros(len(scale)), tuple(shift)), np.float64))
        found.append(slopes(draw, weights, np.diag(scale), STEP, tuple(shift)))
    return Exact(np.stack(images), np.stack(found), weights, scale)


def _bits(count: int) -> np.ndarray:
    """The binary digits (count, digits) of the numbers below a power of two."""
    return np.arange(count)[:, None] >> np.arange(round(np.log2(count))) & 1


def smooth_fields(size: int, count: int = 1) -> np.ndarray:
    """Random weights of pictures, with twelve waves or so across them: (count, size, size, 3)."""
    coarse = jnp.asarray(np.random.default_rng(0).normal(size=(count, 12, 12, 3)))
    return np.asarray(jax.image.resize(coarse, (count, size, size, 3), "cubic"), np.float64)


def slopes(
    draw: Draw,
    fields: np.ndarray,
    motions: np.ndarray,
    step: float,
    shift: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """Central differences of the picture's sums weighted by fields, along motions.

    Their shape is (fields, motions).
    """
    found = []
    for motion in motions:
        ahead, behind = (draw(jnp.asarray(sign * motion), shift) for sign in (step, -step))
        change = np.asarray(ahead, np.float64) - np.asarray(behind, np.float64)
        found.append(np.einsum("fhwc,hwc->f", fields, change) / (2 * step))
    return np.stack(found, axis=1)


def shifted(camera: dr.Camera, shift: tuple[float, float], size: int) -> dr.Camera:
    """A camera whose pixels lie (right, down) of where they were."""
    move = jnp.eye(4).at[:2, 3].set(jnp.array([-2 * shift[0], 2 * shift[1]]) / size)
    return dr.Camera(view=camera.view, projection=move @ camera.projection)


# Tasks of `renderer` ------------------------------------------------------------------------------


@jax.jit
def exact_picture(arguments: Any, parameters: jax.Array, settings: dr.RenderSettings) -> jax.Array:
    """Draw with everything moved by parameters."""
    return renderer.draw(arguments, parameters, settings)


def pose_steps(task: Task) -> np.ndarray:
    """Changes of the six pose parameters that move the mesh by one pixel on average."""
    vertices = np.asarray(task.mesh.vertices, np.float64)
    view = np.asarray(task.camera.view, np.float64)
    eye = vertices @ view[:3, :3].T + view[:3, 3]
    moves = [np.cross(axis, eye) for axis in np.eye(3)]
    moves += [np.broadcast_to(axis, eye.shape) for axis in np.eye(3)]
    steps = []
    for move in moves:
        depth = -eye[:, 2:]
        pixels = (move[:, :2] + eye[:, :2] * move[:, 2:] / depth) / depth
        pixels = pixels * task.focal * task.size / 2
        steps.append(1 / np.sqrt((pixels**2).sum(axis=1).mean()))
    return np.array(steps)


def pose_picture(task: Task, shading: str, samples: int) -> Draw:
    """The jagged picture of a task by the parameters of the pose."""
    settings = dr.RenderSettings(
        height=task.size,
        width=task.size,
        samples=samples,
        antialias=False,
        shading=shading,
        cull_backfaces=task.closed,
    )
    mesh, camera, direction = renderer.arguments_of(task)

    def draw(pose: jax.Array, shift: tuple[float, float]) -> jax.Array:
        arguments = mesh, shifted(camera, shift, task.size), direction
        return exact_picture(arguments, jnp.zeros(PARAMETERS).at[POSE].set(pose), settings)

    return draw


def pose_slopes(peer: Peer, truth: Exact, field: int = 0) -> np.ndarray:
    """A renderer's derivative of the sum weighted by one of the fields, by the pose."""
    return peer.gradient(far_target(truth.fields[field]))[POSE] / 2e3 * truth.scale


def far_target(field: np.ndarray) -> np.ndarray:
    """So far away that the squared difference to it is linear in the picture."""
    return np.float32(-1e3 * field)


def qualities(task: Task, found: Sequence[Peer], samples: int) -> dict[str, dict[str, Any]]:
    """Errors of pictures and pose derivatives."""
    truths, spreads = {}, {}
    for shading in {peer.shading for peer in found}:
        draw = pose_picture(task, shading, samples)
        truth = truths[shading] = exact(draw, task.size, pose_steps(task), samples=samples)
        # A difference that has converged does not depend on its step.
        slope = truth.slopes[0, 0]
        along = slope / np.linalg.norm(slope)
        other = slopes(draw, truth.fields, (along * truth.scale)[None], STEP / 2)[0, 0]
        spreads[shading] = abs(float(other / (along @ slope)) - 1)
    results: dict[str, dict[str, Any]] = {}
    for peer in found:
        truth = truths[peer.shading]
        found_slopes = pose_slopes(peer, truth)[None] if peer.differentiable else None
        result: dict[str, Any] = truth.errors(in_floats(peer.image()), found_slopes)
        if peer.differentiable:
            result["reference_spread"] = spreads[peer.shading]
        results[peer.name] = result
    return results


def relative_error(value: np.ndarray, wanted: np.ndarray) -> float:
    """Length of the difference over that of what was wanted."""
    return float(np.linalg.norm(value - wanted) / np.linalg.norm(wanted))
