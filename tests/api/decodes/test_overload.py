"""More uploads at once than the server takes: each is stored, or refused with the time after which to repeat it."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import httpx
import pytest
import sqlalchemy as sa

from app.main import create_app
from app.registry.decodes import decodes
from app.settings import Settings
from tests.api.decodes.conftest import post_frame
from tests.conftest import ADMIN_KEY, LiveServer
from tests.formats.pictures import png
from tests.http import wait_until
from tests.jobs import standin

PLACES, BURST, UPLOADS = 32, 36, 40
"""Tasks of the decoder processes (`max_waiting`), requests with one key, and more than both."""


@pytest.mark.slow
def test_too_many_uploads_at_once_are_refused_for_a_time(tmp_path: Path) -> None:
    settings = Settings(
        data_dir=tmp_path / "var", admin_key=ADMIN_KEY, warm_decoders=False, decode_workers=1, decode_timeout_s=240.0,
        requests_per_s=0.001, requests_at_once=BURST, request_timeout_s=600.0,
    )  # fmt: skip
    frame, answers = png(standin.frame_that(standin.OBEY)), list[httpx.Response]()
    with (
        LiveServer(create_app(settings, decode=partial(standin.hold, tmp_path))) as server,
        server.client() as client,
        ThreadPoolExecutor(UPLOADS) as threads,
    ):
        for _ in range(UPLOADS):
            threads.submit(lambda: answers.append(post_frame(client, frame)))
        wait_until(lambda: len(answers) == UPLOADS - PLACES, "all refusals, while the others wait for their result")
        (tmp_path / "go").touch()
        threads.shutdown()
        with server.app.state.database.read() as connection:
            stored = connection.execute(sa.select(sa.func.count()).select_from(decodes)).scalar_one()
    statuses = Counter(answer.status_code for answer in answers)
    assert statuses == {201: PLACES, 503: BURST - PLACES, 429: UPLOADS - BURST}
    assert stored == PLACES
    assert all(int(answer.headers["Retry-After"]) >= 1 for answer in answers if answer.status_code != 201)
