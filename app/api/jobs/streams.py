"""What all event streams of this process share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from app.api.http.event_stream import StreamPlaces
from app.api.jobs.watch import Watch
from app.registry.jobs import JobRow


class Streams:
    """The places for streams, and the looks at the jobs and agencies that they follow.

    Parameters
    ----------
    read_jobs : callable
        Rows of jobs by their ids.
    read_newest : callable
        Ids of the newest events by agencies.
    """

    def __init__(
        self,
        read_jobs: Callable[[Sequence[str]], Mapping[str, JobRow]],
        read_newest: Callable[[Sequence[str]], Mapping[str, int]],
    ) -> None:
        self.places = StreamPlaces()
        self.jobs = Watch(read_jobs)
        self.agencies = Watch(read_newest)
