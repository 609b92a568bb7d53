"""What `benchmark_error.py` compares: settings of renderers, next to the truth of each scene."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import peers
from benchmark_peers import checked, tasks
from exactness import Draw, Exact, exact, pose_picture, pose_slopes, pose_steps, shifted
from renderer import Diffrast, DiffrastInterior, Peer, Task, in_floats, with_samples
from timing import compiled

import diffrast as dr

EDGES, JAGGED = "edges", "no edges"
MAP = 2048  # of the true shadows, with eight samples a row of each pixel
FINEST = 32  # divisions of the true teapot


@dataclasses.dataclass(frozen=True)
class Contender:
    """A renderer with its settings.

    Attributes:
        series: what is joined by a line in the plot.
        setting: what tells it from others of the series.
        image: draws the picture.
        slopes: the derivatives by the truth's parameters of the picture weighted by one of the
            truth's fields, given by its number; if it has any.
        truth: what they should be.
        peer: whether it is not ours.
    """

    series: str
    setting: str
    image: Callable[[], np.ndarray]
    slopes: Callable[[int], np.ndarray] | None
    truth: Exact
    peer: bool = False


@dataclasses.dataclass(frozen=True)
class Truths:
    """How exact pictures are drawn: `pictures` of `samples` a pixel; and the fields to ask for."""

    samples: int = 64
    pictures: int = 8
    fields: int = 8

    def of(self, draw: Draw, size: int, scale: np.ndarray) -> Exact:
        return exact(draw, size, scale, **dataclasses.asdict(self))

    def of_task(self, task: Task, shading: str) -> Exact:
        return self.of(pose_picture(task, shading, self.samples), task.size, pose_steps(task))


def of_peer(peer: Peer, series: str, setting: str, truth: Exact) -> Contender:
    """A contender that draws a task."""
    slopes = functools.partial(pose_slopes, peer, truth) if peer.differentiable else None
    others = not isinstance(peer, Diffrast)
    return Contender(series, setting, lambda: in_floats(peer.image()), slopes, truth, others)


def of_function(
    draw: Callable[..., jax.Array],
    arguments: Sequence[Any],
    series: str,
    setting: str,
    truth: Exact,
) -> Contender:
    """One that draws a picture of the truth's parameters and of arguments."""

    def weighted(parameters: jax.Array, field: jax.Array, *arguments: Any) -> jax.Array:
        return jnp.vdot(field, draw(parameters, *arguments))

    start = jnp.zeros(len(truth.scale))
    image = compiled(draw, start, *arguments)
    fields = jnp.asarray(truth.fields)
    both = jax.jit(jax.value_and_grad(weighted))
    return Contender(
        series,
        setting,
        lambda: np.asarray(image()),
        lambda number: np.asarray(both(start, fields[number], *arguments)[1]) * truth.scale,
        truth,
    )


# Samples, edges and peers -------------------------------------------------------------------------


def sample_settings(
    scene: str,
    size: int,
    truths: Truths,
    *,
    sides: Sequence[int],
    others: bool,
    missing: dict[str, str],
) -> list[Contender]:
    """Samples a pixel with edges and without, and the other renderers; derivatives by the pose."""
    task = tasks(size)[scene]
    kinds: dict[type[Peer], tuple[str, int]] = {}
    for side in sides:
        kinds[with_samples(Diffrast, side)] = EDGES, side**2
        kinds[with_samples(DiffrastInterior, side)] = JAGGED, side**2
        if others:
            kinds[with_samples(peers.Mitsuba, side)] = "Mitsuba", side**2
    if others:
        kinds |= {peers.Deodr: ("DEODR", 1), peers.Llvmpipe: ("llvmpipe", 1)}
        kinds |= {peers.Llvmpipe4: ("llvmpipe", 4)}
    found = checked(task, list(kinds), missing)
    truth = {each: truths.of_task(task, each) for each in {peer.shading for peer in found}}
    return [
        of_peer(peer, series, f"{count}", truth[peer.shading])
        for peer in found
        for series, count in [kinds[type(peer)]]
    ]


# Shadows ------------------------------------------------------------------------------------------


def shadow_settings(size: int, truths: Truths, *, resolutions: Sequence[int]) -> list[Contender]:
    """Resolutions of the light's map, with edges and without; derivatives by the light."""
    ring = dr.linalg.compose(
        dr.linalg.translation((0.3, 0.2, 0.9)), dr.linalg.rotation((1, 0.3, 0.2), 0.5)
    )
    objects = (
        dr.Object(dr.shapes.torus(0.6, 0.2), None, ring),
        dr.Object(dr.shapes.plane(12.0, 12.0), dr.Material(diffuse=(0.8, 0.8, 0.8))),
    )
    camera = dr.Camera.perspective(
        eye=(0.3, -3.2, 3.0), target=(0, 0.1, 0.4), up=(0, 0, 1), fov_y=0.8, near=0.5, far=30
    )

    def draw(
        turn: jax.Array,
        objects: tuple[dr.Object, ...],
        camera: dr.Camera,
        *,
        resolution: int,
        settings: dr.RenderSettings,
    ) -> jax.Array:
        light = dr.DirectionalLight(
            direction=jnp.array([-0.5, 0.3, -1.0]).at[:2].add(turn),
            ambient=(0.2, 0.2, 0.2),
            shadow=dr.Shadow(resolution=resolution),
        )
        return dr.render(dr.Scene(objects=objects, lights=[light]), camera, settings)

    def settings(**options: Any) -> dr.RenderSettings:
        return dr.RenderSettings(height=size, width=size, **options)

    fine = settings(samples=truths.samples, antialias=False)
    exact_draw = jax.jit(functools.partial(draw, resolution=MAP, settings=fine))
    truth = truths.of(
        lambda turn, shift: exact_draw(turn, objects, shifted(camera, shift, size)),
        size,
        np.full(2, 4 / size),  # moves the shadow by a pixel or so
    )
    return [
        of_function(
            functools.partial(draw, resolution=resolution, settings=settings(antialias=edges)),
            (objects, camera),
            EDGES if edges else JAGGED,
            f"{resolution}",
            truth,
        )
        for edges in (True, False)
        for resolution in resolutions
    ]


# Filters ------------------------------------------------------------------------------------------


def filter_settings(
    size: int, truths: Truths, *, sides: Sequence[int], anisotropies: Sequence[int]
) -> list[Contender]:
    """Filters of a checkerboard that reaches far away; derivatives by how it moves.

    Its squares are 20 pixels wide at the bottom of the picture of 256², and less than one on top.
    """
    dark = (np.indices((64, 64)) // 8).sum(axis=0) % 2
    squares = jnp.asarray(np.repeat(0.1 + 0.8 * dark[..., None], 3, axis=2), jnp.float32)
    floor = dr.shapes.plane(200.0, 200.0)
    camera = dr.Camera.perspective(
        eye=(0, 0, 1), target=(0.3, 1.94, 0), up=(0, 0, 1), fov_y=0.9, near=0.05, far=300
    )
    mapping = dr.PlanarMapping(corner=(0, 0, 0), across=(0.8, 0, 0), up=(0, 0.8, 0))

    def draw(
        shift: jax.Array,
        floor: dr.Mesh,
        texels: jax.Array,
        camera: dr.Camera,
        *,
        options: Mapping[str, Any],
        samples: int,
    ) -> jax.Array:
        texture = dr.Texture(texels, mapping=mapping, **options)
        material = dr.Material(diffuse=(1, 1, 1), texture=texture)
        item = dr.Object(floor, material, dr.linalg.translation(shift))
        settings = dr.RenderSettings(
            height=size, width=size, shading="unlit", antialias=False, samples=samples
        )
        return dr.render(dr.Scene(objects=[item]), camera, settings)

    nearest = {"filter": "nearest"}
    exact_draw = jax.jit(functools.partial(draw, options=nearest, samples=truths.samples))
    truth = truths.of(
        lambda shift, by: exact_draw(shift, floor, squares, shifted(camera, by, size)),
        size,
        np.full(3, 2 / size),  # a pixel or so in the picture's middle
    )

    def contender(series: str, setting: str, samples: int, **options: Any) -> Contender:
        function = functools.partial(draw, options=options, samples=samples)
        return of_function(function, (floor, squares, camera), series, setting, truth)

    return [
        contender(kind, f"{side**2}", side**2, filter=kind)
        for kind in ("nearest", "bilinear")
        for side in sides
    ] + [contender("trilinear", f"{a}", 1, filter="trilinear", anisotropy=a) for a in anisotropies]


# Tessellation -------------------------------------------------------------------------------------


def tessellation_settings(
    size: int, truths: Truths, *, divisions: Sequence[int]
) -> list[Contender]:
    """Cells along each patch of the teapot, against the finest; derivatives by the pose."""
    camera = tasks(size)["teapot"].camera

    def task(count: int) -> Task:
        return Task(dr.shapes.teapot(count), camera, size, closed=True)

    truth = truths.of_task(task(FINEST), "phong")
    return [of_peer(Diffrast(task(count)), EDGES, f"{count}", truth) for count in divisions]
