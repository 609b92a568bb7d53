"""Meshes in and out: OBJ, PLY, STL, OFF, glTF and GLB (FEATURES G9).

Reading goes through trimesh, an optional dependency (`pip install diffrast[mesh]`), told to
change nothing: no merging, no reordering, no guessing of normals. `diffrast.files._mesh_text`
and `._ply` check text formats first, cut polygons into triangles, and read OFF. Of materials
trimesh sees only numbers; `diffrast.files._mtl`, `._gltf_materials` and `._ply` read what these
are.
"""

import dataclasses
import functools
import io
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from diffrast._check import file_path, instance_of
from diffrast.files import _gltf
from diffrast.files._folder import Neighbors
from diffrast.files._look import Look
from diffrast.files._mesh_text import (
    check_ascii_stl,
    plain_obj,
    read_off,
    text_of,
)
from diffrast.files._mesh_writing import exported, obj_text, off_text
from diffrast.files._mtl import NumberedMaterials, look_of, read_libraries
from diffrast.files._ply import plain_ply, texture_name
from diffrast.linalg import normalize
from diffrast.mesh import Mesh, merge, transform, with_normals

SUFFIXES = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")


class MeshPart(NamedTuple):
    """The faces of a file that share a material; what the file does not say is `None`.

    `name` is that of the material in OBJ files (of the file for faces of none), else of the
    geometry; `wrap` and `filter` are those of a `Texture`.
    """

    name: str
    mesh: Mesh
    ambient: Float[np.ndarray, "3"] | None = None
    diffuse: Float[np.ndarray, "3"] | None = None
    specular: Float[np.ndarray, "3"] | None = None
    shininess: float | None = None
    texture: Float[np.ndarray, "height width channels"] | None = None
    wrap: tuple[str, str] | None = None
    filter: str | None = None


def load_mesh(path: str | Path) -> Mesh:
    """Read a mesh from an OBJ, PLY, STL, OFF, glTF or GLB file.

    Polygons are cut into fans, concave ones ear by ear, and several geometries are merged in their
    places. Vertex normals and texture coordinates are those of the file, else `None`
    (`with_normals` makes smooth normals); where only some geometries have them the others get
    area-weighted normals, or uv (0, 0). Those of an OBJ file are what shares a material: it has
    normals or uvs where all its corners have them. An OBJ vertex that occurs with several texture
    coordinates or normals is split. STL files hold triangles with their own corners and no vertex
    normals. Points, lines, colours and material files are left out.

    Args:
        path: the file; its suffix names the format.

    Raises:
        ImportError: when trimesh is not installed (all but OFF).
        ValueError: with the file's name, and the line in text formats, for an unknown suffix, a
            broken file, or a file without faces.
        OSError: when the file cannot be opened.
    """
    parts, order = _read_parts(file_path("path", path), materials=False)
    mesh = _merged([part.mesh for part in parts])
    if order is None:
        return mesh
    return dataclasses.replace(mesh, faces=mesh.faces[order], topology=None)


def load_mesh_parts(path: str | Path) -> list[MeshPart]:
    """Read a mesh with its materials, one part for each.

    Colours (of an OBJ file's MTL: Ka, Kd, Ks, Ns; of glTF: the base colour) are the file's
    numbers. Textures (map_Kd, base colour, TextureFile of PLY) are linear RGB or RGBA as
    `load_image` reads them, row 0 at the top; v of the uvs points up. A material file or picture
    that is not found in the file's folder, or below, leaves `None`. Nothing else that a material
    says is read.

    Of the options of map_Kd -clamp says the wrap, -s scales the uvs and -o moves them then; others
    are an error.

    A glTF texture has the wraps of its sampler, and of its filters the nearest one: "nearest" if
    its texels are to be seen from nearby, else "trilinear" if it has smaller images for afar, else
    "bilinear"; None if the file leaves that open. The uvs are those that it asks for (`texCoord`),
    after its KHR_texture_transform.

    Raises:
        As `load_mesh`; ValueError also for a material file or a picture that is broken, and for a
            glTF mesh without the coordinates its texture takes.
    """
    return _read_parts(file_path("path", path), materials=True)[0]


def save_mesh(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh in the format that the file's suffix names.

    OBJ, PLY, glTF and GLB hold normals and texture coordinates, OFF and STL only faces; all but OBJ
    split vertices that have several texture coordinates. Text
    formats have enough digits to read the same numbers back; binary ones hold float32.

    Raises:
        ImportError: when trimesh is not installed (PLY, STL, glTF, GLB).
        ValueError: for an unknown suffix.
        OSError: when the file cannot be written.
    """
    path = file_path("path", path)
    instance_of("mesh", mesh, Mesh)
    suffix = _known_suffix(path)
    if suffix == ".obj":
        path.write_text(obj_text(mesh), encoding="ascii")
    elif suffix == ".off":
        path.write_text(off_text(mesh), encoding="ascii")
    else:
        with _quiet_trimesh() as trimesh:
            content = exported(trimesh, mesh, suffix)
        path.write_bytes(content)


# --------------------------------------------------------------------------------------- reading


class _Source(NamedTuple):
    """What to give to trimesh.

    Attributes:
        content: of a file.
        options: of trimesh's reader.
        looks: of materials by number, the last that of what has no material.
        order: of the file's triangles, their places in all parts together; None for as they come.
    """

    content: bytes
    options: dict[str, Any]
    looks: list[Look]
    order: Int[np.ndarray, " F"] | None = None


def _read_parts(
    path: Path, *, materials: bool
) -> tuple[list[MeshPart], Int[np.ndarray, " F"] | None]:
    """The parts of a mesh, and what `_Source` calls order."""
    suffix = _known_suffix(path)
    content = path.read_bytes()
    if suffix == ".off":
        return [MeshPart("geometry_0", _off_mesh(content, path))], None
    neighbors, is_gltf = Neighbors(path), suffix in (".glb", ".gltf")
    with _quiet_trimesh() as trimesh:
        source = _checked(content, suffix, neighbors, materials)
        try:
            if is_gltf:
                content, looks = _gltf.prepare(
                    content, suffix, neighbors, need_coordinates=materials
                )
                source = _Source(content, {}, looks)
            scene = trimesh.load_scene(
                io.BytesIO(source.content),
                file_type=suffix[1:],
                process=False,
                **({"resolver": neighbors} | source.options),
            )
            looks = source.looks
            parts = list(_scene_parts(trimesh, scene, looks, is_gltf=is_gltf, pictures=materials))
        # A reader of foreign data fails in any way: KeyError, struct.error, MemoryError, ...
        except Exception as error:
            kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
            raise ValueError(
                f"{path}: cannot be read as {suffix[1:].upper()} ({kind}{error})"
            ) from error
    if not parts:
        raise ValueError(f"{path}: wanted a mesh with faces, got none")
    if suffix == ".obj":
        parts.reverse()  # trimesh takes materials from the end
    return parts, source.order


def _checked(content: bytes, suffix: str, neighbors: Neighbors, materials: bool) -> _Source:
    """Check text formats."""
    name = str(neighbors.path)
    if suffix == ".obj":
        obj = plain_obj(text_of(content, name), name, keep_materials=materials)
        # Keeping the order is right only where there is nothing to split vertices for.
        plain = "/" not in obj.text.partition("\nf ")[2]
        options = {"maintain_order": plain, "skip_materials": not materials}
        if not materials:
            order = None
            if any(obj.numbers):
                order = np.argsort(np.argsort(obj.numbers, kind="stable"))
            return _Source(obj.text.encode(), options, [Look()], order)
        looks = read_libraries(obj.libraries, neighbors)
        numbers = NumberedMaterials(neighbors.path, len(obj.materials))
        text = f"mtllib numbers\n{obj.text}"
        found = [look_of(material, looks, neighbors.file_name) for material in obj.materials]
        return _Source(text.encode(), options | {"resolver": numbers}, [*found, Look()])
    if suffix == ".ply":
        picture = texture_name(content, name) if materials else None
        content = plain_ply(content, name)
        own_uvs = b"texcoord" in content.partition(b"end_header")[0]
        read = None if picture is None else functools.partial(neighbors.picture, picture)
        return _Source(content, {"fix_texture": own_uvs}, [Look(picture=read)])
    if suffix == ".stl" and len(content) != (wanted := _size_of_binary_stl(content)):
        if b"\0" in content:
            raise ValueError(
                f"{name}: wanted {wanted} bytes, for a header that announces {(wanted - 84) // 50}"
                f" triangles, got {len(content)}"
            )
        text = text_of(content, name)
        check_ascii_stl(text, name)
        content = text.encode()
    return _Source(content, {}, [Look()])


def _size_of_binary_stl(content: bytes) -> int:
    return 84 + 50 * int.from_bytes(content[80:84], "little")


def _off_mesh(content: bytes, path: Path) -> Mesh:
    read = read_off(text_of(content, str(path)), str(path))
    if len(read.faces) == 0:
        raise ValueError(f"{path}: wanted a mesh with faces, got none")
    try:
        mesh = Mesh(**read._asdict())
    except ValueError as error:  # numbers beyond 32 bits
        raise ValueError(f"{path}: cannot be read as OFF ({error})") from error
    if mesh.normals is None:
        return mesh
    return dataclasses.replace(mesh, normals=normalize(mesh.normals))


def _scene_parts(
    trimesh: ModuleType, scene: Any, looks: list[Look], *, is_gltf: bool, pictures: bool
) -> Iterator[MeshPart]:
    """The parts of a scene; `looks` as in `_Source`, `pictures` says whether to read textures."""
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not isinstance(geometry, trimesh.Trimesh) or len(geometry.faces) == 0:
            continue
        material = getattr(getattr(geometry.visual, "material", None), "name", None)
        named = isinstance(material, str) and material.isdigit()
        look = looks[int(str(material)) if named else -1]
        if is_gltf:
            uvs = _gltf.coordinates_of(geometry, look)
        else:
            uvs = getattr(geometry.visual, "uv", None)
            uvs = None if uvs is None else look.moved(np.array(uvs)[:, :2])
        mesh = _converted(geometry, uvs, is_gltf=is_gltf)
        if not np.array_equal(matrix, np.eye(4)):
            mesh = transform(mesh, matrix)
        yield _part(look.name or name, mesh, look, pictures)


def _part(name: str, mesh: Mesh, look: Look, pictures: bool) -> MeshPart:
    texture = look.picture() if pictures and look.picture is not None else None
    return MeshPart(
        name=name,
        mesh=mesh,
        ambient=look.ambient,
        diffuse=look.diffuse,
        specular=look.specular,
        shininess=look.shininess,
        texture=texture,
        wrap=None if texture is None else look.wrap,
        filter=None if texture is None else look.filter,
    )


def _converted(geometry: Any, uvs: Any, *, is_gltf: bool) -> Mesh:
    vertices, faces = np.array(geometry.vertices), np.array(geometry.faces)
    normals = None
    # `vertex_normals` would be computed where the file has none; its cache tells.
    if "vertex_normals" in geometry._cache:
        normals = np.array(geometry.vertex_normals)
    if is_gltf:
        faces = _gltf.faces_of(geometry)
        vertices = _gltf.vectors_of(geometry, "POSITION", vertices)
        if normals is not None:
            normals = _gltf.vectors_of(geometry, "NORMAL", normals)
    return Mesh(
        vertices=vertices,
        faces=faces,
        normals=None if normals is None else normalize(normals),
        uvs=uvs,
    )


def _merged(meshes: list[Mesh]) -> Mesh:
    if len(meshes) == 1:
        return meshes[0]
    if any(mesh.normals is not None for mesh in meshes):
        meshes = [mesh if mesh.normals is not None else with_normals(mesh) for mesh in meshes]
    if any(mesh.uvs is not None for mesh in meshes):
        meshes = [mesh if mesh.uvs is not None else _with_zero_uvs(mesh) for mesh in meshes]
    return merge(meshes)


def _with_zero_uvs(mesh: Mesh) -> Mesh:
    uvs = jnp.zeros_like(mesh.vertices[:, :2])
    return Mesh(vertices=mesh.vertices, faces=mesh.faces, normals=mesh.normals, uvs=uvs)


# --------------------------------------------------------------------------------------- helpers


def _known_suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: wanted a suffix among {', '.join(SUFFIXES)}, got {suffix!r}")
    return suffix


@contextmanager
def _quiet_trimesh() -> Iterator[ModuleType]:
    """Import trimesh, and keep it from logging and warning.

    One warning is an error instead: that numbers end in something that is not one.
    """
    logger = logging.getLogger("trimesh")
    was_disabled = logger.disabled
    logger.disabled = True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", message="string or file could not be read to its end")
            try:
                import trimesh
            except ImportError as error:
                raise ImportError(
                    "reading and writing mesh files needs trimesh: pip install diffrast[mesh]"
                ) from error
            yield trimesh
    finally:
        logger.disabled = was_disabled
