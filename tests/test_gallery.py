"""The gallery of the sources' figures, at tiny size."""

import gallery
import numpy as np
import pytest
from gallery_drawings import star_field
from gallery_scenes import head, trunk

import diffrast as dr
from diffrast import mesh as dm

pytestmark = pytest.mark.usefixtures("compiled_quickly")


def test_pictures_sheet_and_page_are_written(tmp_path):
    names = ["A_fig_04", "D_stars"]
    seconds = gallery.run(tmp_path, size=48, only=names)
    assert sorted(seconds) == names
    picture = np.asarray(dr.load_image(tmp_path / "A_fig_04.png"))
    assert picture.shape == (48, 48, 3)
    assert 0.1 < np.mean(picture.min(axis=-1) < 0.5) < 0.97
    assert (tmp_path / "D_stars.gif").is_file()
    assert dr.load_image(tmp_path / "contact_sheet.png").shape == (64, 96, 3)
    page = (tmp_path / "index.html").read_text()
    assert page.count("<figure>") == 2
    assert "Nine spirals" in page
    with pytest.raises(ValueError, match="only: wanted names among"):
        gallery.run(tmp_path, only=["Z_fig_1"])


def test_names_are_unique_and_captions_told():
    pictures = gallery.pictures()
    assert len({p.name for p in pictures}) == len(pictures) >= 35
    assert all(len(p.caption) > 5 for p in pictures)


def test_stars_come_nearer():
    frames = star_field(64, stars=200, frames=8)
    assert len(frames) == 8
    assert all(0.001 < (frame > 0).mean() < 0.2 for frame in frames)
    assert np.any(frames[0] != frames[1])


def test_meshes_of_our_own_are_sound():
    assert dm.is_closed(head())
    assert dm.euler_characteristic(head()) == 2
    assert dm.euler_characteristic(trunk()) == 0
    for mesh in (head(), trunk()):
        facets = np.asarray(dm.face_normals(mesh.vertices, mesh.faces))
        corners = np.asarray(mesh.normals)[mesh.faces]
        assert np.einsum("fc,fkc->fk", facets, corners).min() > 0.5
