"""Lindenmayer systems in the plane and in space (FEATURES L4, L5; Van Houdt 3, 4, 9).

A string of symbols is rewritten some times over, every symbol at once, and then read by a turtle
that walks and draws. Strings are made on the host, as arrays: the length of what replaces each
symbol gives where it goes. The turtle is an array program too. A symbol turns it, and all turns up
to a symbol are a prefix: a sum of whole numbers of angles in the plane, a product of rotations in
space. Steps in those directions add up to positions, by prefix sums.

What stands in brackets is a branch: the turtle comes back to where the bracket opened. So strings
are read by depth of brackets, all branches of one depth at a time, each beginning with the state at
its bracket.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from diffrast import _check
from diffrast._check import ArrayInput
from diffrast._pytree import pytree_dataclass, set_field, static

_MOST_SYMBOLS = 1 << 28
_OPEN, _CLOSE = ord("["), ord("]")
# Axis and sense of each symbol's rotation of the turtle's heading, left and up.
_TURNS = {"+": (2, 1), "-": (2, -1), "^": (1, -1), "&": (1, 1), "\\": (0, -1), "/": (0, 1)}
_SPECIAL = {2: "+-|[]", 3: "+-|[]^&\\/"}

Rule = str | Sequence[tuple[float, str]]
Rules = tuple[tuple[str, tuple[tuple[float, str], ...]], ...]


class LineDrawing(NamedTuple):
    """What a turtle has drawn, in the order of the string.

    Attributes:
        points: where it has been, the start first.
        lines: numbers of the points that each line joins.
        symbols: for each line the place of its symbol in the alphabet.
        depths: for each line the number of brackets open round it.
    """

    points: Float[Array, "points dimensions"]
    lines: Int[Array, "lines 2"]
    symbols: Int[np.ndarray, " lines"]
    depths: Int[np.ndarray, " lines"]


class Branches(NamedTuple):
    """The symbols at one depth of brackets, and the branches that they form."""

    symbols: Int[np.ndarray, " n"]  # places in the string, ascending
    branch: Int[np.ndarray, " n"]  # number of each one's branch, ascending
    first: Int[np.ndarray, " branches"]  # where each branch begins in `symbols`
    opened: Int[np.ndarray, " branches"]  # place of its bracket, -1 for the trunk


@pytree_dataclass
class LSystem:
    r"""A Lindenmayer system: how strings grow, and what they look like.

    Symbols of the alphabet move the turtle by one step, and draw where they are in `draw`. The
    others turn it: + left and - right by `angle`, | round; [ begins a branch and ] ends it. In
    space (`dimensions=3`) also ^ up, & down, \ rolls left and / rolls right. The turtle looks along
    x, with left along y and up along z::

        koch = dr.LSystem(initiator="F", rules={"F": "F+F--F+F"}, angle=np.radians(85))
        drawing = koch.draw(6)

    Attributes:
        angle: of a turn, in radians; traced and differentiable.
        start_angle: of the first direction from x towards y; likewise.
        initiator: the string to begin with.
        rules: what replaces each symbol: for each one that has a rule, pairs of a probability and
            a string. Symbols without a rule stay as they are.
        alphabet: the symbols that move.
        drawn: those of them that draw.
        dimensions: 2 or 3.

    Raises:
        ValueError: for symbols that are not in the alphabet, brackets that do not match, and
            probabilities that do not add up to one.
    """

    angle: Float[Array, ""]
    start_angle: Float[Array, ""]
    initiator: str = static()
    rules: Rules = static()
    alphabet: str = static()
    drawn: str = static()
    dimensions: int = static()

    def __init__(
        self,
        *,
        initiator: str,
        rules: Mapping[str, Rule] | Rules,
        angle: ArrayInput,
        start_angle: ArrayInput = 0.0,
        alphabet: str | None = None,
        draw: str | None = None,
        drawn: str | None = None,
        dimensions: int = 2,
    ) -> None:
        """Make a system.

        Args:
            initiator: the string to begin with.
            rules: for each symbol that changes its replacement, or a list of (probability,
                replacement) of which each occurrence gets one by chance; or another system's.
            angle: of a turn, in radians.
            start_angle: of the first direction, in radians.
            alphabet: the symbols that move; None: all that occur and do not turn.
            draw: those that draw; None: all of the alphabet.
            drawn: the same by the attribute's name, as `dataclasses.replace` gives it.
            dimensions: 2 or 3.
        """
        shown = "draw" if drawn is None else "drawn"
        if drawn is not None and draw is not None:
            raise ValueError(f"drawn: wanted None beside draw, got {drawn!r:.40}")
        draw = draw if drawn is None else drawn
        if isinstance(rules, tuple):
            rules = _as_given(rules)
        if _check.positive_int("dimensions", dimensions) not in _SPECIAL:
            raise ValueError(f"dimensions: wanted 2 or 3, got {dimensions}")
        for name, text in (("initiator", initiator), ("alphabet", alphabet), (shown, draw)):
            if not (isinstance(text, str) or (text is None and name != "initiator")):
                raise ValueError(f"{name}: wanted a string, got {type(text).__name__}")
        if not isinstance(rules, Mapping) or not all(isinstance(key, str) for key in rules):
            raise ValueError(f"rules: wanted a dictionary of strings, got {rules!r:.40}")
        special = _SPECIAL[dimensions]
        choices = tuple((symbol, _choices(symbol, rule)) for symbol, rule in sorted(rules.items()))
        strings = [initiator, *(s for _, options in choices for _, s in options)]
        if alphabet is None:
            occurring = {*"".join(strings), *rules} - set(special)
            alphabet = "".join(sorted(occurring))
        allowed = {*alphabet, *special}
        for name, text in (("alphabet", alphabet), (shown, draw or ""), ("rules", "".join(rules))):
            wrong = [s for s in text if s not in alphabet or s in special or ord(s) > 255]
            if wrong:
                raise ValueError(
                    f"{name}: wanted symbols of the alphabet {alphabet!r}, which may not hold any"
                    f" of {special!r}, got {wrong[0]!r}"
                )
        for name, text in zip(
            ["initiator", *(f"rules[{s!r}]" for s, options in choices for _ in options)],
            strings,
            strict=True,
        ):
            wrong = [s for s in text if s not in allowed]
            if wrong:
                raise ValueError(
                    f"{name}: wanted symbols among {''.join(sorted(allowed))!r}, got {wrong[0]!r}"
                )
            depth = np.cumsum([(s == "[") - (s == "]") for s in text] or [0])
            if depth.min() < 0 or depth[-1] != 0:
                raise ValueError(f"{name}: wanted brackets that match, got {text!r}")
        set_field(self, "angle", _check.float_array("angle", angle, ()))
        set_field(self, "start_angle", _check.float_array("start_angle", start_angle, ()))
        set_field(self, "initiator", initiator)
        set_field(self, "rules", choices)
        set_field(self, "alphabet", alphabet)
        set_field(self, "drawn", alphabet if draw is None else draw)
        set_field(self, "dimensions", dimensions)

    def expand(self, iterations: int, *, key: Array | None = None) -> str:
        """The string after so many replacements of all its symbols.

        Args:
            iterations: how often.
            key: a random key of JAX; wanted if a symbol has several rules, and only then. The same
                key gives the same string.

        Raises:
            ValueError: for a missing key, and a string of more than 2^28 symbols.
        """
        return self._codes(iterations, key).tobytes().decode("latin-1")

    def draw(
        self, iterations: int, *, step: ArrayInput = 1.0, key: Array | None = None
    ) -> LineDrawing:
        """What the turtle draws after so many replacements, from the origin.

        Differentiable in the system's angles and in the step: the string does not depend on them.
        Known numbers are computed in float64.

        Args:
            iterations: how often all symbols are replaced.
            step: how far a symbol moves the turtle.
            key: as for `expand`.

        Example:
            >>> koch = dr.LSystem(initiator="F", rules={"F": "F+F--F+F"}, angle=np.pi / 3)
            >>> koch.draw(2).lines.shape
            (16, 2)
        """
        codes = self._codes(iterations, key)
        step = _check.float_array("step", step, ())
        numbers: tuple[Any, ...] = (self.angle, self.start_angle, step)
        dtype = jnp.result_type(*numbers)
        xp: Any = jnp
        if all(map(_check.is_concrete, numbers)):
            xp, numbers = np, tuple(np.asarray(number, np.float64) for number in numbers)
        levels = _levels(codes)
        turtle = _directions_2d if self.dimensions == 2 else _directions_3d
        directions = turtle(codes, levels, numbers[0], numbers[1], xp)
        moves = _is_among(codes, self.alphabet)
        steps = xp.where(moves[:, None], directions * numbers[2], 0)
        positions = _path_sums(steps, levels, xp)
        start = xp.zeros((1, self.dimensions), steps.dtype)
        points = jnp.asarray(xp.concatenate([start, positions[moves]]), dtype)
        number = np.where(moves, np.cumsum(moves), 0)
        draws = _is_among(codes, self.drawn) & moves
        lines = np.stack([_last_before(number, levels), number], axis=1)[draws]
        kind = np.zeros(256, np.int32)
        kind[np.frombuffer(self.alphabet.encode("latin-1"), np.uint8)] = np.arange(
            len(self.alphabet)
        )
        depths = np.cumsum((codes == _OPEN).astype(np.int32) - (codes == _CLOSE))
        return LineDrawing(
            points,
            jnp.asarray(lines.astype(np.int32)),
            kind[codes[draws]],
            depths[draws].astype(np.int32),
        )

    def _codes(self, iterations: int, key: Array | None) -> np.ndarray:
        iterations = _check.positive_int("iterations", iterations, minimum=0, maximum=1 << 16)
        chance = any(len(options) > 1 for _, options in self.rules)
        key = _known_key(key) if chance else None
        codes = np.frombuffer(self.initiator.encode("latin-1"), np.uint8)
        for round_ in range(iterations):
            uniform = np.zeros(len(codes))
            if key is not None:
                with _check.staying_known(key):
                    own = jax.random.fold_in(key, round_)
                    uniform = np.asarray(jax.random.uniform(own, (len(codes),)))
            codes = _rewritten(codes, self.rules, uniform)
        return codes


def _known_key(key: Any) -> Array:
    if not _check.is_concrete(key):
        raise ValueError("key: wanted a random key of JAX that is known, got a traced one")
    try:
        with _check.staying_known(key):
            jax.random.fold_in(key, 0)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"key: wanted a random key of JAX for rules with several choices, got {key!r:.40}"
        ) from error
    return key


def _choices(symbol: str, rule: Rule) -> tuple[tuple[float, str], ...]:
    if len(symbol) != 1:
        raise ValueError(f"rules: wanted single symbols as keys, got {symbol!r}")
    if isinstance(rule, str):
        return ((1.0, rule),)
    try:
        options = tuple((float(chance), text) for chance, text in rule)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"rules[{symbol!r}]: wanted a string or pairs of a probability and one, got"
            f" {rule!r:.40}"
        ) from error
    _check.all_instances(f"rules[{symbol!r}]", [text for _, text in options], str)
    total = sum(chance for chance, _ in options)
    if not (options and min(chance for chance, _ in options) >= 0 and abs(total - 1) <= 1e-6):
        raise ValueError(
            f"rules[{symbol!r}]: wanted probabilities that add up to 1, got"
            f" {[chance for chance, _ in options]}"
        )
    return options


def _as_given(rules: tuple[Any, ...]) -> Mapping[str, Rule]:
    """Rules as a dictionary, of those that a system keeps."""
    try:
        return dict(rules)
    except (TypeError, ValueError) as error:
        raise ValueError(f"rules: wanted a dictionary of strings, got {rules!r:.40}") from error


def _is_among(codes: np.ndarray, symbols: str) -> np.ndarray:
    table = np.zeros(256, bool)
    table[np.frombuffer(symbols.encode("latin-1"), np.uint8)] = True
    return table[codes]


def _rewritten(codes: np.ndarray, rules: Any, uniform: np.ndarray) -> np.ndarray:
    """Replace every symbol, choosing among its rules by a number from 0 to 1."""
    texts = [bytes([code]) for code in range(256)]  # what stays as it is
    chosen = codes.astype(np.int64)
    for symbol, options in rules:
        first = len(texts)
        texts += [text.encode("latin-1") for _, text in options]
        bounds = np.cumsum([chance for chance, _ in options])[:-1]
        here = codes == ord(symbol)
        chosen[here] = first + np.searchsorted(bounds, uniform[here], side="right")
    lengths = np.array([len(text) for text in texts])
    begins = np.cumsum(lengths) - lengths
    size = lengths[chosen]
    ends = np.cumsum(size)
    total = int(ends[-1]) if len(ends) else 0
    if total > _MOST_SYMBOLS:
        raise ValueError(f"iterations: wanted at most {_MOST_SYMBOLS} symbols, got {total}")
    source = np.repeat(begins[chosen] - (ends - size), size) + np.arange(total)
    return np.frombuffer(b"".join(texts), np.uint8)[source]


# Branches -----------------------------------------------------------------------------------------


def _levels(codes: np.ndarray) -> list[Branches]:
    """The symbols by depth of brackets, the trunk first; closing brackets belong nowhere.

    An opening bracket stands on the branch that it leaves. An empty string has no trunk.
    """
    opens = codes == _OPEN
    depth = np.cumsum(opens.astype(np.int32) - (codes == _CLOSE)) - opens
    inside = codes != _CLOSE
    places = np.arange(len(codes))
    levels = []
    for level in range(int(depth[inside].max(initial=-1)) + 1):
        symbols = np.flatnonzero(inside & (depth == level))
        opened = np.full(len(codes), -1)
        if level:
            begins = opens & (depth == level - 1)
            opened = np.maximum.accumulate(np.where(begins, places, -1))
        own = opened[symbols]
        starts = np.diff(own, prepend=-2) != 0
        first = np.flatnonzero(starts)
        levels.append(Branches(symbols, np.cumsum(starts) - 1, first, own[first]))
    return levels


def _path_sums(values: Any, levels: list[Branches], xp: Any) -> Any:
    """Sums of (symbols, n) along the way from the trunk's first symbol to each, it included."""
    sums = xp.zeros_like(values)
    for level in levels:
        own = values[level.symbols]
        along = xp.cumsum(own, axis=0)
        before = along[level.first] - own[level.first]
        if level.opened[0] >= 0:
            before = before - sums[level.opened]
        sums = _put(sums, level.symbols, along - before[level.branch], xp)
    return sums


def _last_before(number: np.ndarray, levels: list[Branches]) -> np.ndarray:
    """The largest number on the way to each symbol, without its own; numbers ascend."""
    reached = np.zeros(len(number), np.int64)
    before = np.zeros(len(number), np.int64)
    for level in levels:
        own = number[level.symbols].astype(np.int64)
        start = np.where(level.opened >= 0, reached[level.opened], 0)
        own[level.first] = np.maximum(own[level.first], start)
        # Branches one above another, so that none sees the ones before it.
        lift = level.branch * (number.max(initial=0) + 1)
        along = np.maximum.accumulate(own + lift) - lift
        reached[level.symbols] = along
        previous = np.roll(along, 1)
        previous[level.first] = start
        before[level.symbols] = previous
    return before


def _put(values: Any, at: np.ndarray, new: Any, xp: Any) -> Any:
    if xp is np:
        values[at] = new
        return values
    return values.at[at].set(new)


# The turtle's directions --------------------------------------------------------------------------


def _directions_2d(
    codes: np.ndarray, levels: list[Branches], angle: Any, start_angle: Any, xp: Any
) -> Any:
    """Direction of each symbol. Turns are counted in whole numbers: nothing accumulates."""
    turns = np.zeros((256, 2))
    turns[[ord("+"), ord("-"), ord("|")]] = [[1, 0], [-1, 0], [0, 1]]
    counts = _path_sums(turns[codes], levels, np)
    heading = start_angle + angle * counts[:, 0] + np.pi * (counts[:, 1] % 2)
    return xp.stack([xp.cos(heading), xp.sin(heading)], axis=1)


def _directions_3d(
    codes: np.ndarray, levels: list[Branches], angle: Any, start_angle: Any, xp: Any
) -> Any:
    """Direction of each symbol, from prefix products of rotations as quaternions."""
    axis, half_turns = np.zeros((256, 3)), np.zeros(256)
    for symbol, (k, sense) in _TURNS.items():
        axis[ord(symbol), k] = 1
        half_turns[ord(symbol)] = sense / 2
    back = codes == ord("|")
    half = angle * half_turns[codes]
    own = xp.concatenate([xp.cos(half)[:, None], xp.sin(half)[:, None] * axis[codes]], axis=1)
    own = xp.where(back[:, None], np.array([0.0, 0, 0, 1]).astype(own.dtype), own)
    zero = xp.zeros_like(start_angle)
    start = xp.stack([xp.cos(start_angle / 2), zero, zero, xp.sin(start_angle / 2)])
    frames = xp.zeros_like(own)
    for level in levels:
        turns = own[level.symbols]
        before = start[None] if level.opened[0] < 0 else frames[level.opened]
        turns = _put(turns, level.first, _product(before, turns[level.first], xp), xp)
        begins = np.zeros(len(level.symbols), bool)
        begins[level.first] = True
        frames = _put(frames, level.symbols, _prefix_products(turns, begins, xp)[0], xp)
    w, x, y, z = (frames[:, i] for i in range(4))
    heading = [w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)]
    size = w * w + x * x + y * y + z * z  # one but for rounding; zero for closing brackets
    return xp.stack(heading, axis=1) / xp.where(size > 0, size, 1)[:, None]


def _prefix_products(turns: Any, begins: np.ndarray, xp: Any) -> tuple[Any, np.ndarray]:
    """Products of rotations up to each, from the last beginning on (a segmented scan)."""
    count = len(begins)
    if count == 1:
        return turns, begins
    even = count // 2 * 2
    pairs, pair_begins = _joined(
        turns[0:even:2], begins[0:even:2], turns[1:even:2], begins[1:even:2], xp
    )
    odd, odd_begins = _prefix_products(pairs, pair_begins, xp)
    inner = (count - 1) // 2
    later, later_begins = _joined(odd[:inner], odd_begins[:inner], turns[2::2], begins[2::2], xp)
    result = xp.zeros_like(turns)
    result = _put(result, np.arange(1, count, 2), odd, xp)
    result = _put(result, np.arange(2, count, 2), later, xp)
    result = _put(result, np.arange(1), turns[:1], xp)
    all_begins = np.zeros(count, bool)
    all_begins[0], all_begins[1::2], all_begins[2::2] = begins[0], odd_begins, later_begins
    return result, all_begins


def _joined(
    first: Any, first_begins: np.ndarray, second: Any, second_begins: np.ndarray, xp: Any
) -> tuple[Any, np.ndarray]:
    product = xp.where(second_begins[:, None], second, _product(first, second, xp))
    return product, first_begins | second_begins


def _product(a: Any, b: Any, xp: Any) -> Any:
    """Quaternion products; b turns first."""
    (a0, a1, a2, a3), (b0, b1, b2, b3) = ([q[:, i] for i in range(4)] for q in (a, b))
    return xp.stack(
        [
            a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
            a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
            a0 * b2 - a1 * b3 + a2 * b0 + a3 * b1,
            a0 * b3 + a1 * b2 - a2 * b1 + a3 * b0,
        ],
        axis=1,
    )
