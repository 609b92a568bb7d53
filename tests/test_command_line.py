"""The command line, at tiny size."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrast as dr
from diffrast import _commands
from diffrast.__main__ import keep_programs, main, parser

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
    house = tmp_path / "house.dat"
    for head, line in (("{ a house\nwith a roof }\n", "17 13 13\n"), ("", "17 13 13{points}\n")):
        _, _, rest = (DATA / "house.dat").read_text(encoding="latin-1").partition("\n")
        house.write_text(head + line + rest)
        assert not _commands.is_scene_file(str(house))


def test_programs_are_kept_where_the_user_keeps_such_things(tmp_path, monkeypatch):
    kept = []
    monkeypatch.setattr(jax.config, "update", lambda name, folder: kept.append((name, folder)))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    keep_programs()
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    keep_programs()
    folders = [tmp_path / "diffrast", tmp_path / "home" / ".cache" / "diffrast"]
    assert kept == [("jax_compilation_cache_dir", str(folder)) for folder in folders]
    assert all(folder.is_dir() for folder in folders)
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))  # no folder can be made there
    keep_programs()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")
    keep_programs()
    assert len(kept) == 2


def test_what_belongs_to_no_face_is_not_framed():
    options = parser().parse_args(["render", "mesh.obj"])
    cube = dr.shapes.cube()
    lonely = dr.Mesh(vertices=np.concatenate([cube.vertices, [[999, 0, 0]]]), faces=cube.faces)
    wanted, got = (_commands._framing(options, mesh) for mesh in (cube, lonely))
    np.testing.assert_array_equal(got.eye, wanted.eye)
    assert got.radius == wanted.radius


def test_a_picture_that_is_shrunk_keeps_its_middle():
    picture = np.zeros((50, 71, 3), np.float32)
    picture[24:26, 35] = 1
    small, share = _commands._shrunk(jnp.asarray(picture), 20)  # 4 to one, 2 rows, 3 columns off
    assert small.shape == (12, 17, 3)
    assert share == 48 / 50
    small = np.asarray(small[..., 0])
    np.testing.assert_array_equal(np.argwhere(small), [[5, 8], [6, 8]])
    assert small[5, 8] == small[6, 8]


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
        camera = _commands._camera(framing._replace(eye=eye, target=target), 0.7)
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
        (["render", "cube", "--out", "nowhere/a.png"], "--out: wanted a file in a folder that is"),
        (["orbit", "cube", "--out", "orbit.png"], "--out: wanted a name that ends in .gif, got"),
        (["orbit", str(DATA / "scene1.dat")], "scene1.dat: wanted a mesh, got a scene file"),
    ],
)
def test_mistakes_are_told(arguments, message, capsys):
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_a_fit_tells_before_its_work_what_it_cannot_do(tmp_path, capsys):
    picture = tmp_path / "thin.png"
    dr.save_image(picture, np.zeros((2, 300, 3)))
    assert main(["fit", str(picture), "cube"]) == 2
    wanted = "--resolution: wanted at least 150 for a picture of 2 by 300 pixels, got 96"
    assert wanted in capsys.readouterr().err
    assert main(["fit", str(picture), "cube", "--resolution", "150", "--out", str(picture)]) == 2
    assert "thin.png" in capsys.readouterr().err


def test_options_out_of_range_are_refused(capsys):
    for arguments in (
        ["orbit", "cube", "--fps", "101"],
        ["fit", "picture.png", "cube", "--size", "9"],  # of no effect
        ["wireframe", "cube", "--light", "0", "0", "1"],
        ["gallery", "--no-antialias"],
        ["render"],
        ["render", "cube", "--fov", "180"],
        ["orbit", "cube", "--frames", "0"],
    ):
        with pytest.raises(SystemExit):
            main(arguments)
    assert "wanted an integer of at least 1, got 0" in capsys.readouterr().err
