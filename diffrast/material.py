"""What a surface does with light."""

from jax import Array
from jaxtyping import Float

from diffrast._check import ArrayInput, float_array, one_of, own_copy
from diffrast._pytree import pytree_dataclass, set_field, static
from diffrast.texture import AnyTexture, CubeTexture, Texture
from diffrast.texture.kinds import texels

HIGHLIGHTS = ("phong", "blinn")


@pytree_dataclass
class Material:
    """Reflectances of the Phong model (FEATURES S1), linear RGB; all traced and differentiable.

    Attributes:
        diffuse: (3,) share of diffusely reflected light.
        ambient: (3,) share of ambient light; equal to `diffuse` unless given.
        specular: (3,) share in the highlight, or None for a dull surface, for which no highlight
            and no direction to the viewer is computed at all.
        shininess: exponent of the highlight.
        texture: a `Texture` or `CubeTexture` of linear RGB that multiplies `diffuse` and `ambient`
            at every point, or None for none; differentiable in its texels.
        highlight: what its exponent is of, static: "phong", the cosine between the viewer and the
            mirror image of the light, or "blinn", that between the normal and the direction
            half-way from the light to the viewer, whose highlights are about twice as wide.

    Raises:
        ValueError: for wrong shapes, numbers that are not finite, an unknown highlight, and a
            texture of other than three channels.
    """

    diffuse: Float[Array, "3"]
    ambient: Float[Array, "3"]
    specular: Float[Array, "3"] | None
    shininess: Float[Array, ""]
    texture: AnyTexture | None
    highlight: str = static()

    def __init__(
        self,
        *,
        diffuse: ArrayInput = (0.8, 0.8, 0.8),
        ambient: ArrayInput | None = None,
        specular: ArrayInput | None = None,
        shininess: ArrayInput = 32.0,
        texture: AnyTexture | None = None,
        highlight: str = "phong",
    ) -> None:
        color = float_array("diffuse", diffuse, (3,))
        set_field(self, "diffuse", color)
        if ambient is None:
            ambient = own_copy(color)
        set_field(self, "ambient", float_array("ambient", ambient, (3,)))
        if specular is not None:
            specular = float_array("specular", specular, (3,))
        set_field(self, "specular", specular)
        set_field(self, "shininess", float_array("shininess", shininess, ()))
        if texture is not None:
            if not isinstance(texture, Texture | CubeTexture):
                kind = type(texture).__name__
                raise ValueError(f"texture: wanted a Texture, a CubeTexture or None, got {kind}")
            if texels(texture).shape[-1] != 3:
                shape = texels(texture).shape
                raise ValueError(f"texture: wanted three channels, got shape {shape}")
        set_field(self, "texture", texture)
        set_field(self, "highlight", one_of("highlight", highlight, HIGHLIGHTS))
