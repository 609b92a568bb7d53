"""Shadows: what each light sees, and which points of the scene are among that.

`cast` draws the pictures of every light that casts shadows, for the points that a camera sees;
`receive` tells for those points, or others beside them, which lights reach them. Both are discrete:
nothing here is differentiable, and gradients are stopped at the doors.
"""

from diffrast.shadows.cast import Reached as Reached
from diffrast.shadows.cast import Shadows as Shadows
from diffrast.shadows.cast import cast as cast
from diffrast.shadows.cast import receive as receive
