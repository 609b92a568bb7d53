"""Annotations of the library are checked at every call; plots need no display.

Programs are compiled by XLA's older emitters of loops, in two thirds of the time and with other
roundings. With `XLA_FLAGS` set to anything, if only to nothing, they are compiled as those flags
say, and the tests marked `default_compilation` run, too.

Tracing makes many objects that live on, and is a fifth shorter if garbage is seldom looked for.
"""

import gc
import os
from pathlib import Path

import jax
import jaxtyping
import matplotlib
import pytest
from beartype import BeartypeConf, beartype
from jaxtyping import install_import_hook

OLDER_EMITTERS = "--xla_cpu_use_fusion_emitters=false"
if jax.__version_info__[:2] == (0, 10):  # a version that does not know the flag would stop
    os.environ.setdefault("XLA_FLAGS", OLDER_EMITTERS)

# As for mypy, an int will do where a float is wanted.
check_annotations = beartype(conf=BeartypeConf(is_pep484_tower=True))

install_import_hook("diffrast", f"{__name__}.check_annotations")
matplotlib.use("Agg")
gc.set_threshold(200_000)


def pytest_runtest_setup(item):
    otherwise = os.environ.get("XLA_FLAGS") == OLDER_EMITTERS
    if otherwise and item.get_closest_marker("default_compilation"):
        pytest.skip("run by test_default_compilation.py")


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """A process can map 65,530 regions of memory only, and compiled programs take many each."""
    yield
    regions = Path("/proc/self/maps")
    if not regions.exists() or regions.read_bytes().count(b"\n") > 20_000:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="module")
def compiled_quickly():
    """For modules of few and large programs: compiled in two thirds of the time, and slower."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
    jax.clear_caches()


@pytest.fixture
def unchecked(monkeypatch):
    """The library's own errors, not those of the annotations that the tests check."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
