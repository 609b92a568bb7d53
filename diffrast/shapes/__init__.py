"""Solids, curved surfaces, Bézier patches and the teapot; fractals and L-systems."""

from diffrast.shapes.bezier import BezierPatches as BezierPatches
from diffrast.shapes.bezier import PatchPoints as PatchPoints
from diffrast.shapes.bezier import bezier_mesh as bezier_mesh
from diffrast.shapes.bezier import evaluate as evaluate
from diffrast.shapes.bezier import parse_bezier as parse_bezier
from diffrast.shapes.curved import cone as cone
from diffrast.shapes.curved import cylinder as cylinder
from diffrast.shapes.curved import height_field as height_field
from diffrast.shapes.curved import icosphere as icosphere
from diffrast.shapes.curved import plane as plane
from diffrast.shapes.curved import torus as torus
from diffrast.shapes.curved import uv_sphere as uv_sphere
from diffrast.shapes.fractals import fractal as fractal
from diffrast.shapes.fractals import menger_sponge as menger_sponge
from diffrast.shapes.lsystem import LineDrawing as LineDrawing
from diffrast.shapes.lsystem import LSystem as LSystem
from diffrast.shapes.solids import buckyball as buckyball
from diffrast.shapes.solids import cube as cube
from diffrast.shapes.solids import dodecahedron as dodecahedron
from diffrast.shapes.solids import icosahedron as icosahedron
from diffrast.shapes.solids import octahedron as octahedron
from diffrast.shapes.solids import tetrahedron as tetrahedron
from diffrast.shapes.teapot import teapot as teapot
from diffrast.shapes.teapot import teapot_patches as teapot_patches
