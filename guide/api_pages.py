"""Pages of the HTTP API, from its OpenAPI documents: that of all routes, and that which /ogc serves for GIS clients."""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any, NamedTuple

from app.api.http.problems import PROBLEMS
from app.api.http.routes import permissions_of
from app.api.ogc.documents import api_document
from app.main import ROUTERS, create_app
from app.services.access.access import Scope
from app.settings import Settings
from guide.markdown import code, menu, table
from guide.schema_text import (
    LinkTo,
    Schema,
    meaning_text,
    members_table,
    references,
    schema_section,
    type_text,
)

_FOLDER = "reference/api"
_SHARED = "schemas"
_OGC_DOCUMENT = "ogc-document"
_PERMISSIONS = permissions_of(route for router in ROUTERS for route in router.routes)


class Operation(NamedTuple):
    """One method of one path."""

    method: str
    path: str
    described: dict[str, Any]

    @property
    def route(self) -> str:
        """As in the table of permissions."""
        return f"{self.method.upper()} {self.path}"


def write_api_pages(folder: Path) -> list[tuple[str, str, str]]:
    """Write them; returns name, title and text of those that the index lists."""
    document = openapi_document()
    (folder / _FOLDER).mkdir(parents=True)
    tags = {tag["name"]: tag["description"] for tag in document["tags"]}
    operations: defaultdict[str, list[Operation]] = defaultdict(list)
    for operation in _list_operations(document):
        operations[operation.described["tags"][0]].append(operation)
    pages = _pages_of_schemas(document, operations)
    for tag, text in tags.items():
        own = sorted(name for name, page in pages.items() if page == tag)
        (folder / _FOLDER / f"{tag}.md").write_text(_tag_page(tag, text, operations[tag], own, pages, document))
    (folder / _FOLDER / f"{_SHARED}.md").write_text(_shared_page(pages, document))
    (folder / _FOLDER / f"{_OGC_DOCUMENT}.md").write_text(_ogc_page())
    (folder / _FOLDER / "index.md").write_text(_first_page(document, tags, operations))
    (folder / "reference" / "problems.md").write_text(_problems_page())
    return [
        (f"{_FOLDER}/index", "HTTP API", "every request, parameter, response and schema, from the OpenAPI documents"),
        ("reference/problems", "Problems", "the kinds of errors that the API returns"),
    ]


def openapi_document() -> dict[str, Any]:
    """The document at /openapi.json; it does not depend on settings."""
    with tempfile.TemporaryDirectory() as folder:
        return create_app(Settings(data_dir=Path(folder), warm_decoders=False)).openapi()


def _list_operations(document: dict[str, Any]) -> Iterator[Operation]:
    for path, methods in document["paths"].items():
        for method, described in methods.items():
            if method in ("get", "post", "put", "patch", "delete", "options", "head"):
                yield Operation(method, path, described)


def _pages_of_schemas(document: dict[str, Any], operations: dict[str, list[Operation]]) -> dict[str, str]:
    """The page of each schema: that of the tag whose operations alone use it, or the one of shared schemas."""
    schemas = document["components"]["schemas"]
    users: defaultdict[str, set[str]] = defaultdict(set)
    for tag, used in operations.items():
        waiting = list(references([operation.described for operation in used]))
        while waiting:
            name = waiting.pop()
            if tag not in users[name]:
                users[name].add(tag)
                waiting += references(schemas[name])
    return {name: next(iter(users[name])) if len(users[name]) == 1 else _SHARED for name in schemas}


def _link_from(page: str, pages: dict[str, str]) -> LinkTo:
    def link(name: str) -> str:
        file = "" if pages[name] == page else f"{pages[name]}.md"
        return f"[{code(name)}]({file}#{name.lower()})"

    return link


# --- pages ----------------------------------------------------------------------------------------------------------


def _first_page(document: dict[str, Any], tags: dict[str, str], operations: dict[str, list[Operation]]) -> str:
    rows = [(f"[{tag}]({tag}.md)", text, str(len(operations[tag]))) for tag, text in tags.items()]
    return (
        f"# HTTP API\n\n{document['info']['description']}\n"
        f"Version {document['info']['version']}. These pages are made from the document that the server sends at "
        "`/openapi.json`; a running server also shows it at `/docs`, where requests can be tried out. "
        "[A client can be generated from it](../../generated-client.md). The [scope](../../access.md) of a key "
        "determines which operations it may call.\n\n"
        + table(("part", "content", "operations"), rows)
        + f"[Schemas that several parts share]({_SHARED}.md). "
        + f"[The document of the OGC API]({_OGC_DOCUMENT}.md), which GIS clients read.\n\n"
        + menu([*tags, _SHARED, _OGC_DOCUMENT])
    )


def _tag_page(
    tag: str, text: str, operations: list[Operation], own: list[str], pages: dict[str, str], document: dict[str, Any]
) -> str:
    link = _link_from(tag, pages)
    parts = [f"# {tag[:1].upper()}{tag[1:]}\n\n{text}\n\n", *(_operation_section(each, link) for each in operations)]
    if own:
        schemas = document["components"]["schemas"]
        parts += ["## Schemas\n\n", *(schema_section(name, schemas[name], link) for name in own)]
    return "".join(parts)


def _shared_page(pages: dict[str, str], document: dict[str, Any]) -> str:
    link, schemas = _link_from(_SHARED, pages), document["components"]["schemas"]
    names = sorted(name for name, page in pages.items() if page == _SHARED)
    return "# Shared schemas\n\nThese schemas are used by several parts of the API.\n\n## Schemas\n\n" + "".join(
        schema_section(name, schemas[name], link) for name in names
    )


def _ogc_page() -> str:
    document = api_document("https://HOST/ogc")
    parameters = document["components"]["parameters"]
    text = (
        "# The document of the OGC API\n\n"
        "`GET /ogc/api` describes the same API for GIS clients in OpenAPI 3.0: each collection has a path of its own, "
        "and a parameter for each of its fields. [OGC API](../../ogc.md) explains how to use it; "
        "[ogc](ogc.md) lists the requests with their schemas.\n\n## Paths\n\n"
    )
    rows = []
    for operation in _list_operations(document):
        names = [code(_named(parameter, parameters)["name"]) for parameter in operation.described["parameters"]]
        kinds = operation.described["responses"]["200"]["content"]
        rows.append(
            (f"{code(operation.route)}", operation.described["summary"], ", ".join(names), ", ".join(map(code, kinds)))
        )
    text += table(("path below /ogc", "content", "parameters", "media type"), rows)
    link: LinkTo = code
    return text + "## Parameters\n\n" + _parameters_table(list(parameters.values()), link)


def _named(parameter: Schema, parameters: dict[str, Schema]) -> Schema:
    reference = parameter.get("$ref")
    return parameter if reference is None else parameters[reference.rpartition("/")[2]]


def _problems_page() -> str:
    rows = [
        (str(kind.status), code(kind.type), kind.title)
        for kind in sorted(set(PROBLEMS.values()), key=lambda kind: (kind.status, kind.slug))
    ]
    return (
        "# Problems\n\nThe response to an error is a problem document of RFC 9457, `application/problem+json`. "
        "`detail` states what is wrong; `field` names the input, `limit` gives the allowed values, `cure` the remedy; "
        "`errors` lists all faults of the request. The members are those of [`Problem`](api/schemas.md#problem).\n\n"
        + table(("status", "type", "title"), rows)
    )


# --- operations -----------------------------------------------------------------------------------------------------


def _operation_section(operation: Operation, link: LinkTo) -> str:
    described = operation.described
    return "".join(
        (
            f"## {code(operation.route)}\n\n",
            f"{described['summary']}.\n\n",
            f"{described['description']}\n\n" if described.get("description") else "",
            f"Key: {_scopes_text(operation)}\n\n",
            _titled("Parameters", _parameters_table(described.get("parameters", []), link)),
            _body_text(described.get("requestBody"), link),
            _responses_text(described["responses"], link),
        )
    )


def _titled(title: str, text: str) -> str:
    return f"**{title}**\n\n{text}" if text else ""


def _scopes_text(operation: Operation) -> str:
    allowed = _PERMISSIONS[operation.route.replace("HEAD", "GET")]
    if not allowed:
        return "none is required."
    if allowed == frozenset(Scope):
        return "any scope."
    return f"scope {', '.join(code(scope.value) for scope in Scope if scope in allowed)}."


def _parameters_table(parameters: list[Schema], link: LinkTo) -> str:
    rows = []
    for parameter in parameters:
        schema = parameter.get("schema", {})
        required = "yes" if parameter.get("required") else ""
        meaning = meaning_text(schema, parameter.get("description"))
        rows.append((code(parameter["name"]), parameter["in"], type_text(schema, link), required, meaning))
    return table(("name", "in", "type", "required", "meaning"), rows)


def _body_text(body: dict[str, Any] | None, link: LinkTo) -> str:
    if body is None:
        return ""
    text = "" if body.get("required") else "The body is optional.\n\n"
    for kind, content in body["content"].items():
        schema = content.get("schema", {})
        text += f"{code(kind)}: " + (
            f"a form\n\n{members_table(schema, link)}" if "properties" in schema else f"{type_text(schema, link)}\n\n"
        )
    return _titled("Body", text)


def _responses_text(responses: dict[str, Any], link: LinkTo) -> str:
    rows, problems = [], []
    for status, response in sorted(responses.items()):
        content = response.get("content", {})
        if "$ref" in response or "application/problem+json" in content:
            problems.append(status)
            continue
        kinds = "; ".join(f"{code(kind)} {type_text(each.get('schema', {}), link)}" for kind, each in content.items())
        rows.append((_status_text(status), response.get("description", ""), kinds, _headers_text(response)))
    text = _titled("Responses", table(("status", "meaning", "content", "headers"), rows))
    return text + (f"[Problems](../problems.md): {', '.join(problems)}\n\n" if problems else "")


def _status_text(status: str) -> str:
    return f"{status} {HTTPStatus(int(status)).phrase}" if status.isdigit() else status


def _headers_text(response: dict[str, Any]) -> str:
    return ", ".join(code(name) for name in response.get("headers", {}))
