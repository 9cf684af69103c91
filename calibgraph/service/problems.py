"""Errors as answers: problem+json (RFC 9457), with one line of what to do; schemas for OpenAPI."""

import errno
import logging
import secrets
from collections.abc import Iterable, Mapping
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from calibgraph.errors import CalibrationError

log = logging.getLogger("calibgraph.service")

MEDIA_TYPE = "application/problem+json"
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


class ProblemDetails(BaseModel):
    """What an answer with a problem holds.

    Attributes:
        type: ``about:blank``: the status names the kind of problem.
        detail: what is wrong, and what to do, in one line.
    """

    type: str = "about:blank"
    title: str
    status: int
    detail: str


class Problem(Exception):
    """An answer that refuses a request; its detail states in one line what to do."""

    def __init__(self, status: int, detail: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status, self.detail, self.headers = status, detail, dict(headers or {})


def problem_response(
    status: int, detail: str, headers: Mapping[str, str] | None = None
) -> Response:
    """An answer with a problem."""
    line = str(CalibrationError(detail))
    details = ProblemDetails(title=HTTPStatus(status).phrase, status=status, detail=line)
    return JSONResponse(details.model_dump(), status, dict(headers or {}), MEDIA_TYPE)


def documented(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The problems that a route may answer with, for OpenAPI."""
    content = {MEDIA_TYPE: {"schema": reference(ProblemDetails)}}
    return {
        status: {"description": HTTPStatus(status).phrase, "content": content}
        for status in sorted({400, 401, 403, 500, 503, *statuses})
    }


def add_problem_handlers(app: FastAPI) -> None:
    """Answer every error of an app with a problem."""

    @app.exception_handler(Problem)
    async def _problem(_: Request, error: Problem) -> Response:
        return problem_response(error.status, error.detail, error.headers)

    @app.exception_handler(CalibrationError)
    async def _bad_data(_: Request, error: CalibrationError) -> Response:
        return problem_response(422, str(error))

    @app.exception_handler(RequestValidationError)
    async def _bad_request(_: Request, error: RequestValidationError) -> Response:
        return problem_response(422, _first_problem(error))

    @app.exception_handler(HTTPException)
    async def _http(_: Request, error: HTTPException) -> Response:
        return problem_response(error.status_code, str(error.detail), error.headers)

    @app.exception_handler(OSError)
    async def _disk(request: Request, error: OSError) -> Response:
        if error.errno in _DISK_FULL:
            return problem_response(507, "the server's disk is full; try again later")
        return _unexpected(request, error)

    @app.exception_handler(SQLAlchemyError)
    async def _database(request: Request, error: SQLAlchemyError) -> Response:
        log.error("the database failed in %s %s: %s", request.method, request.url.path, error)
        if "disk is full" in str(error):
            return problem_response(507, "the server's disk is full; try again later")
        text = "the server's database cannot be used; try again later"
        return problem_response(503, text, {"Retry-After": "5"})

    @app.exception_handler(ClientDisconnect)
    async def _gone(_: Request, error: ClientDisconnect) -> Response:
        return problem_response(400, "the request broke off")

    @app.exception_handler(Exception)
    async def _other(request: Request, error: Exception) -> Response:
        return _unexpected(request, error)


def _unexpected(request: Request, error: Exception) -> Response:
    """An error that no one foresaw: the answer names the line of the log that has it."""
    number = secrets.token_hex(4)
    log.error("error %s in %s %s", number, request.method, request.url.path, exc_info=error)
    return problem_response(500, f"internal error {number}; the server's log has more")


def _first_problem(error: RequestValidationError) -> str:
    """The first thing that is wrong with a request."""
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"] if part != "body")
    message = str(first["msg"]).removeprefix("Value error, ")
    return f"{place}: {message}" if place else message


_PLACE = "#/components/schemas/{model}"


def reference(model: type[BaseModel]) -> dict[str, str]:
    """Where the schema of a model is, once :func:`add_schemas` has put it there."""
    return {"$ref": _PLACE.format(model=model.__name__)}


def add_schemas(app: FastAPI, models: Iterable[type[BaseModel]]) -> None:
    """Add models to the components of an app's description."""
    modes: list[tuple[type[BaseModel], Any]] = [(model, "validation") for model in models]
    describe = app.openapi

    def openapi() -> dict[str, Any]:
        is_new = app.openapi_schema is None
        description = describe()
        if is_new:
            _, found = models_json_schema(modes, ref_template=_PLACE)
            schemas = description.setdefault("components", {}).setdefault("schemas", {})
            schemas.update(found["$defs"])
        return description

    app.openapi = openapi  # type: ignore[method-assign]
