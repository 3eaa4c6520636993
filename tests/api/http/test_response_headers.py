"""What caches and browsers may do with responses, and whose address a request has."""

from __future__ import annotations

import contextlib
import socket

import httpx
import pytest
import uvicorn

from app.cli import serving
from app.settings import Settings
from tests.conftest import LiveServer

PUBLIC = ("/", "/docs", "/redoc", "/openapi.json", "/static/app/main.js", "/markers")
PRIVATE = ("/v1/markers", "/v1/keys", "/ogc", "/nowhere", "/healthz", "/v1/markers/none")


@pytest.mark.slow
@pytest.mark.parametrize("path", [*PUBLIC, *PRIVATE])
def test_no_response_is_given_to_another_key(server: LiveServer, path: str) -> None:
    for key in ("a wrong key", None, "an-admin-key-for-tests-only"):
        with server.client(key) as client:
            response = client.get(path)
        expected = "no-cache" if path in PUBLIC else "private, no-store"
        if path == "/ogc" and response.status_code == 200:
            expected = "private, no-cache"
        assert response.headers["cache-control"] == expected, response.text[:200]
        assert response.headers["x-content-type-options"] == "nosniff"
        assert {"authorization", "x-api-key"} <= {name.strip().lower() for name in response.headers["vary"].split(",")}


def test_what_has_an_etag_is_asked_about_each_time(client: httpx.Client) -> None:
    made = client.post("/v1/markers", json={"position": {"lon_deg": 8.4, "lat_deg": 49.0}})
    assert made.headers["cache-control"] == "private, no-cache"
    found = client.get(made.headers["location"])
    again = client.get(made.headers["location"], headers={"If-None-Match": found.headers["etag"]})
    assert (found.status_code, again.status_code) == (200, 304)
    for response in (found, again):
        assert response.headers["cache-control"] == "private, no-cache"
        assert set(response.headers["vary"].split(", ")) == {"Accept-Encoding", "Authorization", "X-API-Key"}


@pytest.mark.parametrize(("proxies", "trusts"), [("", False), ("192.0.2.1, 127.0.0.1", True)])
def test_addresses_of_clients_come_from_configured_proxies_only(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, proxies: str, trusts: bool
) -> None:
    configs: list[uvicorn.Config] = []

    class Stopped(serving.StoppingServer):
        started = True

        def run(self, sockets: list[socket.socket] | None = None) -> None:
            configs.append(self.config)

    monkeypatch.setattr(serving, "StoppingServer", Stopped)
    with contextlib.suppress(SystemExit):
        serving.serve_until_stopped(settings.model_copy(update={"trusted_proxies": proxies}))
    (config,) = configs
    assert config.proxy_headers is trusts
    assert config.forwarded_allow_ips == (["192.0.2.1", "127.0.0.1"] if trusts else [])


@pytest.mark.parametrize("proxies", ["*", "10.0.0.0/8", "proxy.example"])
def test_proxies_are_addresses(proxies: str) -> None:
    with pytest.raises(ValueError, match="trusted_proxies"):
        Settings(trusted_proxies=proxies)
