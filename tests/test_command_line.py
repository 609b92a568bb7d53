"""The command line, at tiny size."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

import diffrast as dr
from diffrast import _commands
from diffrast.__main__ import main, parser

pytestmark = pytest.mark.usefixtures("compiled_quickly")

DATA = Path(__file__).parent / "data"
SMALL = ["--size", "24", "--no-antialias"]


def test_render_and_orbit_draw_a_mesh(tmp_path, capsys):
    mesh = tmp_path / "cube.off"
    dr.save_mesh(mesh, dr.shapes.cube())
    out = tmp_path / "cube.png"
    assert main(["render", str(mesh), "--out", str(out), *SMALL]) == 0
    assert "24 by 24 pixels" in capsys.readouterr().out
    picture = np.asarray(dr.load_image(out))
    assert picture.shape == (24, 24, 3)
    covered = picture.max(axis=-1) > 0
    assert covered[12, 12]
    assert 0.2 < covered.mean() < 0.7
    assert not covered[[0, -1]].any()
    assert not covered[:, [0, -1]].any()
    out = tmp_path / "orbit.gif"
    turn = ["orbit", str(mesh), "--out", str(out), "--frames", "3", "--quiet"]
    assert main([*turn, *SMALL]) == 0
    assert out.read_bytes()[:4] == b"GIF8"


def test_wireframes_and_scene_files(tmp_path):
    out = tmp_path / "wire.png"
    arguments = ["cube", "--out", str(out), "--hidden", *SMALL]
    assert main(["wireframe", *arguments, "--normals", "0.5"]) == 0
    assert 0.05 < np.mean(np.asarray(dr.load_image(out)).max(axis=-1) > 0) < 0.6
    scene = str(DATA / "scene1.dat")
    assert _commands.is_scene_file(scene)
    assert not _commands.is_scene_file(str(DATA / "house.dat"))


def test_fit_finds_a_light(tmp_path):
    out = tmp_path / "target.png"
    view = ["--color", "0.6", "0.6", "0.6", "--no-antialias"]
    drawn = ["render", "cube", "--out", str(out), "--light", "-0.6", "0.4", "-0.9"]
    assert main([*drawn, "--size", "24", *view]) == 0
    arguments = ["--out", str(tmp_path / "fit"), "--resolution", "24", "--quiet", *view]
    assert main(["fit", str(out), "cube", *arguments]) == 0
    report = json.loads((tmp_path / "fit" / "fit.json").read_text())
    assert dr.load_image(tmp_path / "fit" / "fit.png").shape == (24, 72, 3)
    assert len(report["eye"]) == len(report["target"]) == len(report["light_direction"]) == 3
    assert report["rms"] < 0.01


@pytest.mark.parametrize(
    ("eye", "target"),
    [((4, -8, 2), (4, 0, 0)), ((-4, 0, 2), (4, 0, 0)), ((0.3, 0.2, 1.9), (0, 0, 0))],
)
def test_a_camera_that_moves_does_not_cut_the_mesh(eye, target):
    options = parser().parse_args(["orbit", "cube"])
    cube = dr.shapes.cube()
    framing = _commands._framing(options, cube)

    @jax.jit
    def clip(eye, target):
        camera = _commands._camera(options, framing._replace(eye=eye, target=target))
        return dr.world_to_clip(camera, cube.vertices)

    _, _, z, w = np.asarray(clip(np.array(eye, float), np.array(target, float))).T
    assert (w > 0.5).all()
    assert (abs(z) < w).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["render", "nothing.obj"], "nothing.obj: there is no such file, and no such shape among"),
        (["render", str(DATA / "scene1-as-printed.dat")], "scene1-as-printed.dat:19: wanted"),
        (["render", "cube", "--operation", "phong"], "--operation is for scene files"),
        (["render", str(DATA / "scene1.dat"), "--size", "9"], "leave out --size"),
        (
            ["render", str(DATA / "scene1.dat"), "--shading", "flat", "--eye", "1", "2", "3"],
            "leave out --eye --shading",
        ),
        (
            ["wireframe", str(DATA / "scene1.dat"), "--hidden", "--line-width", "2"],
            "leave out --hidden --line-width",
        ),
        (["wireframe", str(DATA / "scene1.dat"), "--normals", "2"], "use render --operation"),
        (["orbit", "cube", "--up", "0", "0", "0"], "--up: wanted finite numbers that are not all"),
        (["render", "cube", "--samples", "3", "--size", "9"], "samples: wanted a square number"),
    ],
)
def test_mistakes_are_told(arguments, message, capsys):
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_options_out_of_range_are_refused(capsys):
    for arguments in (
        ["render"],
        ["render", "cube", "--fov", "180"],
        ["orbit", "cube", "--frames", "0"],
    ):
        with pytest.raises(SystemExit):
            main(arguments)
    assert "wanted an integer of at least 1, got 0" in capsys.readouterr().err
