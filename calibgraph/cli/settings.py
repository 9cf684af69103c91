"""The file of ``--config``: settings of the solve, and those that are too rare for an option."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from calibgraph.files import StrictNumbers, checked_model, read_yaml
from calibgraph.io.bags.storage import Stamps
from calibgraph.model.config import Config, Terms, config_from


class RareSettings(StrictNumbers):
    """Settings of the command line beside those of the solve.

    Attributes:
        terms: of the objective; those of ``--terms``, if it is given.
        stamps: of a bag: ``header``, those of the sensors; or ``record``, of recording.
        sync_tolerance_s: largest difference of the stamps of a cloud and its images; 0.05 if null.
        device: of Torch, for cmrnext; the GPU if there is one, if null.
        iterations: of each network's recurrent update; 12 if null.
        half_resolution: whether cmrnext halves the images; from 1400 px width on, if null.
    """

    terms: Terms = "full"
    stamps: Stamps | None = None
    sync_tolerance_s: Annotated[float, Field(ge=0)] | None = None
    device: Literal["auto", "cpu", "cuda"] | None = None
    iterations: Annotated[int, Field(ge=1, le=1000)] | None = None
    half_resolution: bool | None = None

    @property
    def of_bags(self) -> dict[str, Any]:
        """Those of reading, by the names of :class:`calibgraph.io.bags.BagOptions`."""
        return self.model_dump(include={"stamps", "sync_tolerance_s"}, exclude_none=True)

    @property
    def of_cmrnext(self) -> dict[str, Any]:
        """Those of the matcher cmrnext that are given."""
        names = {"device", "iterations", "half_resolution"}
        return self.model_dump(include=names, exclude_none=True)


def read_settings(
    path: Path | None, *, terms: str | None = None, **given: Any
) -> tuple[Config, RareSettings]:
    """The settings of a file; options that are given, not None, replace its values.

    Raises:
        FileError: if the file is missing, has an unknown key or a wrong value.
        ValueError: if an option has a wrong value.
    """
    content = {} if path is None else read_yaml(path)
    rare = {name: content.pop(name) for name in RareSettings.model_fields if name in content}
    config = config_from(content, path or "--config")
    rare |= {} if terms is None else {"terms": terms}
    given = {name: value for name, value in given.items() if value is not None}
    return config.changed(**given), checked_model(RareSettings, rare, path or "--terms")
