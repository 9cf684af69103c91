"""Who may call: tokens with a scope; the token file holds their hashes alone."""

import hashlib
import re
import secrets
from base64 import b64decode
from contextlib import suppress
from pathlib import Path
from typing import Literal, get_args

from calibgraph.errors import FileError
from calibgraph.files import read_text, write_text
from calibgraph.service.problems import Problem

Scope = Literal["read", "submit"]
SCOPES: tuple[Scope, ...] = get_args(Scope)
"""The second includes the first."""

Tokens = dict[str, Scope]
"""The scope of each token, by the token's SHA-256."""

_LINE = re.compile(f"({'|'.join(SCOPES)}) ([0-9a-f]{{64}})")
_REALM = 'Basic realm="calibgraph: any name, a token as the password"'


def load_tokens(path: Path) -> Tokens:
    """The tokens of a file: a line each, its scope and its hash."""
    found: Tokens = {}
    for number, line in enumerate(read_text(path).splitlines(), 1):
        match = _LINE.fullmatch(line.strip())
        if match is None:
            expected = "expected a scope and a hash, as calibgraph serve --new-token writes"
            raise FileError(path, f"line {number} is {line[:40]!r}, {expected}")
        found[match[2]] = SCOPES[SCOPES.index(match[1])]
    return found


def add_token(path: Path, scope: Scope) -> str:
    """Make a token, which is kept nowhere, and add its hash to a file, which is made if missing."""
    tokens, secret = load_tokens(path) if path.exists() else {}, secrets.token_urlsafe(32)
    tokens[_hash(secret)] = scope
    write_text(path, "".join(f"{each} {digest}\n" for digest, each in tokens.items()))
    path.chmod(0o600)
    return secret


def _hash(token: str) -> str:
    """SHA-256: a token is 256 random bits, which no one finds by trying, nor by taking the time."""
    return hashlib.sha256(token.encode()).hexdigest()


def require_scope(tokens: Tokens | None, authorization: str, needed: Scope) -> None:
    """Refuse a caller whose token, of Bearer or the password of Basic, lacks a scope."""
    if tokens is None:
        return
    scheme, _, given = authorization.partition(" ")
    if scheme.lower() == "basic":
        with suppress(ValueError):
            given = b64decode(given, validate=True).decode().partition(":")[2]
    scope = tokens.get(_hash(given.strip()))
    if scope is None:
        text = "give a token: Authorization: Bearer TOKEN"
        raise Problem(401, text, {"WWW-Authenticate": _REALM})
    if SCOPES.index(scope) < SCOPES.index(needed):
        raise Problem(403, f"this needs a token of scope {needed}, found {scope}")
