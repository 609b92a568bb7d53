"""What the programs hold: nothing for what a scene lacks, nothing for what is not differentiated.

That specular terms, positions, texture coordinates, edges and shadows leave no trace where they are
absent is counted next to each of them (`test_render.py`, `test_textured_scenes.py`,
`test_edges.py`, `test_shadow.py`); here it is what the parts of a scene have in common.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from scenes import settings
from test_render import SHINY, VERTICES, ball, operations, times

import diffrast as dr

SUN = dr.DirectionalLight(direction=(0.3, -1.0, -1.0), ambient=(0.1, 0.1, 0.1))
TEXTURE = dr.Texture(np.random.default_rng(0).uniform(size=(8, 8, 3)))
CAMERA = scenes.perspective()


def scene(material=None, light=SUN):
    return dr.Scene(
        objects=[ball(dr.Material(**(SHINY if material is None else material)))], lights=[light]
    )


def loops(given, options):
    return times(operations(dr.render, given, CAMERA, options), "while")


def gradient(given, part, options):
    """The derivative of a loss by one part of the scene, as a program and its argument.

    Everything else is an argument too: no constants, which the compiler could fold.
    """

    def loss(value, given, camera):
        item = given.objects[0]
        if part == "camera":
            camera = value
        elif part in ("lights", "background"):
            given = dataclasses.replace(given, **{part: value})
        else:
            if part == "texels":
                material = dataclasses.replace(item.material, texture=value)
                item = dataclasses.replace(item, material=material)
            elif part == "vertices":
                item = dataclasses.replace(
                    item, mesh=dataclasses.replace(item.mesh, vertices=value)
                )
            else:
                item = dataclasses.replace(item, **{part: value})
            given = dataclasses.replace(given, objects=[item])
        return jnp.sum(dr.render(given, camera, options) ** 2)

    item = given.objects[0]
    value = {
        "camera": CAMERA,
        "lights": given.lights,
        "background": given.background,
        "material": item.material,
        "texels": item.material.texture,
        "transform": item.transform,
        "vertices": item.mesh.vertices,
    }[part]
    return jax.jit(jax.grad(loss)), (value, given, CAMERA)


def to_vertices(given, part, options):
    """How many columns of the vertices' values a derivative adds up, from the pixels' values."""
    program, arguments = gradient(given, part, options)
    return operations(program, *arguments)["scatter", f"{VERTICES}xf32"]


# Absent features ----------------------------------------------------------------------------------


def test_each_feature_has_its_loops_and_its_absence_none():
    plain = loops(scene(), settings())
    assert loops(scene(material={}), settings()) == plain
    assert loops(scene(), settings(shading="unlit")) == plain
    shadowed = scene(light=dataclasses.replace(SUN, shadow=dr.Shadow(resolution=16)))
    assert loops(shadowed, settings()) > plain  # the light's own picture
    assert loops(shadowed, settings(shading="unlit")) == plain
    assert loops(scene(), settings(antialias=True)) > plain  # edges are searched
    assert loops(scene(material={"texture": TEXTURE}), settings()) == plain


def test_a_light_without_an_ambient_part_adds_no_operation_for_it():
    dark = dataclasses.replace(SUN, ambient=None)
    with_it, without = (
        operations(dr.render, scene({}, light), CAMERA, settings()) for light in (SUN, dark)
    )
    assert times(without, "multiply") < times(with_it, "multiply")
    assert times(without, "add") < times(with_it, "add")


def test_a_camera_without_distortion_bends_nothing_back():
    cube = dr.CubeTexture(np.ones((6, 4, 4, 3)))
    bent = dataclasses.replace(CAMERA, distortion=jnp.zeros(5))
    for objects in ([], scene({}).objects):
        plain, sky = (dr.Scene(objects=objects, background=b) for b in (np.ones(3), cube))
        without, sky_without = (loops(given, settings()) for given in (plain, sky))
        program = [operations(dr.render, given, bent, settings()) for given in (plain, sky)]
        assert sky_without == without == times(program[0], "while")
        assert times(program[1], "while") > without


# Derivatives --------------------------------------------------------------------------------------


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("part", ["lights", "background", "material", "texels"])
def test_what_does_not_move_has_no_part_for_the_geometry(part, antialias):
    material = {"texture": TEXTURE} if part == "texels" else SHINY
    assert to_vertices(scene(material), part, settings(antialias=antialias)) == 0


@pytest.mark.parametrize("part", [None, "transform", "vertices"])
def test_further_objects_add_few_operations(part):
    """What all have in common is made at once; an object of its own adds its numbers to tables."""

    def counted(number):
        given = dataclasses.replace(scene(), objects=scene().objects * number)
        if part is None:
            return sum(operations(dr.render, given, CAMERA, settings()).values())
        program, arguments = gradient(given, part, settings())
        return sum(operations(program, *arguments).values())

    several, more = counted(40), counted(60)
    assert (more - several) / 20 < 30
    assert several < 1.3 * counted(2)


# A camera's motion and that of few objects are summed over the picture; that of vertices has the
# three corners' x, y and z, for positions and for normals.
@pytest.mark.parametrize(
    ("part", "material", "columns"),
    [
        ("camera", {}, 0),
        ("camera", SHINY, 0),
        ("transform", {}, 0),
        ("transform", SHINY, 0),
        ("vertices", SHINY, 9),  # the mesh has normals of its own
    ],
)
def test_a_motion_adds_up_only_what_it_moves(part, material, columns):
    assert to_vertices(scene(material), part, settings()) == columns


@pytest.mark.parametrize("part", ["lights", "camera", "transform"])
def test_a_derivative_draws_the_scene_once(part):
    program, arguments = gradient(scene(), part, settings())
    assert times(operations(program, *arguments), "while") == loops(scene(), settings())


# Other values -------------------------------------------------------------------------------------


def test_a_derivative_is_not_traced_again_for_other_values():
    traced = []
    start = dataclasses.replace(scene({"texture": TEXTURE}), background=(0.1, 0.2, 0.3))

    @jax.jit
    @jax.grad
    def program(camera, given):
        traced.append(camera)
        return jnp.sum(dr.render(given, camera, settings(shading="unlit")))

    program(CAMERA, start)
    other = jax.tree.map(lambda x: x * 1.01 if jnp.issubdtype(x.dtype, jnp.floating) else x, start)
    for given in (start, other, dataclasses.replace(start, background=np.zeros(3))):
        for camera in (CAMERA, scenes.perspective(eye=(0.0, 1.0, 5.0)), scenes.parallel()):
            assert np.isfinite(program(camera, given).view).all()
    assert len(traced) == 1


def test_temporary_memory_is_not_mapped_anew_at_each_call():
    """More than 32 MB are given back after each call, and the next one maps every page again."""
    options = dr.RenderSettings(height=512, width=512)
    shadowed = scene(light=dataclasses.replace(SUN, shadow=dr.Shadow(resolution=512)))
    fine = dr.Object(dr.shapes.icosphere(6), dr.Material(**SHINY))
    floor = dr.Object(dr.shapes.plane(6, 6), transform=dr.linalg.translation((0, 0, -1.0)))
    over_floor = dr.Scene(objects=[*shadowed.objects, floor], lights=shadowed.lights)
    for program, arguments in (
        gradient(scene(), "camera", options),
        gradient(dr.Scene(objects=[fine], lights=[SUN]), "camera", options),
        (jax.jit(dr.render), (shadowed, CAMERA, options)),
        gradient(over_floor, "lights", options),
    ):
        quickly = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
        memory = program.lower(*arguments).compile(compiler_options=quickly).memory_analysis()
        assert 1 << 20 < memory.temp_size_in_bytes < 32 << 20


@pytest.mark.parametrize("part", ["camera", "transform", "vertices", "lights", "texels"])
def test_products_of_matrices_are_in_full_precision_on_every_device(part):
    """GPUs and TPUs round the factors to three digits, or fewer, unless they are told not to."""
    given = scene(
        {**SHINY, "texture": TEXTURE}, dataclasses.replace(SUN, shadow=dr.Shadow(resolution=16))
    )
    program, arguments = gradient(given, part, settings(antialias=True))
    with jax.default_matmul_precision("default"):  # whatever else the process has asked for
        lines = program.lower(*arguments).as_text().splitlines()
    products = [line for line in lines if "stablehlo.dot_general" in line]
    assert products
    assert all("precision = [HIGHEST, HIGHEST]" in line for line in products)
