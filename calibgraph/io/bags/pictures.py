"""Image and CompressedImage messages as BGR images of 8 bits."""

import re
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import DatasetError
from calibgraph.io.bags.messages import describe_message
from calibgraph.io.images import decode_image, describe_turn

Image = NDArray[np.uint8]

_CHANNELS = {"mono": 1, "bgr": 3, "rgb": 3, "bgra": 4, "rgba": 4}
_TO_BGR = {
    "mono": cv2.COLOR_GRAY2BGR,
    "rgb": cv2.COLOR_RGB2BGR,
    "bgra": cv2.COLOR_BGRA2BGR,
    "rgba": cv2.COLOR_RGBA2BGR,
    # ROS names a mosaic by its first row, OpenCV by the second row and column
    "bayer_rggb": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg": cv2.COLOR_BayerGB2BGR,
}
_YUV = {
    "yuv422": cv2.COLOR_YUV2BGR_UYVY, "uyvy": cv2.COLOR_YUV2BGR_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2, "yuyv": cv2.COLOR_YUV2BGR_YUY2,
    "yuy2": cv2.COLOR_YUV2BGR_YUY2, "yvyu": cv2.COLOR_YUV2BGR_YVYU,
}  # fmt: skip
_OPENCV_CHANNELS = {"1": "mono", "3": "bgr", "4": "bgra"}
_DEPTHS = (8, 10, 12, 14, 16)


def is_depth(message: Any) -> bool:
    """Whether an image's values are distances: 16UC1 and 32FC1 by ROS's convention."""
    encoding = str(getattr(message, "encoding", "") or message.format)
    return encoding.startswith(("16UC1", "32FC1")) or "compressedDepth" in encoding


def image_from_message(message: Any, where: str = "") -> Image:
    """The image of an Image or a CompressedImage; of rclpy, rospy, rosbags or another decoder.

    Of images with 16 bits, 8 are kept: the upper ones of the smallest depth (8, 10, 12, 14 or 16
    bits) that holds the brightest value.

    Args:
        message: any object with the fields of the message.
        where: for errors; frame and stamp if empty.

    Returns:
        (height, width, 3) uint8, BGR.

    Raises:
        DatasetError: if its encoding is unknown, or it is incomplete.
    """
    where = where or describe_message(message)
    if hasattr(message, "encoding"):
        return _of_pixels(message, where)
    return _of_compressed(message, where)


def _of_pixels(message: Any, where: str) -> Image:
    encoding = message.encoding.strip()
    if encoding.lower() in _YUV:
        pixels = _pixels(message, 2, "u1", where)
        return np.asarray(cv2.cvtColor(pixels, _YUV[encoding.lower()]), dtype=np.uint8)
    layout, bits = _layout(encoding, where)
    kind = "u1" if bits == 8 else (">u2" if message.is_bigendian else "<u2")  # noqa: PLR2004
    return _to_bgr(_to_8_bits(_pixels(message, _CHANNELS.get(layout, 1), kind, where)), layout)


def _layout(encoding: str, where: str) -> tuple[str, int]:
    """The layout (mono, bgr, ..., bayer_rggb, ...) and the bits of an encoding's channels."""
    opencv = re.fullmatch(r"(8|16)UC([134])", encoding)
    if opencv:
        return _OPENCV_CHANNELS[opencv[2]], int(opencv[1])
    ros = re.fullmatch(r"([a-z_]+?)(8|16)", encoding.lower())
    if ros and (ros[1] in _CHANNELS or ros[1] in _TO_BGR):
        return ros[1], int(ros[2])
    raise DatasetError(
        f"{where}: image encoding {encoding!r} is unknown; known are mono, bgr, rgb, bgra, rgba "
        "and bayer_* with 8 or 16, 8UC and 16UC with 1, 3 or 4, "
        f"{', '.join(_YUV)}: convert it, or choose another topic"
    )


def _pixels(message: Any, channels: int, kind: str, where: str) -> NDArray[Any]:
    """(height, width[, channels]) the pixels; rows may be padded."""
    height, width, item = message.height, message.width * channels, np.dtype(kind).itemsize
    step = max(message.step, width * item)
    data = np.ascontiguousarray(message.data)
    if not height * width or len(data) < step * (height - 1) + width * item:
        raise DatasetError(
            f"{where}: has {len(message.data)} bytes for {message.width}x{message.height} px, "
            f"encoding {message.encoding!r}; record it again"
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, width * item), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view(kind)
    return pixels if channels == 1 else pixels.reshape(height, -1, channels)


def _to_8_bits(pixels: NDArray[Any]) -> Image:
    if pixels.dtype.itemsize == 1:
        return pixels
    depth = next(d for d in _DEPTHS if pixels.max() < 1 << d)
    return (pixels >> (depth - 8)).astype(np.uint8)


def _to_bgr(pixels: Image, layout: str) -> Image:
    if layout == "bgr":
        return pixels if pixels.flags.writeable else pixels.copy()
    return np.asarray(cv2.cvtColor(pixels, _TO_BGR[layout]), dtype=np.uint8)


def _of_compressed(message: Any, where: str) -> Image:
    """Decode; image_transport's ``format`` is ``ENCODING; CODEC compressed STORED``, or a codec."""
    encoding, _, codec = message.format.partition(";")
    data = np.ascontiguousarray(message.data).tobytes()
    if not data.startswith((b"\xff\xd8", b"\x89PNG")):
        raise DatasetError(
            f"{where}: its format {message.format!r} is neither JPEG nor PNG; decode it with "
            "`ros2 run image_transport republish`, of video through ffmpeg, and give that topic"
        )
    mosaic = encoding.startswith("bayer_") and "bgr" not in codec and "rgb" not in codec
    kind = cv2.IMREAD_GRAYSCALE if mosaic else cv2.IMREAD_COLOR
    try:
        turned = describe_turn(data)
        decoded = decode_image(data, kind | cv2.IMREAD_ANYDEPTH)
    except ValueError as error:
        raise DatasetError(
            f"{where}: is truncated or no image of its kind ({error}); record it again"
        ) from error
    if turned:
        raise DatasetError(f"{where}: {turned}")
    image = _to_8_bits(decoded)
    if mosaic:
        return _to_bgr(image, _layout(encoding, where)[0])
    return _to_bgr(image, "rgb") if "compressed rgb" in codec else image
