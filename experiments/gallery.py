"""Do the pictures of the sources come out?

    python experiments/gallery.py
    python experiments/gallery.py --only A_fig_02 A_fig_20 --size 480

Draws the figures of the course notes (A), the lectures (B), the thesis (C) and the paper (D), with
captions: one PNG each, a contact sheet, a page `index.html`, and the star field as a GIF. Expected:
pictures as the sources describe them, in less than ten minutes on two cores, most of which is
compilation. Where a text copy of a source lacks a figure's data (rules of L-systems, scenes,
photographs as textures), classical ones of the same kind stand in; the captions say which. The
sources' own scene file is drawn by `python -m diffrast render`.
"""

import argparse
import html
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gallery_drawings
import gallery_scenes
import gallery_textures
import numpy as np
from common import progress_bar
from PIL import Image, ImageDraw

import diffrast as dr

PER_ROW = 6
LABEL = 16  # pixels of a name on the contact sheet


class Picture(NamedTuple):
    """A figure of the sources."""

    name: str
    caption: str
    draw: Callable[[int], Any]  # of the size in pixels; an image, or the images of an animation


def pictures() -> list[Picture]:
    """All figures, in the order of the sources."""
    found = [*gallery_drawings.FIGURES, *gallery_scenes.FIGURES, *gallery_textures.FIGURES]
    return sorted((Picture(*figure) for figure in found), key=lambda picture: picture.name)


def run(
    out: Path, *, size: int = 240, only: list[str] | None = None, progress: bool = False
) -> dict[str, float]:
    """Draw the pictures and the pages that show them.

    Args:
        out: folder of the result.
        size: of the larger side of each picture, in pixels.
        only: names to draw; None draws all.
        progress: show a progress bar.

    Returns:
        Seconds that each picture took.
    """
    chosen = [p for p in pictures() if only is None or p.name in only]
    unknown = {*(only or [])} - {p.name for p in chosen}
    if unknown or not chosen:
        names = ", ".join(p.name for p in pictures())
        raise ValueError(f"only: wanted names among {names}, got {sorted(unknown)}")
    out.mkdir(parents=True, exist_ok=True)
    seconds, files = {}, {}
    for picture in _with_progress(chosen, progress):
        begin = time.perf_counter()
        drawn = picture.draw(size)
        if isinstance(drawn, list):
            files[picture.name] = f"{picture.name}.gif"
            dr.save_animation(out / files[picture.name], drawn, frames_per_second=20)
        else:
            files[picture.name] = f"{picture.name}.png"
            dr.save_image(out / files[picture.name], drawn)
        seconds[picture.name] = time.perf_counter() - begin
    _contact_sheet(out, files, size)
    _page(out, chosen, files)
    return seconds


def _with_progress(chosen: list[Picture], progress: bool) -> Iterator[Picture]:
    if not progress:
        yield from chosen
        return
    with progress_bar(chosen) as bar:
        for picture in bar:
            bar.set_description(picture.name)
            yield picture


def _contact_sheet(out: Path, files: dict[str, str], size: int) -> None:
    rows = math.ceil(len(files) / PER_ROW)
    columns = min(PER_ROW, len(files))
    sheet = Image.new("RGB", (columns * size, rows * (size + LABEL)), "white")
    pen = ImageDraw.Draw(sheet)
    for index, (name, file) in enumerate(files.items()):
        x, y = index % PER_ROW * size, index // PER_ROW * (size + LABEL)
        with Image.open(out / file) as picture:
            small = picture.convert("RGB")
            small.thumbnail((size - 4, size - 4))
            sheet.paste(small, (x + (size - small.width) // 2, y + (size - small.height) // 2))
        pen.text((x + 4, y + size), name, fill="black")
    sheet.save(out / "contact_sheet.png")


def _page(out: Path, chosen: list[Picture], files: dict[str, str]) -> None:
    figures = [
        f'<figure><img src="{files[p.name]}" alt="{p.name}">'
        f"<figcaption><b>{p.name}</b>: {html.escape(p.caption)}</figcaption></figure>"
        for p in chosen
    ]
    style = (
        "body{font-family:sans-serif;background:#fff}figure{display:inline-block;width:260px;"
        "vertical-align:top;margin:8px}img{max-width:260px}figcaption{font-size:12px}"
    )
    page = [
        '<!doctype html><meta charset="utf-8"><title>Figures of the sources</title>',
        f"<style>{style}</style><h1>Figures of the sources</h1>",
        *figures,
    ]
    (out / "index.html").write_text("\n".join(page) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("results") / "gallery")
    parser.add_argument("--size", type=int, default=240, help="pixels of a picture's larger side")
    parser.add_argument("--only", nargs="+", help="names of the pictures to draw")
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    options = parser.parse_args()
    seconds = run(options.out, size=options.size, only=options.only, progress=not options.quiet)
    slowest = max(seconds, key=lambda name: seconds[name])
    print(
        f"{len(seconds)} pictures in {np.sum(list(seconds.values())):.0f} s, the slowest {slowest}"
        f" in {seconds[slowest]:.0f} s: {options.out / 'index.html'}"
    )


if __name__ == "__main__":
    main()
