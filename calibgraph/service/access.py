"""Who may call: bearer tokens with scopes; only their hashes are kept."""

import hashlib
import hmac
import secrets
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from fastapi import Depends, Request
from fastapi.security import HTTPBearer
from fastapi.security.http import HTTPAuthorizationCredentials
from pydantic import BaseModel, ConfigDict, StringConstraints

from calibgraph.files import checked_model, load_model, write_yaml
from calibgraph.service.problems import Problem

Scope = Literal["read", "submit", "admin"]
SCOPES: tuple[Scope, ...] = ("read", "submit", "admin")
"""Each includes those before it."""

COOKIE = "calibgraph_token"
"""Of the pages for people: the browser's copy of the token."""

ANYONE = "local"
"""The tenant of a server without a token file."""

_FIRST_LINE = "# Written by calibgraph token: hashes of the tokens that may call the service."
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]


class Token(BaseModel):
    """A token that may call; it sees its tenant's jobs, with scope admin all."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    tenant: Name
    scope: Scope
    sha256: Annotated[str, StringConstraints(pattern="^[0-9a-f]{64}$")]


class TokenFile(BaseModel):
    """The content of a token file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    tokens: tuple[Token, ...] = ()


@dataclass(frozen=True)
class Caller:
    """Who calls: whose jobs are meant, and what the call may do."""

    tenant: str
    scope: Scope

    def may(self, scope: Scope) -> bool:
        """Whether the call may do what needs a scope."""
        return SCOPES.index(self.scope) >= SCOPES.index(scope)

    def sees(self, tenant: str) -> bool:
        """Whether what belongs to a tenant is there for this caller."""
        return self.scope == "admin" or hmac.compare_digest(self.tenant, tenant)


def load_tokens(path: Path) -> tuple[Token, ...]:
    """The tokens of a file."""
    return load_model(TokenFile, path).tokens


def add_token(path: Path, tenant: str, scope: Scope) -> str:
    """Make a token, which is kept nowhere, and add its hash to a file, which is made if missing."""
    known = load_tokens(path) if path.exists() else ()
    secret = secrets.token_urlsafe(32)
    token = {"tenant": tenant, "scope": scope, "sha256": _hash(secret)}
    content = {"tokens": [*(t.model_dump() for t in known), token]}
    checked_model(TokenFile, content, path)
    write_yaml(path, content, first_line=_FIRST_LINE)
    path.chmod(0o600)
    return secret


def _hash(token: str) -> str:
    """SHA-256: a token is 256 random bits, which no one finds by trying."""
    return hashlib.sha256(token.encode()).hexdigest()


class Gate:
    """Finds out who calls; without tokens (None) anyone may, as admin."""

    def __init__(self, tokens: tuple[Token, ...] | None) -> None:
        self._tokens = tokens

    @property
    def is_open(self) -> bool:
        """Whether anyone may call."""
        return self._tokens is None

    @property
    def tenants(self) -> set[str]:
        """Whose jobs there may be."""
        return {ANYONE} if self._tokens is None else {token.tenant for token in self._tokens}

    def caller(self, secret: str | None) -> Caller | None:
        """Who calls with a token; None if it is none of ours.

        The time that it takes is the same for all tokens: each is compared, each whole.
        """
        if self._tokens is None:
            return Caller(ANYONE, "admin")
        found, given = None, _hash(secret or "")
        for token in self._tokens:
            if hmac.compare_digest(token.sha256, given):
                found = Caller(token.tenant, token.scope)
        return found if secret else None


_bearer = HTTPBearer(auto_error=False, description="A token of `calibgraph token`.")
Credentials = Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]


def token_of(request: Request, credentials: HTTPAuthorizationCredentials | None) -> str | None:
    """The token of a request: of its header, or of the pages' cookie."""
    if credentials is not None:
        return credentials.credentials
    return request.cookies.get(COOKIE)


def require(scope: Scope) -> Callable[..., Awaitable[Caller]]:
    """A dependency of routes: who calls, if the call may do what needs a scope.

    The app's ``state.gate`` is the :class:`Gate`.
    """

    async def check(request: Request, credentials: Credentials) -> Caller:
        gate: Gate = request.app.state.gate
        caller = gate.caller(token_of(request, credentials))
        if caller is None:
            raise Problem(
                401,
                "give a token: Authorization: Bearer TOKEN",
                {"WWW-Authenticate": "Bearer"},
            )
        if not caller.may(scope):
            raise Problem(403, f"this needs a token of scope {scope}, found {caller.scope}")
        return caller

    return check


Reader = Annotated[Caller, Depends(require("read"))]
Submitter = Annotated[Caller, Depends(require("submit"))]
Admin = Annotated[Caller, Depends(require("admin"))]
