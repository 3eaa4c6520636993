"""Tokens of forms: for one marker, not too soon, not too late, and nobody else can make them."""

from __future__ import annotations

import base64
from datetime import UTC, datetime, timedelta

import pytest

from app.services.public_pages.pages import MAX_AGE_S, MIN_AGE_S, FormTokens, TokenRefused, TokenTooYoung

NOW = datetime(2026, 11, 25, 12, 0, 0, tzinfo=UTC)
MARKER = "019cb624-0000-7000-8000-00000000aaaa"
OTHER = "019cb624-0000-7000-8000-00000000bbbb"


class Clock:
    """A clock that tests set."""

    def __init__(self) -> None:
        self.now = NOW

    def __call__(self) -> datetime:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def tokens(clock: Clock) -> FormTokens:
    return FormTokens(lambda: b"k" * 32, clock)


@pytest.mark.parametrize("age_s", [MIN_AGE_S, 60, MAX_AGE_S])
def test_a_token_has_a_nonce_of_its_own_while_it_is_valid(tokens: FormTokens, clock: Clock, age_s: int) -> None:
    issued = [tokens.issue(MARKER) for _ in range(2)]
    clock.now += timedelta(seconds=age_s)
    nonces = {tokens.check(MARKER, token) for token in issued}
    assert len(nonces) == 2
    assert nonces == {tokens.check(MARKER, token) for token in issued}


@pytest.mark.parametrize(("age_s", "error"), [
    (0, TokenTooYoung), (MIN_AGE_S - 1, TokenTooYoung), (MAX_AGE_S + 1, TokenRefused), (-61, TokenRefused),
])  # fmt: skip
def test_a_token_has_an_age(tokens: FormTokens, clock: Clock, age_s: int, error: type[TokenRefused]) -> None:
    token = tokens.issue(MARKER)
    clock.now += timedelta(seconds=age_s)
    with pytest.raises(TokenRefused) as refused:
        tokens.check(MARKER, token)
    assert type(refused.value) is error


def test_nothing_of_a_token_can_be_changed(tokens: FormTokens, clock: Clock) -> None:
    token = tokens.issue(MARKER)
    clock.now += timedelta(seconds=60)
    content = bytearray(base64.urlsafe_b64decode(token))
    for place in range(len(content)):
        content[place] ^= 1
        with pytest.raises(TokenRefused):
            tokens.check(MARKER, base64.urlsafe_b64encode(content).decode())
        content[place] ^= 1
    assert tokens.check(MARKER, token)


def test_a_token_is_of_one_marker_and_one_server(tokens: FormTokens, clock: Clock) -> None:
    token = tokens.issue(MARKER)
    clock.now += timedelta(seconds=60)
    for others in (tokens, FormTokens(lambda: b"l" * 32, clock)):
        with pytest.raises(TokenRefused):
            others.check(OTHER if others is tokens else MARKER, token)


@pytest.mark.parametrize("text", ["", "x", "=" * 48, "é" * 48, "A" * 48, "A" * 10_000, "A" * 47 + "\n", "<b>" * 16])
def test_other_texts_are_no_tokens(tokens: FormTokens, text: str) -> None:
    with pytest.raises(TokenRefused):
        tokens.check(MARKER, text)
