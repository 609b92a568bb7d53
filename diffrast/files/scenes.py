"""The thesis's object and scene files, *.dat (FEATURES G7, G8; Kos 9, 12.2.8, 12.2.9)."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffrast._check import all_instances, file_path, instance_of, one_of, static_number
from diffrast._tokens import Tokens, is_finite, read_text
from diffrast.mesh import Mesh, from_polygons

OPERATIONS = ("wireframe", "normals", "phong", "gouraud")
PROJECTIONS = ("parallel", "perspective")


class Polygons(NamedTuple):
    """Polygons of any number of corners, each belonging to a surface of the object."""

    points: Float[np.ndarray, "points 3"]
    polygons: tuple[tuple[int, ...], ...]
    surfaces: Int[np.ndarray, " polygons"]

    @property
    def mesh(self) -> Mesh:
        """Triangles, smooth within each surface; see `diffrast.mesh.from_polygons`."""
        return from_polygons(self.points, self.polygons, self.surfaces)


class PlacedFile(NamedTuple):
    """An object of a scene file: rotated about x, y and z in turn, then scaled, then moved."""

    name: str
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)  # degrees
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneFile:
    """What a scene file says.

    Attributes:
        projection: "parallel" or "perspective".
        view_plane_distance: VPD. The thesis's program takes it for the back clipping plane.
        projection_distance: of the centre of projection from VRP, along VPN.
        view_reference_point: VRP.
        view_plane_normal: VPN, towards the viewer.
        view_up: VUP.
        window: width and height, in the plane through VRP, centred there.
        raster_height: rows of the picture.
        operation: "wireframe", "normals" (of the vertices, too), "phong" or "gouraud".
        light: vector towards the light.
        output: name of the file for the result.
        objects: files and where they are put.
    """

    projection: str
    view_plane_distance: float
    projection_distance: float
    view_reference_point: tuple[float, float, float]
    view_plane_normal: tuple[float, float, float]
    view_up: tuple[float, float, float]
    window: tuple[float, float]
    raster_height: int
    operation: str
    light: tuple[float, float, float]
    output: str
    objects: tuple[PlacedFile, ...]


# -------------------------------------------------------------------------------------- objects


def load_polygons(path: str | Path) -> Polygons:
    """Read an object: points, polygons and the surfaces that they belong to.

    A line with the numbers of points, polygons and surfaces; for every point its number and three
    coordinates; for every polygon its number, surface, number of corners and their points,
    counter-clockwise from outside. Anything in braces is a comment. `.mesh` makes triangles of it.

    Raises:
        ValueError: with file and line, for anything that does not follow the format.
        OSError: when the file cannot be opened.
    """
    return _polygons_of(read_text(file_path("path", path)), str(path))


def _polygons_of(text: str, name: str) -> Polygons:
    """The object that a text tells of; errors begin with the name."""
    tokens = Tokens(text, name)
    count = tokens.integer("the number of points", 1)
    polygon_count = tokens.integer("the number of polygons", 1)
    surface_count = tokens.integer("the number of surfaces", 1, 1 << 31)
    # Lists grow with what is read: the numbers above may be any.
    points: list[list[float]] = []
    for number in range(count):
        tokens.integer(f"point number {number}", number, number + 1)
        points.append([tokens.number(f"{axis} of point {number}") for axis in "xyz"])
    polygons: list[tuple[int, ...]] = []
    surfaces: list[int] = []
    for number in range(polygon_count):
        tokens.integer(f"polygon number {number}", number, number + 1)
        surfaces.append(tokens.integer(f"the surface of polygon {number}", 0, surface_count))
        corners = tokens.integer(f"the number of corners of polygon {number}", 1)
        wanted = f"a point of polygon {number}"
        polygons.append(tuple(tokens.integer(wanted, 0, count) for _ in range(corners)))
    tokens.end()
    return Polygons(np.array(points), tuple(polygons), np.array(surfaces, np.int32))


def save_polygons(path: str | Path, polygons: Polygons) -> None:
    """Write an object; reading it gives the same numbers back.

    Raises:
        ValueError: for anything but polygons, and with the line for what `load_polygons` refuses.
        OSError: when the file cannot be written.
    """
    instance_of("polygons", polygons, Polygons)
    points, surfaces = np.asarray(polygons.points), np.asarray(polygons.surfaces)
    if points.shape[1:] != (3,):
        raise ValueError(f"polygons.points: wanted shape (points, 3), got {points.shape}")
    if surfaces.shape != (len(polygons.polygons),):
        raise ValueError(
            f"polygons.surfaces: wanted shape ({len(polygons.polygons)},), got {surfaces.shape}"
        )
    lines = [f"{len(points)} {len(polygons.polygons)} {max(surfaces.tolist(), default=-1) + 1}"]
    for number, point in enumerate(points):
        lines.append(
            f"{number} " + " ".join(np.format_float_positional(x, trim="0") for x in point)
        )
    for number, (surface, ids) in enumerate(zip(surfaces, polygons.polygons, strict=True)):
        lines.append(f"{number} {surface} {len(ids)} " + " ".join(map(str, ids)))
    text = "\n".join(lines) + "\n"
    _polygons_of(text, "polygons")
    file_path("path", path).write_text(text, encoding="ascii")


# --------------------------------------------------------------------------------------- scenes


def load_scene_file(path: str | Path) -> SceneFile:
    """Read a scene: viewing, operation, light, and the files of its objects.

    One entry a line, in the order of `SceneFile`'s attributes; what follows the numbers on a line
    is a comment. After the number of objects each has its scale, rotation, translation and file
    name; the thesis's program reads the name first, and such files are read, too. Nothing but
    comments in braces follows.

    Raises:
        ValueError: with file and line, for anything that does not follow the format.
        OSError: when the file cannot be opened.
    """
    return _scene_of(read_text(file_path("path", path)), str(path))


def _scene_of(text: str, name: str) -> SceneFile:
    """The scene that a text tells of; errors begin with the name."""
    lines = _Lines(text, name)
    projection = PROJECTIONS[lines.choice("the type of projection", len(PROJECTIONS))]
    view_plane_distance = lines.numbers("the view plane's distance (VPD)", 1)[0]
    projection_distance = lines.numbers("the distance of the centre of projection (PRP)", 1)[0]
    if not projection_distance > 0:
        raise lines.error("a distance of the centre of projection above 0")
    points = [
        lines.three(f"the {name}")
        for name in ("view reference point (VRP)", "view plane normal (VPN)", "view up (VUP)")
    ]
    window = lines.numbers("the window's width and height", 2)
    if not min(window) > 0:
        raise lines.error("a window's width and height above 0")
    raster_height = lines.choice("the number of rows", 1 << 16)
    if raster_height < 1:
        raise lines.error("a number of rows of at least 1")
    if not raster_height * window[0] < (1 << 16) * window[1]:
        raise lines.error(f"rows that make fewer than {1 << 16} columns of a window {window}")
    operation = OPERATIONS[lines.choice("the operation", len(OPERATIONS))]
    light = lines.three("the vector to the light")
    output = lines.word("the name of the file for the result")
    count = lines.choice("the number of objects", 1 << 20)
    objects = []
    for number in range(count):
        of = f"of object {number + 1} of {count}"
        file = None if lines.begins_with_number() else lines.word(f"the file name {of}")
        placing = [lines.three(f"the {what} {of}") for what in ("scale", "rotation", "translation")]
        if file is None:
            file = lines.word(f"the file name {of}")
        objects.append(PlacedFile(file, *placing))
    lines.end(f"the end of the file after {count} objects")
    return SceneFile(
        projection=projection,
        view_plane_distance=view_plane_distance,
        projection_distance=projection_distance,
        view_reference_point=points[0],
        view_plane_normal=points[1],
        view_up=points[2],
        window=(window[0], window[1]),
        raster_height=raster_height,
        operation=operation,
        light=light,
        output=output,
        objects=tuple(objects),
    )


def save_scene_file(path: str | Path, scene: SceneFile) -> None:
    """Write a scene; reading it gives the same one back.

    Raises:
        ValueError: for anything but a scene file, for names of several words, and with the line
            for what `load_scene_file` refuses.
        OSError: when the file cannot be written.
    """
    instance_of("scene", scene, SceneFile)
    all_instances("scene.objects", scene.objects, PlacedFile)
    projection = PROJECTIONS.index(one_of("scene.projection", scene.projection, PROJECTIONS))
    operation = OPERATIONS.index(one_of("scene.operation", scene.operation, OPERATIONS))
    lines = [
        f"{projection} {{projection: 0 parallel, 1 perspective}}",
        _row("view_plane_distance", [scene.view_plane_distance], 1),
        _row("projection_distance", [scene.projection_distance], 1),
        _row("view_reference_point", scene.view_reference_point, 3),
        _row("view_plane_normal", scene.view_plane_normal, 3),
        _row("view_up", scene.view_up, 3),
        _row("window", scene.window, 2),
        _row("raster_height", [scene.raster_height], 1),
        f"{operation} {{operation: {', '.join(OPERATIONS)}}}",
        _row("light", scene.light, 3),
        _one_word("output", scene.output),
        f"{len(scene.objects)} {{objects}}",
    ]
    for number, item in enumerate(scene.objects):
        lines += [
            _row(f"objects[{number}].{name}", getattr(item, name), 3)
            for name in ("scale", "rotation", "translation")
        ]
        lines.append(_one_word(f"objects[{number}].name", item.name))
    text = "\n".join(lines) + "\n"
    _scene_of(text, "scene")
    file_path("path", path).write_text(text, encoding="utf-8")


def _row(name: str, numbers: Sequence[float], count: int) -> str:
    """A line of so many numbers, with what they are."""
    if np.shape(numbers) != (count,):
        raise ValueError(f"scene.{name}: wanted {count} numbers, got {numbers!r}")
    known = [static_number(f"scene.{name}", number) for number in numbers]
    return " ".join(f"{number:.17g}" for number in known) + f" {{{name}}}"


def _one_word(name: str, word: str) -> str:
    """A line of a name that reading finds the end of."""
    if not isinstance(word, str) or word.split() != [word] or "{" in word:
        raise ValueError(f"scene.{name}: wanted a name without blanks and braces, got {word!r}")
    return word


class _Lines:
    """Reads lines one after another, each by the words that it begins with."""

    def __init__(self, text: str, name: str) -> None:
        self._name = name
        self._lines = [line.replace("{", " {").split() for line in text.rstrip().split("\n")]
        self._next = 0

    def begins_with_number(self) -> bool:
        """Whether the next line does, or there is none."""
        line = self._lines[self._next] if self._next < len(self._lines) else ["0"]
        return not line or _number(line[0]) is not None

    def numbers(self, wanted: str, count: int) -> Sequence[float]:
        words = self._line(wanted)
        numbers = [_number(word) for word in words[:count]]
        found = [number for number in numbers if number is not None]
        if len(found) < count:
            raise self.error(f"{wanted}, {count} number{'s' if count > 1 else ''}")
        return found

    def three(self, wanted: str) -> tuple[float, float, float]:
        x, y, z = self.numbers(wanted, 3)
        return x, y, z

    def choice(self, wanted: str, bound: int) -> int:
        value = self.numbers(wanted, 1)[0]
        if value != int(value) or not 0 <= value < bound:
            raise self.error(f"{wanted}, an integer in [0, {bound})")
        return int(value)

    def word(self, wanted: str) -> str:
        words = self._line(wanted)
        if not words or words[0].startswith("{"):
            raise self.error(wanted)
        return words[0]

    def end(self, wanted: str) -> None:
        """Nothing but comments may follow."""
        while self._next < len(self._lines):
            line = self._line(wanted)
            if line and not line[0].startswith("{"):
                raise self.error(wanted)

    def _line(self, wanted: str) -> list[str]:
        if self._next == len(self._lines):
            raise ValueError(f"{self._name}:{self._next}: wanted {wanted}, got the end of the file")
        self._next += 1
        return self._lines[self._next - 1]

    def error(self, wanted: str) -> ValueError:
        """The error that the line just read is not what was wanted."""
        line = " ".join(self._lines[self._next - 1])
        return ValueError(f"{self._name}:{self._next}: wanted {wanted}, got {line!r}")


def _number(word: str) -> float | None:
    return float(word) if is_finite(word) else None
