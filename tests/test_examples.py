"""The examples of the docstrings and of the README do what they say."""

import doctest
import importlib
import pkgutil
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrast as dr

pytestmark = pytest.mark.usefixtures("compiled_quickly")

NAMES = {"jax": jax, "jnp": jnp, "np": np, "dr": dr}
ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"


def with_examples():
    """Modules of the library with examples; `__main__` would run."""
    for found in pkgutil.walk_packages(dr.__path__, "diffrast."):
        source = Path(found.module_finder.path, found.name.rpartition(".")[2])
        files = [source.with_suffix(".py"), source / "__init__.py"]
        if any(file.is_file() and ">>>" in file.read_text() for file in files):
            yield found.name


def test_docstrings():
    names = list(with_examples())
    assert len(names) > 10
    for name in names:
        result = doctest.testmod(importlib.import_module(name), extraglobs=NAMES)
        assert result.attempted > 0
        assert result.failed == 0, name


def test_readme(tmp_path, monkeypatch):
    """With small and jagged pictures, and what the reader is to bring along."""
    monkeypatch.chdir(tmp_path)
    dr.save_image("wood.png", np.full((4, 4, 3), 0.5))
    dr.save_mesh("house.obj", dr.shapes.cube())
    mesh = dr.shapes.cube()
    camera = dr.Camera.perspective(eye=(3, 4, 5), target=(0, 0, 0), fov_y=0.6, near=1, far=20)
    scene = dr.Scene(
        objects=[dr.Object(mesh)], lights=[dr.DirectionalLight(direction=(-1, -2, -3))]
    )
    names = NAMES | {
        "mesh": mesh,
        "positions_clip": dr.world_to_clip(camera, mesh.vertices),
        "my_shading": lambda fragments: jnp.where(fragments.face[..., None] >= 0, 1.0, 0.0),
        "scene": scene,
        "cameras": [camera, camera],
        "loss": lambda parameters, view: parameters * jnp.sum(view),
        "views": jnp.arange(3.0),
        "parameters": 2.0,
        "draw": lambda shared, view: shared * view,
        "shared": 3.0,
        "earth": jnp.ones((4, 8, 3)),
        "six": jnp.ones((6, 4, 4, 3)),
    }
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    assert len(blocks) >= 5
    smaller = {"256": "16", "teapot(10)": "teapot(2)", "cull_backfaces=True": "antialias=False"}
    for block in blocks:
        for ours, less in smaller.items():
            block = block.replace(ours, less)
        exec(block, names)
    assert names["picture"].ndim == 3
    assert float(jnp.linalg.norm(names["gradient"])) > 0
    assert names["images"].shape == (2, 16, 16, 3)
    assert Path("teapot.png").is_file()


def test_the_readme_names_what_there_is():
    text = README.read_text()
    for name in set(re.findall(r"`(\w+\.py)`", text)):
        assert (ROOT / "tests" / name).is_file(), name
    for name in set(re.findall(r"(?:experiments|diffrast|tests)/[\w/]+\.\w+", text)):
        assert (ROOT / name).is_file(), name
    for name in set(re.findall(r"`dr\.([\w.]+)", text)):
        thing = dr
        for part in name.split("."):
            thing = getattr(thing, part)
