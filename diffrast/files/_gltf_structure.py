"""Whether the parts of a glTF file fit together, before anything is read by them.

trimesh takes counts, offsets and indices as they come: it would fill memory for a count that no
buffer backs, count negative indices from the end, and lose its way where nodes contain each other.
"""

from importlib import util
from typing import Any

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_UNSIGNED = (5121, 5123, 5125)
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_LISTS = (
    "accessors",
    "bufferViews",
    "buffers",
    "images",
    "materials",
    "meshes",
    "nodes",
    "samplers",
    "scenes",
    "textures",
)
_DRACO = "KHR_draco_mesh_compression"
_EXTENSIONS = (  # that are read, with Draco's where its decoder is installed
    "EXT_texture_webp",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
)
_MODES = 7  # points, three kinds of lines, triangles, strips and fans of them


def check_structure(tree: dict[str, Any]) -> None:
    """Check sizes, offsets, indices, extensions that are needed, and that nodes form trees.

    Raises:
        ValueError: for anything that glTF does not allow, without the file's name.
    """
    _check_extensions(tree)
    for key in _LISTS:
        _check_list(tree, key)
    for number in range(len(entries(tree, "bufferViews"))):
        _check_view(tree, number)
    for number in range(len(entries(tree, "accessors"))):
        _check_accessor(tree, number)
    for number, mesh in enumerate(entries(tree, "meshes")):
        for primitive in _check_list(mesh, "primitives", f"meshes[{number}]: "):
            _check_primitive(tree, primitive, f"meshes[{number}]")
    _check_nodes(tree)


def entries(tree: dict[str, Any], key: str) -> list[Any]:
    """One of the file's lists of objects, empty if it is not there; checked once for all."""
    found: list[Any] = tree.get(key, [])
    return found


def check_index(name: str, index: Any, found: list[Any]) -> None:
    """Check an index into a list."""
    if type(index) is not int or not 0 <= index < len(found):
        raise ValueError(f"{name}: wanted an index in [0, {len(found)}), got {index!r:.40}")


# --------------------------------------------------------------------------------------- details


def _check_list(tree: dict[str, Any], key: str, where: str = "") -> list[Any]:
    found = tree.get(key, [])
    if not isinstance(found, list) or not all(isinstance(entry, dict) for entry in found):
        raise ValueError(f"{where}{key}: wanted a list of objects, got {found!r:.40}")
    return found


def _check_extensions(tree: dict[str, Any]) -> None:
    required = tree.get("extensionsRequired", [])
    if not isinstance(required, list):
        raise ValueError(f"extensionsRequired: wanted a list of names, got {required!r:.40}")
    known = (*_EXTENSIONS, *([_DRACO] if _decodes_draco() else []))
    for name in required:
        if name not in known:
            raise ValueError(
                f"extensionsRequired: wanted extensions among {', '.join(known)}, got {name!r:.80}"
            )


def _decodes_draco() -> bool:
    return util.find_spec("DracoPy") is not None


def _natural(entry: dict[str, Any], key: str, where: str, default: int | None = None) -> int:
    value = entry.get(key, default)
    if type(value) is not int or value < 0:
        raise ValueError(f"{where}: wanted a whole number {key}, got {value!r:.40}")
    return value


def _check_view(tree: dict[str, Any], number: int) -> None:
    view, where = entries(tree, "bufferViews")[number], f"bufferViews[{number}]"
    buffers = entries(tree, "buffers")
    check_index(f"{where}: buffer", view.get("buffer"), buffers)
    length = _natural(buffers[view["buffer"]], "byteLength", f"buffers[{view['buffer']}]")
    end = _natural(view, "byteOffset", where, 0) + _natural(view, "byteLength", where)
    if end > length:
        raise ValueError(
            f"{where}: wanted an end within the {length} bytes of buffers[{view['buffer']}], got"
            f" {end}"
        )


def _check_accessor(tree: dict[str, Any], number: int) -> None:
    accessor, where = entries(tree, "accessors")[number], f"accessors[{number}]"
    for key, known in (("componentType", _COMPONENT_BYTES), ("type", _COMPONENTS)):
        if not isinstance(accessor.get(key), int | str) or accessor[key] not in known:
            names = ", ".join(map(str, known))
            raise ValueError(
                f"{where}: wanted {key} to be one of {names}, got {accessor.get(key)!r:.40}"
            )
    size = _COMPONENT_BYTES[accessor["componentType"]] * _COMPONENTS[accessor["type"]]
    count = _natural(accessor, "count", where)
    if "bufferView" not in accessor:
        # Whoever needs it is refused or brings its own values; trimesh makes as many zeros.
        accessor["count"] = 1
        return
    views = entries(tree, "bufferViews")
    check_index(f"{where}: bufferView", accessor["bufferView"], views)
    view = views[accessor["bufferView"]]
    stride = _natural(view, "byteStride", f"bufferViews[{accessor['bufferView']}]", size)
    if stride < size:
        raise ValueError(f"{where}: wanted a byteStride of at least {size}, got {stride}")
    end = _natural(accessor, "byteOffset", where, 0) + max(0, (count - 1) * stride + size)
    if count > 0 and end > view["byteLength"]:
        raise ValueError(
            f"{where}: wanted an end within the {view['byteLength']} bytes of"
            f" bufferViews[{accessor['bufferView']}], got {end}"
        )


def _check_primitive(tree: dict[str, Any], primitive: dict[str, Any], where: str) -> None:
    accessors = entries(tree, "accessors")
    attributes, extensions = primitive.get("attributes"), primitive.get("extensions", {})
    if not isinstance(attributes, dict) or not isinstance(extensions, dict):
        raise ValueError(f"{where}: wanted objects as attributes and extensions of its primitives")
    mode = primitive.get("mode", 4)
    if type(mode) is not int or not 0 <= mode < _MODES:
        raise ValueError(f"{where}: wanted a mode in [0, {_MODES}), got {mode!r:.40}")
    used = dict(attributes)
    if "indices" in primitive:
        used["indices"] = primitive["indices"]
    for name, index in used.items():
        check_index(f"{where}: {name}", index, accessors)
        decoded = _DRACO in extensions and _decodes_draco()
        if not decoded and ("bufferView" not in accessors[index] or "sparse" in accessors[index]):
            raise ValueError(
                f"{where}: wanted plain values as {name}, got compressed or sparse ones, or none"
            )
    if "indices" in primitive:
        accessor = accessors[primitive["indices"]]
        if accessor["type"] != "SCALAR" or accessor["componentType"] not in _UNSIGNED:
            raise ValueError(
                f"{where}: wanted indices of type SCALAR and componentType"
                f" {', '.join(map(str, _UNSIGNED))}, got {accessor['type']} and"
                f" {accessor['componentType']}"
            )


def _check_nodes(tree: dict[str, Any]) -> None:
    """Each node has one place: then those that hang on the scene's roots form trees."""
    nodes, scenes = entries(tree, "nodes"), entries(tree, "scenes")
    lists = [(f"nodes[{number}]", node.get("children", [])) for number, node in enumerate(nodes)]
    for number, node in enumerate(nodes):
        if "mesh" in node:
            check_index(f"nodes[{number}]: mesh", node["mesh"], entries(tree, "meshes"))
    if scenes:
        check_index("scene", tree.get("scene", 0), scenes)
        number = tree.get("scene", 0)
        lists.append((f"scenes[{number}]", scenes[number].get("nodes", [])))
    owners: dict[int, str] = {}
    for where, children in lists:
        if not isinstance(children, list):
            raise ValueError(f"{where}: wanted a list of nodes, got {children!r:.40}")
        for child in children:
            check_index(f"{where}: node", child, nodes)
            if child in owners:
                raise ValueError(
                    f"nodes: wanted trees, got nodes[{child}] in {owners[child]} and in {where}"
                )
            owners[child] = where
