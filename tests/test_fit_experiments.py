"""The experiments that fit shape and pose, at tiny size: what they find and what they write."""

import json

import common
import fit_light_from_shadow
import fit_materials
import fit_pose
import fit_rig
import fit_shape
import fit_texture
import jax.numpy as jnp
import numpy as np
import pytest

import diffrast as dr

pytestmark = pytest.mark.usefixtures("compiled_quickly")


def test_a_sphere_becomes_the_body(tmp_path):
    report = fit_shape.run(tmp_path, size=32, views=5, subdivisions=2, steps=60, smoothness=3.0)
    fitted = report["fits"]["visibility"]
    assert fitted["found"]["loss"] < 0.1 * fitted["at_start"]["loss"]
    assert fitted["found"]["mean_percent"] < 0.5 * fitted["at_start"]["mean_percent"]
    assert json.loads((tmp_path / "fit_shape.json").read_text())["vertices"] == 162
    assert (tmp_path / "fit_shape.png").is_file()


def test_the_pose_of_a_lattice_is_found(tmp_path):
    report = fit_pose.run(tmp_path, starts=1, size=48, cells=2, degrees=4.0, percent=2.0, steps=8)
    row = report["starts"][0]
    for name in fit_pose.CRITERION:
        assert row["visibility"][name] < 0.2 * row["at_start"][name]
    assert json.loads((tmp_path / "fit_pose.json").read_text())["seed"] == 0
    assert (tmp_path / "fit_pose.png").is_file()


def test_a_light_is_found_from_its_shadow(tmp_path):
    report = fit_light_from_shadow.run(tmp_path, kinds=("direction",), starts=1, size=48)
    (row,) = report["lights"]["direction"]["starts"]
    assert row["at_start"]["degrees"] > 1
    assert row["found"]["degrees"] < 0.5
    assert json.loads((tmp_path / "fit_light_from_shadow.json").read_text())["seed"] == 0
    assert (tmp_path / "fit_direction_from_shadow.png").is_file()


def test_a_rig_of_cameras_is_found_and_goes_on_where_it_stopped(tmp_path, monkeypatch):
    def without_edges(mesh, view, height, width, samples):
        return common.render_view(mesh, view, height, width, samples, antialias=False)

    monkeypatch.setattr(fit_rig, "render_view", without_edges)
    monkeypatch.setattr(fit_rig, "LEVELS", fit_rig.LEVELS[:1])
    asked = {"views": 3, "size": 32, "divisions": 2, "steps": 4}
    report = fit_rig.run(tmp_path / "whole", **asked)
    errors = [report[key]["light"]["light_0_diffuse"] for key in ("at_start", "found")]
    assert errors[1] < 0.5 * errors[0]
    drawn = []

    def interrupt(views):
        drawn.append(views)
        if sum(drawn) > 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_rig.run(tmp_path / "broken", told=interrupt, **asked)
    resumed = fit_rig.run(tmp_path / "broken", **asked)
    np.testing.assert_array_equal(resumed["losses"], report["losses"])
    assert resumed["found"] == report["found"]
    assert (tmp_path / "broken" / "fit_rig.png").is_file()
    with pytest.raises(ValueError, match="wanted the state of a fit of"):
        fit_rig.run(tmp_path / "broken", **(asked | {"seed": 1}))


def test_a_texture_is_found_from_views(tmp_path):
    report = fit_texture.run(tmp_path, size=24, views=4, rows=8, steps=60)
    assert report["found"]["mean_seen"] < 0.2 * report["at_start"]["mean_seen"]
    assert json.loads((tmp_path / "fit_texture.json").read_text())["texels"] == [8, 16]
    assert (tmp_path / "fit_texture.png").is_file()


def test_materials_are_found_with_lights_but_for_their_scales(tmp_path):
    report = fit_materials.run(tmp_path, size=32, steps=12, noise=0.0)
    for name, error in report["errors"].items():
        assert error < 0.05, name
    # Three channels' scales, the lamp's strength against its attenuation, a direction's length.
    exact = [item for item in report["unidentifiable"] if item["moved_by_noise"] > 100]
    assert len(exact) == 5
    direction = {f"direction[{i}]" for i in range(3)}
    assert any(set(item["parameters"]) == direction for item in exact)
    assert json.loads((tmp_path / "fit_materials.json").read_text())["parameters"] == 41
    assert (tmp_path / "fit_materials.png").is_file()


def test_distances_are_those_along_the_normal():
    unit = dr.shapes.icosphere(2).vertices
    surface = unit * fit_shape.body_radius(unit)[:, None]
    np.testing.assert_allclose(fit_shape.distances(surface), 0, atol=1e-6)
    fine = fit_shape.body(6).vertices
    for point in 1.04 * surface[:5]:
        nearest = jnp.min(dr.linalg.norm(fine - point))
        assert fit_shape.distances(point[None])[0] == pytest.approx(float(nearest), rel=0.2)


def test_the_lattice_is_a_closed_body_of_edge_length_one():
    mesh = fit_pose.lattice(3)
    assert dr.mesh.is_closed(mesh)
    assert 0 < dr.mesh.signed_volume(mesh) < 0.5
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), 1, rtol=1e-6)
    full = dr.mesh.signed_volume(fit_pose.lattice(2, missing=0.0, bar=0.25))
    assert full == pytest.approx((27 * 0.25**3 + 54 * 0.75 * 0.25**2) / 2.25**3, rel=1e-5)
