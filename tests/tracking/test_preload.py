"""Tests of loading what updates use before the first frame comes."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import gc
import sys
from factors.loss import loss_and_weight
from calibgraph import IncrementalCalibrator, perturb
from calibgraph.simulation.correspondences import simulate_correspondences
from calibgraph.simulation.rigs import rig_of
from calibgraph.tracking import history, warm_up_tracker

def loaded():
    kernels = [each for each in gc.get_objects() if type(each) is type(loss_and_weight)]
    return sum(len(kernel.signatures) for kernel in kernels)

before = loaded()
warm_up_tracker()
warm = loaded()
rig = rig_of("kitti")
tracker = IncrementalCalibrator(perturb(rig, rotation_deg=1.0, translation_m=0.1))
table = simulate_correspondences(rig, frames=30, matches=200)
for frame in range(30):
    tracker.update(table.select(table.frame == frame))
print(warm - before, loaded() - warm, "matplotlib" in sys.modules)
"""


def test_after_the_warm_up_updates_load_no_code_nor_what_draws() -> None:
    found = subprocess.run(
        [sys.executable, "-c", PROGRAM], check=True, capture_output=True, text=True
    )
    by_warm_up, by_updates, drawing = found.stdout.split()
    assert int(by_warm_up) > 0
    assert int(by_updates) == 0
    assert drawing == "False"
