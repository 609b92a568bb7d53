"""How renderers are compared: the task, what each one offers, and ours with its settings.

All draw one mesh under one directional light (ambient, diffuse and, but for DEODR, specular) and
differentiate the squared difference to a target by twelve parameters: the camera's motion in the
eye system (rotation vector, translation), the light's direction, and the object's translation.
What does not depend on those is prepared in the constructor: compiled programs, buffers, the
acceleration structure. Pictures come back as arrays of the host. The other renderers are in
`peers.py`.
"""

import abc
import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

import diffrast as dr

DIFFUSE = (0.7, 0.45, 0.2)
SPECULAR = 0.3
SHININESS = 20.0
AMBIENT, INTENSITY = 0.2, 0.7  # no sum exceeds one, which 8 bits could not hold
PARAMETERS = 12
POSE = slice(0, 6)


class MissingPeerError(ImportError):
    """A renderer that does not run here, and what to do about it."""


@dataclasses.dataclass(frozen=True)
class Task:
    """What is to be drawn.

    Attributes:
        mesh: with normals, all faces turned outward or, of an open one, to the viewer.
        camera: square picture, centred.
        size: rows and columns.
        closed: whether back faces are culled.
    """

    mesh: dr.Mesh
    camera: dr.Camera
    size: int
    closed: bool

    @property
    def direction(self) -> np.ndarray:
        """The way the light travels: over the viewer's left shoulder."""
        view = np.asarray(self.camera.view, np.float64)
        direction = np.array([0.4, -0.5, -1.0]) @ view[:3, :3]
        return direction / np.linalg.norm(direction)

    @property
    def focal(self) -> float:
        """Cotangent of half the angle of view."""
        return float(self.camera.projection[1, 1])


class Peer(abc.ABC):
    """A renderer: `image` draws, `gradient` differentiates the squared difference to a target."""

    name: ClassVar[str]
    differentiable: ClassVar[bool] = True
    shading: ClassVar[str] = "phong"
    samples: ClassVar[bool] = False  # whether pixels at edges are mixed
    side: ClassVar[int] = 1  # side² samples a pixel

    def __init__(self, task: Task) -> None:
        self.task = task

    @abc.abstractmethod
    def image(self) -> np.ndarray:
        """The picture, (size, size, 3)."""

    def gradient(self, target: np.ndarray) -> np.ndarray:
        """Of the summed squared difference to a target by the parameters, (12,)."""
        raise TypeError(f"{self.name} draws only: it has no derivatives")


def with_samples(kind: type[Peer], side: int) -> type[Peer]:
    """The same renderer with side² samples a pixel."""
    name = f"{kind.name}, {side**2} samples" if side > 1 else kind.name
    changes = {"name": name, "side": side, "samples": kind.samples or side > 1}
    return type(kind.__name__, (kind,), changes)


def in_floats(image: np.ndarray) -> np.ndarray:
    """A picture of bytes or floats in floats."""
    return image / 255.0 if image.dtype == np.uint8 else np.asarray(image, np.float64)


# diffrast -----------------------------------------------------------------------------------------


def draw(
    arguments: tuple[Any, ...], parameters: jax.Array, settings: dr.RenderSettings
) -> jax.Array:
    """The picture with everything moved by parameters."""
    mesh, camera, direction = arguments
    rotation, translation = dr.linalg.so3_exp(parameters[:3]), parameters[3:6]
    motion = dr.linalg.translation(translation).at[:3, :3].set(rotation)
    camera = dr.Camera(view=motion @ camera.view, projection=camera.projection)
    specular = None if settings.shading == "gouraud" else (SPECULAR,) * 3
    material = dr.Material(diffuse=DIFFUSE, specular=specular, shininess=SHININESS)
    light = dr.DirectionalLight(
        direction=direction + parameters[6:9],
        ambient=(AMBIENT,) * 3,
        diffuse=(INTENSITY,) * 3,
        specular=(1.0,) * 3,
    )
    item = dr.Object(mesh, material, dr.linalg.translation(parameters[9:]))
    return dr.render(dr.Scene(objects=[item], lights=[light]), camera, settings)


def arguments_of(task: Task) -> tuple[Any, ...]:
    """What `draw` takes: not constants, which the compiler would try to fold."""
    return task.mesh, task.camera, jnp.asarray(task.direction, jnp.float32)


class Diffrast(Peer):
    """Ours, with the derivative through what is visible."""

    name = "diffrast"
    samples = True
    antialias: ClassVar[bool] = True

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        settings = dr.RenderSettings(
            height=task.size,
            width=task.size,
            antialias=self.antialias,
            cull_backfaces=task.closed,
            shading=self.shading,
            samples=self.side**2,
        )
        self.arguments = arguments_of(task)
        self.parameters = jnp.zeros(PARAMETERS)

        def loss(parameters: jax.Array, arguments: tuple[Any, ...], target: jax.Array) -> jax.Array:
            return jnp.sum((draw(arguments, parameters, settings) - target) ** 2)

        self.draw = jax.jit(lambda p, arguments: draw(arguments, p, settings))
        self.differentiate = jax.jit(jax.value_and_grad(loss))

    def image(self) -> np.ndarray:
        return np.asarray(self.draw(self.parameters, self.arguments))

    def gradient(self, target: np.ndarray) -> np.ndarray:
        _, gradient = self.differentiate(self.parameters, self.arguments, target)
        return np.asarray(gradient)


class DiffrastInterior(Diffrast):
    """Ours, jagged, with the derivative for fixed visible faces."""

    name = "diffrast, no edges"
    samples = False
    antialias = False


class DiffrastGouraud(DiffrastInterior):
    """Ours, for the comparison of pictures only."""

    name = "diffrast, Gouraud"
    shading = "gouraud"
