"""Words of a text file, each with its line, for errors that say where."""

import codecs
import math
import re
from pathlib import Path

_WHOLE = re.compile(r"[+-]?[0-9]{1,18}")
_COMMENT = re.compile(r"\{[^{}]*(\}|\Z)")


def decoded(content: bytes) -> str:
    """Text in UTF-8, a byte order mark or not; else in any encoding that has ASCII's numbers."""
    content = content.removeprefix(codecs.BOM_UTF8)
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def read_text(path: Path) -> str:
    """Text of a file, as `decoded`, each line ending in a line feed."""
    return re.sub(r"\r\n?", "\n", decoded(path.read_bytes()))


def whole(word: str) -> int | None:
    """An integer as files write it; Python itself would also read 1_000 and ١."""
    return int(word) if _WHOLE.fullmatch(word) else None


def is_finite(word: str) -> bool:
    """Whether a word is a finite number as files write it."""
    try:
        return math.isfinite(float(word)) and word.isascii() and "_" not in word
    except ValueError:
        return False


def without_comments(text: str) -> str:
    """Text with blanks instead of {...}; every line stays where it is."""
    return _COMMENT.sub(lambda comment: re.sub(r"[^\n]", " ", comment[0]), text)


class Tokens:
    """Reads white-space separated words one after another; {...} is a comment.

    Every method raises `ValueError` "name:line: wanted ..., got ..." when the next word will not
    do.
    """

    def __init__(self, text: str, name: str) -> None:
        lines = without_comments(text).split("\n")
        self._name = name
        self._words = [
            (word, line) for line, content in enumerate(lines, start=1) for word in content.split()
        ]
        self._last_line = len(lines) - (lines[-1] == "")
        self._next = 0

    def word(self, wanted: str) -> str:
        """The next word, whatever it is."""
        if self._next == len(self._words):
            raise ValueError(
                f"{self._name}:{self._last_line}: wanted {wanted}, got the end of the file"
            )
        self._next += 1
        return self._words[self._next - 1][0]

    def number(self, wanted: str) -> float:
        """The next word as a finite number."""
        word = self.word(wanted)
        if not is_finite(word):
            raise self.error(wanted)
        return float(word)

    def integer(self, wanted: str, minimum: int, bound: int | None = None) -> int:
        """The next word as an integer of at least `minimum` and below `bound`."""
        value = whole(self.word(wanted))
        if value is None:
            raise self.error(wanted)
        if value < minimum or (bound is not None and value >= bound):
            limits = f"of at least {minimum}" if bound is None else f"in [{minimum}, {bound})"
            raise self.error(f"{wanted}, an integer {limits}")
        return value

    def end(self) -> None:
        """Nothing may follow."""
        if self._next < len(self._words):
            self._next += 1
            raise self.error("the end of the file")

    def error(self, wanted: str) -> ValueError:
        """The error that the word just read is not what was wanted."""
        word, line = self._words[self._next - 1]
        return ValueError(f"{self._name}:{line}: wanted {wanted}, got {word!r}")
