"""Differentiable, vectorised triangle rasteriser.

The way of the data::

    mesh, transforms ──► world positions
    camera           ──► clip positions            linalg, camera
                         coverage, 1/z resolve     raster: which face each pixel sees
                         interpolation             interpolate: attributes of the visible points
    lights, materials ─► shading                   light, material, shade
                         edges                     edges: exact areas, and their derivative
                         image ──► loss ──► fit    render, fit

`render(scene, camera, settings)` runs all of it; each stage can be used alone, with a JAX function
of one's own in the place of any other.
"""

from diffrast import clip as clip
from diffrast import color as color
from diffrast import fit as fit
from diffrast import linalg as linalg
from diffrast import lines as lines
from diffrast import mesh as mesh
from diffrast import shapes as shapes
from diffrast import views as views
from diffrast.camera import Camera as Camera
from diffrast.camera import clip_to_pixel as clip_to_pixel
from diffrast.camera import stack_cameras as stack_cameras
from diffrast.camera import viewpoint as viewpoint
from diffrast.camera import world_to_clip as world_to_clip
from diffrast.color import LookUpTable as LookUpTable
from diffrast.color import look_up as look_up
from diffrast.edges import antialias as antialias
from diffrast.files import load_bezier as load_bezier
from diffrast.files import load_image as load_image
from diffrast.files import load_mesh as load_mesh
from diffrast.files import load_objects as load_objects
from diffrast.files import load_polygons as load_polygons
from diffrast.files import save_animation as save_animation
from diffrast.files import save_image as save_image
from diffrast.files import save_mesh as save_mesh
from diffrast.interpolate import interpolate as interpolate
from diffrast.interpolate import screen_derivatives as screen_derivatives
from diffrast.light import AmbientLight as AmbientLight
from diffrast.light import Attenuation as Attenuation
from diffrast.light import DirectionalLight as DirectionalLight
from diffrast.light import PointLight as PointLight
from diffrast.light import Shadow as Shadow
from diffrast.light import SpotLight as SpotLight
from diffrast.lines import LineFragments as LineFragments
from diffrast.lines import draw_lines as draw_lines
from diffrast.lines import draw_lines_with_depth as draw_lines_with_depth
from diffrast.lines import rasterize_lines as rasterize_lines
from diffrast.lines import wireframe as wireframe
from diffrast.material import Material as Material
from diffrast.mesh import Mesh as Mesh
from diffrast.raster import Fragments as Fragments
from diffrast.raster import rasterize as rasterize
from diffrast.recolor import depths as depths
from diffrast.recolor import light_cosines as light_cosines
from diffrast.recolor import recolor as recolor
from diffrast.render import Buffers as Buffers
from diffrast.render import render as render
from diffrast.render import render_buffers as render_buffers
from diffrast.render import shadow_outlines as shadow_outlines
from diffrast.scene import Object as Object
from diffrast.scene import Scene as Scene
from diffrast.scene_files import read_scene as read_scene
from diffrast.scene_files import render_scene_file as render_scene_file
from diffrast.settings import RenderSettings as RenderSettings
from diffrast.shapes import LSystem as LSystem
from diffrast.texture import CubeMapping as CubeMapping
from diffrast.texture import CubeTexture as CubeTexture
from diffrast.texture import PlanarMapping as PlanarMapping
from diffrast.texture import SphereMapping as SphereMapping
from diffrast.texture import Texture as Texture
from diffrast.texture import map_points as map_points
from diffrast.texture import sample_texture as sample_texture
from diffrast.views import render_views as render_views
