"""The OpenAPI description against the server: schemathesis finds no 5xx, nothing undocumented."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from calibgraph.service.settings import Settings
from tests.service.ports import on_a_port

SCHEMATHESIS = shutil.which("schemathesis", path=Path(sys.executable).parent)
CHECKS = (
    "not_a_server_error", "status_code_conformance", "content_type_conformance",
    "response_headers_conformance", "response_schema_conformance",
)  # fmt: skip
HOOKS = """
import schemathesis

@schemathesis.serializer("application/x-ndjson")
def as_bytes(context, value):
    return value if isinstance(value, bytes) else str(value).encode()
"""


@pytest.mark.slow
@pytest.mark.skipif(SCHEMATHESIS is None, reason="no schemathesis: pip install schemathesis")
def test_every_answer_is_documented(tmp_path: Path) -> None:
    (tmp_path / "hooks.py").write_text(HOOKS)
    settings = Settings(data=tmp_path / "data", jobs_at_once=1, tracker_processes=1, free_bytes=0)
    with on_a_port(settings) as (host, port, _):
        done = subprocess.run(
            [
                str(SCHEMATHESIS), "run", f"http://{host}:{port}/openapi.json", "--no-color",
                "--checks", ",".join(CHECKS), "--max-examples", "30", "--seed", "1",
                "--phases", "examples,coverage,fuzzing", "--request-timeout", "120",
            ],
            cwd=tmp_path, capture_output=True, text=True, check=False,
            env={**os.environ, "SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": str(tmp_path)},
        )  # fmt: skip
    assert done.returncode == 0, done.stdout
