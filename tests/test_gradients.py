"""Derivatives through visibility, against differences of an exact box filter.

The numbers in data/gradients.npz are made by `python tests/gradient_reference.py`. To see the
errors of all scenes, large ones included: `python tests/test_gradients.py`.
"""

import sys
from dataclasses import replace

import gradient_reference as reference
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrast as dr

KINDS = {
    "ambient": dr.AmbientLight,
    "directional": dr.DirectionalLight,
    "point": dr.PointLight,
    "spot": dr.SpotLight,
}


def light_of(light):
    kind = KINDS[light["type"]]
    options = {key: value for key, value in light.items() if key not in ("type", "shadow")}
    if kind is dr.AmbientLight:
        options["color"] = options.pop("ambient")
    if light.get("shadow"):
        options["shadow"] = dr.Shadow(resolution=512)
    return kind(**options)


def moved_light(light, params):
    """The light after parameters 13 to 19, of which those that it has no use for do nothing."""
    changes = {}
    if not isinstance(light, dr.DirectionalLight):
        changes["position"] = light.position + params[13:16]
    if not isinstance(light, dr.PointLight):
        changes["direction"] = dr.linalg.so3_exp(params[16:19]) @ light.direction
    if isinstance(light, dr.SpotLight):
        changes["cutoff"] = light.cutoff * jnp.exp(params[19])
    return replace(light, **changes)


def scene_of(problem):
    """The scene and the camera of a problem as functions of its parameters."""
    objects = [
        dr.Object(
            dr.Mesh(vertices=o.vertices, faces=o.faces, normals=o.normals),
            dr.Material(**o.material),
        )
        for o in problem.objects
    ]
    lights = [light_of(light) for light in problem.lights]
    caster = reference.caster(problem)
    pivot = jnp.asarray(problem.objects[0].pivot)
    camera = dr.Camera.perspective(
        eye=problem.eye, target=problem.target, up=problem.up, fov_y=problem.fov_y,
        near=problem.near, far=problem.far,
    )  # fmt: skip

    def at(params):
        turn = dr.linalg.so3_exp(params[:3])
        motion = jnp.eye(4).at[:3, :3].set(turn).at[:3, 3].set(params[3:6])
        zoom = jnp.array([jnp.exp(-params[6]), jnp.exp(-params[6]), 1, 1])
        moved = dr.Camera(view=motion @ camera.view, projection=zoom[:, None] * camera.projection)
        turn = dr.linalg.so3_exp(params[7:10])
        shift = pivot - turn @ pivot + params[10:13]
        placed = jnp.eye(4).at[:3, :3].set(turn).at[:3, 3].set(shift)
        first = dr.Object(objects[0].mesh, objects[0].material, placed)
        shining = [
            moved_light(light, params) if number == caster else light
            for number, light in enumerate(lights)
        ]
        scene = dr.Scene(
            objects=[first, *objects[1:]], lights=shining, background=problem.background
        )
        return scene, moved

    return at


def renderer(problem, **options):
    at = scene_of(problem)
    settings = dr.RenderSettings(
        height=problem.size, width=problem.size, shading=problem.shading,
        cull_backfaces=problem.cull_backfaces, **({"antialias": True} | options),
    )  # fmt: skip
    return lambda params: dr.render(*at(params), settings)


# Largest relative errors of projections on random fields, and of the gradient of an L2 loss. The
# sphere hardly changes as it turns: that group says nothing.
BOUNDS = {
    "cubes": (0.003, 0.006),
    "border": (0.01, 0.01),
    "sphere": (0.02, 0.02),
    "torus2": (0.03, 0.02),
    "lattice": (0.015, 0.015),
    "piercing": (0.003, 0.02),
}
# How many times smaller the error of the image is than that of so many samples.
BETTER = {"cubes": (100, 1), "sphere": (1, 16), "lattice": (10, 16), "piercing": (100, 1)}


@pytest.mark.parametrize("name", BOUNDS)
def test_derivatives_are_those_of_the_box_filtered_image(name):
    found = errors(name)
    image_error = found.pop("image")
    for key, error in found.items():
        if name != "sphere" or not key.endswith("object rotation"):
            assert error < BOUNDS[name][key.startswith("L2")], (key, found)
    if name in BETTER:
        times, samples = BETTER[name]
        problem = reference.SCENES[name]()
        plain = renderer(problem, antialias=False, samples=samples)(jnp.zeros(13))
        assert times * image_error < np.abs(plain - reference.reference_image(problem)).mean()


def test_derivatives_by_vertices():
    # Triangles of some five pixels, all vertices moving at random.
    problem = replace(reference.crease(), size=48)
    thing = problem.objects[0]
    changes = np.random.default_rng(4).normal(size=(3, *thing.vertices.shape))
    fields = reference.adjoint_fields(problem.size)
    step = 2e-3

    def moved(vertices):
        return reference.reference_image(
            replace(problem, objects=[replace(thing, vertices=vertices)]), lines=32
        )

    scene, camera = scene_of(problem)(jnp.zeros(13))
    settings = dr.RenderSettings(
        height=problem.size, width=problem.size, shading="flat", antialias=True
    )

    @jax.jit
    def change_of_image(vertices, change):
        def image(vertices):
            mesh = replace(scene.objects[0].mesh, vertices=vertices)
            objects = [replace(scene.objects[0], mesh=mesh)]
            return dr.render(replace(scene, objects=objects), camera, settings)

        return jax.jvp(image, (vertices,), (change,))[1]

    ours, truth = [], []
    for change in changes:
        ours.append(
            change_of_image(scene.objects[0].mesh.vertices, jnp.asarray(change, jnp.float32))
        )
        ahead, behind = (moved(thing.vertices + s * step * change) for s in (1, -1))
        truth.append((ahead - behind) / (2 * step))
    ours, truth = (np.einsum("fhwc,nhwc->fn", fields, np.stack(x)) for x in (ours, truth))
    assert np.linalg.norm(ours - truth) < 0.07 * np.linalg.norm(truth)


def test_parallel_projection_has_the_same_edges():
    problem = replace(reference.piercing(), size=48, window=3.0)
    frame = {"eye": problem.eye, "target": problem.target, "up": problem.up}
    camera = dr.Camera.orthographic(height=3.0, near=problem.near, far=problem.far, **frame)
    settings = dr.RenderSettings(height=48, width=48, antialias=True)
    shift, step = np.array([0.3, -0.2, 0.5]), 1e-2

    def truth(steps):
        params = np.append(np.zeros(10), steps * step * shift)
        return reference.reference_image(problem, params)

    @jax.jit
    def image(shift):
        scene, _ = scene_of(problem)(jnp.zeros(13).at[10:].set(shift))
        return dr.render(scene, camera, settings)

    ours, moved = jax.jvp(image, (jnp.zeros(3),), (jnp.asarray(shift, jnp.float32),))
    assert np.abs(ours - truth(0)).mean() < 1e-4
    change = (truth(1) - truth(-1)) / (2 * step)
    fields = reference.adjoint_fields(48)
    got, want = (np.einsum("fhwc,hwc->f", fields, x) for x in (moved, change))

    assert np.linalg.norm(got - want) < 0.02 * np.linalg.norm(want)


def errors(name, **options):
    """Relative errors of the projected derivatives and of the L2 gradient, by parameter group."""
    problem = reference.SCENES[name]()
    stored = reference.load(name)
    render = renderer(problem, **options)
    fields = jnp.asarray(reference.adjoint_fields(problem.size), jnp.float32)
    image, pull = jax.vjp(jax.jit(render), jnp.zeros(reference.parameters(problem)))
    projections = np.stack([np.asarray(pull(field.reshape(image.shape))[0]) for field in fields])
    target = reference.reference_image(problem, stored["target_image_params"])
    gradient = np.asarray(pull(image - jnp.asarray(target, jnp.float32))[0])
    units = reference.step_sizes(problem)
    result = {}
    for group, part in reference.groups(problem).items():
        for key, ours, truth in (
            ("", projections, stored["projections"]),
            ("L2 ", gradient[None], stored["l2_gradient"][None]),
        ):
            difference = (ours - truth)[:, part] * units[part]
            result[key + group] = np.linalg.norm(difference) / np.linalg.norm(
                truth[:, part] * units[part]
            )
    result["image"] = float(np.abs(image - reference.reference_image(problem)).mean())
    return result


def main():
    for name in sys.argv[1:] or reference.SCENES:
        found = errors(name)
        text = "  ".join(f"{key} {value:.4f}" for key, value in found.items())
        print(f"{name:10} {text}", flush=True)


if __name__ == "__main__":
    main()
