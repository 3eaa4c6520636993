"""Time on air against published figures."""

from __future__ import annotations

import pytest

from app.errors import InvalidParameter
from app.radio.settings import time_on_air_s

PUBLISHED_MS = [
    (20, 7, 125_000, 56.576),
    (20, 8, 125_000, 102.912),
    (20, 9, 125_000, 185.344),
    (20, 10, 125_000, 370.688),
    (20, 7, 500_000, 14.144),
    (20, 8, 500_000, 25.728),
    (20, 9, 500_000, 46.336),
    (20, 10, 500_000, 92.672),
    (27, 7, 125_000, 66.816),
    (27, 8, 125_000, 123.392),
    (27, 9, 125_000, 226.304),
    (27, 10, 125_000, 411.648),
    (13, 9, 125_000, 164.864),
    (12, 9, 125_000, 144.384),
]


@pytest.mark.parametrize(("payload_bytes", "spreading_factor", "bandwidth_hz", "expected_ms"), PUBLISHED_MS)
def test_time_on_air_is_as_published(
    payload_bytes: int, spreading_factor: int, bandwidth_hz: int, expected_ms: float
) -> None:
    assert 1000 * time_on_air_s(payload_bytes, spreading_factor, bandwidth_hz) == pytest.approx(expected_ms, abs=1e-6)


@pytest.mark.parametrize(("low_data_rate", "expected_ms"), [(False, 2465.792), (True, 2793.472), (None, 2793.472)])
def test_long_symbols_take_the_low_data_rate_optimisation(low_data_rate: bool | None, expected_ms: float) -> None:
    measured_s = time_on_air_s(64, 12, 125_000, low_data_rate=low_data_rate)
    assert 1000 * measured_s == pytest.approx(expected_ms, abs=1e-6)


def test_a_message_is_the_most_that_sf10_sends_in_400_ms() -> None:
    assert time_on_air_s(24, 10, 125_000) <= 0.4 < time_on_air_s(25, 10, 125_000)


def test_preamble_coding_crc_and_header_count() -> None:
    plain = time_on_air_s(24, 9, 125_000)
    symbol_s = 512 / 125_000
    assert time_on_air_s(24, 9, 125_000, preamble_symbols=18) == pytest.approx(plain + 10 * symbol_s)
    # 8 * 24 - 4 * 9 + 28 + 16 = 200 bits in 6 blocks of 36; 184 bits without CRC are 6 too; 180 without header 5.
    assert time_on_air_s(24, 9, 125_000, coding_rate=8) == pytest.approx(plain + 6 * 3 * symbol_s)
    assert time_on_air_s(24, 9, 125_000, crc=False) == plain
    assert time_on_air_s(24, 9, 125_000, explicit_header=False) == pytest.approx(plain - 5 * symbol_s)


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"spreading_factor": 5}, "spreading_factor"),
        ({"spreading_factor": 13}, "spreading_factor"),
        ({"spreading_factor": 6}, "spreading_factor"),
        ({"spreading_factor": 7.5}, "spreading_factor"),
        ({"bandwidth_hz": 125}, "bandwidth_hz"),
        ({"bandwidth_hz": 0}, "bandwidth_hz"),
        ({"payload_bytes": -1}, "payload_bytes"),
        ({"payload_bytes": 256}, "payload_bytes"),
        ({"payload_bytes": float("nan")}, "payload_bytes"),
        ({"coding_rate": 4}, "coding_rate"),
        ({"preamble_symbols": 5}, "preamble_symbols"),
    ],
)
def test_what_the_radio_cannot_do_is_refused(values: dict[str, float], field: str) -> None:
    settings: dict[str, object] = {"payload_bytes": 24, "spreading_factor": 9, "bandwidth_hz": 125_000} | values
    with pytest.raises(InvalidParameter) as caught:
        time_on_air_s(**settings)  # type: ignore[arg-type]
    assert caught.value.field == field
    assert caught.value.limit
