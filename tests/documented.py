"""Checks every response of the test servers against the OpenAPI document: status, media type and JSON body."""

from __future__ import annotations

import copy
import gzip
import re
from typing import Any

import jsonschema_rs
import orjson
from fastapi import FastAPI
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api.http.ui import PAGES

PROBLEM = "application/problem+json"
_PAGES = "|".join(re.sub(r"\{\w+\}", "[^/]+", page) for page in PAGES)
OUTSIDE = re.compile(rf"{_PAGES}|/(static(/.*)?|guide(/.*)?|docs(/.*)?|redoc|openapi\.json|metrics)?")
"""Paths that the document does not describe: files of the web pages and of the guide, the document itself, metrics."""
DEVIATIONS: list[str] = []
"""What was found since a test last looked."""


class CheckedResponses:
    """An ASGI app that records in `DEVIATIONS` how the responses of another one deviate from its document."""

    def __init__(self, app: FastAPI) -> None:
        self._app: ASGIApp = app
        self._document = _document_of(app)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http" or OUTSIDE.fullmatch(scope["path"]):
            await self._app(scope, receive, send)
            return
        status, media_type, body, is_compressed = 0, "", bytearray(), False

        async def send_checked(message: Message) -> None:
            nonlocal status, media_type, is_compressed
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = dict(message["headers"])
                is_compressed = headers.get(b"content-encoding") == b"gzip"
                media_type = headers.get(b"content-type", b"").decode("latin-1").partition(";")[0]
            elif message["type"] == "http.response.body":
                if _is_json(media_type) or not body:
                    body.extend(message.get("body", b""))
                if not message.get("more_body"):
                    plain = gzip.decompress(body) if is_compressed and _is_json(media_type) else bytes(body)
                    self._document.check(scope["method"], scope["path"], status, media_type, plain)
            await send(message)

        await self._app(scope, receive, send_checked)


def _is_json(media_type: str) -> bool:
    return media_type.endswith(("/json", "+json"))


class _Document:
    """The OpenAPI document of an app, with a validator for each response."""

    def __init__(self, document: dict[str, Any]) -> None:
        self._components = _closed(copy.deepcopy(document["components"]))
        self._paths = sorted(
            ((_pattern(template), template, operations) for template, operations in document["paths"].items()),
            key=lambda path: (path[1].count("{"), -len(path[1])),
        )
        self._validators: dict[str, jsonschema_rs.Validator] = {}

    def check(self, method: str, path: str, status: int, media_type: str, body: bytes) -> None:
        """Record what is not as documented."""
        for fault in self._faults(method, path, status, media_type, body):
            DEVIATIONS.append(f"{method} {path}: {status} {media_type}: {fault}")

    def _faults(self, method: str, path: str, status: int, media_type: str, body: bytes) -> list[str]:
        template, operation = self._operation(method, path)
        if method == "HEAD" and operation is None:  # of a route for GET
            template, operation = self._operation("GET", path)
        if method == "HEAD" and operation is not None and media_type != PROBLEM:
            return [] if str(status) in operation["responses"] else ["the status is not documented"]
        if operation is None:  # there is no such resource or method, and the server says so
            if path.startswith("/m/") and media_type == "text/html" and status >= 400:
                return []  # for people
            if media_type != PROBLEM:
                return ["no operation describes this"]
            return self._schema_faults("problem", {"$ref": "#/components/schemas/Problem"}, body)
        response = operation["responses"].get(str(status))
        if response is None:
            return [f"the status is not one of {', '.join(operation['responses'])}"]
        if "$ref" in response:  # a problem that many operations share
            response = self._components["responses"][response["$ref"].rpartition("/")[2]]
        content = response.get("content", {})
        if not content:
            return [f"no content is documented: {body[:80]!r}"] if body else []
        if media_type not in content:
            return [f"the media type is not one of {', '.join(content)}"]
        if not _is_json(media_type):
            return []
        return self._schema_faults(f"{method} {template} {status} {media_type}", content[media_type]["schema"], body)

    def _operation(self, method: str, path: str) -> tuple[str, dict[str, Any] | None]:
        for pattern, template, operations in self._paths:
            if method.lower() in operations and pattern.fullmatch(path):
                return template, operations[method.lower()]
        return "", None

    def _schema_faults(self, name: str, schema: dict[str, Any], body: bytes) -> list[str]:
        if name not in self._validators:
            root = {**_closed(copy.deepcopy(schema)), "components": self._components}
            self._validators[name] = jsonschema_rs.Draft202012Validator(root, validate_formats=True)
        faults = self._validators[name].iter_errors(orjson.loads(body))
        return [f"{'/'.join(map(str, fault.instance_path))}: {fault.message[:500]}" for fault in faults]


_DOCUMENTS: list[_Document] = []


def _document_of(app: FastAPI) -> _Document:
    """The document, made once: it does not depend on an app's settings, as tests/api/http/test_openapi.py shows."""
    if not _DOCUMENTS:
        _DOCUMENTS.append(_Document(app.openapi()))
    return _DOCUMENTS[0]


def _pattern(template: str) -> re.Pattern[str]:
    return re.compile("".join("[^/]+" if part.startswith("{") else re.escape(part) for part in _parts(template)))


def _parts(template: str) -> list[str]:
    return re.split(r"(\{\w+\})", template)


def _closed(schema: Any) -> Any:
    """A schema whose objects have no members but those that are described."""
    if isinstance(schema, dict):
        if "properties" in schema and schema.get("type") == "object":
            schema.setdefault("additionalProperties", False)
        for value in schema.values():
            _closed(value)
    elif isinstance(schema, list):
        for value in schema:
            _closed(value)
    return schema
