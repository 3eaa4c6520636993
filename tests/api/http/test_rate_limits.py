"""Too many requests with a key, and too many wrong keys from an address."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

import httpx
import numpy as np
import pytest

from app.api.http import limits
from app.api.http.limits import RateLimit, address_of
from app.errors import TooManyRequests
from app.services.access.access import Scope, new_key
from app.settings import Settings
from tests.conftest import LiveServer

Serve = Callable[[Settings], LiveServer]


class Clock:
    """A clock that tests set."""

    s = 1000.0

    def __call__(self) -> float:
        return self.s


def _limit(per_s: float, at_once: int, clock: Clock) -> RateLimit:
    return RateLimit(per_s, at_once, name="key", message="too many", cure="wait", now_s=clock)


# --- the bucket ---------------------------------------------------------------------------------------------------


def test_a_burst_and_then_as_many_as_come_back() -> None:
    clock = Clock()
    limit = _limit(2.0, 5, clock)
    left = [limit.take("a") for _ in range(5)]
    assert left == [b'"key";r=4;t=1', b'"key";r=3;t=1', b'"key";r=2;t=2', b'"key";r=1;t=2', b'"key";r=0;t=3']
    with pytest.raises(TooManyRequests) as refused:
        limit.take("a")
    assert refused.value.retry_after_s == 1
    assert refused.value.limit == "5 at once, then 2/s"
    assert limit.take("b").startswith(b'"key";r=4')
    clock.s += 0.5
    limit.take("a")
    with pytest.raises(TooManyRequests):
        limit.take("a")
    clock.s += 1000.0
    for _ in range(5):
        limit.take("a")
    with pytest.raises(TooManyRequests):
        limit.take("a")


def test_it_counts_as_a_bucket_of_tokens_does() -> None:
    rng = np.random.default_rng(5)
    for per_s, at_once in ((3.0, 7), (0.5, 1), (200.0, 1000)):
        clock = Clock()
        limit = _limit(per_s, at_once, clock)
        tokens, now_s = float(at_once), clock.s
        for gap_s in rng.exponential(0.7 / per_s, 5000):
            clock.s += gap_s
            tokens = min(float(at_once), tokens + (clock.s - now_s) * per_s)
            now_s = clock.s
            if abs(tokens - round(tokens)) < 1e-6:
                continue
            allowed = tokens >= 1
            tokens -= allowed
            if allowed:
                limit.check("x")
                assert int(re.findall(rb"r=(\d+)", limit.take("x"))[0]) == math.floor(tokens)
            else:
                with pytest.raises(TooManyRequests):
                    limit.check("x")
                with pytest.raises(TooManyRequests) as refused:
                    limit.take("x")
                assert refused.value.retry_after_s == max(1, math.ceil((1 - tokens) / per_s))


def test_waiting_as_long_as_is_said_is_enough() -> None:
    clock = Clock()
    limit = _limit(1 / 7, 1, clock)
    limit.take("a")
    for _ in range(20):
        with pytest.raises(TooManyRequests) as refused:
            limit.take("a")
        clock.s += refused.value.retry_after_s
        limit.take("a")


def test_reserved_tokens_come_one_after_the_other() -> None:
    clock = Clock()
    limit = _limit(20.0, 1, clock)
    assert [limit.reserve_s("a") for _ in range(4)] == pytest.approx([0.0, 0.05, 0.1, 0.15])
    assert limit.reserve_s("b") == 0.0
    clock.s += 0.15
    assert limit.reserve_s("a") == pytest.approx(0.05)


def test_what_is_kept_does_not_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "_MAX_BUCKETS", 100)
    clock = Clock()
    limit = _limit(1.0, 2, clock)
    for number in range(1000):
        limit.take(str(number))
        limit.take(str(number))
        assert len(limit._full_at_s) <= 100
    with pytest.raises(TooManyRequests):
        limit.take("999")
    clock.s += 10.0
    limit.take("new")
    assert list(limit._full_at_s) == ["new"] or len(limit._full_at_s) <= 100


def test_whose_addresses_are_one() -> None:
    assert address_of("192.0.2.7") == "192.0.2.7"
    assert address_of("2001:db8:1:2:3::4") == address_of("2001:db8:1:2:ffff::") == "2001:db8:1:2::/64"
    assert address_of("fe80::1%eth0") == "fe80::/64"
    assert address_of("a:b") == "a:b"


# --- through HTTP -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_key_that_asks_too_much_waits_and_others_do_not(serve: Serve, settings: Settings) -> None:
    server = serve(settings.model_copy(update={"requests_per_s": 0.5, "requests_at_once": 5}))
    with server.agency("one", Scope.VIEWER) as busy, server.agency("one", Scope.VIEWER) as other:
        answers = [busy.get("/v1/markers") for _ in range(5)]
        assert [answer.status_code for answer in answers] == [200] * 5
        assert answers[0].headers["ratelimit-policy"] == '"key";q=5;w=10'
        assert [re.findall(r"r=(\d)", answer.headers["ratelimit"]) for answer in answers] == [[c] for c in "43210"]
        refused = busy.post("/v1/markers", content=b"{" * 1000)
        assert refused.status_code == 429
        assert 1 <= int(refused.headers["retry-after"]) <= 2
        problem = refused.json()
        assert problem["type"] == "urn:waymark:problem:too-many-requests"
        assert problem["limit"] == "5 at once, then 0.5/s"
        assert "Retry-After" in problem["cure"]
        assert busy.get("/healthz").status_code == 200
        assert other.get("/v1/markers").status_code == 200


def test_a_replaced_key_shares_its_holders_bucket(serve: Serve, settings: Settings) -> None:
    server = serve(settings.model_copy(update={"requests_per_s": 0.01, "requests_at_once": 3}))
    with server.agency("two", Scope.ADMIN) as admin:
        own = admin.get("/v1/keys").json()["items"][0]
        newer = admin.post(f"/v1/keys/{own['id']}/rotate", json={}).json()["key"]
        assert admin.get("/v1/keys").status_code == 200
        with server.client(newer) as replaced:
            assert replaced.get("/v1/keys").status_code == 429


@pytest.mark.slow
def test_no_limit_if_none_is_wanted(serve: Serve, settings: Settings) -> None:
    server = serve(settings.model_copy(update={"requests_per_s": 0.0, "wrong_keys_per_minute": 0.0}))
    with server.client() as admin, server.client("a-key-that-nobody-has") as stranger:
        answer = admin.get("/v1/markers")
        assert answer.status_code == 200
        assert "ratelimit" not in answer.headers
        assert {stranger.get("/v1/markers").status_code for _ in range(60)} == {401}


@pytest.mark.slow
def test_guessing_is_refused_and_locks_nobody_out(serve: Serve, settings: Settings) -> None:
    server = serve(settings.model_copy(update={"wrong_keys_per_minute": 6.0}))
    unseen = server.agency("three", Scope.VIEWER)
    with server.agency("three", Scope.VIEWER) as known, unseen:
        assert known.get("/v1/markers").status_code == 200
        answers = [httpx.get(f"{server.url}/v1/markers", headers={"X-API-Key": new_key()}) for _ in range(8)]
        assert [answer.status_code for answer in answers] == [401] * 6 + [429] * 2
        assert 1 <= int(answers[-1].headers["retry-after"]) <= 10
        assert "this address" in answers[-1].json()["detail"]
        assert unseen.get("/v1/markers").status_code == 200
        assert known.get("/v1/markers").status_code == 200  # a key that was valid before is still asked about
        assert httpx.get(f"{server.url}/v1/markers").status_code == 401
