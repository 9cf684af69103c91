from pathlib import Path

import pytest

from calibgraph import Dataset, load_dataset
from tests.conftest import SAMPLE
from tests.matching.cmrnext.builders import good_content, saved


@pytest.fixture(scope="session")
def sample() -> Dataset:
    return load_dataset(SAMPLE)


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained network."""
    return saved(tmp_path_factory.mktemp("weights") / "random.tar", good_content())


@pytest.fixture(scope="session")
def far_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained network with a config of a training for errors of 20 deg and 1.5 m."""
    content = good_content(max_r=20.0, max_t=1.5)
    return saved(tmp_path_factory.mktemp("weights") / "far.tar", content)
