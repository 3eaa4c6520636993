"""The short form of ``python -m benchmarks.fuzz``: the same inputs every time."""

from __future__ import annotations

import json

import pytest

from benchmarks.fuzz.frames import attack_frames
from benchmarks.fuzz.grammar import compare, list_grammars
from benchmarks.fuzz.parsers import Parser, attack, list_parsers
from tests.machine import require_module

PARSERS = list_parsers()
FEWER = {"bag": 60, "survey-gis": 40, "video": 40}  # files of a grammar that take longer
NEEDS = {
    "bag": {"mcap.writer": "bags", "rosbags.rosbag1": "bags", "zstandard": "bags"},
    "can": {"can": "can"},
    "can-signals": {"can": "can", "cantools": "can"},
}


@pytest.mark.slow
@pytest.mark.parametrize("parser", PARSERS, ids=[parser.name for parser in PARSERS])
def test_damaged_files_are_read_or_refused(parser: Parser) -> None:
    outcome = attack(parser, examples=60, seed=1)
    assert not outcome.failures, outcome.failures[0]
    assert outcome.accepted
    assert outcome.refused or parser.name in ("kinds", "archives")  # these two answer with what they found


@pytest.mark.parametrize("grammar", list_grammars())
def test_the_content_of_valid_files_is_read(grammar: str) -> None:
    for module, extra in NEEDS.get(grammar, {}).items():
        require_module(module, f"the extra {extra}")
    found = compare(grammar, FEWER.get(grammar, 120))
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
