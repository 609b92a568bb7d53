"""What a file refers to by name: only what lies in its own folder, or below, is ever opened."""

from os.path import isfile
from pathlib import Path, PureWindowsPath
from urllib.parse import unquote

from jaxtyping import Float32
from numpy import ndarray

from diffrast.files.images import decoded_picture


def inside(folder: Path, name: str) -> Path | None:
    """The file that a name means in a folder; None if that lies elsewhere, links followed."""
    root = folder.resolve()
    try:
        path = (root / name).resolve()
    except (OSError, RuntimeError, ValueError):  # a link to itself, a null character
        return None
    return path if path.is_relative_to(root) else None


class Neighbors:
    """The files next to a mesh file, as trimesh asks for them.

    A path from another machine, with slashes of either kind, falls back to the file of its name in
    the folder. A blank may be written as %20, as URIs have it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file_name = path.name
        self._pictures: dict[str, Float32[ndarray, "height width channels"] | None] = {}

    def find(self, name: str) -> bytes | None:
        """Content of a file; None for one that is not there, or lies elsewhere."""
        name = name.strip()
        for written in (name, unquote(name)):
            slashes = written.replace("\\", "/")
            for candidate in (written, slashes, slashes.lstrip("/"), PureWindowsPath(written).name):
                path = inside(self.path.parent, candidate)
                if path is not None and isfile(path):
                    return path.read_bytes()
        return None

    def get(self, name: str) -> bytes:
        """Content of a file.

        Raises:
            FileNotFoundError: for one that is not there, or lies elsewhere.
        """
        content = self.find(name)
        if content is None:
            raise FileNotFoundError(f"{name!r} is not in {self.path.parent}")
        return content

    __getitem__ = get

    def picture(self, name: str) -> Float32[ndarray, "height width channels"] | None:
        """A picture as linear RGB or RGBA, decoded once; None for one that is not there.

        Raises:
            ValueError: with the picture's name, for a file that cannot be read as one.
        """
        if name not in self._pictures:
            content = self.find(name)
            self._pictures[name] = None if content is None else decoded_picture(content, name)
        return self._pictures[name]
