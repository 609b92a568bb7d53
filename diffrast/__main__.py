"""The command line: `python -m diffrast --help`."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import jax

from diffrast import _commands
from diffrast.files.scenes import OPERATIONS
from diffrast.settings import SHADINGS

_FILE = (
    "OBJ, PLY, STL, OFF, glTF, GLB, a scene, object or patch file of the thesis (.dat, .bez), or"
    " the name of a shape: " + ", ".join(_commands.SHAPES)
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; 0 if it succeeded, 2 with a message for a wrong file or option."""
    options = parser().parse_args(arguments)
    try:
        print(options.run(options))
    except (ValueError, OSError, ImportError) as error:
        print(f"diffrast {options.command}: {error}", file=sys.stderr)
        return 2
    return 0


def parser() -> argparse.ArgumentParser:
    """The options of all commands."""
    whole = argparse.ArgumentParser(
        prog="python -m diffrast",
        description="Draw and fit meshes.",
        epilog="Compiled programs are kept for the next command in ~/.cache/diffrast, or in the"
        " folder that JAX_COMPILATION_CACHE_DIR names; nowhere if it is empty.",
    )
    commands = whole.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(
        name: str, run: object, help_: str, *parents: argparse.ArgumentParser
    ) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=help_, description=help_, parents=list(parents))
        added.set_defaults(run=run, default_of=added.get_default)
        return added

    view, light, size, jagged = _view_options(), _light_option(), _size_option(), _jagged_option()
    look, quiet = _look_options(), _quiet_options()
    drawn = (view, light, size, jagged, look)
    added = command("render", _commands.render_command, "draw a mesh or a scene", *drawn)
    added.add_argument("file", metavar="FILE", help=_FILE)
    added.add_argument("--out", type=Path, default=Path("render.png"))
    added.add_argument(
        "--operation", choices=OPERATIONS, help="of a scene file; its own by default"
    )

    added = command("orbit", _commands.orbit_command, "turn round a mesh (GIF)", *drawn, quiet)
    added.add_argument("file", metavar="FILE", help=_FILE)
    added.add_argument("--out", type=Path, default=Path("orbit.gif"))
    added.add_argument("--frames", type=_count, default=36)
    added.add_argument("--fps", type=_rate, default=20.0, help="pictures a second, at most 100")

    lines = (view, size, jagged)
    added = command("wireframe", _commands.wireframe_command, "draw the edges of a mesh", *lines)
    added.add_argument("file", metavar="FILE", help=_FILE)
    added.add_argument("--out", type=Path, default=Path("wireframe.png"))
    added.add_argument("--hidden", action="store_true", help="draw what is behind faces, too")
    added.add_argument("--all-edges", action="store_true", help="also between faces in one plane")
    added.add_argument("--normals", type=float, metavar="LENGTH", help="draw vertex normals, too")
    added.add_argument("--line-width", type=float, default=1.0, help="in pixels")

    fitted = (view, light, jagged, quiet)
    added = command("fit", _commands.fit_command, "find camera and light of a picture", *fitted)
    added.add_argument("image", metavar="IMAGE", help="the picture")
    added.add_argument("file", metavar="FILE", help=_FILE)
    added.add_argument("--out", type=Path, default=Path("fit"), help="folder of the result")
    added.add_argument("--resolution", type=_count, default=96, help="of the fit, in pixels")

    shown = (view, light, size, quiet)
    added = command("gallery", _commands.gallery_command, "draw the library's shapes", *shown)
    added.add_argument("--out", type=Path, default=Path("gallery"), help="folder of the pictures")
    added.set_defaults(shading="phong")
    return whole


def keep_programs() -> None:
    """Compiled programs are kept from one command to the next: most of its time is compiling.

    Of another machine, another version or another size of mesh or picture they are others.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:  # JAX knows of it
        return
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    folder = os.path.join(caches, "diffrast")
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError:  # of a user who may not write there
        return
    jax.config.update("jax_compilation_cache_dir", folder)


# Each command has those of these options that its result depends on.


def _view_options() -> argparse.ArgumentParser:
    options, group = _view_group()
    _vector(group, "--eye", None, "where the camera is; by default so that all is seen")
    _vector(group, "--target", None, "what it looks at; by default the middle")
    _vector(group, "--up", (0.0, 0.0, 1.0), "what is up in the picture (default: z)")
    _vector(group, "--color", (0.7, 0.55, 0.35), "of the mesh, linear RGB")
    _vector(group, "--background", (0.0, 0.0, 0.0), "linear RGB")
    group.add_argument("--fov", type=_angle, default=40.0, help="vertical, in degrees")
    return options


def _light_option() -> argparse.ArgumentParser:
    options, group = _view_group()
    _vector(group, "--light", (-0.5, 0.7, -0.8), "the way the light travels")
    return options


def _size_option() -> argparse.ArgumentParser:
    options, group = _view_group()
    group.add_argument("--size", type=_count, help="rows and columns (default: 512)")
    return options


def _jagged_option() -> argparse.ArgumentParser:
    options, group = _view_group()
    group.add_argument("--no-antialias", action="store_true", help="jagged, and sooner done")
    return options


def _view_group() -> tuple[argparse.ArgumentParser, argparse._ArgumentGroup]:
    options = argparse.ArgumentParser(add_help=False)
    return options, options.add_argument_group("view")


def _vector(
    group: argparse._ArgumentGroup,
    name: str,
    default: tuple[float, float, float] | None,
    help_: str,
) -> None:
    group.add_argument(
        name, nargs=3, type=float, metavar=("X", "Y", "Z"), default=default, help=help_
    )


def _look_options() -> argparse.ArgumentParser:
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument("--shading", choices=SHADINGS, default="phong")
    options.add_argument("--samples", type=_count, default=1, help="a pixel, a square number")
    return options


def _quiet_options() -> argparse.ArgumentParser:
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument("--quiet", action="store_true", help="show no progress")
    return options


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"wanted an integer of at least 1, got {text}")
    return value


def _rate(text: str) -> float:
    value = float(text)
    if not 0 < value <= 100:
        raise argparse.ArgumentTypeError(f"wanted a number above 0 and at most 100, got {text}")
    return value


def _angle(text: str) -> float:
    value = float(text)
    if not 0 < value < 180:
        raise argparse.ArgumentTypeError(f"wanted degrees between 0 and 180, got {text}")
    return value


if __name__ == "__main__":
    keep_programs()
    sys.exit(main())
