"""What the JSON of a glTF file says of materials and numbers; trimesh leaves it out, or rounds it.

That is all of materials (`_gltf_materials`), which of a mesh's sets of texture coordinates they
take, in which kind of numbers these are stored, and how they are moved first
(KHR_texture_transform). The coordinates go through trimesh as an attribute of our own, and a
material is known again by its name, which is made its number. Positions and normals stored as
fractions (KHR_mesh_quantization) go through as attributes, too, and fans of triangles as strips.
"""

import json
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from diffrast.files._folder import Neighbors
from diffrast.files._gltf_materials import looks_of
from diffrast.files._gltf_structure import check_index, check_structure, entries
from diffrast.files._look import Look

_PLAIN, _NORMALIZED = "_UV", "_UV_NORMALIZED"
_FRACTIONS = {"POSITION": "_POSITION_NORMALIZED", "NORMAL": "_NORMAL_NORMALIZED"}
_FAN = "_FAN"
_STRIP_MODE, _FAN_MODE = 5, 6


def prepare(
    content: bytes, suffix: str, neighbors: Neighbors, *, need_coordinates: bool
) -> tuple[bytes, list[Look]]:
    """The file for trimesh, of materials that are only numbers, and what they are.

    The last one more is that of what has no material.

    Args:
        content: of the file.
        suffix: .gltf or .glb.
        neighbors: the files next to it.
        need_coordinates: whether a mesh must have the coordinates that its texture takes.

    Raises:
        ValueError: for JSON that says something else than glTF allows, without the file's name.
    """
    start, end = 0, len(content)
    if suffix == ".glb":  # 12 bytes of header, then length, type and data of the JSON chunk
        if content[16:20] != b"JSON":
            raise ValueError(f"wanted a first chunk of type JSON, got {content[16:20]!r}")
        start, end = 20, 20 + int.from_bytes(content[12:16], "little")
    tree = json.loads(content[start:end], parse_constant=_refuse)
    if not isinstance(tree, dict):
        raise ValueError(f"wanted a JSON object, got {tree!r:.40}")
    check_structure(tree)
    binary = content[end + 8 :] if suffix == ".glb" else b""  # what its chunk of that type holds
    looks = looks_of(tree, binary, neighbors)
    for number, mesh in enumerate(entries(tree, "meshes")):
        for primitive in mesh["primitives"]:
            where = f"meshes[{number}]"
            index = primitive.get("material")
            if index is not None:
                check_index(f"{where}: material", index, looks)
            wanted = None if index is None else looks[index].coordinates
            _mark_coordinates(tree, primitive["attributes"], wanted, where, need_coordinates)
            _mark_geometry(tree, primitive)
    plain = {key: tree[key] for key in tree if key not in ("images", "samplers", "textures")}
    text = json.dumps(plain | {"materials": [{"name": str(k)} for k in range(len(looks))]}).encode()
    if suffix == ".glb":
        text += b" " * (-len(text) % 4)
        total = len(content) - (end - start) + len(text)
        sizes = total.to_bytes(4, "little") + len(text).to_bytes(4, "little")
        text = content[:8] + sizes + content[16:20] + text + content[end:]
    return text, [*looks, Look()]


def coordinates_of(geometry: Any, look: Look) -> Float[np.ndarray, "V 2"] | None:
    """Texture coordinates of a mesh of trimesh's, v pointing up; None without any."""
    for name in (_PLAIN, _NORMALIZED):
        if name in geometry.vertex_attributes:
            break
    else:
        return None
    found = np.asarray(geometry.vertex_attributes[name])
    uvs = found.astype(np.float32)[:, :2]
    if name == _NORMALIZED:
        uvs = _fractions(found)[:, :2]
    uvs = look.moved(uvs)
    return np.stack([uvs[:, 0], 1 - uvs[:, 1]], axis=1)


def vectors_of(geometry: Any, name: str, stored: np.ndarray) -> Float[np.ndarray, "V 3"]:
    """POSITION or NORMAL of a mesh of trimesh's, which are stored as they are, or as fractions."""
    found = geometry.vertex_attributes.get(_FRACTIONS[name])
    return stored if found is None else _fractions(np.asarray(found))


def faces_of(geometry: Any) -> Int[np.ndarray, "F 3"]:
    """Triangles of a mesh of trimesh's."""
    faces = np.array(geometry.faces)
    if _FAN not in geometry.vertex_attributes or len(faces) == 0:
        return faces
    # Of a strip a, b, c, d, ... they are abc, dcb, cde, ...; a fan's are abc, acd, ade, ...
    second = faces[:, 1]
    third = np.append(second[1:], faces[-1, 2 if len(faces) % 2 else 0])
    return np.stack([np.full_like(second, faces[0, 0]), second, third], axis=1)


# --------------------------------------------------------------------------------------- details


def _mark_coordinates(
    tree: dict[str, Any],
    attributes: dict[str, Any],
    wanted: int | None,
    where: str,
    needed: bool,
) -> None:
    """Name the coordinates that the texture takes, or else the first ones, as our own."""
    name = f"TEXCOORD_{wanted or 0}"
    if name not in attributes:
        if wanted is not None and needed:
            known = [key for key in attributes if key.startswith("TEXCOORD_")]
            raise ValueError(f"{where}: wanted {name} for its texture, got {known or 'none'}")
        name = "TEXCOORD_0"
    attributes.pop(_PLAIN, None)
    attributes.pop(_NORMALIZED, None)
    if name in attributes:
        accessors = entries(tree, "accessors")
        check_index(f"{where}: {name}", attributes[name], accessors)
        normalized = accessors[attributes[name]].get("normalized", False)
        attributes[_NORMALIZED if normalized else _PLAIN] = attributes[name]


def _mark_geometry(tree: dict[str, Any], primitive: dict[str, Any]) -> None:
    """Name what is stored as fractions as our own, and a fan that is to pass as a strip."""
    attributes = primitive["attributes"]
    attributes.pop(_FAN, None)
    for name, own in _FRACTIONS.items():
        attributes.pop(own, None)
        if name in attributes and entries(tree, "accessors")[attributes[name]].get("normalized"):
            attributes[own] = attributes[name]
    if primitive.get("mode") == _FAN_MODE:
        primitive["mode"] = _STRIP_MODE
        attributes[_FAN] = attributes["POSITION"]


def _fractions(found: np.ndarray) -> Float[np.ndarray, "V columns"]:
    """Integers as fractions of their largest."""
    return np.maximum(found.astype(np.float32) / np.iinfo(found.dtype).max, -1)


def _refuse(constant: str) -> None:
    raise ValueError(f"wanted a number, got {constant}")
