"""Files in and out: images, meshes with their materials, and the thesis's scenes."""

from diffrast.files.bezier import load_bezier as load_bezier
from diffrast.files.bezier import save_bezier as save_bezier
from diffrast.files.images import load_image as load_image
from diffrast.files.images import save_animation as save_animation
from diffrast.files.images import save_image as save_image
from diffrast.files.meshes import MeshPart as MeshPart
from diffrast.files.meshes import load_mesh as load_mesh
from diffrast.files.meshes import load_mesh_parts as load_mesh_parts
from diffrast.files.meshes import save_mesh as save_mesh
from diffrast.files.objects import load_objects as load_objects
from diffrast.files.scenes import Polygons as Polygons
from diffrast.files.scenes import SceneFile as SceneFile
from diffrast.files.scenes import load_polygons as load_polygons
from diffrast.files.scenes import load_scene_file as load_scene_file
from diffrast.files.scenes import save_polygons as save_polygons
from diffrast.files.scenes import save_scene_file as save_scene_file
