"""Status of a marker: from the plan to the end of its use."""

from __future__ import annotations

from typing import Literal, get_args

Status = Literal["planned", "built", "surveyed", "active", "suspect", "retired"]
STATUSES: tuple[Status, ...] = get_args(Status)
