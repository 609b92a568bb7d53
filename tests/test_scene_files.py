"""The thesis's object and scene files."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

import diffrast as dr
from diffrast import mesh as dm
from diffrast.files.scenes import (
    OPERATIONS,
    PlacedFile,
    load_polygons,
    load_scene_file,
    save_polygons,
    save_scene_file,
)

pytestmark = pytest.mark.usefixtures("compiled_quickly")

DATA = Path(__file__).parent / "data"


def test_objects_are_read_written_and_meshed(tmp_path):
    house = load_polygons(DATA / "house.dat")
    assert house.points.shape == (17, 3)
    assert [len(ids) for ids in house.polygons] == [5, 5, *[4] * 11]
    assert house.polygons[9] == (0, 13, 16, 12)
    save_polygons(tmp_path / "house.dat", house)
    again = load_polygons(tmp_path / "house.dat")
    np.testing.assert_array_equal(again.points, house.points)
    np.testing.assert_array_equal(again.surfaces, house.surfaces)
    assert again.polygons == house.polygons
    mesh = house.mesh
    assert mesh.faces.shape == (2 * 3 + 11 * 2, 3)
    # Every polygon is a surface of its own: normals are those of the faces.
    facets = np.asarray(dm.face_normals(mesh.vertices, mesh.faces))
    np.testing.assert_allclose(
        np.asarray(mesh.normals)[mesh.faces], np.repeat(facets[:, None], 3, axis=1), atol=1e-6
    )
    patch = load_polygons(DATA / "patch.dat").mesh
    assert patch.vertices.shape == (25, 3)  # one surface: smooth
    converted = dr.shapes.bezier_mesh(
        dr.load_bezier(DATA / "patch.bez").control_points, 4, merge_tolerance=1e-4
    )
    np.testing.assert_allclose(patch.vertices, converted.vertices, atol=5e-7)


def test_scenes_are_read_and_written(tmp_path):
    scene = load_scene_file(DATA / "scene1.dat")
    assert scene.projection == "perspective"
    assert scene.operation == "phong"
    assert scene.window == (8, 8)
    assert scene.raster_height == 150
    assert scene.light == (0, 1, 1)
    assert scene.objects == (
        PlacedFile("house.dat", (1.6, 1, 1), (-60, 2, 0), (0, 0, 0)),
        PlacedFile("patch.dat"),
    )
    save_scene_file(tmp_path / "scene.dat", scene)
    assert load_scene_file(tmp_path / "scene.dat") == scene
    # The order of the thesis's program: names first.
    lines = (DATA / "scene1.dat").read_text().splitlines()
    turned = [*lines[:12], lines[15], *lines[12:15], lines[19], *lines[16:19]]
    (tmp_path / "turned.dat").write_text("\n".join(turned))
    assert load_scene_file(tmp_path / "turned.dat") == scene


def test_what_follows_the_last_object_is_told(tmp_path):
    lines = (DATA / "scene1.dat").read_text().splitlines()
    path = tmp_path / "scene.dat"
    path.write_text("\n".join([*lines, "{that was all}", "", "{really}"]))
    assert load_scene_file(path) == load_scene_file(DATA / "scene1.dat")
    path.write_text("\n".join([*lines[:11], "1 {object}", *lines[12:]]))
    with pytest.raises(ValueError, match=":17: wanted the end of the file after 1 objects, got"):
        load_scene_file(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"projection": "x"}, "scene.projection: wanted one of parallel, perspective, got 'x'"),
        ({"operation": "draw"}, "scene.operation: wanted one of"),
        ({"light": (0, float("nan"), 1)}, "scene.light: wanted a finite number, got nan"),
        ({"window": (8, -8)}, "scene:7: wanted a window's width and height above 0"),
        ({"raster_height": 0}, "scene:8: wanted a number of rows of at least 1"),
        ({"output": ""}, "scene.output: wanted a name without blanks and braces, got ''"),
        ({"objects": (PlacedFile("my house.dat"),)}, r"scene.objects\[0\].name: wanted a name"),
        ({"objects": (PlacedFile("a", (1, 1)),)}, r"scene.objects\[0\].scale: wanted 3 numbers"),
    ],
)
def test_scenes_that_could_not_be_read_are_not_written(tmp_path, change, message):
    scene = dataclasses.replace(load_scene_file(DATA / "scene1.dat"), **change)
    with pytest.raises(ValueError, match=message):
        save_scene_file(tmp_path / "scene.dat", scene)
    assert not (tmp_path / "scene.dat").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.full((17, 3), np.nan)}, "polygons:2: wanted x of point 0, got 'nan'"),
        ({"points": np.zeros((17, 2))}, r"polygons.points: wanted shape \(points, 3\), got"),
        ({"polygons": ((0, 1, 17),) * 13}, "polygons:19: wanted a point of polygon 0, an integer"),
        ({"polygons": (), "surfaces": np.zeros(0, int)}, "polygons:1: wanted the number of polyg"),
        ({"surfaces": np.full(13, -1)}, "polygons:1: wanted the number of surfaces"),
        ({"surfaces": np.zeros(12, int)}, r"polygons.surfaces: wanted shape \(13,\), got \(12,\)"),
    ],
)
def test_polygons_that_could_not_be_read_are_not_written(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        save_polygons(tmp_path / "a.dat", load_polygons(DATA / "house.dat")._replace(**change))
    assert not (tmp_path / "a.dat").exists()


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (1, "2 x", r":1: wanted the type of projection, an integer in \[0, 2\), got '2 x'"),
        (3, "0", ":3: wanted a distance of the centre of projection above 0"),
        (4, "1.5 two 0", r":4: wanted the view reference point \(VRP\), 3 numbers"),
        (7, "8 -8", ":7: wanted a window's width and height above 0"),
        (9, "4 draw", ":9: wanted the operation"),
        (11, "", ":11: wanted the name of the file for the result"),
        (14, "1 nan 2", ":14: wanted the rotation of object 1 of 2, 3 numbers"),
        (14, "1 1_0 2", ":14: wanted the rotation of object 1 of 2, 3 numbers"),
        (8, "\u0661", ":8: wanted the number of rows, 1 number"),
    ],
)
def test_broken_scenes_name_file_and_line(tmp_path, line, text, message):
    lines = (DATA / "scene1.dat").read_text().splitlines()
    lines[line - 1] = text
    path = tmp_path / "broken.dat"
    path.write_text("\n".join(lines))
    with pytest.raises(ValueError, match="broken.dat" + message):
        load_scene_file(path)


def test_the_scene_as_printed_ends_too_early():
    wanted = r"scene1-as-printed.dat:19: wanted the file name of object 2 of 2, got the end"
    with pytest.raises(ValueError, match=wanted):
        load_scene_file(DATA / "scene1-as-printed.dat")


def test_broken_objects_name_file_and_line(tmp_path):
    lines = (DATA / "house.dat").read_text().splitlines()
    for number, text, message in (
        (3, "1 16.0 0.0", "3: wanted z of point 1|4: wanted point number"),
        (3, "1 16.0 0.0 1_0", "3: wanted z of point 1, got '1_0'"),
        (3, "\u0661 16.0 0.0 10", "3: wanted point number 1, got '\u0661'"),
        (20, "1 1 5 9 8 7 6 99", "20: wanted a point of polygon 1, an integer in"),
        (19, "0 13 5 0 1 2 3 4", "19: wanted the surface of polygon 0, an integer in"),
    ):
        path = tmp_path / "house.dat"
        path.write_text("\n".join([*lines[: number - 1], text, *lines[number:]]))
        with pytest.raises(ValueError, match=message):
            load_polygons(path)


def test_a_scene_is_seen_as_its_program_sees_it():
    file = dr.read_scene(DATA / "scene1.dat")
    assert (file.height, file.width) == (150, 150)
    # A point in the plane through VRP is where the window has it, at any distance of the viewer.
    clip = dr.world_to_clip(file.camera, np.array([[1.5, 2, 0], [5.5, 6, 0], [1.5, 2, 35]]))
    seen = np.asarray(clip[:, :2] / clip[:, 3:])
    np.testing.assert_allclose(seen, [[0, 0], [1, 1], [0, 0]], atol=1e-5)
    assert len(file.edges[1]) == 40  # 16 cells of a grid
    assert len(file.edges[0]) == len({tuple(e) for e in file.edges[0].tolist()})
    corners = np.asarray(file.scene.objects[0].mesh.vertices)[file.edges[0]]
    lengths = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)
    assert lengths.min() == 4


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1"])
def test_files_in_any_encoding_of_their_letters(tmp_path, encoding):
    house = (DATA / "house.dat").read_text(encoding="latin-1") + "{à}"
    (tmp_path / "à.dat").write_text(house, encoding=encoding)
    scene = (DATA / "scene1.dat").read_text(encoding="latin-1").replace("house.dat", "à.dat")
    (tmp_path / "scene.dat").write_text(scene, encoding=encoding)
    (name,) = {item.name for item in load_scene_file(tmp_path / "scene.dat").objects} - {
        "patch.dat"
    }
    assert name == "à.dat"
    read = load_polygons(tmp_path / name)
    np.testing.assert_array_equal(read.points, load_polygons(DATA / "house.dat").points)


def test_names_of_any_letters_are_written(tmp_path):
    scene = load_scene_file(DATA / "scene1.dat")
    scene = dataclasses.replace(scene, objects=(PlacedFile("Ã\u20ac.dat"), PlacedFile("Ω.dat")))
    save_scene_file(tmp_path / "scene.dat", scene)
    assert load_scene_file(tmp_path / "scene.dat") == scene


def test_a_scene_renders_in_all_its_operations(tmp_path):
    scene = dataclasses.replace(load_scene_file(DATA / "scene1.dat"), raster_height=40)
    for name in ("house.dat", "patch.dat"):
        (tmp_path / name).write_text(
            (DATA / name).read_text(encoding="latin-1"), encoding="latin-1"
        )
    save_scene_file(tmp_path / "small.dat", scene)
    shares = {}
    for operation in OPERATIONS:
        image = dr.render_scene_file(tmp_path / "small.dat", operation=operation, antialias=False)
        assert image.shape == (40, 40, 3)
        shares[operation] = float(np.mean(np.asarray(image).max(axis=-1) > 0))
    # The patch is 3 of 8 wide and 6 of 8 high.
    np.testing.assert_allclose([shares["phong"], shares["gouraud"]], 18 / 64, rtol=0.06)
    assert 0.05 < shares["wireframe"] < shares["normals"] < 0.25
    with pytest.raises(ValueError, match="operation: wanted one of wireframe, normals"):
        dr.render_scene_file(tmp_path / "small.dat", operation="raytrace")


@pytest.mark.parametrize(
    ("window", "rows", "columns"),
    [((1.1, 1.1), 240, 240), ((0.3, 0.1), 512, 1536), ((0.7, 0.7), 3, 3), ((3, 2), 3, 4)],
)
def test_no_column_is_lost_by_rounding(tmp_path, window, rows, columns):
    scene = dataclasses.replace(load_scene_file(DATA / "scene1.dat"), window=window, objects=())
    path = tmp_path / "scene.dat"
    save_scene_file(path, dataclasses.replace(scene, raster_height=rows))
    file = dr.read_scene(path)
    assert (file.height, file.width) == (rows, columns)


def test_a_scene_is_read_inside_of_jit():
    path = DATA / "scene1.dat"
    camera = jax.jit(lambda: dr.read_scene(path).camera)()
    np.testing.assert_array_equal(camera.projection, dr.read_scene(path).camera.projection)
