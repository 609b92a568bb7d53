"""What does each feature cost, where it is used and where it is not?

    python experiments/benchmark_features.py [--size 512] [--repeats 30]

The plain scene is a smooth dull sphere of 5,040 faces under a directional light, without edges.
Each feature is added to it alone, all take turns, and the minimum over the repeats counts: forward,
and with the derivative of a weighted sum of the picture by the camera's eye, the object's
translation and the light's colour. What a feature costs is its time less the plain scene's.

Expected: a second light, a highlight, "gouraud" and "flat" within a few milliseconds of the plain
scene; "unlit" a third of it; edges or a shadow about twice as much, both more than three times, 4
samples more than four times. With everything outside of the picture it should take less than a
tenth, and does not: every pixel is shaded all the same, but in pictures of more than 90,000 pixels.

Written to `--out`: `benchmark_features.json`, `.md` and `.png`.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import pyplot
from timing import benchmark_options, compiled, markdown, minimum_times, write_report

import diffrast as dr

SUN = {"direction": (-1.0, -1.0, -2.0), "ambient": (0.1, 0.1, 0.1)}
LAMP = {"position": (2.0, 3.0, 4.0), "ambient": (0.1, 0.1, 0.1)}
COLUMNS = ("ms", "added_ms")


@dataclasses.dataclass(frozen=True)
class Variant:
    """A scene that differs from the plain one.

    Attributes:
        lights: instead of one directional light.
        material: options of the sphere's.
        settings: options of the picture's.
        aside: how far the camera looks past the sphere.
        base: the variant that it is compared with.
    """

    lights: Sequence[Any] = (dr.DirectionalLight(**SUN),)
    material: dict[str, Any] = dataclasses.field(default_factory=dict)
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)
    aside: float = 0.0
    base: str = "plain"


def variants() -> dict[str, Variant]:
    """Every feature alone."""
    squares = np.indices((256, 256)).sum(axis=0) // 16 % 2
    checks = jnp.asarray(np.repeat(0.3 + 0.6 * squares[..., None], 3, axis=2), jnp.float32)
    edges = {"antialias": True}
    lamp = (dr.PointLight(**LAMP),)
    shadow = (dr.DirectionalLight(**SUN, shadow=dr.Shadow(resolution=512)),)
    return {
        "plain": Variant(),
        "culled back faces": Variant(settings={"cull_backfaces": True}),
        "highlight": Variant(material={"specular": (0.5, 0.5, 0.5)}),
        "second light": Variant(lights=(dr.DirectionalLight(**SUN), dr.DirectionalLight(**SUN))),
        "point light": Variant(lights=lamp),
        "attenuation": Variant(
            lights=(dr.PointLight(**LAMP, attenuation=(0.5, 0.1, 0.05)),), base="point light"
        ),
        "shadow": Variant(lights=shadow),
        **{
            f"texture, {kind}": Variant(material={"texture": dr.Texture(checks, filter=kind)})
            for kind in ("nearest", "bilinear", "trilinear")
        },
        "gouraud": Variant(settings={"shading": "gouraud"}),
        "flat": Variant(settings={"shading": "flat"}),
        "unlit": Variant(settings={"shading": "unlit"}),
        "4 samples": Variant(settings={"samples": 4}),
        "edges": Variant(settings=edges),
        "shadow, edges": Variant(lights=shadow, settings=edges, base="edges"),
        "nothing in view": Variant(aside=30.0),
        "nothing in view, edges": Variant(aside=30.0, settings=edges, base="edges"),
    }


def weighted_picture(variant: Variant, size: int) -> tuple[Any, tuple[Any, ...]]:
    """The picture's function of (eye, translation, colour), mesh, lights, material; and these."""
    options = {"height": size, "width": size, "antialias": False} | variant.settings
    settings = dr.RenderSettings(**options)

    def draw(
        parameters: tuple[jax.Array, ...], mesh: dr.Mesh, lights: Any, material: dr.Material
    ) -> jax.Array:
        eye, translation, color = parameters
        camera = dr.Camera.perspective(
            eye=eye, target=(variant.aside, 0, 0), up=(0, 1, 0), fov_y=0.7, near=0.1, far=100
        )
        lights = [dataclasses.replace(light, diffuse=color * light.diffuse) for light in lights]
        item = dr.Object(mesh, material, dr.linalg.translation(translation))
        return dr.render(dr.Scene(objects=[item], lights=lights), camera, settings)

    parameters = jnp.array([1.2, 1.0, 3.0]), jnp.zeros(3), jnp.ones(3)
    mesh = dr.shapes.uv_sphere(segments=72, rings=36)
    return draw, (parameters, mesh, tuple(variant.lights), dr.Material(**variant.material))


def check(name: str, variant: Variant, image: jax.Array) -> None:
    """Refuse a wrong picture."""
    covered = float((jnp.max(image, axis=-1) > 0).mean())
    if (covered == 0) != (variant.aside > 0) or not bool(jnp.isfinite(image).all()):
        raise AssertionError(f"{name}: the picture is wrong, not timed: {covered:.3f} is covered")


def run(
    out: Path,
    *,
    size: int = 512,
    repeats: int = 30,
    only: Sequence[str] | None = None,
    progress: bool = False,
) -> dict[str, Any]:
    """Time the variants; returns what is written: by variant, milliseconds and differences."""
    known = variants()
    wanted = set(known if only is None else only)
    wanted |= {known[name].base for name in wanted}
    chosen = {name: variant for name, variant in known.items() if name in wanted}
    jobs = {}
    for name, variant in chosen.items():
        draw, arguments = weighted_picture(variant, size)
        weights = jnp.asarray(np.random.default_rng(0).normal(size=(size, size, 3)), jnp.float32)

        def loss(parameters: Any, weights: jax.Array, *rest: Any, draw: Any = draw) -> jax.Array:
            return jnp.vdot(weights, draw(parameters, *rest))

        jobs[name, "forward"] = compiled(draw, *arguments)
        jobs[name, "both"] = compiled(
            jax.value_and_grad(loss), arguments[0], weights, *arguments[1:]
        )
        check(name, variant, jobs[name, "forward"]())
        jax.block_until_ready(jobs[name, "both"]())
        if progress:
            print("compiled:", name, flush=True)
    times = minimum_times(jobs, repeats)
    report: dict[str, Any] = {"size": size, "repeats": repeats, "features": {}}
    for name, variant in chosen.items():
        result: dict[str, Any] = {"base": variant.base}
        for kind in ("forward", "both"):
            result[f"{kind}_ms"] = times[name, kind]
            result[f"{kind}_added_ms"] = times[name, kind] - times[variant.base, kind]
            result[f"{kind}_share"] = times[name, kind] / times[variant.base, kind]
        report["features"][name] = result
    write_report(out, "benchmark_features", report, table, plot)
    return report


def table(report: dict[str, Any]) -> str:
    """Milliseconds of each variant, and what it adds to the one that it is compared with."""
    header = ["feature", "compared with", "forward ms", "added", "with derivative ms", "added"]
    return markdown(
        header,
        [
            [name, f["base"], *(f[f"{k}_{what}"] for k in ("forward", "both") for what in COLUMNS)]
            for name, f in report["features"].items()
        ],
    )


def plot(report: dict[str, Any], path: Path) -> None:
    """Bars of the times."""
    plt = pyplot()
    features = report["features"]
    figure, axis = plt.subplots(figsize=(8, 1 + 0.35 * len(features)), layout="constrained")
    place = np.arange(len(features))
    axis.barh(place + 0.2, [f["both_ms"] for f in features.values()], 0.4, label="with derivative")
    axis.barh(place - 0.2, [f["forward_ms"] for f in features.values()], 0.4, label="forward")
    axis.set_yticks(place, list(features))
    axis.invert_yaxis()
    axis.set_xlabel(f"ms, {report['size']}² pixels, minimum of {report['repeats']}")
    axis.grid(axis="x", alpha=0.3)
    axis.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = benchmark_options(__doc__, "benchmark_features", repeats=30)
    parser.add_argument("--size", type=int, default=512, help="rows and columns of the picture")
    parser.add_argument("--only", nargs="+", choices=variants(), metavar="FEATURE")
    options = vars(parser.parse_args())
    print(table(run(options.pop("out"), progress=not options.pop("quiet"), **options)))


if __name__ == "__main__":
    main()
