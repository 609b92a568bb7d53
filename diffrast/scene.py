"""What is seen: objects, lights, and what there is behind them.

A scene as a pytree holds each texture's image once, however many objects show it: in which order
objects share images is part of its structure (`shared`), so it stays known under `jit`.
"""

from typing import Any

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from diffrast import _check
from diffrast._check import ArrayInput
from diffrast._pytree import pytree_dataclass, set_field, static, with_field
from diffrast.light import AmbientLight, DirectionalLight, Light, PointLight, SpotLight
from diffrast.material import Material
from diffrast.mesh import Mesh
from diffrast.texture import CubeTexture, Texture
from diffrast.texture.kinds import texels


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
        texture = material.texture
        if isinstance(texture, Texture) and texture.mapping is None and mesh.uvs is None:
            raise ValueError("mesh: wanted uvs for a texture without a mapping, got none")
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
        background: (3,) linear RGB, a (height, width, 3) image, or a `CubeTexture` that is seen
            infinitely far away; differentiable.
        shared: for each object the first one whose texture has the same image, found from these.
    """

    objects: tuple[Object, ...]
    lights: tuple[Light, ...]
    background: Float[Array, "*size 3"] | CubeTexture
    shared: tuple[int, ...] = static(init=False)

    def __init__(
        self,
        *,
        objects: tuple[Object, ...] | list[Object],
        lights: tuple[Light, ...] | list[Light] = (),
        background: ArrayInput | CubeTexture = (0.0, 0.0, 0.0),
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
        if isinstance(background, CubeTexture):
            if background.images.shape[-1] != 3:
                shape = background.images.shape
                raise ValueError(f"background: wanted three channels, got shape {shape}")
        else:
            background = _check.float_array("background", background)
            if background.ndim not in (1, 3) or background.shape[-1] != 3:
                raise ValueError(
                    f"background: wanted shape (3,) or (height, width, 3), got {background.shape}"
                )
        set_field(self, "objects", tuple(objects))
        set_field(self, "lights", tuple(lights))
        set_field(self, "background", background)
        images = [_image(item) for item in objects]
        keys = [-i if image is None else id(image) for i, image in enumerate(images)]
        set_field(self, "shared", tuple(keys.index(key) for key in keys))

    def _without_copies(self) -> "Scene":
        if self.shared == tuple(range(len(self.shared))):
            return self
        once = [
            item if i == first else _with_image(item, None)
            for i, (item, first) in enumerate(zip(self.objects, self.shared, strict=True))
        ]
        return with_field(self, "objects", tuple(once))

    def _with_copies(self) -> "Scene":
        if self.shared == tuple(range(len(self.shared))):
            return self
        whole = [
            item if i == first else _with_image(item, _image(self.objects[first]))
            for i, (item, first) in enumerate(zip(self.objects, self.shared, strict=True))
        ]
        return with_field(self, "objects", tuple(whole))


def _image(item: Object) -> Array | None:
    texture = item.material.texture
    return None if texture is None else texels(texture)


def _with_image(item: Object, image: Any) -> Object:
    texture = item.material.texture
    assert texture is not None
    name = "image" if isinstance(texture, Texture) else "images"
    material = with_field(item.material, "texture", with_field(texture, name, image))
    return with_field(item, "material", material)
