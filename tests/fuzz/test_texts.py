"""The short form of the texts of ``python -m benchmarks.abuse``: hostile YAML, JSON, TOML, XML and CSV over HTTP."""

from __future__ import annotations

import time

import httpx
import pytest

from app.errors import WaymarkError
from benchmarks.abuse.texts import FORMS, list_text_cases, list_texts
from benchmarks.fuzz.parsers import MAX_CPU_S, MAX_MESSAGE, list_parsers

CASES = list(list_text_cases(short=True))
READERS = {
    "rules": FORMS,
    "json": ("json", "yaml"),
    "surveys": ("csv", "json", "xml", "toml"),
    "alignments": ("xml", "json"),
    "packets": ("json", "csv"),
    "poses": ("xml", "csv"),
    "cql2-text": ("yaml",),
    "cql2-json": ("json",),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_readers_refuse_hostile_texts_with_errors_of_the_domain(name: str) -> None:
    parse = {parser.name: parser.parse for parser in list_parsers()}[name]
    message_lengths: list[int] = []
    for form in READERS[name]:
        for text in list_texts(form, seed=1, mutations=40):
            began_s = time.process_time()
            try:
                parse(text)
            except WaymarkError as error:
                message_lengths.append(len(error.message))
            assert time.process_time() - began_s < MAX_CPU_S, text[:60]
    assert len(message_lengths) > 20
    assert 0 < min(message_lengths) <= max(message_lengths) < MAX_MESSAGE


@pytest.mark.slow
@pytest.mark.parametrize("route", sorted({case.route for case in CASES}))
def test_no_hostile_text_is_a_fault_of_the_server(client: httpx.Client, route: str) -> None:
    refused = 0
    for case in CASES:
        if case.route != route:
            continue
        response = client.request(case.method, case.path, timeout=None, **case.options)
        assert response.status_code < 500, (case.name, case.options, response.text)
        if response.status_code >= 400:
            refused += 1
            problem = response.json()
            assert response.headers["content-type"] == "application/problem+json"
            assert problem["detail"]
            assert len(response.content) < 64_000
            assert problem.get("field") or problem.get("errors"), (case.name, problem)
            assert problem.get("limit") or problem.get("cure") or problem.get("errors"), (case.name, problem)
    assert refused > 5
