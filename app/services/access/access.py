"""Who may call: agencies, their keys and what a key's scope covers."""

from __future__ import annotations

import re
import secrets
import string
import unicodedata
import zlib
from collections.abc import Callable, Collection
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Any, NamedTuple

import sqlalchemy as sa

from app.errors import InvalidParameter, NotAllowed, NotAuthenticated, Unavailable
from app.registry import agencies
from app.registry.database import Database
from app.registry.engines import across_agencies
from app.services.ports import Clock

# === What a key looks like: ``wm_``, eight characters that name it, 256 random bits, check digits; all base62.
#
# The check digits let a mistyped key be refused without a look in the database, and let scanners of repositories and
# logs find keys by ``wm_[0-9A-Za-z]{8}_[0-9A-Za-z]{43}_[0-9A-Za-z]{6}`` without false alarms.


_MARK = "wm_"
_ALPHABET = string.digits + string.ascii_uppercase + string.ascii_lowercase
_NAME, _SECRET, _CHECK = 8, 43, 6
_FORM = re.compile(rf"{_MARK}[{_ALPHABET}]{{{_NAME}}}_[{_ALPHABET}]{{{_SECRET}}}_[{_ALPHABET}]{{{_CHECK}}}")


def new_key() -> str:
    """A key with 256 random bits."""
    name = _base62(secrets.randbelow(len(_ALPHABET) ** _NAME), _NAME)
    head = f"{_MARK}{name}_{_base62(secrets.randbits(256), _SECRET)}"
    return f"{head}_{_check_digits(head)}"


def check_key(key: str) -> None:
    """Refuse what claims to be a key of this form and cannot be one; keys of other forms pass.

    Raises
    ------
    NotAuthenticated
        Characters are missing, or the check digits do not fit.
    """
    if key.startswith(_MARK) and not (_FORM.fullmatch(key) and _check_digits(key[: -_CHECK - 1]) == key[-_CHECK:]):
        raise NotAuthenticated(
            "the key is mistyped: its check digits do not fit",
            field="Authorization",
            limit=f"{len(_MARK) + _NAME + _SECRET + _CHECK + 2} characters, as they were shown",
            cure="copy the key again",
        )


def shown_part(key: str) -> str:
    """The part of a key that lists show to identify it: its name, or the first characters of a key of another form."""
    return key[: len(_MARK) + _NAME] if _FORM.fullmatch(key) else key[:4]


def _check_digits(head: str) -> str:
    return _base62(zlib.crc32(head.encode()), _CHECK)


def _base62(number: int, length: int) -> str:
    digits = []
    for _ in range(length):
        number, digit = divmod(number, len(_ALPHABET))
        digits.append(_ALPHABET[digit])
    return "".join(reversed(digits))


# === Who may call.


FIRST_AGENCY = "default"
_ENVIRONMENT = "WAYMARK_ADMIN_KEY"
_REMEMBERED_FOR = timedelta(seconds=1)
_MAX_REMEMBERED = 10_000


class Scope(StrEnum):
    """Scope of a key. app/api/http/permissions.py lists the routes of each scope, docs/access.md explains them."""

    ADMIN = "admin"
    PLANNER = "planner"
    SURVEYOR = "surveyor"
    VIEWER = "viewer"
    VEHICLE = "vehicle"
    OPERATOR = "operator"


AGENCY_SCOPES = tuple(scope for scope in Scope if scope is not Scope.OPERATOR)
"""Scopes of an agency's keys. A key of an operator creates agencies and belongs to none."""
MAX_AGENCY_NAME = 200


def parse_scope(name: str) -> Scope:
    """The scope of an agency's key with a name.

    Raises
    ------
    InvalidParameter
        There is none.
    """
    if name not in AGENCY_SCOPES:
        raise InvalidParameter(f"there is no scope {name!r}", field="scope", limit=", ".join(AGENCY_SCOPES))
    return Scope(name)


def check_agency_name(name: str, *, field: str) -> None:
    """Refuse a name that an agency cannot have.

    Raises
    ------
    InvalidParameter
        It is empty or too long, has characters that cannot be seen, or could be mistaken for another name.
    """
    limit = f"1 to {MAX_AGENCY_NAME} characters"
    cure = "choose a name that can be printed and typed"
    if not 1 <= len(name) <= MAX_AGENCY_NAME:
        message = f"the name of an agency cannot have {len(name)} characters"
    elif not name.isprintable():  # control and format characters, surrogates, separators other than the space
        character = next(character for character in name if not character.isprintable())
        message, limit = f"the name has the character U+{ord(character):04X}", "printable characters"
    elif not unicodedata.is_normalized("NFC", name):
        message, limit, cure = "the name is not in Unicode's form NFC", "NFC", "send the name normalized to NFC"
    elif name != " ".join(name.split()):
        message, limit = "the name begins or ends with a space, or has several in a row", "single spaces between words"
        cure = "remove the superfluous spaces"
    elif name == agencies.OPERATORS:
        message, limit = f"{name} is reserved for keys of the server's operators", f"any name but {name}"
    else:
        return
    raise InvalidParameter(message, field=field, limit=limit, cure=cure)


@dataclass(frozen=True, slots=True)
class Caller:
    """An authenticated caller."""

    agency_id: str  # whose rows it works on
    key_id: str  # who it is: the same for keys that replace one another
    label: str  # what histories call it
    scope: Scope

    def require(self, allowed: Collection[Scope]) -> None:
        """Refuse unless the key's scope is one of these.

        Raises
        ------
        NotAllowed
            It is not.
        """
        if self.scope not in allowed:
            limit = " or ".join(scope for scope in Scope if scope in allowed) or "nobody"
            if self.scope is Scope.OPERATOR:
                cure = "use a key of an agency; POST /v1/agencies creates an agency with its first key"
            elif Scope.OPERATOR in allowed and Scope.ADMIN not in allowed:
                cure = "ask the server's operator, who creates agencies with a key from waymark key --operator"
            else:
                cure = "ask an admin of your agency for a key with such a scope"
            raise NotAllowed(f"a key with the scope {self.scope} may not do this", limit=f"scope {limit}", cure=cure)

    @property
    def own_key_id(self) -> str | None:
        """The key whose rows alone this caller sees among its agency's: a vehicle its own, others all (None)."""
        return self.key_id if self.scope is Scope.VEHICLE else None


class Bearer(NamedTuple):
    """Who a token speaks for: the agency by its name, and when the token ends."""

    agency: str
    holder_id: str
    label: str
    scope: Scope
    expires_at: datetime


class _Remembered(NamedTuple):
    """A caller, when that was known, until when it holds, and after how many writes it was read."""

    caller: Caller
    at: datetime
    until: datetime
    writes: int


class Access:
    """Checks keys, and makes those that need no key to make them.

    Parameters
    ----------
    verify : callable, optional
        Who a token speaks for, where an issuer's tokens are taken.
    """

    def __init__(self, database: Database, clock: Clock, verify: Callable[[str], Bearer] | None = None) -> None:
        self._database = database
        self._clock = clock
        self._verify = verify
        self._uses: dict[str, datetime] = {}  # of keys, not written yet
        self._remembered: dict[str, _Remembered] = {}

    def recall(self, key: str) -> Caller | None:
        """The caller behind a key that was checked within the last second, if nothing was written since.

        Requests come in runs, and this asks no database. A key that another process revoked is refused a second later.
        """
        known = self._remembered.get(key)
        if known is None or known.writes != self._database.writes or not known.at <= self._clock() < known.until:
            return None
        return known.caller

    def was_valid(self, key: str) -> bool:
        """Whether a key was valid when it was last asked about, as far as is remembered."""
        return key in self._remembered

    def authenticate(self, key: str) -> Caller:
        """The caller behind a key, or behind a token where an issuer's are taken.

        Raises
        ------
        NotAuthenticated
            The key is mistyped, unknown, expired or revoked; the token is not valid.
        NotAllowed
            The token names no agency that is here, or no scope.
        """
        now, writes = self._clock(), self._database.writes
        ends_at: datetime | None
        try:
            if self._verify is not None and is_token(key):
                caller, ends_at = self._token_caller(self._verify(key))
            else:
                caller, ends_at = self._key_caller(key, now)
        except NotAuthenticated:
            self._remembered.pop(key, None)
            raise
        until = min(now + _REMEMBERED_FOR, ends_at or now + _REMEMBERED_FOR)
        if len(self._remembered) >= _MAX_REMEMBERED:
            self._remembered.clear()
        self._remembered[key] = _Remembered(caller, now, until, writes)
        return caller

    def _key_caller(self, key: str, now: datetime) -> tuple[Caller, datetime | None]:
        check_key(key)
        with across_agencies(), self._database.read() as connection:
            row = agencies.find_key(connection, key)
        if row is None or row.revoked_at is not None or (row.expires_at is not None and row.expires_at <= now):
            raise NotAuthenticated(
                "the key is unknown, expired or revoked", field="Authorization", cure="ask your agency for a valid key"
            )
        self._uses[row.id] = now
        return Caller(row.agency_id, row.holder_id, row.label, Scope(row.scope)), row.expires_at

    def _token_caller(self, bearer: Bearer) -> tuple[Caller, datetime]:
        with across_agencies(), self._database.read() as connection:
            agency_id = agencies.find_agency(connection, bearer.agency)
        if agency_id is None:
            raise NotAllowed(
                "the token's agency is not on this server",
                limit="the name of an agency that has a key here",
                cure="have the operator make a key for it: waymark key AGENCY",
            )
        return Caller(agency_id, bearer.holder_id, bearer.label, bearer.scope), bearer.expires_at

    def agency_name(self, caller: Caller) -> str:
        """Name of a caller's agency."""
        with self._database.read() as connection:
            return agencies.get_agency_name(connection, caller.agency_id)

    def last_use(self, key: agencies.KeyRow) -> datetime | None:
        """When a key was last used, as far as this process knows."""
        times = (key.last_used_at, self._uses.get(key.id))
        return max((time for time in times if time is not None), default=None)

    def write_uses(self) -> None:
        """Store which keys were used since the last time. Called once a minute: no request waits for it."""
        taken, self._uses = self._uses, {}
        uses = dict(taken)  # a request may still be adding to it
        if not uses:
            return
        try:
            with across_agencies(), self._database.write() as connection:
                agencies.write_uses(connection, uses)
        except (Unavailable, sa.exc.SQLAlchemyError):
            self._uses = {**uses, **self._uses}  # next time

    def ensure_first_key(self, admin_key: str | None = None) -> str | None:
        """On an empty database create an agency with an admin key; afterwards keep `admin_key` in step.

        Returns
        -------
        str or None
            The key to show once, if one was made up here.
        """
        now = self._clock()
        if admin_key is not None:
            _check_given_key(admin_key)
        with across_agencies(), self._database.write() as connection:
            first = agencies.find_first_agency(connection)
            agency_id = first or agencies.add_agency(connection, FIRST_AGENCY, now)
            if admin_key is not None:
                known = agencies.find_key(connection, admin_key)
                agencies.revoke_keys_labelled(connection, _ENVIRONMENT, now)
                if known is None:
                    add_key(connection, admin_key, agency_id=agency_id, scope=Scope.ADMIN, label=_ENVIRONMENT, now=now)
                elif known.label == _ENVIRONMENT:
                    agencies.restore_key(connection, known.id)
                return None
            if first is not None:
                return None
            key = new_key()
            add_key(connection, key, agency_id=agency_id, scope=Scope.ADMIN, label="first admin key", now=now)
            return key

    def create_key(self, agency: str, scope: Scope, label: str, expires_at: datetime | None = None) -> str:
        """A new key for an agency, which is created if there is none of that name. Shown once, stored as a hash."""
        if scope not in AGENCY_SCOPES:
            raise InvalidParameter(
                f"an agency has no key with the scope {scope}", field="scope", limit=", ".join(AGENCY_SCOPES)
            )
        now = self._clock()
        key = new_key()
        with across_agencies(), self._database.write() as connection:
            agency_id = agencies.find_agency(connection, agency)
            if agency_id is None:
                check_agency_name(agency, field="agency")
                agency_id = agencies.add_agency(connection, agency, now)
            add_key(connection, key, agency_id=agency_id, scope=scope, label=label, now=now, expires_at=expires_at)
        return key

    def create_operator_key(self, label: str, expires_at: datetime | None = None) -> str:
        """A new key with which an operator creates agencies over HTTP. Shown once, stored as a hash."""
        now = self._clock()
        key = new_key()
        with across_agencies(), self._database.write() as connection:
            agency_id = agencies.ensure_operators(connection, now)
            add_key(
                connection, key, agency_id=agency_id, scope=Scope.OPERATOR, label=label, now=now, expires_at=expires_at
            )
        return key


def is_token(key: str) -> bool:
    """Whether a key has the form of a JWT: three parts, the first a JSON object in base64."""
    return key.startswith("eyJ") and key.count(".") == 2


def add_key(connection: sa.Connection, key: str, *, agency_id: str, scope: Scope, label: str, **more: Any) -> str:
    """Store a key with what lists show of it; returns its id."""
    return agencies.add_key(
        connection, key, agency_id=agency_id, scope=scope, label=label, prefix=shown_part(key), **more
    )


def _check_given_key(key: str) -> None:
    try:
        check_key(key)
    except NotAuthenticated as error:
        raise InvalidParameter(
            error.message, field="WAYMARK_ADMIN_KEY", cure="copy it again, or take a key that does not start with wm_"
        ) from error
