"""Files in and out: images, meshes, and the thesis's scenes."""

from diffrast.files.images import load_image as load_image
from diffrast.files.images import save_animation as save_animation
from diffrast.files.images import save_image as save_image
