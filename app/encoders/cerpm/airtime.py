"""How long a LoRa packet is on the air."""

from __future__ import annotations

import math

from app.errors import InvalidParameter

SPREADING_FACTORS = (6, 7, 8, 9, 10, 11, 12)
"""Of the SX1276; 6 only without a header."""
BANDWIDTHS_HZ = (125_000, 250_000, 500_000)
"""Those that the SX1276 names a sensitivity for near 900 MHz and that need no better clock than a crystal. [Hz]"""
CODING_RATES = (5, 6, 7, 8)
"""Bits sent for four of data."""
MAX_PAYLOAD_BYTES = 255
PREAMBLE_SYMBOLS = (6, 65535)
LONG_SYMBOL_S = 0.016
"""Symbols that last longer need the low data rate optimisation. [s]"""
_SYNC_SYMBOLS = 4.25


def time_on_air_s(
    payload_bytes: int,
    spreading_factor: int,
    bandwidth_hz: int,
    *,
    coding_rate: int = 5,
    preamble_symbols: int = 8,
    crc: bool = True,
    explicit_header: bool = True,
    low_data_rate: bool | None = None,
) -> float:
    """Time on air of one packet.

    Parameters
    ----------
    payload_bytes : int
        All that the radio is given to send, 0 to 255; of LoRaWAN its 13 bytes too. [bytes]
    spreading_factor : int
        6 to 12; 6 needs `explicit_header` false.
    bandwidth_hz : int
        125,000, 250,000 or 500,000. [Hz]
    coding_rate : int
        Bits sent for four of data, 5 to 8: 5 is 4/5.
    preamble_symbols : int
        As programmed, 6 to 65,535; the radio adds 4.25.
    crc, explicit_header : bool
    low_data_rate : bool, optional
        Low data rate optimisation; by default where a symbol lasts over 16 ms.

    Returns
    -------
    float
        [s]

    Raises
    ------
    InvalidParameter
        A value is outside its limits.

    Notes
    -----
    Semtech SX1276/77/78/79 data sheet, revision 7, section 4.1.1.7.
    """
    check_modulation(spreading_factor, bandwidth_hz, explicit_header=explicit_header)
    check_whole("payload_bytes", payload_bytes, 0, MAX_PAYLOAD_BYTES, "bytes")
    check_whole("coding_rate", coding_rate, CODING_RATES[0], CODING_RATES[-1], "bits for four of data")
    check_whole("preamble_symbols", preamble_symbols, *PREAMBLE_SYMBOLS, "symbols")
    symbol_s = symbol_time_s(spreading_factor, bandwidth_hz)
    optimised = symbol_s > LONG_SYMBOL_S if low_data_rate is None else low_data_rate
    bits = 8 * payload_bytes - 4 * spreading_factor + 28 + 16 * crc - 20 * (not explicit_header)
    blocks = math.ceil(bits / (4 * (spreading_factor - 2 * optimised)))
    payload_symbols = 8 + max(blocks * coding_rate, 0)
    return (preamble_symbols + _SYNC_SYMBOLS + payload_symbols) * symbol_s


def symbol_time_s(spreading_factor: int, bandwidth_hz: int) -> float:
    """How long one symbol lasts. [s]"""
    return float(2**spreading_factor / bandwidth_hz)


def check_modulation(spreading_factor: int, bandwidth_hz: int, *, explicit_header: bool = True) -> None:
    """Refuse a spreading factor or a bandwidth that the radio does not have."""
    check_whole("spreading_factor", spreading_factor, SPREADING_FACTORS[0], SPREADING_FACTORS[-1], "")
    if bandwidth_hz not in BANDWIDTHS_HZ:
        raise InvalidParameter(
            f"bandwidth_hz is {bandwidth_hz}",
            field="bandwidth_hz",
            limit=", ".join(f"{hz:d}" for hz in BANDWIDTHS_HZ) + " Hz",
            cure="give the bandwidth in hertz",
        )
    if spreading_factor == SPREADING_FACTORS[0] and explicit_header:
        raise InvalidParameter(
            "spreading factor 6 has no room for a header",
            field="spreading_factor",
            limit="7 to 12 with a header",
            cure="leave the header out, which fixes the length of packets, or use 7",
        )


def check_whole(name: str, value: float, low: int, high: int, unit: str) -> None:
    """Refuse a value that is not a whole number within limits."""
    if not low <= value <= high or value != int(value):
        raise InvalidParameter(
            f"{name} is {value:g}", field=name, limit=f"a whole number from {low} to {high} {unit}".rstrip()
        )


def check_between(name: str, value: float, low: float, high: float, unit: str) -> None:
    """Refuse a value outside its limits, or none at all."""
    if not low <= value <= high:
        raise InvalidParameter(
            f"{name} is {value:g} {unit}".rstrip(), field=name, limit=f"{low:g} to {high:g} {unit}".rstrip()
        )
