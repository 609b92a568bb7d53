"""Strained scenes: a tiny run of the experiment."""

import json

import numpy as np
import pytest
import stability
import stress_measures
import stress_scenes

SMALL = {"size": 8, "batch": 56}

pytestmark = pytest.mark.usefixtures("compiled_quickly")


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stability")
    stability.run(folder, scenes=112, groups=["plain"], **SMALL)
    return folder


def test_strained_scenes_are_finite_and_right(results):
    assert (results / "stability.png").is_file()
    report = json.loads((results / "stability.json").read_text())
    assert report["scenes"] == {"plain": 112}
    assert report["failures"] == {}
    totals = report["totals"]["plain"]
    for what in ("value", "forward", "backward"):
        assert totals[f"{what} not finite"] == 0
    assert totals["wrong"] == 0
    assert all(totals[f"{change}: wrong"] == 0 for change in stress_scenes.INVARIANCES)
    assert totals["share unclear"]["mean"] < 0.2
    assert totals["directions apart"]["worst"] < 0.1


def test_a_failed_scene_is_drawn_again(results, monkeypatch):
    case = stress_scenes.case(3)
    name = stability._save(results, "plain, wrong, a: b", "plain", case, *SMALL.values())
    assert name == "plain-wrong-a_b.npz"
    again = stability.replay(results / name)
    assert again["wrong"] == 0
    assert again["error"] < 1e-4

    monkeypatch.setattr(stress_measures.stress_reference, "BACKGROUND", (1.0, 0.0, 0.0))
    assert stability.replay(results / name)["wrong"] > 0


def test_a_picture_with_edges_is_held_to_what_shaking_changes():
    truth = np.full((1, 4, 4, 3), 0.5)
    change = np.zeros((1, 4, 4))
    change[0, 0], change[0, 1] = 1e-3, 0.5  # some doubt, and no telling what is there
    for error, wrong in ((2e-4, 0), (5e-3, 8), (0.1, 12)):
        found = stress_measures.against_double(truth + error, truth, change)
        assert found["float64: wrong"] == wrong
        assert found["float64: share unclear"] == 0.25
    assert found["float64: error"] == pytest.approx(0.1)


def test_shaking_moves_what_is_seen_by_less_than_a_hundredth_of_a_pixel():
    parts = stress_scenes.stacked([stress_scenes.case(number).parts for number in (5, 21)])
    exact = {key: part.astype(float) for key, part in parts.items()}
    other = stress_measures.shaken(exact, 16, np.random.default_rng(0))
    forward = stress_scenes.unit(exact["target"] - exact["eye"])[:, None]
    moved = other["vertices"] - exact["vertices"]
    away = np.linalg.norm(exact["vertices"] - exact["eye"][:, None], axis=-1)
    across = np.linalg.norm(moved - forward * np.sum(moved * forward, -1, keepdims=True), axis=-1)
    pixel = 2 * np.tan(exact["fov_y"] / 2)[:, None] / 16
    assert 1e-3 < np.max(across / away / pixel) < 1e-2
    assert np.max(np.abs(other["normals"] - exact["normals"])) < 1e-4


def test_scenes_depend_on_their_number_alone():
    for number in (0, 5, 15, 40):
        one, other = stress_scenes.case(number), stress_scenes.case(number)
        assert (one.stressor, one.magnitude) == (other.stressor, other.magnitude)
        for key, part in one.parts.items():
            np.testing.assert_array_equal(part, other.parts[key])
            assert part.shape == stress_scenes.case(number + 1).parts[key].shape


@pytest.mark.parametrize("change", stress_scenes.INVARIANCES)
def test_what_changes_nothing_keeps_the_triangles(change):
    parts = stress_scenes.case(13).parts
    other = stress_scenes.INVARIANCES[change](np.random.default_rng(0), parts)

    def sizes(parts):
        corners = parts["vertices"].astype(float)[parts["faces"]]
        lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        return np.sort(lengths.ravel()) / float(parts["size"])

    np.testing.assert_allclose(sizes(other), sizes(parts), rtol=1e-3)
