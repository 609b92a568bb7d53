"""Pictures of the thesis's scene files (FEATURES G8, L7, T3; Kos 12.2)."""

from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from diffrast import linalg, viewing
from diffrast._check import file_path, flag, float_array, one_of, staying_known
from diffrast.camera import Camera
from diffrast.files._folder import inside
from diffrast.files.bezier import load_bezier
from diffrast.files.scenes import OPERATIONS, SceneFile, load_polygons, load_scene_file
from diffrast.light import DirectionalLight
from diffrast.lines import polygon_edges, wireframe
from diffrast.material import Material
from diffrast.mesh import Mesh, weld
from diffrast.render import render
from diffrast.scene import Object, Scene
from diffrast.settings import RenderSettings
from diffrast.shapes import bezier_mesh

_AMBIENT = 0.15
_DIVISIONS = 10  # cells along each side of a patch


class FileScene(NamedTuple):
    """A scene file, ready to be rendered.

    Attributes:
        scene: objects of plain white material and a light at infinity.
        camera: the file's view.
        edges: for each object the vertices of its mesh that the sides of its polygons join.
        height: rows of the picture.
        width: columns of it.
        description: the file itself.
    """

    scene: Scene
    camera: Camera
    edges: tuple[Int[np.ndarray, "edges 2"], ...]
    height: int
    width: int
    description: SceneFile


def read_scene(path: str | Path) -> FileScene:
    """Read a scene file and those of its objects, which lie in the same folder or below.

    Objects are polygons (*.dat) or Bézier patches (*.bez). The window lies in the plane through the
    view reference point, as the thesis's program has it, and nothing is clipped in depth but what
    is behind the centre of projection.

    Raises:
        ValueError: with file and line, for files that do not follow their format; with the file,
            for objects that lie elsewhere and for numbers that are too large for a picture.
        OSError: when a file cannot be opened.
    """
    path = file_path("path", path)
    file = load_scene_file(path)
    meshes = [_object(_file_of(path, item.name)) for item in file.objects]
    try:
        with staying_known(meshes):
            return _assembled(file, meshes)
    except ValueError as error:  # numbers that make no picture: too large ones
        raise ValueError(f"{path}: {error}") from error


def render_scene_file(
    path: str | Path, *, operation: str | None = None, antialias: bool = True
) -> Float[Array, "height width 3"]:
    """Picture of a scene file.

    "wireframe" draws the sides of the polygons that are not hidden, "normals" also the normals of
    the vertices, a thirtieth of the window long; "phong" and "gouraud" shade.

    Args:
        path: the scene file.
        operation: instead of the file's own.
        antialias: of edges or lines.

    Raises:
        ValueError: as `read_scene`, and for an unknown operation.
        OSError: when a file cannot be opened.
    """
    if operation is not None:
        one_of("operation", operation, OPERATIONS)
    antialias = flag("antialias", antialias)
    file = read_scene(path)
    if operation is None:
        operation = file.description.operation
    height, width = file.height, file.width
    if operation in ("phong", "gouraud"):
        settings = RenderSettings(
            height=height, width=width, shading=operation, antialias=antialias
        )
        return render(file.scene, file.camera, settings)
    length = file.description.window[0] / 30
    return wireframe(
        file.scene,
        file.camera,
        height=height,
        width=width,
        edges=file.edges,
        normal_length=length if operation == "normals" else None,
        antialias=antialias,
    )


def _assembled(file: SceneFile, meshes: list[tuple[Mesh, np.ndarray]]) -> FileScene:
    """The scene of a file and the meshes of its objects."""
    objects = []
    for item, (mesh, _) in zip(file.objects, meshes, strict=True):
        turns = [np.radians(degrees) for degrees in item.rotation]
        placing = linalg.compose(
            linalg.translation(item.translation),
            linalg.scaling(item.scale),
            linalg.rotation_z(turns[2]),
            linalg.rotation_y(turns[1]),
            linalg.rotation_x(turns[0]),
        )
        objects.append(Object(mesh, Material(diffuse=(0.8, 0.8, 0.8)), placing))
    light = DirectionalLight(
        direction=[-x for x in file.light],
        ambient=(_AMBIENT,) * 3,
        diffuse=(1 - _AMBIENT,) * 3,
    )
    height = file.raster_height
    # Of the numbers as they are written: rounding would cost a column.
    across, up = (Fraction(str(side)) for side in file.window)
    width = max(1, int(height * across / up))
    scene = Scene(objects=objects, lights=[light])
    edges = tuple(sides for _, sides in meshes)
    return FileScene(scene, _camera(file, objects), edges, height, width, file)


def _file_of(scene: Path, name: str) -> Path:
    """The file of an object."""
    path = inside(scene.parent, name)
    if path is None:
        raise ValueError(f"{scene}: wanted objects from its own folder, got {name!r}")
    return path


def _object(path: Path) -> tuple[Mesh, np.ndarray]:
    """Mesh of an object, and the vertices that its lines join."""
    try:
        return _mesh_of(path)
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: {error}") from error


def _mesh_of(path: Path) -> tuple[Mesh, np.ndarray]:
    if path.suffix.lower() == ".bez":
        patches = load_bezier(path).control_points
        mesh = bezier_mesh(patches, _DIVISIONS)
        side = _DIVISIONS + 1
        grid = np.arange(len(patches) * side * side).reshape(-1, side, side)
        across = np.stack([grid[:, :, :-1], grid[:, :, 1:]], axis=-1).reshape(-1, 2)
        along = np.stack([grid[:, :-1], grid[:, 1:]], axis=-1).reshape(-1, 2)
        return mesh, np.concatenate([across, along]).astype(np.int32)
    polygons = load_polygons(path)
    mesh = polygons.mesh
    # A point has a vertex for each surface that it belongs to; any of them has its place.
    sides = polygon_edges(polygons.polygons)
    places = np.asarray(mesh.vertices)
    together = np.concatenate([places, polygons.points.astype(places.dtype)])
    vertex = np.asarray(weld(together))[len(places) :]
    used = np.all(vertex[sides] < len(places), axis=1)  # sides of polygons without area are not
    return mesh, vertex[sides[used]]


def _camera(file: SceneFile, objects: list[Object]) -> Camera:
    """The file's view, deep enough for all objects."""
    axes = viewing.view_axes([-x for x in file.view_plane_normal], file.view_up)
    origin = float_array("view_reference_point", file.view_reference_point, (3,))
    depths = [
        jnp.sum((linalg.transform_points(item.transform, item.mesh.vertices) - origin) * axes[2], 1)
        for item in objects
    ]
    distance = file.projection_distance
    nearest = float(max([jnp.max(depth) for depth in depths], default=0.0))
    farthest = float(min([jnp.min(depth) for depth in depths], default=-1.0))
    slack = 0.01 * (abs(nearest - farthest) + distance)
    front = nearest + slack
    if file.projection == "perspective":
        front = min(front, distance * 0.999)
    width, height = file.window
    return Camera.phigs(
        view_reference_point=file.view_reference_point,
        view_plane_normal=file.view_plane_normal,
        view_up=file.view_up,
        projection_reference_point=(0.0, 0.0, distance),
        window=(-width / 2, width / 2, -height / 2, height / 2),
        front=front,
        back=min(farthest, front) - slack,
        projection=file.projection,
    )
