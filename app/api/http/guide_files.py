"""The guide at /guide: the documents as a web site, which `make docs` builds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from starlette.datastructures import MutableHeaders
from starlette.staticfiles import StaticFiles
from starlette.types import Message, Receive, Scope, Send

from app import shipped_folder
from app.errors import NotFound

GUIDE = shipped_folder("build/guide")
"""Where `make docs` writes it."""


class GuideFiles(StaticFiles):
    """The guide; it may be built, or built again, while the server runs.

    Parameters
    ----------
    folder : Path
    headers : mapping
        Headers of every response. The style sheets of its theme contain icons as data, which the policy must allow.
    """

    def __init__(self, folder: Path, headers: Mapping[str, str]) -> None:
        super().__init__(directory=folder, html=True, check_dir=False)
        self._first_page = folder / "index.html"
        self._headers = dict(headers)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or with a problem while there is no guide."""
        if not self._first_page.is_file():
            raise NotFound(
                "the guide is not built on this server",
                cure="run `make docs` in a source checkout and reload this page; the container image has the guide",
            )

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(self._headers)
            await send(message)

        await super().__call__(scope, receive, send_with_headers)
