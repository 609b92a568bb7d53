"""Textures: what they are, how they are laid on surfaces, and how they are filtered."""

from diffrast.texture.kinds import AnyTexture as AnyTexture
from diffrast.texture.kinds import CubeTexture as CubeTexture
from diffrast.texture.kinds import Texture as Texture
from diffrast.texture.mapping import CubeMapping as CubeMapping
from diffrast.texture.mapping import Mapping as Mapping
from diffrast.texture.mapping import PlanarMapping as PlanarMapping
from diffrast.texture.mapping import SphereMapping as SphereMapping
from diffrast.texture.mapping import map_points as map_points
from diffrast.texture.sampling import sample_texture as sample_texture
