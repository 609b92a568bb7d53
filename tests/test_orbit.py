"""The turntable experiment: what it writes, that it goes on, and that its cameras are right."""

import json

import jax
import numpy as np
import orbit
import pytest
from common import check_same, save_json

import diffrast as dr

SMALL = {"views": 3, "size": 16, "antialias": False}


def test_a_turntable_is_written_and_goes_on_where_it_stopped(tmp_path):
    mesh = dr.shapes.icosphere(1)
    assert orbit.run(mesh, tmp_path, **SMALL)["drawn"] == 3
    (tmp_path / "images" / "0001.png").unlink()
    seen = []
    result = orbit.run(mesh, tmp_path, **SMALL, told=lambda done, rate: seen.append(done))
    assert result["drawn"] == 1
    assert seen == [1]
    assert (tmp_path / "orbit.gif").is_file()
    assert dr.load_image(tmp_path / "sheet.png").shape == (48, 48, 3)
    with pytest.raises(ValueError, match="wanted a turntable of"):
        orbit.run(mesh, tmp_path, **{**SMALL, "views": 4})

    # Both descriptions of a camera bring the visible points to their pixels.
    known = json.loads((tmp_path / "cameras.json").read_text())["views"][1]
    frame = json.loads((tmp_path / "transforms.json").read_text())["frames"][1]
    depth = np.load(tmp_path / "depth" / "0001.npy")
    row, column = np.argwhere(depth > 0)[5]
    pixel = np.array([column + 0.5, row + 0.5, 1])
    rotation, shift = np.array(known["R"]), np.array(known["t"])
    point = rotation.T @ (depth[row, column] * np.linalg.solve(known["K"], pixel) - shift)
    assert 0.8 < np.linalg.norm(point) < 1.001  # on the ball
    assert known["image"] == frame["file_path"] == "images/0001.png"
    x, y, z, _ = np.linalg.solve(frame["transform_matrix"], [*point, 1])
    focal = 8 / np.tan(json.loads((tmp_path / "transforms.json").read_text())["camera_angle_x"] / 2)
    np.testing.assert_allclose([8 - focal * x / z, 8 + focal * y / z], pixel[:2], atol=1e-3)


def test_settings_of_any_number_of_digits_are_recognised(tmp_path):
    asked = {"elevation": np.radians(23.0), "rise": 1 / 3, "views": np.int64(2)}
    save_json(tmp_path / "asked.json", asked)
    before = json.loads((tmp_path / "asked.json").read_text())
    check_same(tmp_path / "asked.json", "a turntable", asked, before)
    with pytest.raises(ValueError, match=r"turntable of .*0\.418879.* got one of .*0\.4014"):
        check_same(tmp_path, "a turntable", {**asked, "elevation": np.radians(24.0)}, before)


def test_the_last_view_is_higher_by_all_of_the_rise(tmp_path):
    far = dr.Mesh(vertices=[(1000, 0, 0), (1002, 0, 0), (1001, 1, 1)], faces=[(0, 1, 2)])
    cameras = orbit.orbit_cameras(far, 2, 0.4, 0.7)
    backward = np.asarray(cameras.view)[:, 2, :3]
    np.testing.assert_allclose(np.arcsin(backward[:, 2]), [0.4, 1.1], atol=1e-5)
    np.testing.assert_allclose(backward[1, 0], -np.cos(1.1), atol=1e-5)  # half round
    assert np.isfinite(orbit.orbit_cameras(far, 1, 0.4, 0.7).view).all()
    # What is written of them has all the digits that they have.
    orbit.save_cameras(tmp_path, cameras, 2, 16)
    written = json.loads((tmp_path / "cameras.json").read_text())["views"][1]
    known = dr.camera.to_opencv(jax.tree.map(lambda x: x[1], cameras), height=16, width=16)
    np.testing.assert_array_equal(np.float32(written["t"]), known.translation)
