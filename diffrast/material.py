"""What a surface does with light."""

from jax import Array
from jaxtyping import Float

from diffrast._check import ArrayInput, float_array
from diffrast._pytree import pytree_dataclass, set_field


@pytree_dataclass
class Material:
    """Reflectances of the Phong model (FEATURES S1), linear RGB; all traced and differentiable.

    Attributes:
        diffuse: (3,) share of diffusely reflected light.
        ambient: (3,) share of ambient light; equal to `diffuse` unless given.
        specular: (3,) share in the highlight, or None for a dull surface, for which no highlight
            and no direction to the viewer is computed at all.
        shininess: exponent of the highlight.

    Raises:
        ValueError: for wrong shapes and numbers that are not finite.
    """

    diffuse: Float[Array, "3"]
    ambient: Float[Array, "3"]
    specular: Float[Array, "3"] | None
    shininess: Float[Array, ""]

    def __init__(
        self,
        *,
        diffuse: ArrayInput = (0.8, 0.8, 0.8),
        ambient: ArrayInput | None = None,
        specular: ArrayInput | None = None,
        shininess: ArrayInput = 32.0,
    ) -> None:
        set_field(self, "diffuse", float_array("diffuse", diffuse, (3,)))
        if ambient is None:
            ambient = diffuse
        set_field(self, "ambient", float_array("ambient", ambient, (3,)))
        if specular is not None:
            specular = float_array("specular", specular, (3,))
        set_field(self, "specular", specular)
        set_field(self, "shininess", float_array("shininess", shininess, ()))
