"""The commands of the service: serve, token."""

from pathlib import Path
from typing import TypeVar

from typer import Argument, Option

from calibgraph.cli.arguments import require_service
from calibgraph.cli.terminal import print_plain, terminal
from calibgraph.errors import CalibrationError

Word = TypeVar("Word", bound=str)
_GB = 10**9


def serve(
    data: Path = Option(
        Path("calibgraph-service"), metavar="DIR", help="Folder for jobs, results and trackers."
    ),
    host: str = Option("127.0.0.1", help="Address to listen on."),
    port: int = Option(8080, min=0, max=65535, help="Port to listen on."),
    tokens: Path | None = Option(
        None,
        metavar="FILE",
        help="Who may call, see calibgraph token. (default: anyone on this machine)",
    ),
    host_name: list[str] | None = Option(
        None, metavar="NAME", help="Name the server is called by; may be repeated."
    ),
    root: list[str] | None = Option(
        None, metavar="URI", help="Folder that jobs may read from; may be repeated."
    ),
    database: str | None = Option(
        None, metavar="URL", help="postgresql+psycopg://... (default: SQLite in DIR)"
    ),
    jobs: int | None = Option(None, min=0, help="Jobs at once. (default: one per core)"),
    jobs_per_tenant: int | None = Option(
        None,
        min=1,
        metavar="N",
        help="Jobs at once of one tenant. (default: all but one, if there are several tenants)",
    ),
    queue: int = Option(1000, min=0, help="Most jobs of a tenant that wait."),
    timeout_s: float = Option(3600.0, min=0.001, metavar="SECONDS", help="Longest time of a job."),
    memory_gb: float = Option(8.0, min=0.1, metavar="GB", help="Most memory of a job."),
    upload_gb: float = Option(20.0, min=0.001, metavar="GB", help="Largest upload, unpacked too."),
    fetch_gb: float = Option(
        50.0, min=0.001, metavar="GB", help="Most bytes of a remote recording."
    ),
    free_gb: float = Option(1.0, min=0.0, metavar="GB", help="With less on the disk, refuse jobs."),
    keep_days: float = Option(30.0, min=0.001, metavar="DAYS", help="How long results are kept."),
    tracker_processes: int = Option(2, min=0, help="Processes that hold the trackers."),
    trackers: int = Option(200, min=0, help="Most trackers of a tenant."),
    api_docs: str = Option(
        "token",
        metavar="token|open|off",
        help="Who may read /docs and /openapi.json: whoever has a token, anyone, no one.",
    ),
    grace_s: float = Option(
        10.0, min=0.001, metavar="SECONDS", help="For running jobs, at the end."
    ),
    certificate: Path | None = Option(None, metavar="FILE", help="TLS certificate chain, PEM."),
    key: Path | None = Option(None, metavar="FILE", help="Its private key."),
) -> None:
    """Calibrate, check and track for others, over HTTP, until stopped.

    Ctrl-C and SIGTERM lose nothing: jobs that run wait for the next start, as after a crash.
    """
    require_service()
    from calibgraph.service.app import create_app
    from calibgraph.service.serve import Address, require_certificate, require_safe
    from calibgraph.service.serve import serve as serve_app
    from calibgraph.service.settings import DOCS, Settings

    address = Address(host, port, certificate, key)
    require_safe(address, has_tokens=tokens is not None)
    require_certificate(address)
    counted = {} if jobs is None else {"jobs_at_once": jobs}
    settings = Settings(
        data=data,
        database=database,
        tokens=tokens,
        hosts=tuple(host_name or ()),
        roots=tuple(root or ()),
        jobs_per_tenant=jobs_per_tenant,
        most_queued=queue,
        job_timeout_s=timeout_s,
        job_memory_bytes=int(memory_gb * _GB),
        upload_bytes=int(upload_gb * _GB),
        fetch_bytes=int(fetch_gb * _GB),
        free_bytes=int(free_gb * _GB),
        keep_s=keep_days * 86400,
        tracker_processes=tracker_processes,
        most_trackers=trackers,
        api_docs=_one_of(DOCS, "--api-docs", api_docs),
        grace_s=grace_s,
        **counted,
    )
    serve_app(create_app(settings), address, lambda url: _announce(url, tokens))


def _announce(url: str, tokens: Path | None) -> None:
    """Where the pages are, and whether they ask for a token."""
    if tokens is None:
        needed = "no token is needed, and no other machine can reach it"
    else:
        needed = (
            f"it asks for a token of {tokens}; calibgraph token {tokens} --tenant NAME makes one"
        )
    print_plain(terminal(), f"open {url} in a browser: {needed}")


def token(
    file: Path = Argument(..., metavar="FILE", help="Token file; made if it is not there."),
    tenant: str = Option(..., metavar="NAME", help="Whose jobs the token sees."),
    scope: str = Option(
        "submit",
        metavar="read|submit|admin",
        help="Look; ask and cancel too; or all of it, of all tenants.",
    ),
) -> None:
    """Make a token for the service and print it: the file keeps its hash only."""
    from calibgraph.service.access import SCOPES, add_token

    print(add_token(file, tenant, _one_of(SCOPES, "--scope", scope)))
    print_plain(terminal(), f"{file}: a token of {tenant} with scope {scope} was added")


def _one_of(known: tuple[Word, ...], option: str, word: str) -> Word:
    """The word that an option gives."""
    for each in known:
        if word == each:
            return each
    raise CalibrationError(f"{option} {word}: known are {', '.join(known)}")
