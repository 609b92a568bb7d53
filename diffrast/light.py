"""Lights: from where light comes to a point, and how much of it.

A light's `ambient`, `diffuse` and `specular` multiply the material's (FEATURES S1). What a light
does not have (`None`) adds no operation: a light without `ambient` adds no ambient term, and an
`AmbientLight` costs one addition.
"""

import copy
import math
from typing import Any, TypeAlias, TypeGuard

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from diffrast._check import ArrayInput, float_array, one_of, own_copy, positive_int, real_number
from diffrast._pytree import pytree_dataclass, set_field, static
from diffrast.linalg import normalize

Columns: TypeAlias = list[Array]  # x, y, z (or r, g, b), each of any one shape

LEGS = ("light", "both", "viewer")


@pytree_dataclass
class AmbientLight:
    """Light from everywhere: `color` times the material's ambient reflectance."""

    color: Float[Array, "3"]

    def __init__(self, color: ArrayInput) -> None:
        set_field(self, "color", float_array("color", color, (3,)))


@pytree_dataclass
class Shadow:
    """That a light casts shadows: what it cannot see gets its ambient part only (FEATURES S5).

    Attributes:
        resolution: rows and columns of the picture that the light takes of the scene, static. It is
            fitted to what the camera sees. Outlines of shadows are exact whatever the resolution,
            with `RenderSettings(antialias=True)` within pixels too and with their derivative; what
            falls between two pixels of the picture casts no shadow.

    Raises:
        ValueError: for anything but an integer from 8 to 8192.
    """

    resolution: int = static(default=512)

    def __post_init__(self) -> None:
        resolution = positive_int("resolution", self.resolution, minimum=8)
        if resolution > 8192:
            raise ValueError(f"resolution: wanted at most 8192, got {resolution}")
        set_field(self, "resolution", resolution)


@pytree_dataclass
class Attenuation:
    """Diffuse and specular light is divided by a + b r + c r² (FEATURES S3; Kos 6.1).

    So (k, 1, 0) is the source's linear 1 / (r + k), and (0, 0, 1) the inverse square.

    Attributes:
        coefficients: (3,) a, b, c; differentiable.
        legs: what r is, static: the way from the "light" to the point, that from the point to the
            "viewer", or "both" one after the other, the source's R = r + D. The viewer is where
            the eye system has its origin, also under parallel projection.

    Raises:
        ValueError: for wrong shapes, numbers that are not finite, and other legs.
    """

    coefficients: Float[Array, "3"]
    legs: str = static()

    def __init__(self, coefficients: ArrayInput, *, legs: str = "light") -> None:
        set_field(self, "coefficients", float_array("coefficients", coefficients, (3,)))
        set_field(self, "legs", one_of("legs", legs, LEGS))


@pytree_dataclass
class DirectionalLight:
    """Light from infinitely far away.

    Attributes:
        direction: (3,) the way the light travels, of any length but zero; differentiable.
        diffuse: (3,) linear RGB.
        specular: (3,), equal to `diffuse` unless given.
        ambient: (3,) or None.
        shadow: how it casts shadows, or None for none.
        attenuation: an `Attenuation` with the distance from the viewer, or None.

    Raises:
        ValueError: for wrong shapes and numbers that are not finite, and an attenuation with a
            distance from the light.
    """

    direction: Float[Array, "3"]
    diffuse: Float[Array, "3"]
    specular: Float[Array, "3"]
    ambient: Float[Array, "3"] | None
    shadow: Shadow | None
    attenuation: Attenuation | None

    def __init__(
        self,
        *,
        direction: ArrayInput,
        ambient: ArrayInput | None = None,
        diffuse: ArrayInput = (1.0, 1.0, 1.0),
        specular: ArrayInput | None = None,
        shadow: Shadow | None = None,
        attenuation: Attenuation | None = None,
    ) -> None:
        set_field(self, "direction", float_array("direction", direction, (3,)))
        _set_colors(self, ambient, diffuse, specular)
        _set_shadow(self, shadow)
        if attenuation is not None:
            legs = attenuation.legs if isinstance(attenuation, Attenuation) else "light"
            if legs != "viewer":
                raise ValueError(
                    f'attenuation: wanted an Attenuation of legs "viewer", got {legs!r}'
                )
        set_field(self, "attenuation", attenuation)


@pytree_dataclass
class PointLight:
    """Light from a point, equally in all directions.

    Attributes:
        position: (3,) in the world; differentiable.
        diffuse: (3,) linear RGB.
        specular: (3,), equal to `diffuse` unless given.
        ambient: (3,) or None.
        attenuation: (3,) a, b, c: diffuse and specular light is divided by a + b r + c r² at the
            distance r; or an `Attenuation`; None for no attenuation.
        shadow: how it casts shadows, or None for none. From more than some 10^4 times the scene's
            size away they are wrong in float32: let a `DirectionalLight` cast them.
        incidence_cutoff: None, or an angle in radians, 0 < a_s <= pi / 2: light that arrives at
            the angle a from the normal is reflected diffusely as 1 - (1 - cos a) / (1 - cos a_s)
            instead of cos a, and beyond a_s not at all (the spot of FEATURES S2; Van Houdt A20);
            differentiable.

    Raises:
        ValueError: for wrong shapes, numbers that are not finite, and a cutoff out of range.
    """

    position: Float[Array, "3"]
    diffuse: Float[Array, "3"]
    specular: Float[Array, "3"]
    ambient: Float[Array, "3"] | None
    attenuation: Float[Array, "3"] | Attenuation | None
    shadow: Shadow | None
    incidence_cutoff: Float[Array, ""] | None

    def __init__(
        self,
        *,
        position: ArrayInput,
        ambient: ArrayInput | None = None,
        diffuse: ArrayInput = (1.0, 1.0, 1.0),
        specular: ArrayInput | None = None,
        attenuation: ArrayInput | Attenuation | None = None,
        shadow: Shadow | None = None,
        incidence_cutoff: ArrayInput | None = None,
    ) -> None:
        set_field(self, "position", float_array("position", position, (3,)))
        _set_colors(self, ambient, diffuse, specular)
        _set_shadow(self, shadow)
        _set_attenuation(self, attenuation)
        if incidence_cutoff is not None:
            beyond = math.nextafter(math.pi / 2, 2) + 1e-7  # a right angle, also in float32
            incidence_cutoff = real_number(
                "incidence_cutoff", incidence_cutoff, above=0.0, below=beyond
            )
        set_field(self, "incidence_cutoff", incidence_cutoff)


@pytree_dataclass
class SpotLight:
    """Light from a point into a cone round an axis (FEATURES S2).

    At the angle a from the axis diffuse and specular light is 1 - (1 - cos a) / (1 - cos cutoff) of
    that on the axis, which is zero at the cutoff and stays zero beyond it.

    Attributes:
        position: (3,) in the world; differentiable.
        direction: (3,) the way the light travels along the axis, of any length but zero;
            differentiable.
        cutoff: angle between the axis and the cone in radians, 0 < cutoff < pi / 2; differentiable.
        diffuse: (3,) linear RGB, on the axis.
        specular: (3,), equal to `diffuse` unless given.
        ambient: (3,) or None; inside and outside of the cone alike.
        attenuation: as a `PointLight`'s.
        shadow: how it casts shadows, or None for none.

    Raises:
        ValueError: for wrong shapes, numbers that are not finite, and a cutoff out of range.
    """

    position: Float[Array, "3"]
    direction: Float[Array, "3"]
    cutoff: Float[Array, ""]
    diffuse: Float[Array, "3"]
    specular: Float[Array, "3"]
    ambient: Float[Array, "3"] | None
    attenuation: Float[Array, "3"] | Attenuation | None
    shadow: Shadow | None

    def __init__(
        self,
        *,
        position: ArrayInput,
        direction: ArrayInput,
        cutoff: ArrayInput,
        ambient: ArrayInput | None = None,
        diffuse: ArrayInput = (1.0, 1.0, 1.0),
        specular: ArrayInput | None = None,
        attenuation: ArrayInput | Attenuation | None = None,
        shadow: Shadow | None = None,
    ) -> None:
        set_field(self, "position", float_array("position", position, (3,)))
        set_field(self, "direction", float_array("direction", direction, (3,)))
        set_field(self, "cutoff", real_number("cutoff", cutoff, above=0.0, below=math.pi / 2))
        _set_colors(self, ambient, diffuse, specular)
        _set_shadow(self, shadow)
        _set_attenuation(self, attenuation)


ShiningLight: TypeAlias = DirectionalLight | PointLight | SpotLight
Light: TypeAlias = AmbientLight | ShiningLight


def _set_colors(
    light: ShiningLight,
    ambient: ArrayInput | None,
    diffuse: ArrayInput,
    specular: ArrayInput | None,
) -> None:
    if ambient is not None:
        ambient = float_array("ambient", ambient, (3,))
    set_field(light, "ambient", ambient)
    color = float_array("diffuse", diffuse, (3,))
    set_field(light, "diffuse", color)
    if specular is None:
        specular = own_copy(color)
    set_field(light, "specular", float_array("specular", specular, (3,)))


def _set_attenuation(
    light: PointLight | SpotLight, attenuation: ArrayInput | Attenuation | None
) -> None:
    if attenuation is not None and not isinstance(attenuation, Attenuation):
        attenuation = float_array("attenuation", attenuation, (3,))
    set_field(light, "attenuation", attenuation)


def _set_shadow(light: ShiningLight, shadow: Shadow | None) -> None:
    if shadow is not None and not isinstance(shadow, Shadow):
        raise ValueError(f"shadow: wanted a Shadow or None, got {type(shadow).__name__}")
    set_field(light, "shadow", shadow)


def total_ambient(lights: tuple[Light, ...]) -> Float[Array, "3"] | None:
    """Sum of the lights' ambient colours; None if no light has one."""
    colors = [light.color if isinstance(light, AmbientLight) else light.ambient for light in lights]
    present = [color for color in colors if color is not None]
    return sum(present[1:], start=present[0]) if present else None


def without_ambient(light: ShiningLight) -> ShiningLight:
    """The light without its ambient part."""
    other = copy.copy(light)
    set_field(other, "ambient", None)
    return other


def casts_shadow(light: Light) -> TypeGuard[ShiningLight]:
    """Whether the light casts shadows."""
    return not isinstance(light, AmbientLight) and light.shadow is not None


def needs_position(light: Light) -> bool:
    """Whether the light at a point depends on where the point is."""
    return isinstance(light, PointLight | SpotLight)


def needs_viewer_distance(light: Light) -> bool:
    """Whether the light at a point depends on how far away the viewer is."""
    if isinstance(light, AmbientLight) or not isinstance(light.attenuation, Attenuation):
        return False
    return light.attenuation.legs != "light"


def incoming(
    light: ShiningLight, position: Columns | None, viewer_distance: Array | None = None
) -> tuple[Columns, Array | None]:
    """Unit direction to the light, and the factor on its colours (None for one).

    Args:
        light: any but an ambient one.
        position: world positions as columns; may be None where `needs_position` is false.
        viewer_distance: of those from the viewer; may be None where `needs_viewer_distance` is
            false.
    """
    if isinstance(light, DirectionalLight):
        to_light = -normalize(light.direction)
        factor = None
        if light.attenuation is not None:
            factor = _attenuated(light.attenuation, None, viewer_distance)
        return [to_light[i] for i in range(3)], factor
    assert position is not None
    offset = [light.position[i] - position[i] for i in range(3)]
    direction, distance = normalize_columns(offset)
    factor = None
    if light.attenuation is not None:
        factor = _attenuated(light.attenuation, distance, viewer_distance)
    if isinstance(light, SpotLight):
        fade = _fade(light, direction)
        factor = fade if factor is None else fade * factor
    return direction, factor


def _attenuated(
    attenuation: Array | Attenuation, distance: Array | None, viewer_distance: Array | None
) -> Array:
    if isinstance(attenuation, Attenuation):
        legs = {"light": (distance,), "viewer": (viewer_distance,)}
        used = legs.get(attenuation.legs, (distance, viewer_distance))
        attenuation = attenuation.coefficients
    else:
        used = (distance,)
    known = [leg for leg in used if leg is not None]
    distance = sum(known[1:], start=known[0])
    a, b, c = (attenuation[i] for i in range(3))
    divisor = a + distance * (b + distance * c)
    return jnp.where(divisor > 0, 1, 0) / jnp.where(divisor > 0, divisor, 1)


def _fade(light: SpotLight, to_light: Columns) -> Array:
    """Part of the light on the axis that goes in a direction.

    1 - cos a is half the square of the distance between the two unit vectors, which keeps its
    relative precision, and its derivative, at the axis.
    """
    axis = normalize(light.direction)
    across = [axis[i] + to_light[i] for i in range(3)]
    twice_versine = dot_columns(across, across)
    half = 2 * jnp.sin(light.cutoff / 2)
    inverse = jnp.where(half == 0, 0, 1) / jnp.where(half == 0, 1, half * half)
    return jnp.where(half == 0, 0, jnp.maximum(1 - twice_versine * inverse, 0))


def normalize_columns(vector: Columns) -> tuple[Columns, Array]:
    """Unit vector and length, kept as columns; a zero vector gives zeros, with zero gradients."""
    unit, length, _ = _normalized(vector)
    return unit, length


@jax.custom_jvp
def _normalized(vector: Columns) -> tuple[Columns, Array, Array]:
    """Also the inverse of the length, 0 of a zero vector.

    Lengths are taken relative to the largest component, so that no square over- or underflows.
    """
    x, y, z = (jnp.abs(component) for component in vector)
    largest = jnp.maximum(jnp.maximum(x, y), z)
    positive = largest > 0
    inverse = 1 / jnp.where(positive, largest, 1)
    scaled = [component * inverse for component in vector]
    square = dot_columns(scaled, scaled)
    length = jnp.sqrt(jnp.where(positive, square, 1))
    unit = jnp.where(positive, 1, 0) / length
    length = jnp.where(positive, length * largest, 0)
    return [component * unit for component in scaled], length, unit * inverse


@_normalized.defjvp
def _normalized_derivative(primals: Any, tangents: Any) -> tuple[Any, Any]:
    unit, length, inverse = found = _normalized(*primals)
    change = [part * inverse for part in tangents[0]]
    longer = dot_columns(unit, change)
    turned = [c - longer * u for c, u in zip(change, unit, strict=True)]
    return found, (turned, longer * length, -inverse * longer)


def dot_columns(a: Columns | Array, b: Columns | Array) -> Array:
    """Dot products of vectors kept as columns."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
