"""Pictures and derivatives of many samples a pixel, and how far renderers are from them.

No treatment of edges is in them: a picture of 256 samples a pixel is jagged at a sixteenth of a
pixel, and its derivative by a motion is a central difference over half a pixel.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import peers
from peers import POSE, Peer, Task, in_floats

import diffrast as dr


@jax.jit
def exact_picture(arguments: Any, parameters: jax.Array, settings: dr.RenderSettings) -> jax.Array:
    """Draw with everything moved by parameters."""
    return peers.draw(arguments, parameters, settings)


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


def exact_slopes(
    task: Task,
    field: np.ndarray,
    settings: dr.RenderSettings,
    directions: np.ndarray,
    step: float,
) -> np.ndarray:
    """Central differences of the exact picture's sum weighted by a field, along motions."""
    arguments, scale = peers.arguments_of(task), pose_steps(task)
    slopes = []
    for direction in directions * scale:
        ahead, behind = (
            exact_picture(arguments, jnp.zeros(12).at[POSE].set(sign * direction), settings)
            for sign in (step, -step)
        )
        change = np.asarray(ahead, np.float64) - np.asarray(behind, np.float64)
        slopes.append((change * field).sum() / (2 * step))
    return np.array(slopes)


def qualities(task: Task, found: Sequence[Peer], samples: int) -> dict[str, dict[str, Any]]:
    """Errors of pictures and pose derivatives."""
    generator = np.random.default_rng(0)
    coarse = jnp.asarray(generator.normal(size=(12, 12, 3)))
    field = np.asarray(jax.image.resize(coarse, (task.size, task.size, 3), "cubic"), np.float64)
    exact, slopes, spreads = {}, {}, {}
    for shading in {peer.shading for peer in found}:
        settings = dr.RenderSettings(
            height=task.size,
            width=task.size,
            samples=samples,
            antialias=False,
            shading=shading,
            cull_backfaces=task.closed,
        )
        exact[shading] = np.asarray(
            exact_picture(peers.arguments_of(task), jnp.zeros(12), settings)
        )
        slopes[shading] = exact_slopes(task, field, settings, np.eye(6), 0.5)
        # A difference that has converged does not depend on its step.
        some = slopes[shading] / np.linalg.norm(slopes[shading])
        other = exact_slopes(task, field, settings, some[None], 0.25)[0]
        spreads[shading] = abs(float(other / (some @ slopes[shading])) - 1)
    results: dict[str, dict[str, Any]] = {}
    for peer in found:
        difference = in_floats(peer.image()) - exact[peer.shading]
        result: dict[str, Any] = {
            "rmse": float(np.sqrt((difference**2).mean())),
            "mean_difference": float(np.abs(difference).mean()),
        }
        if peer.differentiable:
            # From a target far enough away the squared difference is linear in the picture.
            target = np.float32(-1e3 * field)
            slope = peer.gradient(target)[POSE] / 2e3 * pose_steps(task)
            wanted = slopes[peer.shading]
            norms = np.linalg.norm(slope) * np.linalg.norm(wanted)
            result |= {
                "gradient_error": relative_error(slope, wanted),
                "gradient_cosine": float(slope @ wanted / norms),
                "reference_spread": spreads[peer.shading],
            }
        results[peer.name] = result
    return results


def relative_error(value: np.ndarray, wanted: np.ndarray) -> float:
    """Length of the difference over that of what was wanted."""
    return float(np.linalg.norm(value - wanted) / np.linalg.norm(wanted))
