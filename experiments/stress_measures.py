"""Strained scenes drawn with derivatives, and what there is to measure of them."""

import functools
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import stress_reference
import stress_scenes
from jax import Array
from stress_reference import (
    AMBIENT,
    ATTENUATION,
    BACKGROUND,
    EPSILON,
    MARGIN,
    SHININESS,
    SPECULAR,
    Cameras,
)
from stress_scenes import CONTINUOUS, INVARIANCES, VERTICES, Parts

import diffrast as dr

Measures = dict[str, np.ndarray]  # one number a scene


class Group(NamedTuple):
    """How scenes are drawn.

    Attributes:
        settings: for `RenderSettings`.
        own_normals: whether the mesh has none, so that they are found from its faces.
        shadow: of both lights.
        share: of the scenes, since some take longer than others.
        compared: share of these that are changed without effect, too.
    """

    settings: dict[str, Any]
    own_normals: bool = False
    shadow: dr.Shadow | None = None
    share: float = 1.0
    compared: float = 0.0


GROUPS = {
    "plain": Group({"antialias": False}, compared=1.0),
    "edges": Group({}, share=0.5, compared=0.1),
    "own normals": Group({"shading": "gouraud", "cull_backfaces": True}, True, share=0.1),
    "shadows": Group({}, shadow=dr.Shadow(resolution=32), share=0.02),
}
EDGE_TOLERANCE = 1e-2  # of a colour: more counts as a pixel that differs
SHAKES = 8  # pictures in float64 that tell what of one with edges rounding may change


# Drawing ------------------------------------------------------------------------------------------


def picture(parts: dict[str, Array], group: Group, size: int) -> tuple[Array, dr.Camera]:
    """Draw one scene."""
    unit = parts["size"]
    camera = dr.Camera.perspective(
        **{name: parts[name] for name in ("eye", "target", "up", "fov_y", "near", "far")}
    )
    flip = jnp.ones((4, 1), unit.dtype).at[0].set(parts["mirror"])
    camera = dr.Camera(
        view=camera.view,
        projection=flip * camera.projection,
        view_remainder=camera.view_remainder,
    )
    a, b, c = ATTENUATION
    lights = [
        dr.DirectionalLight(
            direction=parts["direction"], ambient=[AMBIENT] * 3, shadow=group.shadow
        ),
        dr.PointLight(
            position=parts["lamp"],
            attenuation=jnp.stack([a * jnp.ones_like(unit), b / unit, c / unit**2]),
            shadow=group.shadow,
        ),
    ]
    mesh = dr.Mesh(
        vertices=parts["vertices"],
        faces=parts["faces"],
        normals=None if group.own_normals else parts["normals"],
    )
    material = dr.Material(
        ambient=[1.0] * 3, diffuse=parts["diffuse"], specular=[SPECULAR] * 3, shininess=SHININESS
    )
    scene = dr.Scene(objects=[dr.Object(mesh, material)], lights=lights, background=BACKGROUND)
    settings = dr.RenderSettings(height=size, width=size, **group.settings)
    return dr.render(scene, camera, settings), camera


class Drawn(NamedTuple):
    """Pictures of a batch, a derivative forward and one backward."""

    image: Any
    camera: Any
    forward: Any
    backward: Any


@functools.cache
def program(name: str, size: int) -> Callable[..., Drawn]:
    """Draw a batch with derivatives: compiled once, for both directions."""

    def draw(parts: Any, change: Any, weights: Any) -> Drawn:
        given = {key: part for key, part in parts.items() if key not in CONTINUOUS}

        def image(varied: Any) -> tuple[Array, dr.Camera]:
            return picture(varied | given, GROUPS[name], size)

        varied = {key: parts[key] for key in CONTINUOUS}
        value, forward, camera = jax.linearize(image, varied, has_aux=True)
        (backward,) = jax.linear_transpose(forward, varied)(weights)
        return Drawn(value, camera, forward(change), backward)

    return jax.jit(jax.vmap(draw))


def drawn(name: str, parts: Parts, size: int) -> Drawn:
    """Draw a batch of scenes."""
    change, weights = directions(parts, size)
    found = program(name, size)(parts, change, weights)
    return jax.tree.map(np.asarray, found)


def directions(parts: Parts, size: int) -> tuple[Parts, np.ndarray]:
    """In which derivatives are taken forward, and by which weights backward."""
    generator = np.random.default_rng(1)
    steps = {name: generator.normal(size=parts[name].shape) for name in CONTINUOUS}
    for name in stress_scenes.POINTS:
        unit = parts["size"].reshape(-1, *[1] * (steps[name].ndim - 1))
        steps[name] = steps[name] * unit
    steps["fov_y"] = 0.1 * steps["fov_y"]
    weights = generator.normal(size=(len(parts["faces"]), size, size, 3))
    return stress_scenes.single(steps), weights.astype(np.float32)


def cameras_of(found: Drawn) -> Cameras:
    """The matrices in float64, with the digits that float32 keeps apart."""
    view = found.camera.view.astype(np.float64)
    view[:, :3, 3] += found.camera.view_remainder
    return Cameras(view, found.camera.projection.astype(np.float64))


# Measures -----------------------------------------------------------------------------------------


def per_scene(values: Any) -> np.ndarray:
    """Sum of all but the first axis."""
    return np.asarray(values).reshape(len(values), -1).sum(axis=1)


def finite_measures(parts: Parts, found: Drawn) -> Measures:
    """What is not finite, and how far the two directions disagree."""
    measures = {
        "value not finite": per_scene(~np.isfinite(found.image)),
        "forward not finite": per_scene(~np.isfinite(found.forward)),
        "backward not finite": sum(per_scene(~np.isfinite(g)) for g in found.backward.values()),
    }
    change, weights = directions(parts, found.image.shape[1])
    with np.errstate(all="ignore"):
        along = weights * found.forward.astype(np.float64)
        back = [np.float64(found.backward[key]) * change[key] for key in CONTINUOUS]
        size = per_scene(np.abs(along)) + sum(per_scene(np.abs(part)) for part in back)
        apart = np.abs(per_scene(along) - sum(per_scene(part) for part in back))
    return measures | {"directions apart": apart / np.where(size > 0, size, 1)}


def reference_measures(image: np.ndarray, truth: stress_reference.Reference) -> Measures:
    """How far pictures are from those in float64."""
    error = np.abs(np.float64(image) - truth.image).max(axis=-1)
    differs = ~(error <= truth.bound)
    clear = np.where(truth.clear, error, 0)
    return {
        "wrong": per_scene(truth.clear & differs),
        "error": clear.max(axis=(1, 2)),
        "error / bound": (clear / truth.bound).max(axis=(1, 2)),
        "share unclear": (~truth.clear).mean(axis=(1, 2)),
        "share differing": differs.mean(axis=(1, 2)),
    }


def changed(change: str, parts: Parts) -> Parts:
    """A batch, each scene changed by itself, and the same way whatever its place."""
    scenes = []
    for index in range(len(parts["faces"])):
        scene = {key: part[index] for key, part in parts.items()}
        generator = np.random.default_rng(scene["eye"].view(np.uint32))
        scenes.append(INVARIANCES[change](generator, scene))
    return stress_scenes.stacked(scenes)


def plain_measures(parts: Parts, found: Drawn) -> Measures:
    """Against float64, and against the same scenes changed without effect."""
    size = found.image.shape[1]
    truth = stress_reference.reference(parts, cameras_of(found), size)
    measures = reference_measures(found.image, truth)
    for change in INVARIANCES:
        other_parts = changed(change, parts)
        other = drawn("plain", other_parts, size)
        if change == "rigid motion":  # which rounds: what is seen then is another scene
            moved = stress_reference.reference(other_parts, cameras_of(other), size)
            measures[f"{change}: wrong"] = reference_measures(other.image, moved)["wrong"]
            apart = np.abs(other.image - found.image).max(axis=-1)
            clear = (
                moved.clear
                & truth.clear
                & (np.abs(moved.image - truth.image).max(axis=-1) <= truth.bound)
            )
        else:
            image = other.image[:, :, ::-1] if change == "mirror" else other.image
            apart = np.abs(image - found.image).max(axis=-1)
            clear = truth.clear
            measures[f"{change}: wrong"] = per_scene(clear & ~(apart <= 2 * truth.bound))
        measures[f"{change}: share differing"] = (~(apart <= truth.bound)).mean(axis=(1, 2))
        measures[f"{change}: error"] = np.where(clear, apart, 0).max(axis=(1, 2))
    return measures


def edge_measures(parts: Parts, found: Drawn) -> Measures:
    """Against the same scenes changed without effect."""
    size = found.image.shape[1]
    measures: Measures = {}
    for change in INVARIANCES:
        image = drawn("edges", changed(change, parts), size).image
        image = image[:, :, ::-1] if change == "mirror" else image
        measures |= share_measures(change, found.image, image)
    return measures


def share_measures(name: str, first: np.ndarray, second: np.ndarray) -> Measures:
    """Share of the pixels that differ, and the largest difference."""
    apart = np.abs(np.float64(first) - second).max(axis=-1)
    limit = EDGE_TOLERANCE * (1 + np.abs(second).max(axis=-1))
    return {
        f"{name}: share differing": (~(apart <= limit)).mean(axis=(1, 2)),
        f"{name}: largest": apart.max(axis=(1, 2)),
        f"{name}: median": np.median(apart, axis=(1, 2)),
    }


def measured(name: str, parts: Parts, size: int, *, compare: bool) -> tuple[Measures, np.ndarray]:
    """All that is known of a batch drawn in one way, and its pictures."""
    found = drawn(name, parts, size)
    measures = finite_measures(parts, found)
    if compare:
        further = plain_measures if name == "plain" else edge_measures
        measures |= further(parts, found)
    return measures, found.image


def failures(measures: Measures) -> Iterator[tuple[str, np.ndarray]]:
    """Kinds of failure, and which scenes of a batch have them."""
    for name, values in measures.items():
        if name.endswith(("not finite", "wrong")):
            yield name, values > 0


def shaken(parts: Parts, size: int, generator: np.random.Generator) -> Parts:
    """A batch in float64, moved and turned by as much as float32 and snapping may do it."""
    eye = parts["eye"][:, None]
    pixel = 2 * np.tan(parts["fov_y"] / 2)[:, None, None] / size
    distance = np.linalg.norm(parts["vertices"] - eye, axis=-1, keepdims=True)
    moved = MARGIN * pixel * distance
    # Points that are seen are rounded: that turns the ways to the lamp and to the eye.
    rounding = 4 * EPSILON * np.abs(parts["vertices"])
    turned = rounding / np.where(distance > 0, distance, 1)
    signs = generator.choice([-1.0, 1.0], size=(3, VERTICES, 3))
    return parts | {
        "vertices": parts["vertices"] + moved * signs[0],
        "normals": parts["normals"] + turned * np.abs(parts["normals"]) * signs[1],
        "lamp": parts["lamp"] + 4 * EPSILON * np.abs(parts["lamp"]) * signs[2, 0],
    }


def in_double(path: Path) -> None:
    """Draw the batches of a file, in a process whose numbers have twice the digits."""
    with np.load(path) as file:
        given = {
            key: part if key == "faces" else part.astype(np.float64) for key, part in file.items()
        }
    size = int(given.pop("pixels"))
    draw = jax.jit(jax.vmap(lambda parts: picture(parts, GROUPS["edges"], size)[0]))
    images, changes = [], []
    for index in range(len(given["faces"])):
        exact = {key: part[index] for key, part in given.items()}
        image, generator = np.asarray(draw(exact)), np.random.default_rng(0)
        with np.errstate(all="ignore"):
            shakes = [shaken(exact, size, generator) for _ in range(SHAKES)]
        others = (draw(parts) for parts in shakes)
        images.append(image)
        changes.append(np.max([np.abs(other - image).max(axis=-1) for other in others], axis=0))
    np.savez(path.with_name("drawn.npz"), images=images, changes=changes)


def float64_measures(batches: list[Parts], images: list[np.ndarray], size: int) -> list[Measures]:
    """How far pictures with edges are from the library's in float64."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenes.npz"
        np.savez(path, pixels=size, **stress_scenes.stacked(batches))
        command = [sys.executable, __file__, str(path)]
        subprocess.run(command, check=True, env=os.environ | {"JAX_ENABLE_X64": "1"})
        with np.load(path.with_name("drawn.npz")) as drawn:
            truths = zip(images, drawn["images"], drawn["changes"], strict=True)
    return [against_double(*batch) for batch in truths]


def against_double(image: np.ndarray, truth: np.ndarray, change: np.ndarray) -> Measures:
    """How far pictures are from those in float64, in which shaking changes pixels by `change`."""
    error = np.abs(np.float64(image) - truth).max(axis=-1)
    clear, bound = stress_reference.held_to(truth, change)
    return share_measures("float64", image, truth) | {
        "float64: wrong": per_scene(clear & ~(error <= bound)),
        "float64: error": np.where(clear, error, 0).max(axis=(1, 2)),
        "float64: share unclear": (~clear).mean(axis=(1, 2)),
    }


if __name__ == "__main__":
    in_double(Path(sys.argv[1]))
