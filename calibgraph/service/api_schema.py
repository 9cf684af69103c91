"""Schemas of bodies that routes read by themselves, in the OpenAPI description."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from fastapi import FastAPI
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

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
