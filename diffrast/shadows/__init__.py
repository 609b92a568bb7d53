"""Shadows: what each light sees, and which points of the scene are among that.

`cast` draws the pictures of every light that casts shadows, for the points that a camera sees;
`receive` tells for those points, or others beside them, which lights reach them. `outlines` finds
the edges whose shadows begin between two pixels. All this is discrete: nothing here is
differentiable, and gradients are stopped at the doors. How outlines part pixels, and how they move,
is drawn by `diffrast.edges`.
"""

from diffrast.shadows.cast import Reached as Reached
from diffrast.shadows.cast import Shadows as Shadows
from diffrast.shadows.cast import cast as cast
from diffrast.shadows.cast import receive as receive
from diffrast.shadows.cast import terminators as terminators
from diffrast.shadows.outlines import Parted as Parted
from diffrast.shadows.outlines import outlines as outlines
from diffrast.shadows.outlines import parted as parted
