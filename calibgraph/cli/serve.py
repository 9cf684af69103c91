"""The commands of the service: serve, token."""

from pathlib import Path
from typing import Annotated, TypeVar

import typer

from calibgraph.cli.arguments import require_service
from calibgraph.cli.terminal import print_plain, terminal
from calibgraph.errors import CalibrationError

Word = TypeVar("Word", bound=str)
_GB = 10**9


def serve(
    data: Path = Path("calibgraph-service"),
    host: str = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535)] = 8080,
    tokens: Path | None = None,
    host_name: list[str] | None = None,
    root: list[str] | None = None,
    database: str | None = None,
    jobs: Annotated[int | None, typer.Option(min=0)] = None,
    jobs_per_tenant: Annotated[int | None, typer.Option(min=1)] = None,
    queue: Annotated[int, typer.Option(min=0)] = 1000,
    timeout_s: Annotated[float, typer.Option(min=0.001)] = 3600.0,
    memory_gb: Annotated[float, typer.Option(min=0.1)] = 8.0,
    upload_gb: Annotated[float, typer.Option(min=0.001)] = 20.0,
    fetch_gb: Annotated[float, typer.Option(min=0.001)] = 50.0,
    free_gb: Annotated[float, typer.Option(min=0.0)] = 1.0,
    keep_days: Annotated[float, typer.Option(min=0.001)] = 30.0,
    tracker_processes: Annotated[int, typer.Option(min=0)] = 2,
    trackers: Annotated[int, typer.Option(min=0)] = 200,
    api_docs: str = "token",
    grace_s: Annotated[float, typer.Option(min=0.001)] = 10.0,
    certificate: Path | None = None,
    key: Path | None = None,
) -> None:
    """Calibrate, check and track for others, over HTTP, until stopped.

    Ctrl-C and SIGTERM lose nothing: jobs that run wait for the next start, as after a crash.

    Args:
        data (DIR): Folder for jobs, results and trackers.
        host: Address to listen on.
        port: Port to listen on.
        tokens (FILE): Who may call, see calibgraph token. (default: anyone on this machine)
        host_name (NAME): Name the server is called by; may be repeated.
        root (URI): Folder that jobs may read from; may be repeated.
        database (URL): postgresql+psycopg://... (default: SQLite in DIR)
        jobs: Jobs at once. (default: one per core)
        jobs_per_tenant (N): Jobs at once of one tenant. (default: all but one, if there are several
            tenants)
        queue: Most jobs of a tenant that wait.
        timeout_s (SECONDS): Longest time of a job.
        memory_gb (GB): Most memory of a job.
        upload_gb (GB): Largest upload, unpacked too.
        fetch_gb (GB): Most bytes of a remote recording.
        free_gb (GB): With less on the disk, refuse jobs.
        keep_days (DAYS): How long results are kept.
        tracker_processes: Processes that hold the trackers.
        trackers: Most trackers of a tenant.
        api_docs (token|open|off): Who may read /docs and /openapi.json: whoever has a token,
            anyone, no one.
        grace_s (SECONDS): For running jobs, at the end.
        certificate (FILE): TLS certificate chain, PEM.
        key (FILE): Its private key.
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
    file: Path,
    tenant: Annotated[str, typer.Option()],
    scope: str = "submit",
) -> None:
    """Make a token for the service and print it: the file keeps its hash only.

    Args:
        file (FILE): Token file; made if it is not there.
        tenant (NAME): Whose jobs the token sees.
        scope (read|submit|admin): Look; ask and cancel too; or all of it, of all tenants.
    """
    from calibgraph.service.access import SCOPES, add_token

    print(add_token(file, tenant, _one_of(SCOPES, "--scope", scope)))
    print_plain(terminal(), f"{file}: a token of {tenant} with scope {scope} was added")


def _one_of(known: tuple[Word, ...], option: str, word: str) -> Word:
    """The word that an option gives."""
    for each in known:
        if word == each:
            return each
    raise CalibrationError(f"{option} {word}: known are {', '.join(known)}")
