"""Numbers for Prometheus."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_REQUEST_S = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30)
_JOB_S = (0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30, 100, 300, 1000, 3000)


class Metrics:
    """The numbers of one server, in a registry of its own."""

    def __init__(self) -> None:
        self._registry = registry = CollectorRegistry()
        self._requests = Histogram(
            "calibgraph_request_seconds", "Requests", ["method", "route", "status"],
            buckets=_REQUEST_S, registry=registry,
        )  # fmt: skip
        self.jobs = Counter(
            "calibgraph_jobs", "Jobs that ended", ["kind", "state"], registry=registry
        )
        self.job_s = Histogram(
            "calibgraph_job_seconds", "Jobs", ["kind"], buckets=_JOB_S, registry=registry
        )
        self.queued = Gauge("calibgraph_jobs_queued", "Jobs that wait", registry=registry)
        self.running = Gauge("calibgraph_jobs_running", "Jobs that run", registry=registry)
        self.frames = Counter(
            "calibgraph_tracker_frames", "Frames that trackers took in", registry=registry
        )

    def observe_request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request."""
        known = method if method in _METHODS else "other"
        self._requests.labels(known, route, str(status)).observe(seconds)

    def text(self) -> bytes:
        """All numbers in Prometheus' format."""
        return generate_latest(self._registry)


_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
