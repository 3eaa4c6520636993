"""Checks of a marker's radio settings: the regulation of a region, and the duty cycle of the transmitter itself.

Sources: 47 CFR 15.247 and 15.249 (United States, 902-928 MHz); ERC Recommendation 70-03 annex 1, ETSI EN 300 220-2
V3.2.1 table B.1, and for polite spectrum access (listen before talk and adaptive frequency agility) EN 300 220-1 V3.1.1
clause 5.21 (Europe, 863-870 MHz). Figures here are calculated from settings; for
certification they are measured on the device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from app.markers.reading import RadioFinding, Verdict, at_least, at_most
from app.radio.settings import CHANNEL_STEP, CONTINUOUS_POWER_DBM, FULL_POWER_DUTY_CYCLE, RadioSettings, Region

US_BAND_HZ = (902_000_000, 928_000_000)  # [Hz] source: 47 CFR 15.247(a)
DWELL_S = 0.4  # [s] source: 47 CFR 15.247(a)(1)(i)
DIGITAL_BANDWIDTH_HZ = 500_000  # [Hz] source: 47 CFR 15.247(a)(2)
US_POWER_DBM = 30.0  # [dBm] source: 47 CFR 15.247(b)(2), (b)(3)
FEW_CHANNELS_POWER_DBM = 24.0  # [dBm] with less than 50 hopping channels; source: 47 CFR 15.247(b)(2)
DENSITY_DBM = 8.0  # [dBm] in any 3 kHz; source: 47 CFR 15.247(e)
_DENSITY_HZ = 3000  # [Hz] source: 47 CFR 15.247(e)
NARROW_HZ = 250_000  # [Hz] 20 dB bandwidth below which channels are narrow; source: 47 CFR 15.247(a)(1)(i)
NARROW_CHANNELS, NARROW_PERIOD_S = 50, 20.0  # [1, s] source: 47 CFR 15.247(a)(1)(i)
WIDE_CHANNELS, WIDE_PERIOD_S = 25, 10.0  # [1, s] source: 47 CFR 15.247(a)(1)(i)
FIELD_EIRP_DBM = 10 * math.log10((0.05 * 3) ** 2 / 30 * 1000)  # [dBm] 50 mV/m at 3 m, P = (E d)^2 / 30; 15.249(a)
_ERP_DB = 2.15  # [dB] of a dipole over an isotropic antenna; source: ERP and EIRP by definition
_20_DB_BANDWIDTH = 1.1  # LoRa's 20 dB bandwidth over its nominal one


LAWS = {
    Region.US915: "47 CFR 15.247 (United States)",
    Region.EU868: "ERC/REC 70-03 annex 1 as countries of the CEPT have adopted it",
}
"""What settings of a region are checked against."""
_AREAS: dict[Region, tuple[tuple[float, float, float, float], ...]] = {
    Region.US915: (
        (-124.5, 33.0, -122.7, 48.0), (-122.7, 33.0, -95.5, 48.8), (-104.0, 30.0, -93.9, 33.0),
        (-95.5, 28.5, -83.4, 45.7), (-83.4, 24.4, -79.9, 31.0), (-83.4, 31.0, -75.0, 41.4), (-75.0, 38.0, -69.0, 44.7),
        (-168.0, 54.0, -141.2, 71.5), (-160.5, 18.8, -154.7, 22.4),
    ),
    Region.EU868: (
        (-9.6, 37.5, 3.4, 44.0), (-11.0, 43.0, 19.0, 54.2), (6.5, 37.6, 19.0, 43.0), (-9.0, 54.2, 19.0, 71.5),
        (19.0, 66.0, 28.0, 71.5), (21.0, 60.0, 27.0, 66.0), (23.2, 58.0, 26.8, 59.7), (21.5, 55.5, 26.0, 57.8),
        (19.0, 43.5, 23.0, 54.2), (22.4, 38.0, 28.5, 47.5), (19.2, 36.5, 22.4, 41.7),
    ),
}  # fmt: skip
"""Boxes west, south, east, north in which no other law applies on land. [deg] From maps: the United States without a
strip along Canada and Mexico, and members of the CEPT without strips along Belarus, Kosovo, Moldova, Morocco, Russia,
Tunisia and Ukraine."""


def region_at(lon_deg: float, lat_deg: float) -> Region | None:
    """The region whose rules apply at a place; None near borders, and where the table has no country.

    Parameters
    ----------
    lon_deg, lat_deg : float
        [deg]
    """
    for region, boxes in _AREAS.items():
        if any(west <= lon_deg <= east and south <= lat_deg <= north for west, south, east, north in boxes):
            return region
    return None


@dataclass(frozen=True, slots=True)
class SubBand:
    """A part of the European band with its limits: [Hz], share of an hour, [dBm], [dBm in any 100 kHz]."""

    low_hz: int
    high_hz: int
    duty_cycle: float
    erp_dbm: float
    density_dbm: float = math.inf


EU_SUB_BANDS = (
    SubBand(863_000_000, 865_000_000, 0.001, 14.0),
    SubBand(865_000_000, 868_000_000, 0.01, 14.0, density_dbm=6.2),
    SubBand(868_000_000, 868_600_000, 0.01, 14.0),
    SubBand(868_700_000, 869_200_000, 0.001, 14.0),
    SubBand(869_400_000, 869_650_000, 0.1, 27.0),
    SubBand(869_700_000, 870_000_000, 0.01, 14.0),
)
"""Source: EN 300 220-2 V3.2.1, table B.1, bands K, L, M, N, P and Q."""
POLITE_ON_S = 100.0  # [s] in an hour on any 200 kHz; source: EN 300 220-1 V3.1.1, clause 5.21
POLITE_PACKET_S = 1.0  # [s] longest transmission; source: EN 300 220-1 V3.1.1, clause 5.21
POLITE_PAUSE_S = 0.1  # [s] between transmissions on a channel; source: EN 300 220-1 V3.1.1, clause 5.21
POLITE_SPECTRUM_HZ = 200_000  # [Hz] source: EN 300 220-1 V3.1.1, clause 5.21
POLITE_LISTEN_S = 160e-6  # [s] shortest assessment of a channel; source: EN 300 220-1 V3.1.1, clause 5.21
# [dBm, dB] level that a channel in use exceeds, below 100 mW: 15 dB over Sp = 10 log(kHz) - 117 dBm; source: EN
# 300 220-1 V3.1.1, clause 5.21, cited by Saelens et al., EURASIP JWCN 2019, 219, table 11
_SP_DBM, _OVER_SP_DB = -117.0, 15.0
_EU_DENSITY_HZ = 100_000  # [Hz] source: EN 300 220-2 V3.2.1, table B.1, band L


def check_legal(settings: RadioSettings, region: Region) -> tuple[RadioFinding, ...]:
    """Check radio settings against the rules of a region.

    Returns
    -------
    tuple of RadioFinding
        ``warn`` where no rule covers the settings as they are, ``fail`` where one is broken.
    """
    return _check_us(settings) if region is Region.US915 else _check_eu(settings)


def check_transmitter(settings: RadioSettings) -> tuple[RadioFinding, ...]:
    """Check the duty cycle of the chip above 17 dBm, where its data sheet limits it.

    Returns
    -------
    tuple of RadioFinding
        Empty at 17 dBm and less.
    """
    if settings.power_dbm <= CONTINUOUS_POWER_DBM:
        return ()
    return (
        at_most(
            "transmitter-duty-cycle",
            settings.time_on_air_s / settings.interval_s,
            FULL_POWER_DUTY_CYCLE,
            "of the time",
            "SX1276 data sheet, section 5.4.3",
            f"of the power amplifier above {CONTINUOUS_POWER_DBM:g} dBm",
        ),
    )


def is_permitted(settings: RadioSettings, region: Region) -> bool:
    """Whether every rule of the region is met, and the transmitter's own limit."""
    return all(finding.passed for finding in (*check_legal(settings, region), *check_transmitter(settings)))


def _within(settings: RadioSettings, low_hz: float, high_hz: float, source: str) -> RadioFinding:
    """Whether all channels lie in a band."""
    lowest_hz, highest_hz = settings.band_hz
    return at_least(
        "band",
        min(lowest_hz - low_hz, high_hz - highest_hz) / 1e6,
        0.0,
        "MHz",
        source,
        f"from the channels, {lowest_hz / 1e6:g} to {highest_hz / 1e6:g} MHz, to the edge of {low_hz / 1e6:g} to "
        f"{high_hz / 1e6:g} MHz",
    )


# --- United States ------------------------------------------------------------------------------------------------


def _check_us(settings: RadioSettings) -> tuple[RadioFinding, ...]:
    band = _within(settings, *US_BAND_HZ, "47 CFR 15.247(a)")
    if settings.hopping:
        return band, *_check_hopping(settings)
    if settings.bandwidth_hz < DIGITAL_BANDWIDTH_HZ:
        return band, _fixed_narrow(settings), _occupancy(settings, *_hopping_rule(settings.bandwidth_hz))
    return band, *_check_digital(settings)


def _check_digital(settings: RadioSettings) -> tuple[RadioFinding, ...]:
    return (
        at_least(
            "digital-bandwidth",
            settings.bandwidth_hz / 1000,
            DIGITAL_BANDWIDTH_HZ / 1000,
            "kHz",
            "47 CFR 15.247(a)(2)",
            "6 dB bandwidth, taken as LoRa's own; to be measured on the device",
        ),
        _power(settings, US_POWER_DBM, "47 CFR 15.247(b)(3)"),
        _density(settings),
    )


def _hopping_rule(bandwidth_hz: int) -> tuple[int, float]:
    """Minimum number of channels, and the period for the dwell time. [s]"""
    if bandwidth_hz < NARROW_HZ:
        return NARROW_CHANNELS, NARROW_PERIOD_S
    return WIDE_CHANNELS, WIDE_PERIOD_S


def _check_hopping(settings: RadioSettings) -> tuple[RadioFinding, ...]:
    if settings.bandwidth_hz >= DIGITAL_BANDWIDTH_HZ:
        wide = at_most(
            "hopping-bandwidth",
            settings.bandwidth_hz * _20_DB_BANDWIDTH / 1000,
            500.0,
            "kHz",
            "47 CFR 15.247(a)(1)(i)",
            "20 dB bandwidth of LoRa at 500 kHz is above the limit of a hopping channel: checked as digital modulation",
            worst=Verdict.WARN,
        )
        return wide, *_check_digital(settings)
    min_channels, period_s = _hopping_rule(settings.bandwidth_hz)
    if settings.channels < min_channels:
        return _check_hybrid(settings, min_channels)
    limit_dbm = US_POWER_DBM if settings.channels >= NARROW_CHANNELS else FEW_CHANNELS_POWER_DBM
    return (
        at_least(
            "hopping-channels", settings.channels, min_channels, "channels", "47 CFR 15.247(a)(1)(i)", "hopped over"
        ),
        _occupancy(settings, min_channels, period_s),
        _power(settings, limit_dbm, "47 CFR 15.247(b)(2)"),
    )


def _check_hybrid(settings: RadioSettings, min_channels: int) -> tuple[RadioFinding, ...]:
    return (
        at_least(
            "hopping-channels",
            settings.channels,
            min_channels,
            "channels",
            "47 CFR 15.247(a)(1)(i), (f)",
            f"too few to be a hopping system; as a hybrid under (f) it must dwell at most 0.4 s in "
            f"{DWELL_S * settings.channels:g} s and keep the density of digital modulation",
            worst=Verdict.WARN,
        ),
        _occupancy(settings, settings.channels, DWELL_S * settings.channels),
        _power(settings, FEW_CHANNELS_POWER_DBM, "47 CFR 15.247(b)(2)"),
        _density(settings),
    )


def _fixed_narrow(settings: RadioSettings) -> RadioFinding:
    khz = settings.bandwidth_hz / 1000
    return at_most(
        "fixed-narrow-channel",
        settings.eirp_dbm,
        FIELD_EIRP_DBM,
        "dBm EIRP",
        "47 CFR 15.247(a)(1)(i), (a)(2); 15.249(a)",
        f"a beacon on {settings.channels} fixed channel{'s' if settings.channels > 1 else ''} of {khz:g} kHz is no "
        f"hopping system ((a)(1)(i): at least {_hopping_rule(settings.bandwidth_hz)[0]} channels) and no digital "
        "modulation ((a)(2): at least 500 kHz); it is left with 15.249: 50 mV/m at 3 m",
        worst=Verdict.WARN,
    )


def _occupancy(settings: RadioSettings, min_channels: int, period_s: float) -> RadioFinding:
    channels = settings.channels if settings.hopping else 1
    packets = max(1, math.ceil(period_s / (settings.interval_s * channels) - 1e-9))
    return at_most(
        "dwell-time",
        packets * settings.time_on_air_s,
        DWELL_S,
        "s",
        "47 CFR 15.247(a)(1)(i)" if min_channels in (NARROW_CHANNELS, WIDE_CHANNELS) else "47 CFR 15.247(f)",
        f"of one marker on one channel in {period_s:g} s: {packets} packets of "
        f"{1000 * settings.time_on_air_s:.1f} ms, spread evenly over its channels",
        worst=Verdict.FAIL if settings.hopping else Verdict.WARN,
    )


def _power(settings: RadioSettings, limit_dbm: float, source: str) -> RadioFinding:
    return at_most("power", settings.power_dbm, limit_dbm, "dBm", source, "conducted, with an antenna of at most 6 dBi")


def _density(settings: RadioSettings) -> RadioFinding:
    density_dbm = settings.power_dbm - 10 * math.log10(settings.bandwidth_hz / _DENSITY_HZ)
    return at_most(
        "power-density",
        density_dbm,
        DENSITY_DBM,
        "dBm/3 kHz",
        "47 CFR 15.247(e)",
        "power spread evenly over the band; to be measured on the device",
    )


# --- Europe -------------------------------------------------------------------------------------------------------


def _sub_band(settings: RadioSettings) -> SubBand | None:
    return next((band for band in EU_SUB_BANDS if band.low_hz <= settings.frequency_hz <= band.high_hz), None)


def _check_eu(settings: RadioSettings) -> tuple[RadioFinding, ...]:
    source = "ERC/REC 70-03 annex 1; EN 300 220-2 table B.1"
    band = _sub_band(settings)
    if band is None:
        off_hz = min(max(b.low_hz - settings.frequency_hz, settings.frequency_hz - b.high_hz) for b in EU_SUB_BANDS)
        sentence = (
            f"{settings.frequency_hz / 1e6:g} MHz is in no sub-band for devices of any kind; distance from the "
            "nearest one"
        )
        return (RadioFinding("band", off_hz / 1e6, "<=", 0.0, "MHz", source, Verdict.FAIL, sentence),)
    name = f"{band.low_hz / 1e6:g} to {band.high_hz / 1e6:g} MHz"
    density = (_eu_density(settings, band, name),) if math.isfinite(band.density_dbm) else ()
    access = _polite(settings) if settings.polite else (_duty_cycle(settings, band, name, source),)
    return (
        _within(settings, band.low_hz, band.high_hz, source),
        *access,
        at_most("power", settings.eirp_dbm - _ERP_DB, band.erp_dbm, "dBm ERP", source, f"radiated in {name}"),
        *density,
    )


def _duty_cycle(settings: RadioSettings, band: SubBand, name: str, source: str) -> RadioFinding:
    return at_most(
        "duty-cycle",
        settings.time_on_air_s / settings.interval_s,
        band.duty_cycle,
        "of an hour",
        source,
        f"of one marker in {name}, however many channels it uses there",
    )


def polite_threshold_dbm(bandwidth_hz: float) -> float:
    """Level above which a polite radio counts a channel as in use, for less than 100 mW. [dBm]"""
    return _SP_DBM + _OVER_SP_DB + 10 * math.log10(bandwidth_hz / 1000)


def _polite(settings: RadioSettings) -> tuple[RadioFinding, ...]:
    """Limits of polite spectrum access with frequency agility, which stand in place of a duty cycle."""
    source = "EN 300 220-1 V3.1.1, clause 5.21; EN 300 220-2 V3.2.1, table B.1"
    narrow = max(1.0, POLITE_SPECTRUM_HZ / (CHANNEL_STEP * settings.bandwidth_hz))  # channels in 200 kHz
    on_s = 3600 / settings.interval_s * settings.time_on_air_s * narrow / settings.channels
    threshold_dbm = polite_threshold_dbm(settings.bandwidth_hz)
    return (
        at_most(
            "polite-on-time", on_s, POLITE_ON_S, "s in an hour", source,
            f"of one marker on any 200 kHz, hopping evenly over {settings.channels} channels; it listens for "
            f"{1e6 * POLITE_LISTEN_S:g} us or more, and hops on if a channel is above {threshold_dbm:.0f} dBm",
        ),
        at_most("polite-packet", settings.time_on_air_s, POLITE_PACKET_S, "s", source, "time on air of a packet"),
        at_least(
            "polite-pause", settings.interval_s * (1 - settings.jitter_share * (not settings.slotted))
            - settings.time_on_air_s, POLITE_PAUSE_S, "s", source, "shortest, between the packets of one marker",
        ),
    )  # fmt: skip


def _eu_density(settings: RadioSettings, band: SubBand, name: str) -> RadioFinding:
    """Density of the radiated power. A warning, because Decision (EU) 2019/1345, band 47, has no such limit."""
    return at_most(
        "power-density",
        settings.eirp_dbm - _ERP_DB - 10 * math.log10(settings.bandwidth_hz / _EU_DENSITY_HZ),
        band.density_dbm,
        "dBm ERP/100 kHz",
        "EN 300 220-2 V3.2.1, table B.1, band L",
        f"power spread evenly over the channel, in {name}; Decision (EU) 2019/1345, band 47, sets no limit, but a "
        "device above this one cannot rely on the harmonised standard",
        worst=Verdict.WARN,
    )
