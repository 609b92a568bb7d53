"""Lines: plain, anti-aliased, in space before and behind triangles; drawings and wireframes."""

from diffrast.lines.drawing import FittedPoints as FittedPoints
from diffrast.lines.drawing import LineFragments as LineFragments
from diffrast.lines.drawing import draw_lines as draw_lines
from diffrast.lines.drawing import draw_lines_with_depth as draw_lines_with_depth
from diffrast.lines.drawing import fit_points as fit_points
from diffrast.lines.drawing import rasterize_lines as rasterize_lines
from diffrast.lines.wireframe import SpaceLines as SpaceLines
from diffrast.lines.wireframe import mesh_edges as mesh_edges
from diffrast.lines.wireframe import normal_lines as normal_lines
from diffrast.lines.wireframe import polygon_edges as polygon_edges
from diffrast.lines.wireframe import wireframe as wireframe
