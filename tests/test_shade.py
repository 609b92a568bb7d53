"""Lights, materials, the Phong model: closed forms, the oracle, derivatives, degenerate input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from derivatives import check_derivatives

from diffrast.light import (
    AmbientLight,
    Attenuation,
    DirectionalLight,
    PointLight,
    SpotLight,
    incoming,
    normalize_columns,
    total_ambient,
)
from diffrast.material import Material
from diffrast.shade import Reflectance, Surface, needs, phong

pytestmark = pytest.mark.usefixtures("compiled_quickly")

AMBIENT = {"color": (0.2, 0.1, 0.3)}
DIRECTIONAL = {
    "direction": (0.4, -1.3, -2.0),
    "ambient": (0.05, 0.1, 0.0),
    "diffuse": (0.7, 0.8, 0.9),
    "specular": (0.3, 0.5, 0.2),
}
POINT = {"position": (0.5, 3.0, 2.0), "diffuse": (0.9, 0.4, 0.1), "specular": (1.0, 0.2, 0.6)}

SPOT = {
    "position": (0.5, 1.0, 2.0),
    "direction": (-0.3, -1.0, -2.0),
    "cutoff": 0.9,
    "diffuse": (0.2, 0.9, 0.5),
    "specular": (0.7, 0.4, 0.1),
}


def three_lights(**point):
    return AmbientLight(**AMBIENT), DirectionalLight(**DIRECTIONAL), PointLight(**POINT, **point)


def columns(vectors):
    return [jnp.asarray(vectors)[..., i] for i in range(3)]


def reflectance_of(material):
    specular = None if material.specular is None else columns(material.specular)
    return Reflectance(
        columns(material.ambient),
        columns(material.diffuse),
        specular,
        material.shininess,
        material.highlight == "blinn",
    )


@jax.jit
def shaded(normal, position, to_viewer, material, lights):
    """Colours (N, 3) of points of one material, all vectors (N, 3)."""
    surface = Surface(columns(normal), columns(position), columns(to_viewer))
    return jnp.stack(phong(surface, reflectance_of(material), lights), axis=-1)


def shade_one(*, normal=(0, 0, 1), to_viewer=(0, 0, 1), position=(0, 0, 0), material, lights):
    vectors = [jnp.array([vector], float) for vector in (normal, position, to_viewer)]
    return np.asarray(shaded(*vectors, material, lights))[0]


def random_points(count, seed=0):
    """Normals of any length, positions, unit directions to the viewer."""
    rng = np.random.default_rng(seed)
    normal, position, to_viewer = rng.normal(size=(3, count, 3))
    return normal, position, reference.normalize(to_viewer)


def towards(angle):
    """A unit vector that far from the z axis."""
    return np.array([np.sin(angle), 0, np.cos(angle)])


# --------------------------------------------------------------------------------------- lights


def test_defaults():
    light = DirectionalLight(direction=(0, 0, -2), diffuse=(0.1, 0.2, 0.3))
    np.testing.assert_array_equal(light.specular, light.diffuse)
    assert light.ambient is None
    point = PointLight(position=(1, 2, 3))
    np.testing.assert_array_equal([point.diffuse, point.specular], 1)
    assert point.attenuation is None
    material = Material(diffuse=(0.1, 0.2, 0.3))
    np.testing.assert_array_equal(material.ambient, material.diffuse)
    assert material.specular is None


@pytest.mark.parametrize("length", [1e-30, 1e-20, 1.0, 1e20, 1e30])
def test_directional_light_comes_from_where_it_starts(length):
    direction = np.array([3.0, 0.0, -4.0])
    to_light, factor = incoming(DirectionalLight(direction=length * direction), None)
    np.testing.assert_allclose(to_light, -direction / 5, rtol=1e-6)
    assert factor is None


def test_point_light_and_its_attenuation():
    _, position, _ = random_points(20)
    offset = np.asarray(POINT["position"]) - position
    distance = np.linalg.norm(offset, axis=1)
    to_light, factor = incoming(PointLight(**POINT), columns(position))
    np.testing.assert_allclose(np.stack(to_light, 1), reference.normalize(offset), atol=1e-6)
    assert factor is None
    a, b, c = 0.5, 0.25, 2.0
    _, factor = incoming(PointLight(**POINT, attenuation=(a, b, c)), columns(position))
    np.testing.assert_allclose(factor, 1 / (a + b * distance + c * distance**2), rtol=1e-5)


def test_attenuation_dims_all_but_the_ambient_part():
    material = Material(diffuse=(0.5, 0.6, 0.7), specular=(1, 1, 1))
    point = {**POINT, "position": (0, 0, 2), "ambient": (0.1, 0.2, 0.3)}
    full = shade_one(material=material, lights=(PointLight(**point),))
    dimmed = shade_one(material=material, lights=(PointLight(**point, attenuation=(0, 0, 1)),))
    ambient = np.array([0.5, 0.6, 0.7]) * [0.1, 0.2, 0.3]
    np.testing.assert_allclose(dimmed - ambient, (full - ambient) / 4, rtol=1e-5)


@pytest.mark.parametrize("cutoff", [1e-4, 0.3, 1.5])
def test_a_spot_fades_towards_its_cutoff(cutoff):
    """1 - (1 - cos a) / (1 - cos cutoff), to the precision of float32 in narrow cones as well."""
    angles = cutoff * np.array([0, 0.1, 0.5, 0.99, 1.01, 1.9])
    rays = np.stack([np.sin(angles), np.zeros(6), -np.cos(angles)], axis=1)
    light = SpotLight(position=(0, 0, 0), direction=(0, 0, -3), cutoff=cutoff)
    _, factor = incoming(light, columns(2 * rays))
    want = np.maximum(1 - (np.sin(angles / 2) / np.sin(cutoff / 2)) ** 2, 0)
    np.testing.assert_allclose(factor, want, atol=1e-6)
    _, dimmed = incoming(
        dataclasses.replace(light, attenuation=jnp.array([0.0, 0, 1])), columns(2 * rays)
    )
    np.testing.assert_allclose(dimmed, want / 4, atol=1e-6)


def test_attenuation_by_the_legs_of_the_way():
    """Linear 1 / (r + k) and inverse square (FEATURES S3), over one leg or both."""
    _, position, _ = random_points(20)
    leg = np.linalg.norm(np.asarray(POINT["position"]) - position, axis=1)
    other = np.linspace(1, 5, 20)
    for legs, r in (("light", leg), ("viewer", other), ("both", leg + other)):
        for coefficients, want in (((0.7, 1, 0), 1 / (r + 0.7)), ((0, 0, 1), 1 / r**2)):
            attenuation = Attenuation(coefficients, legs=legs)
            _, factor = incoming(
                PointLight(**POINT, attenuation=attenuation), columns(position), jnp.asarray(other)
            )
            np.testing.assert_allclose(factor, want, rtol=1e-5)
    sun = DirectionalLight(direction=(0, 0, -1), attenuation=Attenuation((1, 1, 0), legs="viewer"))
    np.testing.assert_allclose(
        incoming(sun, None, jnp.asarray(other))[1], 1 / (1 + other), rtol=1e-6
    )
    assert needs((sun,), specular=False) == (True, False)


def test_total_ambient_is_the_sum_over_all_lights():
    dark = DirectionalLight(direction=(0, 0, 1))
    assert total_ambient(()) is None
    assert total_ambient((dark, PointLight(**POINT))) is None
    np.testing.assert_allclose(total_ambient((*three_lights(), dark)), [0.25, 0.2, 0.3])


@pytest.mark.parametrize("scale", [1e-30, 1e-20, 1.0, 1e20, 1e30])
def test_normalize_columns_has_no_scale(scale):
    vector = np.array([0.3, -0.5, 0.7], np.float32)
    length = np.linalg.norm(vector)
    jacobian = (np.eye(3) - np.outer(vector, vector) / length**2) / length

    def unit_and_length(v):
        unit, length = normalize_columns(columns(v))
        return jnp.stack([*unit, length])

    scaled = jnp.asarray(scale * vector)
    got, slope = jax.jit(lambda v: (unit_and_length(v), jax.jacfwd(unit_and_length)(v)))(scaled)
    np.testing.assert_allclose(got[:3], vector / length, rtol=1e-6)
    np.testing.assert_allclose(got[3] / scale, length, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(slope[:3], float) * scale, jacobian, atol=1e-6)
    np.testing.assert_allclose(slope[3], vector / length, rtol=1e-6)


# -------------------------------------------------------------------------------- the Phong model


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 3, 1.5])
def test_lambert_and_the_highlight_in_closed_form(angle):
    light = DirectionalLight(direction=-towards(angle), diffuse=(1, 0.5, 0), specular=(0, 0.25, 1))
    material = Material(diffuse=(0.8, 0.6, 0.4), specular=(0.5, 0.5, 0.5), shininess=5.0)
    away = 0.4  # the viewer's angle from the mirror image of the light
    got = shade_one(to_viewer=towards(-angle + away), material=material, lights=(light,))
    lambert, highlight = np.cos(angle), np.cos(away) ** 5
    want = lambert * np.array([0.8, 0.3, 0]) + highlight * np.array([0, 0.125, 0.5])
    np.testing.assert_allclose(got, want, rtol=1e-5)


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.5])
def test_blinns_highlight_in_closed_form(angle):
    light = DirectionalLight(direction=-towards(angle), diffuse=(0, 0, 0), specular=(1, 0.5, 0))
    material = Material(specular=(0.5, 0.5, 0.5), shininess=5.0, highlight="blinn")
    half = (angle - 0.7) / 2  # between light and viewer
    got = shade_one(to_viewer=towards(-0.7), material=material, lights=(light,))
    want = max(np.cos(half), 0) ** 5 * np.array([0.5, 0.25, 0])
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("cutoff", [1e-3, 0.5, np.pi / 2])
def test_a_spot_by_incidence(cutoff):
    """1 - (1 - cos a) / (1 - cos cutoff) instead of cos a; highlights where that is not zero."""
    material = Material(diffuse=(1, 1, 1), specular=(1, 1, 1), shininess=0.0)
    for share in (0.0, 0.4, 0.9, 1.1):
        angle = share * cutoff
        light = PointLight(
            position=3 * towards(angle), diffuse=(1, 0, 0), specular=(0, 1, 0),
            incidence_cutoff=cutoff,
        )  # fmt: skip
        got = shade_one(to_viewer=towards(-angle), material=material, lights=(light,))
        want = 1 - (np.sin(angle / 2) / np.sin(cutoff / 2)) ** 2
        np.testing.assert_allclose(got, [max(want, 0), share < 1, 0], atol=2e-4)


def test_a_surface_that_faces_away_gets_its_ambient_part_only():
    light = DirectionalLight(direction=(0, 0.1, 1), ambient=(0.1, 0.2, 0.3))
    material = Material(ambient=(1, 0.5, 0.25), specular=(1, 1, 1), shininess=0.0)
    got = shade_one(material=material, lights=(light, AmbientLight((1, 1, 1))))
    np.testing.assert_allclose(got, [1.1, 0.6, 0.325], rtol=1e-6)


@pytest.mark.parametrize("specular", [None, (0.9, 0.7, 0.5)])
def test_colors_equal_the_oracle(specular):
    material = Material(
        diffuse=(0.3, 0.5, 0.9), ambient=(0.4, 0.1, 0.2), specular=specular, shininess=7.0
    )
    normal, position, to_viewer = random_points(200)
    lights = (*three_lights(), SpotLight(**SPOT))
    got = shaded(normal, position, to_viewer, material, lights)
    want = reference.shade(
        position,
        reference.normalize(normal),
        to_viewer,
        [
            {"type": "ambient", "ambient": AMBIENT["color"]},
            {"type": "directional", **DIRECTIONAL},
            {"type": "point", **POINT},
            {"type": "spot", **SPOT},
        ],
        {
            "ambient": (0.4, 0.1, 0.2),
            "diffuse": (0.3, 0.5, 0.9),
            "specular": (0.0, 0.0, 0.0) if specular is None else specular,
            "shininess": 7.0,
        },
    )
    np.testing.assert_allclose(got, want, atol=2e-6)


def test_what_shading_needs():
    ambient, directional, point = three_lights()
    cases = {
        (): (False, False),
        (ambient,): (False, False),
        (ambient, directional): (False, False),
        (directional, point): (True, False),
    }
    for lights, dull in cases.items():
        shines = any(light is not ambient for light in lights)
        assert needs(lights, specular=False) == dull
        assert needs(lights, specular=True) == (shines, shines)


@pytest.mark.parametrize("length", [2.0**-66, 2.0**66])
def test_color_does_not_depend_on_the_unit_of_length(length):
    material = Material(specular=(1, 1, 1))
    normal, position, to_viewer = random_points(50)
    point = PointLight(**POINT)
    far = dataclasses.replace(point, position=length * point.position)
    want = shaded(normal, position, to_viewer, material, (point,))
    got = shaded(length * normal, length * position, to_viewer, material, (far,))
    np.testing.assert_array_equal(got, want)


# ------------------------------------------------------------------------------------ derivatives


def test_derivatives_in_everything():
    normal, position, to_viewer = random_points(30)
    with jax.enable_x64(True):
        material = Material(
            diffuse=(0.3, 0.5, 0.9), ambient=(0.4, 0.1, 0.2), specular=(1, 0.7, 0.5), shininess=7.0
        )
        lights = (*three_lights(attenuation=(0.5, 0.25, 0.125)), SpotLight(**SPOT))
        blinn = dataclasses.replace(material, highlight="blinn")
        narrow = (PointLight(**POINT, incidence_cutoff=1.4), DirectionalLight(**DIRECTIONAL))

        def both(normal, position, to_viewer, materials, lights):
            points = normal, position, to_viewer
            return [shaded(*points, *pair) for pair in zip(materials, lights, strict=True)]

        arguments = (material, blinn), (lights, narrow)
        check_derivatives(both, normal, position, to_viewer, *arguments)


HEAD_ON = {"normal": (0, 0, 1), "to_viewer": (0, 0, 1), "light": (0, 0, -1)}
DEGENERATE = {
    "nothing unusual": {
        "normal": (0.2, 0.1, 1),
        "position": (0, 0, 0),
        "to_viewer": towards(0.3),
        "light": (0.1, 0.2, -1),
        "spot": POINT["position"],
        "cutoff": 1.2,
    },
    "light at the point": {"position": POINT["position"]},
    "no normal": {"normal": (0, 0, 0)},
    "no viewer": {"to_viewer": (0, 0, 0)},
    "viewer at a right angle to the reflection": {**HEAD_ON, "to_viewer": (1, 0, 0)},
    "light along the surface": {**HEAD_ON, "light": (-1, 0, 0)},
    "viewer exactly in the mirror direction": HEAD_ON,
    "no direction of light": {"light": (0, 0, 0)},
    "on the axis of a spot": {"position": (0, 0, 0), "light": tuple(-x for x in POINT["position"])},
    "no cone": {"cutoff": 0.0},
    "everything at once": {
        "normal": (0, 0, 0),
        "to_viewer": (0, 0, 0),
        "position": POINT["position"],
        "light": (0, 0, 0),
    },
}


@pytest.fixture(scope="module")
def jacobians():
    """First derivatives of the colour in everything, both modes, and second ones."""

    def color(parameters):
        lights = (
            DirectionalLight(direction=parameters["light"], specular=(1, 1, 1)),
            PointLight(**POINT, attenuation=parameters["attenuation"]),
            SpotLight(
                position=parameters["spot"],
                direction=parameters["light"],
                cutoff=parameters["cutoff"],
                attenuation=parameters["attenuation"],
            ),
            PointLight(position=parameters["spot"], incidence_cutoff=parameters["cutoff"]),
        )
        material = Material(specular=(1, 1, 1), shininess=parameters["shininess"])
        vectors = [parameters[name][None] for name in ("normal", "position", "to_viewer")]
        blinn = dataclasses.replace(material, highlight="blinn")
        return shaded(*vectors, material, lights)[0] + shaded(*vectors, blinn, lights)[0]

    def derivatives(parameters):
        ones = jax.tree.map(jnp.ones_like, parameters)
        reverse, second = jax.jvp(jax.jacrev(color), (parameters,), (ones,))
        forward = jax.jacfwd(color)(parameters)
        return {"forward": forward, "reverse": reverse, "second": second}

    return jax.jit(derivatives)


@pytest.mark.parametrize("attenuation", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("shininess", [0.0, 1.0, 32.0, 1e30])
@pytest.mark.parametrize("case", DEGENERATE)
def test_finite_with_finite_derivatives(jacobians, case, shininess, attenuation):
    vectors = {**DEGENERATE["nothing unusual"], **DEGENERATE[case]}
    parameters = {**vectors, "shininess": shininess, "attenuation": attenuation}
    results = jacobians({name: jnp.array(value, float) for name, value in parameters.items()})
    for path, leaf in jax.tree.leaves_with_path(results):
        assert np.isfinite(leaf).all(), (jax.tree_util.keystr(path), leaf)
    for name, leaf in results["forward"].items():
        np.testing.assert_allclose(leaf, results["reverse"][name], rtol=1e-5, atol=1e-5)


def test_degenerate_vectors_leave_the_ambient_part():
    ambient = AmbientLight((0.5, 0.25, 0.125))
    material = Material(diffuse=(1, 1, 1), specular=(1, 1, 1))
    at_light = PointLight(position=(1, 2, 3), attenuation=(0, 0, 1))
    no_way = DirectionalLight(direction=(0, 0, 0))
    bright = DirectionalLight(direction=(0, 0, -1))
    for options in (
        {"lights": (ambient, at_light), "position": (1, 2, 3)},
        {"lights": (ambient, no_way)},
        {"lights": (ambient, bright), "normal": (0, 0, 0)},
    ):
        np.testing.assert_array_equal(shade_one(material=material, **options), [0.5, 0.25, 0.125])


@pytest.mark.parametrize("shininess", [1e6, 1e9, 1e30])
def test_no_highlight_is_brighter_than_its_light(shininess):
    # Rounding makes r.v a little more than one.
    unit = np.float32(reference.normalize(np.vstack([random_points(500)[0], np.eye(3)])))
    material = Material(diffuse=(0, 0, 0), specular=(1, 1, 1), shininess=shininess)
    highlight = shaded(unit, -unit, unit, material, (PointLight(position=(0, 0, 0)),))
    assert np.all((highlight >= 0) & (highlight <= 1))
    np.testing.assert_array_equal(highlight[-3:], 1)


def test_precision_is_that_of_the_input():
    normal, position, to_viewer = random_points(3)
    material = Material(specular=(1, 1, 1))
    lights = three_lights(attenuation=(1, 1, 1))
    single = [np.float32(vector) for vector in (normal, position, to_viewer)]
    assert shaded(*single, material, lights).dtype == jnp.float32
    with jax.enable_x64(True):
        material, lights = Material(specular=(1, 1, 1)), three_lights(attenuation=(1, 1, 1))
        assert shaded(normal, position, to_viewer, material, lights).dtype == jnp.float64


# -------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: AmbientLight((1, 1)), r"color: wanted shape \(3,\), got \(2,\)"),
        (lambda: AmbientLight((1, np.nan, 1)), "color: wanted finite numbers, got nan at index"),
        (lambda: DirectionalLight(direction=(0, 0)), r"direction: wanted shape \(3,\)"),
        (lambda: DirectionalLight(direction=(0, 0, np.inf)), "direction: wanted finite numbers"),
        (lambda: DirectionalLight(direction=(0, 0, 1), ambient=0.5), r"ambient: wanted shape \(3,"),
        (lambda: PointLight(position=(np.nan, 0, 0)), "position: wanted finite numbers"),
        (lambda: PointLight(position=(0, 0, 0), diffuse=(1, 2, np.nan)), "diffuse: wanted finite"),
        (lambda: PointLight(position=(0, 0, 0), specular=(1, 2)), r"specular: wanted shape \(3,\)"),
        (lambda: PointLight(position=(0, 0, 0), attenuation=(1, 2)), r"attenuation: wanted shape"),
        (
            lambda: SpotLight(**{**SPOT, "cutoff": 1.6}),
            "cutoff: wanted a number between 0 and 1.5708, got 1.6",
        ),
        (lambda: SpotLight(**{**SPOT, "cutoff": 0.0}), "cutoff: wanted a number between 0"),
        (lambda: SpotLight(**{**SPOT, "direction": (0, 1)}), r"direction: wanted shape \(3,\)"),
        (
            lambda: PointLight(position=(0, 0, 0), incidence_cutoff=1.6),
            "incidence_cutoff: wanted a number between 0 and 1.5708, got 1.6",
        ),
        (lambda: Attenuation((1, 2)), r"coefficients: wanted shape \(3,\), got \(2,\)"),
        (lambda: Attenuation((1, 0, 0), legs="three"), "legs: wanted one of light, both, viewer"),
        (
            lambda: DirectionalLight(direction=(0, 0, 1), attenuation=Attenuation((1, 0, 0))),
            "attenuation: wanted an Attenuation of legs \"viewer\", got 'light'",
        ),
        (lambda: Material(highlight="cone"), "highlight: wanted one of phong, blinn, got 'cone'"),
        (lambda: Material(diffuse=(1, 2)), r"diffuse: wanted shape \(3,\), got \(2,\)"),
        (lambda: Material(ambient=(1, np.nan, 2)), "ambient: wanted finite numbers, got nan"),
        (lambda: Material(specular=1.0), r"specular: wanted shape \(3,\), got \(\)"),
        (lambda: Material(shininess=(1.0, 2.0)), r"shininess: wanted shape \(\), got \(2,\)"),
        (lambda: Material(shininess=np.nan), "shininess: wanted finite numbers, got nan"),
        (lambda: Material(diffuse="red"), "diffuse: wanted an array of numbers, got 'red'"),
    ],
)
def test_errors_name_the_argument(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_colors_that_follow_others_may_be_donated_with_them():
    smaller = jax.jit(lambda tree: jax.tree.map(lambda x: x / 2, tree), donate_argnums=0)
    color = np.array([0.5, 0.25, 1.0], np.float32)
    material = smaller(Material(diffuse=jnp.array(color)))
    lights = [
        DirectionalLight(direction=(0, 0, -1), diffuse=jnp.array(color)),
        PointLight(position=(0, 0, 1), diffuse=jnp.array(color)),
        SpotLight(position=(0, 0, 1), direction=(0, 0, -1), cutoff=1, diffuse=jnp.array(color)),
    ]
    for found in (material.ambient, *(light.specular for light in smaller(lights))):
        np.testing.assert_array_equal(found, color / 2)
