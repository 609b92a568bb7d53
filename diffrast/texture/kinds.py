"""Textures: images that lie on surfaces, and cubes of six images round a scene.

Coordinates. (u, v) = (0, 0) is the lower left corner of an image and (1, 1) its upper right one: of
width × height texels, the one in row i (from the top) and column j has its centre at
u = (j + 1/2) / width, v = 1 - (i + 1/2) / height.
"""

from typing import TypeAlias

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from diffrast._check import ArrayInput, float_array, one_of, positive_int
from diffrast._pytree import pytree_dataclass, set_field, static
from diffrast.texture.mapping import CubeMapping, Mapping, PlanarMapping, SphereMapping

WRAPS = ("repeat", "clamp", "mirror")
FILTERS = ("nearest", "bilinear", "trilinear")


@pytree_dataclass
class Texture:
    """An image to be laid on a surface (FEATURES X1–X4). One copy serves any number of materials.

    Attributes:
        image: (height, width, channels) linear, row 0 at the top; traced and differentiable.
            `load_image` decodes sRGB. A material wants three channels.
        mapping: from surface to image; None for the mesh's texture coordinates.
        wrap: what lies beyond the image along u and v, static: "repeat" takes coordinates modulo
            1, after interpolation; "clamp" the colour at the border; "mirror" the image reversed
            in turn. One for both or a pair.
        filter: static. "nearest" takes the nearest texel, with no derivative by the coordinates;
            "bilinear" blends four; "trilinear" blends between two levels of a pyramid of images,
            each of half the size, which adds a third of the memory. The level is that at which a
            pixel covers about a texel.
        anisotropy: static, 1 to 16. With n > 1 a trilinear texture is looked up at n places along
            the longer axis of the pixel's footprint, at the level of the shorter one: sharper
            where surfaces are seen at a low angle, at n times the cost.

    Raises:
        ValueError: for wrong shapes, numbers that are not finite, and unknown choices.
    """

    image: Float[Array, "height width channels"]
    mapping: Mapping | None
    wrap: tuple[str, str] = static()
    filter: str = static()
    anisotropy: int = static()

    def __init__(
        self,
        image: ArrayInput,
        *,
        mapping: Mapping | None = None,
        wrap: str | tuple[str, str] = "repeat",
        filter: str = "bilinear",
        anisotropy: int = 1,
    ) -> None:
        image = float_array("image", image, ("height", "width", "channels"))
        if image.size == 0:
            raise ValueError(f"image: wanted at least one texel, got shape {image.shape}")
        if mapping is not None and not isinstance(mapping, PlanarMapping | SphereMapping):
            kind = type(mapping).__name__
            raise ValueError(f"mapping: wanted PlanarMapping, SphereMapping or None, got {kind}")
        if positive_int("anisotropy", anisotropy) > 16:
            raise ValueError(f"anisotropy: wanted at most 16, got {anisotropy}")
        set_field(self, "image", image)
        set_field(self, "mapping", mapping)
        set_field(self, "wrap", wrap_pair(wrap))
        set_field(self, "filter", one_of("filter", filter, FILTERS))
        set_field(self, "anisotropy", int(anisotropy))


@pytree_dataclass
class CubeTexture:
    """Six square images on the sides of a cube, looked up by direction (A26); no seams.

    As a scene's `background` it is seen infinitely far away in all directions. On a surface it is
    found by the normals.

    Attributes:
        images: (6, size, size, channels) linear, traced and differentiable: the views along +x,
            -x, +y, -y, +z, -z from the centre. The four round the y axis have +y at the top;
            +y has +z at the top, and -y has -z: bent forwards or backwards from the view along -z.
        mapping: for surfaces; by the normal alone unless given.
        filter: as a `Texture`'s.

    Raises:
        ValueError: for wrong shapes, numbers that are not finite, and unknown choices.
    """

    images: Float[Array, "6 size size channels"]
    mapping: CubeMapping
    filter: str = static()

    def __init__(
        self,
        images: ArrayInput,
        *,
        mapping: CubeMapping | None = None,
        filter: str = "bilinear",
    ) -> None:
        images = float_array("images", images, (6, "size", "size", "channels"))
        if images.size == 0:
            raise ValueError(f"images: wanted at least one texel, got shape {images.shape}")
        mapping = CubeMapping() if mapping is None else mapping
        if not isinstance(mapping, CubeMapping):
            raise ValueError(f"mapping: wanted CubeMapping or None, got {type(mapping).__name__}")
        set_field(self, "images", images)
        set_field(self, "mapping", mapping)
        set_field(self, "filter", one_of("filter", filter, FILTERS))

    @staticmethod
    def from_cross(
        cross: ArrayInput, *, mapping: CubeMapping | None = None, filter: str = "bilinear"
    ) -> "CubeTexture":
        """Fold a cross of six images, 3 rows of 4, the way cube maps are often stored.

        From left to right the middle row holds the views along -x, -z, +x, +z; above and below the
        second of them stand +y and -y. Arguments and errors as the constructor's.
        """
        cross = float_array("cross", cross, ("height", "width", "channels"))
        size = cross.shape[1] // 4
        if size == 0 or cross.shape[:2] != (3 * size, 4 * size):
            raise ValueError(f"cross: wanted 3 n rows and 4 n columns, got shape {cross.shape}")
        tiles = cross.reshape(3, size, 4, size, -1)
        places = ((1, 2), (1, 0), (0, 1), (2, 1), (1, 3), (1, 1))
        images = jnp.stack([tiles[row, :, column] for row, column in places])
        return CubeTexture(images, mapping=mapping, filter=filter)


def wrap_pair(wrap: str | tuple[str, str]) -> tuple[str, str]:
    """Check what lies beyond an image along u and v, given for both at once or for each."""
    pair = (wrap, wrap) if isinstance(wrap, str) else wrap
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise ValueError(f"wrap: wanted one name or two, got {wrap!r:.40}")
    return one_of("wrap", pair[0], WRAPS), one_of("wrap", pair[1], WRAPS)


AnyTexture: TypeAlias = Texture | CubeTexture


def texels(texture: AnyTexture) -> Float[Array, "*cube height width channels"]:
    """The image, or the six of them."""
    return texture.image if isinstance(texture, Texture) else texture.images
