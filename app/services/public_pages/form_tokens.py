"""Tokens of forms that need no key: signed, for one marker, and valid for some hours.

A token holds the time at which the form was made. A program that sends the form at once is refused, and so is one that
keeps the token for long. Its nonce identifies the form: one that is sent twice is one report.
"""

from __future__ import annotations

import base64
import binascii
import hmac
import secrets
from collections.abc import Callable
from datetime import datetime

from app.services.ports import Clock

MIN_AGE_S = 3
"""Nobody fills the form in faster. [s] Source: chosen by hand."""
MAX_AGE_S = 6 * 3600
"""Time in which a form has to be sent. [s] Source: chosen by hand: photographed on the road, sent at home."""
_CLOCK_ERROR_S = 60
"""How far the clocks of servers may differ. [s] Source: chosen by hand."""
_PURPOSE = b"waymark damage report form 1"
_TIME_BYTES, _NONCE_BYTES, _TAG_BYTES = 6, 12, 16


class TokenRefused(ValueError):
    """A form has no valid token."""


class TokenTooYoung(TokenRefused):
    """A form was sent sooner than a person can fill it in."""


class FormTokens:
    """Makes and checks tokens.

    Parameters
    ----------
    secret : callable
        The server's master key, from which the key of tokens is derived; asked for at the first use.
    clock : Clock
    """

    def __init__(self, secret: Callable[[], bytes], clock: Clock) -> None:
        self._secret, self._clock = secret, clock

    def issue(self, marker_id: str, at: datetime | None = None) -> str:
        """A new token for a marker's form, made at a time; now by default."""
        issued_s = int((at or self._clock()).timestamp())
        signed = issued_s.to_bytes(_TIME_BYTES, "big") + secrets.token_bytes(_NONCE_BYTES)
        return base64.urlsafe_b64encode(signed + self._tag(marker_id, signed)).decode()

    def check(self, marker_id: str, token: str) -> str:
        """The nonce of a token, in hexadecimal digits.

        Raises
        ------
        TokenTooYoung
            The form was made a moment ago.
        TokenRefused
            The token is not one of a form of this marker, or it has expired.
        """
        signed, tag = self._parts(token)
        if not hmac.compare_digest(tag, self._tag(marker_id, signed)):
            raise TokenRefused("the token is not one of this form")
        age_s = self._clock().timestamp() - int.from_bytes(signed[:_TIME_BYTES], "big")
        if not -_CLOCK_ERROR_S <= age_s <= MAX_AGE_S:
            raise TokenRefused(f"the form is older than {MAX_AGE_S} s")
        if age_s < MIN_AGE_S:
            raise TokenTooYoung(f"the form was sent within {MIN_AGE_S} s")
        return signed[_TIME_BYTES:].hex()

    def _parts(self, token: str) -> tuple[bytes, bytes]:
        try:
            content = base64.b64decode(token.encode("ascii"), altchars=b"-_", validate=True)
        except (binascii.Error, UnicodeEncodeError):
            content = b""
        if len(content) != _TIME_BYTES + _NONCE_BYTES + _TAG_BYTES:
            raise TokenRefused("the token is not one of a form")
        return content[:-_TAG_BYTES], content[-_TAG_BYTES:]

    def _tag(self, marker_id: str, signed: bytes) -> bytes:
        key = hmac.digest(self._secret(), _PURPOSE, "sha256")
        return hmac.digest(key, signed + marker_id.encode(), "sha256")[:_TAG_BYTES]
