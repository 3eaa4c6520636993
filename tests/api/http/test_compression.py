"""Compression of responses: what is compressed, ETags, streams, and who pays."""

from __future__ import annotations

import asyncio
import gzip
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route

from app.api.http import compression
from app.api.http.compression import MIN_BYTES, Compressed, accepts_gzip
from app.services.request_work import working

TEXT = b'{"text": "waymark"}' * 20_000
TYPES = {"json": "application/json", "svg": "image/svg+xml", "png": "image/png", "zip": "application/zip"}


def versioned(request: Request) -> Response:
    """As `versioned_response`: an ETag, and 304 where the client has it."""
    headers = {"ETag": '"3"', "Seen": request.headers.get("if-match", "")}
    if request.headers.get("if-none-match") == '"3"':
        return Response(status_code=304, headers=headers)
    return Response(TEXT, headers=headers, media_type="application/json")


def streamed(_request: Request) -> Response:
    def parts() -> Iterator[bytes]:
        for at in range(0, len(TEXT), 1000):
            yield TEXT[at : at + 1000]

    return StreamingResponse(parts(), media_type="text/csv")


def of_type(request: Request) -> Response:
    size = int(request.query_params.get("size", len(TEXT)))
    status = int(request.query_params.get("status", 200))
    return Response(TEXT[:size], status, media_type=TYPES[request.path_params["name"]])


def encoded(_request: Request) -> Response:
    return Response(gzip.compress(TEXT), headers={"Content-Encoding": "gzip"}, media_type="application/json")


def openapi(_request: Request) -> Response:
    return Response(TEXT, media_type="application/json")


ROUTES = [
    Route("/versioned", versioned, methods=["GET", "POST"]),
    Route("/streamed", streamed),
    Route("/encoded", encoded),
    Route("/openapi.json", openapi),
    Route("/short", lambda _request: PlainTextResponse("short")),
    Route("/{name}", of_type, methods=["GET", "HEAD"]),
]
APP = Compressed(Starlette(routes=ROUTES))


def ask(path: str, method: str = "GET", **headers: str) -> httpx.Response:
    async def send() -> httpx.Response:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(APP), base_url="http://x") as client:
            names = {name.replace("_", "-"): value for name, value in headers.items()}
            return await client.request(method, path, headers=names)

    return asyncio.run(send())


@pytest.mark.parametrize("path", ["/versioned", "/streamed", "/json", "/svg"])
def test_texts_are_compressed_for_clients_that_accept_it(path: str) -> None:
    response = ask(path, accept_encoding="br, gzip")
    assert response.headers["content-encoding"] == "gzip"
    assert response.headers["vary"] == "Accept-Encoding"
    assert response.content == TEXT
    assert response.num_bytes_downloaded < len(TEXT) / 20
    plain = ask(path, accept_encoding="identity")
    assert "content-encoding" not in plain.headers
    assert plain.headers["vary"] == "Accept-Encoding"  # a cache must not give one for the other
    assert plain.content == TEXT


@pytest.mark.parametrize(
    ("path", "method"),
    [
        ("/png", "GET"),
        ("/zip", "GET"),
        ("/short", "GET"),
        (f"/json?size={MIN_BYTES - 1}", "GET"),
        ("/json?status=206", "GET"),
        ("/json", "HEAD"),
    ],
)
def test_other_responses_are_not(path: str, method: str) -> None:
    response = ask(path, method, accept_encoding="gzip")
    assert "content-encoding" not in response.headers
    assert ("vary" in response.headers) == ("png" not in path and "zip" not in path)


def test_what_is_encoded_is_left_as_it_is() -> None:
    response = ask("/encoded", accept_encoding="gzip")
    assert response.content == TEXT
    assert int(response.headers["content-length"]) == len(gzip.compress(TEXT))


def test_each_form_has_its_etag_and_both_mean_the_same() -> None:
    response = ask("/versioned", accept_encoding="gzip")
    assert response.headers["etag"] == '"3-gzip"'
    assert ask("/versioned", accept_encoding="identity").headers["etag"] == '"3"'
    same = ask("/versioned", accept_encoding="gzip", if_none_match='"3-gzip"')
    assert (same.status_code, same.headers["etag"]) == (304, '"3-gzip"')
    same = ask("/versioned", accept_encoding="identity", if_none_match='"3"')
    assert (same.status_code, same.headers["etag"]) == (304, '"3"')
    assert ask("/versioned", accept_encoding="gzip", if_none_match='"2-gzip"').status_code == 200
    assert ask("/versioned", if_match='"3-gzip"').headers["seen"] == '"3"'
    made = ask("/versioned", "POST", accept_encoding="gzip")
    assert (made.headers["etag"], made.headers["content-encoding"]) == ('"3"', "gzip")  # the resource's


@pytest.mark.parametrize(
    ("header", "accepted"),
    [
        ("gzip", True),
        ("GZIP;q=0.5, br", True),
        ("*", True),
        ("gzip;q=0", False),
        ("gzip; q=0.00, *", False),
        ("identity", False),
        ("", False),
        ("xgzip", False),
    ],
)
def test_which_headers_accept_gzip(header: str, accepted: bool) -> None:
    assert accepts_gzip(header) is accepted


@pytest.mark.parametrize("path", ["/json", "/streamed"])
def test_the_request_pays(path: str) -> None:
    with working(60.0) as work:
        ask(path, accept_encoding="gzip")
    assert work.used_s > 0


def test_the_document_of_the_api_is_compressed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []
    compress = compression.zlib.compress

    def counted(data: bytes, *options: Any) -> bytes:
        made.append(len(data))
        return bytes(compress(data, *options))

    monkeypatch.setattr(compression.zlib, "compress", counted)
    for _ in range(3):
        assert ask("/openapi.json", accept_encoding="gzip").content == TEXT
    assert made == [len(TEXT)]
