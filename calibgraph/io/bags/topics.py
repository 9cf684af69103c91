"""Which topics of a bag are the LiDAR and the cameras: as named, else by the types of messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from calibgraph.errors import DatasetError
from calibgraph.io.bags.messages import CAMERA_INFO, CLOUDS, COMPRESSED_IMAGE, IMAGE, Bag
from calibgraph.io.bags.options import LIDAR, ODOMETRY
from calibgraph.io.bags.pictures import is_depth

_BEST_FIRST = ("image_raw", "image", "image_color", "image_mono", "image_rect_color", "image_rect")


@dataclass(frozen=True)
class CameraTopics:
    """The topics of a camera."""

    image: str
    info: str | None

    @property
    def rectified(self) -> bool:
        """Whether the images are, by their name."""
        return "rect" in _base(self.image).rsplit("/", 1)[-1]


@dataclass(frozen=True)
class RigTopics:
    """The topics of a LiDAR and of cameras, by the cameras' names."""

    lidar: str
    cameras: Mapping[str, CameraTopics]


def choose_topics(
    bag: Bag,
    named: Mapping[str, str],
    cameras: Sequence[str] | None = None,
    drive: Iterable[Bag] | None = None,
) -> RigTopics:
    """The topics of the LiDAR and the cameras.

    Args:
        bag: the bag.
        named: the topic of ``lidar`` and those of cameras, where they are not left to be found.
        cameras: names that are wanted; those named, or if none is all that have a CameraInfo.
        drive: the bag, and others whose CameraInfo serve where it has none; the bag alone if None.

    Raises:
        DatasetError: if a topic is missing, or there are several to choose from.
    """
    for name, topic in named.items():
        if topic not in bag.topics or not bag.topics[topic].count:
            raise DatasetError(f"{bag.path}: has no messages of {topic} ({name}); {_listed(bag)}")
    chosen = {name: topic for name, topic in named.items() if name not in (LIDAR, ODOMETRY)}
    wanted = list(chosen) if cameras is None else list(cameras)
    for name in set(chosen) - set(wanted):
        raise DatasetError(f"--topic {name}: the rig has no such camera, but {', '.join(wanted)}")
    infos = _Infos(drive or [bag])
    found = _found_cameras(bag, infos)
    names = wanted or list(found)
    if set(names) - set(found):  # the rig has the lenses, the bag need not
        found = {**_found_cameras(bag, None), **found}
    if not names:
        raise DatasetError(f"{bag.path}: {_why_no_camera(bag, infos)}")
    images = {name: chosen.get(name) or found.get(name) for name in names}
    return RigTopics(
        lidar=named.get(LIDAR) or _lidar_topic(bag),
        cameras={name: _camera(bag, name, topic, infos) for name, topic in images.items()},
    )


def _why_no_camera(bag: Bag, infos: _Infos) -> str:
    """Why no image topic belongs to a camera, and what to do."""
    for topic in _image_topics(bag):
        if infos.beside(topic):  # so it is depth, by its encoding
            message = bag.first(topic)
            encoding = getattr(message, "encoding", None) or message.format
            name = _short_names([_namespace(topic)])[_namespace(topic)]
            return (
                f"{topic} is {encoding}, which is taken for depth; if it is the image of a camera, "
                f"name it by --topic {name}={topic}"
            )
    return (
        f"has no image topic with a camera_info beside it; {_listed(bag)}: give a rig with the "
        "lenses (--rig)"
    )


def _lidar_topic(bag: Bag) -> str:
    found = bag.of_type(*CLOUDS)
    if len(found) == 1:
        return found[0].name
    listed = ", ".join(f"{each.name} ({each.count})" for each in found)
    what = f"has {len(found)} topics of clouds: {listed}; name" if found else (
        "has no messages of PointCloud2 or of Livox; convert the driver's packets first, then name"
    )  # fmt: skip
    raise DatasetError(f"{bag.path}: {what} the LiDAR's by --topic lidar=/TOPIC")


def _camera(bag: Bag, name: str, topic: str | None, infos: _Infos) -> CameraTopics:
    if topic is None:
        raise DatasetError(
            f"{bag.path}: which topic has the images of camera {name!r}? {_listed(bag)}: name it "
            f"by --topic {name}=/TOPIC",
            camera=name,
        )
    return CameraTopics(topic, infos.beside(topic))


def _found_cameras(bag: Bag, infos: _Infos | None) -> dict[str, str]:
    """The best image topic by camera; with ``infos`` only of cameras that have a CameraInfo."""
    best: dict[str, str] = {}
    for topic in _image_topics(bag):
        if _namespace(topic) in best or (infos and infos.beside(topic) is None):
            continue
        if not is_depth(bag.first(topic)):
            best[_namespace(topic)] = topic
    names = _short_names(best)
    return {names[namespace]: best[namespace] for namespace in sorted(best)}


def _image_topics(bag: Bag) -> list[str]:
    """Those of images, the best first."""
    return sorted((each.name for each in bag.of_type(IMAGE, COMPRESSED_IMAGE)), key=_rank)


class _Infos:
    """The CameraInfo topics of some bags."""

    def __init__(self, bags: Iterable[Bag]) -> None:
        self._bags = bags

    def beside(self, image: str) -> str | None:
        """That beside an image topic, by ROS's convention in the same namespace."""
        places = (_namespace(image), _base(image))
        for bag in self._bags:
            for info in bag.of_type(CAMERA_INFO):
                if info.name.rsplit("/", 1)[0] in places:
                    return info.name
        return None


def _base(topic: str) -> str:
    """The topic without the transport's name: /front/image_raw of /front/image_raw/compressed."""
    return topic.removesuffix("/compressed")


def _namespace(topic: str) -> str:
    return _base(topic).rpartition("/")[0]


def _rank(topic: str) -> tuple[int, int, str]:
    """Images as recorded before rectified ones, without loss before compressed."""
    last = _base(topic).rsplit("/", 1)[-1]
    place = _BEST_FIRST.index(last) if last in _BEST_FIRST else len(_BEST_FIRST)
    return place, int(_base(topic) != topic), topic


def _short_names(namespaces: Iterable[str]) -> dict[str, str]:
    """The last words of each namespace, as many for all as make them differ; joined by _."""
    words = {namespace: namespace.strip("/").split("/") for namespace in namespaces}
    for count in range(1, 1 + max(map(len, words.values()), default=0)):
        names = {namespace: "_".join(parts[-count:]) for namespace, parts in words.items()}
        if max(Counter(names.values()).values()) == 1:
            return {namespace: name or "camera" for namespace, name in names.items()}
    return {}


def _listed(bag: Bag) -> str:
    """The topics of images and clouds, for errors."""
    found = bag.of_type(IMAGE, COMPRESSED_IMAGE, *CLOUDS)
    if not found:
        types = Counter(each.type for each in bag.topics.values())
        return f"it has neither images nor PointCloud2, but {', '.join(sorted(types)) or 'nothing'}"
    return "it has " + ", ".join(f"{each.name} ({each.count})" for each in found)
