"""Cache of the prepared clouds and gray images of the current frames."""

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path

from calibgraph.io.frame import Frame, ScanMotion
from calibgraph.matching.structure.pose_refinement import CameraFrames
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from calibgraph.matching.structure.prepared_image import Derived, PreparedImage
from calibgraph.memory import mmap_copy
from calibgraph.model.rig import Camera, Rig
from calibgraph.parallel import KeyedCache

MAX_IMAGE_BYTES, MAX_CLOUD_BYTES, MAX_DERIVED_BYTES = 1_500_000_000, 500_000_000, 1_300_000_000


class FrameCache:
    """Clouds and images, decoded once from round to round; and what is derived of them.

    Those used last are kept, up to so many bytes of each.
    """

    def __init__(self) -> None:
        self._clouds: KeyedCache[tuple[Path, ScanMotion | None], PreparedCloud]
        self._images: KeyedCache[tuple[Path, int, int], PreparedImage]
        self._clouds, self._images = KeyedCache(MAX_CLOUD_BYTES), KeyedCache(MAX_IMAGE_BYTES)
        self._derived: Derived = KeyedCache(MAX_DERIVED_BYTES)

    def keep_only(self, frames: Iterable[Frame]) -> None:
        """Drop all other frames: memory stays bounded along a drive."""
        kept = {path for f in frames for path in (f.cloud_path, *f.image_paths.values())}
        self._clouds.keep_only(lambda key: key[0] in kept)
        self._images.keep_only(lambda key: key[0] in kept)
        known = {cloud.identity for cloud in self._clouds.values()}
        known |= {image.identity for image in self._images.values()}
        self._derived.keep_only(lambda key: key[0] in known)

    def cloud(self, frame: Frame) -> PreparedCloud:
        """The frame's cloud."""
        return self._clouds.get(
            (frame.cloud_path, frame.motion),
            lambda: PreparedCloud.from_points(frame.load_cloud(), self._derived),
        )

    def image(self, frame: Frame, name: str, camera: Camera) -> PreparedImage:
        """The camera's image; its size is checked against the camera's."""
        key = (frame.image_paths[name], camera.width_px, camera.height_px)

        def load() -> PreparedImage:
            gray = frame.load_gray(name, camera)
            kept = gray if frame.kept else mmap_copy(gray)
            return PreparedImage.from_gray(kept, camera, self._derived)

        return self._images.get(key, load)


def cache_of(frames: Sequence[Frame], otherwise: FrameCache) -> FrameCache:
    """The cache that goes with kept frames, for all that score them; else, the given one."""
    if frames and frames[0].kept:
        return frames[0].derive_for_all("frame cache", FrameCache)
    return otherwise


def load_camera_frames(
    cache: FrameCache, frames: Sequence[Frame], rig: Rig, cores: Executor
) -> dict[str, CameraFrames]:
    """The images and clouds of frames for a search, by camera."""
    clouds = list(cores.map(cache.cloud, frames))
    return {
        name: CameraFrames(
            frames,
            list(cores.map(partial(cache.image, name=name, camera=camera), frames)),
            clouds,
            cores,
        )
        for name, camera in rig.cameras.items()
    }
