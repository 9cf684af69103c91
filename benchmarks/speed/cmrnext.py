"""One pass of a CMRNext network: seconds and peak memory, beside the plainest way to compute it.

    python -m benchmarks.speed.cmrnext [--full] [--runs 3]    # --full: also 1216x1920, a minute

Each measurement runs in a process of its own, which has its peak memory to itself. The plainest way
is the reference network of the tests: correlation by `grid_sample`, nothing kept.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time

from benchmarks.tables import Table, add_record_option, publish

ITERATIONS = 12
SIZE = (384, 1280)
COLUMNS = ("correlation", "image", "time [s]", "ratio", "peak [GB]")


def run_pass(correlation: str, height: int, width: int) -> tuple[float, float]:
    """Seconds, and peak memory of the process in GB."""
    import torch

    from calibgraph.matching.cmrnext import network
    from calibgraph.matching.cmrnext.architecture import Architecture
    from tests.matching.cmrnext.reference_network import flow_and_sigma

    torch.manual_seed(0)
    model = network.CmrNext(Architecture()).eval()
    if correlation == "on the fly":
        network.VOLUME_BYTES_MAX = 0
    rgb, lidar = torch.randn(1, 3, height, width), torch.randn(1, 25, height, width)
    start = time.perf_counter()
    with torch.inference_mode():
        if correlation == "plain":
            state = model.state_dict()
            flow_and_sigma(state, rgb, lidar, context="lidar", iterations=ITERATIONS)
        else:
            model(rgb, lidar, iterations=ITERATIONS)
    seconds = time.perf_counter() - start
    return seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def measure(correlation: str, height: int, width: int, *, runs: int) -> tuple[float, float]:
    """The shortest time, and its memory, of some runs, each in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        return min(pool.apply(run_pass, (correlation, height, width)) for _ in range(runs))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--full", action="store_true", help="also 1216x1920")
    parser.add_argument("--runs", type=int, default=3, help="of which the shortest counts")
    add_record_option(parser)
    options = parser.parse_args()
    cases = [("plain", *SIZE), ("ours", *SIZE), ("on the fly", *SIZE)]
    if options.full:
        cases.append(("ours", 1216, 1920))
    rows, plain = [], None
    for correlation, height, width in cases:
        seconds, memory = measure(correlation, height, width, runs=options.runs)
        plain = plain or seconds
        ratio = f"{plain / seconds:.1f}" if (height, width) == SIZE else ""
        size = f"{height}x{width}"
        rows.append((correlation, size, f"{seconds:.2f}", ratio, f"{memory:.2f}"))
    table = Table("A pass of one network", COLUMNS, tuple(rows))
    publish("speed.cmrnext", [table], record=options.record)


if __name__ == "__main__":
    main()
