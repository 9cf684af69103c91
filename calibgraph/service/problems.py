"""Errors as answers, with one line of what to do."""

import errno
import logging
import secrets
import sqlite3
from collections.abc import Mapping

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from calibgraph.errors import CalibrationError

log = logging.getLogger("calibgraph.service")


class Problem(HTTPException):
    """An answer that refuses a request; its detail states in one line what to do."""

    def __init__(self, status: int, detail: str, headers: Mapping[str, str] | None = None) -> None:
        again = {"Retry-After": "5"} if status in (429, 503) else {}
        super().__init__(status, str(CalibrationError(detail)), {**again, **(headers or {})})

    @property
    def response(self) -> Response:
        """The answer."""
        return JSONResponse({"detail": self.detail}, self.status_code, self.headers)


def add_problem_handlers(app: FastAPI) -> None:
    """Answer every error of an app with a problem."""

    async def answer(request: Request, error: Exception) -> Response:
        return _problem_of(request, error).response

    for kind in (CalibrationError, RequestValidationError, OSError, sqlite3.Error,
                 ClientDisconnect, Exception):  # fmt: skip
        app.add_exception_handler(kind, answer)


def _problem_of(request: Request, error: Exception) -> Problem:
    is_full = getattr(error, "errno", 0) in (errno.ENOSPC, errno.EDQUOT) or "disk is full" in str(
        error
    )
    found = Problem(500, f"internal error {secrets.token_hex(4)}; the server's log has more")
    match error:
        case CalibrationError():
            found = Problem(422, str(error))
        case RequestValidationError():
            first = error.errors()[0]
            found = Problem(422, f"{'.'.join(map(str, first['loc']))}: {first['msg']}")
        case ClientDisconnect():
            found = Problem(400, "the request broke off")
        case OSError() | sqlite3.Error() if is_full:
            found = Problem(507, "the server's disk is full; try again later")
        case sqlite3.Error():
            found = Problem(503, "the server's database cannot be used; try again later")
    if found.status_code in (500, 503):
        log.error("%s: %s", request.url.path, found.detail, exc_info=error)
    return found
