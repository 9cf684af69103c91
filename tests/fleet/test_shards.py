from __future__ import annotations

import pytest

from calibgraph import CalibrationError
from calibgraph.fleet.run import Shard, shard_from


def test_every_bucket_is_in_one_shard() -> None:
    for count in (1, 3, 7, 256):
        owners = [sum(Shard(i, count).has(b) for i in range(count)) for b in range(256)]
        assert owners == [1] * 256


def test_the_shard_is_that_of_the_option() -> None:
    array = {"SLURM_ARRAY_TASK_ID": "3"}
    assert shard_from("2/8", array) == Shard(2, 8)
    assert shard_from(None, {"SLURM_JOB_ID": "3"}) == Shard()


@pytest.mark.parametrize(
    "name", ["SLURM_ARRAY_TASK_ID", "AWS_BATCH_JOB_ARRAY_INDEX", "JOB_COMPLETION_INDEX"]
)
def test_a_process_of_an_array_does_not_do_the_whole_manifest(name: str) -> None:
    with pytest.raises(CalibrationError, match=rf"--shard \${name}/N"):
        shard_from(None, {name: "0"})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("8/8", "expected i/n with 0 <= i < n <= 256"),
        ("0/257", "expected i/n with 0 <= i < n <= 256"),
        ("3", "expected i/n, as 0/8"),
        ("a/b", "expected i/n, as 0/8"),
    ],
)
def test_a_wrong_shard_is_one_line(text: str, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        shard_from(text, {})
