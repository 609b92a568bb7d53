"""Images in and out: every kind of file, the sRGB encoding, errors that name the file."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from diffrast.color import srgb_to_linear
from diffrast.files.images import load_image, save_animation, save_image

RNG = np.random.default_rng(0)


def decoded(values):
    return np.asarray(srgb_to_linear(values))


def write_png16(path, values):
    """A 16-bit PNG of 1 to 4 channels, which Pillow cannot write; Sub filter in every other row."""
    height, width, channels = values.shape

    def row(index):
        data = np.frombuffer(values[index].astype(">u2").tobytes(), np.uint8)
        left = np.concatenate([np.zeros(2 * channels, np.uint8), data[: -2 * channels]])
        return b"\1" + (data - left).tobytes() if index % 2 else b"\0" + data.tobytes()

    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 16, (0, 4, 2, 6)[channels - 1], 0, 0, 0)
    body = zlib.compress(b"".join(row(index) for index in range(height)))
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("shape", [(5, 7, 3), (5, 7, 4), (5, 7)])
def test_saved_images_come_back(tmp_path, shape):
    codes = RNG.integers(0, 256, shape)
    linear = codes / 255
    color = linear if len(shape) == 2 else linear[..., :3]
    color[...] = decoded(color)
    save_image(tmp_path / "image.png", linear)
    with Image.open(tmp_path / "image.png") as file:
        np.testing.assert_array_equal(np.asarray(file), codes)  # alpha is not encoded
    image = load_image(tmp_path / "image.png")
    assert image.dtype == np.float32
    wanted = np.repeat(linear[..., None], 3, axis=-1) if len(shape) == 2 else linear
    np.testing.assert_allclose(image, wanted, atol=1e-6)


def test_values_are_clamped_and_rounded_and_data_stays_linear(tmp_path):
    image = np.array([[[-1.0, 0.5, 7.0], [0.2, 0.4999 / 255, 0.5001 / 255]]])
    save_image(tmp_path / "data.png", image, srgb=False)
    codes = np.array([[[0, 128, 255], [51, 0, 1]]])
    np.testing.assert_allclose(
        load_image(tmp_path / "data.png", srgb=False) * 255, codes, rtol=1e-6
    )
    save_image(tmp_path / "picture.png", np.full((2, 2, 3), 0.5))
    with Image.open(tmp_path / "picture.png") as file:
        assert file.getpixel((0, 0)) == (188, 188, 188)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_sixteen_bits_are_kept(tmp_path, channels):
    values = RNG.integers(0, 65536, (6, 5, channels))
    write_png16(tmp_path / "deep.png", values)
    image = np.asarray(load_image(tmp_path / "deep.png", srgb=False))
    wanted = values if channels > 2 else values[..., [0, 0, 0, 1][: 3 + (channels == 2)]]
    np.testing.assert_allclose(image * 65535, wanted, rtol=1e-6)
    color = np.asarray(load_image(tmp_path / "deep.png"))[..., :3]
    np.testing.assert_allclose(color, decoded(wanted[..., :3] / 65535), atol=1e-6)


def test_other_kinds_of_files(tmp_path):
    codes = RNG.integers(0, 256, (8, 8, 3)).astype(np.uint8)
    Image.fromarray(codes).quantize(4).save(tmp_path / "palette.png")
    with Image.open(tmp_path / "palette.png") as file:
        wanted = np.asarray(file.convert("RGB"))
    np.testing.assert_allclose(
        load_image(tmp_path / "palette.png"), decoded(wanted / 255), atol=1e-6
    )
    Image.fromarray(codes).quantize(4).save(tmp_path / "clear.png", transparency=0)
    assert set(np.unique(load_image(tmp_path / "clear.png")[..., 3])) == {0.0, 1.0}
    grey = Image.fromarray(codes[..., 0])
    grey.convert("LA").save(tmp_path / "grey_alpha.png")
    assert load_image(tmp_path / "grey_alpha.png").shape == (8, 8, 4)
    grey.convert("1").save(tmp_path / "bits.png")
    assert load_image(tmp_path / "bits.png").shape == (8, 8, 3)
    flat = np.full((8, 6, 3), (200, 100, 50), np.uint8)
    for mode in ("RGB", "CMYK"):
        Image.fromarray(flat).convert(mode).save(tmp_path / "photo.jpg", quality=95)
        np.testing.assert_allclose(
            load_image(tmp_path / "photo.jpg"), decoded(flat / 255), atol=0.02
        )


def test_photographs_are_turned_upright(tmp_path):
    flat = np.zeros((8, 16, 3), np.uint8)
    flat[:, :8] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # the right side of the stored picture is its bottom
    Image.fromarray(flat).save(tmp_path / "photo.jpg", exif=exif, quality=95)
    image = np.asarray(load_image(tmp_path / "photo.jpg"))
    assert image.shape == (16, 8, 3)
    assert image[:6].min() > 0.9
    assert image[10:].max() < 0.1


def test_photographs_of_sixteen_bits_are_turned_upright(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    values = RNG.integers(0, 65536, (2, 3, 4)).astype(np.uint16)
    turned = np.rot90(values, -1) / 65535
    block = b"eXIf" + exif.tobytes().removeprefix(b"Exif\0\0")
    chunk = struct.pack(">I", len(block) - 4) + block + struct.pack(">I", zlib.crc32(block))
    for channels, wanted in (
        (1, turned[..., [0, 0, 0]]),
        (2, turned[..., [0, 0, 0, 1]]),
        (3, turned[..., :3]),
        (4, turned),
    ):
        path = tmp_path / f"{channels}.png"
        write_png16(path, values[..., :channels])
        content = path.read_bytes()
        path.write_bytes(content[:33] + chunk + content[33:])  # behind the header
        np.testing.assert_allclose(load_image(path, srgb=False), wanted, rtol=1e-6)


@pytest.mark.parametrize("channels", [1, 3])
def test_one_colour_of_sixteen_bits_may_be_transparent(tmp_path, channels):
    values = RNG.integers(0, 65536, (2, 3, channels))
    write_png16(tmp_path / "clear.png", values)
    block = b"tRNS" + values[0, 1].astype(">u2").tobytes()
    chunk = struct.pack(">I", len(block) - 4) + block + struct.pack(">I", zlib.crc32(block))
    content = (tmp_path / "clear.png").read_bytes()
    (tmp_path / "clear.png").write_bytes(content[:33] + chunk + content[33:])
    image = np.asarray(load_image(tmp_path / "clear.png", srgb=False))
    np.testing.assert_allclose(image[..., :3] * 65535, values * np.ones(3), rtol=1e-6)
    np.testing.assert_array_equal(image[..., 3], [[1, 0, 1], [1, 1, 1]])


def test_other_files_of_sixteen_bits(tmp_path):
    values = RNG.integers(0, 65536, (2, 3)).astype(np.uint16)
    (tmp_path / "a.pgm").write_bytes(b"P5 3 2 65535\n" + values.astype(">u2").tobytes())
    Image.frombytes("I;16B", (3, 2), values.astype(">u2").tobytes()).save(tmp_path / "a.tif")
    for name in ("a.pgm", "a.tif"):
        image = np.asarray(load_image(tmp_path / name, srgb=False))
        np.testing.assert_allclose(image * 65535, values[..., None] * np.ones(3), rtol=1e-6)


def test_animations(tmp_path):
    images = RNG.uniform(size=(3, 4, 5, 1)) * np.ones(3)
    save_animation(tmp_path / "a.gif", images, frames_per_second=12.5)
    with Image.open(tmp_path / "a.gif") as file:
        assert (file.n_frames, file.size, file.info["duration"]) == (3, (5, 4), 80)
        assert file.info["loop"] == 0
        for index in range(3):
            file.seek(index)
            frame = np.asarray(file.convert("RGB")) / 255
            np.testing.assert_allclose(decoded(frame), images[index], atol=0.01)


def test_the_slowest_animation(tmp_path):
    images = RNG.uniform(size=(2, 4, 5, 3))
    save_animation(tmp_path / "a.gif", images, frames_per_second=1 / 655.35)
    with Image.open(tmp_path / "a.gif") as file:
        assert file.info["duration"] == 655350


BROKEN = {
    "empty.png": b"",
    "text.png": b"not an image",
    "short.png": None,
    "short.jpg": None,
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_are_named(tmp_path, name):
    path = tmp_path / name
    data = BROKEN[name]
    if data is None:
        Image.fromarray(RNG.integers(0, 256, (64, 64, 3)).astype(np.uint8)).save(path)
        data = path.read_bytes()[:700]
    path.write_bytes(data)
    with pytest.raises(ValueError, match=rf"{name}: cannot be read as an image"):
        load_image(path)


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.png"):
        load_image(tmp_path / "none.png")
    with pytest.raises(FileNotFoundError, match=r"a\.png: its folder does not exist"):
        save_image(tmp_path / "none" / "a.png", np.zeros((2, 2, 3)))
    with pytest.raises(ValueError, match="cannot be read as an image"):
        load_image(tmp_path)


@pytest.mark.parametrize(
    ("image", "name", "message"),
    [
        (np.full((2, 2, 3), np.nan), "a.png", "image: wanted finite numbers, got nan at index"),
        (np.zeros((2, 2, 3), np.uint8), "a.png", "image: wanted floating-point values"),
        (np.zeros((2, 2, 2)), "a.png", "image: wanted shape"),
        (np.zeros(4), "a.png", "image: wanted shape"),
        (np.zeros((0, 2, 3)), "a.png", "image: wanted shape"),
        (np.zeros((2, 2, 3)), "a.what", r"a\.what: cannot be written as an image"),
        (np.zeros((2, 2, 4)), "a.jpg", r"a\.jpg: cannot be written as an image"),
        (
            np.zeros((2, 2, 4)),
            "a.bmp",
            r"a\.bmp: cannot be written .*BMP holds no alpha",
        ),
        (np.zeros((2, 2, 3)), "a.psd", r"a\.psd: cannot be written as an image"),
    ],
)
def test_what_cannot_be_saved(tmp_path, image, name, message):
    with pytest.raises(ValueError, match=message):
        save_image(tmp_path / name, image)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_saved_leaves_the_file_that_is_there(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(b"a good picture")
    with pytest.raises(ValueError, match="cannot be written as an image"):
        save_image(path, np.zeros((2, 2, 4)))
    assert path.read_bytes() == b"a good picture"


@pytest.mark.parametrize(
    ("images", "options", "message"),
    [
        ([], {}, "images: wanted at least one"),
        ([np.zeros((2, 2, 3)), np.zeros((3, 2, 3))], {}, "images: wanted equal shapes"),
        ([np.full((2, 2, 3), np.nan)], {}, r"images\[0\]: wanted finite"),
        ([np.zeros((2, 2, 3))], {"frames_per_second": 0.0}, "frames_per_second: wanted"),
        ([np.zeros((2, 2, 3))], {"frames_per_second": 200.0}, "frames_per_second: wanted at most"),
        (
            [np.zeros((2, 2, 3))],
            {"frames_per_second": 0.001},
            r"wanted at least 0\.001526, no picture for more than 655\.35 s, got 0\.001",
        ),
        ([np.zeros((2, 2, 3))] * 66, {"frames_per_second": 0.1}, "at least 0.1007, .* 66 equal"),
        ([np.zeros((2, 2, 3))], {"name": "a.png"}, r"path: wanted a name that ends in \.gif"),
    ],
)
def test_what_cannot_be_animated(tmp_path, images, options, message):
    options = dict(options)
    with pytest.raises(ValueError, match=message):
        save_animation(tmp_path / options.pop("name", "a.gif"), images, **options)
