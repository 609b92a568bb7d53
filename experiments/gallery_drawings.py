"""The sources' line drawings: rasterised lines, L-systems, wireframes, the star field."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

import diffrast as dr
from diffrast import lines as dl

RIGHT = np.pi / 2
FOUR_COLORS = np.array([[0.9, 0.1, 0.1], [0.1, 0.7, 0.2], [0.1, 0.3, 0.9], [0.95, 0.7, 0.05]])
PAPER = (1.0, 1.0, 1.0)
INK = (0.0, 0.0, 0.0)


# Two dimensions -----------------------------------------------------------------------------------


def drawn(points: Any, lines: Any, colors: Any, size: int, **options: Any) -> Array:
    """A drawing on a square sheet of paper, in its middle."""
    fitted = dl.fit_points(points, size=size)
    offset = np.array([(size - fitted.width) / 2, (size - fitted.height) / 2])
    style: dict[str, Any] = {"background": PAPER, **options}
    return dr.draw_lines(fitted.points + offset, lines, colors, height=size, width=size, **style)


def system(drawing: dr.shapes.LineDrawing, size: int, colors: Any = INK) -> Array:
    return drawn(drawing.points, drawing.lines, colors, size)


def side_by_side(images: Sequence[Any], columns: int = 0) -> Array:
    """Images of one size in rows."""
    columns = columns or len(images)
    rows = [
        jnp.concatenate(images[k : k + columns], axis=1) for k in range(0, len(images), columns)
    ]
    return jnp.concatenate(rows, axis=0)


def dragon(size: int) -> Array:
    curve = dr.LSystem(initiator="F", rules={"F": "F+G", "G": "F-G"}, angle=RIGHT).draw(18)
    return system(curve, size, np.repeat(FOUR_COLORS, 2**16, axis=0))


def spirals(size: int) -> Array:
    share = 0.05
    corner = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    squares = []
    for _ in range(40):
        squares.append(corner)
        corner = (1 - share) * corner + share * np.roll(corner, -1, axis=0)
    one = np.concatenate(squares)
    mirrored = one * [-1, 1]
    cells = [
        (mirrored if (i + j) % 2 else one) + [2 * i, 2 * j] for i in range(3) for j in range(3)
    ]
    points = np.concatenate(cells)
    first = np.arange(len(points)).reshape(-1, 4)
    lines = np.stack([first, np.roll(first, -1, axis=1)], axis=-1).reshape(-1, 2)
    return drawn(points, lines, (0.1, 0.1, 0.5), size)


def koch(size: int) -> Array:
    curve = dr.LSystem(initiator="F", rules={"F": "F+F--F+F"}, angle=np.radians(85))
    steps = side_by_side([system(curve.draw(n), size // 3) for n in range(1, 7)], 3)
    return side_by_side([steps, system(curve.draw(10), steps.shape[1])], 1)


ONE_SYMBOL = [
    ("FF-F-F-F-F-F+F", 3),
    ("FF-F-F-F-FF", 4),
    ("FF-F+F-F-FF", 3),
    ("FF-F--F-F", 4),
    ("F-FF--F-F", 4),
    ("F-F+F-F-F", 4),
]


def one_symbol_system(rule: str) -> dr.LSystem:
    return dr.LSystem(initiator="F-F-F-F", rules={"F": rule}, angle=RIGHT)


def one_symbol(size: int) -> Array:
    images = [system(one_symbol_system(rule).draw(n), size // 3) for rule, n in ONE_SYMBOL]
    return side_by_side(images, 3)


TWO_SYMBOLS = [
    ({"F": "F+G", "G": "F-G"}, 90, 10),
    ({"F": "G+F+G", "G": "F-G-F"}, 60, 6),
    ({"F": "F+G++G-F--FF-G+", "G": "-F+GG++G+F--F-G"}, 60, 4),
    ({"F": "F-G+F+G-F", "G": "GG"}, 120, 6),
]


def two_symbols(size: int) -> Array:
    images = []
    for rules, degrees, rounds in TWO_SYMBOLS:
        start = "F-G-G" if degrees == 120 else "F"
        curve = dr.LSystem(initiator=start, rules=rules, angle=np.radians(degrees))
        images.append(system(curve.draw(rounds), size // 2))
    return side_by_side(images, 2)


PLANTS = [
    ("F", {"F": "F[+F]F[-F]F"}, 25.7, 5),
    ("F", {"F": "FF-[-F+F+F]+[+F-F-F]"}, 22.5, 4),
    ("X", {"X": "F-[[X]+X]+F[+FX]-X", "F": "FF"}, 22.5, 5),
]


def plants(size: int) -> Array:
    images = []
    for start, rules, degrees, rounds in PLANTS:
        plant = dr.LSystem(
            initiator=start, rules=rules, angle=np.radians(degrees), start_angle=RIGHT, draw="F"
        )
        images.append(system(plant.draw(rounds), size // 2, (0.1, 0.45, 0.1)))
    return side_by_side(images)


# Three dimensions ---------------------------------------------------------------------------------


def space_drawing(
    points: Any, lines: Any, colors: Any, size: int, *, theta: float, phi: float, **options: Any
) -> Array:
    """Lines in space from the direction (theta, phi), filling the picture."""
    points = np.asarray(points, np.float32)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    reach = np.linalg.norm(points - centre, axis=1).max()
    camera = dr.Camera.spherical(
        radius=3 * reach, theta=theta, phi=phi, target=centre, fov_y=0.68, near=reach, far=9 * reach
    )
    clip = dr.world_to_clip(camera, points)
    style: dict[str, Any] = {"background": PAPER, **options}
    return dr.draw_lines_with_depth(clip, lines, colors, height=size, width=size, **style)


def hilbert() -> dr.shapes.LineDrawing:
    rule = "^\\XF^\\XFX-F^//XFX&F+//XFX-F/X-/"
    return dr.LSystem(initiator="X", rules={"X": rule}, angle=RIGHT, dimensions=3).draw(2)


def decorated_cube() -> tuple[np.ndarray, np.ndarray]:
    """The second system of figure 6 on each face of a cube; and the number of each line's face."""
    flat = one_symbol_system(ONE_SYMBOL[1][0]).draw(3)
    points = np.asarray(flat.points)
    low, high = points.min(axis=0), points.max(axis=0)
    points = 2 * (points - low) / (high - low).max() - 1
    corners = np.concatenate([points, np.ones_like(points[:, :1])], axis=1)
    faces = [np.roll(corners, k, axis=1) * sign for k in range(3) for sign in (1, -1)]
    lines = np.asarray(flat.lines)
    all_lines = [lines + k * len(corners) for k in range(6)]
    return np.concatenate(faces), np.concatenate(all_lines)


def hilbert_and_cube(size: int, *, colored: bool = False) -> Array:
    curve = hilbert()
    points, lines = decorated_cube()
    count = len(curve.lines)
    colors: list[Any] = [INK, INK]
    if colored:
        share = np.linspace(0, 1, count)[:, None]
        colors = [
            (1 - share) * FOUR_COLORS[0] + share * FOUR_COLORS[2],
            np.repeat(np.tile(FOUR_COLORS, (2, 1))[:6], len(lines) // 6, axis=0),
        ]
    theta, phi = (0.5, 1.1) if colored else (0.7, 1.0)
    view = {"theta": theta, "phi": phi, "antialias": not colored}
    return side_by_side(
        [
            space_drawing(curve.points, curve.lines, colors[0], size, **view),
            space_drawing(points, lines, colors[1], size, **view),
        ]
    )


def plant_in_space(size: int) -> Array:
    rules = {"F": "F[-&\\G][\\++&G]F[---&/G][+&G]", "G": "F[+G][-G]F[+G][-G]FG"}
    plant = dr.LSystem(initiator="^^^^F", rules=rules, angle=np.pi / 8, dimensions=3)
    images = []
    for rounds in (3, 4):
        drawing = plant.draw(rounds)
        view = {"theta": 0.4, "phi": 1.35, "line_width": 0.7}
        images.append(space_drawing(drawing.points, drawing.lines, (0.1, 0.4, 0.1), size, **view))
    return side_by_side(images)


def wire(mesh: dr.Mesh, size: int, *, hidden: bool = True, theta: float = 0.6) -> Array:
    """A mesh's edges, transparent as in the source unless asked otherwise."""
    reach = float(np.linalg.norm(np.asarray(mesh.vertices), axis=1).max())
    camera = dr.Camera.spherical(
        radius=4 * reach, theta=theta, phi=1.1, fov_y=0.55, near=reach, far=9 * reach
    )
    scene = dr.Scene(objects=[dr.Object(mesh)], background=PAPER)
    return dr.wireframe(scene, camera, height=size, width=size, color=INK, hidden=hidden)


def platonic(size: int) -> Array:
    solids = [dr.shapes.cube, dr.shapes.tetrahedron, dr.shapes.octahedron]
    solids += [dr.shapes.icosahedron, dr.shapes.dodecahedron]
    images = [wire(solid(flat=False), size // 2) for solid in solids]
    images.append(wire(dr.shapes.buckyball(flat=False), size // 2))
    return side_by_side(images, 3)


def spheres(size: int) -> Array:
    return side_by_side([wire(dr.shapes.icosphere(n), size // 2) for n in (1, 2, 3)])


def subdivision(size: int) -> Array:
    """The triangle ABC becomes ADE, BFD, CEF and DFE; D, E and F lie half-way."""
    corners = np.array([[-1.0, 0], [1, 0], [0, np.sqrt(3)]])
    middles = (corners + np.roll(corners, -1, axis=0)) / 2
    lines = [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3)]
    colors = np.array([INK] * 3 + [FOUR_COLORS[2]] * 3)
    return drawn(np.concatenate([corners, middles]), lines, colors, size, line_width=2.0)


def arrows(begin: Any, end: Any, across: Any) -> tuple[np.ndarray, np.ndarray]:
    """Points and lines of arrows, whose heads lie in the plane of `across`."""
    begin, end, across = (np.asarray(x, float) for x in (begin, end, across))
    back = end + 0.15 * (begin - end)
    points = np.stack([begin, end, back + 0.07 * across, back - 0.07 * across], axis=1)
    first = 4 * np.arange(len(points))[:, None, None]
    lines = first + np.array([[0, 1], [1, 2], [1, 3]])
    return points.reshape(-1, points.shape[-1]), lines.reshape(-1, 2)


def turtle(size: int) -> Array:
    """Heading H (red), left L (green) and up U (blue), of a turtle that is a tetrahedron."""
    axes = np.eye(3)
    points, lines = arrows(np.zeros((3, 3)), axes, np.roll(axes, 1, axis=0))
    body = 0.3 * np.array([[1.6, 0, 0], [-0.8, 0.8, 0], [-0.8, -0.8, 0], [-0.4, 0, 0.7]])
    edges = [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]
    colors = np.concatenate([np.repeat(FOUR_COLORS[:3], 3, axis=0), [INK] * 6])
    together = np.concatenate([lines, np.array(edges) + len(points)])
    view = {"theta": 0.5, "phi": 1.1, "line_width": 1.5}
    return space_drawing(np.concatenate([points, body]), together, colors, size, **view)


def reflection(size: int) -> Array:
    """Normal n (blue), light l (yellow) and r = 2 (n . l) n - l (red), and how r is made."""
    normal, light = np.array([0.0, 1]), np.array([-np.sin(0.8), np.cos(0.8)])
    cosine = normal @ light
    mirrored = 2 * cosine * normal - light
    ends = np.stack([light, normal, mirrored])
    across = np.stack([ends[:, 1], -ends[:, 0]], axis=1)
    points, lines = arrows(np.zeros((3, 2)), ends, across)
    more = np.array([[-1.0, 0], [1, 0], 2 * cosine * normal, light, mirrored, normal])
    extra = np.array([(0, 1), (3, 2), (2, 4), (5, 2)]) + len(points)
    grey = (0.6, 0.6, 0.6)
    colors = np.concatenate([np.repeat(FOUR_COLORS[[3, 2, 0]], 3, axis=0), [INK, *[grey] * 3]])
    together = np.concatenate([lines, extra])
    return drawn(np.concatenate([points, more]), together, colors, size, line_width=2.0)


def cube_fractal(size: int) -> Array:
    cube = dr.shapes.cube(flat=False)
    images = []
    for n in range(4):
        mesh = dr.shapes.fractal(cube, n, 3.0)
        edges = dl.mesh_edges(cube)
        copies = np.arange(8**n)[:, None, None]
        lines = (edges + 8 * copies).reshape(-1, 2)
        images.append(space_drawing(mesh.vertices, lines, INK, size // 2, theta=0.6, phi=1.15))
    return side_by_side(images, 2)


def teapot_lines(divisions: int = 6) -> tuple[Any, np.ndarray]:
    """The teapot's points, and the two families of curves on its patches (C 12.4)."""
    mesh = dr.shapes.teapot(divisions)
    side = divisions + 1
    grid = np.arange(32 * side * side).reshape(32, side, side)
    across = np.stack([grid[:, :, :-1], grid[:, :, 1:]], axis=-1).reshape(-1, 2)
    along = np.stack([grid[:, :-1], grid[:, 1:]], axis=-1).reshape(-1, 2)
    return mesh, np.concatenate([across, along])


def teapot_wire(size: int) -> Array:
    mesh, lines = teapot_lines()
    return space_drawing(mesh.vertices, lines, INK, size, theta=-0.9, phi=1.1, line_width=0.6)


def teapot_hidden(size: int, *, normals: bool = False) -> Array:
    mesh, lines = teapot_lines(4)
    camera = dr.Camera.spherical(
        radius=13, theta=-0.9, phi=1.1, target=(0.3, 0.2, 1.5), fov_y=0.52, near=1, far=30
    )
    scene = dr.Scene(objects=[dr.Object(mesh)], background=PAPER)
    return dr.wireframe(
        scene,
        camera,
        height=size,
        width=size,
        color=INK,
        edges=[lines],
        normal_length=0.2 if normals else None,
        line_width=0.7,
    )


def bezier_grid(control: np.ndarray, size: int, *, curves: bool = True, net: bool = True) -> Array:
    """Control nets in red, and curves of constant u and v."""
    points, lines, colors = [np.zeros((0, 3))], [np.zeros((0, 2), int)], [np.zeros((0, 3))]
    total = 0

    def add(grid: np.ndarray, color: tuple[float, float, float], step: int) -> None:
        nonlocal total
        rows, columns = grid.shape[:2]
        number = total + np.arange(rows * columns).reshape(rows, columns)
        across = np.stack([number[::step, :-1], number[::step, 1:]], axis=-1).reshape(-1, 2)
        along = np.stack([number[:-1, ::step], number[1:, ::step]], axis=-1).reshape(-1, 2)
        points.append(grid.reshape(-1, 3))
        lines.extend([across, along])
        colors.append(np.tile(color, (len(across) + len(along), 1)))
        total += rows * columns

    fine = np.linspace(0, 1, 25)
    surface = dr.shapes.evaluate(control, fine, fine[:, None]).position
    for patch, net_points in zip(np.asarray(surface), control, strict=True):
        if curves:
            add(patch, (0.1, 0.1, 0.4), 3)
        if net:
            add(net_points, (0.85, 0.2, 0.1), 1)
    return space_drawing(
        np.concatenate(points),
        np.concatenate(lines),
        np.concatenate(colors),
        size,
        theta=-1.0,
        phi=0.95,
    )


def hill() -> np.ndarray:
    """The control points of the thesis's example patch."""
    x, y = np.meshgrid(np.arange(4.0), 2 * np.arange(4.0))
    z = np.zeros((4, 4))
    z[1:3, 1:3] = 3
    return np.stack([x, y, z], axis=-1)


def joined_patches(size: int) -> Array:
    first = hill()
    first[:, 3, 2] = [0.5, 2.0, 2.0, 0.5]
    second = first + np.array([3.0, 0, 0])
    second[:, 0] = first[:, 3]
    second[:, 1] = 2 * first[:, 3] - first[:, 2]  # C1: the tangents go on
    second[:, 2:, 2] = [[0, 0], [-1, 0], [-1, 0], [0, 0]]
    return bezier_grid(np.stack([first, second]), size)


def teapot_control(size: int) -> Array:
    return bezier_grid(np.asarray(dr.shapes.teapot_patches().control_points), size, curves=False)


# Rasterising --------------------------------------------------------------------------------------

_CELLS = 24


def enlarged(image: Any, size: int) -> Array:
    """Every pixel as a square, with lines between them."""
    cell = max(size // _CELLS, 3)
    large = jnp.repeat(jnp.repeat(jnp.asarray(image), cell, axis=0), cell, axis=1)
    border = (jnp.arange(large.shape[0]) % cell == 0)[:, None]
    return jnp.where((border | border.T)[..., None], 0.8, large)


def raster_lines(size: int) -> Array:
    ends = np.array([[2, 20], [21, 14], [3, 3], [9, 20], [11, 2], [22, 2], [20, 19], [12, 9]]) + 0.5
    lines = np.arange(8).reshape(-1, 2)
    both = [
        dr.draw_lines(
            ends, lines, INK, height=_CELLS, width=_CELLS, background=PAPER, antialias=smooth
        )
        for smooth in (False, True)
    ]
    return side_by_side([enlarged(image, size) for image in both])


def raster_triangle(size: int) -> Array:
    corners = np.array([[-0.8, -0.8, 0, 1], [0.85, -0.3, 0, 1], [-0.2, 0.85, 0, 1]])
    found = dr.rasterize(corners, [[0, 1, 2]], height=_CELLS, width=_CELLS)
    colors = dr.interpolate(np.eye(3), np.array([[0, 1, 2]]), found)
    return enlarged(jnp.where((found.face >= 0)[..., None], colors, 1.0), size)


# Stars --------------------------------------------------------------------------------------------


def star_field(size: int, *, stars: int = 600, frames: int = 40, spread: float = 4.0) -> list[Any]:
    """Points that come nearer at constant speed, projected by x/z and y/z (FEATURES L8)."""
    rng = np.random.default_rng(0)
    x, y = spread * rng.uniform(-1, 1, (2, stars))
    depth = rng.uniform(0, spread, stars)
    images = []
    for frame in range(frames):
        z = (depth - frame / frames * spread) % spread  # who has passed begins anew, far away
        z = np.maximum(z, 1e-3)
        across, upward = x / z, y / z
        column = np.floor((across + 1) / 2 * size).astype(int)
        row = np.floor((1 - upward) / 2 * size).astype(int)
        seen = (column >= 0) & (column < size) & (row >= 0) & (row < size)
        image = np.zeros((size, size, 3), np.float32)
        brightness = np.clip(1.2 - z / spread, 0.1, 1)[:, None]
        np.maximum.at(image, (row[seen], column[seen]), np.repeat(brightness[seen], 3, axis=1))
        images.append(image)
    return images


FIGURES = [
    ("A_fig_02", "Dragon curve, 2^18 lines in four colours", dragon),
    ("A_fig_04", "Nine spirals of 40 squares each", spirals),
    ("A_fig_05", "Koch curve: steps 1 to 6, and 4^10 lines", koch),
    ("A_fig_06", "L-systems of one symbol from F-F-F-F (classical rules)", one_symbol),
    ("A_fig_07", "L-systems of two symbols (dragon, Sierpinski, Gosper, gasket)", two_symbols),
    ("A_fig_08", "Plants by L-systems with brackets (classical rules)", plants),
    ("A_fig_14", "Wireframe of the teapot, transparent", teapot_wire),
    ("A_fig_15_16", "Wireframes of the Platonic solids and the buckyball", platonic),
    ("A_fig_17", "A triangle of the icosahedron becomes four", subdivision),
    ("A_fig_18", "Wireframes of spheres from the icosahedron", spheres),
    ("A_fig_19", "Heading, left and up of the turtle", turtle),
    ("A_fig_20", "Hilbert curve in space; cube with a system on each face", hilbert_and_cube),
    ("A_fig_21", "A plant in space, n = 3 and 4", plant_in_space),
    (
        "A_fig_22",
        "Figure 20 in colour, the nearest line in front",
        lambda size: hilbert_and_cube(size, colored=True),
    ),
    ("A_fig_33", "Fractal of the cube, scale 3, 0 to 3 steps", cube_fractal),
    ("A_fig_42", "The direction r in which light is mirrored", reflection),
    ("B_lines", "Midpoint algorithm, and the box filter", raster_lines),
    ("B_triangle", "A triangle with interpolated colours", raster_triangle),
    ("C_fig_23", "Wireframe with hidden faces removed", teapot_hidden),
    (
        "C_fig_26",
        "Control points and their patch",
        lambda size: bezier_grid(hill()[None], size),
    ),
    (
        "C_fig_27",
        "A patch by its families of curves u and v",
        lambda size: bezier_grid(hill()[None], size, net=False),
    ),
    ("C_fig_28", "Two patches joined with equal tangents", joined_patches),
    ("C_fig_29", "Control points of the teapot", teapot_control),
    (
        "C_photo_3",
        "Teapot of 32 patches as a wireframe with its normals",
        lambda size: teapot_hidden(size, normals=True),
    ),
    ("D_stars", "Star field flying towards the viewer", star_field),
]
