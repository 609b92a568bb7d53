"""Arguments of all public functions: each wrong value is a ValueError that names the argument.

What passes the checks is not computed where that would compile a large program: the function
behind the checks is replaced. `DIFFRAST_FUZZ_EXAMPLES` as for `test_fuzz_files`.
"""

import importlib
import inspect
import os
import re
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from limits import in_time

import diffrast as dr
from diffrast import clip, color, files, fit, linalg, lines, mesh, shapes, views
from diffrast.files.scenes import load_scene_file

EXAMPLES = int(os.environ.get("DIFFRAST_FUZZ_EXAMPLES", "3"))
SECONDS = 20
MODULES = (dr, clip, color, files, fit, linalg, lines, mesh, shapes, views)
DATA = Path(__file__).parent / "data"

pytestmark = [
    pytest.mark.usefixtures("unchecked", "no_large_programs"),
    # NumPy's and JAX's, of numbers that float32 cannot hold and of words as arrays.
    pytest.mark.filterwarnings("ignore:overflow encountered"),
    pytest.mark.filterwarnings("ignore:Data type alias 'a'"),
]

# ------------------------------------------------------------------------------- what is not run


class Reached(Exception):  # noqa: N818 (no error: the arguments passed)
    pass


LARGE = (
    "diffrast.render.world_geometry",
    "diffrast.views.in_order",
    "diffrast.views.usual_chunk",
    "diffrast.raster.fragments.stored_rows",
    "diffrast.interpolate.interpolate_columns",
    "diffrast.interpolate.face_slopes",
    "diffrast.edges.antialias.traced_topology",
    "diffrast.edges.antialias.View",
    "diffrast.lines.drawing._picture",
    "diffrast.lines.drawing._fragments",
    "diffrast.lines.drawing.surface_of",
    "diffrast.texture.sampling._sampled",
    "diffrast.clip._cut",
    "diffrast.fit._gradient_step",
    "diffrast._least_squares.evaluate",
    "diffrast.shapes.bezier._evaluate_traced",
    "diffrast._scale_space._convolve",
)


@pytest.fixture
def no_large_programs(monkeypatch):
    def reached(*_, **__):
        raise Reached

    for name in LARGE:
        module, _, attribute = name.rpartition(".")
        monkeypatch.setattr(importlib.import_module(module), attribute, reached)


# ------------------------------------------------------------------------------- what is called

POINTS = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))
CLIP = tuple((*point, 1.0) for point in POINTS)
EYE4 = np.eye(4)
DIRECTION = (0.0, 0.0, -1.0)


def square(*reals):
    return reals[0]


def twice(shared, view):
    del shared
    return 2 * view


def with_residuals(params, *_):
    return params


def cases(folder):
    """Valid arguments of everything public, by its name."""
    body = dr.Mesh(vertices=POINTS, faces=FACES)
    smooth = dr.Mesh(vertices=POINTS, faces=FACES, normals=POINTS, uvs=np.zeros((4, 2)))
    camera = dr.Camera.perspective(eye=(3, 0, 0), target=(0, 0, 0), fov_y=1.0, near=1, far=9)
    light = dr.DirectionalLight(direction=DIRECTION)
    picture = np.zeros((4, 4, 3))
    item = dr.Object(body)
    scene = dr.Scene(objects=[item], lights=[light])
    size = dr.RenderSettings(height=4, width=4)
    four = jnp.full((4, 4), -1, jnp.int32)
    fragments = dr.Fragments(
        face=four, barycentrics=jnp.zeros((4, 4, 3)), inverse_depth=jnp.zeros((4, 4))
    )
    three = jnp.zeros((4, 4, 3))
    buffers = dr.Buffers(four, four, three, three[..., 0], three, three, None, None)
    table = dr.LookUpTable(positions=(0.0, 1.0), colors=np.zeros((2, 3)))
    texture = dr.Texture(picture)
    planar = dr.PlanarMapping(corner=POINTS[0], across=POINTS[1], up=POINTS[2])
    koch = dr.LSystem(initiator="F", rules={"F": "F+F--F+F"}, angle=1.0)
    control = np.arange(48.0).reshape(1, 4, 4, 3)
    patches = shapes.BezierPatches(
        np.arange(48.0).reshape(16, 3), np.arange(16).reshape(1, 4, 4), np.zeros(1, int)
    )
    polygons = files.load_polygons(DATA / "house.dat")
    depths = {"near": 1.0, "far": 9.0}
    seen = {"target": POINTS[0], "direction": None, "up": (0.0, 0.0, 1.0), "aspect": 1.0, **depths}
    spot = {
        "position": POINTS[0], "ambient": None, "diffuse": POINTS[1], "specular": POINTS[1],
        "attenuation": (1.0, 0.0, 0.0), "shadow": dr.Shadow(),
    }  # fmt: skip
    image_size = {"height": 4, "width": 4}
    drawing = {
        "lines": ((0, 1),), "colors": (1.0, 1.0, 1.0), **image_size, "background": (0.0, 0.0, 0.0),
        "line_width": 1.0, "antialias": True,
    }  # fmt: skip
    view = {"scene": scene, "camera": camera, "settings": size}
    stack = {"scene": scene, "cameras": dr.stack_cameras([camera]), "settings": size}
    many = {"function": twice, "views": np.zeros(3), "shared": None}
    spread = {"chunk": 1, "devices": jax.devices()[:1]}
    indexed = {"vertices": POINTS, "faces": FACES}
    surfaces = {"faces": FACES, "fragments": fragments}
    logged = {"record_params": False, "progress": False, "callback": None}
    saved = {name: folder / f"saved{name}" for name in (".obj", ".png", ".gif", ".bez", ".dat")}
    dr.save_mesh(folder / "a.obj", body)
    dr.save_image(folder / "a.png", picture)
    found = {
        "AmbientLight": {"color": POINTS[1]},
        "Attenuation": {"coefficients": (1.0, 0.0, 0.0), "legs": "viewer"},
        "Camera": {
            "view": EYE4, "projection": EYE4, "distortion": np.zeros(5), "view_remainder": POINTS[0]
        },
        "Camera.perspective": {"eye": (3.0, 0.0, 0.0), "fov_y": 1.0, **seen},
        "Camera.orthographic": {"eye": (3.0, 0.0, 0.0), "height": 1.0, **seen},
        "Camera.spherical": {
            "radius": 3.0, "theta": 1.0, "phi": 1.0, "target": POINTS[0], "fov_y": 1.0,
            "aspect": 1.0, **depths,
        },
        "Camera.phigs": {
            "view_reference_point": POINTS[0], "view_plane_normal": POINTS[1],
            "view_up": POINTS[2], "projection_reference_point": (0.0, 0.0, 5.0),
            "window": (-1.0, 1.0, -1.0, 1.0), "view_plane_distance": 0.0, "front": 1.0,
            "back": -1.0, "projection": "perspective",
        },
        "Camera.opencv": {
            "intrinsics": ((4.0, 0.0, 2.0), (0.0, 4.0, 2.0), (0.0, 0.0, 1.0)),
            "rotation": np.eye(3), "translation": POINTS[3], **image_size, **depths,
            "distortion": np.zeros(5),
        },
        "CubeMapping": {"centre": POINTS[0], "half_size": 1.0, "rotation": np.eye(3)},
        "CubeTexture": {
            "images": np.zeros((6, 2, 2, 3)), "mapping": dr.CubeMapping(), "filter": "bilinear"
        },
        "CubeTexture.from_cross": {
            "cross": np.zeros((6, 8, 3)), "mapping": dr.CubeMapping(), "filter": "bilinear"
        },
        "DirectionalLight": {
            "direction": DIRECTION, "ambient": None, "diffuse": POINTS[1], "specular": POINTS[1],
            "shadow": dr.Shadow(), "attenuation": dr.Attenuation((1, 0, 0), legs="viewer"),
        },
        "LSystem": {
            "initiator": "F", "rules": {"F": "F+F--F+F"}, "angle": 1.0, "start_angle": 0.0,
            "alphabet": "F", "draw": "F", "drawn": None, "dimensions": 2,
        },
        "LSystem.draw": {"self": koch, "iterations": 2, "step": 1.0, "key": None},
        "LSystem.expand": {"self": koch, "iterations": 2, "key": None},
        "LookUpTable": {"positions": (0.0, 1.0), "colors": np.zeros((2, 3))},
        "Material": {
            "diffuse": POINTS[1], "ambient": POINTS[1], "specular": POINTS[1], "shininess": 9.0,
            "texture": texture, "highlight": "phong",
        },
        "Mesh": {
            **indexed, "normals": POINTS, "uvs": np.zeros((4, 2)), "uv_faces": FACES,
            "topology": body.topology,
        },
        "Object": {"mesh": smooth, "material": dr.Material(texture=texture), "transform": EYE4},
        "PlanarMapping": {"corner": POINTS[0], "across": POINTS[1], "up": POINTS[2]},
        "PointLight": {**spot, "incidence_cutoff": 1.0},
        "RenderSettings": {
            **image_size, "shading": "flat", "cull_backfaces": False, "samples": 4,
            "antialias": True,
        },
        "Scene": {"objects": [item], "lights": [light], "background": (0.0, 0.0, 0.0)},
        "Shadow": {"resolution": 64},
        "SphereMapping": {"centre": POINTS[0], "rotation": np.eye(3), "kind": "longitude"},
        "SpotLight": {**spot, "direction": DIRECTION, "cutoff": 1.0},
        "Texture": {
            "image": picture, "mapping": planar, "wrap": ("clamp", "repeat"),
            "filter": "trilinear", "anisotropy": 2,
        },
        "antialias": {
            "image": picture, "positions_clip": CLIP, "faces": FACES, "face": four,
            "background": 0.0, "topology": body.topology, "creases": "seams",
            "cull_backfaces": False, "shader": None, "data": None,
        },
        "clip_to_pixel": {"positions_clip": CLIP, **image_size},
        "depths": {"buffers": buffers},
        "draw_lines": {"points": np.zeros((2, 2)), **drawing},
        "draw_lines_with_depth": {"positions_clip": CLIP, **drawing, **surfaces},
        "interpolate": {"attributes": POINTS, **surfaces},
        "light_cosines": {"buffers": buffers, "light": light},
        "load_bezier": {"path": DATA / "patch.bez"},
        "load_image": {"path": folder / "a.png", "srgb": True},
        "load_mesh": {"path": folder / "a.obj"},
        "load_objects": {"path": folder / "a.obj", "filter": "nearest", "wrap": "clamp"},
        "load_polygons": {"path": DATA / "house.dat"},
        "look_up": {"table": table, "values": picture[..., 0]},
        "map_points": {"mapping": planar, "points": POINTS, "normals": POINTS},
        "rasterize": {
            "positions_clip": CLIP, "faces": FACES, **image_size, "cull_backfaces": False,
            "border": 0,
        },
        "rasterize_lines": {"positions_clip": CLIP, "lines": ((0, 1),), **image_size, **surfaces},
        "read_scene": {"path": DATA / "scene1.dat"},
        "recolor": {
            "values": picture[..., 0], "face": four, "table": table, "background": POINTS[0]
        },
        "render": view,
        "render_buffers": view,
        "render_scene_file": {
            "path": DATA / "scene1.dat", "operation": "wireframe", "antialias": True
        },
        "render_views": {**stack, **spread},
        "sample_texture": {"texture": texture, "uv": np.zeros((5, 2)), "derivatives": None},
        "save_animation": {
            "path": saved[".gif"], "images": [picture], "frames_per_second": 20.0, "srgb": True
        },
        "save_image": {"path": saved[".png"], "image": picture, "srgb": True},
        "save_mesh": {"path": saved[".obj"], "mesh": body},
        "screen_derivatives": {
            "attributes": POINTS, "positions_clip": CLIP, **surfaces, "border": 0
        },
        "shadow_outlines": view,
        "stack_cameras": {"cameras": [camera, camera]},
        "viewpoint": {"camera": camera},
        "wireframe": {
            "scene": scene, "camera": camera, **image_size, "hidden": True,
            "cull_backfaces": False, "edges": [((0, 1),)], "color": POINTS[1],
            "normal_length": 1.0, "line_width": 1.0, "antialias": True,
        },
        "world_to_clip": {"camera": camera, "positions_world": POINTS},
        "clip.clip_lines": {"positions_clip": CLIP, "lines": ((0, 1),), "planes": CLIP},
        "clip.clip_mesh": {"mesh": body, "camera": camera},
        "clip.clip_triangles": {"positions_clip": CLIP, "faces": FACES, "planes": CLIP},
        "color.gamma_to_linear": {"encoded": POINTS, "gamma": 2.2},
        "color.hls_to_rgb": {"hls": POINTS},
        "color.linear_to_gamma": {"linear": POINTS, "gamma": 2.2},
        "color.linear_to_srgb": {"linear": POINTS},
        "color.rgb_to_hls": {"rgb": POINTS},
        "color.srgb_to_linear": {"encoded": POINTS},
        "files.load_mesh_parts": {"path": folder / "a.obj"},
        "files.load_scene_file": {"path": DATA / "scene1.dat"},
        "files.save_bezier": {"path": saved[".bez"], "patches": patches},
        "files.save_polygons": {"path": saved[".dat"], "polygons": polygons},
        "files.save_scene_file": {
            "path": saved[".dat"], "scene": load_scene_file(DATA / "scene1.dat")
        },
        "fit.direction_update": {"direction": DIRECTION, "tangent": (0.1, 0.2)},
        "fit.downsample": {"image": picture, "factor": 2},
        "fit.gaussian_blur": {"image": picture, "sigma": 1.0, "radius": None},
        "fit.least_squares": {
            "residuals": with_residuals, "params": {"a": np.ones(2)}, "args": (), "steps": 2,
            "method": "gauss_newton", "damping": 1e-3, "tolerance": 1e-3, "loss": "huber",
            "scale": 1.0, "chunk": 2, **logged,
        },
        "fit.minimize": {
            "loss": square, "params": {"a": np.ones(2)}, "args": (), "optimizer": None, "steps": 2,
            "tolerance": 0.1, "patience": 2, **logged,
        },
        "linalg.apply_matrix": {"matrix": EYE4, "vectors": CLIP},
        "linalg.compose": {"matrices": [EYE4, EYE4]},
        "linalg.dot": {"a": POINTS[0], "b": POINTS[1]},
        "linalg.invert": {"matrix": EYE4},
        "linalg.mirrors": {"matrix": EYE4},
        "linalg.norm": {"vectors": POINTS},
        "linalg.normalize": {"vectors": POINTS},
        "linalg.project_points": {"matrix": EYE4, "points": POINTS},
        "linalg.rotation": {"axis": POINTS[1], "angle": 1.0},
        "linalg.rotation_x": {"angle": 1.0},
        "linalg.rotation_y": {"angle": 1.0},
        "linalg.rotation_z": {"angle": 1.0},
        "linalg.scaling": {"factors": POINTS[1]},
        "linalg.se3_exp": {"twist": np.ones(6)},
        "linalg.se3_log": {"matrix": EYE4},
        "linalg.shear": dict.fromkeys(("xy", "xz", "yx", "yz", "zx", "zy"), 0.5),
        "linalg.so3_exp": {"rotation_vector": POINTS[1]},
        "linalg.so3_log": {"matrix": np.eye(3)},
        "linalg.transform_directions": {"matrix": EYE4, "directions": POINTS},
        "linalg.normal_matrix": {"matrix": EYE4},
        "linalg.transform_normals": {"matrix": EYE4, "normals": POINTS},
        "linalg.transform_points": {"matrix": EYE4, "points": POINTS},
        "linalg.translation": {"offset": POINTS[1]},
        "lines.fit_points": {"points": ((0.0, 0.0), (1.0, 2.0)), "size": 9, "margin": 0.9},
        "lines.mesh_edges": {"mesh": body, "flat": False},
        "lines.normal_lines": {"vertices": POINTS, "normals": POINTS, "length": 1.0},
        "lines.polygon_edges": {"polygons": [[0, 1, 2], [0, 2, 3, 1]]},
        "mesh.edge_adjacency": indexed,
        "mesh.euler_characteristic": {"mesh": body},
        "mesh.face_areas": indexed,
        "mesh.face_normals": indexed,
        "mesh.flat_shaded": {"mesh": body},
        "mesh.from_polygons": {
            "vertices": POINTS, "polygons": FACES, "surfaces": (0, 1, 1, 0), "weighting": "area"
        },
        "mesh.is_closed": {"mesh": body},
        "mesh.merge": {"meshes": [body, body]},
        "mesh.merge_near_vertices": {"mesh": body, "tolerance": 0.1},
        "mesh.signed_volume": {"mesh": body},
        "mesh.split_uvs": {"mesh": smooth},
        "mesh.stack_meshes": {"meshes": [body, body]},
        "mesh.transform": {"mesh": body, "matrix": EYE4},
        "mesh.vertex_normals": {**indexed, "weighting": "angle", "weld": (0, 1, 2, 3)},
        "mesh.weld": {"vertices": POINTS},
        "mesh.with_normals": {"mesh": body, "weighting": "uniform", "weld": True},
        "shapes.bezier_mesh": {"control_points": control, "divisions": 2, "merge_tolerance": 0.1},
        "shapes.cone": {"radius": 1.0, "height": 1.0, "segments": 3, "caps": True},
        "shapes.cylinder": {
            "radius": 1.0, "height": 1.0, "segments": 3, "divisions": 1, "caps": True
        },
        "shapes.evaluate": {"control_points": control, "u": 0.5, "v": 0.5},
        "shapes.fractal": {"mesh": body, "iterations": 1, "scale": 2.0},
        "shapes.height_field": {"heights": np.zeros((2, 3)), "width": 1.0, "height": 1.0},
        "shapes.icosphere": {"subdivisions": 1, "radius": 1.0},
        "shapes.menger_sponge": {"level": 1, "interior": False, "flat": True},
        "shapes.parse_bezier": {"text": (DATA / "patch.bez").read_text(), "name": "patch"},
        "shapes.plane": {"width": 1.0, "height": 1.0, "divisions": (1, 2)},
        "shapes.teapot": {"divisions": 1, "surfaces": ("lid",)},
        "shapes.teapot_patches": {},
        "shapes.torus": {
            "major_radius": 1.0, "minor_radius": 0.5, "major_segments": 3, "minor_segments": 3
        },
        "shapes.uv_sphere": {"radius": 1.0, "segments": 3, "rings": 2},
        "views.map_views": {**many, **spread},
        "views.stream_views": {**many, **spread},
        "views.sum_views": {**many, "devices": None},
    }  # fmt: skip
    solids = ("buckyball", "cube", "dodecahedron", "icosahedron", "octahedron", "tetrahedron")
    return found | {f"shapes.{name}": {"flat": True} for name in solids}


# What the library makes, or hands from one stage to the next: never checked, as JAX rebuilds it.
RESULTS = {"Fragments", "LineFragments", "files.SceneFile"}
HANDED_ON = {"linalg.null_vector", "linalg.where_finite", "views.image_of"}


def public():
    """Everything public by its shortest name, without results."""
    found = {}
    for module in MODULES:
        prefix = "" if module is dr else module.__name__.removeprefix("diffrast.") + "."
        for name, value in vars(module).items():
            if name.startswith("_") or isinstance(value, types.ModuleType) or not callable(value):
                continue
            home = getattr(value, "__module__", None) or ""
            if not home.startswith((module.__name__, "diffrast._scale_space")):
                continue
            if not (isinstance(value, type) and issubclass(value, tuple)):
                found.setdefault(value, prefix + name)
    return {name: value for value, name in found.items()}


PUBLIC = public()
NAMES = sorted(PUBLIC.keys() - RESULTS - HANDED_ON)
METHODS = (
    *(f"Camera.{name}" for name in ("perspective", "orthographic", "spherical", "phigs", "opencv")),
    "CubeTexture.from_cross", "LSystem.draw", "LSystem.expand",
)  # fmt: skip
# JAX's own error for what is no tree of arrays, as their docstrings say.
JITTED = ("render", "render_buffers", "shadow_outlines", "viewpoint")


OTHERS = {"shapes.parse_bezier": ["patch:[0-9]+"], "shapes.bezier_mesh": ["tolerance"]}


@pytest.fixture(scope="module")
def arguments(tmp_path_factory):
    return cases(tmp_path_factory.mktemp("files"))


def function_of(name):
    if name in METHODS:
        owner, method = name.split(".")
        return getattr(getattr(dr, owner), method)
    return PUBLIC[name]


def test_every_public_name_is_known(arguments):
    assert sorted(arguments.keys() - set(METHODS)) == NAMES
    for name in arguments:
        parameters = inspect.signature(function_of(name)).parameters
        assert set(arguments[name]) == set(parameters), name


# ------------------------------------------------------------------------------- wrong values

OBJECT = object()
ESSENTIAL = (None, "word", OBJECT, float("nan"), 10**12, np.zeros((2, 2, 2, 2, 2)))
VALUES = (
    True, 0, -1, 2, 2**31, 2**70, -(2**70), 0.5, -1.0, float("inf"), 1e300, 1e-300, 1 + 2j, "",
    b"x", "\0", "../x", (), [], {}, [[1], [1, 2]], [None], ["a"], [OBJECT], [[], []], range(3),
    {1, 2}, "f4", np.zeros(0), np.zeros((0, 3)), np.zeros((3, 0)), np.zeros((0, 4)),
    np.float64("nan"), np.array([2**40, 2**32]), np.array(2**63, np.uint64), np.array(["a"]),
    np.array([None, 1]), np.zeros(3, bool), np.zeros(3, complex), np.zeros(2, "M8[s]"),
    lambda: None, int, np,
)  # fmt: skip


def variants(valid):
    """Values of nearly the kind that is wanted."""
    try:
        array = np.asarray(valid)
    except (TypeError, ValueError):
        return []
    if array.dtype.kind not in "iuf" or isinstance(valid, dr.Mesh):
        return []
    found = [
        array.astype(kind) for kind in ("i1", "u8", "f2", "f8", "complex64", "S", "U", "O", "?")
    ]
    found += [array[None], array.T, array.tolist(), array.astype(str).tolist(), -array]
    filled = [np.nan, np.inf, -np.inf, 1e39] if array.dtype.kind == "f" else [-1, 2**31, 2**40]
    found += [np.full(array.shape, value) for value in filled]
    if array.ndim and array.size:
        found += [array[:-1], array[:0], array[0], array[..., :-1], np.concatenate([array, array])]
    return found


def call(function, name, given_arguments):
    if name == "linalg.compose":
        matrices = given_arguments["matrices"]
        return function(*(matrices if isinstance(matrices, list | tuple) else [matrices]))
    result = function(**given_arguments)
    return list(result) if inspect.isgenerator(result) else result


def check(name, valid, argument, value):
    """The call works, or its ValueError begins with the name of an argument."""
    function, message, result = function_of(name), None, None
    documented = (TypeError, OverflowError) if name in JITTED else ()
    if argument == "path":
        documented = (OSError,)
    with in_time(SECONDS):
        try:
            result = call(function, name, {**valid, argument: value})
        except (Reached, *documented):
            return
        except ValueError as error:
            message = str(error)
    if message is not None:
        file = re.escape(str(Path(value))) if isinstance(value, str) else ""
        starts = "|".join([*valid, *OTHERS.get(name, ()), *([file] if argument == "path" else [])])
        named = re.match(rf"(?s)({starts})(?!\w).*: (wanted|cannot be) ", message)
        assert named, f"{argument}={value!r:.60}: {message}"
    elif isinstance(function, type):
        for leaf in jax.tree.leaves(result):
            if jnp.issubdtype(getattr(leaf, "dtype", object), jnp.floating):
                assert np.all(np.isfinite(leaf)), f"{argument}={value!r:.60}"


@pytest.mark.parametrize("name", sorted([*NAMES, *METHODS]))
def test_wrong_arguments_are_named(arguments, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where files of strange names are written
    valid = arguments[name]
    for argument, value in valid.items():
        if argument == "self":
            continue
        check(name, valid, argument, value)
        for wrong in ESSENTIAL:
            check(name, valid, argument, wrong)
    changed = [argument for argument in valid if argument != "self"]
    if not changed:
        return

    @settings(
        derandomize=True, deadline=None, max_examples=EXAMPLES, database=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.sampled_from(changed), st.floats(0, 1, exclude_max=True))
    def run(argument, place):
        values = [*VALUES, *variants(valid[argument])]
        check(name, valid, argument, values[int(place * len(values))])

    run()
