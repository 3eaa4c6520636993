"""Digits of many plates at once are those of each by itself."""

from __future__ import annotations

import numpy as np
import pytest

from app.markers.plate import PlateCode, PlateScheme, id_digits, position_digits, registry_number_bits

TIES = [0.0000005, 1.2345675, 8.0, 179.9999995, 179.99999951, 12.3456785, 0.1 + 0.2, -0.0000015, 99.9999995]


CASES = [
    *((n, PlateScheme.POSITION, 0) for n in (8, 10, 12)),
    *((n, PlateScheme.POSITION_CHECK, checks) for n, checks in ((8, 1), (8, 2), (10, 2), (12, 1))),
    *((n, PlateScheme.POSITION_ROBUST, 0) for n in (10, 12)),
]


@pytest.mark.parametrize(("n", "scheme", "checks"), CASES)
def test_position_digits_are_those_of_each_plate(n: int, scheme: PlateScheme, checks: int) -> None:
    rng = np.random.default_rng(3)
    lon = np.array([*rng.uniform(-180, 180, 1500), *TIES])
    lat = np.array([*rng.uniform(-90, 90, 1500), *(v / 2 for v in TIES)])
    lon[:500], lat[:500] = np.round(lon[:500], 7), np.round(lat[:500], 7)
    wanted = [
        PlateCode.from_position(x, y, n=n, scheme=scheme, check_digits=checks).digits
        for x, y in zip(lon.tolist(), lat.tolist(), strict=True)
    ]
    assert [d.decode() for d in position_digits(lon, lat, n=n, scheme=scheme, check_digits=checks)] == wanted


@pytest.mark.parametrize("n", [8, 10, 12])
def test_id_digits_are_those_of_each_number(n: int) -> None:
    bits = registry_number_bits(n)
    rng = np.random.default_rng(4)
    numbers = [0, 1, 2**bits - 1, *(int.from_bytes(rng.bytes(bits // 8), "big") for _ in range(300))]
    wanted = [PlateCode.from_registry_number(number, n=n).digits for number in numbers]
    assert [d.decode() for d in id_digits(np.array(numbers, dtype=np.uint64), n=n)] == wanted
