"""One pass of a CMRNext network: seconds and peak memory, beside the plainest way to compute it.

Each measurement runs in a process of its own, so that its peak memory is its own. The plainest way
is the tests' rendering of the description: correlation by `grid_sample`, nothing kept.

    python benchmarks/cmrnext.py [--full]      # --full: also 1216x1920, a minute
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

ITERATIONS = 12


def one_pass(way: str, height: int, width: int) -> tuple[float, float]:
    """Seconds, and peak memory of the process in GB."""
    import torch
    from tests.cmrnext_reference import flow_and_sigma

    from calibgraph.matching.cmrnext import network
    from calibgraph.matching.cmrnext.architecture import Architecture

    torch.manual_seed(0)
    model = network.CmrNext(Architecture()).eval()
    if way == "on the fly":
        network.VOLUME_BYTES_MAX = 0
    rgb, lidar = torch.randn(1, 3, height, width), torch.randn(1, 25, height, width)
    start = time.perf_counter()
    with torch.inference_mode():
        if way == "plain":
            state = model.state_dict()
            flow_and_sigma(state, rgb, lidar, context="lidar", iterations=ITERATIONS)
        else:
            model(rgb, lidar, iterations=ITERATIONS)
    seconds = time.perf_counter() - start
    return seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def measured(way: str, height: int, width: int) -> tuple[float, float]:
    """The best of three, each in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        runs = [pool.apply(one_pass, (way, height, width)) for _ in range(3)]
    return min(runs)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--full", action="store_true", help="also 1216x1920")
    cases = [("plain", 384, 1280), ("ours", 384, 1280), ("on the fly", 384, 1280)]
    if parser.parse_args().full:
        cases.append(("ours", 1216, 1920))
    baseline = None
    print(f"{'way':12} {'size':>10} {'seconds':>8} {'ratio':>6} {'GB':>5}")
    for way, height, width in cases:
        seconds, memory = measured(way, height, width)
        baseline = baseline or seconds
        ratio = f"{baseline / seconds:.1f}" if (height, width) == (384, 1280) else ""
        print(f"{way:12} {height:>5}x{width:<4} {seconds:8.2f} {ratio:>6} {memory:5.2f}")


if __name__ == "__main__":
    main()
