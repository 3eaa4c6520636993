"""The short form of ``python -m benchmarks.fuzz``: the same inputs every time."""

from __future__ import annotations

import json

import pytest

from benchmarks.fuzz.frames import attack_frames
from benchmarks.fuzz.grammar import compare, list_grammars
from benchmarks.fuzz.parsers import Parser, attack, list_parsers

PARSERS = list_parsers()
FILES = {"survey-gis": 40}
"""Files of grammars that take long to write; 120 of the others."""


@pytest.mark.slow
@pytest.mark.parametrize("parser", PARSERS, ids=[parser.name for parser in PARSERS])
def test_damaged_files_are_read_or_refused(parser: Parser) -> None:
    outcome = attack(parser, examples=60, seed=1)
    assert not outcome.failures, outcome.failures[0]
    assert outcome.accepted
    assert outcome.refused or parser.name in ("kinds", "archives")  # these two answer with what they found


@pytest.mark.parametrize("grammar", list_grammars())
def test_the_content_of_valid_files_is_read(grammar: str) -> None:
    found = compare(grammar, FILES.get(grammar, 120))
    assert not found.failures, found.failures[0]
    assert not found.refused


def test_an_error_of_no_domain_is_found() -> None:
    outcome = attack(Parser("defect", json.loads, [b'{"a": 1}']), examples=60, seed=1)
    assert "JSONDecodeError" in outcome.failures[0]


def test_damaged_pictures_do_not_stop_the_decoder_processes() -> None:
    outcome = attack_frames(40, workers=1)
    assert not outcome.failures, outcome.failures[0]
    assert outcome.accepted
    assert outcome.refused
