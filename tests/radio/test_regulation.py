"""Rules of the United States and of Europe."""

from __future__ import annotations

from dataclasses import replace

import pytest

from app.errors import InvalidParameter
from app.markers.reading import RadioFinding, Verdict
from app.radio.regulation import FIELD_EIRP_DBM, check_legal, check_transmitter, is_permitted, region_at
from app.radio.settings import RadioSettings, Region

HOPPING = RadioSettings(
    frequency_hz=902_300_000, bandwidth_hz=125_000, spreading_factor=10, interval_s=2.0, power_dbm=17.0, channels=64,
    hopping=True,
)  # fmt: skip
EUROPE = RadioSettings(
    frequency_hz=868_100_000, bandwidth_hz=125_000, spreading_factor=7, interval_s=10.0, power_dbm=14.0
)


def findings(settings: RadioSettings, region: Region = Region.US915) -> dict[str, RadioFinding]:
    found = check_legal(settings, region)
    assert len({finding.name for finding in found}) == len(found)
    return {finding.name: finding for finding in found}


def test_500_khz_on_one_channel_is_digital_modulation() -> None:
    found = findings(RadioSettings())
    assert {finding.verdict for finding in found.values()} == {Verdict.OK}
    assert found["digital-bandwidth"].source == "47 CFR 15.247(a)(2)"
    # 20 dBm over 166.7 slices of 3 kHz.
    assert found["power-density"].figure == pytest.approx(-2.218, abs=1e-3)


@pytest.mark.parametrize("bandwidth_hz", [125_000, 250_000])
@pytest.mark.parametrize("channels", [1, 64])
def test_a_fixed_beacon_in_a_narrow_channel_fits_neither_rule(bandwidth_hz: int, channels: int) -> None:
    settings = RadioSettings(frequency_hz=902_300_000, bandwidth_hz=bandwidth_hz, channels=channels, interval_s=5.0)
    finding = findings(settings)["fixed-narrow-channel"]
    assert finding.verdict is Verdict.WARN
    assert "15.247(a)(1)(i), (a)(2)" in finding.source
    assert "no hopping system" in finding.sentence
    assert "no digital modulation" in finding.sentence
    assert not is_permitted(settings, Region.US915)


def test_a_whisper_in_a_narrow_channel_is_allowed_by_field_strength() -> None:
    assert pytest.approx(-1.249, abs=1e-3) == FIELD_EIRP_DBM
    settings = RadioSettings(bandwidth_hz=125_000, interval_s=5.0, power_dbm=-4.0, antenna_gain_dbi=2.15)
    assert is_permitted(settings, Region.US915)
    assert not is_permitted(replace(settings, power_dbm=-3.0), Region.US915)


def test_hopping_over_50_narrow_channels_is_allowed_up_to_400_ms() -> None:
    assert 0.37 < HOPPING.time_on_air_s < 0.4
    assert is_permitted(HOPPING, Region.US915)
    slow = replace(HOPPING, spreading_factor=11, interval_s=20.0)
    found = findings(slow)
    assert found["dwell-time"].verdict is Verdict.FAIL
    assert found["dwell-time"].figure == pytest.approx(slow.time_on_air_s)


def test_dwell_counts_all_packets_on_one_channel_in_20_s() -> None:
    # 64 channels, a packet each 0.2 s: 1.56 packets on a channel in 20 s, 2 at worst.
    fast = replace(HOPPING, spreading_factor=9, interval_s=0.25, jitter_share=0.1)
    assert findings(fast)["dwell-time"].figure == pytest.approx(2 * fast.time_on_air_s)
    assert is_permitted(replace(fast, interval_s=0.32), Region.US915)


def test_too_few_channels_are_a_hybrid_at_best() -> None:
    found = findings(replace(HOPPING, channels=8, interval_s=5.0))
    assert found["hopping-channels"].verdict is Verdict.WARN
    assert "(f)" in found["hopping-channels"].source
    assert found["dwell-time"].source == "47 CFR 15.247(f)"
    assert found["power-density"].verdict is Verdict.OK


def test_wide_hopping_channels_need_25_and_less_power_below_50() -> None:
    settings = replace(HOPPING, bandwidth_hz=250_000, channels=25)
    found = findings(settings)
    assert found["hopping-channels"].limit == 25
    assert found["power"].limit == 24.0
    assert is_permitted(settings, Region.US915)
    assert not is_permitted(replace(settings, channels=24), Region.US915)


def test_500_khz_does_not_hop() -> None:
    settings = RadioSettings(frequency_hz=902_500_000, bandwidth_hz=500_000, channels=30, hopping=True)
    assert findings(settings)["hopping-bandwidth"].verdict is Verdict.WARN


@pytest.mark.parametrize(("frequency_hz", "legal"), [(902_250_000, True), (902_200_000, False), (927_800_000, False)])
def test_channels_lie_within_the_band(frequency_hz: int, legal: bool) -> None:
    assert is_permitted(RadioSettings(frequency_hz=frequency_hz), Region.US915) is legal


def test_all_channels_lie_within_the_band() -> None:
    settings = RadioSettings(frequency_hz=915_000_000)
    assert is_permitted(replace(settings, channels=16), Region.US915)
    assert not is_permitted(replace(settings, channels=17), Region.US915)


@pytest.mark.parametrize(
    ("frequency_hz", "duty_cycle"),
    [
        (864_000_000, 0.001),
        (867_100_000, 0.01),
        (868_300_000, 0.01),
        (868_950_000, 0.001),
        (869_525_000, 0.1),
        (869_850_000, 0.01),
    ],
)
def test_sub_bands_have_their_duty_cycles(frequency_hz: int, duty_cycle: float) -> None:
    settings = replace(EUROPE, frequency_hz=frequency_hz)
    min_s = settings.time_on_air_s / duty_cycle
    allowed = findings(replace(settings, interval_s=min_s * 1.001), Region.EU868)
    assert allowed["duty-cycle"].verdict is Verdict.OK
    broken = findings(replace(settings, interval_s=min_s * 0.99), Region.EU868)
    assert broken["duty-cycle"].verdict is Verdict.FAIL
    assert broken["duty-cycle"].limit == duty_cycle


def test_europe_counts_power_against_a_dipole() -> None:
    found = findings(EUROPE, Region.EU868)
    assert found["power"].figure == pytest.approx(14.0)
    assert found["power"].verdict is Verdict.OK
    assert findings(replace(EUROPE, power_dbm=17.0), Region.EU868)["power"].verdict is Verdict.FAIL
    loud = replace(EUROPE, frequency_hz=869_525_000, power_dbm=20.0)
    assert findings(loud, Region.EU868)["power"].verdict is Verdict.OK


def test_frequencies_of_another_region_are_in_no_band() -> None:
    (finding,) = check_legal(RadioSettings(), Region.EU868)
    assert finding.verdict is Verdict.FAIL
    assert finding.figure == pytest.approx(45.0)
    assert findings(EUROPE)["band"].verdict is Verdict.FAIL


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"frequency_hz": 433_000_000}, "frequency_hz"),
        ({"interval_s": 0.01}, "interval_s"),
        ({"interval_s": float("nan")}, "interval_s"),
        ({"jitter_share": 0.95}, "jitter_share"),
        ({"power_dbm": 21.0}, "power_dbm"),
        ({"antenna_gain_dbi": 9.0}, "antenna_gain_dbi"),
        ({"channels": 0}, "channels"),
        ({"hopping": True}, "channels"),
        ({"spreading_factor": 6}, "spreading_factor"),
        ({"explicit_header": False, "lorawan": True}, "explicit_header"),
        ({"spreading_factor": 12, "bandwidth_hz": 125_000, "interval_s": 1.0}, "interval_s"),
    ],
)
def test_settings_that_no_radio_has_are_refused(values: dict[str, object], field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        RadioSettings(**values)  # type: ignore[arg-type]
    assert caught.value.field == field
    assert caught.value.limit


@pytest.mark.parametrize(
    ("bandwidth_hz", "max_dbm"),
    [(125_000, 7.169), (250_000, 10.179), (500_000, 13.190)],  # 6.2 dBm + 10 log10(bandwidth / 100 kHz)
)
def test_865_to_868_mhz_limits_the_power_in_any_100_khz(bandwidth_hz: int, max_dbm: float) -> None:
    settings = replace(EUROPE, frequency_hz=867_000_000, bandwidth_hz=bandwidth_hz, power_dbm=max_dbm - 0.01)
    assert findings(settings, Region.EU868)["power-density"].verdict is Verdict.OK
    dense = replace(settings, power_dbm=max_dbm + 0.01)
    assert findings(dense, Region.EU868)["power-density"].verdict is Verdict.WARN
    assert not is_permitted(dense, Region.EU868)
    assert "power-density" not in findings(replace(dense, frequency_hz=868_300_000), Region.EU868)


def test_the_transmitter_sends_one_percent_of_the_time_above_17_dbm() -> None:
    often = RadioSettings(interval_s=1.0)
    assert check_transmitter(replace(often, power_dbm=17.0)) == ()
    (finding,) = check_transmitter(often)
    assert finding.verdict is Verdict.FAIL
    assert finding.figure == pytest.approx(0.0154, abs=1e-4)  # a packet of 15.4 ms every second
    assert not is_permitted(often, Region.US915)
    assert is_permitted(replace(often, interval_s=1.6), Region.US915)


def test_the_default_settings_are_permitted_where_their_frequency_is() -> None:
    assert is_permitted(RadioSettings(), Region.US915)


def test_the_region_of_a_place_is_known_inside_of_it_only() -> None:
    places = {
        Region.US915: {"Kalamazoo": (-85.6, 42.3), "Detroit suburbs": (-83.5, 42.4), "Seattle": (-122.3, 47.6),
                       "Miami": (-80.2, 25.8), "New York": (-74.0, 40.7), "Anchorage": (-149.9, 61.2),
                       "Honolulu": (-157.9, 21.3), "Houston": (-95.4, 29.8)},
        Region.EU868: {"Karlsruhe": (8.4, 49.0), "Gothenburg": (12.0, 57.6), "Madrid": (-3.7, 40.4),
                       "London": (-0.1, 51.5), "Warsaw": (21.0, 52.2), "Athens": (23.7, 38.0), "Rome": (12.5, 41.9),
                       "Riga": (24.1, 56.9), "Tampere": (23.8, 61.5), "Bucharest": (26.1, 44.4)},
        None: {"Toronto": (-79.4, 43.7), "Vancouver": (-123.1, 49.3), "Victoria": (-123.4, 48.4),
               "Windsor": (-83.0, 42.3), "Kingston": (-76.5, 44.2), "Montreal": (-73.6, 45.5),
               "Sault Ste. Marie": (-84.3, 46.5), "Thunder Bay": (-89.2, 48.4), "Tijuana": (-117.0, 32.5),
               "Ciudad Juarez": (-106.5, 31.7), "Nuevo Laredo": (-99.5, 27.5), "Matamoros": (-97.5, 25.9),
               "Nassau": (-77.3, 25.1), "Freeport": (-78.7, 26.5), "Havana": (-82.4, 23.1),
               "Kaliningrad": (20.5, 54.7), "Minsk": (27.6, 53.9), "Brest": (23.7, 52.1), "Grodno": (23.8, 53.7),
               "Pskov": (28.3, 57.8), "Saint Petersburg": (30.3, 59.9), "Murmansk": (33.1, 69.0),
               "Chisinau": (28.9, 47.0), "Pristina": (21.2, 42.7), "Tunis": (10.2, 36.8), "Algiers": (3.1, 36.8),
               "Tangier": (-5.8, 35.8), "Hong Kong": (114.2, 22.3), "Sydney": (151.2, -33.9)},
    }  # fmt: skip
    for region, found in places.items():
        for name, (lon_deg, lat_deg) in found.items():
            assert region_at(lon_deg, lat_deg) is region, name


# --- polite spectrum access ---------------------------------------------------------------------------------------


POLITE = replace(EUROPE, frequency_hz=863_100_000, channels=10, hopping=True, polite=True, interval_s=1.0)


def test_polite_access_has_its_own_limits_in_place_of_a_duty_cycle() -> None:
    found = findings(POLITE, Region.EU868)
    assert set(found) == {"band", "polite-on-time", "polite-packet", "polite-pause", "power"}
    assert {finding.verdict for finding in found.values()} == {Verdict.OK}
    # 3,600 packets of 61.7 ms in an hour, over ten channels of 200 kHz
    assert found["polite-on-time"].figure == pytest.approx(3600 * 0.061696 / 10)
    assert found["polite-on-time"].limit == 100.0
    assert found["polite-pause"].figure == pytest.approx(0.8 - 0.061696)
    assert "above -81 dBm" in found["polite-on-time"].sentence  # 15 dB over -117 + 10 log10(125)
    impolite = findings(replace(POLITE, polite=False), Region.EU868)
    assert impolite["duty-cycle"].verdict is Verdict.FAIL


@pytest.mark.parametrize(("channels", "lawful"), [(2, False), (3, True)])
def test_a_hundred_seconds_an_hour_on_any_200_khz_are_allowed(channels: int, lawful: bool) -> None:
    # 222 s in an hour: 111 s on each of two channels, 74 s on each of three
    assert is_permitted(replace(POLITE, channels=channels), Region.EU868) is lawful


def test_packets_above_a_second_and_short_pauses_are_not_polite() -> None:
    long = replace(POLITE, spreading_factor=12, interval_s=30.0)
    assert findings(long, Region.EU868)["polite-packet"].verdict is Verdict.FAIL
    hasty = replace(POLITE, interval_s=0.15, jitter_share=0.1)
    assert findings(hasty, Region.EU868)["polite-pause"].verdict is Verdict.FAIL
    even = replace(hasty, interval_s=0.17, slotted=True)  # slots have no jitter
    assert findings(even, Region.EU868)["polite-pause"].verdict is Verdict.OK


@pytest.mark.parametrize("how", [{"polite": True}, {"slotted": True, "channels": 2}])
def test_a_polite_radio_and_slots_on_channels_need_hopping(how: dict[str, object]) -> None:
    with pytest.raises(InvalidParameter) as caught:
        replace(EUROPE, **how)  # type: ignore[arg-type]
    assert caught.value.field == "hopping"
