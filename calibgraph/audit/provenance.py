"""Whether a calibration was made from the recording that it is checked with."""

from pathlib import Path

from pydantic import BaseModel

from calibgraph.files import checked_model, read_yaml
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import hash_source
from calibgraph.model.result_files import CALIBRATION_FILE, is_calibration_file


class _Inputs(BaseModel):
    """The inputs of a result, as its file names them."""

    inputs: dict[str, str] = {}


def is_made_from(rig: Path, data: Dataset) -> bool:
    """Whether a cloud of the recording is one that the calibration was made from.

    Only clouds with the name of one of its inputs are read.

    Raises:
        FileError: if the result is malformed, or a cloud cannot be read.
    """
    path = rig / CALIBRATION_FILE if rig.is_dir() else rig
    if not is_calibration_file(path):
        return False
    inputs = checked_model(_Inputs, read_yaml(path), path).inputs
    names = {Path(source).name for source in inputs}
    clouds = (frame.cloud_path for frame in data.frames if frame.cloud_path.name in names)
    return any(hash_source(cloud) in inputs.values() for cloud in clouds)
