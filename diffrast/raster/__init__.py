"""From clip positions to fragments: which face a pixel sees, and where on it.

`fixed_point` puts vertices on the sub-pixel grid and sorts faces by the work they need, `coverage`
draws them into a depth buffer, and `fragments` evaluates barycentrics and depth of the chosen faces
again by ordinary differentiable expressions.
"""

from diffrast.raster.fragments import Fragments as Fragments
from diffrast.raster.fragments import rasterize as rasterize
