"""Write a drive of KITTI-360 as a dataset folder: ``python kitti_360.py ROOT DRIVE OUT``.

ROOT has ``calibration/``, ``data_2d_raw/DRIVE/image_0k/data_rect/*.png`` and
``data_3d_raw/DRIVE/velodyne_points/data/*.bin``, as they are unpacked. The rig is that of the
rectified images, with the extrinsics of KITTI-360 as a guess; frames are those with all files.
"""

import shutil
import sys
from pathlib import Path

import numpy as np

from calibgraph import Rig


def read_rig(calibration: Path) -> Rig:
    """The rectified cameras: P = K [I | b] shifts each by b against the rectified image_00."""
    text = (calibration / "perspective.txt").read_text(encoding="utf-8")
    lines = (line.partition(":") for line in text.splitlines())
    rows = {key: words.split() for key, _, words in lines}
    T_lidar_00, T_rectified_00 = np.eye(4), np.eye(4)
    T_lidar_00[:3] = np.loadtxt(calibration / "calib_cam_to_velo.txt").reshape(3, 4)
    T_rectified_00[:3, :3] = np.array(rows["R_rect_00"], float).reshape(3, 3)
    cameras = {}
    for k in sorted(key[-2:] for key in rows if key.startswith("P_rect_")):
        P = np.array(rows[f"P_rect_{k}"], float).reshape(3, 4)
        shift = np.eye(4)
        shift[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
        width, height = map(int, map(float, rows[f"S_rect_{k}"]))
        cameras[f"image_{k}"] = {
            "model": "pinhole", "width_px": width, "height_px": height, "distortion": [],
            "intrinsics_px": {"fx": P[0, 0], "fy": P[1, 1], "cx": P[0, 2], "cy": P[1, 2]},
            "T_camera_lidar": shift @ T_rectified_00 @ np.linalg.inv(T_lidar_00),
        }  # fmt: skip
    return Rig.model_validate({"lidar": "velodyne", "cameras": cameras})


def convert(root: Path, drive: str, out: Path) -> None:
    """Write rig.yaml, lidar/ and cameras/."""
    rig = read_rig(root / "calibration")
    scans = root / "data_3d_raw" / drive / "velodyne_points" / "data"
    images = {name: root / "data_2d_raw" / drive / name / "data_rect" for name in rig.cameras}
    stems = {path.stem for path in scans.glob("*.bin")}
    for folder in images.values():
        stems &= {path.stem for path in folder.glob("*.png")}
    targets = {out / "lidar": scans, **{out / "cameras" / n: path for n, path in images.items()}}
    for target, folder in targets.items():
        target.mkdir(parents=True)
        for stem in sorted(stems):
            (source,) = folder.glob(f"{stem}.*")
            shutil.copy(source, target)
    rig.save(out / "rig.yaml")


if __name__ == "__main__":
    convert(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
