"""The abstract tests of OGC API Features, CQL2 and OGC API Tiles, over HTTP: see abstract_tests.py."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from app.services.access.access import Scope
from tests.conftest import LiveServer

pytest.register_assert_rewrite(
    *(f"tests.api.ogc.abstract_{name}" for name in ("tests", "features", "filters", "tiles"))
)

from tests.api.ogc.abstract_tests import AbstractTest, Api, all_tests, fill, table  # noqa: E402

pytestmark = pytest.mark.both_databases
DOCUMENT = Path(__file__).parents[3] / "docs" / "ogc.md"
RUN = [one for one in all_tests() if one.run is not None]


@pytest.fixture(scope="module")
def api(server: LiveServer) -> Iterator[Api]:
    """The API of an agency with features in all collections but maintenance."""
    with server.agency("abstract tests", Scope.PLANNER) as client:
        fill(client)
        yield Api(client)


@pytest.mark.parametrize("one", RUN, ids=[f"{one.standard}{one.identifier}" for one in RUN])
def test_abstract_test(api: Api, one: AbstractTest) -> None:
    assert one.run is not None
    one.run(api)


def test_no_abstract_test_is_listed_twice() -> None:
    names = [(one.standard, one.identifier) for one in all_tests()]
    assert len(names) == len(set(names))
    assert all(one.run is not None or one.reason for one in all_tests())


def test_the_table_in_the_document_has_these_tests_and_results() -> None:
    """To renew it: python -m tests.api.ogc.abstract_tests"""
    assert table() in DOCUMENT.read_text()
