"""x."""
from diffrast.raster import rasterize, Fragments
from diffrast.interpolate import interpolate
