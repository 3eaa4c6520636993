"""Tokens of an OpenID Connect issuer instead of keys: JWTs (RFC 7519, RFC 8725) that name an agency and a scope."""

from __future__ import annotations

import hashlib
import json
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

import jwt
import structlog

from app.errors import NotAllowed, NotAuthenticated, Unavailable
from app.services.access.access import AGENCY_SCOPES, Bearer, Scope
from app.values import JsonObject

_LOG = structlog.get_logger(__name__)
MAX_TOKEN_CHARACTERS = 8192
_LEEWAY_S = 30.0
_MIN_RSA_BITS = 2048
_AGAIN_S = 60.0
_REFRESH_S = 3600.0
# one algorithm for each type of key, so that the token's header cannot turn a public key into a shared secret
_ALGORITHMS = {("RSA", None): "RS256", ("EC", "P-256"): "ES256", ("OKP", "Ed25519"): "EdDSA"}


@dataclass(frozen=True, slots=True)
class Issuer:
    """Issuer whose tokens are accepted, and the claims that are read."""

    # `issuer`, `audience`: required value of `iss`, and a value that `aud` must contain
    issuer: str
    audience: str
    # `agency_claim`, `scope_claim`: claims that name the agency and the scope; a.b is b inside of a, where there is no
    # claim a.b itself
    agency_claim: str
    scope_claim: str


class KeySet:
    """The issuer's public keys. They are read again hourly, and for an unknown key at most once a minute.

    Parameters
    ----------
    read : callable
        The key set as bytes; raises Unavailable.
    now_s : callable
        A monotonic clock. [s]
    """

    def __init__(self, read: Callable[[], bytes], now_s: Callable[[], float] = time.monotonic) -> None:
        self._read = read
        self._now_s = now_s
        self._keys: dict[str | None, jwt.PyJWK] = {}
        self._tried_at_s: float | None = None
        self._lock = threading.Lock()

    def find(self, kid: str | None) -> jwt.PyJWK | None:
        """The key with an id; without an id the only key.

        Raises
        ------
        Unavailable
            No keys could be read yet.
        """
        age_s = self._now_s() - self._tried_at_s if self._tried_at_s is not None else _REFRESH_S
        if age_s >= _REFRESH_S or (age_s >= _AGAIN_S and self._known(kid) is None):
            self._refresh()
        if not self._keys:
            raise Unavailable("the issuer's keys cannot be read", cure="try again in a minute")
        return self._known(kid)

    def _known(self, kid: str | None) -> jwt.PyJWK | None:
        keys = self._keys
        return keys.get(kid) if kid is not None else next(iter(keys.values())) if len(keys) == 1 else None

    def _refresh(self) -> None:
        if not self._lock.acquire(blocking=not self._keys):
            return  # somebody is at it; what is known serves meanwhile
        try:
            now_s = self._now_s()
            if self._tried_at_s is not None and now_s - self._tried_at_s < _AGAIN_S:
                return
            self._tried_at_s = now_s
            self._keys = _usable_keys(self._read())
        except (Unavailable, ValueError) as error:
            _LOG.warning("the issuer's keys cannot be read", why=str(error))
        finally:
            self._lock.release()


class Tokens:
    """Checks tokens of one issuer."""

    def __init__(self, issuer: Issuer, keys: KeySet) -> None:
        self._issuer = issuer
        self._keys = keys

    def verify(self, token: str) -> Bearer:
        """Who a token speaks for.

        Raises
        ------
        NotAuthenticated
            It is forged, has ended or not begun, or is for somebody else.
        NotAllowed
            It is valid, but names no agency or not exactly one scope.
        Unavailable
            The issuer's keys could not be read yet.
        """
        claims = self._claims(token)
        agency = _claim(claims, self._issuer.agency_claim)
        if not isinstance(agency, str) or not 0 < len(agency) <= 200 or not agency.isprintable():
            raise _without(self._issuer.agency_claim, "the name of an agency")
        given = _claim(claims, self._issuer.scope_claim)
        names = given.split() if isinstance(given, str) else given if isinstance(given, list) else []
        scopes = {Scope(name) for name in names if isinstance(name, str) and name in AGENCY_SCOPES}
        if len(scopes) != 1:
            raise _without(self._issuer.scope_claim, f"one of {', '.join(AGENCY_SCOPES)}")
        subject = str(claims["sub"])
        digest = hashlib.sha256(f"{self._issuer.issuer}\n{subject}".encode("utf-8", "replace")).hexdigest()
        return Bearer(agency, f"oidc:{digest[:32]}", _label(claims, subject), scopes.pop(), _ends_at(claims))

    def _claims(self, token: str) -> dict[str, object]:
        try:
            if len(token) > MAX_TOKEN_CHARACTERS:
                raise jwt.InvalidTokenError("it is too long")
            header = jwt.get_unverified_header(token)
            if "crit" in header:
                raise jwt.InvalidTokenError("it has critical extensions")
            key = self._keys.find(header.get("kid"))
            if key is None:
                raise jwt.InvalidTokenError("its key is not the issuer's")
            claims: dict[str, object] = jwt.decode(
                token,
                key=key,
                algorithms=[key.algorithm_name],
                issuer=self._issuer.issuer,
                audience=self._issuer.audience,
                leeway=_LEEWAY_S,
                options={"require": ["exp", "iss", "aud", "sub"]},
            )
        except (jwt.InvalidTokenError, ValueError, OverflowError, RecursionError) as error:
            raise NotAuthenticated(
                f"the token is not valid: {error}"[:200],
                field="Authorization",
                limit=f"a token of {self._issuer.issuer} for {self._issuer.audience}",
                cure="sign in again",
            ) from error
        return claims


def _usable_keys(content: bytes) -> dict[str | None, jwt.PyJWK]:
    """Keys by id: those that sign, of a kind that is allowed.

    Raises
    ------
    ValueError
        It is no key set.
    """
    document = json.loads(content)
    listed = document.get("keys") if isinstance(document, dict) else None
    if not isinstance(listed, list):
        raise ValueError("it is no JSON Web Key Set")
    usable: dict[str | None, jwt.PyJWK] = {}
    for described in listed:
        if not isinstance(described, dict) or described.get("use", "sig") != "sig":
            continue
        algorithm = _ALGORITHMS.get((str(described.get("kty")), described.get("crv")))
        kid = described.get("kid")
        if algorithm is None or described.get("alg", algorithm) != algorithm or not isinstance(kid, str | None):
            continue
        try:
            key = jwt.PyJWK(described, algorithm)
        except jwt.PyJWTError:
            continue
        if algorithm != "RS256" or key.key.key_size >= _MIN_RSA_BITS:
            usable[kid] = key
    return usable


def _claim(claims: Mapping[str, object], name: str) -> object:
    if name in claims:
        return claims[name]
    found: object = claims
    for part in name.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return found


def _label(claims: Mapping[str, object], subject: str) -> str:
    name = claims.get("preferred_username")
    label = name if isinstance(name, str) and name.strip() else subject
    return "".join(c if c.isprintable() else "?" for c in label)[:200]


def _ends_at(claims: JsonObject) -> datetime:
    return datetime.fromtimestamp(min(float(claims["exp"]), 4e9), UTC)


def _without(claim: str, limit: str) -> NotAllowed:
    return NotAllowed(
        f"the token's claim {claim} has no valid value",
        field=claim,
        limit=limit,
        cure="set it in the identity provider",
    )
