"""GET /v1/server-settings: what the server runs with, for admins only, and without any secret."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.api.http.permissions import ADMINS
from app.published_settings import server_settings_of
from app.services.access.access import Scope
from app.settings import Settings
from tests.conftest import LiveServer
from tests.http import PERMISSIONS

SECRETS = ("s3cret", "hidden-user", "hidden-host", "hidden-bucket", "hidden-folder", "hidden-client")


@pytest.mark.slow
def test_the_settings_in_use_are_listed(server: LiveServer) -> None:
    with server.client() as client:
        found = client.get("/v1/server-settings").json()
    assert (found["engine"], found["database"], found["storage"], found["broker"]) == (
        "embedded", "sqlite", "folder", None,
    )  # fmt: skip
    numbers = {setting["name"]: setting for setting in found["numbers"]}
    assert numbers["WAYMARK_MAX_IMPORT_BYTES"]["default"] == 256 * 1024**2
    assert numbers["WAYMARK_WEBHOOKS_TO_LOOPBACK"]["value"] is False
    assert all(setting["description"] for setting in found["numbers"])
    assert "WAYMARK_PORT" not in numbers


def test_only_admins_read_them(server: LiveServer) -> None:
    assert PERMISSIONS["GET /v1/server-settings"] == ADMINS
    with server.agency("settings", Scope.PLANNER) as planner:
        assert planner.get("/v1/server-settings").status_code == 403


def test_no_secret_and_no_place_is_in_them(tmp_path: Path) -> None:
    settings = Settings(
        data_dir=tmp_path / "hidden-folder",
        database_url="postgresql+psycopg://hidden-user:s3cret@hidden-host/db",
        broker_url="amqp://hidden-user:s3cret@hidden-host:5672/",
        blobs_url="s3://hidden-bucket/prefix",
        admin_key="s3cret-s3cret-s3cret-s3cret",
        oidc_issuer="https://id.example.org",
        oidc_audience="waymark",
        oidc_jwks="https://id.example.org/keys",
        otlp_endpoint="http://hidden-host:4318",
        base_map="https://tiles.example.org/{z}/{x}/{y}.png?key=s3cret",
    )
    found = server_settings_of(settings, "1.2.3")
    assert (found["engine"], found["database"], found["storage"], found["broker"]) == (
        "celery", "postgresql", "s3", "amqp",
    )  # fmt: skip
    assert (found["issuer"], found["base_map"], found["tracing"]) == ("https://id.example.org", "raster", True)
    assert not [secret for secret in SECRETS if secret in str(found)]
