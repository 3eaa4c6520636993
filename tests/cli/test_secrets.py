"""Secrets in files, as containers get them, instead of in the environment."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from app.cli.database import read_settings
from app.errors import InvalidParameter


def test_settings_and_the_stores_keys_come_from_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in (
        ("waymark_database_url", "postgresql+psycopg://waymark:secret@db:5432/waymark"),
        ("waymark_admin_key", "an-admin-key-from-a-file-of-secrets"),
        ("aws_access_key_id", "id\n"),
        ("aws_secret_access_key", "secret"),
        ("another_programs", "x"),
    ):
        (tmp_path / name).write_text(text)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "of-the-environment")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    monkeypatch.setenv("WAYMARK_SECRETS_DIR", str(tmp_path))
    settings = read_settings(port=1)
    assert settings.database_url == "postgresql+psycopg://waymark:secret@db:5432/waymark"
    assert settings.admin_key is not None
    assert settings.admin_key.get_secret_value() == "an-admin-key-from-a-file-of-secrets"
    assert (os.environ["AWS_ACCESS_KEY_ID"], os.environ["AWS_SECRET_ACCESS_KEY"]) == ("of-the-environment", "secret")
    monkeypatch.setenv("WAYMARK_ADMIN_KEY", "the-environment-goes-before-files")
    settings = read_settings()
    assert settings.admin_key is not None
    assert settings.admin_key.get_secret_value() == "the-environment-goes-before-files"


def test_a_folder_that_is_none_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WAYMARK_SECRETS_DIR", str(tmp_path / "none"))
    with pytest.raises(InvalidParameter, match="is not a folder"):
        read_settings()
