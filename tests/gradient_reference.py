"""Reference derivatives of images under a box filter, of the scenes of `gradient_scenes`.

`reference_jacobian` differentiates `box_filter.render_box` by central differences, with one step
of Richardson's extrapolation, for the 13 numbers that `moved` explains, camera and first object,
and where a light casts shadows for the 7 of `moved_lights`. Projections of the Jacobians on smooth
random fields are stored in data/gradients.npz; running this file makes them again:

    python tests/gradient_reference.py [--scenes cubes,sphere] [--size 96]
    python tests/gradient_reference.py --check cubes

For a scene NAME of P = 13 or 20 parameters the file holds `NAME/projections` (16, P), the sums
over pixels and channels of `adjoint_fields` times the Jacobian; `NAME/target_image_params` (P,), a
motion by 1.5 pixels or so; and `NAME/l2_gradient` (P,), the gradient at rest of half the sum of
squared differences to the image after that motion.
"""

import argparse
import time
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from box_filter import render_box
from box_shadow import source
from gradient_scenes import SCENES, so3_exp
from reference import look_at, normalize, orthographic, perspective

STORE = Path(__file__).parent / "data" / "gradients.npz"
PARAMETERS = 13
LIGHT_PARAMETERS = 7
GROUPS = {
    "rotation": slice(0, 3),
    "translation": slice(3, 6),
    "fov": slice(6, 7),
    "object rotation": slice(7, 10),
    "object translation": slice(10, 13),
}
LIGHT_GROUPS = {
    "light position": slice(13, 16),
    "light direction": slice(16, 19),
    "light cutoff": slice(19, 20),
}
LIGHT_GROUPS_OF = {
    "directional": ["light direction"],
    "point": ["light position"],
    "spot": list(LIGHT_GROUPS),
}
SEED = 20240611


# Motion.


def moved(problem, params=None) -> tuple:
    """Return (positions, normals, faces, view, projection, material) for the first 13 parameters.

    Positions and normals are in world space, material values have one entry a face. The view is
    T(translation) @ R(so3_exp(rotation)) @ look_at(eye, target, up), and object 0 is turned about
    its pivot before it is shifted. The parameters are

        0:3    rotation vector of the camera, in eye axes
        3:6    translation of the camera, in eye axes
        6      change of log(tan(fov_y / 2))
        7:10   rotation vector of object 0 about its pivot, in world axes
        10:13  translation of object 0, in world axes.
    """
    params = np.zeros(PARAMETERS) if params is None else np.asarray(params, np.float64)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = so3_exp(params[0:3]), params[3:6]
    view = motion @ look_at(problem.eye, problem.target, problem.up)
    tangent = np.tan(problem.fov_y / 2) * np.exp(params[6])
    projection = perspective(2 * np.arctan(tangent), 1.0, problem.near, problem.far)
    if problem.window is not None:
        projection = orthographic(problem.window, 1.0, problem.near, problem.far)

    positions, normals, faces, start = [], [], [], 0
    for index, thing in enumerate(problem.objects):
        rotation, shift = np.eye(3), np.zeros(3)
        if index == 0:
            rotation, shift = so3_exp(params[7:10]), params[10:13]
        positions.append((thing.vertices - thing.pivot) @ rotation.T + thing.pivot + shift)
        normals.append(thing.normals @ rotation.T)
        faces.append(thing.faces + start)
        start += len(thing.vertices)
    material = {
        key: np.concatenate(
            [
                np.repeat(np.asarray(thing.material[key], np.float64)[None], len(thing.faces), 0)
                for thing in problem.objects
            ]
        )
        for key in ("ambient", "diffuse", "specular", "shininess")
    }
    parts = np.concatenate(positions), np.concatenate(normals), np.concatenate(faces)
    return *parts, view, projection, material


def caster(problem) -> int | None:
    """Which light is the first to cast shadows."""
    return next((k for k, light in enumerate(problem.lights) if light.get("shadow")), None)


def parameters(problem) -> int:
    return PARAMETERS if caster(problem) is None else PARAMETERS + LIGHT_PARAMETERS


def groups(problem) -> dict[str, slice]:
    """The groups of parameters that have an effect."""
    number = caster(problem)
    names = [] if number is None else LIGHT_GROUPS_OF[problem.lights[number]["type"]]
    return GROUPS | {name: LIGHT_GROUPS[name] for name in names}


def moved_lights(problem, params=None) -> list[dict]:
    """Return the lights, the first that casts shadows moved by parameters 13 to 19.

    Those that mean nothing for a light have no effect. The parameters are

        13:16  translation of the light, in world axes
        16:19  rotation vector of its direction, in world axes
        19     change of log(cutoff).
    """
    lights, number = list(problem.lights), caster(problem)
    if params is None or number is None:
        return lights
    light = dict(lights[number])
    if light["type"] != "directional":
        light["position"] = np.asarray(light["position"], float) + params[13:16]
    if light["type"] != "point":
        light["direction"] = so3_exp(params[16:19]) @ np.asarray(light["direction"], float)
    if light["type"] == "spot":
        light["cutoff"] = light["cutoff"] * np.exp(params[19])
    lights[number] = light
    return lights


def pixels_moved(problem, params) -> float:
    """Root mean square motion in pixels of those points in the image that move at all.

    The points are some of all surfaces, of the shadow of object 0 on the plane of the last object,
    and of the rim of a spot light's cone on that plane. None may move: zero.
    """
    here, there = (_points_in_pixels(problem, p) for p in (np.zeros(parameters(problem)), params))
    inside = np.all((here > 0) & (here < problem.size) & np.isfinite(there), axis=1)
    distance = np.linalg.norm((there - here)[inside], axis=1)
    moving = distance[distance > 0]
    return float(np.sqrt(np.mean(moving**2))) if len(moving) else 0.0


def _points_in_pixels(problem, params) -> np.ndarray:
    """Points scattered over all faces, hidden ones too, in pixels; NaN behind the near plane."""
    positions, _, faces, view, projection, _ = moved(problem, params)
    random = np.random.default_rng(SEED)
    counts = np.array([len(thing.faces) for thing in problem.objects])
    starts = np.cumsum(counts) - counts
    chosen = np.concatenate(
        [start + random.integers(n, size=4096) for start, n in zip(starts, counts, strict=True)]
    )
    weights = random.dirichlet(np.ones(3), size=len(chosen))
    points = np.einsum("nk,nkc->nc", weights, positions[faces[chosen]])
    points = np.pad(points, ((0, 0), (0, 1)), constant_values=1)
    if caster(problem) is not None:
        light = moved_lights(problem, params)[caster(problem)]
        plane = positions[faces[-1]]
        shades = _shadow_points(light, points[chosen < counts[0]], plane)
        points = np.concatenate([points, shades])
    clip = points @ (projection @ view).T
    w = np.where(clip[:, 3:] > problem.near, clip[:, 3:], np.nan)
    return (clip[:, :2] / w * [1, -1] + 1) * problem.size / 2


def _shadow_points(light, points, corners) -> np.ndarray:
    """Shadows (N, 4) of homogeneous points, and of a cone's rim, on the plane of three corners.

    NaN where they are none, as the point is behind the light or the ray leads away from the plane.
    """
    if light["type"] == "spot":
        along = normalize(np.asarray(light["direction"], float))
        side = normalize(np.cross(along, np.eye(3)[np.argmin(np.abs(along))]))
        across = side, np.cross(along, side)
        around = np.linspace(0, 2 * np.pi, 256, endpoint=False)[:, None]
        outwards = np.cos(around) * across[0] + np.sin(around) * across[1]
        rim = along + np.tan(light["cutoff"]) * outwards
        points = np.concatenate([points, np.pad(rim, ((0, 0), (0, 1)))])
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    plane, place = np.append(normal, -normal @ corners[0]), source(light)
    plane = plane * np.sign(plane @ place)
    shades = (plane @ place) * points - (points @ plane)[:, None] * place
    return shades / np.where(shades[:, 3:] > 0, shades[:, 3:], np.nan)


# Images and derivatives.


def reference_image(problem, params=None, lines=32, levelness=None) -> np.ndarray:
    """Return the image (H, W, 3) after the motion `params`.

    It is a mean of two integrals, over level and over upright lines, `levelness` (H, W, 1) being
    the weight of the latter: by default, that of the image.
    """
    level, upright = (_render(problem, params, lines, upright) for upright in (False, True))
    weight = _levelness((level + upright) / 2) if levelness is None else levelness
    return (1 - weight) * level + weight * upright


def _levelness(image) -> np.ndarray:
    """From 0 where outlines are upright to 1 where they are level: (H, W, 1)."""
    squares = [np.sum(np.gradient(image, axis=axis) ** 2, axis=-1) for axis in (0, 1)]
    for axis in (0, 1):  # over 3 x 3 pixels
        padded = [np.pad(s, [(int(i == axis),) * 2 for i in (0, 1)], mode="edge") for s in squares]
        squares = [
            sum(np.take(s, np.arange(k, k + image.shape[axis]), axis=axis) for k in range(3))
            for s in padded
        ]
    level, upright = (s**2 + 1e-12 for s in squares)
    return (level / (level + upright))[..., None]


def _render(problem, params, lines, upright) -> np.ndarray:
    positions, normals, faces, view, projection, material = moved(problem, params)
    return render_box(
        positions,
        normals,
        faces,
        view,
        projection,
        lights=moved_lights(problem, params),
        material=material,
        background=problem.background,
        height=problem.size,
        width=problem.size,
        lines=lines,
        nodes=problem.nodes,
        shading=problem.shading,
        cull_backfaces=problem.cull_backfaces,
        piercing=problem.piercing,
        upright=upright,
    )


def step_sizes(problem) -> np.ndarray:
    """For each parameter the change that moves things by one pixel, zero if there is none."""
    tiny = 1e-6
    pixels = [pixels_moved(problem, tiny * axis) for axis in np.eye(parameters(problem))]
    return np.array([tiny / moved if moved else 0.0 for moved in pixels])


def reference_jacobian(problem, lines=None, step=None, which=slice(None)) -> np.ndarray:
    """Return the derivatives (P, H, W, 3) of the image at rest, or those by some parameters.

    Central differences D over `step` pixels and twice as many give 2 D(step) - D(2 step): a pixel
    that an outline enters bends the image, and adds an error in proportion to the step.
    """
    lines, step = lines or problem.lines, step or problem.step
    levelness = _levelness(reference_image(problem, lines=lines))

    def difference(change) -> np.ndarray:
        if not np.any(change):
            return np.zeros((problem.size, problem.size, 3))
        ahead, behind = (reference_image(problem, s * change, lines, levelness) for s in (1, -1))
        return (ahead - behind) / (2 * np.linalg.norm(change))

    changes = step * np.diag(step_sizes(problem))
    return np.stack([2 * difference(c) - difference(2 * c) for c in changes[which]])


def adjoint_fields(size=96, count=16) -> np.ndarray:
    """Return (count, size, size, 3): white noise blurred by a Gaussian of 4 pixels, of RMS one.

    The blur wraps round the image, and the channels are independent.
    """
    noise = np.random.default_rng(SEED).normal(size=(count, size, size, 3))
    frequency = np.fft.fftfreq(size)
    blur = np.exp(-2 * (np.pi * 4.0 * frequency) ** 2)
    blur = (blur[:, None] * blur)[None, :, :, None]
    fields = np.fft.ifft2(np.fft.fft2(noise, axes=(1, 2)) * blur, axes=(1, 2)).real
    return fields / np.sqrt(np.mean(fields**2, axis=(1, 2, 3), keepdims=True))


def project(jacobian) -> np.ndarray:
    """Sums over pixels and channels of the fields times the Jacobian: (16, P)."""
    return np.einsum("fhwc,phwc->fp", adjoint_fields(jacobian.shape[1]), jacobian, optimize=True)


def target_params(problem) -> np.ndarray:
    """Return a random motion (P,) by 1.5 pixels, to which each parameter adds as much."""
    steps = step_sizes(problem)
    params = 0.4 * np.random.default_rng(SEED + 1).choice([-1.0, 1.0], len(steps)) * steps
    for _ in range(4):
        params *= 1.5 / pixels_moved(problem, params)
    return params


# The stored file.


def load(name) -> dict[str, np.ndarray]:
    """Return what is stored for a scene, in float64."""
    prefix = f"{name}/"
    with np.load(STORE) as data:
        keys = [key for key in data if key.startswith(prefix)]
        return {key.removeprefix(prefix): data[key].astype(np.float64) for key in keys}


def compute(problem) -> dict[str, np.ndarray]:
    """Return what is to be stored for a scene."""
    jacobian = reference_jacobian(problem)
    return {
        "projections": project(jacobian),
        "target_image_params": target_params(problem),
        "l2_gradient": l2_gradient(jacobian, residual_of(problem)),
    }


def residual_of(problem) -> np.ndarray:
    """The image at rest less the target."""
    return reference_image(problem) - reference_image(problem, target_params(problem))


def l2_gradient(jacobian, residual) -> np.ndarray:
    return np.einsum("phwc,hwc->p", jacobian, residual)


def check(problem) -> None:
    """Print how far what is stored depends on the number of lines and on the step.

    In proportion to those of the same group of parameters, and to those of all parameters in
    units of pixels: a smooth sphere, say, hardly changes when it turns.
    """
    residual = residual_of(problem)

    def stored(**options) -> dict[str, np.ndarray]:
        jacobian = reference_jacobian(problem, **options)
        return {"fields": project(jacobian), "L2": l2_gradient(jacobian, residual)[None]}

    base, steps = stored(), step_sizes(problem)
    others = {
        "twice the lines": stored(lines=2 * problem.lines),
        "half the step": stored(step=problem.step / 2),
    }
    for (what, other), (group, part), key in product(others.items(), groups(problem).items(), base):
        change = other[key] - base[key]
        error = np.linalg.norm(change[:, part]) / np.linalg.norm(other[key][:, part])
        share = np.linalg.norm((change * steps)[:, part]) / np.linalg.norm(base[key] * steps)
        print(f"  {what:16} {key:6} {group:19} {error:.2e}, of all groups {share:.2e}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="Compute the stored reference derivatives.")
    parser.add_argument("--scenes", help="do these only, and keep what is stored of the others")
    parser.add_argument("--check", metavar="SCENE", help="print convergence, store nothing")
    parser.add_argument("--size", type=int, default=96, help="side of the image in pixels")
    arguments = parser.parse_args()
    if arguments.check:
        return check(replace(SCENES[arguments.check](), size=arguments.size))
    stored = {}
    if arguments.scenes and STORE.exists():
        with np.load(STORE) as data:
            stored = dict(data)
    STORE.parent.mkdir(exist_ok=True)
    for name in arguments.scenes.split(",") if arguments.scenes else SCENES:
        start = time.perf_counter()
        problem = replace(SCENES[name](), size=arguments.size)
        results = compute(problem)
        stored |= {f"{name}/{key}": value.astype(np.float32) for key, value in results.items()}
        np.savez_compressed(STORE, **stored)
        faces = sum(len(thing.faces) for thing in problem.objects)
        print(f"{name}: {faces} faces, {time.perf_counter() - start:.0f} s", flush=True)
    return None


if __name__ == "__main__":
    main()
