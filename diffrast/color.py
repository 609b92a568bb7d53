"""Colour: transfer functions, hue, lightness and saturation, and look-up tables."""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from diffrast._check import ArrayInput, float_array, instance_of, is_concrete, real_number
from diffrast._pytree import pytree_dataclass, set_field

_SIXTH = jnp.pi / 3  # of a turn


def srgb_to_linear(encoded: ArrayLike) -> Float[Array, "..."]:
    """Linear light of sRGB values; 0 to 1 goes to 0 to 1, any shape.

    Exact and differentiable for every number: the straight piece near black continues below zero,
    the curve continues above one. FEATURES S6, IEC 61966-2-1.
    """
    encoded = float_array("encoded", encoded, finite=False)
    straight = encoded <= 0.04045
    curved = jnp.where(straight, 1, (encoded + 0.055) / 1.055)
    return jnp.where(straight, encoded / 12.92, curved**2.4)


def linear_to_srgb(linear: ArrayLike) -> Float[Array, "..."]:
    """Encode linear light as sRGB values: the inverse of `srgb_to_linear`.

    Example:
        >>> dr.color.linear_to_srgb(jnp.array([0.0, 0.214, 1.0])).round(2).tolist()
        [0.0, 0.5, 1.0]
    """
    linear = float_array("linear", linear, finite=False)
    straight = linear <= 0.0031308
    curved = jnp.where(straight, 1, linear)
    return jnp.where(straight, 12.92 * linear, 1.055 * curved ** (1 / 2.4) - 0.055)


def gamma_to_linear(encoded: ArrayLike, gamma: ArrayLike = 2.2) -> Float[Array, "..."]:
    """Linear light of values encoded with a pure power, encoded^gamma; 0 for those below zero.

    Differentiable in both, with derivative 0 at and below zero. FEATURES S6.

    Raises:
        ValueError: for a gamma that is not above 0.
    """
    return _power("encoded", encoded, real_number("gamma", gamma, above=0.0))


def linear_to_gamma(linear: ArrayLike, gamma: ArrayLike = 2.2) -> Float[Array, "..."]:
    """Encode linear light by linear^(1 / gamma): the inverse of `gamma_to_linear`."""
    return _power("linear", linear, 1 / real_number("gamma", gamma, above=0.0))


def rgb_to_hls(rgb: ArrayInput) -> Float[Array, "*size 3"]:
    """Hue, lightness and saturation of colours (FEATURES S6; Kos 8.2).

    Differentiable but where two channels are equal; greys have hue and saturation 0, with
    derivative 0.

    Args:
        rgb: (..., 3) from 0 to 1.

    Returns:
        (..., 3): hue as an angle from 0 (red) over 2 pi / 3 (green) and 4 pi / 3 (blue) to 2 pi,
        the source's degrees in radians; lightness and saturation from 0 to 1.

    Raises:
        ValueError: for a wrong shape.
    """
    rgb = float_array("rgb", rgb, ("...", 3), finite=False)
    r, g, b = (rgb[..., i] for i in range(3))
    high, low = jnp.maximum(jnp.maximum(r, g), b), jnp.minimum(jnp.minimum(r, g), b)
    span, lightness = high - low, (high + low) / 2
    grey = span == 0
    full = jnp.where(lightness <= 0.5, high + low, (1 - high) + (1 - low))
    known = ~grey & (full != 0)
    saturation = jnp.where(known, span, 0) / jnp.where(known, full, 1)
    parts = [jnp.where(grey, 0, part) for part in (g - b, b - r, r - g)]
    sector = jnp.where(r == high, 0, jnp.where(g == high, 2, 4))
    offset = jnp.where(r == high, parts[0], jnp.where(g == high, parts[1], parts[2]))
    hue = sector + offset / jnp.where(grey, 1, span)
    hue = jnp.where(hue < 0, hue + 6, hue)
    return jnp.stack([hue * _SIXTH, lightness, saturation], axis=-1)


def hls_to_rgb(hls: ArrayInput) -> Float[Array, "*size 3"]:
    """Colours of hue, lightness and saturation: the inverse of `rgb_to_hls`.

    Differentiable but at the six hues where a channel begins to change.

    Args:
        hls: (..., 3) as `rgb_to_hls` gives them; hues of any number of turns.

    Raises:
        ValueError: for a wrong shape.
    """
    hls = float_array("hls", hls, ("...", 3), finite=False)
    hue, lightness, saturation = (hls[..., i] for i in range(3))
    sixths = hue / _SIXTH
    sixths = sixths - 6 * jnp.floor(sixths / 6)
    half = saturation * jnp.where(lightness <= 0.5, lightness, 1 - lightness)
    low = lightness - half
    shares = (jnp.abs(sixths - 3) - 1, 2 - jnp.abs(sixths - 2), 2 - jnp.abs(sixths - 4))
    return jnp.stack([low + 2 * half * jnp.clip(share, 0, 1) for share in shares], axis=-1)


@pytree_dataclass
class LookUpTable:
    """A profile of colours, linear between its vertices (FEATURES S7; Kos 8.3, 12.3).

    Attributes:
        positions: (vertices,) values in ascending order; differentiable.
        colors: (vertices, channels) what stands for them; differentiable.

    Raises:
        ValueError: for wrong shapes, fewer than two vertices, numbers that are not finite, and
            positions that do not ascend.
    """

    positions: Float[Array, "vertices"]
    colors: Float[Array, "vertices channels"]

    def __init__(self, *, positions: ArrayInput, colors: ArrayInput) -> None:
        positions = float_array("positions", positions, ("vertices",))
        count = positions.shape[0]
        if count < 2:
            raise ValueError(f"positions: wanted at least two vertices, got {count}")
        if is_concrete(positions) and not np.all(np.diff(np.asarray(positions)) > 0):
            raise ValueError(f"positions: wanted them in ascending order, got {positions}")
        set_field(self, "positions", positions)
        set_field(self, "colors", float_array("colors", colors, (count, "channels")))


def look_up(table: LookUpTable, values: ArrayInput) -> Float[Array, "*size channels"]:
    """Colours that a table gives to values; its first and last colour beyond its ends.

    Recolours a picture of scalars without rendering it again: of `light_cosines`, where a steep end
    of the profile is a highlight and its beginning the ambient light, or of depths.

    Args:
        table: the profile.
        values: of any shape.

    Returns:
        (..., channels), differentiable in the values and, for a fixed order, in the table. At a
        vertex it has the derivative of the piece that begins there, at the last one of the last.

    Raises:
        ValueError: for values that are no numbers, and anything but a table.

    Example:
        >>> heat = dr.LookUpTable(positions=[0.0, 1.0], colors=[[0.0, 0, 1], [1, 0, 0]])
        >>> dr.look_up(heat, jnp.array([-1.0, 0.25])).tolist()
        [[0.0, 0.0, 1.0], [0.25, 0.0, 0.75]]
    """
    instance_of("table", table, LookUpTable)
    values = float_array("values", values, finite=False)
    positions, colors = table.positions, table.colors
    count = positions.shape[0]
    piece = jnp.clip(jnp.searchsorted(positions, values, side="right") - 1, 0, count - 2)
    width = (positions[1:] - positions[:-1])[piece]
    known = width > 0
    share = (values - positions[piece]) / jnp.where(known, width, 1)
    # By comparisons: the ends of a piece have its whole derivative, of which `jnp.clip` takes half.
    inside = known & ~(share < 0)
    share = jnp.where(inside, jnp.where(share > 1, 1, share), 0)[..., None]
    return (1 - share) * colors[piece] + share * colors[piece + 1]


def _power(name: str, values: ArrayLike, exponent: Array) -> Array:
    values = float_array(name, values, finite=False)
    positive = values > 0
    return jnp.where(positive, jnp.where(positive, values, 1) ** exponent, 0)
