"""A ROS 2 node that calibrates a rig while it is driven about, and publishes the transforms.

    python3 examples/ros2_node.py --ros-args -p lidar:=/points -p cameras:="['/front', '/left']"

Each camera is a namespace with image_raw and camera_info in it. The guess comes from tf. Every
``every_s`` seconds the node keeps a cloud with its images; of ``frames`` such frames it calibrates
the rig in a thread of its own, while it goes on to receive. A result that has not failed is
published to /tf_static: per camera the pose of its optical frame in the LiDAR's frame.

To be started again with another guess, or edited: it is an example.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import calibgraph

TOLERANCE_S = 0.05


@dataclass
class Recording:
    """What has been received of one rig.

    Attributes:
        every_s: seconds between the frames that are kept.
        frames: how many are kept.
        clouds: the kept clouds, and ``images`` the images taken with them, by camera.
        infos: the CameraInfo of each camera.
    """

    every_s: float
    frames: int
    clouds: list[Any] = field(default_factory=list)
    images: dict[str, list[Any]] = field(default_factory=dict)
    infos: dict[str, Any] = field(default_factory=dict)
    lidar_frame: str = ""
    last_ns: int = 0

    @property
    def complete(self) -> bool:
        """Whether a calibration can begin."""
        return len(self.clouds) >= self.frames and self.infos.keys() == self.images.keys()

    def add(self, cloud: Any, images: dict[str, Any]) -> None:
        """Keep a cloud and the images of all cameras, unless the last ones are too near in time."""
        stamp_ns = cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec
        if stamp_ns - self.last_ns < self.every_s * 1e9 or len(self.clouds) >= self.frames:
            return
        arrays = {name: calibgraph.image_from_message(each) for name, each in images.items()}
        self.clouds.append(calibgraph.cloud_from_message(cloud))
        for name, image in arrays.items():
            self.images.setdefault(name, []).append(image)
        self.last_ns, self.lidar_frame = stamp_ns, cloud.header.frame_id

    def dataset(self, transforms: dict[str, Any]) -> calibgraph.Dataset:
        """The frames, with the guess.

        Args:
            transforms: per camera what tf2's ``lookup_transform(camera_optical, lidar)`` gave.
        """
        cameras = {
            name: calibgraph.camera_from_message(self.infos[name], matrix_of(each.transform))
            for name, each in transforms.items()
        }
        rig = calibgraph.Rig(lidar=self.lidar_frame, cameras=cameras)
        return calibgraph.dataset_from_arrays(rig, self.clouds, self.images)


def matrix_of(transform: Any) -> np.ndarray:
    """(4, 4) of a geometry_msgs Transform."""
    t, q = transform.translation, transform.rotation
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = t.x, t.y, t.z
    return T


def fill_transform(message: Any, T_lidar_camera: np.ndarray, lidar: str, optical: str) -> Any:
    """Fill a TransformStamped with the pose of a camera: parent LiDAR, child optical frame."""
    message.header.frame_id, message.child_frame_id = lidar, optical
    t, q = message.transform.translation, message.transform.rotation
    t.x, t.y, t.z = map(float, T_lidar_camera[:3, 3])
    q.x, q.y, q.z, q.w = map(float, Rotation.from_matrix(T_lidar_camera[:3, :3]).as_quat())
    return message


class Calibrator:
    """Receives, calibrates in a thread, publishes; with the parts of ROS handed in."""

    def __init__(self, recording: Recording, cameras: list[str], ros: Any) -> None:
        self.recording, self.cameras, self.ros = recording, cameras, ros
        self.running: Future[calibgraph.Calibration] | None = None
        self._thread = ThreadPoolExecutor(1)

    def receive_info(self, camera: str, message: Any) -> None:
        """Keep a camera's latest CameraInfo."""
        self.recording.infos[camera] = message

    def receive_frame(self, cloud: Any, *images: Any) -> None:
        """Keep a frame; when there are enough, calibrate."""
        try:
            self.recording.add(cloud, dict(zip(self.cameras, images, strict=True)))
            if self.recording.complete and self.running is None:
                self._start()
        except calibgraph.CalibrationError as error:
            self.ros.log.warning(str(error))

    def _start(self) -> None:
        recording = self.recording
        transforms = {
            name: self.ros.lookup(info.header.frame_id, recording.lidar_frame)
            for name, info in recording.infos.items()
        }
        data = recording.dataset(transforms)
        self.ros.log.info(f"calibrating with {len(data.frames)} frames")
        self.running = self._thread.submit(calibgraph.calibrate, data)
        self.running.add_done_callback(self._finish)

    def _finish(self, running: Future[calibgraph.Calibration]) -> None:
        if (error := running.exception()) is not None:
            self.ros.log.error(str(error))
            return
        result = running.result()
        self.ros.log.info(f"{result.verdict.status} {'; '.join(result.verdict.reasons)}")
        if result.verdict.status != "FAIL":
            self.ros.publish([self._transform(result, name) for name in self.cameras])

    def _transform(self, result: calibgraph.Calibration, name: str) -> Any:
        optical = self.recording.infos[name].header.frame_id
        pose = result.T_lidar_camera[name]
        return fill_transform(self.ros.new_transform(), pose, self.recording.lidar_frame, optical)


class Ros:
    """The parts of ROS that the calibrator uses."""

    def __init__(self, node: Any) -> None:
        import geometry_msgs.msg
        import rclpy.time
        import tf2_ros

        self.log, self.new_transform = node.get_logger(), geometry_msgs.msg.TransformStamped
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)
        self._broadcaster = tf2_ros.StaticTransformBroadcaster(node)
        self._latest, self._no_transform = rclpy.time.Time(), tf2_ros.TransformException

    def lookup(self, target: str, source: str) -> Any:
        """The transform from source to target."""
        try:
            return self._buffer.lookup_transform(target, source, self._latest)
        except self._no_transform as error:
            raise calibgraph.CalibrationError(str(error)) from error

    def publish(self, transforms: list[Any]) -> None:
        """Send static transforms."""
        self._broadcaster.sendTransform(transforms)


def main() -> None:
    """Subscribe, and receive until stopped."""
    import message_filters
    import rclpy
    from rclpy.qos import qos_profile_sensor_data as qos
    from sensor_msgs.msg import CameraInfo, Image, PointCloud2

    rclpy.init()
    node = rclpy.create_node("calibgraph")
    lidar = node.declare_parameter("lidar", "/points").value
    names = node.declare_parameter("cameras", ["/camera"]).value
    topics = {name.strip("/").replace("/", "_"): name for name in names}
    every_s = node.declare_parameter("every_s", 3.0).value
    frames = node.declare_parameter("frames", 20).value
    calibrator = Calibrator(Recording(every_s, frames), list(topics), Ros(node))
    for name, topic in topics.items():
        receive_info = partial(calibrator.receive_info, name)
        node.create_subscription(CameraInfo, f"{topic}/camera_info", receive_info, qos)
    inputs = [(PointCloud2, lidar), *((Image, f"{topic}/image_raw") for topic in topics.values())]
    filters = [message_filters.Subscriber(node, *each, qos_profile=qos) for each in inputs]
    together = message_filters.ApproximateTimeSynchronizer(filters, 30, TOLERANCE_S)
    together.registerCallback(calibrator.receive_frame)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
