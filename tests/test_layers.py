"""The package reads in one direction: a module imports only what stands above it in `ORDER`."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import diffrast

ROOT = Path(diffrast.__file__).parent
ORDER = [
    "diffrast._pytree",
    "diffrast._check",
    "diffrast._tokens",
    "diffrast._device",
    "diffrast._stored",
    "diffrast.linalg",
    "diffrast._compensated",
    "diffrast.color",
    "diffrast.viewing",
    "diffrast.opencv",
    "diffrast.camera",
    "diffrast._topology",
    "diffrast._polygons",
    "diffrast.mesh.triangles",
    "diffrast.mesh.normals",
    "diffrast.mesh.assembly",
    "diffrast.mesh.measures",
    "diffrast.mesh",
    "diffrast.clip",
    "diffrast.shapes._grid",
    "diffrast.shapes.solids",
    "diffrast.shapes.curved",
    "diffrast.shapes.bezier",
    "diffrast.shapes.teapot",
    "diffrast.shapes.fractals",
    "diffrast.shapes.lsystem",
    "diffrast.shapes",
    "diffrast._selection",
    "diffrast._varying",
    "diffrast._linear",
    "diffrast.raster.fixed_point",
    "diffrast.raster.edge_functions",
    "diffrast.raster.one_by_one",
    "diffrast.raster.all_at_once",
    "diffrast.raster.coverage",
    "diffrast.raster.evaluate",
    "diffrast.raster.fragments",
    "diffrast.raster",
    "diffrast.edges.planes",
    "diffrast.edges.pieces",
    "diffrast.edges.follow",
    "diffrast.edges.waiting",
    "diffrast.edges.parts",
    "diffrast.edges.neighborhood",
    "diffrast.edges.rim",
    "diffrast.edges.creases",
    "diffrast.edges.ways",
    "diffrast.edges.unseen",
    "diffrast.edges.shadow_planes",
    "diffrast.edges.shadow_ends",
    "diffrast.edges.shadow_overlap",
    "diffrast.edges.shadow_pairs",
    "diffrast.edges.shadow_beside",
    "diffrast.edges.shadow_lines",
    "diffrast.edges.visibility",
    "diffrast.edges.areas",
    "diffrast.edges.piercing",
    "diffrast.edges.records",
    "diffrast.edges.blend",
    "diffrast.edges.survey",
    "diffrast.edges.collect",
    "diffrast.edges.derivative",
    "diffrast.edges.antialias",
    "diffrast.edges",
    "diffrast.interpolate",
    "diffrast.light",
    "diffrast.texture.mapping",
    "diffrast.texture.kinds",
    "diffrast.texture.pyramid",
    "diffrast.texture.sampling",
    "diffrast.texture",
    "diffrast.material",
    "diffrast.scene",
    "diffrast.files.images",
    "diffrast.files._folder",
    "diffrast.files._look",
    "diffrast.files._mesh_text",
    "diffrast.files._mesh_writing",
    "diffrast.files._mtl",
    "diffrast.files._ply",
    "diffrast.files._gltf_structure",
    "diffrast.files._gltf_materials",
    "diffrast.files._gltf",
    "diffrast.files.meshes",
    "diffrast.files.objects",
    "diffrast.files.bezier",
    "diffrast.files.scenes",
    "diffrast.files",
    "diffrast.settings",
    "diffrast.geometry",
    "diffrast.shade",
    "diffrast.shadows.views",
    "diffrast.shadows.maps",
    "diffrast.shadows.near",
    "diffrast.shadows.lit",
    "diffrast.shadows.cast",
    "diffrast.shadows.outlines",
    "diffrast.shadows",
    "diffrast.texturing",
    "diffrast.lines.segments",
    "diffrast.lines.hidden",
    "diffrast.lines.pixels",
    "diffrast.lines.overlap",
    "diffrast.lines.blend",
    "diffrast.lines.drawing",
    "diffrast.lines.wireframe",
    "diffrast.lines",
    "diffrast.surface",
    "diffrast.deferred",
    "diffrast.bending",
    "diffrast.within",
    "diffrast.turning",
    "diffrast.render",
    "diffrast.recolor",
    "diffrast._chunks",
    "diffrast.views",
    "diffrast.scene_files",
    "diffrast._fit_result",
    "diffrast._least_squares",
    "diffrast._scale_space",
    "diffrast.fit",
    "diffrast._commands",
    "diffrast.__main__",
    "diffrast",
]


def module_name(file):
    parts = file.relative_to(ROOT.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(file): file for file in ROOT.rglob("*.py")}


def imported_modules(file):
    """Names of the package's modules that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file.name}: relative import in line {node.lineno}"
            parts = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [part if part in MODULES else node.module for part in parts]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] == "diffrast")


def test_every_module_has_its_place():
    assert sorted(ORDER) == sorted(MODULES)


@pytest.mark.parametrize("module", ORDER)
def test_imports_go_one_way(module):
    above = ORDER[: ORDER.index(module)]
    assert set(imported_modules(MODULES[module])) <= set(above)


def run_python(code, **environment):
    environment = os.environ | {"PYTHONPATH": str(ROOT.parent)} | environment
    command = [sys.executable, "-W", "error", "-c", code]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout.split()


def test_import_needs_no_optional_package():
    loaded = run_python("import sys, diffrast; print(*sys.modules)")
    assert "diffrast.render" in loaded
    assert not {"trimesh", "matplotlib", "tqdm", "scipy", "pytest"} & set(loaded)


def test_import_makes_no_arrays():
    # On a platform that does not exist, the first array is an error.
    no_arrays = "import diffrast"
    one_array = "import jax.numpy; jax.numpy.zeros(1)"
    assert run_python(f"{no_arrays}; print('ok')", JAX_PLATFORMS="no_such_platform") == ["ok"]
    with pytest.raises(AssertionError, match="no_such_platform"):
        run_python(one_array, JAX_PLATFORMS="no_such_platform")
