"""L-systems: strings, and the turtle against one that walks symbol by symbol."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import check_derivatives

import diffrast as dr

RIGHT = np.pi / 2


def koch():
    return dr.LSystem(initiator="F", rules={"F": "F+F--F+F"}, angle=np.radians(85))


def dragon():
    return dr.LSystem(initiator="F", rules={"F": "F+G", "G": "F-G"}, angle=RIGHT)


def hilbert():
    rule = "^\\XF^\\XFX-F^//XFX&F+//XFX-F/X-/"
    return dr.LSystem(initiator="X", rules={"X": rule}, angle=RIGHT, dimensions=3)


def plant(dimensions=2):
    if dimensions == 2:
        rules = {"X": "F+[[X]-X]-F[-FX]+X", "F": "FF"}
        return dr.LSystem(
            initiator="X", rules=rules, angle=np.radians(25), start_angle=RIGHT, draw="F"
        )
    rules = {
        "F": "F[-&\\G][\\++&G]F[---&/G][+&G]",
        "G": "F[+G][-G]F[+G][-G]FG",
    }
    return dr.LSystem(initiator="^^^^F", rules=rules, angle=np.pi / 8, dimensions=3)


def walked(system, text):
    """The source's turtle, one symbol after another with a stack, in float64."""
    d = float(system.angle)
    turn = np.array([[np.cos(d), -np.sin(d)], [np.sin(d), np.cos(d)]])
    pairs = {"+": (0, 1, 1), "-": (0, 1, -1), "^": (0, 2, 1), "&": (0, 2, -1)}
    pairs |= {"\\": (1, 2, -1), "/": (1, 2, 1)}
    a = float(system.start_angle)
    frame = np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1]])
    position, stack, lines = np.zeros(3), [], []
    for symbol in text:
        if symbol == "[":
            stack.append((position, frame))
        elif symbol == "]":
            position, frame = stack.pop()
        elif symbol == "|":
            frame = frame * np.array([[-1], [-1], [1]])
        elif symbol in pairs:
            i, j, sense = pairs[symbol]
            frame = frame.copy()
            frame[[i, j]] = (turn if sense < 0 else turn.T) @ frame[[i, j]]
        else:
            if symbol in system.drawn:
                lines.append((position, position + frame[0]))
            position = position + frame[0]
    return np.array(lines)[..., : system.dimensions]


def ends(drawing):
    return np.asarray(drawing.points)[np.asarray(drawing.lines)]


def replaced(system, rounds):
    rules = {symbol: options[0][1] for symbol, options in system.rules}
    text = system.initiator
    for _ in range(rounds):
        text = "".join(rules.get(symbol, symbol) for symbol in text)
    return text


@pytest.mark.parametrize(
    ("make", "rounds"),
    [(koch, 4), (dragon, 7), (plant, 4), (hilbert, 2), (lambda: plant(3), 2)],
)
def test_the_turtle_walks_as_the_sources_does(make, rounds):
    system = make()
    text = replaced(system, rounds)
    assert system.expand(rounds) == text
    drawing = system.draw(rounds)
    np.testing.assert_allclose(ends(drawing), walked(system, text), atol=2e-4)
    assert drawing.points.shape[0] == 1 + sum(symbol in system.alphabet for symbol in text)
    letters = [symbol for symbol in text if symbol in system.drawn]
    assert [system.alphabet[i] for i in drawing.symbols] == letters


def test_counts_and_shapes_of_the_sources_curves():
    long = koch().draw(10)
    assert long.lines.shape == (4**10, 2)
    side = 2 * (1 + np.cos(np.radians(85)))
    np.testing.assert_allclose(long.points[-1], [side**10, 0], atol=1e-3 * side**10)
    curve = dragon().draw(18)
    assert curve.lines.shape == (2**18, 2)
    points = np.asarray(curve.points)
    # On the grid after 2^18 steps, but for the digits that float32 has of a right angle.
    np.testing.assert_allclose(points, np.round(points), atol=1e-3)
    # No edge of the grid is passed twice.
    middles = np.unique(np.round(ends(curve)).sum(axis=1), axis=0)
    assert len(middles) == 2**18
    square = dr.LSystem(initiator="F+F+F+F", rules={"F": "F"}, angle=RIGHT).draw(3)
    np.testing.assert_allclose(square.points, [[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]], atol=1e-6)
    cells = np.asarray(hilbert().draw(1).points)
    np.testing.assert_allclose(cells, np.round(cells), atol=1e-6)


def test_space_holds_the_plane():
    rules = {"F": "F+F-|[-F]F"}
    flat = dr.LSystem(initiator="F-F", rules=rules, angle=0.7, start_angle=0.3).draw(3)
    deep = dr.LSystem(initiator="F-F", rules=rules, angle=0.7, start_angle=0.3, dimensions=3)
    drawing = deep.draw(3)
    np.testing.assert_allclose(drawing.points[:, :2], flat.points, atol=1e-5)
    np.testing.assert_allclose(drawing.points[:, 2], 0, atol=1e-6)
    np.testing.assert_array_equal(drawing.depths, flat.depths)
    assert drawing.depths.max() == 3


def test_chance_follows_its_key_and_its_probabilities():
    rules = {"F": [(0.25, "F+F"), (0.75, "FF")]}
    system = dr.LSystem(initiator="F" * 4000, rules=rules, angle=0.3)
    once = system.expand(1, key=jax.random.key(1))
    assert once == system.expand(1, key=jax.random.key(1))
    assert once != system.expand(1, key=jax.random.key(2))
    assert abs(once.count("+") / 4000 - 0.25) < 0.03
    assert len(system.expand(2, key=jax.random.key(1))) > 16000
    for key in (None, jnp.zeros(2), jax.random.split(jax.random.key(0))):
        with pytest.raises(ValueError, match="key: wanted a random key"):
            system.draw(1, key=key)
    with pytest.raises(ValueError, match="key: wanted a random key of JAX that is known"):
        jax.jit(lambda key: system.draw(1, key=key).points)(jax.random.key(0))


@pytest.mark.parametrize(("make", "rounds"), [(plant, 2), (lambda: plant(3), 1)])
def test_drawings_are_differentiable_in_angles_and_step(make, rounds):
    with jax.enable_x64(True):
        system = make()
        flat, tree = jax.tree.flatten(system)

        def points(angle, start_angle, step):
            moved = jax.tree.unflatten(tree, [angle, start_angle])
            return moved.draw(rounds, step=step).points

        numbers = [jnp.asarray(leaf, jnp.float64) for leaf in (*flat, 1.3)]
        known = jax.tree.unflatten(tree, numbers[:2]).draw(rounds, step=1.3).points
        np.testing.assert_allclose(jax.jit(points)(*numbers), known, atol=1e-12)
        check_derivatives(points, *numbers)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"initiator": "F?"}, "initiator: wanted symbols among"),
        ({"rules": {"F": "F[F"}}, r"rules\['F'\]: wanted brackets that match"),
        ({"rules": {"+": "F"}}, "rules: wanted symbols of the alphabet"),
        ({"rules": {"F": [(0.5, "F")]}}, r"rules\['F'\]: wanted probabilities that add up"),
        ({"rules": {"F": [(1, "F"), (np.nan, "F")]}}, r"that add up to 1, got \[1.0, nan\]"),
        ({"rules": {"FG": "F"}}, "rules: wanted single symbols"),
        ({"draw": "G"}, "draw: wanted symbols of the alphabet 'F'"),
        ({"dimensions": 4}, "dimensions: wanted 2 or 3"),
    ],
)
def test_systems_refuse(options, message):
    given = {"initiator": "F", "rules": {"F": "FF"}, "angle": 0.5, "alphabet": "F"}
    with pytest.raises(ValueError, match=message):
        dr.LSystem(**given | options)


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize(("initiator", "rules"), [("", {}), ("FF", {"F": ""})])
def test_nothing_is_drawn_of_an_empty_string(initiator, rules, dimensions):
    def drawing(angle):
        system = dr.LSystem(initiator=initiator, rules=rules, angle=angle, dimensions=dimensions)
        return system.draw(1)

    drawn = drawing(0.3)
    np.testing.assert_array_equal(drawn.points, np.zeros((1, dimensions)))  # the start
    assert drawn.lines.shape == (0, 2)
    assert drawn.symbols.shape == drawn.depths.shape == (0,)
    assert jax.grad(lambda angle: jnp.sum(drawing(angle).points ** 2))(0.3) == 0


def test_strings_that_are_too_long_are_refused():
    with pytest.raises(ValueError, match="iterations: wanted at most 268435456 symbols"):
        dr.LSystem(initiator="F", rules={"F": "F" * 32768}, angle=0.5).expand(3)


@pytest.mark.usefixtures("unchecked")
def test_systems_may_be_changed_by_replace():
    rules = {"F": [(0.5, "FG"), (0.5, "F+F")], "G": "GG"}
    system = dr.LSystem(initiator="F", rules=rules, angle=0.5, alphabet="FG", draw="F")
    same = dataclasses.replace(system)
    assert jax.tree.structure(same) == jax.tree.structure(system)
    turned = dataclasses.replace(system, angle=0.7, drawn="G")
    assert (float(turned.angle), turned.drawn, turned.rules) == (np.float32(0.7), "G", system.rules)
    with pytest.raises(ValueError, match="drawn: wanted None beside draw, got 'F'"):
        dataclasses.replace(system, draw="G")
    with pytest.raises(ValueError, match="drawn: wanted symbols of the alphabet 'FG'"):
        dataclasses.replace(system, drawn="X")
    with pytest.raises(ValueError, match="rules: wanted a dictionary of strings, got"):
        dataclasses.replace(system, rules=(1, 2))
