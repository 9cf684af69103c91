"""The texts of ``forms.yaml`` for tests of commands."""

from pathlib import Path

import numpy as np
import yaml

TEXTS = yaml.safe_load((Path(__file__).parent / "forms.yaml").read_text())["texts"]
CAMERA_INFO, KALIBR, URDF, KOIDE = (TEXTS[name] for name in ("info", "camchain", "urdf", "koide"))
FRONT = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.4], [0, 0, 0, 1.0]])
SENTENCE = "front looks along LiDAR +x, sits 0.40 m ahead, 0.10 m left and 0.20 m below the LiDAR"


def write(folder: Path, **files: str) -> list[Path]:
    """Files by name, with __ for the dot."""
    paths = [folder / name.replace("__", ".") for name in files]
    for path, text in zip(paths, files.values(), strict=True):
        path.write_text(text)
    return paths
