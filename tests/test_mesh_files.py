import base64
import builtins
import dataclasses
import itertools
import json
import logging
import struct
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import diffrast as dr
from diffrast import mesh as dm
from diffrast import shapes
from diffrast.files.meshes import SUFFIXES, load_mesh, load_mesh_parts, save_mesh
from diffrast.files.objects import load_objects

MODELS = Path(__file__).parents[1] / ".." / "shared" / "data" / "meshes"
HOLDS_NORMALS = (".obj", ".ply", ".glb", ".gltf")


def corners(mesh, name="vertices"):
    """Values at the corners of the faces: what a mesh is, however its vertices are numbered."""
    return np.asarray(getattr(mesh, name))[np.asarray(mesh.faces)]


def write(path, text):
    path.write_text(text)
    return path


# ----------------------------------------------------------------------------------- round trips


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("full", [True, False])
def test_round_trip_keeps_everything_the_format_holds(tmp_path, suffix, full):
    mesh = shapes.torus(1.0, 1 / 3, major_segments=5, minor_segments=4)
    if not full:
        mesh = dataclasses.replace(mesh, normals=None, uvs=None)
    path = tmp_path / f"torus{suffix.upper() if full else suffix}"
    save_mesh(path, mesh)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    read = load_mesh(str(path))
    np.testing.assert_array_equal(corners(read), corners(mesh))
    if suffix != ".stl":
        np.testing.assert_array_equal(read.faces, mesh.faces)
    if full and suffix in HOLDS_NORMALS:
        np.testing.assert_allclose(corners(read, "normals"), corners(mesh, "normals"), atol=1e-6)
        np.testing.assert_allclose(corners(read, "uvs"), corners(mesh, "uvs"), atol=1e-6)
    else:
        assert read.normals is None
        assert read.uvs is None


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_nothing_is_merged_dropped_or_lost_to_few_digits(tmp_path, suffix):
    # Copies of vertices, a face without area, a vertex that no face uses, far from unit size.
    mesh = shapes.cube()
    spare = jnp.ones((1, 3))
    mesh = dm.Mesh(
        vertices=jnp.concatenate([mesh.vertices, spare]) * np.float32(1 / 3e12),
        faces=jnp.concatenate([mesh.faces, jnp.array([[0, 0, 1]])]),
    )
    save_mesh(tmp_path / f"cube{suffix}", mesh)
    read = load_mesh(tmp_path / f"cube{suffix}")
    np.testing.assert_array_equal(corners(read), corners(mesh))
    if suffix != ".stl":
        np.testing.assert_array_equal(read.vertices, mesh.vertices)


def test_attributes_survive_on_vertices_that_no_face_uses(tmp_path):
    mesh = dm.Mesh(
        vertices=np.arange(12).reshape(4, 3),
        faces=[[0, 1, 3]],
        normals=np.eye(4, 3),
        uvs=np.arange(8).reshape(4, 2) / 8,
    )
    for suffix in HOLDS_NORMALS:
        save_mesh(tmp_path / f"one{suffix}", mesh)
        read = load_mesh(tmp_path / f"one{suffix}")
        for name in ("vertices", "normals", "uvs"):
            np.testing.assert_allclose(corners(read, name), corners(mesh, name), err_msg=suffix)


# ------------------------------------------------------------------------------------------- OBJ

QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def test_obj_polygons_become_fans_in_their_order(tmp_path):
    text = QUAD + "v 2 0 0\nf 1 2 3 4\nf 2 5 3\nf 1 2 5 3 4\n"
    read = load_mesh(write(tmp_path / "a.obj", text))
    want = [[0, 1, 2], [0, 2, 3], [1, 4, 2], [0, 1, 4], [0, 4, 2], [0, 2, 3]]
    np.testing.assert_array_equal(read.faces, want)


# A concave outline, of area 2.5.
DART = [(0, 0), (2, 0), (2, 2), (1, 0.5), (0, 2)]


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".PLY"])
@pytest.mark.parametrize("first", range(len(DART)))
def test_concave_polygons_are_cut_within_their_outline(tmp_path, suffix, first):
    outline = np.roll(DART, -first, axis=0)
    flat = np.insert(outline, 2, 0, axis=1)
    points = np.concatenate([flat, flat[:, [2, 0, 1]]])
    rows = [" ".join(map(str, point)) for point in points.tolist()]
    polygons, uvs = ([[*range(n)], [*range(n, 2 * n)]] for n in (5, 10))
    lists = ["5 {} {} {} {} {}".format(*polygon) for polygon in polygons]
    path = tmp_path / f"a{suffix.lower()}"
    if suffix == ".obj":
        text = "".join(f"v {row}\nvt {k} 0\n" for k, row in enumerate(rows))
        text += "f 1/1 2/2 3/3 4/4 5/5\nf -5/-5 -4/-4 -3/-3 -2/-2 -1/-1\n"
        write(path, text)
    elif suffix == ".off":
        write(path, "\n".join(["OFF 10 2 0", *rows, *lists]))
    else:  # its faces before its vertices, which is no less a PLY file
        vertex = "element vertex 10\nproperty double x\nproperty double y\nproperty double z\n"
        face = "element face 2\nproperty list uchar int vertex_indices\n"
        face += "property list uchar float texcoord\n"
        if suffix == ".ply":
            both = [
                f"{row} 10 {' '.join(map(str, uv))}" for row, uv in zip(lists, uvs, strict=True)
            ]
            head = f"ply\nformat ascii 1.0\n{face}{vertex}end_header\n"
            write(path, head + "\n".join([*both, *rows]))
        else:
            body = b"".join(
                struct.pack(">B5iB10f", 5, *polygon, 10, *uv)
                for polygon, uv in zip(polygons, uvs, strict=True)
            )
            head = f"ply\nformat binary_big_endian 1.0\n{face}{vertex}end_header\n"
            path.write_bytes(head.encode() + body + points.astype(">f8").tobytes())
    read = load_mesh(path)
    assert len(read.faces) == 6
    a, b, c = np.moveaxis(corners(read), 1, 0)
    area = np.cross(b - a, c - a) / 2
    np.testing.assert_allclose(area[:3, 2].sum(), 2.5, rtol=1e-6)
    np.testing.assert_allclose(area[3:, 0].sum(), 2.5, rtol=1e-6)
    assert np.linalg.norm(area, axis=1).sum() < 5 + 1e-5
    if suffix != ".off":
        step = 1 if suffix == ".obj" else 2
        number = np.round(corners(read, "uvs")[..., 0] / step).astype(int)
        np.testing.assert_allclose(corners(read), points[number], atol=1e-6)


def test_obj_relative_indices_count_back_from_their_line(tmp_path):
    text = "v 9 9 9\n" + QUAD + "f -4 -3 -2 -1\nv 0 0 5\nf -1 -4 2\n"
    read = load_mesh(write(tmp_path / "a.obj", text))
    np.testing.assert_array_equal(read.faces, [[1, 2, 3], [1, 3, 4], [5, 2, 1]])
    text = QUAD + "vt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 2\nf -4/-3/-1 -3/-2/-1 -2/-1/-1\n"
    read = load_mesh(write(tmp_path / "b.obj", text))
    np.testing.assert_array_equal(corners(read, "uvs"), [[[0, 0], [1, 0], [1, 1]]])
    np.testing.assert_array_equal(read.normals, np.tile([0, 0, 1], (3, 1)))


def test_obj_splits_vertices_on_seams_only(tmp_path):
    uvs = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt .5 .5\n"
    text = QUAD + uvs + "f 1/1 2/2 3/3\nf 1/1 3/5 4/4\n"
    read = load_mesh(write(tmp_path / "a.obj", text))
    assert read.vertices.shape == (5, 3)
    np.testing.assert_allclose(corners(read, "uvs")[1], [[0, 0], [0.5, 0.5], [0, 1]])
    np.testing.assert_array_equal(corners(read)[1], [[0, 0, 0], [1, 1, 0], [0, 1, 0]])


def test_obj_syntax_that_other_programs_write(tmp_path):
    text = (
        "# comment\r\nmtllib none.mtl\r\no thing\r\n\tv  0 0 0 1.0 # w\r\nv 1e0 +0 0 .5 .5 .5\r\n"
        "v 1 1\\\r\n 0\r\nvn 0 0 1\r\ng side\r\nusemtl red\r\ns off\r\nf 1//1 2//1 \\\r\n 3//1\r\n"
        "l 1 2\r\nvp 0 0\r\n"
    )
    path = tmp_path / "a.obj"
    path.write_bytes(text.encode())
    read = load_mesh(path)
    np.testing.assert_array_equal(corners(read), [[[0, 0, 0], [1, 0, 0], [1, 1, 0]]])
    np.testing.assert_array_equal(read.normals, np.tile([0, 0, 1], (3, 1)))


def test_obj_may_end_in_a_backslash(tmp_path):
    read = load_mesh(write(tmp_path / "a.obj", QUAD + "f 1 2 3\nf 1 3 4 \\"))
    np.testing.assert_array_equal(read.faces, [[0, 1, 2], [0, 2, 3]])


def test_obj_attributes_of_some_faces_only_are_left_out(tmp_path):
    text = QUAD + "vt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf 1//1 3//1 4//1\n"
    read = load_mesh(write(tmp_path / "a.obj", text))
    assert read.uvs is None
    assert read.normals is not None


def test_text_may_begin_with_a_byte_order_mark(tmp_path):
    write(tmp_path / "m.mtl", "\ufeffnewmtl one\nKd .8 .7 .6\n")
    obj = QUAD.replace("\n", "\r") + "mtllib m.mtl\rusemtl one\rf 1 2 3\r"
    off = "OFF\n3 1 0\n0 0 0\n1 0 0\n1 1 0\n3 0 1 2\n"
    stl = f"solid\n{FACET}vertex 1 1 0\nendloop\nendfacet\nendsolid\n"
    ply = PLY + "0 0 0\n1 0 0\n1 1 0\n3 0 1 2\n"
    for suffix, text in ((".obj", obj), (".off", off), (".stl", stl), (".ply", ply)):
        for mark in ("", "\ufeff"):
            path = tmp_path / f"a{suffix}"
            path.write_bytes((mark + text).encode())
            (part,) = load_mesh_parts(path)
            np.testing.assert_array_equal(corners(part.mesh), [[[0, 0, 0], [1, 0, 0], [1, 1, 0]]])
            if suffix == ".obj":
                np.testing.assert_allclose(part.diffuse, [0.8, 0.7, 0.6], rtol=1e-6)
    path = tmp_path / "a.obj"
    path.write_bytes(b"\xef\xbb\xbf" + obj.encode() + b"# \xc4")  # and letters in another encoding
    assert load_mesh(path).faces.shape == (1, 3)


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_names_in_a_file_may_have_any_letters(tmp_path, encoding):
    (tmp_path / "à.mtl").write_text("newmtl é\nKd 0 0 1\n", encoding=encoding)
    path = tmp_path / "a.obj"
    path.write_text(f"mtllib à.mtl\n{QUAD}usemtl é\nf 1 2 3\n", encoding=encoding)
    (part,) = load_mesh_parts(path)
    np.testing.assert_array_equal(part.diffuse, [0, 0, 1])


def test_materials_and_textures(tmp_path):
    Image.fromarray(np.array([[[255, 0, 0], [0, 188, 0]]], np.uint8)).save(tmp_path / "t.png")
    write(
        tmp_path / "m.mtl",
        "newmtl one\nKa .1 .1 .1\nKd .8 .7 .6\nKs 1 1 1\nNs 20\nmap_Kd t.png\n"
        "newmtl two\nKd 0 0 1\n",
    )
    text = (
        "mtllib m.mtl\n" + QUAD + "vt 0 0\nusemtl one\nf 1/1 2/1 3/1\nusemtl two\nf 1/1 3/1 4/1\n"
    )
    path = write(tmp_path / "a.obj", text)
    first, second = load_mesh_parts(path)
    np.testing.assert_allclose(first.ambient, [0.1, 0.1, 0.1], rtol=1e-6)
    np.testing.assert_allclose(first.diffuse, [0.8, 0.7, 0.6], rtol=1e-6)
    np.testing.assert_allclose(first.specular, [1, 1, 1])
    assert first.shininess == 20
    np.testing.assert_allclose(first.texture, [[[1, 0, 0], [0, 0.502886, 0]]], atol=1e-5)
    np.testing.assert_array_equal(corners(first.mesh), [[[0, 0, 0], [1, 0, 0], [1, 1, 0]]])
    np.testing.assert_allclose(second.diffuse, [0, 0, 1])
    assert second.texture is None
    assert (first.name, second.name) == ("one", "two")
    np.testing.assert_array_equal(load_mesh(path).faces, [[0, 1, 2], [0, 2, 3]])
    (tmp_path / "m.mtl").unlink()
    assert all(part.diffuse is None for part in load_mesh_parts(path))


TRIANGLE = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl one\n"
TRIANGLE += "f 1/1 2/2 3/3\n"


def one_material(tmp_path, lines):
    """The part of a triangle whose material has these lines."""
    write(tmp_path / "m.mtl", f"newmtl one\n{lines}\n")
    (part,) = load_mesh_parts(write(tmp_path / "a.obj", TRIANGLE))
    return part


@pytest.mark.parametrize("material", ["", "usemtl missing\n"])
@pytest.mark.parametrize("suffix", [".obj", ".ply", ".gltf", ".glb"])
def test_uvs_without_a_material_bring_none(tmp_path, suffix, material):
    path = tmp_path / f"a{suffix}"
    save_mesh(path, shapes.plane())
    assert b"PNG" not in path.read_bytes()
    if suffix == ".obj":
        path.write_text(material + path.read_text())
    (part,) = load_mesh_parts(path)
    assert part[2:] == (None,) * 7
    (item,) = load_objects(path)
    assert item.mesh.uvs is not None
    assert item.material.texture is None
    np.testing.assert_array_equal(item.material.diffuse, dr.Material().diffuse)


def test_obj_materials_may_differ_in_what_their_corners_have(tmp_path):
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "t.png")
    write(tmp_path / "m.mtl", "newmtl plain\nKd 1 0 0\nnewmtl full\nmap_Kd t.png\n")
    text = "mtllib m.mtl\n" + QUAD + "v 0 0 9\nvt 0 0\nvt 1 0\nvt 1 1\nvn 1 0 0\n"
    text += "usemtl plain\nf 1 2 3\nusemtl full\nf 1/1/1 3/3/1 4/2/1\nusemtl plain\nf 1 3 4\n"
    path = write(tmp_path / "a.obj", text)
    plain, full = load_mesh_parts(path)
    assert (plain.mesh.uvs, plain.mesh.normals) == (None, None)
    np.testing.assert_array_equal(corners(full.mesh, "uvs"), [[[0, 0], [1, 1], [1, 0]]])
    np.testing.assert_array_equal(full.mesh.normals, np.tile([1, 0, 0], (3, 1)))
    assert full.texture is not None
    read = load_mesh(path)  # its faces in their order
    np.testing.assert_array_equal(corners(read)[:, 1], [[1, 0, 0], [1, 1, 0], [1, 1, 0]])
    np.testing.assert_array_equal(corners(read, "uvs")[::2], np.zeros((2, 3, 2)))
    np.testing.assert_array_equal(corners(read, "uvs")[1], [[0, 0], [1, 1], [1, 0]])
    z = [0, 0, 1]
    np.testing.assert_array_equal(corners(read, "normals")[:, 0], [z, [1, 0, 0], z])


def test_faces_in_the_order_of_the_file_know_which_of_them_meet(tmp_path):
    write(tmp_path / "m.mtl", "newmtl plain\nnewmtl full\n")
    text = "mtllib m.mtl\n" + QUAD + "v 0 0 9\nvn 1 0 0\nusemtl plain\nf 1 2 3\n"
    text += "usemtl full\nf 1//1 3//1 4//1\nusemtl plain\nf 1 2 5\n"
    mesh = load_mesh(write(tmp_path / "a.obj", text))
    again = dr.Mesh(vertices=mesh.vertices, faces=mesh.faces)
    np.testing.assert_array_equal(mesh.topology.neighbors, again.topology.neighbors)


@pytest.mark.parametrize(
    ("line", "color"),
    [
        ("Kd 1 .5 0 # red", (1, 0.5, 0)),
        ("Kd 1 \\\n .5 0", (1, 0.5, 0)),
        ("kd .5", (0.5, 0.5, 0.5)),
        ("Kd 1 2", "wanted 1 or 3 numbers after Kd, got '1 2'"),
        ("Kd 1 2 x", "wanted 1 or 3 numbers after Kd, got '1 2 x'"),
        ("Kd nan 0 0", "wanted 1 or 3 numbers after Kd, got 'nan 0 0'"),
        ("Kd 1e39 0 0", "wanted 1 or 3 numbers after Kd, got '1e39 0 0'"),
        ("Kd spectral a.rfl", "wanted 1 or 3 numbers after Kd, got 'spectral a.rfl'"),
        ("Ns 1 2", "wanted 1 number after Ns, got '1 2'"),
    ],
)
def test_mtl_colours(tmp_path, line, color):
    if isinstance(color, str):
        with pytest.raises(ValueError, match=f"a.obj: m.mtl:2: {color}"):
            one_material(tmp_path, line)
    else:
        np.testing.assert_array_equal(one_material(tmp_path, line).diffuse, color)


def test_mtl_colours_belong_to_a_material(tmp_path):
    write(tmp_path / "m.mtl", "Kd 1 0 0\nnewmtl one\n")
    with pytest.raises(ValueError, match=r"a\.obj: m\.mtl:1: wanted newmtl before Kd, got none"):
        load_mesh_parts(write(tmp_path / "a.obj", TRIANGLE))


@pytest.mark.parametrize(
    "name", ["t 1.png", "t 1.png # c", "t 1.png #c", r"a\t 1.png", r"C:\a\t 1.png", "a/t%201.png"]
)
def test_names_of_textures(tmp_path, name):
    Image.fromarray(np.full((1, 1, 3), 255, np.uint8)).save(tmp_path / "t 1.png")
    np.testing.assert_array_equal(one_material(tmp_path, f"map_Kd {name}").texture, [[[1, 1, 1]]])


def test_mtl_options_of_textures(tmp_path):
    Image.fromarray(np.full((1, 1, 3), 255, np.uint8)).save(tmp_path / "-mm.png")
    part = one_material(tmp_path, "map_Kd -clamp on -o .5 -s 2 3 1 -mm.png")
    assert part.wrap == ("clamp", "clamp")
    np.testing.assert_array_equal(part.texture, [[[1, 1, 1]]])
    np.testing.assert_array_equal(corners(part.mesh, "uvs"), [[[0.5, 0], [2.5, 0], [0.5, 3]]])
    assert one_material(tmp_path, "map_Kd -clamp off -mm.png").wrap == ("repeat", "repeat")
    assert one_material(tmp_path, "map_Kd").texture is None
    for option in ("-mm 0 1", "-clamp maybe", "-s x", "-blendu on"):
        with pytest.raises(ValueError, match=f"m.mtl:2: wanted a picture after .* got '{option} t"):
            one_material(tmp_path, f"map_Kd {option} t.png")


@pytest.mark.parametrize("libraries", ["mtllib m.mtl b.mtl", "mtllib m.mtl\nmtllib b.mtl # c"])
def test_several_material_files_and_names_with_a_hash(tmp_path, libraries):
    write(tmp_path / "m.mtl", "newmtl one\nKd 1 0 0\n")
    more = "newmtl one\nKd 0 0 0\nnewmtl Mat #2\nKd 0 1 0\nnewmtl Mat #3 # c\nKd 0 0 1\n"
    write(tmp_path / "b.mtl", more)
    text = f"{libraries}\n{QUAD}usemtl one #c\nf 1 2 3\nusemtl Mat #2\nf 1 2 3\nusemtl Mat #3\n"
    parts = load_mesh_parts(write(tmp_path / "a.obj", text + "f 1 2 3\n"))
    np.testing.assert_array_equal([part.diffuse for part in parts], np.eye(3))
    assert [part.name for part in parts] == ["one #c", "Mat #2", "Mat #3"]


@pytest.mark.parametrize("kind", ["obj", "ply", "gltf", "embedded"])
def test_textures_are_read_as_pictures_are(tmp_path, kind):
    """16 bits of grey are kept; what is no picture is an error that says so."""
    values = np.array([[0, 10000, 20000], [40000, 50000, 65535]], np.uint16)
    Image.fromarray(values).save(tmp_path / "deep.png")
    (tmp_path / "broken.png").write_bytes(b"no picture")

    def texture(name):
        if kind == "obj":
            return one_material(tmp_path, f"map_Kd {name}").texture
        if kind == "ply":
            save_mesh(tmp_path / "a.ply", shapes.plane())
            line = f"1.0\ncomment TextureFile {name}\n".encode()
            content = (tmp_path / "a.ply").read_bytes().replace(b"1.0\n", line, 1)
            (tmp_path / "a.ply").write_bytes(content)
            return load_mesh_parts(tmp_path / "a.ply")[0].texture
        tree = gltf_tree(tmp_path)
        tree["images"] = [{"uri": name}]
        if kind == "embedded":
            content = (tmp_path / name).read_bytes()
            uri = f"data:image/png;base64,{base64.b64encode(content).decode()}"
            tree["buffers"].append({"uri": uri, "byteLength": len(content)})
            tree["bufferViews"].append(
                {"buffer": len(tree["buffers"]) - 1, "byteLength": len(content)}
            )
            tree["images"] = [{"bufferView": len(tree["bufferViews"]) - 1}]
        return load_mesh_parts(write(tmp_path / "a.gltf", json.dumps(tree)))[0].texture

    np.testing.assert_array_equal(texture("deep.png"), dr.load_image(tmp_path / "deep.png"))
    with pytest.raises(ValueError, match=r"a\..*: cannot be read as an image"):
        texture("broken.png")
    if kind != "embedded":
        assert texture("none.png") is None


def test_ply_of_several_textures_is_refused(tmp_path):
    lines = "comment TextureFile a.png\ncomment TextureFile b.png\nelement vertex"
    path = write(tmp_path / "a.ply", PLY.replace("element vertex", lines, 1) + "0 0 0\n" * 3)
    with pytest.raises(ValueError, match=r"a\.ply: wanted one TextureFile, got 'a.png b.png'"):
        load_mesh_parts(path)


def test_gltf_names_of_files_may_be_percent_encoded(tmp_path):
    tree = gltf_tree(tmp_path)
    (tmp_path / "t.png").rename(tmp_path / "ü t.png")
    (tmp_path / "b 1.bin").write_bytes(
        base64.b64decode(tree["buffers"][0]["uri"].partition("base64,")[2])
    )
    tree["images"], tree["buffers"][0]["uri"] = [{"uri": "%C3%BC%20t.png"}], "b%201.bin"
    (item,) = load_objects(write(tmp_path / "a.gltf", json.dumps(tree)))
    assert item.material.texture is not None


def test_gltf_colours_keep_their_digits(tmp_path):
    tree = gltf_tree(tmp_path)
    base = tree["materials"][0]["pbrMetallicRoughness"]
    base["baseColorFactor"] = [0.5, 0.001, 1.0, 0.5]
    (part,) = load_mesh_parts(write(tmp_path / "a.gltf", json.dumps(tree)))
    np.testing.assert_array_equal(part.diffuse, np.float32([0.5, 0.001, 1.0]))
    old = {"diffuseFactor": [0.25, 0, 1, 1], "diffuseTexture": {"index": 0}}
    tree["materials"] = [{"extensions": {"KHR_materials_pbrSpecularGlossiness": old}}]
    (part,) = load_mesh_parts(write(tmp_path / "a.gltf", json.dumps(tree)))
    np.testing.assert_array_equal(part.diffuse, [0.25, 0, 1])
    np.testing.assert_allclose(part.texture, [[[1, 0, 0], [0, 0.502886, 0]]], atol=1e-5)
    old["diffuseFactor"] = [1, "x", 1]
    with pytest.raises(ValueError, match=r"materials\[0\]: wanted 3 or 4 numbers as a base colour"):
        load_mesh_parts(write(tmp_path / "a.gltf", json.dumps(tree)))


def test_obj_faces_before_any_material(tmp_path):
    write(tmp_path / "m.mtl", "newmtl one\nKd 1 0 0\n")
    text = f"mtllib m.mtl\n{QUAD}f 1 2 3\nusemtl one\nf 1 3 4\nusemtl two\nf 1 2 4\n"
    parts = load_mesh_parts(write(tmp_path / "a.obj", text))
    assert [part.name for part in parts] == ["a.obj", "one", "two"]
    assert [part.diffuse is None for part in parts] == [True, False, True]


def test_objects_of_a_file_carry_its_materials(tmp_path):
    Image.fromarray(np.array([[[255, 0, 0], [0, 188, 0]]], np.uint8)).save(tmp_path / "t.png")
    write(
        tmp_path / "m.mtl",
        "newmtl one\nKd .8 .7 .6\nKs 0 0 0\nmap_Kd t.png\nnewmtl two\nKd 0 0 1\nKs 1 .5 1\nNs 20\n"
        "newmtl three\nmap_Kd t.png\n",
    )
    faces = "usemtl one\nf 1/1 2/1 3/1\nusemtl two\nf 1/1 3/1 4/1\nusemtl three\nf 1/1 2/1 4/1\n"
    path = write(tmp_path / "a.obj", "mtllib m.mtl\n" + QUAD + "vt .75 .5\n" + faces)
    one, two, three = load_objects(path, filter="trilinear", wrap="clamp")
    np.testing.assert_allclose(one.material.diffuse, [0.8, 0.7, 0.6], rtol=1e-6)
    assert one.material.specular is None
    assert one.material.texture is three.material.texture
    assert (one.material.texture.filter, one.material.texture.wrap) == ("trilinear", ("clamp",) * 2)
    color = dr.sample_texture(one.material.texture, one.mesh.uvs[0])
    np.testing.assert_allclose(color, [0, 0.502886, 0], atol=1e-5)
    np.testing.assert_allclose(three.material.diffuse, 1)
    assert two.material.texture is None
    assert two.material.shininess == 20
    np.testing.assert_allclose(two.material.specular, [1, 0.5, 1])
    assert dr.Scene(objects=[one, two, three]).shared == (0, 1, 0)
    assert one.mesh.normals is not None


def test_gltf_textures_arrive_in_objects(tmp_path):
    picture = Image.fromarray(np.array([[[255, 0, 0], [0, 188, 0]]], np.uint8))
    picture.save(tmp_path / "t.png")
    save_mesh(tmp_path / "a.gltf", shapes.plane())
    tree = json.loads((tmp_path / "a.gltf").read_text())
    base = {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.2, 0.4, 1, 1]}
    tree["materials"] = [{"pbrMetallicRoughness": base}]
    tree["textures"], tree["images"] = [{"source": 0}], [{"uri": "t.png"}]
    (item,) = load_objects(write(tmp_path / "b.gltf", json.dumps(tree)))
    np.testing.assert_allclose(item.material.diffuse, [0.2, 0.4, 1], atol=1 / 255)
    image = item.material.texture.image
    np.testing.assert_allclose(image, [[[1, 0, 0], [0, 0.502886, 0]]], atol=1e-5)


def gltf_tree(tmp_path):
    """A square with a texture, as the JSON of a glTF file."""
    Image.fromarray(np.array([[[255, 0, 0], [0, 188, 0]]], np.uint8)).save(tmp_path / "t.png")
    save_mesh(tmp_path / "square.gltf", shapes.plane())
    tree = json.loads((tmp_path / "square.gltf").read_text())
    tree["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    tree["textures"], tree["images"] = [{"source": 0, "sampler": 0}], [{"uri": "t.png"}]
    tree["samplers"] = [{}]
    return tree


def texture_info(tree):
    return tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]


def as_glb(tree):
    """The JSON alone as a binary file; its buffers keep their URIs."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    sizes = [np.uint32(n).tobytes() for n in (2, 20 + len(text), len(text))]
    return b"glTF" + sizes[0] + sizes[1] + sizes[2] + b"JSON" + text


SAMPLERS = [
    ({}, ("repeat", "repeat"), "bilinear"),
    ({"wrapS": 33071}, ("clamp", "repeat"), "bilinear"),
    ({"wrapS": 10497, "wrapT": 33648}, ("repeat", "mirror"), "bilinear"),
    ({"wrapS": 33648, "wrapT": 33071}, ("mirror", "clamp"), "bilinear"),
    ({"magFilter": 9728, "minFilter": 9728}, ("repeat", "repeat"), "nearest"),
    ({"magFilter": 9728, "minFilter": 9987}, ("repeat", "repeat"), "nearest"),
    ({"minFilter": 9728}, ("repeat", "repeat"), "nearest"),
    ({"magFilter": 9729, "minFilter": 9728}, ("repeat", "repeat"), "bilinear"),
    ({"magFilter": 9729, "minFilter": 9987}, ("repeat", "repeat"), "trilinear"),
    ({"minFilter": 9984}, ("repeat", "repeat"), "trilinear"),
]


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
def test_gltf_samplers_arrive_in_textures(tmp_path, suffix):
    """Of several materials in one file, each with its own sampler and the same picture."""
    tree = gltf_tree(tmp_path)
    count = len(SAMPLERS)
    tree["samplers"] = [sampler for sampler, _, _ in SAMPLERS]
    tree["textures"] = [{"source": 0, "sampler": k} for k in range(count)] + [{"source": 0}]
    tree["materials"] = [
        {"name": "same", "pbrMetallicRoughness": {"baseColorTexture": {"index": k}}}
        for k in range(count + 1)
    ]
    (primitive,) = tree["meshes"][0]["primitives"]
    tree["meshes"][0]["primitives"] = [{**primitive, "material": k} for k in range(count + 1)]
    path = tmp_path / f"a{suffix}"
    path.write_bytes(as_glb(tree) if suffix == ".glb" else json.dumps(tree).encode())
    textures = [item.material.texture for item in load_objects(path)]
    wanted = [(wrap, filter_) for _, wrap, filter_ in SAMPLERS]
    assert [(t.wrap, t.filter) for t in textures] == [*wanted, wanted[0]]
    assert textures[0] is textures[-1]
    parts = load_mesh_parts(path)
    assert parts[-1].wrap == ("repeat", "repeat")
    assert parts[-1].filter is None
    given = [item.material.texture for item in load_objects(path, filter="nearest", wrap="clamp")]
    assert {(t.wrap, t.filter) for t in given} == {(("clamp", "clamp"), "nearest")}


@pytest.mark.parametrize("kind", [np.float32, np.uint8, np.uint16])
def test_gltf_textures_take_the_coordinates_they_ask_for(tmp_path, kind):
    tree = gltf_tree(tmp_path)
    limit = 1 if kind == np.float32 else np.iinfo(kind).max
    other = (np.array([[0, 1], [1, 1], [0, 0.2], [1, 0.2]]) * limit).astype(kind)
    data = base64.b64encode(other.tobytes()).decode()
    uri = f"data:application/octet-stream;base64,{data}"
    tree["buffers"].append({"uri": uri, "byteLength": other.nbytes})
    view = {"buffer": len(tree["buffers"]) - 1, "byteOffset": 0, "byteLength": other.nbytes}
    tree["bufferViews"].append(view)
    accessor = {
        "bufferView": len(tree["bufferViews"]) - 1,
        "componentType": {np.float32: 5126, np.uint8: 5121, np.uint16: 5123}[kind],
        "normalized": kind != np.float32,
        "count": 4,
        "type": "VEC2",
    }
    tree["accessors"].append(accessor)
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["TEXCOORD_1"] = len(tree["accessors"]) - 1
    path = write(tmp_path / "a.gltf", json.dumps(tree))
    np.testing.assert_allclose(load_objects(path)[0].mesh.uvs, shapes.plane().uvs, atol=1e-6)
    texture_info(tree)["texCoord"] = 1
    write(path, json.dumps(tree))
    wanted = [[0, 0], [1, 0], [0, 0.8], [1, 0.8]]
    np.testing.assert_allclose(load_objects(path)[0].mesh.uvs, wanted, atol=2e-3)
    np.testing.assert_allclose(load_mesh(path).uvs, wanted, atol=2e-3)


def test_gltf_texture_transforms_move_the_coordinates(tmp_path):
    """The extension's own example: the lower left quarter of the picture, turned clockwise."""
    tree = gltf_tree(tmp_path)
    moved = {"offset": [0, 1], "rotation": np.pi / 2, "scale": [0.5, 0.5]}
    texture_info(tree)["extensions"] = {"KHR_texture_transform": moved}
    path = write(tmp_path / "a.gltf", json.dumps(tree))
    u, v = np.asarray(shapes.plane().uvs).T
    np.testing.assert_allclose(load_mesh(path).uvs, np.c_[(1 - v) / 2, u / 2], atol=1e-6)
    moved["scale"], moved["texCoord"] = [1, -1], 0
    del moved["rotation"]
    write(path, json.dumps(tree))
    np.testing.assert_allclose(load_mesh(path).uvs, np.c_[u, 1 - v], atol=1e-6)


BROKEN_TEXTURES = {
    "index of a sampler": (
        lambda tree: tree["textures"][0].update(sampler=1),
        r"textures\[0\]: sampler: wanted an index in \[0, 1\), got 1",
    ),
    "wrap": (
        lambda tree: tree["samplers"][0].update(wrapT=5),
        r"samplers\[0\]: wanted wrapT to be one of 10497, 33071, 33648, got 5",
    ),
    "filter": (
        lambda tree: tree["samplers"][0].update(magFilter="LINEAR"),
        r"samplers\[0\]: wanted magFilter to be one of 9728, 9729, got 'LINEAR'",
    ),
    "samplers": (
        lambda tree: tree.update(samplers={"wrapS": 10497}),
        "samplers: wanted a list of objects, got",
    ),
    "index of a texture": (
        lambda tree: texture_info(tree).update(index=-1),
        r"materials\[0\]: texture: wanted an index in \[0, 1\), got -1",
    ),
    "index of a material": (
        lambda tree: tree["meshes"][0]["primitives"][0].update(material=7),
        r"meshes\[0\]: material: wanted an index in \[0, 1\), got 7",
    ),
    "set of coordinates": (
        lambda tree: texture_info(tree).update(texCoord=0.5),
        r"materials\[0\]: wanted a whole number texCoord, got 0.5",
    ),
    "coordinates that are not there": (
        lambda tree: texture_info(tree).update(texCoord=2),
        r"meshes\[0\]: wanted TEXCOORD_2 for its texture, got \['TEXCOORD_0'\]",
    ),
    "transform": (
        lambda tree: texture_info(tree).update(
            extensions={"KHR_texture_transform": {"scale": [1, None]}}
        ),
        r"materials\[0\]: wanted two numbers as scale, got \[1, None\]",
    ),
}


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
@pytest.mark.parametrize("case", BROKEN_TEXTURES)
def test_broken_gltf_textures_are_named_with_their_file(tmp_path, case, suffix):
    change, message = BROKEN_TEXTURES[case]
    tree = gltf_tree(tmp_path)
    change(tree)
    path = tmp_path / f"broken{suffix}"
    path.write_bytes(as_glb(tree) if suffix == ".glb" else json.dumps(tree).encode())
    with pytest.raises(ValueError, match=rf"broken{suffix}: cannot be read as .*{message}"):
        load_objects(path)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
def test_uvs_with_their_own_indices_are_written(tmp_path, suffix):
    square = shapes.plane()
    own = dm.Mesh(
        vertices=square.vertices, faces=square.faces, uvs=[(0, 0), (1, 0), (0, 1), (1, 1), (2, 0)],
        uv_faces=[(0, 1, 3), (4, 2, 0)],
    )  # fmt: skip
    save_mesh(tmp_path / f"a{suffix}", own)
    read = load_mesh(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(read.vertices[read.faces], own.vertices[own.faces], atol=1e-6)
    np.testing.assert_allclose(read.uvs[read.faces], own.uvs[own.uv_faces], atol=1e-6)


# ---------------------------------------------------------------------------------- other formats


def test_several_gltf_nodes_are_merged_in_their_places(tmp_path):
    save_mesh(tmp_path / "one.gltf", shapes.cube())
    tree = json.loads((tmp_path / "one.gltf").read_text())
    mesh_node = next(k for k, node in enumerate(tree["nodes"]) if "mesh" in node)
    mirrored = {"mesh": tree["nodes"][mesh_node]["mesh"], "name": "mirrored"}
    tree["nodes"].append({**mirrored, "scale": [-1, 1, 1], "translation": [5, 0, 0]})
    tree["nodes"][tree["scenes"][0]["nodes"][0]].setdefault("children", []).append(
        len(tree["nodes"]) - 1
    )
    write(tmp_path / "two.gltf", json.dumps(tree))
    read = load_mesh(tmp_path / "two.gltf")
    assert read.faces.shape == (24, 3)
    np.testing.assert_allclose(dm.signed_volume(read), 16, rtol=1e-6)
    assert read.vertices[:, 0].max() == 6
    facets = dm.face_normals(read.vertices, read.faces)
    np.testing.assert_allclose(facets, read.normals[read.faces[:, 0]], atol=1e-6)


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
def test_gltf_without_a_material_keeps_its_uvs(tmp_path, suffix):
    mesh = shapes.plane(divisions=2)
    path = tmp_path / f"a{suffix}"
    save_mesh(path, mesh)
    # The same number of bytes, so that lengths stay right.
    path.write_bytes(path.read_bytes().replace(b'"material":', b'"ignored_":'))
    np.testing.assert_allclose(load_mesh(path).uvs, mesh.uvs, atol=1e-6)
    (part,) = load_mesh_parts(path)
    assert part.texture is None
    assert part.diffuse is None


def gltf_of(arrays, **primitive):
    """A file of one primitive with each attribute and its indices as they are, by name."""
    names = {"f4": 5126, "i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123}
    tree = {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
    tree |= {"accessors": [], "bufferViews": [], "buffers": []}
    for number, array in enumerate(arrays.values()):
        data = base64.b64encode(array.tobytes()).decode()
        uri = f"data:application/octet-stream;base64,{data}"
        tree["buffers"].append({"uri": uri, "byteLength": array.nbytes})
        tree["bufferViews"].append({"buffer": number, "byteLength": array.nbytes})
        accessor = {"bufferView": number, "componentType": names[array.dtype.str[1:]]}
        accessor |= {"count": len(array), "type": "VEC3" if array.ndim == 2 else "SCALAR"}
        tree["accessors"].append(accessor)
    numbers = {name: number for number, name in enumerate(arrays)}
    primitive |= {"indices": numbers.pop("indices")} if "indices" in numbers else {}
    tree["meshes"] = [{"primitives": [{"attributes": numbers, **primitive}]}]
    return tree


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
@pytest.mark.parametrize("kind", [np.int8, np.uint8, np.int16, np.uint16])
@pytest.mark.parametrize("normalized", [False, True])
def test_gltf_positions_in_whole_numbers(tmp_path, suffix, kind, normalized):
    limits = np.iinfo(kind)
    low = limits.min if normalized else 0
    positions = np.array([(0, 0, 0), (limits.max, 0, 1), (0, limits.max, low)], kind)
    normals = np.array([(0, 0, 127), (127, 0, 0), (0, -128, 0)], np.int8)
    tree = gltf_of({"POSITION": positions, "NORMAL": normals})
    tree["extensionsUsed"] = tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    tree["accessors"][0]["normalized"] = normalized
    tree["accessors"][1]["normalized"] = True
    tree["nodes"][0] |= {"scale": [2, 2, 2], "translation": [0, 0, 5]}
    path = tmp_path / f"a{suffix}"
    path.write_bytes(as_glb(tree) if suffix == ".glb" else json.dumps(tree).encode())
    read = load_mesh(path)
    stored = np.maximum(positions / limits.max, -1) if normalized else positions
    np.testing.assert_allclose(read.vertices, 2.0 * stored + (0, 0, 5), rtol=1e-6)
    np.testing.assert_allclose(read.normals, [(0, 0, 1), (1, 0, 0), (0, -1, 0)], atol=1e-6)


@pytest.mark.parametrize("count", [3, 4, 5, 6])
@pytest.mark.parametrize("indexed", [False, True])
def test_gltf_strips_and_fans(tmp_path, count, indexed):
    points = np.arange(3 * count, dtype="f4").reshape(-1, 3)
    order = np.random.default_rng(count).permutation(count) if indexed else np.arange(count)
    arrays = {"POSITION": points} | ({"indices": order.astype("u2")} if indexed else {})
    tree = gltf_of(arrays, mode=6)
    tree["meshes"][0]["primitives"].append({**tree["meshes"][0]["primitives"][0], "mode": 5})
    fan, strip = load_mesh_parts(write(tmp_path / "a.gltf", json.dumps(tree)))
    np.testing.assert_array_equal(
        fan.mesh.faces, [order[[0, k, k + 1]] for k in range(1, count - 1)]
    )
    ahead = [order[[k + 2, k + 1, k] if k % 2 else [k, k + 1, k + 2]] for k in range(count - 2)]
    np.testing.assert_array_equal(strip.mesh.faces, ahead)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda t: t.update(extensionsRequired=["KHR_texture_transform", "FOO_bar"]),
            "extensionsRequired: wanted extensions among EXT_texture_webp, .*, got 'FOO_bar'",
        ),
        (
            lambda t: t.update(extensionsRequired="KHR_texture_transform"),
            "extensionsRequired: wanted a list of names, got 'KHR",
        ),
        (
            lambda t: t["meshes"][0]["primitives"][0].update(mode=7),
            r"meshes\[0\]: wanted a mode in \[0, 7\), got 7",
        ),
    ],
)
def test_gltf_that_cannot_be_read_right_is_refused(tmp_path, change, message):
    tree = gltf_of({"POSITION": np.eye(3, dtype="f4")})
    path = write(tmp_path / "a.gltf", json.dumps(tree))
    assert load_mesh(path).faces.shape == (1, 3)
    change(tree)
    with pytest.raises(ValueError, match=f"a.gltf: cannot be read as GLTF .{message}"):
        load_mesh(write(path, json.dumps(tree)))


def test_gltf_base_colour(tmp_path):
    save_mesh(tmp_path / "a.gltf", shapes.plane())
    tree = json.loads((tmp_path / "a.gltf").read_text())
    tree["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [0.2, 0.4, 1, 1]}}]
    (part,) = load_mesh_parts(write(tmp_path / "b.gltf", json.dumps(tree)))
    np.testing.assert_allclose(part.diffuse, [0.2, 0.4, 1], atol=1 / 255)


def test_text_forms_of_ply_off_and_stl(tmp_path):
    ply = (
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"
    )
    mixed = load_mesh(write(tmp_path / "a.ply", ply + "3 0 1 2\n4 0 1 2 3\n"))
    assert mixed.faces.shape == (3, 3)
    np.testing.assert_allclose(dm.face_areas(mixed.vertices, mixed.faces).sum(), 1.5)
    off = load_mesh(
        write(tmp_path / "a.off", "OFF # c\n4 1 0\n" + "0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3")
    )
    assert off.faces.shape == (2, 3)
    facet = f"{FACET}vertex 0 1 0\nendloop\nendfacet\n"
    stl = load_mesh(write(tmp_path / "a.stl", f"solid a b\n{facet}endsolid a b\n"))
    np.testing.assert_array_equal(corners(stl), [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    assert stl.normals is None


def test_off_polygons_become_fans_in_their_order(tmp_path):
    points = "0 0 0\n2 0 0\n3 1 0\n2 2 0\n0 2 0\n-1 1 0\n"
    path = tmp_path / "a.off"
    read = load_mesh(write(path, f"OFF\n6 3 0\n{points}6 0 1 2 3 4 5\n3 5 0 4\n5 0 1 2 3 4 9 9\n"))
    fan = [[0, 1, 2], [0, 2, 3], [0, 3, 4]]
    np.testing.assert_array_equal(read.faces, [*fan, [0, 4, 5], [5, 0, 4], *fan])
    read = load_mesh(write(path, f"OFF 6 2 0\n{points}4 0 1 2 3\n4 0 3 4 5\n"))
    np.testing.assert_array_equal(read.faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])


def test_off_vertices_have_what_their_header_says(tmp_path):
    path = tmp_path / "a.off"
    place = [[0, 0, 1], [1, 0, 1], [0, 1, 1]]
    uvs = [[0.0, 0.0], [0.5, 0.0], [0.0, 0.25]]

    def read(kind, *columns):
        rows = [" ".join(map(str, np.concatenate(row))) for row in zip(*columns, strict=True)]
        return load_mesh(write(path, "\n".join([kind, "3 1 0", *rows, "3 0 1 2"])))

    normals, color = [[0, 0, 2]] * 3, [[255, 0, 9]] * 3
    weighted = [[0, 0, 2, 2], [-3, 0, -3, -3], [0, 0.5, 0.5, 0.5]]
    for kind, columns in (
        ("OFF", [place]),
        ("COFF", [place, color]),
        ("NOFF", [place, normals]),
        ("4OFF", [weighted]),
        ("STOFF", [place, uvs]),
        ("STCOFF", [place, color, uvs]),
        ("STCN4OFF", [weighted, normals, [[0.1, 0.2, 0.3, 1]] * 3, uvs]),
    ):
        mesh = read(kind, *columns)
        np.testing.assert_array_equal(mesh.vertices, place, err_msg=kind)
        assert (mesh.normals is not None, mesh.uvs is not None) == ("N" in kind, "ST" in kind)
        if mesh.normals is not None:
            np.testing.assert_array_equal(mesh.normals, [[0, 0, 1]] * 3)
        if mesh.uvs is not None:
            np.testing.assert_array_equal(mesh.uvs, uvs)


def binary_ply(faces, *, order="<", uvs=False):
    """Nine points; faces with a scalar before their corners, and edges behind them."""
    kind = "little" if order == "<" else "big"
    texcoord = "property list ushort double texcoord\n" if uvs else ""
    header = (
        f"ply\nformat binary_{kind}_endian 1.0\ncomment end_header soon\nelement vertex 9\n"
        f"property double x\nproperty double y\nproperty double z\nelement face {len(faces)}\n"
        f"property uchar red\nproperty list int ushort vertex_index\n{texcoord}"
        "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n"
    )
    content = np.arange(27).astype(f"{order}f8").tobytes()
    for face in faces:
        content += struct.pack(f"{order}Bi{len(face)}H", 7, len(face), *face)
        if uvs:
            numbers = [(vertex + axis) / 8 for vertex in face for axis in (0, 1)]
            content += struct.pack(f"{order}H{len(numbers)}d", len(numbers), *numbers)
    return header.encode() + content + struct.pack(f"{order}ii", 0, 1)


POLYGONS = {  # trimesh takes sizes from the first: of (4, 3, 5) their sum is right
    "triangles": [(0, 1, 2), (5, 4, 3)],
    "quads": [(0, 1, 2, 3), (8, 7, 6, 5)],
    "mixed": [(0, 1, 2), (3, 4, 5, 6, 7, 8), (1, 2, 3, 4, 5), (0, 2, 1)],
    "of one sum": [(0, 1, 2, 3), (6, 5, 4), (1, 2, 3, 4, 5)],
}


@pytest.mark.parametrize("uvs", [False, True])
@pytest.mark.parametrize("polygons", POLYGONS)
def test_ply_polygons_become_fans_in_their_order(tmp_path, polygons, uvs):
    faces = POLYGONS[polygons]
    fans = [(face[0], b, c) for face in faces for b, c in itertools.pairwise(face[1:])]
    path = tmp_path / "a.ply"
    for order in "<>":
        path.write_bytes(binary_ply(faces, order=order, uvs=uvs))
        read = load_mesh(path)
        np.testing.assert_array_equal(corners(read)[..., 0], 3 * np.array(fans))
        assert (read.uvs is not None) == uvs
        if uvs:
            np.testing.assert_array_equal(corners(read, "uvs")[..., 1], np.array(fans) / 8 + 1 / 8)
    rows = [f"7 {len(face)} {' '.join(map(str, face))}" for face in faces]
    header = PLY.replace("vertex 3", "vertex 9").replace("face 1", f"face {len(faces)}")
    header = header.replace("property list", "property uchar red\nproperty list")
    points = [f"{k} 0 0" for k in range(9)]
    read = load_mesh(write(path, "\n".join([header + points[0], *points[1:], "", *rows])))
    np.testing.assert_array_equal(read.faces, fans)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: b[:-9], "a.ply: wanted face 3, got the end of the file"),
        (lambda b: b[:-1], "a.ply: cannot be read as PLY"),
        (lambda b: b.replace(b"vertex 9", b"vertex 8"), "a.ply: wanted face|a.ply: face"),
        (
            lambda b: b.replace(struct.pack("<H", 8), struct.pack("<H", 9)),
            r"face 1: .* in \[0, 9\)",
        ),
        (
            lambda b: b.replace(b"vertex_index", b"vertex"),
            "a.ply: wanted faces with a list vertex_i",
        ),
        (
            lambda b: b.replace(b"list int", b"list float"),
            "a.ply:10: wanted a type .* got 'list fl",
        ),
        (
            lambda b: b.replace(b"uchar red", b"colour red"),
            "a.ply:9: wanted a type .* got 'colour r",
        ),
        (lambda b: b.replace(b"double y", b"double x"), "a.ply:6: wanted properties of several na"),
    ],
)
def test_broken_binary_ply(tmp_path, change, message):
    path = tmp_path / "a.ply"
    path.write_bytes(change(binary_ply(POLYGONS["mixed"])))
    with pytest.raises(ValueError, match=message):
        load_mesh(path)


# ---------------------------------------------------------------------------------------- errors

PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
)
FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n"


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("a.obj", "v 0 0\n", "a.obj:1: wanted 3 numbers after v, got '0 0'"),
        ("a.obj", "\nv 0 0 x\n", "a.obj:2: wanted 3 numbers after v, got '0 0 x'"),
        ("a.obj", "v 0 0 nan\n", "a.obj:1: wanted 3 numbers after v"),
        ("a.obj", QUAD + "f 1 2 5\n", "a.obj:5: wanted an index of at most 4, .* v .*got 5"),
        ("a.obj", QUAD + "f 1 2 0\n", "a.obj:5: wanted a corner .*, got '0'"),
        ("a.obj", QUAD + "f 1 2 -5\n", "a.obj:5: wanted a corner .* back to -4, got '-5'"),
        ("a.obj", QUAD + "f 1 2 3.5\n", "a.obj:5: wanted a corner .*, got '3.5'"),
        ("a.obj", QUAD + "f 1/1 2/1 3/1\n", "a.obj:5: wanted an index of at most 0, .* vt"),
        ("a.obj", QUAD + "f 1 2\n", "a.obj:5: wanted at least 3 corners after f, got '1 2'"),
        ("a.obj", QUAD, "a.obj: wanted a mesh with faces"),
        ("a.obj", "", "a.obj: wanted a mesh with faces"),
        ("a.obj", "v 0 0 0\n\0\1", "a.obj:2: wanted text, got binary data"),
        ("a.off", "COFFEE\n", "a.off:1: wanted the word OFF"),
        ("a.off", "OFF\n3\n", "a.off:2: wanted the numbers of vertices and faces, got '3'"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n", "a.off:4: wanted vertex 2, got the end"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0\n0 0 0\n3 0 1 2", "a.off:4: wanted three numbers"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n", "a.off:5: wanted face 0, got the end"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3", r"a.off:6: .* in \[0, 3\), got"),
        ("a.off", "nOFF\n4\n1 0 0\n0 0 0 0\n", "a.off:1: wanted the word OFF, with ST, C, N or 4"),
        ("a.off", "4OFF\n1 0 0\n0 0 1 0\n", "a.off:3: wanted a fourth number other than 0, got"),
        ("a.off", "NOFF\n1 0 0\n0 0 1\n", "a.off:3: wanted 6 numbers, got '0 0 1'"),
        ("a.off", "STCOFF\n1 0 0\n0 0 1 9 9 0 0\n", "a.off:3: .* 5 numbers and 3 or 4 of a colour"),
        (
            "a.off",
            "OFF\n1 1 0\n1e39 0 0\n3 0 0 0\n",
            "a.off: cannot be read as OFF .vertices: wanted",
        ),
        ("a.off", "OFF\n1 0 0\n0 0 0\n", "a.off: wanted a mesh with faces"),
        ("a.off", "OFF\n0 0 0\n", "a.off: wanted a mesh with faces"),
        ("a.ply", PLY + "0 0 0\n1 0 0\n", "a.ply:11: wanted vertex 2, got the end"),
        ("a.ply", PLY + "0 0 0\n1 0 0\n0 1\n3 0 1 2\n", "a.ply:12: wanted 3 numbers for vertex 2"),
        ("a.ply", PLY + "0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", r"a.ply:13: .* in \[0, 3\)"),
        ("a.ply", PLY + "0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "a.ply:13: wanted a number of corners"),
        (
            "a.ply",
            PLY.replace("face 1", "face 0") + "0 0 0\n1 0 0\n0 1 0\n",
            "a.ply: wanted a mesh",
        ),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 3\n", "a.ply"),
        ("a.stl", f"solid\n{FACET}vertex 0 1\n", "a.stl:6: wanted three numbers, got '0 1'"),
        ("a.stl", f"solid\n{FACET}endloop\n", "a.stl:6: wanted facets of three vertices"),
        ("a.stl", f"solid\n{FACET}vertex 0 1 0\n", "a.stl:6: wanted endsolid, got the end"),
        ("a.stl", "solid\nendsolid\n", "a.stl: wanted a mesh with faces"),
        ("a.gltf", "{", "a.gltf: cannot be read as GLTF"),
        ("a.gltf", "{}", "a.gltf"),
        ("a.xyz", "", "a.xyz: wanted a suffix among .glb, .gltf, .obj.*got '.xyz'"),
        ("mesh", "", "mesh: wanted a suffix among"),
    ],
)
def test_broken_files_are_named_with_their_line(tmp_path, file, text, message):
    with pytest.raises(ValueError, match=message):
        load_mesh(write(tmp_path / file, text))


@pytest.mark.parametrize(("change", "size"), [(lambda b: b[:-5], 179), (lambda b: b + b"xx", 186)])
def test_binary_stl_of_another_length_than_it_announces(tmp_path, change, size):
    path = tmp_path / "a.stl"
    save_mesh(path, shapes.plane())
    path.write_bytes(change(path.read_bytes()))
    message = f"a.stl: wanted 184 bytes, for a header that announces 2 triangles, got {size}"
    with pytest.raises(ValueError, match=message):
        load_mesh(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_truncated_and_random_files_are_value_errors(tmp_path, suffix):
    whole = tmp_path / f"whole{suffix}"
    save_mesh(whole, shapes.icosahedron())
    content = whole.read_bytes()
    path = tmp_path / f"broken{suffix}"
    rng = np.random.default_rng(0)
    for broken in (
        b"",
        content[:10],
        content[: len(content) // 2],
        content[:-5],
        rng.bytes(500),
        content[:84] + rng.bytes(len(content) - 84),
    ):
        path.write_bytes(broken)
        if broken == content[:-5] and suffix == ".obj":
            continue  # a last index of fewer digits is a valid file
        with pytest.raises(ValueError, match=f"broken{suffix}"):
            load_mesh(path)


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.obj"):
        load_mesh(tmp_path / "none.obj")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(OSError, match=r"folder\.ply"):
        load_mesh(tmp_path / "folder.ply")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        save_mesh(tmp_path / "nowhere" / "a.ply", shapes.cube())
    with pytest.raises(ValueError, match="wanted a suffix among"):
        save_mesh(tmp_path / "a.png", shapes.cube())


def test_reading_says_nothing(tmp_path, capfd):
    save_mesh(tmp_path / "a.ply", shapes.cube())
    load_mesh(tmp_path / "a.ply")
    (tmp_path / "b.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-3])
    with pytest.raises(ValueError, match=r"b\.ply"):
        load_mesh(tmp_path / "b.ply")
    assert capfd.readouterr() == ("", "")
    assert not logging.getLogger("trimesh").disabled


def test_without_trimesh_the_error_says_what_to_install(tmp_path, monkeypatch):
    save_mesh(tmp_path / "a.ply", shapes.cube())
    real_import = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name.split(".")[0] == "trimesh":
            raise ImportError(name)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    monkeypatch.delitem(sys.modules, "trimesh")
    with pytest.raises(ImportError, match=r"pip install diffrast\[mesh\]"):
        load_mesh(tmp_path / "a.ply")


# ---------------------------------------------------------------------------------- common models


@pytest.mark.parametrize(
    ("name", "faces", "characteristic"),
    [
        ("spot", 5856, 2),
        ("suzanne", 968, None),
        ("fandisk", 12946, 2),
        ("stanford-bunny", 69451, None),
    ],
)
def test_common_models(name, faces, characteristic):
    path = MODELS / f"{name}.obj"
    if not path.exists():
        pytest.skip(f"the common test models are not at {MODELS}")
    mesh = load_mesh(path)
    assert mesh.faces.shape == (faces, 3)
    assert (mesh.uvs is not None) == (name == "spot")
    if characteristic is not None:
        assert dm.euler_characteristic(mesh) == characteristic
        assert dm.is_closed(mesh)
        assert dm.signed_volume(mesh) > 0
    smooth = dm.with_normals(mesh)
    used = np.unique(mesh.faces)
    np.testing.assert_allclose(jnp.linalg.norm(smooth.normals[used], axis=1), 1, rtol=1e-5)
