"""Mesh files with their materials and textures, as objects of a scene (FEATURES G9, X4)."""

from pathlib import Path

import numpy as np

from diffrast._check import one_of
from diffrast.files.meshes import MeshPart, load_mesh_parts
from diffrast.material import Material
from diffrast.mesh import with_normals
from diffrast.scene import Object
from diffrast.texture import Texture
from diffrast.texture.kinds import FILTERS, wrap_pair


def load_objects(
    path: str | Path,
    *,
    filter: str | None = None,
    wrap: str | tuple[str, str] | None = None,
) -> list[Object]:
    """Read a mesh file as objects, one for each of its materials.

    An OBJ file's MTL gives ambient, diffuse and specular reflectance (Ka, Kd, Ks), shininess (Ns)
    and texture (map_Kd); glTF the base colour and its texture. Pictures are decoded from sRGB to
    linear, without their alpha; what the file does not say is as in `Material()`, but that a
    texture without a colour is shown as it is, and a highlight of no colour is none. Parts with
    one picture, filtered and wrapped alike, share one `Texture`. Meshes without normals get smooth
    ones.

    Args:
        path: the file, as for `load_mesh`.
        filter: of the textures; None for what the file says (glTF does, see `load_mesh_parts`),
            or else "bilinear".
        wrap: likewise, or else "repeat".

    Raises:
        As `load_mesh`; ValueError also for an unknown filter or wrap.
    """
    if filter is not None:
        one_of("filter", filter, FILTERS)
    if wrap is not None:
        wrap_pair(wrap)
    textures: dict[tuple[object, ...], Texture] = {}

    def texture_of(part: MeshPart) -> Texture | None:
        if part.texture is None or part.mesh.uvs is None:
            return None
        picture = np.ascontiguousarray(part.texture[..., :3])
        texture = Texture(
            picture,
            filter=(part.filter or "bilinear") if filter is None else filter,
            wrap=(part.wrap or "repeat") if wrap is None else wrap,
        )
        key = (picture.shape, picture.tobytes(), texture.filter, texture.wrap)
        return textures.setdefault(key, texture)

    def object_of(part: MeshPart) -> Object:
        texture = texture_of(part)
        given = {
            name: getattr(part, name)
            for name in ("ambient", "diffuse", "specular", "shininess")
            if getattr(part, name) is not None
        }
        if texture is not None:
            given.setdefault("diffuse", (1.0, 1.0, 1.0))
        if not np.any(given.get("specular", 0)):
            given.pop("specular", None)
        mesh = part.mesh if part.mesh.normals is not None else with_normals(part.mesh)
        return Object(mesh, Material(texture=texture, **given))

    return [object_of(part) for part in load_mesh_parts(path)]
