"""A turntable: pictures of a mesh from all round it, as a GIF, a sheet and a data set.

    python experiments/orbit.py
    python experiments/orbit.py --mesh bunny.obj --views 100 --size 400 --out results/bunny

The views lie on a circle round the up axis, or on a spiral if `--rise` is given. All of them are
drawn by one call, on all cores. The data set holds, for each view, the picture (`images/`, 8-bit
sRGB), what is covered (`masks/`), the unit normals of the world as colours (`normals/`) and the
distance along the viewing direction (`depth/`, 32-bit floats in .npy, 0 where there is nothing).
Cameras are written twice: as OpenCV has them (`cameras.json`: K, R and t of each view, x right,
y down, z forward) and as NeRF's tools read them (`transforms.json`: camera to world, x right, y up,
z backward). Work that was interrupted goes on where it stopped.

Expected: 36 views of the teapot at 256 x 256 in about 20 s, most of it compilation.
"""

import argparse
import json
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import check_same, load_mesh, progress_bar, save_json, save_whole
from jax import Array

import diffrast as dr

FIELD_OF_VIEW = 0.7
SUN = {"ambient": (0.15, 0.15, 0.15), "specular": (0.4, 0.4, 0.4)}
DIGITS = 9  # of what is written of cameras: those of float32
FOLDERS = {"image": "images", "mask": "masks", "normal": "normals", "depth": "depth"}


def orbit_cameras(
    mesh: dr.Mesh,
    views: int,
    elevation: float,
    rise: float = 0.0,
    distance: float = 1.05 / math.sin(FIELD_OF_VIEW / 2),
) -> dr.Camera:
    """Cameras round a mesh, z up, that look at its middle.

    Args:
        mesh: what is seen.
        views: how many.
        elevation: angle above the horizon of the first view, in radians.
        rise: by how much the last one is higher.
        distance: of the eye, in half diagonals of the box round the mesh; by default all is seen.
    """
    low, high = jnp.min(mesh.vertices, axis=0), jnp.max(mesh.vertices, axis=0)
    centre, radius = (low + high) / 2, jnp.linalg.norm(high - low) / 2
    away = distance * radius

    def camera(number: Array) -> dr.Camera:
        around = 2 * jnp.pi * (number / views)
        above = elevation + rise * number / max(views - 1, 1)
        way = [jnp.cos(around) * jnp.cos(above), jnp.sin(around) * jnp.cos(above), jnp.sin(above)]
        return dr.Camera.perspective(
            eye=centre + away * jnp.stack(way),
            target=centre,
            up=(0, 0, 1),
            fov_y=FIELD_OF_VIEW,
            near=away / 50,
            far=away * 2.5,
        )

    return jax.vmap(camera)(jnp.arange(views))


def draw(shared: tuple[dr.Scene, dr.RenderSettings], camera: dr.Camera) -> dict[str, Array]:
    """What is stored of one view."""
    scene, settings = shared
    seen = dr.render_buffers(scene, camera, settings)
    covered = seen.face >= 0
    depth = jnp.where(covered, 1 / jnp.where(covered, seen.inverse_depth, 1), 0)
    return {
        "image": dr.render(scene, camera, settings),
        "mask": covered,
        "normal": jnp.where(covered[..., None], (seen.normal + 1) / 2, 0),
        "depth": depth,
    }


def save_view(folder: Path, number: int, view: dict[str, np.ndarray]) -> None:
    """Write what is known of a view; the picture last, which tells that all is there."""
    np.save(folder / "depth" / f"{number:04}.npy", view["depth"].astype(np.float32))
    encoded = np.repeat(view["mask"][..., None].astype(np.float32), 3, axis=-1)
    dr.save_image(folder / "masks" / f"{number:04}.png", encoded, srgb=False)
    dr.save_image(folder / "normals" / f"{number:04}.png", view["normal"], srgb=False)
    save_whole(
        folder / "images" / f"{number:04}.png",
        lambda unfinished: dr.save_image(unfinished, view["image"]),
    )


def save_cameras(folder: Path, cameras: dr.Camera, views: int, size: int) -> None:
    """Write the cameras as OpenCV and as NeRF's tools have them."""
    opencv, frames = [], []
    for number in range(views):
        camera = jax.tree.map(lambda x, number=number: x[number], cameras)
        known = dr.camera.to_opencv(camera, height=size, width=size)
        name = f"images/{number:04}.png"
        opencv.append(
            {
                "image": name,
                "K": known.intrinsics.tolist(),
                "R": known.rotation.tolist(),
                "t": known.translation.tolist(),
            }
        )
        to_world = np.linalg.inv(np.asarray(camera.view, np.float64))
        frames.append({"file_path": name, "transform_matrix": to_world.tolist()})
    save_json(folder / "cameras.json", {"width": size, "height": size, "views": opencv}, DIGITS)
    lens = {"camera_angle_x": FIELD_OF_VIEW, "w": size, "h": size}
    save_json(folder / "transforms.json", {**lens, "frames": frames}, DIGITS)


def contact_sheet(folder: Path, views: int, columns: int = 6) -> np.ndarray:
    """Pictures above depth and normals of up to `columns` views, side by side."""
    shown = np.linspace(0, views, min(columns, views), endpoint=False).astype(int)
    rows = []
    for kind in ("images", "normals"):
        read = [dr.load_image(folder / kind / f"{n:04}.png", srgb=False) for n in shown]
        rows.append(np.concatenate([np.asarray(image)[..., :3] for image in read], axis=1))
    depths = np.stack([np.load(folder / "depth" / f"{n:04}.npy") for n in shown])
    covered = depths > 0
    near, far = (depths[covered].min(), depths[covered].max()) if covered.any() else (0.0, 1.0)
    grey = np.where(covered, 1 - 0.9 * (depths - near) / max(far - near, 1e-12), 0)
    rows.insert(1, np.repeat(np.concatenate(list(grey), axis=1)[..., None], 3, axis=-1))
    return np.concatenate(rows)


def run(
    mesh: dr.Mesh,
    out: Path,
    *,
    views: int = 36,
    size: int = 256,
    elevation: float = 0.4,
    rise: float = 0.0,
    antialias: bool = True,
    told: Callable[[int, float], Any] = lambda done, per_second: None,
) -> dict[str, float]:
    """Draw and write what is not there yet; tell after each chunk how many, and how many a second.

    Raises:
        ValueError: if `out` holds views of other settings.
    """
    for name in FOLDERS.values():
        (out / name).mkdir(parents=True, exist_ok=True)
    asked = {"views": views, "size": size, "elevation": elevation, "rise": rise}
    asked |= {"vertices": mesh.vertices.shape[0], "faces": mesh.faces.shape[0]}
    settings_file = out / "orbit.json"
    if settings_file.exists():
        before = json.loads(settings_file.read_text())["asked"]
        check_same(settings_file, "a turntable", asked, before)
    save_json(settings_file, {"asked": asked})

    cameras = orbit_cameras(mesh, views, elevation, rise)
    save_cameras(out, cameras, views, size)
    left = [n for n in range(views) if not (out / "images" / f"{n:04}.png").exists()]
    object_ = dr.Object(mesh, dr.Material(diffuse=(0.75, 0.6, 0.45), specular=(0.4, 0.4, 0.4)))
    light = dr.DirectionalLight(direction=(-0.5, 0.4, -1.0), **SUN)
    scene = dr.Scene(objects=[object_], lights=[light], background=(1.0, 1.0, 1.0))
    settings = dr.RenderSettings(height=size, width=size, antialias=antialias)
    start, done = time.perf_counter(), 0
    some = jax.tree.map(lambda x: np.asarray(x)[left], cameras)
    for which, results in dr.views.stream_views(draw, some, (scene, settings)):
        for row, place in enumerate(which):
            save_view(out, left[place], {name: x[row] for name, x in results.items()})
        done += len(which)
        told(done, done / (time.perf_counter() - start))
    seconds = time.perf_counter() - start
    pictures = (dr.load_image(out / "images" / f"{n:04}.png") for n in range(views))
    dr.save_animation(out / "orbit.gif", (image[..., :3] for image in pictures))
    dr.save_image(out / "sheet.png", contact_sheet(out, views), srgb=False)
    return {"drawn": done, "seconds": seconds}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mesh", default="teapot.bez", help="mesh file; z is up")
    parser.add_argument("--views", type=int, default=36)
    parser.add_argument("--size", type=int, default=256, help="pixels along both sides")
    parser.add_argument("--elevation", type=float, default=23.0, help="degrees above the horizon")
    parser.add_argument("--rise", type=float, default=0.0, help="degrees more at the last view")
    parser.add_argument("--out", type=Path, default=Path("results/orbit"), help="folder to write")
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    options = parser.parse_args()
    bar = None
    if not options.quiet:
        bar = progress_bar(total=options.views, unit="view")

    def told(bar: Any, done: int, per_second: float) -> None:
        bar.update(done - bar.n)
        bar.set_postfix_str(f"{per_second:.1f} views/s with compilation")

    result = run(
        load_mesh(options.mesh),
        options.out,
        views=options.views,
        size=options.size,
        elevation=np.radians(options.elevation),
        rise=np.radians(options.rise),
        **({} if bar is None else {"told": partial(told, bar)}),
    )
    if bar is not None:
        bar.close()
    print(f"{result['drawn']} views drawn in {result['seconds']:.1f} s, written to {options.out}")


if __name__ == "__main__":
    main()
