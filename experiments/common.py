"""What the experiments share: problems from files; results as pictures, plots and JSON."""

import argparse
import dataclasses
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import diffrast as dr

# For products of the experiments' own on a GPU or TPU; the library asks for it where it multiplies.
jax.config.update("jax_default_matmul_precision", "highest")

DEFAULT_TARGET = Path(__file__).parent / "data" / "teapot_one_light.json"
# Dull grey: where the fit of a material starts of which nothing is known.
UNKNOWN_MATERIAL: dict[str, Any] = {
    "diffuse": (0.5, 0.5, 0.5),
    "specular": (0.3, 0.3, 0.3),
    "shininess": 12.0,
}
LIGHTS = {"directional": dr.DirectionalLight, "point": dr.PointLight}


@dataclasses.dataclass(frozen=True)
class View:
    """All that a picture of one mesh depends on.

    Attributes:
        camera: eye, target, up, fov_y, near, far, as `diffrast.Camera.perspective` takes them.
        lights: directional and point lights.
        material: of the mesh.
        background: (3,) linear RGB.
    """

    camera: dict[str, Any]
    lights: tuple[dr.DirectionalLight | dr.PointLight, ...]
    material: dr.Material
    background: Array


@dataclasses.dataclass(frozen=True)
class Problem:
    """A picture to be explained.

    Attributes:
        name: for the files of the result.
        mesh: what is seen, with vertex normals.
        target: (height, width, 3) linear RGB.
        start: where the fit starts.
        truth: what it should find, where that is known.
    """

    name: str
    mesh: dr.Mesh
    target: Array
    start: View
    truth: View | None

    def shrunk(self, factor: int) -> "Problem":
        """Return the same problem with a picture `factor` times smaller."""
        return dataclasses.replace(self, target=dr.fit.downsample(self.target, factor))


def render_view(
    mesh: dr.Mesh, view: View, height: int, width: int, samples: int = 4, antialias: bool = True
) -> Array:
    """Render what a target picture holds: values clamped to 0 to 1, back faces culled."""
    scene = dr.Scene(
        objects=[dr.Object(mesh, view.material)], lights=view.lights, background=view.background
    )
    camera = dr.Camera.perspective(**view.camera, aspect=width / height)
    settings = dr.RenderSettings(
        height=height, width=width, cull_backfaces=True, samples=samples, antialias=antialias
    )
    return jnp.clip(dr.render(scene, camera, settings), 0, 1)


def exact_settings(size: int) -> dr.RenderSettings:
    """How pictures to be explained are made: by samples, not by the treatment of edges on trial."""
    return dr.RenderSettings(height=size, width=size, samples=256, antialias=False)


def mean_difference(first: Array, second: Array) -> float:
    """Mean absolute difference of linear pictures in sRGB steps of 1/255."""
    encoded = [dr.color.linear_to_srgb(jnp.clip(image, 0, 1)) for image in (first, second)]
    return float(255 * jnp.mean(jnp.abs(encoded[0] - encoded[1])))


# Reading ------------------------------------------------------------------------------------------


def load_problem(path: str | Path) -> Problem:
    """Read a problem: a JSON file with "mesh", "image", "start" and, where known, "truth".

    Raises:
        ValueError: for missing entries and lights of an unknown type.
        FileNotFoundError: if there is no such file, mesh or picture.
    """
    path = Path(path)
    description = json.loads(path.read_text())
    missing = {"mesh", "image", "start"} - set(description)
    if missing:
        raise ValueError(f"{path}: wanted an object with {sorted(missing)}")
    truth = description.get("truth")
    return Problem(
        name=path.stem,
        mesh=load_mesh(description["mesh"], path.parent),
        target=dr.load_image(path.parent / description["image"])[..., :3],
        start=_view(description["start"], path),
        truth=None if truth is None else _view(truth, path),
    )


def load_mesh(name: str, folder: Path = Path()) -> dr.Mesh:
    """Read a mesh, given relative to `folder` or a folder above it; "teapot.bez" is built in."""
    if Path(name).name == "teapot.bez":
        return dr.shapes.teapot(16)
    places = [place / name for place in (folder, *folder.resolve().parents)]
    for place in places:
        if place.is_file():
            mesh = dr.load_mesh(place)
            return mesh if mesh.normals is not None else dr.mesh.with_normals(mesh)
    raise FileNotFoundError(f"mesh {name!r}: not found in {folder.resolve()} or a folder above it")


def _view(description: dict[str, Any], path: Path) -> View:
    lights = []
    for light in description["lights"]:
        kind = light.get("type")
        if kind not in LIGHTS:
            raise ValueError(f"{path}: wanted a light of type {sorted(LIGHTS)}, got {kind!r}")
        lights.append(LIGHTS[kind](**{key: light[key] for key in light if key != "type"}))
    return View(
        camera=description["camera"],
        lights=tuple(lights),
        material=dr.Material(**description["material"]),
        background=jnp.asarray(description["background"], jnp.float32),
    )


def problem_from_picture(
    mesh: str,
    image: str,
    *,
    eye: list[float],
    target: list[float],
    up: list[float],
    fov_y: float,
    light_direction: list[float] | None = None,
) -> Problem:
    """Make a problem of a mesh file and a picture, with a rough guess of the camera.

    The light starts from behind the viewer unless `light_direction` tells the way it travels; the
    background is the median colour along the picture's border.
    """
    shape = load_mesh(mesh)
    picture = dr.load_image(image)[..., :3]
    border = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
    distances = np.linalg.norm(np.asarray(shape.vertices) - np.asarray(eye), axis=1)
    camera = {"eye": eye, "target": target, "up": up, "fov_y": fov_y}
    camera |= {"near": distances.min() / 10, "far": distances.max() * 10}
    direction = light_direction or list(np.subtract(target, eye))
    light = dr.DirectionalLight(direction=direction, ambient=[0.15] * 3, diffuse=[0.7] * 3)
    material = dr.Material(**UNKNOWN_MATERIAL)
    background = jnp.asarray(np.median(border, axis=0))
    start = View(camera, (light,), material, background)
    return Problem(Path(image).stem, shape, picture, start, truth=None)


# Command line -------------------------------------------------------------------------------------


def fitting_options(description: str | None, out: str) -> argparse.ArgumentParser:
    """Options of the experiments that fit one picture; read them with `problem_from_options`."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "target", nargs="?", default=DEFAULT_TARGET, help="JSON of mesh, picture, start and truth"
    )
    parser.add_argument("--out", type=Path, default=Path("results") / out, help="folder to write")
    parser.add_argument("--shrink", type=int, default=1, help="make the picture smaller, 2, 4, ...")
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    own = parser.add_argument_group("instead of a JSON file")
    own.add_argument("--mesh", help="mesh file, or teapot.bez")
    own.add_argument("--image", help="picture of it")
    for name in ("eye", "look-at", "up", "light-direction"):
        own.add_argument(f"--{name}", type=float, nargs=3, metavar=("X", "Y", "Z"))
    own.add_argument("--fov", type=float, default=40.0, help="vertical angle of view in degrees")
    return parser


def problem_from_options(options: argparse.Namespace) -> Problem:
    """Read the problem that the options of `fitting_options` name."""
    if options.image is None and options.mesh is None:
        return load_problem(options.target).shrunk(options.shrink)
    if None in (options.image, options.mesh, options.eye):
        raise SystemExit("a picture of one's own needs --mesh, --image and --eye")
    return problem_from_picture(
        options.mesh,
        options.image,
        eye=options.eye,
        target=options.look_at or [0.0, 0.0, 0.0],
        up=options.up or [0.0, 1.0, 0.0],
        fov_y=float(np.radians(options.fov)),
        light_direction=options.light_direction,
    ).shrunk(options.shrink)


# Writing ------------------------------------------------------------------------------------------


def pyplot() -> ModuleType:
    """Import matplotlib for drawing into files."""
    try:
        import matplotlib
    except ImportError as error:
        raise ImportError("plots need matplotlib: install diffrast[plot]") from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def progress_bar(items: Iterable[Any] | None = None, **options: Any) -> Any:
    """A bar of tqdm's for what scripts show unless they are told `--quiet`."""
    try:
        from tqdm.auto import tqdm
    except ImportError as error:
        message = "progress needs tqdm: install diffrast[progress], or pass --quiet"
        raise SystemExit(message) from error
    return tqdm(items, **options)


def save_comparison(
    path: Path, target: Array, start: Array, result: Array, gain: float = 16.0
) -> None:
    """Write target, start, result and the amplified sRGB difference round grey, side by side."""
    encoded = [np.asarray(dr.color.linear_to_srgb(image)) for image in (target, start, result)]
    difference = np.clip(0.5 + gain * (encoded[2] - encoded[0]), 0, 1)
    dr.save_image(path, np.concatenate([*encoded, difference], axis=1), srgb=False)


def random_start_options(
    description: str | None, out: str, *, starts: int, size: int
) -> argparse.ArgumentParser:
    """Options of fits from random starts."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("results") / out)
    parser.add_argument("--starts", type=int, default=starts)
    parser.add_argument("--size", type=int, default=size, help="rows and columns of the pictures")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    return parser


def show_fit(axes: Sequence[Any], target: Array, start: Array, result: Array) -> None:
    """Draw the pictures of a fit side by side, with 16 times their difference round grey."""
    encoded = [np.clip(dr.color.linear_to_srgb(image), 0, 1) for image in (target, start, result)]
    difference = np.clip(0.5 + 16 * (encoded[2] - encoded[0]), 0, 1)
    titles = ("target", "start", "result", "16 times the difference")
    for axis, image, title in zip(axes, (*encoded, difference), titles, strict=True):
        axis.imshow(image)
        axis.set_title(title)
        axis.axis("off")


def statistics(outcomes: list[dict[str, Any]], criterion: dict[str, float]) -> dict[str, Any]:
    """Share of fits that converged, which did not, and medians over all of them."""

    def median(key: str) -> float:
        return float(np.median([outcome[key] for outcome in outcomes]))

    return {
        "share_converged": float(np.mean([outcome["converged"] for outcome in outcomes])),
        "failed": [i for i, outcome in enumerate(outcomes) if not outcome["converged"]],
        **{f"median_{key}": median(key) for key in (*criterion, "renders", "seconds")},
    }


def save_json(path: Path, content: Any, digits: int = 6) -> None:
    """Write a result, all or nothing; arrays become lists, floats keep six digits or others."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(_plain(content, digits), indent=1) + "\n"
    save_whole(path, lambda unfinished: unfinished.write_text(text))


def save_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """Write a file under another name in its folder, which becomes its own when it is whole."""
    unfinished = path.with_name(f"unfinished-{path.name}")
    write(unfinished)
    unfinished.replace(path)


def check_same(path: Path, kind: str, wanted: Any, got: Any) -> None:
    """See that what an interrupted run left in a file is of the kind asked for.

    Numbers that `save_json` wrote count as those that they were rounded from.

    Raises:
        ValueError: if it is not.
    """
    if got not in (wanted, _plain(wanted)):
        raise ValueError(f"{path}: wanted {kind} of {_plain(wanted)}, got one of {got}")


def _plain(value: Any, digits: int = 6) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value)]
        return {name: _plain(getattr(value, name), digits) for name in names}
    if isinstance(value, dict):
        return {key: _plain(item, digits) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item, digits) for item in value]
    if isinstance(value, (float, np.ndarray, np.generic, Array)):
        array = np.asarray(value)
        if array.dtype.kind == "f":
            return _plain([*array], digits) if array.ndim else float(f"{array:.{digits}g}")
        return array.tolist()
    return value
