"""Places of tasks in the decoder processes or before them: no agency takes all of them from the others."""

from __future__ import annotations

import threading
from collections import Counter

from app.errors import Unavailable
from app.registry.tenancy import EVERY_AGENCY

_CERTAIN = 2  # places that an agency gets also where others hold all; source: by hand, one that runs and the next


class Places:
    """Places that agencies share.

    An agency gets a place while any is free, but more than half of them only while no other agency holds or waits for
    one. Its first two are certain, so that a server whose places are all taken by one agency still serves another.

    Parameters
    ----------
    count : int
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._changed = threading.Condition()
        self._held: Counter[str] = Counter()
        self._waiting: Counter[str] = Counter()

    def take(self, agency_id: str, wait_s: float = 0.0) -> None:
        """Take a place.

        Parameters
        ----------
        agency_id : str
            Or `EVERY_AGENCY` or an empty text for work of the server itself, which has no certain places.
        wait_s : float
            How long to wait for one. [s]

        Raises
        ------
        Unavailable
            None is free for this agency.
        """
        with self._changed:
            self._waiting[agency_id] += 1
            try:
                if not self._changed.wait_for(lambda: self._is_free(agency_id), wait_s):
                    raise self._busy(agency_id)
                self._held[agency_id] += 1
            finally:
                _decrease(self._waiting, agency_id)

    def give_back(self, agency_id: str) -> None:
        """Give a place back."""
        with self._changed:
            _decrease(self._held, agency_id)
            self._changed.notify_all()

    def _is_free(self, agency_id: str) -> bool:
        own, is_agency = self._held[agency_id], agency_id not in ("", EVERY_AGENCY)
        if is_agency and own < _CERTAIN:
            return True
        if self._held.total() >= self._count:
            return False
        is_shared = any(other != agency_id for other in (*self._held, *self._waiting) if self._wants(other))
        return not (is_agency and is_shared and own >= self._count // 2)

    def _wants(self, agency_id: str) -> bool:
        return self._held[agency_id] > 0 or self._waiting[agency_id] > 0

    def _busy(self, agency_id: str) -> Unavailable:
        own = self._held[agency_id]
        return Unavailable(
            f"every decoder process is busy; {own} tasks of this agency wait or are carried out",
            limit=f"{self._count} tasks, and {self._count // 2} of one agency while others send some",
            cure="try again in a few seconds",
        )


def _decrease(counter: Counter[str], agency_id: str) -> None:
    counter[agency_id] -= 1
    if not counter[agency_id]:
        del counter[agency_id]
