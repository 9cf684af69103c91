"""What is sent: files as they are, dataset folders as archives without compression."""

import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any

from calibgraph.errors import FileError
from calibgraph.io.dataset_folders import folder_layout

_BESIDE = ("rig.yaml", "calib.txt", "times.txt", "metadata.yaml")
_BAG_SUFFIXES = (".bag", ".mcap", ".db3")

Source = Path | str
"""A path of this machine, or a URI that the server reads."""

Field = tuple[str, tuple[str | None, Any]]
"""A part of a form: its name; the file's name (None: a text) and its content."""


def is_uri(source: Source) -> bool:
    """Whether the server reads it, and not this machine."""
    return isinstance(source, str) and "://" in source


@contextmanager
def form_of(
    inputs: Mapping[str, Sequence[Source]], texts: Mapping[str, str]
) -> Iterator[list[Field]]:
    """The parts of a form; its files are open in the body."""
    with ExitStack() as stack:
        fields: list[Field] = [(name, (None, text)) for name, text in texts.items()]
        for name, sources in inputs.items():
            for source in sources:
                fields.append((name, _part(stack, name, source)))
        yield fields


def _part(stack: ExitStack, name: str, source: Source) -> tuple[str | None, Any]:
    if is_uri(source):
        return None, str(source)
    path = Path(source)
    if path.is_dir() and name == "recording":
        return f"{name}.zip", stack.enter_context(_archive(path))
    try:
        return name, stack.enter_context(path.open("rb"))
    except OSError as error:
        raise FileError(path, f"cannot be read ({error.strerror}); check the path") from error


@contextmanager
def _archive(folder: Path) -> Iterator[IO[bytes]]:
    """An archive of what belongs to a dataset folder."""
    with tempfile.TemporaryFile() as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for path in files_of(folder):
                archive.write(path, path.relative_to(folder).as_posix())
        file.seek(0)
        yield file


def files_of(folder: Path) -> list[Path]:
    """The files of a dataset folder, a KITTI sequence or a ROS 2 bag."""
    layout = folder_layout(folder)
    found = [folder / name for name in _BESIDE if (folder / name).is_file()]
    for part in (layout.clouds, *layout.images.values()):
        found += [path for path in sorted(part.glob("*")) if path.is_file()]
    found += [path for path in sorted(folder.glob("*")) if path.suffix in _BAG_SUFFIXES]
    if not found:
        raise FileError(folder, "holds no dataset; see the formats of datasets")
    return found
