"""The registry beside a model: the short form of ``python -m benchmarks.fuzz registry``, the same runs every time."""

from __future__ import annotations

import pytest

from app.registry.database import Database
from benchmarks.fuzz.registry_model import run_model


@pytest.mark.slow
def test_the_registry_does_what_its_model_does(database: Database) -> None:
    run_model(database, runs=4, steps=15, seeded=True)
