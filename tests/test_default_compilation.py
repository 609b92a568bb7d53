"""Tests of bits are of programs as users compile them, unlike the others (`conftest.py`)."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

MODULES = ["tests/test_edges.py", "tests/test_stored.py", "tests/test_views.py"]


def test_those_that_ask_for_it():
    if not os.environ.get("XLA_FLAGS"):
        pytest.skip("they run by themselves")
    options = ["-p", "no:xdist", "-o", "addopts=-q", "-m", "default_compilation"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *MODULES],
        cwd=Path(__file__).parents[1],
        env=os.environ | {"XLA_FLAGS": ""},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    assert " passed" in done.stdout
    assert " skipped" not in done.stdout
