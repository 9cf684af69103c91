from __future__ import annotations

from pathlib import Path

import pytest

from calibgraph import Dataset
from calibgraph.matching.cmrnext import train
from calibgraph.matching.trusted_data import load_trusted_dataset
from tests.conftest import SAMPLE
from tests.matching.cmrnext.training.tiny import TINY


@pytest.fixture(scope="session")
def trusted() -> Dataset:
    return load_trusted_dataset(SAMPLE)


@pytest.fixture(scope="session")
def parts(trusted: Dataset) -> tuple[Dataset, Dataset]:
    return trusted.select("0:2"), trusted.select("5")


@pytest.fixture(scope="session")
def once(parts: tuple[Dataset, Dataset], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training of 3 steps, stopped after the first."""
    path = tmp_path_factory.mktemp("once") / "net.tar"

    def stop(what: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train([parts[0]], [parts[1]], path, TINY.changed(steps=3), validate_every=1, progress=stop)
    return path
