"""Who holds the files: this process, worker processes of this machine, or actors of Ray."""

from __future__ import annotations

import multiprocessing
import os
import resource
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from multiprocessing.connection import Connection
from threading import Lock
from typing import Any, Literal

from calibgraph.errors import CalibrationError
from calibgraph.fleet.sharded.shard import Shard
from calibgraph.model.config import Config
from calibgraph.model.rig import Rig
from calibgraph.parallel import count_cores

Engine = Literal["local", "processes", "ray"]
ENGINES: tuple[Engine, ...] = ("local", "processes", "ray")


class Holder:
    """Several files, and what is asked of them. An error is an answer: it has to travel."""

    def __init__(self, rig: Rig, paths: Sequence[str], config: Config) -> None:
        self._given, self._shards = (rig, paths, config), list[Shard]()

    def load(self) -> list[Any]:
        """Read the files."""
        rig, paths, config = self._given
        self._shards = [Shard(rig, path, config) for path in paths]
        return [shard.inventory() for shard in self._shards]

    def peak_bytes(self) -> list[Any]:
        """The most memory that this process has had, once per file."""
        kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return [1024 * kilobytes] * len(self._shards)

    def answer(self, method: str, each: Sequence[tuple[Any, ...]]) -> tuple[str, Any]:
        """Call a method of every file, with arguments of its own."""
        try:
            if method in ("load", "peak_bytes"):
                return "done", getattr(self, method)()
            pairs = zip(self._shards, each, strict=True)
            return "done", [getattr(shard, method)(*given) for shard, given in pairs]
        except CalibrationError as error:
            return "error", str(error)
        except MemoryError:
            return "error", "a worker has no memory left; take more workers on more machines"


Ask = Callable[[Sequence[tuple[str, Sequence[tuple[Any, ...]]]]], list[tuple[str, Any]]]
"""From a method and arguments for each holder to all of their answers."""


@dataclass(frozen=True)
class Workers:
    """The files of a table with those who hold them.

    Attributes:
        paths: of the files, in the order in which everything is summed.
        owners: per holder, the places of its files.
        ask: all holders at once.
    """

    paths: tuple[str, ...]
    owners: tuple[tuple[int, ...], ...]
    ask: Ask
    _lock: Lock

    def call(
        self, method: str, *arguments: Any, each: Sequence[tuple[Any, ...]] | None = None
    ) -> list[Any]:
        """Call a method of every file at once.

        Args:
            method: of ``Shard``.
            arguments: the same for all files, in front of those in ``each``.
            each: per file, further arguments.

        Returns:
            The results, in the order of the files.

        Raises:
            CalibrationError: the error of a file, or that a worker is gone.
        """
        own = each or [()] * len(self.paths)
        asked = [(method, [(*arguments, *own[place]) for place in places])
                 for places in self.owners]  # fmt: skip
        with self._lock:
            answers = self.ask(asked)
        results: list[Any] = [None] * len(self.paths)
        for places, (kind, answer) in zip(self.owners, answers, strict=True):
            if kind == "error":
                raise CalibrationError(answer)
            for place, result in zip(places, answer, strict=True):
                results[place] = result
        return results


@contextmanager
def start_workers(
    rig: Rig, paths: Sequence[str], config: Config, engine: Engine, count: int | None = None
) -> Iterator[Workers]:
    """Start workers for the files of a table, and stop them at the end.

    Args:
        rig: lenses and guess.
        paths: of the files; each worker reads its own.
        config: settings.
        engine: ``local``: this process; ``processes``: one per core; ``ray``: actors of the
            cluster that is configured (RAY_ADDRESS), or of a new local one.
        count: of workers; None: one per core, of the cluster with Ray. Ray has no more.

    Raises:
        CalibrationError: if the engine is not installed.
    """
    start = {"local": _in_process, "processes": _in_processes, "ray": _on_ray}[engine]
    with _cluster() if engine == "ray" else nullcontext(len(paths)) as most:
        cores = {"local": 1, "processes": count_cores(), "ray": most}[engine]
        count = max(1, min(len(paths), most, count or cores))
        owners = tuple(tuple(range(first, len(paths), count)) for first in range(count))
        given = [(rig, [paths[place] for place in places], config) for places in owners]
        with start(given) as ask:
            yield Workers(tuple(paths), owners, ask, Lock())


@contextmanager
def _in_process(given: Sequence[tuple[Any, ...]]) -> Iterator[Ask]:
    holders = [Holder(*arguments) for arguments in given]
    yield lambda asked: [
        holder.answer(*question) for holder, question in zip(holders, asked, strict=True)
    ]


@contextmanager
def _in_processes(given: Sequence[tuple[Any, ...]]) -> Iterator[Ask]:
    context = multiprocessing.get_context("spawn")
    pipes = [context.Pipe() for _ in given]
    workers = [context.Process(target=_serve, args=(theirs, arguments), daemon=True)
               for (_, theirs), arguments in zip(pipes, given, strict=True)]  # fmt: skip
    for worker in workers:
        worker.start()
    for _, theirs in pipes:
        theirs.close()
    ours = [pipe for pipe, _ in pipes]

    def ask(asked: Sequence[tuple[str, Sequence[tuple[Any, ...]]]]) -> list[tuple[str, Any]]:
        try:
            for pipe, question in zip(ours, asked, strict=True):
                pipe.send(question)
            return [pipe.recv() for pipe in ours]
        except (EOFError, OSError) as error:
            raise CalibrationError(_GONE) from error

    try:
        yield ask
    finally:
        for pipe in ours:
            pipe.close()
        for worker in workers:
            worker.join()


_GONE = (
    "a worker of the solve is gone, with the files that it held, perhaps for want of memory; "
    "solve again with more workers, or on more machines"
)


def _serve(pipe: Connection, given: tuple[Any, ...]) -> None:
    """Answer until the pipe is closed."""
    holder = Holder(*given)
    while True:
        try:
            question = pipe.recv()
        except EOFError:
            return
        pipe.send(holder.answer(*question))


@contextmanager
def _cluster() -> Iterator[int]:
    """A Ray cluster, and how many cores of it are free: more actors would wait for ever."""
    try:
        import ray
    except ImportError as error:
        raise CalibrationError(
            "the engine ray is not installed; pip install 'calibgraph[ray]'"
        ) from error
    ours = not ray.is_initialized()
    if ours:
        address = os.environ.get("RAY_ADDRESS")
        ray.init(address=address, include_dashboard=False, log_to_driver=False)
    try:
        free: Any = ray.available_resources
        yield int(free().get("CPU", 0))
    finally:
        if ours:
            ray.shutdown()


@contextmanager
def _on_ray(given: Sequence[tuple[Any, ...]]) -> Iterator[Ask]:
    import ray

    remote: Any = ray.remote(num_cpus=1)(Holder)
    actors: list[Any] = [remote.remote(*arguments) for arguments in given]

    def ask(asked: Sequence[tuple[str, Sequence[tuple[Any, ...]]]]) -> list[tuple[str, Any]]:
        try:
            pairs = zip(actors, asked, strict=True)
            return list(ray.get([actor.answer.remote(*question) for actor, question in pairs]))
        except ray.exceptions.RayError as error:
            raise CalibrationError(_GONE) from error

    try:
        yield ask
    finally:
        for actor in actors:
            ray.kill(actor)
