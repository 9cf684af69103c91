"""Write a drive of KITTI-360 as a dataset folder: ``python kitti_360.py ROOT DRIVE OUT``.

ROOT has ``calibration/``, ``data_2d_raw/DRIVE/image_0k/data_rect/*.png`` and
``data_3d_raw/DRIVE/velodyne_points/data/*.bin``, as they are unpacked. The rig is that of the
rectified images, with the extrinsics of KITTI-360 as a guess; frames are those with all files.
"""

import shutil
import sys
from pathlib import Path

from calibgraph import import_rig


def convert(root: Path, drive: str, out: Path) -> None:
    """Write rig.yaml, lidar/ and cameras/."""
    names = ("perspective", "calib_cam_to_velo", "calib_cam_to_pose")
    rig = import_rig([root / "calibration" / f"{name}.txt" for name in names])
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
