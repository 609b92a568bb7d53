"""What the command line does; `diffrast.__main__` says it in words."""

import argparse
import json
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from diffrast import fit, linalg, shapes, viewing
from diffrast._tokens import read_text, without_comments
from diffrast.camera import Camera, stack_cameras
from diffrast.color import linear_to_srgb
from diffrast.files import (
    load_bezier,
    load_image,
    load_mesh,
    load_polygons,
    save_animation,
    save_image,
)
from diffrast.light import DirectionalLight
from diffrast.lines import draw_lines, fit_points, mesh_edges, wireframe
from diffrast.material import Material
from diffrast.mesh import Mesh, with_normals
from diffrast.render import render
from diffrast.scene import Object, Scene
from diffrast.scene_files import render_scene_file
from diffrast.settings import RenderSettings
from diffrast.views import image_of, stream_views

T = TypeVar("T")

SHAPES: dict[str, Callable[[], Mesh]] = {
    "teapot": shapes.teapot,
    "cube": shapes.cube,
    "tetrahedron": shapes.tetrahedron,
    "octahedron": shapes.octahedron,
    "icosahedron": shapes.icosahedron,
    "dodecahedron": shapes.dodecahedron,
    "buckyball": shapes.buckyball,
    "sphere": lambda: shapes.icosphere(3),
    "torus": shapes.torus,
    "sponge": lambda: shapes.menger_sponge(2),
}
_FIT_STEPS = 60
# What else than the look of a mesh the options of `render` and `wireframe` tell.
_FOR_SCENES = {"command", "run", "default_of", "file", "out", "operation", "no_antialias"}


class Framing(NamedTuple):
    """Where a mesh is seen from; no point of it is farther than `radius` from `centre`."""

    eye: np.ndarray | Array
    target: np.ndarray | Array
    up: np.ndarray
    centre: np.ndarray
    radius: float


def render_command(options: argparse.Namespace) -> str:
    """Draw a mesh, or a scene file."""
    _check_folder(options.out)
    if is_scene_file(options.file):
        _refuse_for_scenes(options)
        image = render_scene_file(
            options.file, operation=options.operation, antialias=not options.no_antialias
        )
        return _written(options.out, image)
    if options.operation is not None:
        raise ValueError(f"{options.file}: --operation is for scene files, which this is none of")
    mesh = load(options.file)
    camera = _camera(_framing(options, mesh), math.radians(options.fov))
    return _written(options.out, render(_scene(options, mesh), camera, _settings(options)))


def orbit_command(options: argparse.Namespace) -> str:
    """Turn once round a mesh."""
    _check_folder(options.out)
    if options.out.suffix.lower() != ".gif":
        raise ValueError(f"--out: wanted a name that ends in .gif, got {options.out}")
    mesh = load(options.file)
    framing = _framing(options, mesh)
    scene, settings = _scene(options, mesh), _settings(options)
    up = framing.up / np.linalg.norm(framing.up)
    cameras = []
    for k in range(options.frames):
        turn = np.asarray(linalg.rotation(up, 2 * np.pi * k / options.frames))[:3, :3]
        eye = framing.target + turn @ (framing.eye - framing.target)
        cameras.append(_camera(framing._replace(eye=eye), math.radians(options.fov)))
    stream = stream_views(image_of, stack_cameras(cameras), (scene, settings))
    images = (image for _, some in stream for image in some)
    frames = list(_with_progress(images, options, options.frames))
    save_animation(options.out, frames, frames_per_second=options.fps)
    return f"{options.out}: {len(frames)} pictures"


def wireframe_command(options: argparse.Namespace) -> str:
    """Draw the edges of a mesh."""
    _check_folder(options.out)
    if is_scene_file(options.file):
        if options.normals is not None:
            raise ValueError(
                f"{options.file}: normals of a scene file have a length of their own; leave out"
                " --normals, and use render --operation normals"
            )
        _refuse_for_scenes(options)
        image = render_scene_file(
            options.file, operation="wireframe", antialias=not options.no_antialias
        )
        return _written(options.out, image)
    mesh = load(options.file)
    thing = Object(mesh, Material(diffuse=options.color))
    size = options.size or 512
    image = wireframe(
        Scene(objects=[thing], lights=[], background=options.background),
        _camera(_framing(options, mesh), math.radians(options.fov)),
        height=size,
        width=size,
        hidden=options.hidden,
        normal_length=options.normals,
        edges=[mesh_edges(mesh, flat=options.all_edges)],
        line_width=options.line_width,
        antialias=not options.no_antialias,
    )
    return _written(options.out, image)


def fit_command(options: argparse.Namespace) -> str:
    """Find eye, target, light and colour from a picture of a known mesh."""
    mesh, picture = load(options.file), load_image(options.image)[..., :3]
    framing = _framing(options, mesh)
    target, share = _shrunk(picture, options.resolution)
    fov_y = 2 * math.atan(share * math.tan(math.radians(options.fov) / 2))
    options.out.mkdir(parents=True, exist_ok=True)  # before the work, which would be lost
    reach = float(np.linalg.norm(framing.eye - framing.target))
    background, light_start = jnp.asarray(options.background), jnp.asarray(options.light)
    settings = RenderSettings(
        height=target.shape[0], width=target.shape[1], antialias=not options.no_antialias
    )
    if mesh.normals is None:
        mesh = with_normals(mesh)

    def picture_of(params: dict[str, Array], size: RenderSettings) -> Array:
        seen = framing._replace(
            eye=framing.eye + reach * params["eye"],
            target=framing.target + reach * params["target"],
        )
        camera = _camera(seen, fov_y, size.width / size.height)
        light = DirectionalLight(
            direction=fit.direction_update(light_start, params["light"]),
            ambient=params["ambient"],
            diffuse=params["diffuse"],
            specular=(0.0, 0.0, 0.0),
        )
        thing = Object(mesh, Material(diffuse=(1.0, 1.0, 1.0)))
        return render(Scene(objects=[thing], lights=[light], background=background), camera, size)

    start = {
        "eye": jnp.zeros(3),
        "target": jnp.zeros(3),
        "light": jnp.zeros(2),
        "ambient": 0.2 * jnp.asarray(options.color),
        "diffuse": 0.8 * jnp.asarray(options.color),
    }
    result = fit.least_squares(
        lambda params, target: picture_of(params, settings) - target,
        start,
        args=(target,),
        steps=_FIT_STEPS,
        damping=0.1,
        tolerance=1e-5,
        progress=not options.quiet,
    )
    found = result.params
    numbers = {
        "eye": framing.eye + reach * np.asarray(found["eye"]),
        "target": framing.target + reach * np.asarray(found["target"]),
        "light_direction": fit.direction_update(light_start, found["light"]),
        "ambient": found["ambient"],
        "diffuse": found["diffuse"],
    }
    report: dict[str, Any] = {name: np.asarray(v).tolist() for name, v in numbers.items()}
    report["rms"] = math.sqrt(2 * result.loss / target.size)
    report["renders"] = result.renders
    (options.out / "fit.json").write_text(json.dumps(report, indent=1) + "\n")
    images = [target, picture_of(start, settings), picture_of(found, settings)]
    encoded = [np.asarray(linear_to_srgb(jnp.clip(image, 0, 1))) for image in images]
    save_image(options.out / "fit.png", np.concatenate(encoded, axis=1), srgb=False)
    return (
        f"{options.out / 'fit.json'}: difference {report['rms']:.4f} after {result.renders}"
        f" pictures ({result.reason}); {options.out / 'fit.png'}: target, start, result"
    )


def _shrunk(picture: Array, resolution: int) -> tuple[Array, float]:
    """The picture, no longer than `resolution`, and what share of its rows that shows.

    What fills no whole pixel is left out on both sides, so that the middle stays the middle.
    """
    rows, columns = picture.shape[:2]
    shrink = max(1, math.ceil(max(rows, columns) / resolution))
    if min(rows, columns) < shrink:
        raise ValueError(
            f"--resolution: wanted at least {math.ceil(max(rows, columns) / min(rows, columns))}"
            f" for a picture of {rows} by {columns} pixels, got {resolution}"
        )
    height, width = rows // shrink * shrink, columns // shrink * shrink
    top, left = (rows - height) // 2, (columns - width) // 2
    kept = picture[top : top + height, left : left + width]
    return fit.downsample(kept, shrink), height / rows


def gallery_command(options: argparse.Namespace) -> str:
    """Draw every shape of the library, and some L-systems."""
    size = options.size or 192
    options.out.mkdir(parents=True, exist_ok=True)
    written = []
    for name in _with_progress([*SHAPES, *_systems()], options):
        if name in SHAPES:
            mesh = load(name)
            camera = _camera(_framing(options, mesh), math.radians(options.fov))
            settings = RenderSettings(height=size, width=size, samples=4, antialias=False)
            image = render(_scene(options, mesh), camera, settings)
        else:
            system, rounds = _systems()[name]
            drawing = system.draw(rounds)
            points = fit_points(drawing.points, size=size)
            image = draw_lines(
                points.points, drawing.lines, height=points.height, width=points.width
            )
        save_image(options.out / f"{name}.png", image)
        written.append(name)
    return f"{options.out}: {', '.join(written)}"


def _systems() -> dict[str, tuple[shapes.LSystem, int]]:
    right = math.pi / 2
    plant = {"X": "F-[[X]+X]+F[+FX]-X", "F": "FF"}
    return {
        "koch": (
            shapes.LSystem(initiator="F", rules={"F": "F+F--F+F"}, angle=math.radians(85)),
            7,
        ),
        "dragon": (
            shapes.LSystem(initiator="F", rules={"F": "F+G", "G": "F-G"}, angle=right),
            12,
        ),
        "plant": (
            shapes.LSystem(
                initiator="X", rules=plant, angle=math.pi / 8, start_angle=right, draw="F"
            ),
            5,
        ),
    }


# The parts they share -----------------------------------------------------------------------------


def is_scene_file(file: str) -> bool:
    """Whether a file is a scene of the thesis, rather than one of its objects.

    Of these the first line that is no comment holds three whole numbers.
    """
    path = Path(file)
    if path.suffix.lower() != ".dat" or not path.is_file():
        return False
    lines = (line.split() for line in without_comments(read_text(path)).split("\n"))
    first = next((words for words in lines if words), [])[:3]
    return not (len(first) == 3 and all(word.isdigit() for word in first))


def _refuse_for_scenes(options: argparse.Namespace) -> None:
    """Tell options that have no effect on the picture of a scene file."""
    given = {
        name
        for name, value in vars(options).items()
        if name not in _FOR_SCENES and value != options.default_of(name)
    }
    if given:
        names = " ".join(f"--{name.replace('_', '-')}" for name in sorted(given))
        raise ValueError(
            f"{options.file}: a scene file has a view, size and look of its own; leave out {names}"
        )


def load(file: str) -> Mesh:
    """The mesh of a file, or the shape of a name."""
    if file in SHAPES:
        return SHAPES[file]()
    path = Path(file)
    if not path.is_file():
        raise FileNotFoundError(
            f"{file}: there is no such file, and no such shape among {', '.join(SHAPES)}"
        )
    if is_scene_file(file):
        raise ValueError(f"{file}: wanted a mesh, got a scene file, for render and wireframe")
    if path.suffix.lower() == ".bez":
        return shapes.bezier_mesh(load_bezier(path).control_points)
    if path.suffix.lower() == ".dat":
        return load_polygons(path).mesh
    mesh = load_mesh(path)
    return mesh if mesh.normals is not None else with_normals(mesh)


def _framing(options: argparse.Namespace, mesh: Mesh) -> Framing:
    """The view that was asked for; by default all of the mesh from the front right above."""
    vertices = np.asarray(mesh.vertices, np.float64)
    if mesh.faces.size:  # what belongs to none of them is not seen
        vertices = vertices[np.unique(mesh.faces)]
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    target = centre if options.target is None else np.asarray(options.target, np.float64)
    up = np.asarray(options.up, np.float64)
    if not (np.all(np.isfinite(up)) and np.any(up)):
        raise ValueError(f"--up: wanted finite numbers that are not all zero, got {options.up}")
    if options.eye is None:
        # Along 1 of right, 1 of front and 0.7 of up, whichever way is up.
        axis = int(np.argmax(np.abs(up)))
        direction = np.roll(np.array([0.75, -1.0, 0.6]), axis - 2) * np.where(
            np.arange(3) == axis, np.sign(up[axis]), 1
        )
        distance = 1.15 * radius / math.sin(math.radians(options.fov) / 2)
        eye = target + distance * direction / np.linalg.norm(direction)
    else:
        eye = np.asarray(options.eye, np.float64)
    return Framing(eye, target, up, centre, radius)


def _camera(framing: Framing, fov_y: float, aspect: float = 1.0) -> Camera:
    """The camera of a framing, which sees the mesh whole in depth from wherever it stands."""
    backward = viewing.view_axes(framing.target - framing.eye, framing.up)[2]
    depth = jnp.maximum(linalg.dot(framing.eye - framing.centre, backward), 0)
    far = lax.stop_gradient(depth + 2 * framing.radius)
    return Camera.perspective(
        eye=framing.eye,
        target=framing.target,
        up=framing.up,
        fov_y=fov_y,
        aspect=aspect,
        near=jnp.maximum(far - 3.5 * framing.radius, far * 1e-3),
        far=far,
    )


def _scene(options: argparse.Namespace, mesh: Mesh) -> Scene:
    light = DirectionalLight(
        direction=options.light, ambient=(0.2,) * 3, diffuse=(0.8,) * 3, specular=(0.4,) * 3
    )
    material = Material(diffuse=options.color, specular=(0.3, 0.3, 0.3))
    return Scene(objects=[Object(mesh, material)], lights=[light], background=options.background)


def _settings(options: argparse.Namespace) -> RenderSettings:
    size = options.size or 512
    return RenderSettings(
        height=size,
        width=size,
        shading=options.shading,
        samples=options.samples,
        antialias=not options.no_antialias,
    )


def _check_folder(path: Path) -> None:
    """See that there is a folder for a file, before the work that would be lost."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"--out: wanted a file in a folder that is there, got {path}")


def _written(path: Path, image: Array) -> str:
    save_image(path, image)
    return f"{path}: {image.shape[1]} by {image.shape[0]} pixels"


def _with_progress(
    items: Iterable[T], options: argparse.Namespace, total: int | None = None
) -> Iterator[T]:
    """The items, with a progress bar if it is wanted; `total` if they do not tell how many."""
    if options.quiet:
        yield from items
        return
    try:
        from tqdm.auto import tqdm
    except ImportError as error:
        raise ImportError(
            "progress needs tqdm: install diffrast[progress], or pass --quiet"
        ) from error
    yield from tqdm(items, total=total)
