"""Images in and out, through Pillow: linear RGB here, sRGB in the file."""

import io
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float32, UInt8
from PIL import Image, ImageFile, ImageOps, UnidentifiedImageError

from diffrast._check import ArrayInput, file_path, flag, float_array, iterable, real_number
from diffrast.color import linear_to_srgb, srgb_to_linear

_LONGEST = 0xFFFF  # time of a GIF's frame, in 1/100 s
_OPAQUE = (".bmp", ".dib")  # to which Pillow writes an alpha that nobody reads


def load_image(path: str | Path, *, srgb: bool = True) -> Float32[Array, "height width channels"]:
    """Read an image as linear RGB, or RGB and alpha where the file has transparency.

    Reads what Pillow reads, 8 or 16 bits a channel: PNG, JPEG, ... Grey and palette images become
    RGB. A photograph's orientation mark is obeyed. Alpha is not premultiplied and never decoded.
    Images of more than `PIL.Image.MAX_IMAGE_PIXELS` (89 million) are refused: a small file can
    claim to be of any size.

    Args:
        path: the file.
        srgb: the file holds sRGB colours, as pictures do. False for data such as roughness or
            normals: the numbers are only scaled to 0 to 1.

    Raises:
        ValueError: with the file's name, for a file that cannot be read as an image.
        FileNotFoundError: for a file that is not there.
    """
    path, srgb = file_path("path", path), flag("srgb", srgb)
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:  # a folder, say
        raise ValueError(f"{path}: cannot be read as an image ({error})") from error
    return jnp.asarray(decoded_picture(content, str(path), srgb=srgb))


def save_image(path: str | Path, image: ArrayInput, *, srgb: bool = True) -> None:
    """Write a linear image as 8 bits a channel, in the format that the file's name ends in.

    Args:
        path: the file; its folder must exist.
        image: (height, width, 3) or with alpha (..., 4), or grey (height, width). Values are
            clamped to 0 to 1.
        srgb: encode the colours as sRGB, as pictures are. False for data.

    Raises:
        ValueError: for other shapes, whole numbers (which would be 0 to 255, not 0 to 1), NaN and
            infinity, and formats that Pillow cannot write, or only without the alpha given. A
            file of that name that was there is then still there.
        FileNotFoundError: for a folder that is not there.
    """
    path, srgb = file_path("path", path), flag("srgb", srgb)
    _write(path, [Image.fromarray(_to_bytes("image", image, srgb))])


def save_animation(
    path: str | Path,
    images: Iterable[ArrayInput],
    *,
    frames_per_second: float = 20.0,
    srgb: bool = True,
) -> None:
    """Write linear images as an endlessly repeated GIF of at most 256 colours a frame.

    Args:
        path: the file, ending in .gif; its folder must exist.
        images: equal in size, each as for `save_image`.
        frames_per_second: at most 100. GIF rounds the time of a frame to 1/100 s, and 655.35 s is
            its longest; equal images in a row are one frame.
        srgb: as for `save_image`.

    Raises:
        ValueError: as for `save_image`, and for no images or images of different sizes.
        FileNotFoundError: for a folder that is not there.
    """
    rate = float(real_number("frames_per_second", frames_per_second, above=0.0))
    if rate > 100:
        raise ValueError(f"frames_per_second: wanted at most 100, got {rate:g}")
    path, srgb = file_path("path", path), flag("srgb", srgb)
    if path.suffix.lower() != ".gif":
        raise ValueError(f"path: wanted a name that ends in .gif, got {path}")
    iterable("images", images, "a list of images")
    frames = [_to_bytes(f"images[{i}]", image, srgb) for i, image in enumerate(images)]
    for index, frame in enumerate(frames):
        if frame.shape != frames[0].shape:
            raise ValueError(
                f"images: wanted equal shapes, got {frames[0].shape} at index 0 and"
                f" {frame.shape} at index {index}"
            )
    if not frames:
        raise ValueError("images: wanted at least one, got none")
    time = round(100 / rate)
    equal = max(sum(1 for _ in run) for _, run in groupby(frames, key=np.ndarray.tobytes))
    if equal * time > _LONGEST:
        raise ValueError(
            f"frames_per_second: wanted at least {100 * equal / _LONGEST:.4g}, no picture for more"
            f" than {_LONGEST / 100:g} s, got {rate:g} and {equal} equal images in a row"
        )
    duration = 10 * time  # in milliseconds
    _write(path, [Image.fromarray(f) for f in frames], save_all=True, duration=duration, loop=0)


def decoded_picture(
    content: bytes, name: str, *, srgb: bool = True
) -> Float32[np.ndarray, "height width channels"]:
    """The picture that a file's content is, as `load_image` reads it.

    Raises:
        ValueError: with `name`, for anything else.
    """
    try:
        with Image.open(io.BytesIO(content)) as image:
            _check_picture(image)
            values = _deep_channels(image, content)
            if values is None:
                values = _channels(ImageOps.exif_transpose(image))
    except Exception as error:  # Pillow's readers fail in any way: SyntaxError, struct.error, ...
        unknown = isinstance(error, UnidentifiedImageError)
        reason = "of no known format" if unknown else error
        raise ValueError(f"{name}: cannot be read as an image ({reason})") from error
    if srgb:
        values[..., :3] = srgb_to_linear(values[..., :3])
    return values


# --------------------------------------------------------------------------------------- details


def _check_picture(image: Image.Image) -> None:
    """Refuse pictures that are dangerous to decode, before any of their pixels are.

    Raises:
        ValueError: for one of too many pixels, and for PostScript, a program that Ghostscript runs.
    """
    limit = Image.MAX_IMAGE_PIXELS
    if limit is not None and image.width * image.height > limit:
        raise ValueError(
            f"wanted at most {limit} pixels, PIL.Image.MAX_IMAGE_PIXELS, got {image.width} x"
            f" {image.height}"
        )
    if image.format == "EPS":
        raise ValueError("wanted a picture of pixels, got PostScript")


def _channels(image: Image.Image) -> Float32[np.ndarray, "height width channels"]:
    """RGB or RGBA of an image of 8 bits a channel."""
    if image.mode == "F" or image.mode.startswith("I"):
        raise ValueError(f"wanted 8 or 16 bits a channel, got mode {image.mode}")
    transparent = "A" in image.getbands() or "transparency" in image.info
    return _unit(np.asarray(image.convert("RGBA" if transparent else "RGB")), 255)


def _deep_channels(
    image: ImageFile.ImageFile, content: bytes
) -> Float32[np.ndarray, "height width channels"] | None:
    """RGB or RGBA of an image of 16 bits a channel; None for any other.

    Pillow keeps 16 bits of grey only. Of PNG colours it drops the lower byte; read as if the bytes
    stood the other way round it drops the upper one.
    """
    raw_mode = image.tile[0][3] if image.format == "PNG" and image.tile else ""
    if image.mode.startswith("I;16") or (image.mode == "I" and image.format in ("PNG", "PPM")):
        values = np.asarray(ImageOps.exif_transpose(image))[..., None]
    elif raw_mode == "LA;16B":  # four bytes a pixel, as 8-bit RGBA has
        grey_high, grey_low, alpha_high, alpha_low = np.moveaxis(_decode(content, "RGBA"), -1, 0)
        high = np.stack([grey_high, grey_high, grey_high, alpha_high], axis=-1)
        low = np.stack([grey_low, grey_low, grey_low, alpha_low], axis=-1)
        values = high.astype(np.uint16) * 256 + low
    elif raw_mode in ("RGB;16B", "RGBA;16B"):
        high, low = (_decode(content, mode) for mode in (raw_mode, raw_mode.replace("16B", "16L")))
        values = high.astype(np.uint16) * 256 + low
    else:
        return None
    color = np.repeat(values, 3, axis=-1) if values.shape[-1] == 1 else values
    if "transparency" in image.info:  # the one colour that is not opaque
        opaque = np.any(values != image.info["transparency"], axis=-1, keepdims=True)
        color = np.concatenate([color, opaque * np.uint16(65535)], axis=-1)
    return _unit(color, 65535)


def _decode(content: bytes, raw_mode: str) -> UInt8[np.ndarray, "height width channels"]:
    """Pixels of a PNG, its bytes understood as `raw_mode`."""
    with Image.open(io.BytesIO(content)) as image:
        tiles: Any = [(*tile[:3], raw_mode) for tile in image.tile]
        image.tile = tiles
        return np.array(ImageOps.exif_transpose(image))


def _unit(values: np.ndarray, full: int) -> np.ndarray:
    return values.astype(np.float32) / np.float32(full)


def _to_bytes(name: str, image: ArrayInput, srgb: bool) -> UInt8[np.ndarray, "height width *c"]:
    values = float_array(name, image)
    dtype = jnp.result_type(image) if hasattr(image, "dtype") else np.asarray(image).dtype
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"{name}: wanted floating-point values from 0 to 1, got dtype {dtype}")
    channels = values.shape[2:] or (1,)
    if values.ndim not in (2, 3) or values.size == 0 or channels not in ((1,), (3,), (4,)):
        raise ValueError(
            f"{name}: wanted shape (height, width, 3 or 4) or (height, width), got {values.shape}"
        )
    values = jnp.clip(values.reshape(*values.shape[:2], *channels), 0, 1)
    if srgb:
        color = linear_to_srgb(values[..., :3])
        values = jnp.concatenate([color, values[..., 3:]], axis=-1)
    pixels = np.asarray(jnp.round(values * 255)).astype(np.uint8)
    return pixels[..., 0] if channels == (1,) else pixels


def _write(path: Path, frames: list[Image.Image], **options: Any) -> None:
    """Write a file as a whole: one that is there stays as it is until the new one is encoded."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: its folder does not exist")
    if len(frames) > 1:
        options["append_images"] = frames[1:]
    encoded = io.BytesIO()
    encoded.name = str(path)  # by which Pillow knows the format
    try:
        if path.suffix.lower() in _OPAQUE and frames[0].mode == "RGBA":
            raise ValueError("BMP holds no alpha")
        frames[0].save(encoded, **options)
    except (ValueError, OSError, KeyError) as error:  # KeyError: a format that is only read
        raise ValueError(f"{path}: cannot be written as an image ({error})") from error
    path.write_bytes(encoded.getbuffer())
