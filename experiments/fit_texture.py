"""Is the texture of an object found from pictures of it?

    python experiments/fit_texture.py

All texels of a ball's texture (64 rows, 128 columns), wrapped round it by longitude, are fitted to
twelve shaded views with 16 samples a pixel each; shape, cameras and lights are known. The texture
starts as plain grey. The loss is the mean squared difference of the pictures, with a weak pull of
each texel towards its neighbours, which decides where no picture looks.

The error is that of the texels, true colours against found ones: a texel counts by its area on the
ball, and as seen if some picture depends on it, which the derivative of the sum of all pictures
tells.

Expected: the mean absolute error falls from 0.24 to 0.004 where the texture is seen, in a minute or
two on two cores; at the poles, where a row of texels is smaller than a pixel, only averages of
texels can be known, but they count for little.

Written to `--out`: `fit_texture.json` with loss and errors, and `fit_texture.png` with the texture
(true, start, found, 4 times their difference), some of the views, and the errors by step.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from common import pyplot, save_json
from fit_shape import LIGHTS, cameras_around
from jax import Array

import diffrast as dr

BALL = dr.shapes.icosphere(4)
MAPPING = dr.SphereMapping(kind="longitude")
MATERIAL = dr.Material(diffuse=(1.0, 1.0, 1.0), texture=dr.Texture([[[0.5] * 3]], mapping=MAPPING))
LAMP = dr.AmbientLight((0.35, 0.35, 0.35))
VIEWS_SHOWN = 4


def true_texture(rows: int) -> Array:
    """Return the image to be found: spots, bands and a few sharp corners, 0.1 to 0.9."""
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(2 * rows) + 0.5) / (2 * rows))
    u, v = u.T, v.T
    bands = 0.5 + 0.4 * np.sin(2 * np.pi * (3 * u + np.sin(2 * np.pi * v)))
    spots = 0.5 + 0.4 * np.sin(10 * np.pi * u) * np.sin(6 * np.pi * v)
    squares = np.where((np.floor(16 * u) + np.floor(8 * v)) % 2 > 0, 0.8, 0.2)
    return jnp.asarray(np.stack([bands, spots, squares], axis=-1), jnp.float32)


@jax.jit
def pictures(image: Array, cameras: dr.Camera, settings: dr.RenderSettings) -> Array:
    """Render all views of the ball with this texture, one after another."""
    texture = dr.Texture(image, mapping=MAPPING, filter="trilinear")
    material = dataclasses.replace(MATERIAL, texture=texture)
    scene = dr.Scene(objects=[dr.Object(BALL, material)], lights=[*LIGHTS, LAMP])
    return jax.lax.map(lambda camera: dr.render(scene, camera, settings), cameras)


def roughness(image: Array) -> Array:
    """Mean squared difference of neighbouring texels, round the ball and along it."""
    across, along = image - jnp.roll(image, 1, axis=1), image[1:] - image[:-1]
    return jnp.mean(across**2) + jnp.mean(along**2)


def image_loss(
    image: Array,
    cameras: dr.Camera,
    targets: Array,
    smoothness: Array,
    settings: dr.RenderSettings,
) -> Array:
    """Mean squared difference of the pictures, and the pull towards neighbours."""
    difference = pictures(image, cameras, settings) - targets
    return jnp.mean(difference**2) + smoothness * roughness(image)


def seen_texels(image: Array, cameras: dr.Camera, settings: dr.RenderSettings) -> np.ndarray:
    """Whether pictures depend on each texel, (rows, columns)."""
    weight = jax.grad(lambda x: jnp.sum(pictures(x, cameras, settings)))(image)
    return np.asarray(jnp.sum(weight, axis=-1) > 0.1 * jnp.median(jnp.sum(weight, axis=-1)))


def errors_of(image: Array, truth: Array, seen: np.ndarray) -> dict[str, float]:
    """Mean absolute error over the ball's area that is seen, over all of it, and the largest."""
    rows = truth.shape[0]
    area = np.cos(np.pi * ((np.arange(rows) + 0.5) / rows - 0.5))[:, None] * np.ones(seen.shape)
    error = np.mean(np.abs(np.asarray(image) - np.asarray(truth)), axis=-1)
    return {
        "mean_seen": float(np.sum(area * error * seen) / np.sum(area * seen)),
        "mean_all": float(np.sum(area * error) / np.sum(area)),
        "largest_seen": float(np.max(error * seen)),
    }


def run(
    out: Path,
    *,
    size: int = 128,
    views: int = 12,
    rows: int = 64,
    steps: int = 200,
    rate: float = 0.05,
    smoothness: float = 1e-4,
    antialias: bool = False,
    progress: bool = False,
) -> dict[str, Any]:
    """Fit the texture; see the module's docstring for the result."""
    cameras, truth = cameras_around(views), true_texture(rows)
    exact = dr.RenderSettings(height=size, width=size, samples=16, antialias=False)
    settings = dr.RenderSettings(height=size, width=size, antialias=antialias)
    targets = pictures(truth, cameras, exact)
    start = jnp.full_like(truth, 0.5)
    seen = seen_texels(start, cameras, settings)
    result = dr.fit.minimize(
        image_loss,
        start,
        args=(cameras, targets, jnp.float32(smoothness), settings),
        optimizer=optax.adam(optax.cosine_decay_schedule(rate, steps)),
        steps=steps,
        record_params=True,
        progress=progress,
    )
    trace = [errors_of(image, truth, seen) for image in result.history.params]
    report = {
        "size": size,
        "views": views,
        "texels": [rows, 2 * rows],
        "share_seen": float(seen.mean()),
        "at_start": trace[0],
        "found": errors_of(result.params, truth, seen),
        "loss_at_start": result.history.loss[0],
        "loss": result.loss,
        "seconds": result.seconds,
        "trace": {name: [errors[name] for errors in trace] for name in trace[0]},
    }
    save_json(out / "fit_texture.json", report)
    images = {"true": truth, "start": start, "found": result.params}
    shown = [targets, pictures(result.params, cameras, settings)]
    plot(out / "fit_texture.png", images, shown, report["trace"])
    return report


def plot(
    path: Path, images: dict[str, Array], shown: list[Array], trace: dict[str, list[float]]
) -> None:
    """Draw the textures, the first views of the target and the result, and the errors by step."""
    plt = pyplot()
    figure = plt.figure(figsize=(12, 7), layout="constrained")
    axes = figure.subplot_mosaic("abcd;eeef;eeef")
    difference = 0.5 + 4 * (images["found"] - images["true"])
    encoded = {name: dr.color.linear_to_srgb(image) for name, image in images.items()}
    sheets = {**encoded, "4 times the difference": difference}
    for axis, (name, image) in zip("abcd", sheets.items(), strict=True):
        axes[axis].imshow(np.clip(image, 0, 1))
        axes[axis].set_title(name)
        axes[axis].axis("off")
    sheet = np.concatenate([np.concatenate([*row[:VIEWS_SHOWN]], axis=1) for row in shown])
    axes["e"].imshow(np.clip(dr.color.linear_to_srgb(sheet), 0, 1))
    axes["e"].set_title("views: target above, result below")
    axes["e"].axis("off")
    for name, values in trace.items():
        axes["f"].semilogy(values, label=name.replace("_", ", "))
    axes["f"].set_xlabel("step")
    axes["f"].set_ylabel("error of the texels")
    axes["f"].legend(fontsize="small")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("results/fit_texture"))
    parser.add_argument("--size", type=int, default=128, help="rows and columns of the pictures")
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--rows", type=int, default=64, help="of the texture")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--rate", type=float, default=0.05, help="step size of Adam at the start")
    parser.add_argument("--smoothness", type=float, default=1e-4, help="pull towards neighbours")
    parser.add_argument("--antialias", action="store_true", help="fit with edges, too")
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    options = vars(parser.parse_args())
    report = run(options.pop("out"), progress=not options.pop("quiet"), **options)
    start, found = report["at_start"], report["found"]
    print(
        f"texels: mean error {found['mean_seen']:.4f} where seen (start {start['mean_seen']:.4f}),"
        f" {found['mean_all']:.4f} over all (start {start['mean_all']:.4f}), at most"
        f" {found['largest_seen']:.3f}; {report['seconds']:.0f} s"
    )


if __name__ == "__main__":
    main()
