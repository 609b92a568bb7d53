"""Materials of glTF files: base colours, and textures with their samplers and pictures.

trimesh rounds colours to 8 bits, and leaves out samplers, transforms and pictures that are broken.
"""

import base64
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from diffrast.files._folder import Neighbors
from diffrast.files._gltf_structure import check_index, entries
from diffrast.files._look import Look
from diffrast.files.images import decoded_picture

WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST, LINEAR = 9728, 9729
MAGNIFIED = (NEAREST, LINEAR)
MINIFIED = (NEAREST, LINEAR, 9984, 9985, 9986, 9987)  # the last four look into a pyramid

_Pixels = Float[np.ndarray, "height width channels"]


def looks_of(tree: dict[str, Any], binary: bytes, neighbors: Neighbors) -> list[Look]:
    """What a file says of its materials, by their numbers.

    The base colour of a material of KHR_materials_pbrSpecularGlossiness is the diffuse one.

    Args:
        tree: the file's JSON, checked.
        binary: the buffer of a GLB file; more may follow.
        neighbors: the files next to it.

    Raises:
        ValueError: for what glTF does not allow, without the file's name. Pictures are read later.
    """
    pictures = _pictures(tree, binary, neighbors)
    return [_look(tree, number, pictures) for number in range(len(entries(tree, "materials")))]


# --------------------------------------------------------------------------------------- details


def _look(tree: dict[str, Any], number: int, pictures: Callable[[int], _Pixels | None]) -> Look:
    material, where = entries(tree, "materials")[number], f"materials[{number}]"
    base = material.get("pbrMetallicRoughness", {})
    old = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    info = old.get("diffuseTexture", base.get("baseColorTexture"))
    color = _color(old.get("diffuseFactor", base.get("baseColorFactor")), where)
    if info is None:
        return Look(diffuse=color)
    textures = entries(tree, "textures")
    check_index(f"{where}: texture", info.get("index"), textures)
    texture, where_texture = textures[info["index"]], f"textures[{info['index']}]"
    other = texture.get("extensions", {}).get("EXT_texture_webp", {})
    source = other.get("source", texture.get("source"))
    if source is not None:
        check_index(f"{where_texture}: source", source, entries(tree, "images"))
    wrap, filter_ = _sampler(tree, texture, where_texture)
    moved = info.get("extensions", {}).get("KHR_texture_transform", {})
    coordinates = moved.get("texCoord", info.get("texCoord", 0))
    if type(coordinates) is not int or coordinates < 0:
        raise ValueError(f"{where}: wanted a whole number texCoord, got {coordinates!r}")
    return Look(
        diffuse=color,
        picture=None if source is None else functools.partial(pictures, source),
        wrap=wrap,
        filter=filter_,
        coordinates=coordinates,
        transform=_transform(moved, where),
    )


def _color(factor: Any, where: str) -> Float[np.ndarray, "3"] | None:
    """A base colour without its alpha."""
    if factor is None:
        return None
    try:
        values = np.asarray(factor, np.float32)
    except (TypeError, ValueError):
        values = np.empty(0, np.float32)
    if values.shape not in ((3,), (4,)) or not np.all(np.isfinite(values)):
        raise ValueError(f"{where}: wanted 3 or 4 numbers as a base colour, got {factor!r:.40}")
    return values[:3]


def _pictures(
    tree: dict[str, Any], binary: bytes, neighbors: Neighbors
) -> Callable[[int], _Pixels | None]:
    """Reads a picture by its number, once; gives None for a file that is not there."""

    @functools.cache
    def buffer(number: int) -> bytes:
        uri = entries(tree, "buffers")[number].get("uri")
        return binary if uri is None else _embedded(uri) or neighbors.get(uri)

    @functools.cache
    def picture(number: int) -> _Pixels | None:
        image, where = entries(tree, "images")[number], f"images[{number}]"
        if "bufferView" in image:
            views = entries(tree, "bufferViews")
            check_index(f"{where}: bufferView", image["bufferView"], views)
            view = views[image["bufferView"]]
            start = view.get("byteOffset", 0)
            content = buffer(view["buffer"])[start : start + view["byteLength"]]
            return decoded_picture(content, where)
        uri = image.get("uri")
        if not isinstance(uri, str):
            raise ValueError(f"{where}: wanted a uri or a bufferView, got neither")
        embedded = _embedded(uri)
        return neighbors.picture(uri) if embedded is None else decoded_picture(embedded, where)

    return picture


def _embedded(uri: str) -> bytes | None:
    """What a URI holds itself; None for the name of a file."""
    start, mark, data = uri.partition("base64,")
    return base64.b64decode(data) if mark and start.startswith("data:") else None


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


def _one_of(sampler: dict[str, Any], where: str, key: str, known: tuple[int, ...]) -> int | None:
    value = sampler.get(key)
    if value is not None and value not in known:
        names = ", ".join(map(str, known))
        raise ValueError(f"{where}: wanted {key} to be one of {names}, got {value!r}")
    return value
