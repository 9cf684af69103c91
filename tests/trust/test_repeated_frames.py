from __future__ import annotations

from dataclasses import replace

import calibgraph
from calibgraph.files import sha256
from calibgraph.trust.rematch_checks import check_repeated_clouds
from tests.conftest import SAMPLE


def test_frames_with_the_same_cloud_are_reported() -> None:
    data = calibgraph.load_dataset(SAMPLE).select("0:2")
    copy = replace(data.frames[0], index=2, name="copy")
    data = replace(data, frames=(*data.frames, copy))
    hashes = {str(frame.cloud_path): sha256(frame.cloud_path) for frame in data.frames}
    (check,) = check_repeated_clouds(data, hashes)
    assert check.status == "WARN" and "000000 and copy have the same cloud" in check.text
    assert check_repeated_clouds(replace(data, frames=data.frames[:2]), hashes) == []
