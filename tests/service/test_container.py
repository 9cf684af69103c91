"""The steps of the Containerfile without an engine: a user without rights, a read-only root."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import pytest

from calibgraph.service.access import add_token
from tests.conftest import ROOT
from tests.service.conftest import Problem, bearer

USER = 10001
TEXT = (ROOT / "Containerfile").read_text()

# $1 interpreter's folder, $2 data, $3 size of the disk; then the command.
SCRIPT = f"""
set -e
base=$1 data=$2 size=$3; shift 3
mount --make-rprivate /
mount -t tmpfs -o "size=$size,mode=0700,uid={USER},gid={USER}" tmpfs "$data"
mkdir -m 1777 "$data/tmp"; chown {USER} "$data/tmp"
case "$base" in /root/*)  # no other user could run it there
    held=$(mktemp -d); mount --bind "$base" "$held"
    mount -t tmpfs -o mode=0755 tmpfs /root; mkdir -p "$base"; mount --bind "$held" "$base";;
esac
mount -o remount,bind,ro /
exec setpriv --reuid {USER} --regid {USER} --clear-groups --no-new-privs \\
    --bounding-set=-all --inh-caps=-all "$@"
"""


def can_mount() -> bool:
    """Whether this user may make a mount namespace, as an engine does."""
    if os.geteuid() != 0 or shutil.which("unshare") is None or shutil.which("setpriv") is None:
        return False
    probe = ["unshare", "-m", "mount", "--make-rprivate", "/"]
    return subprocess.run(probe, capture_output=True, check=False).returncode == 0


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not can_mount(), reason="needs the right to mount"),
]


def environment(data: Path) -> dict[str, str]:
    """The variables of the file, with a folder here for /data."""
    lines = re.search(r"^ENV ((?:.*\\\n)*.*)$", TEXT, re.MULTILINE)
    assert lines is not None
    found = dict(pair.split("=", 1) for pair in lines[1].replace("\\\n", " ").split())
    here = {name: value.replace("/data", str(data)) for name, value in found.items()}
    return {**here, "PATH": os.environ["PATH"], "TMPDIR": f"{data}/tmp", "PYTHONPATH": str(ROOT)}


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that other users can reach, as pytest's own cannot be."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


@contextmanager
def contained(
    folder: Path, size: str, options: Mapping[str, str]
) -> Iterator[tuple[httpx.Client, Path]]:
    """The entry point of the file in a namespace: a client, and the log."""
    data, log = folder / "data", folder / "log"
    data.mkdir()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [
        "unshare", "-m", "--fork", "--kill-child", "bash", "-c", SCRIPT, "serve",
        sys.base_prefix, str(data), size, sys.executable, "-m", "calibgraph", "serve",
        "--data", f"{data}/service", "--port", str(port), "--jobs", "1",
        *(word for option in options.items() for word in option),
    ]  # fmt: skip
    with log.open("wb") as file:
        process = subprocess.Popen(
            command, env=environment(data), stdout=file, stderr=file, start_new_session=True
        )
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=120) as client:
        try:
            wait_until_ready(client, log)
            yield client, log
        finally:
            os.killpg(process.pid, signal.SIGKILL)  # a change of user ends --kill-child
            process.wait()


def wait_until_ready(client: httpx.Client, log: Path) -> None:
    end = time.monotonic() + 120
    while time.monotonic() < end:
        with suppress(httpx.HTTPError):
            if client.get("/healthz").status_code == 200:
                return
        time.sleep(0.1)
    raise AssertionError(log.read_text())


def test_a_solve_succeeds_on_a_read_only_root(open_folder: Path, small: Problem) -> None:
    tokens = open_folder / "tokens.txt"
    headers = bearer(add_token(tokens, "submit"))
    tokens.chmod(0o644)
    options = {"--tokens": str(tokens), "--host": "0.0.0.0", "--free-gb": "0"}
    with contained(open_folder, "800m", options) as (client, log):
        client.headers.update(headers)
        at = client.post("/v1/jobs/solve", files=small.files).headers["location"]
        assert finished(client, at)["state"] == "succeeded", log.read_text()
        assert client.get(f"{at}/files.zip").content.startswith(b"PK")
        server = processes_of(USER)
        assert server
        for status in server:
            assert re.search(r"^CapEff:\s+0+$", status, re.MULTILINE)
            assert re.search(r"^NoNewPrivs:\s+1$", status, re.MULTILINE)


def finished(client: httpx.Client, at: str) -> dict[str, object]:
    """A job with its final state: the first one compiles the kernels."""
    for _ in range(5):
        job: dict[str, object] = client.get(at, params={"wait_s": 60}).json()
        if job["finished"]:
            break
    return job


def processes_of(user: int) -> list[str]:
    """What the system has of the processes of a user."""
    found = []
    for path in Path("/proc").glob("[0-9]*/status"):
        with suppress(OSError):
            text = path.read_text()
            if re.search(rf"^Uid:\s+{user}\s", text, re.MULTILINE):
                found.append(text)
    return found


def test_a_disk_that_fills_keeps_what_was_acknowledged(open_folder: Path, small: Problem) -> None:
    # The compiled kernels take 10 MB of it; the solves do not run before all is taken in.
    options = {"--free-gb": "0", "--jobs": "0"}
    big = {**small.files, "correspondences": small.table + bytes(1_000_000)}
    with contained(open_folder, "30m", options) as (client, log):
        answers = [client.post("/v1/jobs/solve", files=big) for _ in range(60)]
        statuses = {answer.status_code for answer in answers}
        assert statuses == {202, 507}, log.read_text()
        ids = [answer.json()["id"] for answer in answers if answer.status_code == 202]
        listed = client.get("/v1/jobs", params={"limit": 500}).json()["jobs"]
        assert [job["id"] for job in listed] == ids[::-1]
        for id in ids[: len(ids) // 2]:
            assert client.delete(f"/v1/jobs/{id}").status_code in (200, 507)
