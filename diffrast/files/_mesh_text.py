"""What the mesh reader passes over in silence: the lines of text formats, checked one by one.

trimesh counts OBJ's relative indices from the end of the file instead of from the face, takes the
first vertex for index 0, drops texture coordinates and normals of all corners where one has none,
and does not say where a file is broken. Of OFF files, read here, it reorders polygons, and drops
normals and texture coordinates. Each check here raises `ValueError` "file:line: wanted ..., got
...".
"""

import re
from collections.abc import Iterator
from itertools import chain, islice
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffrast._polygons import triangles_in_order
from diffrast._tokens import decoded, is_finite, whole

_OBJ_SIZES = {"v": 3, "vt": 2, "vn": 3}
_OFF = re.compile(r"(?P<uv>ST)?(?P<color>C)?(?P<normal>N)?(?P<weight>4)?OFF")
_COMMENT = re.compile(r"(?:^|\s)#(?=\s|$)")  # behind a name, which may have a # itself
_END_OF_LINE = re.compile(r"\r\n|\r|\n")  # not those that `str.splitlines` finds in letters


_ObjFace = tuple[int, str | None, list[list[int]]]  # line, material, corners


def text_of(content: bytes, name: str) -> str:
    """Text of a file; in UTF-8, or in any encoding that has ASCII's numbers."""
    if b"\0" in content:
        line = content[: content.index(b"\0")].count(b"\n") + 1
        raise ValueError(f"{name}:{line}: wanted text, got binary data")
    return decoded(content)


class PlainObj(NamedTuple):
    """The geometry of an OBJ file in its plainest form.

    Attributes:
        text: an OBJ file of vertices and triangles, and of `usemtl` with a number.
        numbers: of each triangle, that which stands before it.
        materials: the names that these numbers stand for; None for faces of no material.
        libraries: what follows `mtllib` on each line.
    """

    text: str
    numbers: list[int]
    materials: list[str | None]
    libraries: list[str]


def plain_obj(text: str, name: str, *, keep_materials: bool = False) -> PlainObj:
    """An OBJ file, checked.

    Triangles only (see `triangles_in_order`), indices from the start of the file, one blank between
    words, the same kind of corner (v, v/vt, v//vn, v/vt/vn) wherever a material is: texture
    coordinates and normals are kept where all its corners have them. Groups, objects, lines and
    colours are dropped. Without `keep_materials` numbers only part faces with unlike corners.
    """
    counts = dict.fromkeys(_OBJ_SIZES, 0)
    vertices: list[str] = []
    faces: list[_ObjFace] = []
    libraries: list[str] = []
    material = None
    for line, words in statements(text, ("mtllib", "usemtl")):
        key = words[0]
        if key in counts:
            counts[key] += 1
            vertices.append(" ".join([key, *_obj_numbers(words, f"{name}:{line}")]))
        elif key == "f":
            faces.append((line, material, _obj_corners(words[1:], counts, f"{name}:{line}")))
        elif key == "mtllib":
            libraries += words[1:]
        elif key == "usemtl":
            material = words[1] if len(words) > 1 else None
    kinds = _obj_kinds(faces)
    materials: dict[str | None, int] = {}
    unlike: dict[tuple[bool, bool], int] = {}
    lines: list[str] = []
    numbers: list[int] = []
    for line, _, corners in faces:
        _obj_in_range(line, corners, counts, name)

    def positions() -> np.ndarray:
        return np.array([row.split()[1:] for row in vertices if row.startswith("v ")], dtype=float)

    polygons = [[corner[0] - 1 for corner in corners] for _, _, corners in faces]
    triangles = iter(triangles_in_order(positions, polygons).tolist())
    end = 0
    for _, material, corners in faces:
        kind = kinds[material]
        number = materials.setdefault(material, len(materials))
        if not keep_materials:
            number = unlike.setdefault(kind, len(unlike))
        if numbers[-1:] != [number]:
            lines.append(f"usemtl {number}")
        written = [_obj_corner(corner, kind) for corner in corners]
        for triangle in islice(triangles, len(corners) - 2):
            lines.append("f " + " ".join(written[k - end] for k in triangle))
        end += len(corners)
        numbers += [number] * (len(corners) - 2)
    text = "\n".join([*vertices, *lines, ""])
    return PlainObj(text, numbers, list(materials), libraries)


def statements(text: str, names: tuple[str, ...]) -> Iterator[tuple[int, list[str]]]:
    """Words of every line that has any, with the number of its first line.

    After one of `names`, in small letters, the rest of a line is one word: in it only a # that
    stands alone begins a comment.
    """
    pending, first = "", 0
    for number, line in enumerate([*_lines(text), ""], start=1):  # the last may end in a backslash
        first = first if pending else number
        content = pending + line
        if "#" in content:
            is_name = content.split(None, 1)[0].lower() in names
            content = _COMMENT.split(content)[0] if is_name else content.partition("#")[0]
        if content.endswith("\\"):
            pending = content[:-1] + " "
            continue
        pending = ""
        words = content.split(None, 1)
        if not words:
            continue
        if words[0].lower() in names:
            yield first, [word.rstrip() for word in words]
        else:
            yield first, content.split()


def _obj_kinds(faces: list[_ObjFace]) -> dict[str | None, tuple[bool, bool]]:
    """Whether all corners of each material have texture coordinates, and normals."""
    kinds: dict[str | None, tuple[bool, bool]] = {}
    for _, material, corners in faces:
        uv, normal = kinds.get(material, (True, True))
        kinds[material] = (
            uv and all(corner[1] for corner in corners),
            normal and all(corner[2] for corner in corners),
        )
    return kinds


def _obj_numbers(words: list[str], where: str) -> list[str]:
    size = _OBJ_SIZES[words[0]]
    numbers = words[1 : 1 + size]
    if words[0] == "vt" and len(numbers) == 1:
        numbers = [*numbers, "0"]
    if len(numbers) < size or not all(is_finite(word) for word in numbers):
        raise ValueError(f"{where}: wanted {size} numbers after {words[0]}, got {quote(words[1:])}")
    return numbers


def _obj_corners(words: list[str], counts: dict[str, int], where: str) -> list[list[int]]:
    """Indices (v, vt, vn) of each corner, from 1; 0 where the corner has none."""
    if len(words) < 3:
        raise ValueError(f"{where}: wanted at least 3 corners after f, got {quote(words)}")
    corners = []
    for word in words:
        fields = word.split("/")
        corner = [0, 0, 0]
        for k, (field, count) in enumerate(zip(fields, counts.values(), strict=False)):
            if not field and k > 0:
                continue
            index = whole(field) or 0
            if index == 0 or index < -count or len(fields) > 3:
                raise ValueError(
                    f"{where}: wanted a corner v, v/vt, v//vn or v/vt/vn with indices from 1 or"
                    f" back to -{count}, got {word!r}"
                )
            corner[k] = index if index > 0 else count + 1 + index
        corners.append(corner)
    return corners


def _obj_in_range(line: int, corners: list[list[int]], counts: dict[str, int], name: str) -> None:
    for k, (key, count) in enumerate(counts.items()):
        for corner in corners:
            if (index := corner[k]) > count:
                raise ValueError(
                    f"{name}:{line}: wanted an index of at most {count}, the number of {key} in"
                    f" the file, got {index}"
                )


def _obj_corner(corner: list[int], kind: tuple[bool, bool]) -> str:
    has_uv, has_normal = kind
    if has_normal:
        return f"{corner[0]}/{corner[1] if has_uv else ''}/{corner[2]}"
    return f"{corner[0]}/{corner[1]}" if has_uv else f"{corner[0]}"


class OffMesh(NamedTuple):
    """What an OFF file says; None for what it does not. Normals are of any length."""

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "vertices 3"] | None
    uvs: Float[np.ndarray, "vertices 2"] | None


def read_off(text: str, name: str) -> OffMesh:
    """An OFF file, checked; its polygons as triangles, in their places.

    A vertex has a position (4OFF: and what to divide it by), with N a normal, with C a colour of 3
    or 4 numbers, with ST texture coordinates, in this order. Colours are dropped.
    """
    lines = [(n, w) for n, w in numbered(text) if w]
    kind = _OFF.fullmatch(lines[0][1][0]) if lines else None
    if kind is None:
        raise ValueError(
            f"{name}:1: wanted the word OFF, with ST, C, N or 4 before it or not, got"
            f" {quote(text.split()[:1])}"
        )
    number, words = lines[0]
    rest = lines[1:] if len(words) == 1 else [(number, words[1:]), *lines[1:]]
    if not rest:
        raise ValueError(f"{name}:{number}: wanted the numbers of vertices and faces, got the end")
    number, words = rest[0]
    sizes = [to_count(word) for word in words[:2]]
    if len(sizes) < 2 or min(sizes) < 0:
        raise ValueError(
            f"{name}:{number}: wanted the numbers of vertices and faces, got {quote(words)}"
        )
    body = iter(rest[1:])
    # Lists grow with what is read: the numbers above may be any.
    vertices: list[list[float]] = []
    for k in range(sizes[0]):
        number, words = next_line(body, f"vertex {k}", name, number)
        vertices.append(_off_vertex(words, kind, f"{name}:{number}"))
    faces: list[list[int]] = []
    for k in range(sizes[1]):
        number, words = next_line(body, f"face {k}", name, number)
        check_indices(words, len(vertices), f"{name}:{number}")
        faces.append([int(word) for word in words[1 : 1 + int(words[0])]])
    width = 3 + 3 * bool(kind["normal"]) + 2 * bool(kind["uv"])
    values = np.array(vertices, dtype=float).reshape(-1, width)
    corners = np.array([*chain.from_iterable(faces)], dtype=int)
    return OffMesh(
        vertices=values[:, :3],
        faces=corners[triangles_in_order(lambda: values[:, :3], faces)],
        normals=values[:, 3:6] if kind["normal"] else None,
        uvs=values[:, -2:] if kind["uv"] else None,
    )


def _off_vertex(words: list[str], kind: re.Match[str], where: str) -> list[float]:
    """Position, normal and texture coordinates, as far as there are any."""
    size = 4 if kind["weight"] else 3
    size += 3 if kind["normal"] else 0
    color = len(words) - size - 2 if kind["color"] and kind["uv"] else 0
    used = words[:size] + (words[size + color : size + color + 2] if kind["uv"] else [])
    wanted = size + (2 if kind["uv"] else 0)
    if len(used) < wanted or not all(is_finite(word) for word in used):
        raise ValueError(
            f"{where}: wanted {'three' if wanted == 3 else wanted} numbers, got {quote(words)}"
        )
    if kind["color"] and kind["uv"] and color not in (3, 4):
        raise ValueError(
            f"{where}: wanted {wanted} numbers and 3 or 4 of a colour, got {quote(words)}"
        )
    numbers = [float(word) for word in used]
    if kind["weight"]:
        weight = numbers.pop(3)
        if weight == 0:
            raise ValueError(f"{where}: wanted a fourth number other than 0, got {quote(words)}")
        numbers[:3] = [x / weight for x in numbers[:3]]
    return numbers


def check_ascii_stl(text: str, name: str) -> None:
    """Check that a text STL file has facets of three vertices, and an end."""
    corners, number, inside = 0, 1, False
    for number, words in numbered(text):
        key = words[0].lower() if words else ""
        if key == "vertex":
            corners += 1
            if len(words) != 4 or not all(is_finite(word) for word in words[1:]):
                raise ValueError(f"{name}:{number}: wanted three numbers, got {quote(words[1:])}")
        elif key in ("endloop", "endfacet", "endsolid") and corners % 3:
            raise ValueError(f"{name}:{number}: wanted facets of three vertices, got {key} early")
        elif key in ("solid", "endsolid"):
            inside = key == "solid"
    if inside:
        raise ValueError(f"{name}:{number}: wanted endsolid, got the end of the file")


def numbered(text: str) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(_lines(text), start=1):
        yield number, line.split("#")[0].split()


def _lines(text: str) -> list[str]:
    lines = _END_OF_LINE.split(text)
    return lines[:-1] if lines[-1] == "" else lines


def next_line(
    lines: Iterator[tuple[int, list[str]]], wanted: str, name: str, number: int
) -> tuple[int, list[str]]:
    """The next line that is not empty."""
    for number, words in lines:
        if words:
            return number, words
    raise ValueError(f"{name}:{number}: wanted {wanted}, got the end of the file")


def check_indices(words: list[str], bound: int, where: str) -> None:
    """A number of corners and as many vertex ids, perhaps more."""
    size = to_count(words[0])
    ids = words[1 : 1 + size]
    fits = size >= 3 and len(ids) == size
    if not (fits and all(0 <= to_count(word) < bound for word in ids)):
        raise ValueError(
            f"{where}: wanted a number of corners and as many indices in [0, {bound}), got"
            f" {quote(words)}"
        )


def to_count(word: str) -> int:
    """A number of things, or an index from 0; −1 for any other word."""
    count = whole(word)
    return -1 if count is None or count < 0 else count


def quote(words: list[str]) -> str:
    text = " ".join(words)
    return repr(text if len(text) <= 60 else text[:57] + "...")
