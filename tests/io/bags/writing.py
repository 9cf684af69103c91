"""Bags of the sample, written with rosbags: ROS 1, ROS 2 sqlite3 and MCAP."""

from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calibgraph import Camera, Dataset, Rig, load_dataset
from calibgraph.io.bags.messages import type_store
from calibgraph.io.dataset import keep_frames
from calibgraph.model.geometry import invert, transform
from tests.conftest import SAMPLE

pytest.importorskip("rosbags")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from scipy.spatial.transform import Rotation

KINDS = ("ros1", "sqlite3", "mcap")
STORES = {ros1: type_store(ros1=ros1) for ros1 in (True, False)}
START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 100_000_000


@dataclass(frozen=True)
class Stamped:
    """A message to write: its topic, its type, and when it was recorded."""

    topic: str
    type: str
    record_ns: int
    content: Any


class Messages:
    """Makes messages of ROS 1 or ROS 2."""

    def __init__(self, kind: str) -> None:
        self.kind, self.ros1 = kind, kind == "ros1"
        self.types = STORES[self.ros1].types

    def make(self, type_: str, /, **fields: Any) -> Any:
        return self.types[type_](**fields)

    def header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self.make(
            "builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        extra = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **extra)

    def image(
        self, pixels: NDArray[Any], encoding: str, stamp_ns: int, *, padding: int = 0,
        big_endian: bool = False,
    ) -> Any:  # fmt: skip
        rows = pixels.astype(pixels.dtype.newbyteorder(">" if big_endian else "<"))
        data = np.frombuffer(rows.tobytes(), np.uint8).reshape(len(pixels), -1)
        data = np.pad(data, ((0, 0), (0, padding)))
        return self.make(
            "sensor_msgs/msg/Image", header=self.header(stamp_ns, "camera"),
            height=pixels.shape[0], width=pixels.shape[1], encoding=encoding,
            is_bigendian=int(big_endian), step=data.shape[1], data=data.ravel(),
        )  # fmt: skip

    def compressed(self, data: bytes, form: str, stamp_ns: int) -> Any:
        return self.make(
            "sensor_msgs/msg/CompressedImage", header=self.header(stamp_ns, "camera"),
            format=form, data=np.frombuffer(data, np.uint8),
        )  # fmt: skip

    def camera_info(self, camera: Camera, frame: str, **changed: Any) -> Any:
        lens = camera.intrinsics_px
        K = np.array([lens.fx, 0, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1])
        P = np.column_stack([K.reshape(3, 3), np.zeros(3)]).ravel()
        matrices = {
            "K": K, "D": np.array(camera.distortion), "R": np.eye(3).ravel(), "P": P
        }  # fmt: skip
        matrices = {name: changed.pop(name, value) for name, value in matrices.items()}
        names = matrices if self.ros1 else {n.lower(): value for n, value in matrices.items()}
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0,
            do_rectify=False,
        )  # fmt: skip
        fields = {
            "header": self.header(START_NS, frame), "height": camera.height_px,
            "width": camera.width_px, "distortion_model": "plumb_bob", "binning_x": 0,
            "binning_y": 0, "roi": roi, **names, **changed,
        }  # fmt: skip
        return self.make("sensor_msgs/msg/CameraInfo", **fields)

    def cloud(
        self, points: NDArray[np.void], stamp_ns: int, *, height: int = 1, padding: int = 0
    ) -> Any:
        """A cloud of a structured array, whose fields, offsets and byte order it gets."""
        codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        kinds = points.dtype.fields or {}
        fields = [
            self.make(
                "sensor_msgs/msg/PointField", name=name, offset=offset,
                datatype=codes[kind.str[1:]], count=1,
            )
            for name, (kind, offset, *_) in kinds.items()
        ]  # fmt: skip
        data = np.frombuffer(points.tobytes(), np.uint8).reshape(height, -1)
        data = np.pad(data, ((0, 0), (0, padding)))
        order = {kind.str[0] for kind, *_ in kinds.values()}
        return self.make(
            "sensor_msgs/msg/PointCloud2", header=self.header(stamp_ns, "velodyne"), height=height,
            width=len(points) // height, fields=fields, is_bigendian=">" in order,
            point_step=points.dtype.itemsize, row_step=data.shape[1], data=data.ravel(),
            is_dense=False,
        )  # fmt: skip

    def transforms(self, edges: Iterable[tuple[str, str, NDArray[np.float64]]]) -> Any:
        """A TFMessage of (parent, child, T_parent_child)."""
        stamped = []
        for parent, child, T in edges:
            x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
            turn = self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
            shift = self.make(
                "geometry_msgs/msg/Vector3", **dict(zip("xyz", T[:3, 3], strict=True))
            )
            both = self.make("geometry_msgs/msg/Transform", translation=shift, rotation=turn)
            stamped.append(
                self.make(
                    "geometry_msgs/msg/TransformStamped", header=self.header(START_NS, parent),
                    child_frame_id=child, transform=both,
                )
            )  # fmt: skip
        return self.make("tf2_msgs/msg/TFMessage", transforms=stamped)


def structured(cloud: NDArray[np.float32], names: str = "xyzi") -> NDArray[np.void]:
    """(n,) a cloud as points with fields in this order."""
    fields = ["intensity" if name == "i" else name for name in names]
    points = np.zeros(len(cloud), [(field, "<f4") for field in fields])
    for name, field in zip(names, fields, strict=True):
        points[field] = cloud[:, "xyzi".index(name)]
    return points


def write_bag(
    folder: Path, kind: str, messages: Iterable[Stamped], *, compression: str = ""
) -> Path:
    """Write a bag.

    Args:
        folder: where to.
        kind: of the bag.
        messages: its messages.
        compression: BZ2 or LZ4 of ROS 1; FILE, MESSAGE or STORAGE of ROS 2.

    Returns:
        The .bag file of ROS 1, or the folder of a ROS 2 bag.
    """
    ros1 = kind == "ros1"
    store, path = STORES[ros1], folder / ("drive.bag" if ros1 else f"drive_{kind}")
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        if ros1:
            writer: Any = Writer1(path)
            if compression:
                writer.set_compression(Writer1.CompressionFormat[compression])
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(path, version=9, storage_plugin=plugin)
            if compression:
                writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
        stack.enter_context(writer)
        connections: dict[str, Any] = {}
        for each in messages:
            if each.topic not in connections:
                connections[each.topic] = writer.add_connection(
                    each.topic, each.type, typestore=store
                )
            serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
            data = serialize(each.content, each.type)
            writer.write(connections[each.topic], each.record_ns, data)
    return path


def tree_of(rig: Rig) -> list[tuple[str, str, NDArray[np.float64]]]:
    """Transforms base -> LiDAR and base -> camera bodies -> optical frames, as a vehicle's URDF."""
    T_base_lidar = transform(Rotation.from_euler("z", 30, degrees=True), [1.0, 0.2, 1.8])
    T_body_optical = transform([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    edges = [("base", "velodyne", T_base_lidar)]
    for name, camera in rig.cameras.items():
        T_base_optical = T_base_lidar @ invert(camera.T_camera_lidar)
        edges.append(("base", f"{name}_link", T_base_optical @ invert(T_body_optical)))
        edges.append((f"{name}_link", f"{name}_optical", T_body_optical))
    return edges


_sample = cache(lambda: keep_frames(load_dataset(SAMPLE)))


def sample_messages(
    make: Messages, data: Dataset | None = None, *, raw: bool = False
) -> list[Stamped]:
    """The messages of a dataset, by default the sample.

    Args:
        make: of ROS 1 or 2.
        data: whose frames are 0.1 s apart.
        raw: images as pixels, not as the files' JPEG.
    """
    data = data or _sample()
    tree = make.transforms(tree_of(data.rig))
    written = [Stamped("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, tree)]
    for name, camera in data.rig.cameras.items():
        info = make.camera_info(camera, f"{name}_optical")
        written.append(
            Stamped(f"/{name}/camera_info", "sensor_msgs/msg/CameraInfo", START_NS, info)
        )
    for number, frame in enumerate(data.frames):
        stamp_ns = START_NS + number * PERIOD_NS
        cloud = make.cloud(structured(frame.load_cloud()), stamp_ns)
        written.append(Stamped("/points", "sensor_msgs/msg/PointCloud2", stamp_ns + 9, cloud))
        for name, path in frame.image_paths.items():
            if raw:
                image = make.image(cv2.imread(str(path)), "bgr8", stamp_ns + 3_000_000)
                written.append(
                    Stamped(f"/{name}/image_raw", "sensor_msgs/msg/Image", stamp_ns, image)
                )
            else:
                jpeg = make.compressed(path.read_bytes(), path.suffix[1:], stamp_ns + 3_000_000)
                topic = f"/{name}/image_raw/compressed"
                written.append(Stamped(topic, "sensor_msgs/msg/CompressedImage", stamp_ns, jpeg))
    return written


def require_same_frames(found: Dataset, expected: Dataset) -> None:
    """Check that clouds and images are the same."""
    for one, two in zip(found.frames, expected.frames, strict=True):
        np.testing.assert_array_equal(one.load_cloud(), two.load_cloud())
        for name, camera in expected.rig.cameras.items():
            images = one.load_image(name, camera), two.load_image(name, camera)
            np.testing.assert_array_equal(*images)


def sample_bag(folder: Path, kind: str, **options: Any) -> Path:
    """The sample as a bag."""
    return write_bag(folder, kind, sample_messages(Messages(kind), **options))


def without(messages: Iterable[Stamped], topic: str) -> list[Stamped]:
    """The messages of all other topics."""
    return [each for each in messages if each.topic != topic]
