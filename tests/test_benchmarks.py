"""The benchmarks, at tiny size: what they check, measure and write."""

import dataclasses
import inspect
import json
import sys

import benchmark_device
import benchmark_error
import benchmark_features
import benchmark_peers
import benchmark_scaling
import benchmark_stages
import benchmark_views
import error_scenes
import exactness
import numpy as np
import peers
import pytest
import renderer
import timing

import diffrast as dr

SPHERE = "sphere, 5,120 faces"

pytestmark = pytest.mark.usefixtures("compiled_quickly")


def read(folder, name):
    assert (folder / f"{name}.png").is_file()
    assert (folder / f"{name}.md").read_text().startswith("| ")
    return json.loads((folder / f"{name}.json").read_text())


# Peers --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def task():
    return benchmark_peers.tasks(32)[SPHERE]


@pytest.fixture(scope="module")
def own(task):
    return renderer.DiffrastInterior(task)


class Absent(renderer.Peer):
    name = "absent"
    image = None

    def __init__(self, task):
        raise renderer.MissingPeerError("absent needs what is not there")


def test_peers_are_timed_and_compared(tmp_path, monkeypatch, own):
    class Own(renderer.Peer):  # compiled already
        name = "diffrast"
        image, gradient = staticmethod(own.image), staticmethod(own.gradient)

    class Twin(Own):
        name = "twin"

    monkeypatch.setattr(renderer, "DiffrastInterior", lambda task: own)
    report = benchmark_peers.run(
        tmp_path,
        sizes=(32,),
        only=[SPHERE],
        repeats=1,
        exact_size=32,
        samples=16,
        which=(Own, Twin, Absent),
    )
    cell = report["times"][SPHERE]["32"]
    assert set(cell) == {"diffrast", "twin"}
    ratios = report["speed"]["best_peer_over_ours"][f"{SPHERE}, 32"]
    assert ratios["both_ms"] == cell["twin"]["both_ms"] / cell["diffrast"]["both_ms"]
    assert report["speed"]["geometric_mean"] == pytest.approx(ratios)
    errors = report["errors"][SPHERE]["diffrast"]
    assert errors == report["errors"][SPHERE]["twin"]
    assert errors["rmse"] < 0.05
    assert 0 < errors["gradient_error"] < 1  # jagged: the outline's part is missing
    assert report["missing"] == {"absent": "absent needs what is not there"}
    assert read(tmp_path, "benchmark_peers")["missing"] == report["missing"]
    assert "Missing: absent needs" in benchmark_peers.tables(report)


@pytest.mark.parametrize(
    ("kind", "module"),
    [
        (peers.Deodr, "deodr.differentiable_renderer"),
        (peers.Mitsuba, "mitsuba"),
        (peers.Llvmpipe, "moderngl"),
    ],
)
def test_a_peer_that_is_not_installed_says_what_to_install(kind, module, task, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(renderer.MissingPeerError, match=r"install diffrast\[peers\]"):
        kind(task)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # their own
@pytest.mark.parametrize("kind", peers.PEERS)
def test_an_installed_peer_draws_the_same_picture(kind, task, own):
    try:
        peer = kind(task)
    except renderer.MissingPeerError as missing:
        pytest.skip(str(missing))
    expected = own.image() if kind.shading == "phong" else renderer.DiffrastGouraud(task).image()
    benchmark_peers.check_picture(peer, renderer.in_floats(peer.image()), expected)
    if kind is peers.Mitsuba:  # the same derivative as ours without edges
        target = np.roll(expected, 2, axis=1)
        np.testing.assert_allclose(peer.gradient(target), own.gradient(target), rtol=0.02, atol=0.1)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_samples_of_a_peer_are_those_of_a_larger_picture(task):
    try:
        several = renderer.with_samples(peers.Mitsuba, 2)(task)
    except renderer.MissingPeerError as missing:
        pytest.skip(str(missing))
    large = peers.Mitsuba(dataclasses.replace(task, size=2 * task.size)).image()
    blocks = large.reshape(task.size, 2, task.size, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(several.image(), blocks, atol=1e-5)


def test_another_picture_is_not_timed(own):
    image = own.image()
    benchmark_peers.check_picture(own, image, image)
    for other in (np.roll(image, 1, axis=0), image[:, :, ::-1], 0 * image):
        with pytest.raises(AssertionError, match="diffrast, no edges draws another picture"):
            benchmark_peers.check_picture(own, other, image)


def test_pose_steps_move_the_mesh_by_a_pixel(task):
    clip = np.diag([task.focal, task.focal])
    view = np.asarray(task.camera.view, np.float64)
    eye = np.asarray(task.mesh.vertices, np.float64) @ view[:3, :3].T + view[:3, 3]

    def pixels(points):
        return task.size / 2 * (points[:, :2] / -points[:, 2:]) @ clip

    for i, step in enumerate(exactness.pose_steps(task)):
        axis = np.eye(3)[i % 3]
        moved = eye + 1e-4 * step * (np.cross(axis, eye) if i < 3 else axis)
        distance = np.linalg.norm(pixels(moved) - pixels(eye), axis=1)
        np.testing.assert_allclose(np.sqrt((distance**2).mean()), 1e-4, rtol=1e-3)


# Errors -------------------------------------------------------------------------------------------


def test_pictures_of_many_samples_tell_the_truth_and_how_far_it_may_be_off():
    """A slanted edge: what it uncovers as it moves is its length, weighted."""
    size, samples = 16, 64
    grid = (np.arange(8 * size) + 0.5) / 8

    def draw(motion, shift):
        fine = (grid + shift[0])[None, :] + 0.1 * (grid + shift[1])[:, None] > 7.3 + motion[0]
        pixels = fine.reshape(size, 8, size, 8).mean(axis=(1, 3))
        return np.repeat(pixels[..., None], 3, axis=2)

    truth = exactness.exact(draw, size, np.ones(1), samples=samples, pictures=8, fields=2)
    middle = truth.images.mean(axis=0)[5, :, 0]  # the edge at x = 7.3 - 0.1 * 5.5, on average
    np.testing.assert_allclose(middle, np.clip(np.arange(16) + 1 - 6.75, 0, 1), atol=0.02)
    steps = np.linspace(-exactness.STEP, exactness.STEP, 101)
    column = np.floor(7.3 - 0.1 * grid[:, None] + steps).astype(int)
    row = np.arange(8 * size)[:, None] // 8
    along_edge = -truth.fields.sum(axis=3)[:, row, column].mean(axis=(1, 2)) * size
    np.testing.assert_allclose(truth.slopes.mean(axis=0)[:, 0], along_edge, rtol=0.03)
    own = truth.own_errors()
    assert 0 < own["rmse"] < 0.01
    assert own["gradient_error"] < 0.1
    assert truth.errors(truth.images.mean(axis=0), truth.slopes.mean(axis=0)) == {
        "rmse": 0,
        "mean_difference": 0,
        "gradient_error": 0,
        "gradient_cosine": pytest.approx(1),
    }


def test_a_front_is_what_none_of_ours_beats():
    def point(time, error, peer=False):
        return {"forward_ms": time, "rmse": error, "peer": peer}

    points = [point(1, 0.9), point(2, 0.5), point(3, 0.6), point(4, 0.5), point(1, 0.6, True)]
    points.append(point(0.5, 1.0))  # as wrong as nothing at all
    benchmark_error.mark_fronts(points)
    assert [p["picture_front"] for p in points] == [True, True, False, False, True, False]
    assert not any("derivative_front" in p for p in points)


def test_errors_fall_with_samples(tmp_path, monkeypatch):
    every = error_scenes.filter_settings

    def few(*arguments, **options):
        return [found for found in every(*arguments, **options) if found.series == "nearest"]

    monkeypatch.setattr(error_scenes, "filter_settings", few)
    report = benchmark_error.run(
        tmp_path,
        size=24,
        repeats=1,
        families=("filters",),
        sides=(1, 4),
        truths=error_scenes.Truths(16, 2),
    )
    points = report["panels"]["filters"]["points"]
    assert [point["setting"] for point in points] == ["1", "16"]
    one, many = (point["rmse"] for point in points)
    assert many < 0.5 * one
    assert points[1]["picture_front"]
    assert {p["gradient_error"] for p in points} == {1.0}  # "nearest" has no derivative
    assert read(tmp_path, "benchmark_error")["missing"] == {}
    assert benchmark_error.table(report, front=True).count("| filters | nearest |") >= 1


# The others ---------------------------------------------------------------------------------------


def test_stages_have_times_and_bounds(tmp_path, monkeypatch):
    chosen = ("vertices to clip space", "face ids", "with normals and positions")
    every = benchmark_stages.stages

    def few(*arguments):
        found = every(*arguments)
        assert set(chosen) < set(found)
        return {name: found[name] for name in chosen}

    cast = inspect.signature(benchmark_stages.cast)

    def nothing(*arguments):
        cast.bind(*arguments)
        return (), ()

    monkeypatch.setattr(benchmark_stages, "stages", few)
    monkeypatch.setattr(benchmark_stages, "cast", nothing)
    benchmark_stages.run(tmp_path, size=32, repeats=1, only=[SPHERE])
    found = read(tmp_path, "benchmark_stages")["scenes"][SPHERE]
    for stage in found.values():
        assert stage["ratio"] == pytest.approx(stage["ms"] / stage["bound_ms"], rel=1e-4)
        assert stage["bound_ms"] > 0
    assert found["face ids"]["both_ms"] is None
    assert found["with normals and positions"]["both_ms"] > 0


def test_growth_is_fitted(tmp_path):
    counts = {"views": (1, 2), "parameters": (3, 6)}
    report = benchmark_scaling.run(tmp_path, size=16, repeats=1, counts=counts)
    assert read(tmp_path, "benchmark_scaling")["growth"]["views"]["picture"]["counts"] == [1, 2]
    assert set(report["growth"]["parameters"]) == {"derivative"}
    assert "| views | picture | 1 to 2 |" in benchmark_scaling.table(report)


def test_the_exponent_is_that_of_a_power():
    sizes = np.array([1.0, 10, 300, 5000])
    assert timing.exponent(sizes, 3 * sizes**1.5) == pytest.approx(1.5)


def test_jobs_take_turns():
    calls = []
    times = timing.minimum_times({name: lambda n=name: calls.append(n) for name in "ab"}, 2)
    assert "".join(calls) == "ab" + "ab" * 2  # once to compile
    assert all(0 <= t < 100 for t in times.values())


def test_features_are_compared_with_the_plain_scene(tmp_path, monkeypatch):
    every = benchmark_features.variants()
    assert {variant.base for variant in every.values()} <= set(every)
    unlit = {"shading": "unlit"}  # compiles in half the time
    few = {
        "plain": benchmark_features.Variant(settings=unlit),
        "culled": benchmark_features.Variant(settings=unlit | {"cull_backfaces": True}),
    }
    monkeypatch.setattr(benchmark_features, "variants", lambda: few)
    report = benchmark_features.run(tmp_path, size=24, repeats=1)
    found = read(tmp_path, "benchmark_features")["features"]
    assert found["plain"]["forward_added_ms"] == 0
    culled, plain = (report["features"][name]["both_ms"] for name in ("culled", "plain"))
    assert report["features"]["culled"]["both_share"] == pytest.approx(culled / plain)


def test_a_wrong_picture_of_a_feature_is_not_timed():
    variant = benchmark_features.Variant()
    with pytest.raises(AssertionError, match="plain: the picture is wrong"):
        benchmark_features.check("plain", variant, np.zeros((4, 4, 3)))


def test_views_are_timed(tmp_path):
    ball = {"ball": lambda: dr.shapes.icosphere(1)}
    report = benchmark_views.run(
        tmp_path,
        meshes=ball,
        counts={16: (1, 3)},
        gradients={16: (2,)},
        repeats=1,
        antialias=False,
        elsewhere_too=False,
    )
    written = read(tmp_path, "benchmark_views")["throughput"]
    assert [(row["kind"], row["views"]) for row in written] == [
        ("picture", 1),
        ("picture", 3),
        ("gradient", 2),
    ]
    assert all(row["ms"] > 0 for row in report["throughput"])
    more = {"cores": {1: {"picture": 2.0}, 2: {"picture": 1.0}}, "peak_megabytes": {"16 views": 3}}
    more["same_bits"] = {"chunks": [1], "devices": [2]}
    assert "2 cores over one: picture 2.00." in benchmark_views.table(report | more)


def test_the_device_is_compared_and_timed(tmp_path):
    _, camera = benchmark_device.scenes()["sphere, 5,120 faces"]
    known = {"ball": (dr.shapes.icosphere(1), camera), "cube": (dr.shapes.cube(), camera)}
    small = {"sizes": (8,), "views": (2,), "view_size": 8, "repeats": 1}
    benchmark_device.run(tmp_path, known=known, antialias=False, shadows=(True,), **small)
    written = read(tmp_path, "benchmark_device")
    assert [(row["scene"], row["size"], row["different"]) for row in written["ids"]] == [
        (scene, 8, 0) for scene in known
    ]
    rows = [(row["scene"], row["what"], row["size"]) for row in written["stages"]]
    whats = ("ids", "picture, shadow, no edges", "gradient, shadow, no edges")
    assert rows == [*(("ball", what, 8) for what in whats), ("cube", "ids", 8)]
    assert [row["what"] for row in written["views"]] == list(whats[1:])
    assert all(row["ms"] > 0 for row in written["stages"] + written["views"])
