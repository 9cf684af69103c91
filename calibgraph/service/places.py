"""Where jobs may read: URIs inside roots that the server's owner allows."""

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from calibgraph.errors import FileError
from calibgraph.fleet.uris import is_local, locate


@dataclass(frozen=True)
class Root:
    """A folder from which jobs may read: its fsspec protocol, and its path without links."""

    protocol: str
    path: str

    def holds(self, place: "Root") -> bool:
        """Whether a place is this folder, or in it."""
        same = place.protocol == self.protocol
        return same and f"{place.path}/".startswith(f"{self.path.rstrip('/')}/")


def open_roots(uris: tuple[str, ...]) -> tuple[Root, ...]:
    """The roots of these URIs.

    Raises:
        FileError: if one is no URI that can be read, or a local folder that is not there.
    """
    if "" in uris:
        raise FileError("--root", "is empty; name a folder, or leave it out")
    return tuple(_place(uri) for uri in uris)


def require_inside(uri: str, roots: tuple[Root, ...]) -> None:
    """Check that a URI is inside the roots; links of local folders are followed first.

    Raises:
        FileError: if not. The message is the same whether or not anything is there.
    """
    outside = FileError(uri[:200], "is not inside the folders that this server reads from")
    if "::" in uri or not uri.isprintable() or ".." in unquote(uri).split("/"):
        raise outside
    if not any(uri.startswith(f"{root.protocol}:") for root in roots) and "://" in uri:
        raise outside  # before a store's client is loaded
    try:
        place = _place(uri)
    except (FileError, ValueError):
        raise outside from None
    if not any(root.holds(place) for root in roots):
        raise outside


def _place(uri: str) -> Root:
    """The place of a URI."""
    filesystem, path = locate(uri)
    if is_local(filesystem):
        try:
            return Root("file", str(Path(path).resolve(strict=True)))
        except (OSError, RuntimeError) as error:
            raise FileError(uri, "no such file or folder; check the path") from error
    return Root(uri.partition("://")[0], path.rstrip("/"))
