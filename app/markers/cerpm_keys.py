"""Keys of CERPMs and the tag of their messages: AES-CMAC throughout, the same for both directions.

Sources: RFC 4493 (AES-CMAC), NIST SP 800-108r1 section 4.1 (key derivation in counter mode), NIST SP 800-38B appendix A
(short tags). Decision 0015 has the reasons for the length of the tag and the limits on guesses.
"""

from __future__ import annotations

import math

from cryptography.hazmat.primitives.ciphers.algorithms import AES
from cryptography.hazmat.primitives.cmac import CMAC
from cryptography.hazmat.primitives.kdf.kbkdf import KBKDFCMAC, CounterLocation, Mode

from app.errors import InvalidParameter
from app.markers.cerpm import BODY_BYTES, KEY_BYTES, MAX_NUMBER, TAG_BYTES

AGENCY_KEY_BYTES = (16, 32)  # [bytes] source: AES-128 and AES-256
KEY_LABEL = b"waymark cerpm v1"  # purpose of the derived keys; another message version needs another label
MAX_INVALID_TAGS_PER_LOG = 1_000
"""Tags that may fail in one log before the rest is left unchecked. Source: one transmitter at SF7 and 125 kHz sends 972
messages of 24 bytes in a minute, about as long as a vehicle is within its range (decision 0015)."""
MAX_INVALID_TAGS_PER_DAY = 10_000
"""The same for all logs of one API key in a day (UTC). Source: ten logs as above; with it one key forges a message in a
year with a probability of 0.085 % (decision 0015)."""
_COUNTER_BYTES = 4  # [bytes] source: NIST SP 800-108r1, section 4.1, r = 32


def derive_marker_key(agency_key: bytes, number: int) -> bytes:
    """The key of one marker, from its agency's.

    Parameters
    ----------
    agency_key : bytes
        16 or 32 of them; never leaves the server.
    number : int
        Of the marker within its agency.

    Returns
    -------
    bytes
        16 of them, programmed into the marker. Whoever opens a marker learns only its own key.

    Raises
    ------
    InvalidParameter
        The agency's key has another length, or the number does not fit 32 bits.

    Notes
    -----
    NIST SP 800-108r1 in counter mode with AES-CMAC. For the one block of 128 bits that is needed this is
    ``CMAC(agency_key, 00000001 || "waymark cerpm v1" || 00 || number || 00000080)``, integers of 4 bytes, big endian.
    """
    if len(agency_key) not in AGENCY_KEY_BYTES:
        raise InvalidParameter(
            f"an agency's key has {len(agency_key)} bytes",
            field="agency_key",
            limit="16 or 32 bytes",
            cure="make one from 16 or 32 random bytes",
        )
    if not 1 <= number <= MAX_NUMBER:
        raise InvalidParameter(f"number is {number}", field="number", limit=f"1 to {MAX_NUMBER}")
    derivation = KBKDFCMAC(
        algorithm=AES,
        mode=Mode.CounterMode,
        length=KEY_BYTES,
        rlen=_COUNTER_BYTES,
        llen=_COUNTER_BYTES,
        location=CounterLocation.BeforeFixed,
        label=KEY_LABEL,
        context=number.to_bytes(4),
        fixed=None,
    )
    return derivation.derive(agency_key)


def message_tag(key: bytes, body: bytes) -> bytes:
    """The tag of a message: the first four bytes of AES-CMAC over its body.

    Parameters
    ----------
    key : bytes
        The marker's own, 16 bytes.
    body : bytes
        Bytes 0 to 19 of a message.

    Returns
    -------
    bytes
        4 of them. Compare tags with `hmac.compare_digest`.

    Raises
    ------
    InvalidParameter
        The key or the body has another length.

    Notes
    -----
    RFC 4493, section 2.4, which recommends at least 64 bits. The message has room for 32 (decision 0015): one guess in
    2^32 is right, and the number of guesses is limited.
    """
    for name, value, length in (("key", key, KEY_BYTES), ("body", body, BODY_BYTES)):
        if len(value) != length:
            raise InvalidParameter(
                f"the {name} has {len(value)} bytes",
                field=name,
                limit=f"{length} bytes",
                cure="tags are made over bytes 0 to 19 of a message, with the key of its marker",
            )
    return aes_cmac(key, body)[:TAG_BYTES]


def forgery_probability(invalid_tags: float, tag_bytes: int = TAG_BYTES) -> float:
    """Probability that at least one of a number of guessed tags is valid.

    Parameters
    ----------
    invalid_tags : float
        Guesses that the limits allow, >= 0.
    tag_bytes : int
        Length of a tag. [bytes]

    Notes
    -----
    NIST SP 800-38B, appendix A.2: each guess is right with the probability 2^-bits, independently of the others.
    """
    return -math.expm1(invalid_tags * math.log1p(-(2.0 ** (-8 * tag_bytes))))


def aes_cmac(key: bytes, data: bytes) -> bytes:
    """AES-CMAC of RFC 4493, 16 bytes."""
    mac = CMAC(AES(key))
    mac.update(data)
    return mac.finalize()
