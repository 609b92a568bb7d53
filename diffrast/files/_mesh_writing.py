"""What `save_mesh` writes: texts with all digits, and trimesh's binary files."""

from types import ModuleType
from typing import Any

import numpy as np

from diffrast.mesh import Mesh, split_uvs


def obj_text(mesh: Mesh) -> str:
    """An OBJ file."""
    lines = _rows("v ", mesh.vertices)
    corner = "{0}"
    if mesh.uvs is not None:
        lines += _rows("vt ", mesh.uvs)
        corner = "{0}/{1}"
    if mesh.normals is not None:
        lines += _rows("vn ", mesh.normals)
        corner = "{0}/{1}/{0}" if mesh.uvs is not None else "{0}//{0}"
    uv_faces = mesh.faces if mesh.uv_faces is None else mesh.uv_faces
    both = np.stack([np.asarray(mesh.faces), np.asarray(uv_faces)], axis=-1) + 1
    for face in both.tolist():
        lines.append("f " + " ".join(corner.format(*indices) for indices in face))
    return "\n".join([*lines, ""])


def off_text(mesh: Mesh) -> str:
    """An OFF file: faces only."""
    faces = [f"3 {a} {b} {c}" for a, b, c in np.asarray(mesh.faces).tolist()]
    sizes = f"{mesh.vertices.shape[0]} {len(faces)} 0"
    return "\n".join(["OFF", sizes, *_rows("", mesh.vertices), *faces, ""])


def _rows(start: str, values: Any) -> list[str]:
    """One line for each row, with the digits that its type needs."""
    array = np.asarray(values)
    digits = 17 if array.dtype == np.float64 else 9
    return [start + " ".join(f"{x:.{digits}g}" for x in row) for row in array.tolist()]


def exported(trimesh: ModuleType, mesh: Mesh, suffix: str) -> bytes:
    """A PLY, STL, glTF or GLB file, by trimesh."""
    visual = None
    mesh = split_uvs(mesh)
    if mesh.uvs is not None:
        # One that says nothing: trimesh's own is dark, with a picture.
        material = trimesh.visual.material.PBRMaterial()
        visual = trimesh.visual.TextureVisuals(uv=np.asarray(mesh.uvs), material=material)
    geometry = trimesh.Trimesh(
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces),
        vertex_normals=None if mesh.normals is None else np.asarray(mesh.normals),
        visual=visual,
        process=False,
    )
    has_normals = mesh.normals is not None
    if suffix == ".ply":
        return bytes(geometry.export(file_type="ply", vertex_normal=has_normals))
    if suffix == ".stl":
        return bytes(geometry.export(file_type="stl"))
    if suffix == ".glb":
        return bytes(geometry.export(file_type="glb", include_normals=has_normals))
    files = geometry.export(
        file_type="gltf", include_normals=has_normals, merge_buffers=True, embed_buffers=True
    )
    return bytes(files["model.gltf"])
