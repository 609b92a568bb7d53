"""What a file refers to by name: only what lies in its own folder, or below, is ever opened."""

from pathlib import Path

from diffrast._tokens import decoded


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

    A path from another machine falls back to the file of its name in the folder. Material files
    (.mtl) come as UTF-8, as mesh files do.
    """

    def __init__(self, path: Path) -> None:
        self.file_name = path.name
        self._folder = path.parent

    def get(self, name: str) -> bytes:
        """Content of a file.

        Raises:
            FileNotFoundError: for one that is not there, or lies elsewhere.
        """
        name = name.strip()
        for candidate in (name, name.lstrip("/"), Path(name).name):
            path = inside(self._folder, candidate)
            if path is not None and path.is_file():
                content = path.read_bytes()
                return decoded(content).encode() if path.suffix.lower() == ".mtl" else content
        raise FileNotFoundError(f"{name!r} is not in {self._folder}")

    __getitem__ = get
