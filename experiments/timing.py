"""What the benchmarks share: options, fair times, tables and files."""

import argparse
import math
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from common import save_json

Key = TypeVar("Key", bound=Hashable)


def benchmark_options(
    description: str | None, out: str, *, repeats: int
) -> argparse.ArgumentParser:
    """Options of every benchmark."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("results") / out)
    parser.add_argument("--repeats", type=int, default=repeats, help="timed runs of each")
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    return parser


def minimum_times(
    jobs: Mapping[Key, Callable[[], Any]], repeats: int, *, patience: float = 10.0
) -> dict[Key, float]:
    """Minimum milliseconds of each job, its first call (compilation) apart.

    Jobs take turns, so that what else the machine does falls on all of them. One that has run for
    `patience` seconds has no more turns.
    """
    for job in jobs.values():
        jax.block_until_ready(job())
    times: dict[Key, list[float]] = {key: [] for key in jobs}
    for _ in range(repeats):
        for key, job in jobs.items():
            if sum(times[key]) < 1e3 * patience:
                start = time.perf_counter()
                jax.block_until_ready(job())
                times[key].append(1e3 * (time.perf_counter() - start))
    return {key: min(taken) for key, taken in times.items()}


def compiled(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    """A job that runs a compiled function on arguments."""
    program = jax.jit(function)
    return lambda: program(*arguments)


def exponent(sizes: Sequence[float], times: Sequence[float]) -> float:
    """Slope of the straight line through times over sizes, both logarithmic."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def three_digits(value: float) -> str:
    """Without an exponent: 0.0123, 1.23, 123, 12345."""
    if value == 0 or not math.isfinite(value):
        return str(value)
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}"


def markdown(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A Markdown table; numbers get three digits."""
    cells = [[three_digits(c) if isinstance(c, float) else str(c) for c in row] for row in rows]
    lines = [list(header), ["---"] * len(header), *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def write_report(
    out: Path,
    name: str,
    report: dict[str, Any],
    table: Callable[[dict[str, Any]], str],
    plot: Callable[[dict[str, Any], Path], None],
) -> None:
    """Write a report as JSON, its table and its plot."""
    save_json(out / f"{name}.json", report)
    (out / f"{name}.md").write_text(table(report) + "\n")
    plot(report, out / f"{name}.png")
