"""Surface and incoming light to colour: the Phong reflection model.

colour = Σ ambient + Σ_lights factor (diffuse max(n·l, 0) + specular max(r·v, 0)^m), with r the
mirror image of l in n and the highlight only where n·l > 0 (FEATURES S1, S4). Blinn's highlight is
max(n·h, 0)^m, with h half-way between l and the viewer's direction v (Blinn 1977). Everything is
kept as columns, one array a component, which XLA fuses into one pass where stacked vectors make it
compute their parts again for every component.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from diffrast.light import (
    AmbientLight,
    Columns,
    Light,
    PointLight,
    dot_columns,
    incoming,
    needs_position,
    needs_viewer_distance,
    normalize_columns,
    total_ambient,
)


class Surface(NamedTuple):
    """Points to be shaded, as columns of one shape (pixels or vertices)."""

    normal: Columns  # any length
    position: Columns | None  # world
    to_viewer: Columns | None  # unit
    viewer_distance: Array | None = None


class Reflectance(NamedTuple):
    """A material at those points; each entry a number or of the points' shape."""

    ambient: Columns
    diffuse: Columns
    specular: Columns | None
    shininess: Array | None
    blinn: bool | Array = False  # whether the highlight is Blinn's


def needs(lights: tuple[Light, ...], specular: bool) -> tuple[bool, bool]:
    """Whether shading needs positions and whether it needs the direction to the viewer."""
    shining = any(not isinstance(light, AmbientLight) for light in lights)
    to_viewer = shining and specular
    position = any(needs_position(light) or needs_viewer_distance(light) for light in lights)
    return to_viewer or position, to_viewer


def phong(
    surface: Surface,
    reflectance: Reflectance,
    lights: tuple[Light, ...],
    reached: Sequence[Array | None] | None = None,
) -> Columns:
    """Reflected light, linear RGB, not clamped. Differentiable in everything.

    A surface that faces away from a light gets its ambient part only. Normals are used as they
    are: they are not turned towards the viewer.

    Args:
        surface: where light is reflected.
        reflectance: of the material there.
        lights: any.
        reached: for each light the part of it that arrives, None for all of it.
    """
    ambient = total_ambient(lights)
    zero = jnp.zeros_like(surface.normal[0])
    if ambient is None:
        color = [zero, zero, zero]
    else:
        color = [reflectance.ambient[c] * ambient[c] + zero for c in range(3)]
    if all(isinstance(light, AmbientLight) for light in lights):
        return color
    normal, _ = normalize_columns(surface.normal)
    for light, part in zip(lights, reached or [None] * len(lights), strict=True):
        if isinstance(light, AmbientLight):
            continue
        direction, factor = incoming(light, surface.position, surface.viewer_distance)
        # Spread once: the derivative by a light's direction is then summed once over all points.
        direction = [jnp.broadcast_to(part, zero.shape) for part in direction]
        if part is not None:
            factor = part if factor is None else part * factor
        cosine = dot_columns(normal, direction)
        if isinstance(light, PointLight) and light.incidence_cutoff is not None:
            cosine = _narrowed(light.incidence_cutoff, normal, direction, cosine)
        diffuse = jnp.maximum(cosine, 0)
        if factor is not None:
            diffuse = diffuse * factor
        for c in range(3):
            color[c] = color[c] + (reflectance.diffuse[c] * light.diffuse[c]) * diffuse
        if reflectance.specular is not None:
            assert surface.to_viewer is not None
            highlight = _highlight(normal, direction, surface.to_viewer, diffuse > 0, reflectance)
            if factor is not None:
                highlight = highlight * factor
            for c in range(3):
                color[c] = color[c] + (reflectance.specular[c] * light.specular[c]) * highlight
    return color


def _narrowed(cutoff: Array, normal: Columns, to_light: Columns, cosine: Array) -> Array:
    """1 - (1 - cos a) / (1 - cos cutoff) for light that comes from in front, else 0.

    Both versines are half the square of a distance between unit vectors.
    """
    apart = [n - d for n, d in zip(normal, to_light, strict=True)]
    half = 2 * jnp.sin(cutoff / 2)
    inverse = jnp.where(half == 0, 0, 1) / jnp.where(half == 0, 1, half * half)
    return jnp.where((cosine > 0) & (half > 0), 1 - dot_columns(apart, apart) * inverse, 0)


def _highlight(
    normal: Columns,
    to_light: Columns,
    to_viewer: Columns,
    lit: Array,
    reflectance: Reflectance,
) -> Array:
    """max(r·v, 0)^m, or Blinn's max(n·h, 0)^m, where the light reaches the front of the surface.

    The power is exp(m log x) behind a mask: finite, with finite derivatives, also at x = 0. What
    rounding adds to x = 1 is cut off, since a large m would make it infinite.
    """
    assert reflectance.shininess is not None
    blinn = reflectance.blinn
    if blinn is not True:
        cosine = dot_columns(normal, to_light)
        along = 2 * cosine * dot_columns(normal, to_viewer) - dot_columns(to_light, to_viewer)
    if blinn is not False:
        half, _ = normalize_columns([a + b for a, b in zip(to_light, to_viewer, strict=True)])
        across = dot_columns(normal, half)
        along = across if blinn is True else jnp.where(blinn, across, along)
    visible = (along > 0) & lit
    power = jnp.exp(reflectance.shininess * jnp.log(jnp.where(visible & (along < 1), along, 1)))
    return jnp.where(visible, power, 0)
