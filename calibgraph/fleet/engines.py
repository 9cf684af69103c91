"""Where jobs run: child processes here, a Ray cluster, or a Dask cluster.

An engine takes a task and gives a future. Queues, placement and lost machines are the cluster's
business; limits, retries and rows are the same for all.
"""

import logging
import queue
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, Protocol

from calibgraph.errors import CalibrationError, needs_extra
from calibgraph.fleet.child import Child, run_in_kept_child
from calibgraph.fleet.task import Outcome, Task
from calibgraph.parallel import count_cores


class Engine(Protocol):
    """Runs tasks, ``slots`` of them at once; a few more may be submitted."""

    slots: int

    def submit(self, task: Task) -> Future[Outcome]:
        """Start a task; the future has an exception if the worker was lost."""

    def has_workers(self) -> bool:
        """Whether anything is there that can run tasks."""

    def close(self) -> None:
        """Stop what runs, and release all."""


class ProcessEngine:
    """Child processes of this one: one per core if ``slots`` is None."""

    def __init__(self, slots: int | None = None) -> None:
        self.slots = slots or count_cores()
        self._children = [Child() for _ in range(self.slots)]
        self._free: queue.SimpleQueue[Child] = queue.SimpleQueue()
        for child in self._children:
            self._free.put(child)
        self._threads = ThreadPoolExecutor(self.slots)

    def submit(self, task: Task) -> Future[Outcome]:
        """Start a task as soon as a child is free."""
        return self._threads.submit(self._run, task)

    def _run(self, task: Task) -> Outcome:
        child = self._free.get()
        try:
            return child.run(task)
        finally:
            self._free.put(child)

    def has_workers(self) -> bool:
        """Children that are lost are started again."""
        return True

    def close(self) -> None:
        """End all children."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        for child in self._children:
            child.interrupt()
        self._threads.shutdown()
        for child in self._children:
            child.close()


class RayEngine:
    """Tasks of a Ray cluster, or of a local one; each reserves ``memory_bytes``."""

    def __init__(
        self, address: str = "", slots: int | None = None, memory_bytes: int | None = None
    ) -> None:
        ray = _require("ray")
        options = {"address": address} if address else {"num_cpus": slots or count_cores()}
        self._owns = not ray.is_initialized()
        if self._owns:
            try:
                ray.init(log_to_driver=False, include_dashboard=False, configure_logging=False,
                         **options)  # fmt: skip
            except Exception as error:  # Ray has no class of its own for it
                raise CalibrationError(f"--engine ray:{address}: no cluster ({error})") from error
        self._ray = ray
        self.slots = slots or int(ray.cluster_resources().get("CPU", 1))
        self._memory_bytes = memory_bytes or 0
        if not address and not self.has_workers():
            self.close()
            raise CalibrationError(
                f"--memory-gb {self._memory_bytes / 1e9:g}: this machine has less for jobs; give "
                "less, or leave it out"
            )
        reserve = {"memory": memory_bytes} if memory_bytes else {}
        # Retries are the run's, so that they are counted alike with every engine.
        self._run = ray.remote(num_cpus=1, max_retries=0, **reserve)(run_in_kept_child)

    def submit(self, task: Task) -> Future[Outcome]:
        """Give a task to the cluster."""
        future: Future[Outcome] = self._run.remote(task).future()
        return future

    def has_workers(self) -> bool:
        """Whether a machine of the cluster is alive, and has what a task reserves."""
        return any(
            node["Alive"]
            and node["Resources"].get("CPU", 0) >= 1
            and node["Resources"].get("memory", 0) >= self._memory_bytes
            for node in self._ray.nodes()
        )

    def close(self) -> None:
        """Leave the cluster, which ends the tasks that run."""
        if self._owns:
            self._ray.shutdown()


class DaskEngine:
    """Tasks of a Dask cluster, or of a local one of one-threaded processes."""

    def __init__(self, address: str = "", slots: int | None = None) -> None:
        distributed = _require("distributed", "dask")
        self._cluster = None
        # Else a local cluster gives up a worker that is not there again 15 s after it was lost.
        self._settings = _require("dask").config.set(
            {"distributed.deploy.lost-worker-timeout": "365 days"}
        )
        try:
            if not address:
                self._cluster = distributed.LocalCluster(
                    n_workers=slots or count_cores(), threads_per_worker=1, dashboard_address=None,
                    silence_logs=logging.ERROR,
                )  # fmt: skip
            self._client = distributed.Client(self._cluster or address, timeout="30s")
        except Exception as error:  # of its communication and of its processes
            raise CalibrationError(f"--engine dask:{address}: no scheduler ({error})") from error
        self._pool = self._client.get_executor(pure=False, retries=0)
        self.slots = slots or sum(self._client.nthreads().values()) or 1

    def submit(self, task: Task) -> Future[Outcome]:
        """Give a task to the cluster."""
        future: Future[Outcome] = self._pool.submit(run_in_kept_child, task)
        return future

    def has_workers(self) -> bool:
        """Whether the scheduler is there and knows of any worker."""
        try:
            return bool(self._client.nthreads())
        except Exception:  # of its communication
            return False

    def close(self) -> None:
        """Cancel the tasks that run, and leave the cluster."""
        with suppress(Exception):  # of a cluster that has gone
            self._pool.shutdown(wait=False, cancel_futures=True)
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()
        self._settings.__exit__(None, None, None)


def open_engine(name: str, slots: int | None = None, memory_bytes: int | None = None) -> Engine:
    """The engine of a name: ``processes``, ``ray`` or ``dask``, with ``:ADDRESS`` of a cluster.

    Raises:
        CalibrationError: if there is none, its package is missing, or its cluster is not there.
    """
    kind, _, address = name.partition(":")
    if kind == "ray":
        return RayEngine(address, slots, memory_bytes)
    if kind == "dask":
        return DaskEngine(address, slots)
    if name == "processes":
        return ProcessEngine(slots)
    raise CalibrationError(
        f"--engine {name}: known are processes, ray, ray:ADDRESS, dask and dask:ADDRESS"
    )


def _require(module: str, extra: str = "") -> Any:
    """An optional package."""
    from importlib import import_module

    name = extra or module
    with needs_extra(name, f"--engine {name} needs {module}"):
        found = import_module(module)
    return found
