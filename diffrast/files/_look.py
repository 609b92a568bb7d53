"""A material as a mesh file describes it, whichever format that has."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Picture = Callable[[], Float[np.ndarray, "height width channels"] | None]


class Look(NamedTuple):
    """What a file says of a material; None for what it does not.

    Attributes:
        name: of the material, if its part of the mesh is to be called so.
        ambient: reflectance.
        diffuse: reflectance; the base colour.
        specular: reflectance.
        shininess: exponent of the highlight.
        picture: reads the texture, linear, row 0 at the top; gives None if it is not found.
        wrap: of the texture along u and v, as a `Texture` has it.
        filter: of the texture, the nearest that a `Texture` has.
        coordinates: number of the set of coordinates that the texture takes (glTF has several).
        transform: what is done to those first, v pointing as it does in the file.
    """

    name: str | None = None
    ambient: Float[np.ndarray, "3"] | None = None
    diffuse: Float[np.ndarray, "3"] | None = None
    specular: Float[np.ndarray, "3"] | None = None
    shininess: float | None = None
    picture: Picture | None = None
    wrap: tuple[str, str] | None = None
    filter: str | None = None
    coordinates: int | None = None
    transform: Float[np.ndarray, "2 3"] | None = None

    def moved(self, uvs: Float[np.ndarray, "V 2"]) -> Float[np.ndarray, "V 2"]:
        """The coordinates that the texture is looked up at."""
        if self.transform is None:
            return uvs
        return (uvs @ self.transform[:, :2].T + self.transform[:, 2]).astype(uvs.dtype)
