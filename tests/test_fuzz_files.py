"""Damaged and hostile files: documented errors only, in bounded time and memory, one folder.

`DIFFRAST_FUZZ_EXAMPLES` is the number of examples of each test, for a longer run than usual.
"""

import copy
import json
import os
import re
import sys
import tracemalloc
import zlib
from contextlib import contextmanager
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from limits import in_time
from PIL import Image

import diffrast as dr
from diffrast.files import (
    load_bezier,
    load_image,
    load_mesh,
    load_mesh_parts,
    load_objects,
    load_polygons,
    load_scene_file,
    save_mesh,
)
from diffrast.scene_files import read_scene

DATA = Path(__file__).parent / "data"
EXAMPLES = int(os.environ.get("DIFFRAST_FUZZ_EXAMPLES", "15"))
SECONDS = 20  # for one file; the usual one takes a hundredth
MEGABYTES = 64  # for one small file

fuzz = settings(
    derandomize=True,
    deadline=None,  # `bounded` has a limit that does not depend on what is compiled first
    max_examples=EXAMPLES,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)

opened: list[tuple[str, int]] | None = None


def watch(event, arguments):
    if opened is None:
        return
    if event == "open" and isinstance(arguments[0], str | bytes):
        opened.append((os.fsdecode(arguments[0]), arguments[2] or 0))
    elif event in ("subprocess.Popen", "os.system", "os.exec", "socket.connect", "os.remove"):
        opened.append((event, 0))


sys.addaudithook(watch)  # there is no way to remove it


def check_opened(folder):
    """Only files of the folder were read, but for modules that were imported, and none written."""
    own = Path(dr.__file__).parent  # tracebacks that are logged quote it
    places = [Path(p).resolve() for p in (sys.prefix, sys.base_prefix, own, *sys.path) if p]
    for name, flags in opened:
        path = Path(name).resolve()
        if path.is_relative_to(folder):
            assert not flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT), f"{name} was written"
        else:
            assert any(path.is_relative_to(place) for place in places), f"{name} was opened"


@contextmanager
def bounded(folder):
    """What runs inside ends in time and opens no file outside of the folder."""
    global opened
    opened = []
    try:
        with in_time(SECONDS):
            yield
        check_opened(folder)
    finally:
        opened = None


def read(reader, path, documented=()):
    """The result; None for a ValueError that names the file, and for errors documented."""
    result, message = None, path.name
    with bounded(path.parent.resolve()):
        try:
            result = reader(path)
        except documented:
            return None
        except ValueError as error:
            message = str(error)
    assert path.name in message
    for array in jax.tree.leaves(result):
        if np.issubdtype(getattr(array, "dtype", object), np.floating):
            assert np.all(np.isfinite(array))
    return result


def check_mesh(mesh):
    faces = np.asarray(mesh.faces)
    assert faces.min() >= 0
    assert faces.max() < len(mesh.vertices)


# ------------------------------------------------------------------------------------ whole files

FACES = "f 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1\n"
OBJ = (
    "# comment …\nmtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\n"
    f"vt 0 1\nvn 0 0 1\ng side\nusemtl one\n{FACES}usemtl two\nf -4 -3 \\\n -2 -1\n"
)
MTL = "newmtl one\nKa .1 .1 .1\nKd .8 .7 .6\nKs 1 1 1\nNs 20\nmap_Kd t.png\nnewmtl two\nKd 0 0 1\n"
OFF = "OFF # a square\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n4 0 1 2 3\n"
PLY = (
    "ply\nformat ascii 1.0\ncomment TextureFile t.png\nelement vertex 4\nproperty float x\n"
    "property float y\nproperty float z\nproperty float u\nproperty float v\nelement face 2\n"
    "property list uchar int vertex_indices\nend_header\n"
    "0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n0 1 0 0 1\n3 0 1 2\n3 0 2 3\n"
)
PLY_HEADER = (
    "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nelement face 1\nproperty list uchar {} vertex_indices\nend_header\n"
)
STL = (
    "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n"
    "endfacet\nendsolid a\n"
)


def picture_bytes(folder, suffix, mode, **options):
    values = np.random.default_rng(0).integers(0, 256, (9, 7, 3)).astype(np.uint8)
    image = Image.fromarray(values).convert(mode)
    path = folder / f"picture{suffix}"
    image.save(path, **options)
    content = path.read_bytes()
    path.unlink()
    return content


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """With a texture and a material file, below a folder with files that are nobody's business."""
    outside = tmp_path_factory.mktemp("outside")
    folder = outside / "inside"
    folder.mkdir()
    for place in (outside, folder):
        Image.fromarray(np.array([[[255, 0, 0], [0, 188, 0]]], np.uint8)).save(place / "t.png")
        (place / "m.mtl").write_text(MTL)
        for name in ("house.dat", "patch.bez"):
            (place / name).write_bytes((DATA / name).read_bytes())
    (outside / "buffer.bin").write_bytes(bytes(1000))
    (folder / "link.png").symlink_to(outside / "t.png")
    return folder


@pytest.fixture(scope="module")
def whole(folder):
    """Content of one valid file of each format, by a name."""
    mesh = dr.shapes.plane()
    found = {
        "text.obj": OBJ.encode(),
        "text.off": OFF.encode(),
        "text.ply": PLY.encode(),
        "text.stl": STL.encode(),
        "polygons.ply": PLY_HEADER.replace("face 1", "face 2").format("int").encode()
        + np.arange(9, dtype="<f4").tobytes()
        + b"\4\0\0\0\0\1\0\0\0\2\0\0\0\1\0\0\0\3\2\0\0\0\1\0\0\0\0\0\0\0",
        "house.dat": (DATA / "house.dat").read_bytes(),
        "patch.bez": (DATA / "patch.bez").read_bytes(),
        "scene.dat": (DATA / "scene1.dat").read_bytes().replace(b"patch.dat", b"patch.bez"),
        "rgb.png": picture_bytes(folder, ".png", "RGB"),
        "palette.png": picture_bytes(folder, ".png", "P", transparency=0),
        "grey.png": picture_bytes(folder, ".png", "I;16"),
        "photo.jpg": picture_bytes(folder, ".jpg", "RGB"),
        "moving.gif": picture_bytes(folder, ".gif", "P"),
        "plain.bmp": picture_bytes(folder, ".bmp", "RGB"),
        "deep.tif": picture_bytes(folder, ".tif", "RGB", compression="tiff_lzw"),
    }
    for suffix in (".ply", ".stl", ".glb", ".gltf"):
        save_mesh(folder / f"plane{suffix}", mesh)
        found[f"binary{suffix}"] = (folder / f"plane{suffix}").read_bytes()
    return found


# ----------------------------------------------------------------------------------- damaged files

WORDS = (
    b"0", b"-1", b"1", b"7", b"255", b"65536", b"2147483648", b"4294967296", b"-4294967295",
    b"1000000000000", b"-1000000000000", b"9" * 30, b"9" * 5000, b"1.5", b"1e39", b"-1e39",
    b"1e308", b"1e999", b"1e-320", b"nan", b"-inf", b"1_0", b"0x10", b"+1", b"\xb2", b"word", b"",
    b"\0", b"\xe2\x80\xa6", b"\r", b"/", b"//", b"{", b"}", b"#", b"..", b"../t.png",
    b"/etc/passwd",
)  # fmt: skip
NUMBERS = (0, 1, 2, 255, 2**15, 2**16, 2**31 - 1, 2**31, 2**32 - 1)


@st.composite
def damage(draw):
    """A way to damage a file, as a function of its content."""
    kind = draw(
        st.sampled_from(["word", "word", "flip", "cut", "drop", "twice", "number", "line", "lines"])
    )
    place = draw(st.floats(0, 1, exclude_max=True))
    word, size = draw(st.sampled_from(WORDS)), draw(st.integers(1, 40))
    value, number = draw(st.integers(1, 255)), draw(st.sampled_from(NUMBERS))

    def damaged(content):
        at = int(place * len(content))
        if kind == "word":
            words = list(re.finditer(rb"[^\s/,:{}\[\]]+", content)) or [re.match(b"", content)]
            found = words[int(place * len(words))]
            return content[: found.start()] + word + content[found.end() :]
        if kind == "flip":
            flipped = bytes(b ^ value for b in content[at : at + 1])
            return content[:at] + flipped + content[at + 1 :]
        if kind == "cut":
            return content[:at]
        if kind == "drop":
            return content[:at] + content[at + size :]
        if kind == "twice":
            return content[: at + size] + content[at:]
        if kind == "number":
            written = number.to_bytes(4, "big" if size % 2 else "little")
            return content[:at] + written + content[at + 4 :]
        lines = content.split(b"\n")
        number_of_line = int(place * len(lines))
        lines[number_of_line : number_of_line + 1] = (
            [] if kind == "line" else [lines[number_of_line]] * 2
        )
        return b"\n".join(lines)

    return damaged


DAMAGES = st.lists(damage(), min_size=1, max_size=3)


def broken(content, damages):
    for one in damages:
        content = one(content)
    return content


@pytest.mark.parametrize(
    "name",
    [
        "text.off",
        "text.ply",
        "binary.ply",
        "polygons.ply",
        "text.stl",
        "binary.stl",
        "text.obj",
    ],
)
def test_damaged_meshes(folder, whole, name):
    path = folder / f"damaged.{name.split('.')[1]}"
    reader = load_objects if name == "text.obj" else load_mesh

    @fuzz
    @given(DAMAGES)
    def run(damages):
        path.write_bytes(broken(whole[name], damages))
        found = read(reader, path)
        for item in found if isinstance(found, list) else [found] if found else []:
            check_mesh(item.mesh if isinstance(item, dr.Object) else item)

    run()


@fuzz
@given(DAMAGES)
def test_damaged_materials(folder, damages):
    (folder / "damaged.mtl").write_bytes(broken(MTL.encode(), damages))
    path = folder / "material.obj"
    path.write_text(OBJ.replace("m.mtl", "damaged.mtl"))
    read(load_objects, path)


@pytest.mark.parametrize("name", ["house.dat", "patch.bez"])
def test_damaged_objects_of_scenes(folder, whole, name):
    path = folder / f"damaged-{name}"

    @fuzz
    @given(DAMAGES)
    def run(damages):
        path.write_bytes(broken(whole[name], damages))
        found = read(load_polygons if name == "house.dat" else load_bezier, path)
        if found is not None and name == "patch.bez":
            assert found.control_points.shape == (len(found.surfaces), 4, 4, 3)

    run()


@fuzz
@given(DAMAGES)
def test_damaged_scenes(folder, whole, damages):
    path = folder / "damaged-scene.dat"
    path.write_bytes(broken(whole["scene.dat"], damages))
    if read(load_scene_file, path) is None:
        return
    found = read(read_scene, path, OSError)
    if found is not None:
        assert 0 < found.height < 1 << 16
        assert 0 < found.width < 1 << 16


@pytest.mark.parametrize(
    "name",
    ["rgb.png", "palette.png", "grey.png", "photo.jpg", "moving.gif", "plain.bmp", "deep.tif"],
)
@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, of odd metadata
def test_damaged_pictures(folder, whole, name):
    path = folder / f"damaged-{name}"

    @fuzz
    @given(DAMAGES)
    def run(damages):
        path.write_bytes(broken(whole[name], damages))
        image = read(lambda path: load_image(path, srgb=False), path)
        assert image is None or image.shape[2] in (3, 4)

    run()


# -------------------------------------------------------------------------------------------- glTF

JSON_VALUES = (
    None, True, -1, 0, 1, 7, 2**31, 10**12, -(10**12), 10**400, 0.5, 1e300, float("nan"), "",
    "word", "../buffer.bin", "/etc/passwd", "data:;base64,AAAA", "data:;base64,?", [], {}, [[]],
    [-1], [0, 0], [1e300] * 3, [0.0] * 16, {"index": -1},
)  # fmt: skip


def places(tree, found):
    """Every (parent, key) of a tree of JSON."""
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)):
        found.append((tree, key))
        if isinstance(tree[key], dict | list):
            places(tree[key], found)
    return found


def textured(whole):
    """A glTF file with two nodes, a material and a texture."""
    tree = json.loads(whole["binary.gltf"])
    base = {"baseColorTexture": {"index": 0, "texCoord": 0}, "baseColorFactor": [0.2, 0.4, 1, 1]}
    tree["materials"] = [{"pbrMetallicRoughness": base}]
    tree["textures"], tree["images"] = [{"source": 0, "sampler": 0}], [{"uri": "t.png"}]
    tree["samplers"] = [{"wrapS": 33071, "magFilter": 9728}]
    tree["nodes"].append({"mesh": 0, "translation": [1, 0, 0], "rotation": [0, 0, 0, 1]})
    tree["nodes"][0].setdefault("children", []).append(len(tree["nodes"]) - 1)
    return tree


def as_glb(tree):
    """The JSON alone as a binary file; its buffers keep their URIs."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    sizes = [n.to_bytes(4, "little") for n in (2, 20 + len(text), len(text))]
    return b"glTF" + sizes[0] + sizes[1] + sizes[2] + b"JSON" + text


def write_tree(path, tree):
    path.write_bytes(as_glb(tree) if path.suffix == ".glb" else json.dumps(tree).encode())


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
def test_damaged_gltf_trees(folder, whole, suffix):
    path = folder / f"damaged{suffix}"
    assert len(load_objects_of(path, textured(whole))) == 2
    change = st.tuples(
        st.floats(0, 1, exclude_max=True),
        st.sampled_from(["put", "put", "put", "drop", "twice"]),
        st.sampled_from(JSON_VALUES),
    )

    @fuzz
    @given(st.lists(change, min_size=1, max_size=2))
    def run(changes):
        tree = textured(whole)
        for place, kind, value in changes:
            found = places(tree, [])
            parent, key = found[int(place * len(found))]
            if kind == "drop":
                del parent[key]
            elif kind == "twice" and isinstance(parent, list):
                parent.append(parent[key])
            else:
                parent[key] = copy.deepcopy(value)
        write_tree(path, tree)
        for item in read(load_objects, path) or []:
            check_mesh(item.mesh)

    run()


def load_objects_of(path, tree):
    write_tree(path, tree)
    return load_objects(path)


@fuzz
@given(DAMAGES)
def test_damaged_glb_files(folder, whole, damages):
    path = folder / "bytes.glb"
    path.write_bytes(broken(whole["binary.glb"], damages))
    read(load_mesh_parts, path)


# --------------------------------------------------------------------------------- hostile headers


def png(width, height, rows, *, bits=8, kind=2):
    def chunk(name, data):
        body = name + data
        return len(data).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")

    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([bits, kind, 0, 0, 0])
    data = chunk(b"IDAT", zlib.compress(rows, 9))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + data + chunk(b"IEND", b"")


MANY = 10**12
BODY = np.arange(9, dtype="<f4").tobytes()
HOSTILE = {
    "vertices.off": f"OFF\n{MANY} 1 0\n0 0 0\n".encode(),
    "faces.off": f"OFF\n1 {MANY} 0\n0 0 0\n".encode(),
    "corners.off": f"OFF\n1 1 0\n0 0 0\n{MANY} 0 0 0\n".encode(),
    "digits.off": b"OFF\n" + b"9" * 5000 + b" 1 0\n0 0 0\n",
    "superscript.off": "OFF\n3 ² 0\n".encode("latin-1"),
    "vertices.ply": PLY.replace("vertex 4", f"vertex {MANY}").encode(),
    "corners.ply": PLY.replace("\n3 0 1 2", f"\n{MANY} 0 1 2").encode(),
    "digits.ply": PLY.replace("vertex 4", "vertex " + "9" * 5000).encode(),
    "binary.ply": PLY_HEADER.format("int").replace("vertex 3", f"vertex {MANY}").encode() + BODY,
    "most.ply": PLY_HEADER.format("int").replace("vertex 3", "vertex " + "9" * 18).encode() + BODY,
    "negative.ply": PLY_HEADER.format("int").replace("vertex 3", "vertex -3").encode() + BODY,
    "length.ply": PLY_HEADER.format("int").replace("uchar", "uint").encode() + BODY + b"\xff" * 16,
    "index.ply": PLY_HEADER.format("uint").encode() + BODY + b"\x03" + b"\xff" * 12,
    "wide-index.ply": PLY_HEADER.format("uint64").encode()
    + BODY
    + b"\x03"
    + np.array([2**32, 2**32 + 1, 2**32 + 2]).tobytes(),
    "facets.stl": bytes(80) + b"\xff" * 4 + bytes(50),
    "index.obj": OBJ.replace("2/2/1", f"{MANY}/2/1").encode(),
    "digits.obj": OBJ.replace("2/2/1", "9" * 5000).encode(),
    "chunk.glb": b"glTF\2\0\0\0" + b"\xff" * 8 + b"JSON{}",
    "nested.gltf": b'{"extras":' + b"[" * 100_000,
    "nested-object.gltf": b'{"a":' * 100_000,
    "points.bez": f"{MANY} 1 1\n0 0 0 0\n".encode(),
    "patches.bez": f"1 {MANY} 1\n0 0 0 0\n".encode(),
    "surfaces.bez": f"1 1 {MANY}\n0 0 0 0\n0 {MANY - 1} 16 {'0 ' * 16}\n".encode(),
    "braces.bez": b"{" * 100_000,
    "points.dat": f"{MANY} 1 1\n0 0 0 0\n".encode(),
    "polygons.dat": f"1 {MANY} 1\n0 0 0 0\n".encode(),
    "corners.dat": f"1 1 1\n0 0 0 0\n0 0 {MANY} 0 0 0\n".encode(),
    "surfaces.dat": f"1 1 {MANY}\n0 0 0 0\n0 {MANY - 1} 3 0 0 0\n".encode(),
    "large.png": png(100_000, 100_000, b""),
    "hundred-million.png": png(10_000, 10_000, b""),
    "short.png": png(9_000, 9_000, b""),
    "bits.png": png(100_000, 1_000, bytes(12_501_000), bits=1, kind=0),
    "program.png": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n",
}
READERS = {".bez": load_bezier, ".dat": load_polygons, ".png": load_image}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_headers_are_refused_in_little_memory(folder, name):
    path = folder / name
    path.write_bytes(HOSTILE[name])
    reader = READERS.get(path.suffix, load_mesh)
    assert refusal(reader, path)


def refusal(reader, path):
    """The message of a ValueError that names the file and comes before much memory is taken."""
    with (
        in_little_memory(),
        bounded(path.parent.resolve()),
        pytest.raises(ValueError, match=re.escape(path.name)) as error,
    ):
        reader(path)
    return str(error.value)


@contextmanager
def in_little_memory():
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < MEGABYTES << 20
    finally:
        tracemalloc.stop()


def test_edges_of_a_ply_file_are_passed_over(folder):
    edges = "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header"
    path = folder / "edges.ply"
    path.write_text(PLY.replace("end_header", edges) + "0 2000000000\n")
    with in_little_memory():
        assert read(load_mesh, path).faces.shape == (2, 3)


def chain(tree, *children):
    """As many nodes as there are lists of children."""
    tree["nodes"] = [{"mesh": 0, "children": list(list_)} for list_ in children]
    tree["scenes"], tree["scene"] = [{"nodes": [0]}], 0


HOSTILE_TREES = {
    "count": (
        lambda t: t["accessors"][0].update(count=MANY),
        r"accessors\[0\]: wanted an end within the \d+ bytes of bufferViews\[\d\], got \d{13}",
    ),
    "negative count": (
        lambda t: t["accessors"][0].update(count=-1),
        r"accessors\[0\]: wanted a whole number count, got -1",
    ),
    "no buffer": (
        lambda t: [(a.update(count=MANY), a.pop("bufferView")) for a in t["accessors"]],
        r"meshes\[0\]: \w+: wanted plain values|meshes\[0\]: wanted plain values as \w+",
    ),
    "sparse": (
        lambda t: t["accessors"][0].update(sparse={"count": MANY}),
        r"wanted plain values as \w+, got compressed or sparse ones",
    ),
    "offset": (
        lambda t: t["accessors"][0].update(byteOffset=MANY),
        r"accessors\[0\]: wanted an end within",
    ),
    "negative offset": (
        lambda t: t["bufferViews"][0].update(byteOffset=-4),
        r"bufferViews\[0\]: wanted a whole number byteOffset, got -4",
    ),
    "length": (
        lambda t: t["bufferViews"][0].update(byteLength=MANY),
        r"bufferViews\[0\]: wanted an end within the \d+ bytes of buffers\[0\]",
    ),
    "both lengths": (
        lambda t: (
            t["buffers"][0].update(byteLength=2 * MANY),
            t["bufferViews"][0].update(byteLength=MANY),
        ),
        "cannot be read as GL",
    ),
    "stride": (
        lambda t: [view.update(byteStride=0) for view in t["bufferViews"]],
        r"accessors\[0\]: wanted a byteStride of at least \d+, got 0",
    ),
    "short stride": (
        lambda t: [view.update(byteStride=1) for view in t["bufferViews"]],
        r"accessors\[0\]: wanted a byteStride of at least \d+, got 1",
    ),
    "type": (
        lambda t: t["accessors"][0].update(type="MAT9"),
        r"accessors\[0\]: wanted type to be one of SCALAR, .* got 'MAT9'",
    ),
    "position": (
        lambda t: t["meshes"][0]["primitives"][0]["attributes"].update(POSITION=-1),
        r"meshes\[0\]: POSITION: wanted an index in \[0, \d\), got -1",
    ),
    "picture": (
        lambda t: t["textures"][0].update(source=-1),
        r"textures\[0\]: source: wanted an index in \[0, 1\), got -1",
    ),
    "own child": (lambda t: chain(t, [0]), r"nodes: wanted trees, got nodes\[0\] in nodes\[0\]"),
    "cycle": (lambda t: chain(t, [1], [2], [1]), r"nodes: wanted trees, got nodes\[1\]"),
    "many ways": (
        lambda t: chain(t, *[[n + 1] * 2 for n in range(40)], []),
        r"nodes: wanted trees, got nodes\[1\] in nodes\[0\] and in nodes\[0\]",
    ),
    "negative child": (lambda t: chain(t, [-1]), r"nodes\[0\]: node: wanted an index"),
    "not a number": (
        lambda t: t["nodes"][0].update(translation=[float("nan"), 0, 0]),
        "wanted a number, got NaN",
    ),
    "buffer outside": (
        lambda t: t["buffers"][0].update(uri="../buffer.bin"),
        "'../buffer.bin' is not in",
    ),
    "device": (lambda t: t["buffers"][0].update(uri="/dev/zero"), "'/dev/zero' is not in"),
    "folder": (lambda t: t["buffers"][0].update(uri="."), "is not in"),
}


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
@pytest.mark.parametrize("case", HOSTILE_TREES)
def test_hostile_gltf_trees_are_refused_in_little_memory(folder, whole, case, suffix):
    change, message = HOSTILE_TREES[case]
    tree = textured(whole)
    change(tree)
    path = folder / f"hostile{suffix}"
    write_tree(path, tree)
    assert re.search(message, refusal(load_objects, path))


def test_deep_trees_of_nodes_end(folder, whole):
    tree = textured(whole)
    chain(tree, *[[n + 1] for n in range(300)], [])
    path = folder / "deep.gltf"
    write_tree(path, tree)
    assert read(load_mesh, path).faces.shape == (301 * 2, 3)


# ------------------------------------------------------------------------------- one folder only

OUTSIDE = ["../t.png", "../inside/../t.png", "link.png", "{outside}/t.png", "/dev/zero", "~/t.png"]


@pytest.mark.parametrize("name", OUTSIDE)
def test_textures_of_other_folders_are_not_opened(folder, whole, name):
    name = name.format(outside=folder.parent.resolve())
    own = Path(name).name == "t.png"  # found by its last part in the folder instead
    (folder / "own.mtl").write_text(MTL.replace("t.png", name))
    path = folder / "own.obj"
    path.write_text(OBJ.replace("m.mtl", "own.mtl"))
    parts = read(load_mesh_parts, path)
    assert (parts[0].texture is not None) == own
    tree = textured(whole)
    tree["images"][0]["uri"] = name
    write_tree(folder / "own.gltf", tree)
    assert all((p.texture is not None) == own for p in read(load_mesh_parts, folder / "own.gltf"))
    (folder / "own.ply").write_text(PLY.replace("t.png", name))
    read(load_mesh_parts, folder / "own.ply")


def test_materials_of_other_folders_are_not_opened(folder):
    path = folder / "far.obj"
    for name in ("../other.mtl", "/etc/passwd", "..", "\x7f", "m\u0085.mtl", "a" * 5000):
        path.write_text(OBJ.replace("m.mtl", name))
        assert all(part.diffuse is None for part in read(load_mesh_parts, path))


@pytest.mark.parametrize("name", ["../house.dat", "{outside}/house.dat", "/etc/passwd", "link.png"])
def test_objects_of_other_folders_are_not_opened(folder, whole, name):
    name = name.format(outside=folder.parent.resolve())
    path = folder / "far-scene.dat"
    path.write_bytes(whole["scene.dat"].replace(b"house.dat", name.encode()))
    message = f"wanted objects from its own folder, got '{name}'"
    assert message in refusal(read_scene, path)


# --------------------------------------------------------------------- errors that were found once


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.off", b"OFF\n3 \xb2 0\n", "a.off:2: wanted the numbers of vertices and faces"),
        ("a.ply", PLY.replace("face 2", "face x").encode(), "a.ply:10: wanted a name and a number"),
        ("b.ply", PLY.partition("end_header")[0].encode(), "b.ply:11: wanted end_header"),
        ("a.obj", OBJ.replace("v 1 1 0", "v 1_0 1 0").encode(), "a.obj:5: wanted 3 numbers after"),
        ("b.obj", OBJ.replace("1/1/1", "1_0/1/1", 1).encode(), "b.obj:14: wanted a corner"),
        ("a.bez", b"1 1 1\n0 1e39 0", "a.bez:2: wanted z of control point 0, got the end"),
        (
            "a.stl",
            STL.replace("facet", "FACET").replace("1 0 0", "1 0").encode(),
            "a.stl:5: wanted",
        ),
    ],
)
def test_errors_name_the_line(folder, name, content, message):
    path = folder / f"named-{name}"
    path.write_bytes(content)
    assert message in refusal(READERS.get(path.suffix, load_mesh), path)


def test_letters_of_comments_do_not_end_lines(folder):
    path = folder / "letters.off"
    path.write_bytes(OFF.replace("a square", "Ångström… \x1c").encode())
    assert read(load_mesh, path).faces.shape == (3, 3)


def test_materials_that_are_no_numbers_name_the_file(folder):
    (folder / "nan.mtl").write_text(MTL.replace("Ns 20", "Ns nan"))
    path = folder / "nan.obj"
    path.write_text(OBJ.replace("m.mtl", "nan.mtl"))
    wanted = "nan.obj: nan.mtl:5: wanted 1 number after Ns, got 'nan'"
    assert wanted in refusal(load_objects, path)
    with pytest.raises(ValueError, match="filter: wanted one of"):
        load_objects(path, filter="sharp")
    with pytest.raises(ValueError, match="wrap: wanted one of"):
        load_objects(path, wrap="fold")


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (7, "1e300 1e-300", ":8: wanted rows that make fewer than 65536 columns"),
        (4, "1e300 0 0", "scene.dat: .*finite"),
        (13, "1e39 1 1", "scene.dat: .*finite"),
    ],
)
def test_scenes_of_numbers_too_large_name_the_file(folder, whole, line, text, message):
    lines = whole["scene.dat"].split(b"\n")
    lines[line - 1] = text.encode()
    path = folder / "large-scene.dat"
    path.write_bytes(b"\n".join(lines))
    assert re.search(message, refusal(read_scene, path))
