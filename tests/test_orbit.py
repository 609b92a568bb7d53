"""The turntable experiment: what it writes, that it goes on, and that its cameras are right."""

import json

import numpy as np
import orbit
import pytest

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
