"""Tokens of an issuer with keys of our own, served from a socket: what is taken, and what is not."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import jwt
import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from pydantic import ValidationError

from app.errors import NotAllowed, NotAuthenticated, Unavailable
from app.services.access.access import Scope
from app.services.access.oidc import Issuer, KeySet, Tokens
from app.settings import Settings
from app.storage.jwks import MAX_BYTES, read_jwks
from tests.conftest import LiveServer

pytestmark = pytest.mark.both_databases

ISSUER, AUDIENCE = "https://id.example/realms/roads", "waymark"
TERMS = Issuer(ISSUER, AUDIENCE, "waymark_agency", "waymark_scope")
RSA_KEY = rsa.generate_private_key(65537, 2048)
EC_KEY = ec.generate_private_key(ec.SECP256R1())
ED_KEY = ed25519.Ed25519PrivateKey.generate()
STRANGER = rsa.generate_private_key(65537, 2048)


def jwk(private: Any, kid: str | None, **more: Any) -> dict[str, Any]:
    """The public half of a key as a JSON Web Key."""
    algorithm = {rsa.RSAPrivateKey: "RS256", ec.EllipticCurvePrivateKey: "ES256"}.get(
        next((kind for kind in (rsa.RSAPrivateKey, ec.EllipticCurvePrivateKey) if isinstance(private, kind)), None),
        "EdDSA",
    )
    described = json.loads(jwt.get_algorithm_by_name(algorithm).to_jwk(private.public_key()))
    described.pop("key_ops", None)
    return described | ({"kid": kid} if kid else {}) | more


KEYS = [jwk(RSA_KEY, "r"), jwk(EC_KEY, "e", use="sig", alg="ES256"), jwk(ED_KEY, "d")]


def claims(**more: Any) -> dict[str, Any]:
    now = int(time.time())
    made = {"iss": ISSUER, "aud": AUDIENCE, "sub": "u-1", "exp": now + 300, "iat": now, "nbf": now}
    return {**made, "waymark_agency": "Roads", "waymark_scope": "planner", **more}


def token(key: Any = RSA_KEY, algorithm: str = "RS256", kid: str | None = "r", **more: Any) -> str:
    """A signed token; a claim that is None is left out."""
    kept = {name: value for name, value in claims(**more).items() if value is not None}
    return jwt.encode(kept, key, algorithm=algorithm, headers={"kid": kid} if kid else {})


def key_set(*keys: dict[str, Any]) -> bytes:
    return json.dumps({"keys": list(keys)}).encode()


def part(content: Any) -> str:
    return base64.urlsafe_b64encode(json.dumps(content).encode()).rstrip(b"=").decode()


@pytest.fixture
def tokens() -> Tokens:
    return Tokens(TERMS, KeySet(lambda: key_set(*KEYS)))


# --- what is taken ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "algorithm", "kid"), [(RSA_KEY, "RS256", "r"), (EC_KEY, "ES256", "e"), (ED_KEY, "EdDSA", "d")]
)
def test_three_algorithms(tokens: Tokens, key: Any, algorithm: str, kid: str) -> None:
    bearer = tokens.verify(token(key, algorithm, kid, preferred_username="ada"))
    assert (bearer.agency, bearer.scope, bearer.label) == ("Roads", Scope.PLANNER, "ada")
    assert 290 < bearer.expires_at.timestamp() - time.time() <= 300


def test_who_holds_it_is_issuer_and_subject(tokens: Tokens) -> None:
    first, again, other = (
        tokens.verify(token(sub=s, preferred_username=n)) for s, n in (("a", "x"), ("a", "y"), ("b", "x"))
    )
    assert first.holder_id == again.holder_id != other.holder_id
    assert tokens.verify(token(sub="a\nb")).label == "a?b"


def test_claims_may_lie_deeper_and_be_lists() -> None:
    terms = Issuer(ISSUER, AUDIENCE, "org.name", "realm.roles")
    deep = Tokens(terms, KeySet(lambda: key_set(*KEYS)))
    bearer = deep.verify(token(org={"name": "Roads"}, realm={"roles": ["offline_access", "surveyor"]}))
    assert (bearer.agency, bearer.scope) == ("Roads", Scope.SURVEYOR)
    named = Tokens(Issuer(ISSUER, AUDIENCE, "https://roads.example/agency", "scope"), KeySet(lambda: key_set(*KEYS)))
    bearer = named.verify(token(**{"https://roads.example/agency": "Roads", "scope": "openid viewer email"}))
    assert bearer.scope is Scope.VIEWER


def test_a_token_without_kid_needs_a_single_key() -> None:
    alone = Tokens(TERMS, KeySet(lambda: key_set(jwk(RSA_KEY, None))))
    assert alone.verify(token(kid=None)).agency == "Roads"
    with pytest.raises(NotAuthenticated):
        Tokens(TERMS, KeySet(lambda: key_set(*KEYS))).verify(token(kid=None))


# --- what is not --------------------------------------------------------------------------------------------------


def _public_pem() -> bytes:
    return RSA_KEY.public_key().public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )


def _confused(secret: bytes) -> str:
    """A token "signed" with the public key as the secret of HS256."""
    head = f"{part({'alg': 'HS256', 'typ': 'JWT', 'kid': 'r'})}.{part(claims())}"
    signature = base64.urlsafe_b64encode(hmac.new(secret, head.encode(), hashlib.sha256).digest()).rstrip(b"=")
    return f"{head}.{signature.decode()}"


def _changed() -> str:
    head, _, signature = token().split(".")
    return f"{head}.{part(claims(waymark_scope='admin'))}.{signature}"


FORGED: dict[str, Callable[[], str]] = {
    "signed by a stranger": lambda: token(STRANGER),
    "claims changed": _changed,
    "no signature": lambda: f"{part({'alg': 'none', 'kid': 'r'})}.{part(claims())}.",
    "none with a signature": lambda: f"{part({'alg': 'None', 'kid': 'r'})}.{part(claims())}.e30",
    "public key as a secret": lambda: _confused(_public_pem()),
    "modulus as a secret": lambda: _confused(jwk(RSA_KEY, "r")["n"].encode()),
    "another algorithm of RSA": lambda: token(algorithm="RS512"),
    "PSS": lambda: token(algorithm="PS256"),
    "the id of another key": lambda: token(kid="e"),
    "an unknown key": lambda: token(STRANGER, kid="new"),
    "its own key in the header": lambda: jwt.encode(
        claims(), STRANGER, algorithm="RS256", headers={"jwk": jwk(STRANGER, "r"), "kid": "r"}
    ),
    "a critical extension": lambda: jwt.encode(
        claims(), RSA_KEY, algorithm="RS256", headers={"crit": ["exp"], "kid": "r"}
    ),
    "expired": lambda: token(exp=int(time.time()) - 60),
    "without end": lambda: token(exp=None),
    "endless": lambda: token(exp=float("inf")),
    "no number": lambda: token(exp="tomorrow"),
    "not yet": lambda: token(nbf=int(time.time()) + 120),
    "issued in the future": lambda: token(iat=int(time.time()) + 120),
    "for another audience": lambda: token(aud="billing"),
    "for nobody": lambda: token(aud=None),
    "of another issuer": lambda: token(iss="https://id.example/realms/other"),
    "of no issuer": lambda: token(iss=None),
    "of nobody": lambda: token(sub=None),
    "too long": lambda: token(padding="x" * 9000),
    "empty parts": lambda: "eyJ..",
    "no JSON": lambda: "eyJhbGciOiJSUzI1NiJ9.bm9wZQ.AAAA",
    "a list": lambda: f"{part({'alg': 'RS256', 'kid': 'r'})}.{part([1])}.AAAA",
    "a kid that is no text": lambda: f"{part({'alg': 'RS256', 'kid': {'a': 1}})}.{part(claims())}.AAAA",
    "deep": lambda: "eyJ" + base64.urlsafe_b64encode(b"[" * 3000).decode() + ".e30.AAAA",
}


@pytest.mark.parametrize("how", FORGED)
def test_forged_and_stale_tokens_are_refused(tokens: Tokens, how: str) -> None:
    assert tokens.verify(token())  # the good one next to it
    with pytest.raises(NotAuthenticated) as refused:
        tokens.verify(FORGED[how]())
    assert refused.value.limit
    assert refused.value.cure


@pytest.mark.parametrize(
    "wrong",
    [
        {"waymark_agency": None},
        {"waymark_agency": ""},
        {"waymark_agency": ["Roads"]},
        {"waymark_agency": "a\x00b"},
        {"waymark_scope": None},
        {"waymark_scope": "write"},
        {"waymark_scope": "viewer admin"},
        {"waymark_scope": ["viewer", "vehicle"]},
        {"waymark_scope": 7},
    ],
)
def test_a_valid_token_that_names_no_agency_or_scope(tokens: Tokens, wrong: dict[str, Any]) -> None:
    with pytest.raises(NotAllowed) as refused:
        tokens.verify(token(**wrong))
    assert refused.value.field == next(iter(wrong))


@pytest.mark.filterwarnings("ignore::jwt.warnings.InsecureKeyLengthWarning")
def test_keys_that_are_no_good_are_not_used() -> None:
    weak = rsa.generate_private_key(65537, 1024)
    secret = {"kty": "oct", "kid": "s", "k": base64.urlsafe_b64encode(b"s" * 32).decode()}
    other = ec.generate_private_key(ec.SECP384R1())
    for_encryption = jwk(STRANGER, "enc", use="enc")
    listed = [jwk(weak, "weak"), secret, for_encryption, {"kty": "RSA", "kid": "broken", "n": "!"}, 7, *KEYS]
    p384 = json.loads(jwt.get_algorithm_by_name("ES384").to_jwk(other.public_key()))
    tokens = Tokens(TERMS, KeySet(lambda: json.dumps({"keys": [*listed, {**p384, "kid": "p"}]}).encode()))
    assert tokens.verify(token())
    for key, algorithm, kid in (
        (weak, "RS256", "weak"), (b"s" * 32, "HS256", "s"), (STRANGER, "RS256", "enc"), (other, "ES384", "p")
    ):  # fmt: skip
        with pytest.raises(NotAuthenticated):
            tokens.verify(token(key, algorithm, kid))


# --- the issuer's keys --------------------------------------------------------------------------------------------


@dataclass
class Provider:
    """An issuer's key set behind a socket."""

    keys: list[dict[str, Any]] = field(default_factory=lambda: list(KEYS))
    asked: int = 0
    content: bytes | None = None
    status: int = 200
    url: str = ""


@pytest.fixture
def provider() -> Iterator[Provider]:
    state = Provider()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            state.asked += 1
            self.send_response(state.status)
            self.end_headers()
            self.wfile.write(state.content if state.content is not None else key_set(*state.keys))

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    state.url = f"http://127.0.0.1:{server.server_port}/jwks"
    yield state
    server.shutdown()
    server.server_close()
    thread.join()


def test_keys_are_kept_and_asked_for_again_at_a_bounded_rate(provider: Provider) -> None:
    now_s = [100.0]
    tokens = Tokens(TERMS, KeySet(lambda: read_jwks(provider.url), lambda: now_s[0]))
    for _ in range(10):
        tokens.verify(token())
    assert provider.asked == 1
    provider.keys.append(jwk(STRANGER, "new"))
    for _ in range(10):
        with pytest.raises(NotAuthenticated):
            tokens.verify(token(STRANGER, kid="new"))
    assert provider.asked == 1
    now_s[0] += 61.0
    assert tokens.verify(token(STRANGER, kid="new"))
    for number in range(50):
        with pytest.raises(NotAuthenticated):
            tokens.verify(token(STRANGER, kid=f"guess {number}"))
    assert provider.asked == 2
    provider.keys = [key for key in provider.keys if key["kid"] != "r"]
    now_s[0] += 3601.0
    with pytest.raises(NotAuthenticated):
        tokens.verify(token())
    assert provider.asked == 3


def test_an_issuer_that_is_away(provider: Provider) -> None:
    now_s = [100.0]
    tokens = Tokens(TERMS, KeySet(lambda: read_jwks(provider.url), lambda: now_s[0]))
    provider.status = 500
    for _ in range(5):
        with pytest.raises(Unavailable):
            tokens.verify(token())
    assert provider.asked == 1
    now_s[0] += 61.0
    provider.status = 200
    assert tokens.verify(token())
    now_s[0] += 3601.0
    for content in (b"no JSON", b"[]", b'{"keys": 7}', b" " * (MAX_BYTES + 1), b"\xff"):
        provider.content = content
        assert tokens.verify(token())  # what was known serves on
        now_s[0] += 3601.0
    provider.content, provider.status = None, 302
    assert tokens.verify(token())


def test_keys_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "jwks.json"
    path.write_bytes(key_set(*KEYS))
    assert Tokens(TERMS, KeySet(lambda: read_jwks(str(path)))).verify(token())
    with pytest.raises(Unavailable):
        read_jwks(str(tmp_path / "none.json"))
    with pytest.raises(Unavailable):
        read_jwks("http://127.0.0.1:9/jwks")


# --- through HTTP -------------------------------------------------------------------------------------------------


@pytest.fixture
def live(serve: Callable[[Settings], LiveServer], settings: Settings, provider: Provider) -> LiveServer:
    chosen = {"oidc_issuer": ISSUER, "oidc_audience": AUDIENCE, "oidc_jwks": provider.url}
    return serve(settings.model_copy(update=chosen))


@pytest.mark.slow
def test_a_token_works_as_a_key_does(live: LiveServer) -> None:
    with live.agency("Roads") as keyed, live.agency("Others") as others:
        position = {"lon_deg": 8.5, "lat_deg": 47.5}
        with (
            live.client(token(preferred_username="ada")) as planner,
            live.client(token(waymark_scope="viewer")) as viewer,
        ):
            made = planner.post("/v1/markers", json={"position": position})
            assert made.status_code == 201, made.text
            path = made.headers["location"]
            assert keyed.get(path).status_code == viewer.get(path).status_code == 200
            assert others.get(path).status_code == 404
            assert viewer.post("/v1/markers", json={"position": position}).status_code == 403
            assert planner.get("/v1/keys").status_code == 403
            assert planner.get(f"{path}/versions").json()["items"][0]["who"] == "ada"
            once = {"json": {"position": position, "code": {"scheme": "id"}}, "headers": {"Idempotency-Key": "once"}}
            mine = planner.post("/v1/markers", **once).json()
            with live.client(token(jti="renewed")) as renewed, live.client(token(sub="another")) as another:
                assert renewed.post("/v1/markers", **once).json() == mine
                assert another.post("/v1/markers", **once).json()["id"] != mine["id"]
        with live.client(token(waymark_agency="Nobody")) as stranger:
            refused = stranger.get("/v1/markers")
            assert refused.status_code == 403
            assert "operator" in refused.json()["cure"]
        for how in ("expired", "no signature", "public key as a secret", "claims changed"):
            answer = httpx.get(f"{live.url}/v1/markers", headers={"Authorization": f"Bearer {FORGED[how]()}"})
            assert answer.status_code == 401, how
            assert answer.json()["field"] == "Authorization"


def test_without_an_issuer_tokens_are_unknown_keys(serve: Callable[[Settings], LiveServer], settings: Settings) -> None:
    server = serve(settings)
    with server.agency("Roads"), server.client(token()) as client:
        assert client.get("/v1/markers").status_code == 401


@pytest.mark.parametrize(
    "given",
    [
        {"oidc_issuer": ISSUER},
        {"oidc_issuer": ISSUER, "oidc_audience": AUDIENCE},
        {"oidc_issuer": ISSUER, "oidc_audience": AUDIENCE, "oidc_jwks": "http://id.example/jwks"},
    ],
)
def test_settings_that_would_not_be_safe(given: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        Settings(**given)
