"""Time on air of LoRa packets."""

from __future__ import annotations

import math

from app.errors import InvalidParameter

SPREADING_FACTORS = (6, 7, 8, 9, 10, 11, 12)  # 6 only without a header; source: SX1276 data sheet, 4.1.1.2
BANDWIDTHS_HZ = (125_000, 250_000, 500_000)  # [Hz] source: SX1276 data sheet, table 10, sensitivities near 900 MHz
CODING_RATES = (5, 6, 7, 8)  # bits sent for four of data; source: SX1276 data sheet, 4.1.1.3
MAX_PAYLOAD_BYTES = 255  # [bytes] source: one byte of length in the header
PREAMBLE_SYMBOLS = (6, 65535)  # shortest and longest; source: SX1276 data sheet, 4.1.1.6
LONG_SYMBOL_S = 0.016  # [s] longer symbols need the low data rate optimisation; source: SX1276 data sheet, 4.1.1.6
_SYNC_SYMBOLS = 4.25  # that the radio adds to the preamble; source: SX1276 data sheet, 4.1.1.7


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
        All bytes that the radio sends, 0 to 255; with LoRaWAN its 13 bytes too. [bytes]
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
    """Duration of one symbol. [s]"""
    return float(2**spreading_factor / bandwidth_hz)


def check_modulation(spreading_factor: int, bandwidth_hz: int, *, explicit_header: bool = True) -> None:
    """Raises InvalidParameter if the radio does not have the spreading factor or the bandwidth."""
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
    """Raises InvalidParameter if a value is not a whole number within limits."""
    if not low <= value <= high or value != int(value):
        raise InvalidParameter(
            f"{name} is {value:g}", field=name, limit=f"a whole number from {low} to {high} {unit}".rstrip()
        )


def check_between(name: str, value: float, low: float, high: float, unit: str) -> None:
    """Raises InvalidParameter if a value is outside its limits or NaN."""
    if not low <= value <= high:
        raise InvalidParameter(
            f"{name} is {value:g} {unit}".rstrip(), field=name, limit=f"{low:g} to {high:g} {unit}".rstrip()
        )
