"""How a scene is rendered."""

from diffrast import _check
from diffrast._pytree import pytree_dataclass, set_field, static

SHADINGS = ("phong", "gouraud", "flat", "unlit")


@pytree_dataclass
class RenderSettings:
    """How to render. All static: another value compiles another program.

    Attributes:
        height: rows of the image.
        width: columns of the image.
        shading: "phong" interpolates normals, "gouraud" the colours of vertices, "flat" takes the
            normals of the faces, and "unlit" shows the diffuse reflectance without any light.
        cull_backfaces: drop faces whose corners turn clockwise to the viewer.
        samples: samples a pixel, a square number, on a regular grid, averaged with equal weights.
        antialias: give edges their exact share of each sample's square, and the derivative its part
            through what is visible where. Without it edges are jagged, the derivative is that of
            the shading alone, and `render` compiles in half the time.
    """

    height: int = static()
    width: int = static()
    shading: str = static(default="phong")
    cull_backfaces: bool = static(default=False)
    samples: int = static(default=1)
    antialias: bool = static(default=True)

    def __post_init__(self) -> None:
        set_field(self, "height", _check.positive_int("height", self.height))
        set_field(self, "width", _check.positive_int("width", self.width))
        _check.one_of("shading", self.shading, SHADINGS)
        set_field(self, "cull_backfaces", _check.flag("cull_backfaces", self.cull_backfaces))
        set_field(self, "antialias", _check.flag("antialias", self.antialias))
        side = round(_check.positive_int("samples", self.samples) ** 0.5)
        if side * side != self.samples:
            raise ValueError(f"samples: wanted a square number, got {self.samples}")
