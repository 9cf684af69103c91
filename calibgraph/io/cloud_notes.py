"""Notes about a cloud: it has no intensity, or its columns were told by its content."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calibgraph.errors import CalibrationError
from calibgraph.io.bags import MESSAGE_SUFFIX, load_bag_cloud
from calibgraph.io.bags.messages import read_message
from calibgraph.io.clouds import check_points, read_cloud
from calibgraph.io.point_fields import RawCloud

_COST = "the error bars become about twice as wide without; record it, or name its field intensity"
"""Measured on data/sample: 1.8 to 2.8 times the error bars without it, with half of the matches."""


def read_cloud_notes(path: Path) -> list[str]:
    """Notes about a file, or about a message in a bag; none if it cannot be read."""
    try:
        if path.suffix == MESSAGE_SUFFIX:
            fields = tuple(each.name for each in read_message(path)[1].fields)
            cloud = RawCloud(load_bag_cloud(path), fields)
        else:
            cloud = read_cloud(path)
            cloud = cloud._replace(points=check_points(cloud.points, path))
    except (CalibrationError, OSError):  # which is named where the frame is read
        return []
    return list(describe_cloud(str(path), cloud))


def describe_cloud(where: str, cloud: RawCloud) -> Iterator[str]:
    """Notes about a cloud."""
    if cloud.told:
        yield f"{where}: {cloud.told}"
    intensity = cloud.points[:, 3]
    if np.isnan(intensity).all():
        yield f"{where}: no intensity among its fields {' '.join(cloud.fields)}; {_COST}"
    elif np.nanmin(intensity) == np.nanmax(intensity):
        yield f"{where}: the intensity is {np.nanmax(intensity) + 0:g} at all points; {_COST}"
