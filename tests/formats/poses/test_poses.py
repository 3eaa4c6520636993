"""Tracks of vehicles: CSV, GPX and NMEA, whole and broken."""

from __future__ import annotations

import math
import re
from datetime import UTC, date, datetime
from time import process_time

import numpy as np
import pytest

from app.errors import (
    InvalidParameter,
    ReferenceSystemError,
    UnreadableUpload,
    UnsupportedUpload,
    UploadTooLarge,
)
from app.formats.logs import LogClock, LogReport
from app.formats.poses import PoseDeclaration, PoseLimits, read_poses
from app.geodesy import enu_from_wgs84
from app.sensors.pose_track import PoseTrack

CSV = (
    "time,longitude,latitude,heading,accuracy\n"
    "2026-03-16T13:39:32Z,-85.6123456,42.2834567,91.5,0.02\n"
    "2026-03-16T13:39:33Z,-85.6122,42.2834567,,\n"
)
AT_S = datetime(2026, 3, 16, 13, 39, 32, tzinfo=UTC).timestamp()
POINT = '<trkpt lat="42.2834567" lon="-85.6123456"><time>2026-03-16T13:39:32Z</time>{}</trkpt>'
GPX = (
    '<?xml version="1.0" encoding="UTF-8"?><gpx version="1.1" creator="t" xmlns="http://www.topografix.com/GPX/1/1" '
    'xmlns:x="http://www.garmin.com/xmlschemas/TrackPointExtension/v2"><trk><trkseg>{}</trkseg></trk></gpx>'
)


def read(content: str | bytes, **declared: object) -> tuple[PoseTrack, LogReport]:
    """A track without a telling name."""
    data = content.encode() if isinstance(content, str) else content
    return read_poses("upload", data, PoseDeclaration(**declared))  # type: ignore[arg-type]


def nmea(*contents: str) -> str:
    """Sentences with their checksums."""
    lines = []
    for content in contents:
        value = 0
        for byte in content.encode():
            value ^= byte
        lines.append(f"${content}*{value:02X}")
    return "\r\n".join(lines) + "\r\n"


def rmc(clock: str, day: str = "160326", *, talker: str = "GN", status: str = "A", lat: str = "4217.00740") -> str:
    """A position with its date."""
    return f"{talker}RMC,{clock},{status},{lat},N,08536.74074,W,022.4,084.4,{day},,,A"


def gga(clock: str, quality: int = 4, *, talker: str = "GN", lat: str = "4217.00740") -> str:
    """A position without a date."""
    return f"{talker}GGA,{clock},{lat},N,08536.74074,W,{quality},12,0.6,250.0,M,-33.0,M,,"


# --- CSV ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        CSV,
        CSV.replace(",", ";"),
        CSV.replace("longitude,latitude", "Lon [deg],LAT"),
        CSV.replace("2026-03-16T13:39:32Z", f"{AT_S * 1000:.0f}").replace(
            "2026-03-16T13:39:33Z", f"{AT_S * 1000 + 1000:.0f}"
        ),
        "\n".join([CSV.split("\n")[0], CSV.split("\n")[2], CSV.split("\n")[1]]),
    ],
)
def test_columns_by_name(text: str) -> None:
    track, report = read(text)
    assert track.time_s.tolist() == [AT_S, AT_S + 1]
    assert track.lon_deg[0] == -85.6123456
    np.testing.assert_array_equal(track.heading_deg, [91.5, np.nan])
    np.testing.assert_array_equal(track.accuracy_m, [0.02, np.nan])
    assert report.format == "csv"


def test_rows_that_are_no_positions_are_left_out() -> None:
    rows = [
        "2026-03-16T13:39:34Z,0,0,,",
        "x,1,2,,",
        "2026-03-16T13:39:35Z,-85.6,north,,",
        "a,b",
        "2026-03-16T13:39:36Z,,,,",
        "2026-03-16T13:39:33Z,-85.61,42.28,,",
        "2026-03-16T13:39:37Z,-85.6,95,,",
        "\0,,,,",
    ]
    track, report = read(CSV + "\n".join(rows))
    assert len(track.time_s) == 2
    assert report.left_out_count == len(rows)
    assert report.reasons["null-island"] == 1
    assert report.reasons["same-time"] == 1


def test_a_jump_there_and_back_is_left_out() -> None:
    rows = [f"{AT_S + i},{-85.6 + i * 1e-4},{42.28 + (i == 5) * 0.05},," for i in range(10)]
    track, report = read("time,lon,lat,heading,accuracy\n" + "\n".join(rows))
    assert len(track.time_s) == 9
    assert report.left_out[0].entry == 5


def test_swapped_columns_are_named() -> None:
    with pytest.raises(InvalidParameter, match="swapped") as caught:
        read("time,lon,lat\n" + "".join(f"{AT_S + i},22.28,{114.17 + i * 1e-5}\n" for i in range(5)))
    assert caught.value.cure


@pytest.mark.parametrize("crs", ["EPSG:6318", "NAD83(2011)", "epsg:4258", "27700", "ED50"])
def test_another_datum_is_refused_with_a_cure(crs: str) -> None:
    with pytest.raises(ReferenceSystemError, match="not WGS 84") as caught:
        read(f"time,lon,lat,crs\n{AT_S},-85.6,42.28,{crs}\n")
    assert "transform" in str(caught.value.cure)
    with pytest.raises(ReferenceSystemError):
        read(CSV, crs=crs)


@pytest.mark.parametrize("crs", ["EPSG:4326", "WGS84", "wgs 84 (G2139)", "ITRF2014", "EPSG:7912", "", "4979"])
def test_wgs_84_has_many_names(crs: str) -> None:
    track, _report = read(f"time,lon,lat,crs\n{AT_S},-85.6,42.28,{crs}\n")
    assert len(track.time_s) == 1


def test_declared_columns_and_clocks() -> None:
    text = "when,x,y\n10,-85.6,42.28\n11,-85.6,42.28\n"
    columns = {"time": "when", "lon": "x", "lat": "y"}
    track, _report = read(text, columns=columns, clock=LogClock(offset_s=AT_S - 10))
    assert track.time_s.tolist() == [AT_S, AT_S + 1]
    with pytest.raises(UnreadableUpload, match="no time between"):
        read(text, columns=columns)
    with pytest.raises(InvalidParameter, match="no column of the lat"):
        read(text, columns={"time": "when", "lon": "x", "lat": "z"})


@pytest.mark.parametrize(
    ("first", "later", "declared", "expected"),
    [
        ("01.06.2026 08:00:00", "01.06.2026 08:00:01", {}, "2026-06-01"),
        ("1/6/2026 8:00", "13/6/2026 8:00", {}, "2026-06-01"),
        ("06/01/2026 8:00 AM", "06/13/2026 8:00 PM", {}, "2026-06-01"),
        ("01/06/2026 08:00", "02/06/2026 08:00", {"day_first": True}, "2026-06-01"),
        ("01/06/2026 08:00", "02/06/2026 08:00", {"day_first": False}, "2026-01-06"),
        ("2026/06/01 08:00", "2026/06/02 08:00", {}, "2026-06-01"),
    ],
)
def test_local_dates(first: str, later: str, declared: dict[str, bool], expected: str) -> None:
    text = f"time;lon;lat\n{first};8.5;49.1\n{later};8.5001;49.1\n"
    track, _report = read(text, clock=LogClock(utc_offset_s=7200, **declared))
    assert datetime.fromtimestamp(track.time_s[0], UTC).isoformat() == f"{expected}T06:00:00+00:00"


@pytest.mark.parametrize("later", ["02/06/2026 08:00", "13/06/2026 08:00\n06/14/2026 08:00"])
def test_dates_whose_order_is_not_known_are_refused(later: str) -> None:
    rows = "".join(f"{at};8.5;49.1\n" for at in ("01/06/2026 08:00", *later.split("\n")))
    with pytest.raises(InvalidParameter, match="day or the month") as caught:
        read("time;lon;lat\n" + rows)
    assert caught.value.field == "poses.clock.day_first"
    assert "2026" in caught.value.message


def test_texts_that_are_no_times_are_shown() -> None:
    with pytest.raises(UnreadableUpload, match=r"'Montag um acht' is no time .* 2026-06-01T08:00:00Z"):
        read("time;lon;lat\nMontag um acht;8.5;49.1\n")


# --- GPX ----------------------------------------------------------------------------------------------------------


def test_gpx() -> None:
    turned = POINT.replace("13:39:32Z", "09:39:33.5-04:00").format(
        "<extensions><x:TrackPointExtension><x:course>271.5</x:course></x:TrackPointExtension></extensions>"
    )
    track, report = read(
        GPX.format(POINT.format("") + turned + POINT.format("").replace("<time>", "<!-- ").replace("</time>", "-->"))
    )
    assert track.time_s.tolist() == [AT_S, AT_S + 1.5]
    assert (track.lon_deg[0], track.lat_deg[0]) == (-85.6123456, 42.2834567)
    np.testing.assert_array_equal(track.heading_deg, [np.nan, 271.5])
    assert (report.format, report.left_out_count) == ("gpx", 1)


@pytest.mark.parametrize(
    "text",
    [
        '<!DOCTYPE gpx [<!ENTITY a "aaaa">]>' + GPX,
        '<?xml version="1.0"?><!doctype gpx SYSTEM "file:///etc/passwd">' + GPX.split("?>")[1],
        GPX.format(POINT)[:-30],
        GPX.format('<trkpt lat="north" lon="1"><time>2026-03-16T13:39:32Z</time></trkpt>'),
        GPX.format("<trkpt><time>2026-03-16T13:39:32Z</time></trkpt>"),
        GPX.format("&undefined;"),
        GPX.format(""),
        "<gpx" + "<a>" * 50_000,
    ],
)  # fmt: skip
def test_broken_and_hostile_gpx(text: str) -> None:
    with pytest.raises(UnreadableUpload):
        read(text)
    with pytest.raises(UnreadableUpload):
        read(text.encode("utf-16"))


# --- NMEA ---------------------------------------------------------------------------------------------------------


def test_known_sentences() -> None:
    # the example sentences that receivers' manuals share, in another year: their checksums are not ours
    track, report = read(
        "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230326,003.1,W*63\r\n"
        "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
    )
    assert track.time_s.tolist() == [datetime(2026, 3, 23, 12, 35, 19, tzinfo=UTC).timestamp()]
    assert track.lat_deg[0] == pytest.approx(48.1173)
    assert track.lon_deg[0] == pytest.approx(11.5166667)
    assert track.heading_deg[0] == 84.4
    assert report.format == "nmea"


def test_headings_and_accuracies() -> None:
    track, _report = read(
        nmea(
            rmc("133932.00"), gga("133932.00"), "GNGST,133932.00,1,,,,0.03,0.04,0.05", "GPHDT,91.5,T",
            rmc("133933.00"), "GNVTG,80.0,T,,M,5.5,N,10.2,K",
            rmc("133934.00").replace("022.4", "000.3"), "GNVTG,80.0,T,,M,0.3,N,0.5,K",
            gga("133935.00"), "GPTHS,359.0,A",
        )
    )  # fmt: skip
    assert (track.time_s - AT_S).tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(track.heading_deg, [91.5, 80.0, np.nan, 359.0])
    assert track.accuracy_m[0] == pytest.approx(0.05)  # of both axes, as of the covariance in a bag


def headed(*order: str, headings: tuple[float, ...] = (0.0, 30.0, 60.0, 90.0)) -> list[str]:
    """Sentences of epochs a second apart, each in this order; the vehicle turns where it stands."""
    sentences = []
    for second, heading in enumerate(headings):
        at = f"13393{2 + second}.00"
        kinds = {
            "HDT": f"GNHDT,{heading:.1f},T",
            "RMC": rmc(at).replace("022.4", "000.1"),
            "GGA": gga(at),
            "GST": f"GNGST,{at},1,,,,0.03,0.04,0.05",
            "GSA": "GNGSA,A,3,1,,,,,,,,,,,,1,1,1",
        }
        sentences += [kinds[kind] for kind in order]
    return sentences


@pytest.mark.parametrize(
    "order",
    [
        ("HDT", "RMC", "GGA", "GST"),
        ("HDT", "RMC"),
        ("RMC", "HDT"),
        ("RMC", "GGA", "GST", "HDT"),
        ("RMC", "HDT", "GGA"),
        ("GGA", "HDT", "RMC"),
        ("GSA", "RMC", "HDT"),
        ("GSA", "HDT", "RMC", "GGA"),
    ],
)
def test_a_heading_belongs_to_its_epoch(order: tuple[str, ...]) -> None:
    track, report = read(nmea(*headed(*order)))
    assert (track.time_s - AT_S).tolist() == [0, 1, 2, 3]
    assert track.heading_deg.tolist() == [0, 30, 60, 90]
    assert not report.warnings


def test_where_an_epoch_begins_is_not_guessed_silently() -> None:
    both = nmea("GNHDT,330.0,T", *headed("RMC", "HDT"))
    neither = nmea(*headed("HDT", "RMC")[1:])
    for text, expected in ((both, [0, 30, 60, 90]), (neither, [30, 60, 90, np.nan])):
        track, report = read(text)
        np.testing.assert_array_equal(track.heading_deg, expected)
        assert any("HDT sentences have no time" in text for text in report.warnings)
    steady = nmea("GNHDT,90.0,T", *headed("RMC", "HDT", headings=(90.0, 90.5, 91.0)))
    assert not read(steady)[1].warnings
    # the first line is cut: the log began within an epoch, which its first heading ends
    torn, report = read("0.6,250.0,M,-33.0,M,,*5B\r\n" + nmea("GNHDT,330.0,T", *headed("RMC", "HDT")))
    assert torn.heading_deg.tolist() == [0, 30, 60, 90]


def test_a_lost_sentence_moves_no_heading() -> None:
    lines = headed("RMC", "HDT", "GGA", headings=(0.0, 30.0, 60.0, 90.0, 120.0))
    del lines[8]  # GGA of the third epoch
    track, _report = read(nmea(*lines))
    np.testing.assert_array_equal(track.heading_deg, [0, 30, np.nan, 90, 120])


@pytest.mark.parametrize(
    ("sentence", "estimated"),
    [
        (rmc("133932.00").removesuffix("A") + "E", True),
        (gga("133932.00", 6), True),
        ("GNGLL,4217.00740,N,08536.74074,W,133932.00,A,E", True),
        ("GNGNS,133932.00,4217.00740,N,08536.74074,W,EE,12,0.6,250.0,-33.0,,", True),
        ("GNGNS,133932.00,4217.00740,N,08536.74074,W,AE,12,0.6,250.0,-33.0,,", False),
        ("GNVTG,80.0,T,,M,5.5,N,10.2,K,E", True),
        ("GNVTG,80.0,T,,M,5.5,N,10.2,K,A", False),
        (gga("133932.00", 4), False),
    ],
)
def test_dead_reckoning_is_warned_of(sentence: str, estimated: bool) -> None:
    for text in (
        nmea(rmc("133932.00"), sentence),
        nmea("GNZDA,133932.00,16,03,2026,00,00", sentence, rmc("133933.00")),
    ):
        track, report = read(text)
        assert len(track.time_s)
        assert any("dead reckoning" in warning for warning in report.warnings) is estimated


def test_leap_seconds() -> None:
    midnight_s = datetime(2017, 1, 1, tzinfo=UTC).timestamp()
    track, _report = read(nmea(rmc("235959.00", "311216"), rmc("235960.00", "311216"), rmc("000001.00", "010117")))
    assert (track.time_s - midnight_s).tolist() == [-1, 0, 1]
    track, _report = read(nmea(gga("235960.50"), gga("000001.50"), rmc("000002.50", "010117")))
    assert (track.time_s - midnight_s).tolist() == [0.5, 1.5, 2.5]
    for written in ("2016-12-31T23:59:60Z", "2016-12-31T23:59:60.000Z", "2017-01-01T08:59:60+09:00"):
        track, _report = read(GPX.format(POINT.replace("2026-03-16T13:39:32Z", written).format("")))
        assert track.time_s.tolist() == [midnight_s]
        assert read(CSV.replace("2026-03-16T13:39:32Z", written))[0].time_s[0] == midnight_s


def test_dates_before_2000_name_the_week_rollover() -> None:
    # 1024 and 2048 weeks before 2018 and 2026
    for day, weeks, true in (("310798", 1024, datetime(2018, 3, 16)), ("310787", 2048, datetime(2026, 10, 30))):
        text = nmea(rmc("133932.00", day))
        with pytest.raises(UnreadableUpload, match="rollover of the GPS week counter"):
            read(text)
        track, _report = read(text, clock=LogClock(offset_s=weeks * 7 * 86_400.0))
        assert datetime.fromtimestamp(track.time_s[0], UTC).date() == true.date()


def test_checksums_and_voids() -> None:
    text = nmea(rmc("133932.00"), rmc("133933.00", status="V"), gga("133934.00", 0), rmc("133935.00"))
    broken = (
        text.replace("133932.00,A", "133932.00,B") + "$GNRMC,133936.00,A,4217.00740,N,08536.74074,W,1,2,160326,,,A\r\n"
    )
    broken += "garbage $GNRMC\r\n" + "\0\1\2\r\n" + "$" * 5000 + "\r\n"
    track, report = read(broken)
    assert (track.time_s - AT_S).tolist() == [3]
    assert report.reasons["checksum"] == 2
    assert report.reasons["no-fix"] == 2


def test_cut_sentences_are_left_out() -> None:
    track, report = read(
        nmea(
            rmc("133932.00"),
            "GNGST,133932.00,1",
            "GNRMC,133933.00",
            "GPHDT",
            "GNZDA,133934.00",
            "GNZDA,133934.00,16,03,99999999999999999999,00,00",
            rmc("133935.00"),
        )
    )
    assert (track.time_s - AT_S).tolist() == [0, 3]
    assert report.reasons["malformed"] >= 2


def test_headings_that_are_not_finite_are_not_known() -> None:
    track, _report = read(nmea(rmc("133932.00"), "GPHDT,1e999,T"))
    assert np.isnan(track.heading_deg).all() or track.heading_deg[0] == 84.4


def test_midnight() -> None:
    text = nmea(
        gga("235958.00"), rmc("235959.00", "311226"), gga("000000.00"), gga("000001.00"), rmc("000002.00", "010127")
    )
    track, _report = read(text)
    new_year_s = datetime(2027, 1, 1, tzinfo=UTC).timestamp()
    assert (track.time_s - new_year_s).tolist() == [-2, -1, 0, 1, 2]
    track, _report = read(nmea(gga("235959.50"), gga("000000.50"), rmc("000001.50", "010127")))
    assert (track.time_s - new_year_s).tolist() == [-0.5, 0.5, 1.5]


def test_dates_may_be_declared_and_are_never_guessed() -> None:
    text = nmea(gga("133932.00"), gga("133933.00"))
    with pytest.raises(InvalidParameter, match="no sentence has a date"):
        read(text)
    track, _report = read(text, date=date(2026, 3, 16))
    assert (track.time_s - AT_S).tolist() == [0, 1]
    dated = nmea("GNZDA,133932.00,16,03,2026,00,00", gga("133932.00"))
    assert read(dated)[0].time_s.tolist() == [AT_S]


def test_the_combined_solution_of_several_talkers() -> None:
    text = nmea(
        gga("133932.00", talker="GP", lat="4217.10000"),
        gga("133932.00", talker="GL", lat="4217.20000"),
        gga("133932.00", talker="GN"),
        rmc("133932.00", talker="GP"),
    )
    track, _report = read(text)
    assert track.lat_deg.tolist() == [pytest.approx(42.28345667)]


def test_a_talker_that_changes_with_the_satellites_in_view() -> None:
    text = nmea(
        rmc("133932.00"),
        gga("133932.00", lat="4217.00741"),
        rmc("133933.00", talker="GP"),
        gga("133933.00", talker="GP"),
        rmc("133934.00"),
        rmc("133934.00", talker="GP", lat="4217.10000"),
    )
    track, report = read(text)
    assert (track.time_s - AT_S).tolist() == [0, 1, 2]
    assert track.lat_deg == pytest.approx(42.2834566667)
    assert any("RMC sentences come from GN and GP at different times" in warning for warning in report.warnings)


def test_two_positions_of_one_time_are_reported() -> None:
    apart = nmea(rmc("133932.00"), rmc("133932.00", lat="4217.10000"), rmc("133933.00", lat="4217.10000"))
    assert any("sentences of one time have different positions" in w for w in read(apart)[1].warnings)
    alike = nmea(rmc("133932.00"), gga("133932.00", lat="4217.007"), rmc("133933.00"))
    assert not read(alike)[1].warnings


def test_gpx_times_without_a_zone_are_reported() -> None:
    text = GPX.format(POINT.format(""))
    assert not read(text)[1].warnings
    local = text.replace("Z</time>", "</time>")
    assert "times without a zone were taken as UTC" in read(local)[1].warnings[0]
    track, report = read(local, clock=LogClock(utc_offset_s=3600.0))
    assert not report.warnings
    assert track.time_s.tolist() == [AT_S - 3600]


@pytest.mark.parametrize(("scale", "shift", "warned"), [(1.0, 0.0, False), (1.0, 20.0, False), (1.0, 90.0, True),
                                                        (math.pi / 180, 0.0, True)])  # fmt: skip
def test_headings_that_do_not_fit_the_travel_are_reported(scale: float, shift: float, warned: bool) -> None:
    rows = [f"2026-03-16T13:39:{k:02d}Z,{8 + k * 1e-4},{49 + k * 1e-4},{(33.3 + shift) * scale:.4f}" for k in range(9)]
    report = read("\n".join(["time,lon,lat,heading", *rows]))[1]
    assert any("headings and the direction of travel" in warning for warning in report.warnings) == warned


@pytest.mark.parametrize("names", ["N/S,E/W", "NS,EW", "LatRef,LonRef", "lat_dir,lon_dir", "Latitude Hemisphere,E/W"])
def test_hemispheres_beside_degrees_without_a_sign(names: str) -> None:
    south, west = names.split(",")
    rows = "2026-03-16T13:39:32Z,33.5,S,70.6,W\n2026-03-16T13:39:33Z,33.6,s,70.7,w\n2026-03-16T13:39:34Z,33.7,S,-70.7,W"
    track, report = read(f"time,latitude,{south},longitude,{west}\n{rows}")
    assert track.lat_deg.tolist() == [-33.5, -33.6]
    assert track.lon_deg.tolist() == [-70.6, -70.7]
    assert "hemispheres" in report.left_out[0].reason, "two signs"


def test_what_holds_no_track_is_named() -> None:
    route = GPX.replace("<trk><trkseg>{}</trkseg></trk>", '<rte><rtept lat="49" lon="8"/></rte>')
    with pytest.raises(UnreadableUpload, match="no track, but 1 routes and 0 waypoints"):
        read(route)
    with pytest.raises(InvalidParameter, match="PUBX"):
        read(nmea("PUBX,00,133932.00,4217.00740,N,08536.74074,W,205.3,G3,2.1,3.4,0.1,77.5,0.0,,1.2,1.5,1.1,9,0,0"))


def test_a_datum_in_the_log_is_refused() -> None:
    good = "GPDTM,W84,,0.0,N,0.0,E,0.0,W84"
    assert len(read(nmea(good, rmc("133932.00")))[0].time_s) == 1
    for content in (
        "GPDTM,999,,0.08,N,0.07,E,-47.7,W84",
        "GPDTM,NAS,,0.0,N,0.0,E,0.0,W84",
        "GPDTM,W84,,0.1,N,0.0,E,0.0,W84",
    ):
        with pytest.raises(ReferenceSystemError, match="DTM") as caught:
            read(nmea(content, rmc("133932.00")))
        assert "WGS 84" in str(caught.value.cure)


def test_sentences_behind_a_loggers_own_time() -> None:
    lines = nmea(rmc("133932.00"), rmc("133933.00")).splitlines()
    track, _report = read("\n".join(f"1773668372.1 {line}" for line in lines))
    assert (track.time_s - AT_S).tolist() == [0, 1]


# --- any ----------------------------------------------------------------------------------------------------------


def test_what_is_no_track_names_what_is_expected() -> None:
    for content in (b"hello\nworld\n", b"\x89PNG\r\n\x1a\n" + bytes(50), b"<html></html>", b"a,b\n1,2\n"):
        with pytest.raises(UnsupportedUpload) as caught:
            read(content)
        assert "GPX" in str(caught.value.limit)
    for content in (b"", b"  \n"):
        with pytest.raises(UnreadableUpload, match="empty"):
            read(content)


def test_limits() -> None:
    for limits in (PoseLimits(file_bytes=10), PoseLimits(points=1)):
        for text in (CSV, GPX.format(POINT.format("") * 2), nmea(rmc("133932.00"), rmc("133933.00"))):
            with pytest.raises(UploadTooLarge):
                read_poses("upload", text.encode(), None, limits)


def test_a_long_track_takes_seconds() -> None:
    rows = "".join(f"{AT_S + i / 20},{-85.6 + i * 1e-7:.7f},42.28,90,0.02\n" for i in range(20_000))
    began = process_time()
    track, _report = read("time,lon,lat,heading,accuracy\n" + rows)
    assert process_time() - began < 2
    assert len(track.time_s) == 20_000


# --- what a vehicle's profile says of its track -------------------------------------------------------------------


def test_a_lever_arm_brings_the_track_to_the_vehicles_reference() -> None:
    for heading, east_m, north_m in ((90.0, -2.0, -0.5), (0.0, 0.5, -2.0), (225.0, 1.0607, 1.7678)):
        text = f"time,longitude,latitude,heading\n2026-03-16T13:39:32Z,10.0,50.0,{heading}\n"
        track, report = read(text, forward_m=2.0, left_m=0.5)
        moved_m = enu_from_wgs84(float(track.lon_deg[0]), float(track.lat_deg[0]), 0.0, (10.0, 50.0, 0.0))
        assert moved_m[:2] == pytest.approx([east_m, north_m], abs=1e-3)
        assert not report.warnings
    unturned, report = read("time,longitude,latitude\n2026-03-16T13:39:32Z,10.0,50.0\n", forward_m=2.0)
    assert (unturned.lon_deg[0], unturned.lat_deg[0]) == (10.0, 50.0)
    assert any("no heading" in warning for warning in report.warnings)


def test_an_accuracy_is_declared_where_the_track_has_none() -> None:
    track, _report = read(CSV, accuracy_m=0.5)
    assert track.accuracy_m.tolist() == [0.02, 0.5]


def test_the_way_driven_leaves_out_wandering_and_gaps() -> None:
    rng = np.random.default_rng(3)
    seconds = np.arange(0.0, 700.0, 0.1)
    along_m = np.where(seconds < 600, 0.0, (seconds - 600) * 12.0)  # ten minutes at a stop, then 1.2 km
    lat = 50.0 + (along_m + rng.normal(0, 0.7, len(seconds))) / 111_230.0
    lon = 179.9999 + rng.normal(0, 0.7, len(seconds)) / 71_700.0
    nothing = np.full(len(seconds), np.nan)
    track = PoseTrack(seconds, (lon + 180) % 360 - 180, lat, nothing, np.full(len(seconds), 0.7))
    assert track.driven_m() == pytest.approx(1200.0, rel=0.02)
    far = PoseTrack([0.0, 1.0, 2.0], [10.0, 11.0, 11.0002], [50.0] * 3, [np.nan] * 3, [np.nan] * 3)
    assert far.driven_m() == pytest.approx(14.34, abs=0.05)
    assert PoseTrack([0.0], [10.0], [50.0], [np.nan], [np.nan]).driven_m() == 0.0


def test_gpx_whose_elements_have_a_prefix() -> None:
    plain = GPX.format(POINT.format(""))
    prefixed = re.sub(r"(</?)(?=\w+[ >])", r"\1g:", plain).replace("xmlns=", "xmlns:g=")
    assert "<g:trkpt" in prefixed
    assert read(prefixed)[0].time_s.tolist() == read(plain)[0].time_s.tolist() == [AT_S]


def test_the_compass_of_gpx_counts_more_than_the_course() -> None:
    both = "<extensions><x:course>10</x:course><heading>350</heading></extensions>"
    assert read(GPX.format(POINT.format(both)))[0].heading_deg.tolist() == [350.0]


def test_the_first_or_last_cell_between_tabs_may_be_empty() -> None:
    rows = "\t2026-03-16T13:39:32Z\t-85.6\t42.3\t\n9\t2026-03-16T13:39:33Z\t-85.6\t42.3\t1\n"
    text = f"heading\ttime\tlon\tlat\taccuracy\n{rows}"
    track, report = read(text)
    assert (track.time_s - AT_S).tolist() == [0, 1]
    assert not report.left_out_count


def test_a_declared_date_is_that_of_the_first_position() -> None:
    lost = gga("235959.00", 0)
    track, _report = read(nmea(lost, gga("000000.00"), gga("000001.00")), date=date(2026, 3, 17))
    assert track.time_s[0] == datetime(2026, 3, 17, tzinfo=UTC).timestamp()
    track, _report = read(nmea(gga("235958.00"), lost, gga("000000.00")), date=date(2026, 3, 16))
    assert track.time_s[-1] == datetime(2026, 3, 17, tzinfo=UTC).timestamp()
