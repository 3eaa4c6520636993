"""What a key looks like: ``wm_``, eight characters that name it, 256 random bits, check digits; all base62.

The check digits let a mistyped key be refused without a look in the database, and let scanners of repositories and logs
find keys by ``wm_[0-9A-Za-z]{8}_[0-9A-Za-z]{43}_[0-9A-Za-z]{6}`` without false alarms.
"""

from __future__ import annotations

import re
import secrets
import string
import zlib

from app.errors import NotAuthenticated

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
