"""Annotations of the library are checked at every call; plots need no display."""

import jax
import jaxtyping
import matplotlib
import pytest
from beartype import BeartypeConf, beartype
from jaxtyping import install_import_hook

# As for mypy, an int will do where a float is wanted.
check_annotations = beartype(conf=BeartypeConf(is_pep484_tower=True))

install_import_hook("diffrast", f"{__name__}.check_annotations")
matplotlib.use("Agg")


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """Compiled programs of one file are of no use to the next; a process can map so many only."""
    yield
    jax.clear_caches()


@pytest.fixture
def unchecked(monkeypatch):
    """The library's own errors, not those of the annotations that the tests check."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
