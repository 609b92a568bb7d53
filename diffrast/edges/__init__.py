"""Anti-aliased edges, and the derivative of what is visible where."""

from diffrast.edges.antialias import antialias as antialias
from diffrast.edges.antialias import antialias_image as antialias_image
from diffrast.edges.antialias import with_depth as with_depth
from diffrast.edges.blend import View as View
from diffrast.edges.shadow_pairs import Cast as Cast
