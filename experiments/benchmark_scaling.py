"""How does the time grow with faces, pixels, objects, lights, views and parameters?

    python experiments/benchmark_scaling.py [--quick] [--repeats 10]

One of them grows while the others stay: a height field of 100 to a million faces, pictures of 64²
to 4096² pixels, 10,000 faces in 1 to 256 objects side by side, 1 to 16 directional lights, 1 to 64
views in one call, and the derivative by 10 to 5,000 of the vertices' coordinates. "picture" is
without edges, "edges" with them, "derivative" that of a weighted sum of the jagged picture by every
object's translation, or by the parameters that grow. Each exponent is the slope of the straight
line through the times, both axes logarithmic.

Expected: below one for faces (pixels cost, too), objects and lights, about one for pixels and
views, and zero for parameters: the derivative's price does not depend on their number.

Written to `--out`: `benchmark_scaling.json`, `.md` and `.png`. Fifteen minutes on two cores, most
of it compilation.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import pyplot
from timing import benchmark_options, compiled, exponent, markdown, minimum_times, write_report

import diffrast as dr

COUNTS = {
    "faces": (1e2, 1e3, 1e4, 1e5, 1e6),
    "pixels": (64**2, 256**2, 1024**2, 4096**2),
    "objects": (1, 16, 256),
    "lights": (1, 4, 16),
    "views": (1, 8, 64),
    "parameters": (10, 200, 5000),
}
QUICK = {
    "faces": (1e2, 1e3),
    "pixels": (32**2, 64**2),
    "objects": (1, 4),
    "lights": (1, 2),
    "views": (1, 2),
    "parameters": (10, 100),
}
Jobs = dict[str, Callable[[], Any]]


def height_field(faces: float) -> dr.Mesh:
    """A smooth one of about as many faces."""
    side = max(round((faces / 2) ** 0.5), 1) + 1
    x, z = np.meshgrid(*[np.linspace(-1, 1, side)] * 2)
    return dr.shapes.height_field(0.15 * np.sin(5 * x) * np.cos(4 * z))


def camera(turn: float = 0.0) -> dr.Camera:
    """Sees the field from the front, or from round it."""
    eye = (2.2 * np.sin(turn), -2.2 * np.cos(turn), 1.4)
    return dr.Camera.perspective(
        eye=eye, target=(0, 0, 0), up=(0, 0, 1), fov_y=0.7, near=0.1, far=100
    )


def lights(count: int = 1) -> list[dr.DirectionalLight]:
    """Directional ones from all round."""
    angles = np.arange(count) * 2.4
    color = np.full(3, 1 / count)
    return [
        dr.DirectionalLight(direction=(np.cos(a), np.sin(a), -1.5), diffuse=color) for a in angles
    ]


def settings(size: int, *, antialias: bool = False) -> dr.RenderSettings:
    return dr.RenderSettings(height=size, width=size, antialias=antialias)


def weights(size: int) -> jax.Array:
    """Of the picture's values in the sum that is differentiated."""
    return jnp.asarray(np.random.default_rng(0).normal(size=(size, size, 3)), jnp.float32)


def drawing(mesh: dr.Mesh, size: int, count: int = 1, *, side: int = 1, edges: bool = True) -> Jobs:
    """A picture without edges, with them, and the derivative by the translations of the objects.

    These are so many a side, where else there is one.
    """
    middles = (np.arange(side) * 2 + 1) / side - 1
    places = jnp.asarray([(x, y, 0) for y in middles for x in middles], jnp.float32)
    smaller = dr.linalg.scaling(np.full(3, 1 / side))

    def picture(places: jax.Array, mesh: dr.Mesh, lights: Any, antialias: bool) -> jax.Array:
        objects = [
            dr.Object(mesh, None, dr.linalg.compose(dr.linalg.translation(place), smaller))
            for place in places
        ]
        scene = dr.Scene(objects=objects, lights=lights)
        return dr.render(scene, camera(), settings(size, antialias=antialias))

    def weighted(places: jax.Array, weights: jax.Array, mesh: dr.Mesh, lights: Any) -> jax.Array:
        return jnp.vdot(weights, picture(places, mesh, lights, False))

    arguments = places, mesh, lights(count)
    jobs = {
        "picture": compiled(lambda *a: picture(*a, False), *arguments),
        "derivative": compiled(jax.grad(weighted), arguments[0], weights(size), *arguments[1:]),
    }
    if edges:
        jobs["edges"] = compiled(lambda *a: picture(*a, True), *arguments)
    return jobs


def viewing(mesh: dr.Mesh, size: int, count: int) -> Jobs:
    """Many views in one call."""
    scene = dr.Scene(objects=[dr.Object(mesh)], lights=lights())
    cameras = dr.stack_cameras([camera(turn) for turn in np.linspace(0, 1, count)])
    return {"picture": lambda: dr.render_views(scene, cameras, settings(size))}


def differentiating(mesh: dr.Mesh, size: int, count: int) -> Jobs:
    """The derivative by the first coordinates of the vertices."""

    def weighted(parameters: jax.Array, weights: jax.Array, mesh: dr.Mesh) -> jax.Array:
        moved = jnp.ravel(mesh.vertices).at[:count].add(parameters).reshape(-1, 3)
        own = dr.Mesh(
            vertices=moved, faces=mesh.faces, normals=mesh.normals, topology=mesh.topology
        )
        scene = dr.Scene(objects=[dr.Object(own)], lights=lights())
        return jnp.vdot(weights, dr.render(scene, camera(), settings(size)))

    return {"derivative": compiled(jax.grad(weighted), jnp.zeros(count), weights(size), mesh)}


def series(counts: dict[str, Sequence[float]], size: int) -> Iterator[tuple[str, float, Jobs]]:
    """What grows, how many there are, and what is timed."""
    mesh = height_field(10_000)
    for count in counts.get("faces", ()):
        field = height_field(count)
        yield "faces", field.faces.shape[0], drawing(field, size)
    for count in counts.get("pixels", ()):
        yield "pixels", count, drawing(mesh, round(count**0.5), edges=count <= 1024**2)
    for count in counts.get("objects", ()):
        side = round(count**0.5)
        yield "objects", count, drawing(height_field(10_000 / count), size, side=side)
    for count in counts.get("lights", ()):
        yield "lights", count, drawing(mesh, size, int(count), edges=False)
    for count in counts.get("views", ()):
        yield "views", count, viewing(mesh, size // 2, int(count))
    for count in counts.get("parameters", ()):
        yield "parameters", count, differentiating(mesh, size, int(count))


def run(
    out: Path,
    *,
    size: int = 512,
    repeats: int = 10,
    counts: dict[str, Sequence[float]] | None = None,
    progress: bool = False,
) -> dict[str, Any]:
    """Time everything; returns what is written: times by what grows, and exponents."""
    found: dict[str, dict[str, tuple[list[float], list[float]]]] = {}
    for what, count, jobs in series(counts or COUNTS, size):
        times = minimum_times(jobs, repeats)
        for name, milliseconds in times.items():
            line = found.setdefault(what, {}).setdefault(name, ([], []))
            line[0].append(count)
            line[1].append(milliseconds)
        if progress:
            print(what, f"{count:g}:", {n: f"{t:.3g} ms" for n, t in times.items()}, flush=True)
    report = {
        "size": size,
        "repeats": repeats,
        "growth": {
            what: {
                name: {"counts": line[0], "ms": line[1], "exponent": exponent(*line)}
                for name, line in lines.items()
            }
            for what, lines in found.items()
        },
    }
    write_report(out, "benchmark_scaling", report, table, plot)
    return report


def table(report: dict[str, Any]) -> str:
    """First and last of each line, and its exponent."""
    rows = []
    for what, lines in report["growth"].items():
        for name, line in lines.items():
            (first, *_, last), times = line["counts"], line["ms"]
            rows.append(
                [what, name, f"{first:g} to {last:g}", times[0], times[-1], line["exponent"]]
            )
    return markdown(["what grows", "time of", "from, to", "ms", "to ms", "exponent"], rows)


def plot(report: dict[str, Any], path: Path) -> None:
    """Times over counts, and slope one for comparison."""
    plt = pyplot()
    growth = report["growth"]
    figure, axes = plt.subplots(
        1,
        len(growth),
        figsize=(3.4 * len(growth), 3.6),
        sharey=True,
        squeeze=False,
        layout="constrained",
    )
    for axis, (what, lines) in zip(axes[0], growth.items(), strict=True):
        for name, line in lines.items():
            label = f"{name}, exponent {line['exponent']:.2f}"
            axis.loglog(line["counts"], line["ms"], "o-", label=label)
        counts = np.array(line["counts"])
        axis.loglog(counts, line["ms"][-1] * counts / counts[-1], "k:", lw=1, label="slope 1")
        axis.set_title(what)
        axis.legend(fontsize=7)
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("ms")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = benchmark_options(__doc__, "benchmark_scaling", repeats=10)
    parser.add_argument("--size", type=int, default=512, help="rows and columns of the pictures")
    parser.add_argument("--quick", action="store_true", help="few and small")
    options = vars(parser.parse_args())
    if options.pop("quick"):
        options |= {"counts": QUICK, "size": 64}
    print(table(run(options.pop("out"), progress=not options.pop("quiet"), **options)))


if __name__ == "__main__":
    main()
