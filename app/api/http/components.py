"""Schemas of the OpenAPI document that FastAPI does not find by itself: parts of forms, and problem documents."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import TypeAdapter

Mode = Literal["validation", "serialization"]
_TEMPLATE = "#/components/schemas/{model}"
_MODELS: dict[str, tuple[Any, Mode]] = {}


def reference(model: Any, mode: Mode = "validation") -> dict[str, str]:
    """A reference to the schema of a model, which becomes part of the document."""
    _MODELS[model.__name__] = model, mode
    return {"$ref": _TEMPLATE.format(model=model.__name__)}


def with_reference(response: dict[str, Any]) -> dict[str, Any]:
    """A response of a route whose `model`, if it is a class, is a reference: FastAPI would make its schema at once."""
    if not isinstance(response.get("model"), type):
        return response
    described = {name: value for name, value in response.items() if name != "model"}
    schema = reference(response["model"], "serialization")
    return {**described, "content": {**described.get("content", {}), "application/json": {"schema": schema}}}


def component_schemas() -> dict[str, Any]:
    """The schemas of all models that are referred to, and of the models within them, by name."""
    adapters = [(name, mode, TypeAdapter(model)) for name, (model, mode) in _MODELS.items()]
    _, schemas = TypeAdapter.json_schemas(adapters, ref_template=_TEMPLATE)
    found: dict[str, Any] = schemas["$defs"]
    return found
