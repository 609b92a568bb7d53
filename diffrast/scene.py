"""What is seen: objects, lights, and what there is behind them."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from diffrast import _check
from diffrast._check import ArrayInput
from diffrast._pytree import pytree_dataclass, set_field
from diffrast.light import AmbientLight, DirectionalLight, Light, PointLight, SpotLight
from diffrast.material import Material
from diffrast.mesh import Mesh


@pytree_dataclass
class Object:
    """A mesh of one material, placed in the world.

    Attributes:
        mesh: in its own coordinates.
        material: its reflectances.
        transform: (4, 4) object to world, traced and differentiable; normals follow by its inverse
            transpose, and what was outside stays outside where it mirrors.
    """

    mesh: Mesh
    material: Material
    transform: Float[Array, "4 4"]

    def __init__(
        self, mesh: Mesh, material: Material | None = None, transform: ArrayInput | None = None
    ) -> None:
        if not isinstance(mesh, Mesh):
            raise ValueError(f"mesh: wanted a Mesh, got {type(mesh).__name__}")
        material = Material() if material is None else material
        if not isinstance(material, Material):
            raise ValueError(f"material: wanted a Material, got {type(material).__name__}")
        if transform is None:
            transform = jnp.eye(4, dtype=mesh.vertices.dtype)
        set_field(self, "mesh", mesh)
        set_field(self, "material", material)
        set_field(self, "transform", _check.float_array("transform", transform, (4, 4)))


@pytree_dataclass
class Scene:
    """Objects, lights and what is seen where there is no object.

    Attributes:
        objects: any number of `Object`s.
        lights: any number of lights.
        background: (3,) linear RGB, or a (height, width, 3) image.
    """

    objects: tuple[Object, ...]
    lights: tuple[Light, ...]
    background: Float[Array, "*size 3"]

    def __init__(
        self,
        *,
        objects: tuple[Object, ...] | list[Object],
        lights: tuple[Light, ...] | list[Light] = (),
        background: ArrayInput = (0.0, 0.0, 0.0),
    ) -> None:
        for name, items, kinds in (
            ("objects", objects, (Object,)),
            ("lights", lights, (AmbientLight, DirectionalLight, PointLight, SpotLight)),
        ):
            if not isinstance(items, tuple | list):
                raise ValueError(f"{name}: wanted a tuple or list, got {type(items).__name__}")
            for i, item in enumerate(items):
                if not isinstance(item, kinds):
                    wanted = " or ".join(kind.__name__ for kind in kinds)
                    raise ValueError(f"{name}[{i}]: wanted {wanted}, got {type(item).__name__}")
        background = _check.float_array("background", background)
        if background.ndim not in (1, 3) or background.shape[-1] != 3:
            raise ValueError(
                f"background: wanted shape (3,) or (height, width, 3), got {background.shape}"
            )
        set_field(self, "objects", tuple(objects))
        set_field(self, "lights", tuple(lights))
        set_field(self, "background", background)
