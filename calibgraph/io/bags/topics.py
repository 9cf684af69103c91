"""Which topics of a bag are the LiDAR and the cameras: as named, else by the types of messages."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from shlex import quote

from calibgraph.errors import DatasetError
from calibgraph.io.bags.messages import CAMERA_INFO, CLOUDS, COMPRESSED_IMAGE, IMAGE, Bag
from calibgraph.io.bags.pictures import is_depth
from calibgraph.io.bags.storage import LIDAR, ODOMETRY

_BEST_FIRST = ("image_raw", "image", "image_color", "image_mono", "image_rect_color", "image_rect")
_FORM = re.compile(
    r"^(image|images|img|raw|rect|rectified|color|colour|mono|gray|grey|compressed|info)(?=\d*$)"
)
"""Words of a topic's last part that name a form of an image, not a camera."""

Words = tuple[str, ...]

_VIDEO = "video, which is not read: write images with `ros2 run image_transport republish {} raw`"
_PACKETS = "a driver's packets, which are not read: record the clouds that the driver makes of them"
_NOT_READ = {
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": _VIDEO.format("ffmpeg"),
    "foxglove_msgs/msg/CompressedVideo": _VIDEO.format("foxglove"),
    "theora_image_transport/msg/Packet": _VIDEO.format("theora"),
    "point_cloud_interfaces/msg/CompressedPointCloud2": (
        "a compressed cloud, which is not read: write clouds with `ros2 run point_cloud_transport "
        "republish --ros-args -p in_transport:=draco -p out_transport:=raw`"
    ),
    "velodyne_msgs/msg/VelodyneScan": _PACKETS,
    "ouster_ros/msg/PacketMsg": _PACKETS,
    "ouster_sensor_msgs/msg/PacketMsg": _PACKETS,
    "hesai_ros_driver/msg/UdpFrame": _PACKETS,
    "nebula_msgs/msg/NebulaPackets": _PACKETS,
}


@dataclass(frozen=True)
class RigTopics:
    """The topics of a LiDAR and of cameras, by the cameras' names; ``notes`` name others.

    ``infos`` are the CameraInfo of images, ``unclear`` why others have none. Of several LiDARs
    ``lidar`` is the base, and ``lidars`` are those of the others.
    """

    lidar: str
    images: Mapping[str, str]
    infos: Mapping[str, str]
    unclear: Mapping[str, str]
    notes: tuple[str, ...] = ()
    lidars: Mapping[str, str] = field(default_factory=dict)

    @property
    def paired(self) -> dict[str, str]:
        """The topics that are paired with the LiDAR's clouds: of images, and of other LiDARs."""
        return {**self.images, **self.lidars}


def is_rectified(image: str) -> bool:
    """Whether the images of a topic are, by its name."""
    return "rect" in _base(image).rsplit("/", 1)[-1]


def choose_topics(
    bag: Bag,
    named: Mapping[str, str],
    cameras: Sequence[str] | None = None,
    drive: Iterable[Bag] | None = None,
    *,
    lidars: Sequence[str] = (),
) -> RigTopics:
    """The topics of the LiDAR and the cameras.

    Args:
        bag: the bag.
        named: the topic of ``lidar`` and those of cameras, where they are not left to be found; of
            a camera with that of its CameraInfo behind a comma, where several could be.
        cameras: names that are wanted; those named, or if none is all that have a CameraInfo.
        lidars: names of a rig's LiDARs if there are several, the base first.
        drive: the bag, and others whose CameraInfo serve where it has none; the bag alone if None.
    """
    bags = [*(drive or [bag])]
    parted = {name: topic.split(",") for name, topic in named.items()}
    for name, (topic, *info) in parted.items():
        for each, among in ((topic, [bag]), *((one, bags) for one in info)):
            if not any(one.has(each) for one in among):
                raise DatasetError(
                    f"{bag.path}: has no messages of {each} ({name}); {_listed(bag)}"
                )
    chosen = {
        name: parts for name, parts in parted.items() if name not in (LIDAR, ODOMETRY, *lidars)
    }
    wanted = list(chosen) if cameras is None else list(cameras)
    for name in set(chosen) - set(wanted):
        raise DatasetError(f"--topic {name}: the rig has no such camera, but {', '.join(wanted)}")
    infos = _Infos(bag, bags)
    found = _found_cameras(bag, infos)
    names = wanted or ([] if lidars else list(found))
    if set(names) - set(found):  # the rig has the lenses, the bag need not
        found = {**_found_cameras(bag, None), **found}
    if not names and not lidars:
        raise DatasetError(f"{bag.path}: {_why_no_camera(bag, infos)}")
    images, of_images, unclear = dict[str, str](), dict[str, str](), dict[str, str]()
    for name in names:
        image, *info = chosen.get(name) or [found.get(name, "")]
        if not image:
            raise DatasetError(
                f"{bag.path}: which topic has the images of camera {name!r}? {_listed(bag)}: name "
                f"it by --topic {quote(name)}=/TOPIC",
                camera=name,
            )
        images[name] = image
        possible, rivals = (info, ()) if info else (infos.of(image), infos.rivals(image))
        if len(possible) == 1 and not rivals:
            of_images[name] = possible[0]
        else:
            unclear[name] = _why_no_info(name, image, possible, rivals)
    of_cameras = images, of_images, unclear, tuple(_unused(bag, infos, images.values()))
    if lidars:
        base, *others = (named.get(name) or _topic_of_lidar(bag, name) for name in lidars)
        return RigTopics(base, *of_cameras, dict(zip(lidars[1:], others, strict=True)))
    return RigTopics(named.get(LIDAR) or _lidar_topic(bag), *of_cameras)


def _why_no_info(name: str, image: str, infos: Sequence[str], rivals: Sequence[str]) -> str:
    """Why no CameraInfo is an image's, and what to do."""
    if not infos:
        return f"{image} has no camera_info beside it; record it"
    also = f", which may be that of {', '.join(rivals)} too" if rivals else ""
    return (
        f"which camera_info is that of {image}? There is {', '.join(infos)}{also}; "
        f"name both: --topic {quote(name)}={image},/CAMERA_INFO"
    )


def _unused(bag: Bag, infos: _Infos, used: Iterable[str]) -> Iterable[str]:
    """A line for each image topic with a CameraInfo that no camera has."""
    taken = {*map(_words, used)}
    for each in bag.of_type(*_NOT_READ):
        if _NOT_READ[each.type].startswith("video"):
            yield f"{bag.path}: {each.name} is {_NOT_READ[each.type]}"
    for topic in _image_topics(bag):
        if _words(topic) not in taken and infos.of(topic):
            depth = _depth(bag, topic)
            why = f": it is {depth}, which is taken for depth" if depth else ""
            yield f"{bag.path}: {topic} has a camera_info and is not used{why}"


def _depth(bag: Bag, topic: str) -> str:
    """The encoding of a topic of depth images; empty for others."""
    message = bag.first(topic)
    encoding: str = getattr(message, "encoding", None) or message.format
    return encoding if is_depth(message) else ""


def _why_no_camera(bag: Bag, infos: _Infos) -> str:
    """Why no image topic belongs to a camera, and what to do."""
    for topic in _image_topics(bag):
        if infos.of(topic):  # so it is depth, by its encoding
            name = _short_names([_words(topic)])[_words(topic)]
            return (
                f"{topic} is {_depth(bag, topic)}, which is taken for depth; if it is the image of "
                f"a camera, name it by --topic {quote(name)}={topic}"
            )
    if not _image_topics(bag) and (found := _not_read(bag)):
        return found
    return (
        f"has no image topic with a camera_info beside it; {_listed(bag)}: calibrate with a rig "
        "that has the lenses (--rig)"
    )


def _not_read(bag: Bag, *, clouds: bool = False) -> str:
    """What the topics are that might have been read; empty if there are none."""
    found = [
        f"{each.name} ({each.count}) is {_NOT_READ[each.type]}"
        for each in bag.of_type(*_NOT_READ)
        if clouds != _NOT_READ[each.type].startswith("video")
    ]
    return found[0] if found else ""


def _topic_of_lidar(bag: Bag, name: str) -> str:
    """The topic of clouds that has the name of a LiDAR between its slashes."""
    clouds = [each.name for each in bag.of_type(*CLOUDS)]
    found = [topic for topic in clouds if name in topic.split("/")]
    if len(found) != 1:
        listed = ", ".join(clouds) or "none"
        raise DatasetError(
            f"{bag.path}: which topic has the clouds of LiDAR {name!r}? Those of clouds are "
            f"{listed}: name it by --topic {quote(name)}=/TOPIC"
        )
    return found[0]


def _lidar_topic(bag: Bag) -> str:
    found = bag.of_type(*CLOUDS)
    if len(found) == 1:
        return found[0].name
    if not found and (what := _not_read(bag, clouds=True)):
        raise DatasetError(f"{bag.path}: {what}")
    listed = ", ".join(f"{each.name} ({each.count})" for each in found)
    what = f"has {len(found)} topics of clouds: {listed}; name" if found else (
        "has no messages of PointCloud2 or of Livox; convert the driver's packets first, then name"
    )  # fmt: skip
    raise DatasetError(f"{bag.path}: {what} the LiDAR's by --topic lidar=/TOPIC")


def _found_cameras(bag: Bag, infos: _Infos | None) -> dict[str, str]:
    """The best image topic by camera; with ``infos`` only of cameras that have a CameraInfo."""
    best: dict[Words, str] = {}
    for topic in _image_topics(bag):
        if _words(topic) in best or (infos and not infos.of(topic)):
            continue
        if not _depth(bag, topic):
            best[_words(topic)] = topic
    in_space = Counter(map(_space, best.values()))
    named = {
        words if in_space[_space(topic)] > 1 else tuple(_space(topic).strip("/").split("/")): topic
        for words, topic in sorted(best.items())
    }
    names = _short_names(named)
    return {names[words]: topic for words, topic in named.items()}


def _image_topics(bag: Bag) -> list[str]:
    """Those of images, the best first."""
    return sorted((each.name for each in bag.of_type(IMAGE, COMPRESSED_IMAGE)), key=_rank)


class _Infos:
    """The CameraInfo topics of a drive, as far as they may be those of a bag's images."""

    def __init__(self, bag: Bag, drive: Iterable[Bag]) -> None:
        self._images = [each.name for each in bag.of_type(IMAGE, COMPRESSED_IMAGE)]
        self._bags = [[each.name for each in one.of_type(CAMERA_INFO)] for one in drive]

    def of(self, image: str) -> tuple[str, ...]:
        """Those of an image: with its words; else in its namespace, and of no other image."""
        for infos in self._bags:
            same = [info for info in infos if _words(info) == _words(image)]
            near = [info for info in infos if _space(info) == _space(image)]
            others = {_words(each) for each in self._images} - {_words(image)}
            free = [info for info in near if _words(info) not in others]
            apart = {info: len({*_own(info)} ^ {*_own(image)}) for info in free}
            sharing = [info for info in free if {*_own(info)} & {*_own(image)}]
            least = min((apart[info] for info in sharing), default=0)
            shared = [info for info in sharing if apart[info] == least]
            if same or shared or free:
                return tuple(same or shared or free)
        return ()

    def rivals(self, image: str) -> tuple[str, ...]:
        """Other images that may have the same CameraInfo."""
        others = (each for each in self._images if _words(each) != _words(image))
        return tuple(each for each in others if {*self.of(each)} & {*self.of(image)})


def _base(topic: str) -> str:
    """The topic without the transport's name: /front/image_raw of /front/image_raw/compressed."""
    return topic.removesuffix("/compressed")


def _space(topic: str) -> str:
    return _base(topic).rpartition("/")[0]


def _own(topic: str) -> list[str]:
    """The words of a topic's last part that are none of a form: of /cams/image_left, left."""
    last = _base(topic).rsplit("/", 1)[-1]
    parts = [part for part in last.split("_") if part]
    found = [word for part in parts if (word := _FORM.sub("", part, count=1))]
    forms = len(found) < len(parts)
    return [word for word in found if not (forms and word in ("camera", "cam"))]


def _words(topic: str) -> Words:
    """What distinguishes a camera: its namespace, and its own words in the topic's last part."""
    space = _space(topic).strip("/").split("/")
    own = "_".join(_own(topic))
    if not own and space[-1].startswith("image") and not _own(space[-1]):
        space.pop()  # of /left/image_raw/camera_info
    return tuple(word for word in (*space, own) if word)


def _rank(topic: str) -> tuple[int, int, str]:
    """Images as recorded before rectified ones, without loss before compressed."""
    last = _base(topic).rsplit("/", 1)[-1]
    place = _BEST_FIRST.index(last) if last in _BEST_FIRST else len(_BEST_FIRST)
    return place, int(_base(topic) != topic), topic


def _short_names(cameras: Iterable[Words]) -> dict[Words, str]:
    """The last words of each camera, as many for all as make them differ; joined by _."""
    words = list(cameras)
    for count in range(1, 1 + max((len(each) for each in words), default=0) or 2):
        names = {each: "_".join(each[-count:]) for each in words}
        if names and max(Counter(names.values()).values()) == 1:
            return {each: name or "camera" for each, name in names.items()}
    return {}


def _listed(bag: Bag) -> str:
    found = bag.of_type(IMAGE, COMPRESSED_IMAGE, *CLOUDS)
    if not found:
        types = Counter(each.type for each in bag.topics.values())
        return f"it has neither images nor PointCloud2, but {', '.join(sorted(types)) or 'nothing'}"
    return "it has " + ", ".join(f"{each.name} ({each.count})" for each in found)
