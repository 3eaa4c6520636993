"""Jobs that nobody has are submitted again, from time to time: those of processes that died."""

from __future__ import annotations

import threading
from collections.abc import Callable

import structlog

from app.errors import Unavailable

RESUBMIT_S = 5.0
"""How often jobs are looked for that nobody has. Source: by hand; with the lease of a job it is the time until the job
of a killed process runs again, 20 s at most."""
_LOG = structlog.get_logger(__name__)


class Resubmission:
    """A thread that submits again what nobody has, every `RESUBMIT_S`.

    Parameters
    ----------
    resubmit : callable
        Looks for such jobs and submits them.
    """

    def __init__(self, resubmit: Callable[[], None]) -> None:
        self._resubmit = resubmit
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="jobs-resubmission", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(RESUBMIT_S):
            try:
                self._resubmit()
            except Unavailable as error:
                _LOG.warning("jobs were not looked for", why=error.message)
            except Exception:  # noqa: BLE001 - the next time may succeed
                _LOG.exception("jobs were not looked for")
