"""A large bag is read in little memory."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from calibgraph import load_dataset
from tests.conftest import ROOT, SAMPLE
from tests.io.bags.writing import (
    KINDS,
    PERIOD_NS,
    START_NS,
    Messages,
    Stamped,
    sample_messages,
    structured,
    write_bag,
)

FRAMES, POINTS, HEIGHT, WIDTH = 60, 65536, 720, 1280
FRAME_BYTES = 16 * POINTS + 3 * HEIGHT * WIDTH * 3

READ = """
import resource, sys
from calibgraph import load_dataset, load_rig
rig = load_rig(sys.argv[1])
peak_kb = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
before = peak_kb()
assert len(load_dataset(sys.argv[1], rig).frames) == int(sys.argv[2])
print(1024 * (peak_kb() - before))
"""


def large_frames(make: Messages) -> Iterator[Stamped]:
    """Lenses and transforms of the sample, then noise."""
    generator, cameras = np.random.default_rng(0), load_dataset(SAMPLE).rig.cameras
    points = structured(generator.normal(0, 20, (POINTS, 4)).astype(np.float32))
    pixels = generator.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    yield from sample_messages(make)[: 1 + len(cameras)]
    for stamp_ns in range(START_NS, START_NS + FRAMES * PERIOD_NS, PERIOD_NS):
        cloud = make.cloud(points, stamp_ns)
        yield Stamped("/points", "sensor_msgs/msg/PointCloud2", stamp_ns, cloud)
        for name in cameras:
            image = make.image(pixels, "bgr8", stamp_ns)
            yield Stamped(f"/{name}/image_raw", "sensor_msgs/msg/Image", stamp_ns, image)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_reading_a_bag_takes_a_fraction_of_its_size(tmp_path: Path, kind: str) -> None:
    bag = write_bag(tmp_path, kind, large_frames(Messages(kind)))
    command = [sys.executable, "-c", READ, str(bag), str(FRAMES)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert int(run.stdout) < 0.2 * FRAMES * FRAME_BYTES  # of 0.54 GB; a chunk, some messages
