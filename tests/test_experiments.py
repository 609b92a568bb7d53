"""The experiments, at tiny size: what they find and what they write."""

import dataclasses
import json
import sys

import common
import fit_camera
import fit_camera_and_lights
import fit_lights
import fit_robustness
import fitting
import jax.numpy as jnp
import numpy as np
import optax
import parameters
import pytest

import diffrast as dr

pytestmark = pytest.mark.usefixtures("compiled_quickly")


@pytest.fixture(scope="module")
def problem():
    return common.load_problem(common.DEFAULT_TARGET).shrunk(8)


def check_files(folder, name, report):
    assert json.loads((folder / f"{name}.json").read_text())["renders"] == report["renders"]
    assert dr.load_image(folder / f"{name}.png").shape == (64, 256, 3)
    assert (folder / f"{name}_convergence.png").is_file()


def test_camera_and_lights_are_found_together(problem, tmp_path):
    report = fit_camera_and_lights.run(problem, tmp_path)
    errors = report["errors"]
    assert errors["rotation_degrees"] < 0.2
    assert errors["eye_percent"] < 0.5
    assert errors["light_0_degrees"] < 0.5
    assert errors["light_0_diffuse"] < 0.01
    assert report["image_difference"] < 1 < report["image_difference_at_start"]
    check_files(tmp_path, problem.name, report)
    assert "rotation_degrees" in fitting.summary(report)


def test_camera_is_found_under_known_lights(problem, tmp_path):
    report = fit_camera.run(problem, tmp_path)
    assert report["fitted"] == ["camera"]
    assert report["errors"]["rotation_degrees"] < 0.2
    assert report["errors"]["light_0_degrees"] == 0
    check_files(tmp_path, problem.name, report)


def test_lights_and_material_are_found_for_a_known_camera(problem, tmp_path):
    report = fit_lights.run(problem, tmp_path, known_material=False)
    assert report["errors"]["light_0_degrees"] < 0.5
    assert report["errors"]["light_0_diffuse"] < 0.01
    assert report["errors"]["shininess_percent"] < 5
    np.testing.assert_array_equal(
        report["recovered"].lights[0].diffuse, 0.5
    )  # the scale that stays
    check_files(tmp_path, problem.name, report)


def test_robustness_compares_methods_and_goes_on(tmp_path, monkeypatch):
    # Light alone needs no edges; one optimizer for both levels compiles once.
    levels = [fitting.Level(1, 4, 4.0, 20, False), fitting.Level(1, 4, 1.0, 20, True)]
    search = optax.lbfgs()
    monkeypatch.setattr(fit_robustness, "optimizer", lambda *_: search)
    methods = ("levenberg_marquardt", "several_lights", "l_bfgs")
    monkeypatch.setattr(fit_robustness, "METHODS", methods)

    def without_edges(mesh, view, height, width, samples=4):
        return common.render_view(mesh, view, height, width, samples, antialias=False)

    monkeypatch.setattr(fit_robustness, "render_view", without_edges)
    asked = {"problems": ["light"], "starts": 1, "size": 32, "divisions": 2, "steps": 2}
    asked["methods"] = fit_robustness.METHODS
    report = fit_robustness.run(tmp_path, levels=levels, **asked)
    lm, several, lbfgs = (report["found"]["light"][name] for name in fit_robustness.METHODS)
    assert lm["median_light_0_degrees"] < 1
    assert several["median_light_0_degrees"] < 1
    assert several["median_renders"] > 4 * lm["median_renders"]
    assert lbfgs["share_converged"] == 0
    assert lbfgs["median_renders"] > 2 * 3  # line searches are counted
    stored = json.loads((tmp_path / "fit_robustness.json").read_text())
    assert [len(rows) for rows in stored["starts"]["light"].values()] == [1, 1, 1]
    assert (tmp_path / "fit_robustness.png").is_file()
    assert (tmp_path / "failures_l_bfgs.png").is_file()

    told = []
    asked["methods"] = ["l_bfgs"]
    again = fit_robustness.run(tmp_path, levels=levels, told=lambda: told.append(1), **asked)
    assert not told
    assert again["found"] == stored["found"]
    with pytest.raises(ValueError, match="wanted a report of"):
        fit_robustness.run(tmp_path, levels=levels, **(asked | {"steps": 3}))


def test_some_light_of_several_is_near_any():
    params = {"lights": [{"move": np.zeros(2), "diffuse": np.ones(3)}]}
    moves = [other["lights"][0]["move"] for other in fit_robustness.lights_around(params)]
    light = np.array([0.1, -0.5, 0.4])
    tried = np.stack([dr.fit.direction_update(light, move) for move in moves])
    anywhere = np.random.default_rng(0).normal(size=(1000, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    nearest = np.degrees(np.arccos(np.max(anywhere @ tried.T, axis=1)))
    assert len(tried) == 9
    assert nearest.max() < 55
    assert fit_robustness.lights_around({"camera": 1}) == [{"camera": 1}]


def test_starts_are_as_far_off_as_they_say(problem):
    generator = np.random.default_rng(0)
    for name, parts in fit_robustness.PROBLEMS.items():
        view = fit_robustness.random_start(name, problem.mesh, problem.truth, 30.0, generator)
        errors = parameters.view_errors(view, problem.truth, 1.0)
        assert (0.01 < errors["rotation_degrees"] < 30.1) == parts["camera"]
        assert (errors["light_0_degrees"] > 0.1) == parts["lights"]


# The parts they share -----------------------------------------------------------------------------


def test_camera_parameters_are_scaled_to_the_picture(problem):
    start = parameters.start_of(problem.mesh, problem.start)

    def pivot_pixel(values):
        camera = dr.Camera.perspective(**parameters.moved_camera(start, jnp.asarray(values)))
        clip = dr.world_to_clip(camera, start.pivot)
        return dr.clip_to_pixel(clip, height=64, width=64)

    at_start = pivot_pixel(np.zeros(7, np.float32))
    expected = problem.start.camera
    camera = parameters.moved_camera(start, jnp.zeros(7))
    errors = parameters.camera_errors(camera, expected)
    assert max(errors.values()) < 1e-3
    turned = pivot_pixel(np.array([0.3, -0.2, 0.1, 0, 0, 0, 0], np.float32))
    np.testing.assert_allclose(turned, at_start, rtol=1e-4)
    shifted = pivot_pixel(np.array([0, 0, 0, 0.25, 0.5, 0, 0], np.float32))
    np.testing.assert_allclose(shifted[:2] - at_start[:2], [8, -16], atol=1e-3)
    wide = parameters.moved_camera(start, jnp.zeros(7).at[6].set(0.5))
    depth = [1 / pivot_pixel(np.eye(7, dtype=np.float32)[6] * s)[2] for s in (0.0, 0.5)]
    sizes = [d * np.tan(c["fov_y"] / 2) for d, c in zip(depth, (camera, wide), strict=True)]
    np.testing.assert_allclose(sizes[1], sizes[0], rtol=1e-5)


def test_errors_of_the_truth_are_zero(problem):
    errors = parameters.view_errors(problem.truth, problem.truth, 1.0)
    assert max(errors.values()) < 1e-3
    assert parameters.view_errors(problem.start, problem.truth, 1.0)[
        "light_0_degrees"
    ] == pytest.approx(20, abs=1e-3)


def test_levels_end_at_full_size():
    levels = fitting.coarse_to_fine(512, 768)
    assert [level.shrink for level in levels] == [4, 4, 1]
    assert {level.shrink for level in fitting.coarse_to_fine(97, 101)} == {1}


def test_patience_ends_a_fit_that_stalls_but_not_one_that_has_not_begun():
    stalls, begins = fitting.Patience(), fitting.Patience()
    assert [stalls(i, {}, loss) for i, loss in enumerate([2.0, 1, 1, 1, 1])] == [False] * 4 + [True]
    assert not any(begins(i, {}, 2.0) for i in range(9))


def test_a_picture_of_ones_own_needs_no_json(problem, tmp_path):
    dr.save_image(tmp_path / "photo.png", problem.target)
    own = common.problem_from_picture(
        "teapot.bez",
        str(tmp_path / "photo.png"),
        eye=[8.0, -6.0, 4.0],
        target=[0.0, 0.0, 1.0],
        up=[0.0, 0.0, 1.0],
        fov_y=0.7,
    )
    assert own.truth is None
    np.testing.assert_allclose(own.start.background, problem.start.background, atol=0.01)


def test_broken_problems_are_named(tmp_path):
    description = json.loads(common.DEFAULT_TARGET.read_text())
    path = tmp_path / "problem.json"

    def load_with(**changes):
        path.write_text(json.dumps(description | changes))
        return common.load_problem(path)

    with pytest.raises(FileNotFoundError, match=r"mesh 'no/mesh\.obj'"):
        load_with(mesh="no/mesh.obj")
    with pytest.raises(FileNotFoundError):
        load_with(image="no.png")
    path.write_text("{}")
    with pytest.raises(ValueError, match=r"\['image', 'mesh', 'start'\]"):
        common.load_problem(path)
    (tmp_path / "cube.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert common.load_mesh("cube.obj", tmp_path / "deeper").normals.shape == (3, 3)


def test_unknown_lights_are_named(problem, tmp_path):
    dr.save_image(tmp_path / "picture.png", problem.target)
    description = json.loads(common.DEFAULT_TARGET.read_text())
    description["start"]["lights"][0]["type"] = "laser"
    path = tmp_path / "problem.json"
    path.write_text(json.dumps(description | {"image": "picture.png"}))
    with pytest.raises(ValueError, match="got 'laser'"):
        common.load_problem(path)


def test_plots_without_matplotlib_say_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"diffrast\[plot\]"):
        common.pyplot()


def test_json_holds_numbers_only(tmp_path):
    @dataclasses.dataclass(frozen=True)
    class Item:
        value: object

    common.save_json(tmp_path / "a" / "b.json", {"x": Item((jnp.arange(2) / 3, np.int32(4), None))})
    assert json.loads((tmp_path / "a" / "b.json").read_text()) == {
        "x": {"value": [[0, 0.333333], 4, None]}
    }
