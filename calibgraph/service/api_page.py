"""The API in words, from its OpenAPI description: a page that loads nothing from elsewhere."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

_METHODS = ("get", "post", "put", "delete")


def operations(description: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The operations of an OpenAPI description, for the page."""
    return list(_operations(description))


def schemas(description: Mapping[str, Any]) -> dict[str, str]:
    """The schemas that bodies and answers refer to, by their name."""
    found = description["components"]["schemas"]
    return {name: json.dumps(schema, indent=1) for name, schema in sorted(found.items())}


def _operations(description: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for path, item in description["paths"].items():
        for method in _METHODS:
            if method in item:
                yield _operation(method, path, item[method])


def _operation(method: str, path: str, operation: Mapping[str, Any]) -> dict[str, Any]:
    bodies = operation.get("requestBody", {}).get("content", {})
    return {
        "method": method.upper(),
        "path": path,
        "description": operation.get("description", "").replace("``", ""),
        "parameters": [_parameter(each) for each in operation.get("parameters", [])],
        "bodies": [
            {"media": media, "schema": json.dumps(body["schema"], indent=1)}
            for media, body in bodies.items()
        ],
        "answers": ", ".join(operation["responses"]),
    }


def _parameter(parameter: Mapping[str, Any]) -> dict[str, str]:
    return {
        "name": parameter["name"],
        "place": parameter["in"],
        "description": parameter.get("description", ""),
    }
