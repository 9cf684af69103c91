"""The versions that results depend on."""

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

_PACKAGES = ("calibgraph", "gtsam", "numpy", "numba", "opencv-python-headless", "scipy")


def package_versions() -> dict[str, str]:
    """Versions of this package and of the libraries that results depend on."""
    return {"python": platform.python_version()} | {name: version_of(name) for name in _PACKAGES}


@cache  # reading the metadata of a package takes a millisecond
def version_of(package: str) -> str:
    """The version of an installed package."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed as a package"
