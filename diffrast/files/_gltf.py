"""What the JSON of a glTF file says of textures and numbers; trimesh leaves it out.

That is how a texture is repeated and filtered (its sampler), which of a mesh's sets of texture
coordinates it takes, in which kind of numbers they are stored, and how they are moved first
(KHR_texture_transform). The coordinates go through trimesh as an attribute of our own, and a
material is known again by its name, which is made its number. Positions and normals stored as
fractions (KHR_mesh_quantization) go through as attributes, too, and fans of triangles as strips.
"""

import json
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffrast.files._gltf_structure import check_index, check_structure, entries

WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST, LINEAR = 9728, 9729
MAGNIFIED = (NEAREST, LINEAR)
MINIFIED = (NEAREST, LINEAR, 9984, 9985, 9986, 9987)  # the last four look into a pyramid

_PLAIN, _NORMALIZED = "_UV", "_UV_NORMALIZED"
_FRACTIONS = {"POSITION": "_POSITION_NORMALIZED", "NORMAL": "_NORMAL_NORMALIZED"}
_FAN = "_FAN"
_STRIP_MODE, _FAN_MODE = 5, 6


class TextureUse(NamedTuple):
    """How a material looks at its texture.

    Attributes:
        wrap: along u and v.
        filter: the nearest that a `Texture` has; None if the file leaves it open.
        coordinates: number of the set of texture coordinates.
        transform: (2, 3) what is done to those, v pointing down; None for nothing.
    """

    wrap: tuple[str, str]
    filter: str | None
    coordinates: int
    transform: Float[np.ndarray, "2 3"] | None


def prepare(
    content: bytes, suffix: str, *, need_coordinates: bool
) -> tuple[bytes, list[TextureUse | None]]:
    """The file for trimesh, and the use of a texture in each material.

    Args:
        content: of the file.
        suffix: .gltf or .glb.
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
    uses = [_use(tree, number) for number in range(len(entries(tree, "materials")))]
    for number, material in enumerate(entries(tree, "materials")):
        material["name"] = str(number)
    for number, mesh in enumerate(entries(tree, "meshes")):
        for primitive in mesh["primitives"]:
            where = f"meshes[{number}]"
            index = primitive.get("material")
            if index is not None:
                check_index(f"{where}: material", index, uses)
            use = None if index is None else uses[index]
            _mark_coordinates(tree, primitive["attributes"], use, where, need_coordinates)
            _mark_geometry(tree, primitive)
    text = json.dumps(tree).encode()
    if suffix == ".gltf":
        return text, uses
    text += b" " * (-len(text) % 4)
    total = len(content) - (end - start) + len(text)
    sizes = (total.to_bytes(4, "little"), len(text).to_bytes(4, "little"))
    return content[:8] + sizes[0] + sizes[1] + content[16:20] + text + content[end:], uses


def coordinates_of(geometry: Any, use: TextureUse | None) -> Float[np.ndarray, "V 2"] | None:
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
    if use is not None and use.transform is not None:
        uvs = (uvs @ use.transform[:, :2].T + use.transform[:, 2]).astype(np.float32)
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


def use_of(geometry: Any, uses: list[TextureUse | None]) -> TextureUse | None:
    """The use of a texture in the material of a mesh of trimesh's; None without a texture."""
    name = getattr(getattr(geometry.visual, "material", None), "name", None)
    if not isinstance(name, str) or not name.isdigit():
        return None
    return uses[int(name)]


# --------------------------------------------------------------------------------------- details


def _use(tree: dict[str, Any], number: int) -> TextureUse | None:
    """What a material says of the texture that trimesh gives it."""
    material = entries(tree, "materials")[number]
    where = f"materials[{number}]"
    old = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    info = old.get("diffuseTexture")
    if info is None:
        info = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
    if info is None:
        return None
    textures = entries(tree, "textures")
    check_index(f"{where}: texture", info.get("index"), textures)
    if "source" in textures[info["index"]]:
        picture = textures[info["index"]]["source"]
        check_index(f"textures[{info['index']}]: source", picture, entries(tree, "images"))
    wrap, filter_ = _sampler(tree, textures[info["index"]], f"textures[{info['index']}]")
    moved = info.get("extensions", {}).get("KHR_texture_transform", {})
    coordinates = moved.get("texCoord", info.get("texCoord", 0))
    if type(coordinates) is not int or coordinates < 0:
        raise ValueError(f"{where}: wanted a whole number texCoord, got {coordinates!r}")
    return TextureUse(wrap, filter_, coordinates, _transform(moved, where))


def _sampler(
    tree: dict[str, Any], texture: dict[str, Any], where: str
) -> tuple[tuple[str, str], str | None]:
    """Wraps, and the filter.

    A `Texture` has one filter for both sizes: "nearest" if larger texels are to be seen, else
    "trilinear" if smaller ones come from a pyramid, whichever way they are blended.
    """
    sampler: dict[str, Any] = {}
    if "sampler" in texture:
        samplers = entries(tree, "samplers")
        check_index(f"{where}: sampler", texture["sampler"], samplers)
        sampler, where = samplers[texture["sampler"]], f"samplers[{texture['sampler']}]"
    u, v = (_one_of(sampler, where, key, tuple(WRAPS)) or 10497 for key in ("wrapS", "wrapT"))
    larger = _one_of(sampler, where, "magFilter", MAGNIFIED)
    smaller = _one_of(sampler, where, "minFilter", MINIFIED)
    if larger is None and smaller is None:
        return (WRAPS[u], WRAPS[v]), None
    if larger == NEAREST or (larger is None and smaller == NEAREST):
        return (WRAPS[u], WRAPS[v]), "nearest"
    pyramid = smaller is not None and smaller not in MAGNIFIED
    return (WRAPS[u], WRAPS[v]), "trilinear" if pyramid else "bilinear"


def _transform(moved: dict[str, Any], where: str) -> Float[np.ndarray, "2 3"] | None:
    """Scale, then turn, then shift; a positive angle turns u towards where v decreases."""
    if not any(key in moved for key in ("offset", "rotation", "scale")):
        return None

    def numbers(key: str, default: Any) -> np.ndarray:
        try:
            values = np.asarray(moved.get(key, default), np.float64)
        except (TypeError, ValueError):
            values = np.full((), np.nan)
        if values.shape != np.shape(default) or not np.all(np.isfinite(values)):
            wanted = "two numbers" if np.ndim(default) else "a number"
            raise ValueError(f"{where}: wanted {wanted} as {key}, got {moved[key]!r}")
        return values

    angle, scale = numbers("rotation", 0.0), numbers("scale", (1.0, 1.0))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return np.column_stack([turn * scale, numbers("offset", (0.0, 0.0))])


def _mark_coordinates(
    tree: dict[str, Any],
    attributes: dict[str, Any],
    use: TextureUse | None,
    where: str,
    needed: bool,
) -> None:
    """Name the coordinates that the texture takes, or else the first ones, as our own."""
    name = f"TEXCOORD_{0 if use is None else use.coordinates}"
    if name not in attributes:
        if use is not None and needed:
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


def _one_of(sampler: dict[str, Any], where: str, key: str, known: tuple[int, ...]) -> int | None:
    value = sampler.get(key)
    if value is not None and value not in known:
        names = ", ".join(map(str, known))
        raise ValueError(f"{where}: wanted {key} to be one of {names}, got {value!r}")
    return value
