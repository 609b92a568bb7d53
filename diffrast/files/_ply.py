"""PLY files made plain before trimesh reads them: checked, and of triangles only.

trimesh accepts text files that end early, reads no binary polygons of several sizes, puts the
second halves of quads, and polygons of other sizes, behind all other faces, and makes paths of
edges, in memory that grows with the largest index, and no faces.
"""

import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from diffrast._polygons import triangles_in_order
from diffrast._tokens import is_finite
from diffrast.files._mesh_text import (
    check_indices,
    next_line,
    numbered,
    quote,
    text_of,
    to_count,
)

_CODES = {  # as struct and numpy know them
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float16": "e", "float32": "f", "float64": "d",
    "float": "f", "double": "d",
}  # fmt: skip
_INDICES = ("vertex_indices", "vertex_index")
_TEXTURE = re.compile(r"^[ \t]*comment[ \t]+texturefile[ \t]+(.+)$", re.MULTILINE | re.IGNORECASE)
_END = re.compile(rb"^end_header[^\n]*\n?", re.MULTILINE)


class _Property(NamedTuple):
    name: str
    type: str
    length: str | None  # type of the length of a list


_Row: TypeAlias = Mapping[str, Sequence[Any]]  # values of the properties of one thing


class _Element(NamedTuple):
    name: str
    size: int
    properties: list[_Property]


def plain_ply(content: bytes, name: str) -> bytes:
    """A PLY file of triangles, polygons cut in their places, without what faces have besides.

    Texture coordinates of the corners of faces are kept. Text is checked to its end.

    Raises:
        ValueError: "file:line: wanted ..., got ...", for binary data without the line.
    """
    end = _END.search(content)
    start = len(content) if end is None else end.end()
    lines = text_of(content[:start], name)
    is_text = "ascii" in "".join(lines.splitlines()[1:2])
    if is_text:
        lines = text_of(content, name)
    numbers = numbered(lines)
    elements, number = _read_header(numbers, name)
    if is_text:
        elements, body = _plain_text(elements, numbers, number, name)
    else:
        order = ">" if "big" in "".join(lines.splitlines()[1:2]) else "<"
        elements, body = _plain_binary(elements, content[start:], order, name)
    return _header(elements, lines) + body


def texture_name(content: bytes, name: str) -> str | None:
    """The picture that a comment in the header names; None without one.

    Raises:
        ValueError: for pictures of several names.
    """
    end = _END.search(content)
    header = text_of(content[: None if end is None else end.start()], name)
    names = sorted({found.strip() for found in _TEXTURE.findall(header)})
    if len(names) > 1:
        raise ValueError(f"{name}: wanted one TextureFile, got {quote(names)}")
    return names[0] if names else None


def _read_header(lines: Iterator[tuple[int, list[str]]], name: str) -> tuple[list[_Element], int]:
    """The elements, and the number of the header's last line."""
    elements: list[_Element] = []
    number = 1
    for number, words in lines:
        where = f"{name}:{number}"
        if words[:1] == ["element"]:
            if len(words) != 3 or to_count(words[2]) < 0:
                raise ValueError(
                    f"{where}: wanted a name and a number after element, got {quote(words[1:])}"
                )
            elements.append(_Element(words[1], to_count(words[2]), []))
        elif words[:1] == ["property"]:
            is_list = words[1:2] == ["list"]
            types = words[2:-1] if is_list else words[1:-1]
            known = all(type_ in _CODES for type_ in types)
            if len(types) != 1 + is_list or not known or (is_list and _CODES[types[0]] in "efd"):
                raise ValueError(
                    f"{where}: wanted a type and a name after property, or list, an integer's type,"
                    f" a type and a name, got {quote(words[1:])}"
                )
            if not elements or words[-1] in (other.name for other in elements[-1].properties):
                raise ValueError(
                    f"{where}: wanted properties of several names after their element, got"
                    f" {quote(words)}"
                )
            length = types[0] if is_list else None
            elements[-1].properties.append(_Property(words[-1], types[-1], length))
        elif words[:1] == ["end_header"]:
            return elements, number
    raise ValueError(f"{name}:{number}: wanted end_header, got the end of the file")


def _header(elements: list[_Element], text: str) -> bytes:
    """The header of a file of these elements, in the format of another."""
    written = ["ply", *text.splitlines()[1:2]]
    for element in elements:
        # By another name trimesh passes edges over.
        name = "lines" if element.name == "edge" else element.name
        written.append(f"element {name} {element.size}")
        for kind in element.properties:
            length = "" if kind.length is None else f"list {kind.length} "
            written.append(f"property {length}{kind.type} {kind.name}")
    return "\n".join([*written, "end_header", ""]).encode()


# ------------------------------------------------------------------------------------------ faces


def _face_lists(element: _Element, name: str) -> list[_Property]:
    """The lists that make a face: its corners, and their texture coordinates if it has any."""
    lists = {kind.name: kind for kind in element.properties if kind.length is not None}
    indices = [lists[key] for key in _INDICES if key in lists]
    if not indices and len(element.properties) == 1:
        indices = list(lists.values())
    if not indices:
        raise ValueError(f"{name}: wanted faces with a list {_INDICES[0]}, got none")
    return [indices[0], *([lists["texcoord"]] if "texcoord" in lists else [])]


def _check_coordinates(row: _Row, lists: list[_Property], where: str) -> None:
    """Whether a face has as many texture coordinates as its corners want."""
    size, *given = (len(row[kind.name]) for kind in lists)
    if given and given[0] != 2 * size:
        raise ValueError(
            f"{where}: wanted {2 * size} texture coordinates of {size} corners, got {given[0]}"
        )


def _cut(
    faces: list[_Row], lists: list[_Property], positions: Callable[[], np.ndarray]
) -> Iterator[list[list[Any]]]:
    """The lists of each triangle of all polygons."""
    corners = [(row, k) for row in faces for k in range(len(row[lists[0].name]))]
    polygons = [[int(vertex) for vertex in row[lists[0].name]] for row in faces]
    for triangle in triangles_in_order(positions, polygons).tolist():
        some = [corners[k] for k in triangle]
        vertices = [row[lists[0].name][k] for row, k in some]
        coordinates = [
            [row[kind.name][2 * k + axis] for row, k in some for axis in (0, 1)]
            for kind in lists[1:]
        ]
        yield [vertices, *coordinates]


def _triangles(count: int, lists: list[_Property]) -> _Element:
    return _Element("face", count, [kind._replace(length="uchar") for kind in lists])


def _positions(rows: Iterable[_Row], name: str) -> np.ndarray:
    """x, y and z of vertices."""
    try:
        places = [[row[axis][0] for axis in "xyz"] for row in rows]
    except (KeyError, IndexError) as error:
        raise ValueError(f"{name}: wanted vertices with x, y and z, got others") from error
    return np.array(places, dtype=float).reshape(-1, 3)


def _vertex_count(elements: list[_Element]) -> int:
    return sum(element.size for element in elements if element.name == "vertex")


# ------------------------------------------------------------------------------------------- text


def _plain_text(
    elements: list[_Element], lines: Iterator[tuple[int, list[str]]], number: int, name: str
) -> tuple[list[_Element], bytes]:
    bodies: list[list[str]] = []
    faces: dict[int, list[_Row]] = {}
    vertices = _vertex_count(elements)
    for position, element in enumerate(elements):
        scalars = sum(kind.length is None for kind in element.properties)
        is_face = element.name == "face" and element.size > 0
        lists = _face_lists(element, name) if is_face else []
        bodies.append([])
        for k in range(element.size):
            number, words = next_line(lines, f"{element.name} {k}", name, number)
            where = f"{name}:{number}"
            if len(words) < scalars or not all(is_finite(word) for word in words):
                raise ValueError(
                    f"{where}: wanted {scalars or 'several'} numbers for {element.name} {k}, got"
                    f" {quote(words)}"
                )
            if not is_face:
                bodies[-1].append(" ".join(words))
                continue
            row = _text_row(words, element, where, lists[0], vertices)
            _check_coordinates(row, lists, where)
            faces.setdefault(position, []).append(row)

    def positions() -> np.ndarray:
        rows = (
            _text_row(row.split(), element, name)
            for element, body in zip(elements, bodies, strict=True)
            if element.name == "vertex"
            for row in body
        )
        return _positions(rows, name)

    plain = [*elements]
    for position, rows in faces.items():
        lists = _face_lists(elements[position], name)
        bodies[position] = [
            " ".join(f"{len(values)} {' '.join(values)}" for values in triangle)
            for triangle in _cut(rows, lists, positions)
        ]
        plain[position] = _triangles(len(bodies[position]), lists)
    return plain, "\n".join([*chain.from_iterable(bodies), ""]).encode()


def _text_row(
    words: list[str],
    element: _Element,
    where: str,
    indices: _Property | None = None,
    vertices: int = 0,
) -> dict[str, list[str]]:
    """Values of an element; `indices` is the list of a face's corners, of so many vertices."""
    row: dict[str, list[str]] = {}
    rest = words
    for kind in element.properties:
        if kind == indices and rest:
            check_indices(rest, vertices, where)
        size = 1 if kind.length is None else to_count(rest[0]) if rest else -1
        rest = rest if kind.length is None else rest[1:]
        if not 0 <= size <= len(rest):
            raise ValueError(f"{where}: wanted {kind.name} of a {element.name}, got {quote(words)}")
        row[kind.name], rest = rest[:size], rest[size:]
    return row


# ----------------------------------------------------------------------------------------- binary


def _plain_binary(
    elements: list[_Element], body: bytes, order: str, name: str
) -> tuple[list[_Element], bytes]:
    at = 0
    vertices = _vertex_count(elements)
    starts: list[int] = []
    found: tuple[int, int, list[_Row]] | None = None  # faces: their element, their end, and they
    for number, element in enumerate(elements):
        starts.append(at)
        if found is None and element.name == "face" and element.size > 0:
            lists = _face_lists(element, name)
            if _are_triangles(element, body, at, order, lists[0], name):
                return elements, body
            rows: list[_Row] = []
            for row, end in _binary_rows(element, body, at, order, name):
                corners, where = row[lists[0].name], f"{name}: face {len(rows)}"
                check_indices([str(value) for value in (len(corners), *corners)], vertices, where)
                _check_coordinates(row, lists, where)
                rows.append(row)
                at = end
            found = number, at, rows
        elif any(kind.length is not None for kind in element.properties):
            for _, end in _binary_rows(element, body, at, order, name):
                at = end
        else:
            row_code = order + "".join(_CODES[kind.type] for kind in element.properties)
            at += element.size * struct.calcsize(row_code)
    if found is None:
        return elements, body

    def positions() -> np.ndarray:
        rows = (
            row
            for element, start in zip(elements, starts, strict=True)
            if element.name == "vertex"
            for row, _ in _binary_rows(element, body, start, order, name)
        )
        return _positions(rows, name)

    number, end, rows = found
    lists = _face_lists(elements[number], name)
    codes = [f"{order}B{n}{_CODES[kind.type]}" for kind, n in zip(lists, (3, 6), strict=False)]
    faces = [
        b"".join(
            struct.pack(code, len(values), *values)
            for code, values in zip(codes, triangle, strict=True)
        )
        for triangle in _cut(rows, lists, positions)
    ]
    plain = [*elements]
    plain[number] = _triangles(len(faces), lists)
    return plain, body[: starts[number]] + b"".join(faces) + body[end:]


def _binary_rows(
    element: _Element, body: bytes, at: int, order: str, name: str
) -> Iterator[tuple[_Row, int]]:
    """Values of all of an element, each with where they end."""
    for k in range(element.size):
        row, at = _binary_row(element, body, at, order, f"{name}: wanted {element.name} {k}")
        yield row, at


def _binary_row(
    element: _Element, body: bytes, at: int, order: str, wanted: str
) -> tuple[dict[str, tuple[Any, ...]], int]:
    """Values of an element, and where they end."""
    row: dict[str, tuple[Any, ...]] = {}
    try:
        for kind in element.properties:
            size = 1
            if kind.length is not None:
                (size,) = struct.unpack_from(order + _CODES[kind.length], body, at)
                at += struct.calcsize(order + _CODES[kind.length])
            code = f"{order}{size}{_CODES[kind.type]}"
            row[kind.name] = struct.unpack_from(code, body, at)
            at += struct.calcsize(code)
    except (struct.error, OverflowError) as error:
        raise ValueError(f"{wanted}, got the end of the file") from error
    return row, at


def _are_triangles(
    element: _Element, body: bytes, at: int, order: str, indices: _Property, name: str
) -> bool:
    """Whether all faces are, and their other lists are as long as those of the first."""
    first, _ = _binary_row(element, body, at, order, f"{name}: wanted face 0")
    fields: list[Any] = []
    for number, kind in enumerate(element.properties):
        if kind.length is not None:
            fields.append((f"length {number}", order + _CODES[kind.length]))
        fields.append((f"{number}", order + _CODES[kind.type], (len(first[kind.name]),)))
    dtype = np.dtype(fields)
    if len(first[indices.name]) != 3 or at + element.size * dtype.itemsize > len(body):
        return False
    rows = np.frombuffer(body, dtype, element.size, at)
    return all(
        np.all(rows[f"length {number}"] == len(first[kind.name]))
        for number, kind in enumerate(element.properties)
        if kind.length is not None
    )
