"""Materials of OBJ files (MTL), whose comments, options and broken numbers trimesh passes over.

Read are Ka, Kd, Ks, Ns and map_Kd. Every other line is left out: `Material` has no such thing.
"""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from diffrast._tokens import is_finite
from diffrast.files._folder import Neighbors
from diffrast.files._look import Look, Picture
from diffrast.files._mesh_text import quote, statements, text_of

_COLORS = {"ka": "ambient", "kd": "diffuse", "ks": "specular"}
_NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_OPTION = re.compile(
    rf"-(?:(?P<clamp>clamp)\s+(?P<on>on|off)|(?P<key>[os])(?P<numbers>(?:\s+{_NUMBER}(?=\s)){{1,3}}))"
    r"\s+"
)
_LARGEST = float(np.finfo(np.float32).max)


def read_libraries(libraries: list[str], neighbors: Neighbors) -> dict[str, Look]:
    """The materials of all files that lines `mtllib` name, by their names.

    Of several materials of one name that of the first file is taken, there the last. Files that
    are not there are passed over.

    Raises:
        ValueError: "file:line: wanted ..., got ...", for a file that does not follow the format.
    """
    looks: dict[str, Look] = {}
    for line in libraries:
        for name, content in _files(line, neighbors):
            where = f"{neighbors.path}: {name}"
            looks = _read(text_of(content, where), where, neighbors) | looks
    return looks


def look_of(name: str | None, looks: dict[str, Look], file_name: str) -> Look:
    """The material that a line `usemtl` names; a # in the name may begin a comment."""
    if name is None:
        return Look(name=file_name)
    bare = name.partition("#")[0].strip()
    return looks.get(name, looks.get(bare, Look()))._replace(name=name)


class NumberedMaterials(Neighbors):
    """The files next to an OBJ file as trimesh sees them: one MTL, in which numbers say nothing."""

    def __init__(self, path: Path, count: int) -> None:
        super().__init__(path)
        self._text = "".join(f"newmtl {number}\n" for number in range(count)).encode()

    def get(self, name: str) -> bytes:
        return self._text

    __getitem__ = get


# --------------------------------------------------------------------------------------- details


def _files(line: str, neighbors: Neighbors) -> Iterator[tuple[str, bytes]]:
    """One file whose name may have blanks, or else several."""
    whole = neighbors.find(line)
    if whole is not None:
        yield line, whole
        return
    for name in line.split():
        content = neighbors.find(name)
        if content is not None:
            yield name, content


def _read(text: str, name: str, neighbors: Neighbors) -> dict[str, Look]:
    looks: dict[str, Look] = {}
    current = None
    for line, words in statements(text, ("newmtl", "map_kd")):
        key, where = words[0].lower(), f"{name}:{line}"
        if key == "newmtl":
            current = " ".join(words[1:])
            looks[current] = Look()
        elif key in (*_COLORS, "ns", "map_kd"):
            if current is None:
                raise ValueError(f"{where}: wanted newmtl before {words[0]}, got none")
            fields = _fields(key, words, where, neighbors)
            looks[current] = looks[current]._replace(**fields)
    return looks


def _fields(key: str, words: list[str], where: str, neighbors: Neighbors) -> dict[str, Any]:
    """Fields of a `Look` that a line gives."""
    if key == "map_kd":
        return _texture(" ".join(words[1:]), where, neighbors)
    numbers = [float(word) for word in words[1:] if is_finite(word)]
    sizes = (1,) if key == "ns" else (1, 3)
    fits = len(numbers) in sizes and len(numbers) == len(words) - 1
    if not fits or max(map(abs, numbers)) > _LARGEST:
        wanted = "1 number" if key == "ns" else "1 or 3 numbers"
        raise ValueError(f"{where}: wanted {wanted} after {words[0]}, got {quote(words[1:])}")
    if key == "ns":
        return {"shininess": numbers[0]}
    return {_COLORS[key]: np.array(np.broadcast_to(numbers, 3), np.float32)}


def _texture(text: str, where: str, neighbors: Neighbors) -> dict[str, Any]:
    """A picture; before it `-clamp on`, and `-s u v w` and `-o u v w` to scale and move uvs."""
    if not text:  # as some programs write it where there is none
        return {}
    fields: dict[str, Any] = {"wrap": None}
    values = {"s": [1.0, 1.0], "o": [0.0, 0.0]}
    while option := _OPTION.match(text):
        text = text[option.end() :]
        if option["clamp"]:
            fields["wrap"] = (("clamp" if option["on"] == "on" else "repeat"),) * 2
            continue
        numbers = [float(word) for word in option["numbers"].split()][:2]
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"{where}: wanted finite numbers, got {quote(option[0].split())}")
        values[option["key"]][: len(numbers)] = numbers
    if not text or (text.startswith("-") and neighbors.find(text) is None):
        raise ValueError(
            f"{where}: wanted a picture after -clamp on, -clamp off, and -s and -o with 1 to 3"
            f" numbers, or none of these, got {quote(text.split())}"
        )
    transform: Float[np.ndarray, "2 3"] = np.column_stack([np.diag(values["s"]), values["o"]])
    is_moved = not np.array_equal(transform, np.eye(2, 3))
    return fields | {
        "picture": _picture(text, neighbors),
        "transform": transform if is_moved else None,
    }


def _picture(name: str, neighbors: Neighbors) -> Picture:
    """Reads the picture of a name; a # in it may begin a comment."""

    def read() -> Float[np.ndarray, "height width channels"] | None:
        found = neighbors.picture(name)
        return neighbors.picture(name.partition("#")[0]) if found is None else found

    return read
