"""LandXML: lines, arcs, clothoids, profiles and station equations against values computed in other ways."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from app.errors import UnreadableUpload, WaymarkError
from app.formats.alignments.curves import clothoid
from app.formats.alignments.geometry import AlignmentDeclaration, AlignmentFile, StationEquation
from app.formats.alignments.landxml import read_landxml
from app.formats.alignments.read import read_alignment
from app.formats.surveys.declaration import METRES, ImportDeclaration
from app.formats.surveys.read import read_survey
from app.values import Floats
from tests.formats.alignments.mutations import damaged

METRIC = '<Units><Metric linearUnit="meter" angularUnit="decimal degrees"/></Units>'
EAST, NORTH = 2_000_000.0, 400_000.0
US_FOOT_M = 1200 / 3937


def ends(start: tuple[float, float], end: tuple[float, float]) -> str:
    """Start and End, northing first, from easting and northing."""
    (e0, n0), (e1, n1) = start, end
    return f"<Start>{n0!r} {e0!r}</Start><End>{n1!r} {e1!r}</End>"


def line(start: tuple[float, float], end: tuple[float, float]) -> str:
    return f'<Line dir="12.5" length="1">{ends(start, end)}</Line>'


def landxml(shape: str, *, extra: str = "", units: str = METRIC, head: str = "", sta: float = 0.0) -> bytes:
    return (
        f'<?xml version="1.0"?><LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2">{units}{head}'
        f'<Alignments><Alignment name="CL" length="1" staStart="{sta}">'
        f"<CoordGeom>{shape}</CoordGeom>{extra}</Alignment>"
        "</Alignments></LandXML>"
    ).encode()


def centre(file: AlignmentFile) -> Floats:
    assert file.lanes[0].centre is not None
    return file.lanes[0].centre


def stations(file: AlignmentFile) -> Floats:
    assert file.lanes[0].station_m is not None
    return file.lanes[0].station_m


def curvatures(file: AlignmentFile) -> Floats:
    assert file.lanes[0].curvature_per_m is not None
    return file.lanes[0].curvature_per_m


def profile(points: str) -> str:
    return f'<Profile name="FG"><ProfAlign name="FG">{points}</ProfAlign></Profile>'


FLAT = line((0, 0), (200, 0))


def test_northing_comes_first_and_directions_are_not_used() -> None:
    file = read_landxml(landxml(line((EAST, NORTH), (EAST + 30, NORTH + 40))))
    assert centre(file)[0, :2].tolist() == [EAST, NORTH]
    assert centre(file)[-1, :2] == pytest.approx([EAST + 30, NORTH + 40], abs=1e-9)
    assert stations(file)[-1] == pytest.approx(50.0)
    assert np.isnan(centre(file)[:, 2]).all()
    assert len(centre(file)) == 26
    assert (file.lanes[0].name, file.unit_m, file.crs, file.crs_problem) == ("CL", 1.0, None, None)


@pytest.mark.parametrize(
    ("rot", "end", "angle"),
    [("ccw", (100, 100), 0.5), ("cw", (100, -100), 0.5), ("ccw", (-100, 100), 1.5), ("cw", (-100, -100), 1.5)],
)
@pytest.mark.parametrize("with_centre", [True, False])
def test_arcs(rot: str, end: tuple[float, float], angle: float, with_centre: bool) -> None:
    side = 1 if rot == "ccw" else -1
    centre_text = f"<Center>{100 * side} 0</Center>" if with_centre else ""
    arc = (
        f'<Curve rot="{rot}" radius="100" length="{50 * math.pi * 2 * angle}">{ends((0, 0), end)}{centre_text}</Curve>'
    )
    file = read_landxml(landxml(arc))
    assert np.abs(np.hypot(centre(file)[:, 0], centre(file)[:, 1] - 100 * side) - 100).max() < 1e-9
    assert centre(file)[-1, :2] == pytest.approx(end, abs=1e-9)
    assert centre(file)[1, 0] > 0, "an arc that begins eastwards"
    assert stations(file)[-1] == pytest.approx(100 * math.pi * angle)
    np.testing.assert_allclose(curvatures(file), side / 100)


@pytest.mark.parametrize(("r0", "r1"), [("INF", 300.0), (300.0, "INF"), (800.0, 250.0)])
@pytest.mark.parametrize("rot", ["cw", "ccw"])
def test_clothoids_in_feet(r0: float | str, r1: float | str, rot: str) -> None:
    length, hdg = 420.0, 2.3
    k0, k1 = (0.0 if r == "INF" else (1.0 if rot == "ccw" else -1.0) / float(r) for r in (r0, r1))

    def at(s: float) -> tuple[float, float]:
        turn = [(lambda t, f=f: f(hdg + k0 * t + (k1 - k0) * t * t / 2 / length)) for f in (math.cos, math.sin)]
        return EAST + quad(turn[0], 0, s, epsabs=1e-11)[0], NORTH + quad(turn[1], 0, s, epsabs=1e-11)[0]

    spiral = (
        f'<Spiral rot="{rot}" spiType="clothoid" length="{length}" radiusStart="{r0}" radiusEnd="{r1}" dirStart="1">'
        f"{ends(at(0.0), at(length))}<PI>0 0</PI></Spiral>"
    )
    units = '<Units><Imperial linearUnit="USSurveyFoot"/></Units>'
    file = read_landxml(landxml(spiral, units=units))
    assert file.unit_m == pytest.approx(US_FOOT_M, abs=1e-15)
    s = stations(file) / US_FOOT_M
    assert s[-1] == pytest.approx(length)
    assert np.abs(centre(file)[:, :2] - [at(float(value)) for value in s]).max() < 1e-6
    np.testing.assert_allclose(curvatures(file), (k0 + (k1 - k0) * s / length) / US_FOOT_M, atol=1e-12)


def test_elements_follow_each_other_and_curvature_jumps_at_one_place() -> None:
    arc = f'<Curve rot="ccw" radius="100">{ends((100, 0), (200, 100))}<Center>100 100</Center></Curve>'
    file = read_landxml(landxml(line((0, 0), (100, 0)) + arc))
    twice = np.flatnonzero(np.diff(stations(file)) == 0.0)
    assert stations(file)[twice].tolist() == pytest.approx([100.0])
    assert curvatures(file)[[twice[0], twice[0] + 1]] == pytest.approx([0.0, 0.01])
    assert (centre(file)[twice[0], :2] == centre(file)[twice[0] + 1, :2]).all()


def test_irregular_lines_and_named_points() -> None:
    shape = (
        '<IrregularLine><Start pntRef="A"/><End>0 30</End><PntList2D>0 10 5 20</PntList2D></IrregularLine>'
        '<Line><Start>0 30</Start><End pntRef="B"/></Line>'
    )
    head = '<CgPoints><CgPoint name="A">0 0 7</CgPoint><CgPoint name="B">0 40</CgPoint></CgPoints>'
    file = read_landxml(landxml(shape, head=head))
    assert stations(file)[-1] == pytest.approx(20 + 2 * math.hypot(5, 10))
    assert centre(file)[-1, :2].tolist() == pytest.approx([40.0, 0.0])
    assert 5.0 in centre(file)[:, 1]


def test_parabolas_of_profiles() -> None:
    points = (
        "<PVI>1000 50</PVI><ParaCurve length='60'>1080 54</ParaCurve>"
        "<UnsymParaCurve lengthIn='20' lengthOut='40'>1150 52.6</UnsymParaCurve><PVI>1200 54.6</PVI>"
    )
    file = read_landxml(landxml(FLAT, extra=profile(points), sta=1000))
    s, z = stations(file), centre(file)[:, 2]
    assert np.interp(20, s, z) == pytest.approx(51.0)
    # Crest: 5 % to -2 % over 60 m; the middle lies L A / 8 below the point of intersection.
    assert np.interp(80, s, z) == pytest.approx(54 - 60 * 0.07 / 8, abs=1e-3)
    assert np.interp(50, s, z) == pytest.approx(52.5, abs=1e-3)
    assert np.interp(110, s, z) == pytest.approx(53.4, abs=1e-3)
    # Sag of unequal lengths: L1 L2 A / (2 (L1 + L2)) above it.
    assert np.interp(150, s, z) == pytest.approx(52.6 + 20 * 40 * 0.06 / 120, abs=1e-3)
    assert z[-1] == pytest.approx(54.6)
    fine = np.linspace(0.0, 200.0, 4001)
    slope = np.diff(np.interp(fine, s, z)) / np.diff(fine)
    assert np.abs(np.diff(slope)).max() < 0.01, "grades change smoothly"


def test_circles_of_profiles() -> None:
    file = read_landxml(
        landxml(
            FLAT, extra=profile("<PVI>0 0</PVI><CircCurve length='50' radius='500'>100 5</CircCurve><PVI>200 0</PVI>")
        )
    )
    s, z = stations(file), centre(file)[:, 2]
    # The circle touches both grades of 5 %: its centre lies R / cos(angle) below the point of intersection.
    bottom = 5 - 500 / math.cos(math.atan(0.05))
    inside = np.abs(s - 100) < 500 * math.sin(math.atan(0.05)) - 0.01
    assert inside.sum() > 20
    np.testing.assert_allclose(np.hypot(s[inside] - 100, z[inside] - bottom), 500.0, atol=1e-9)
    assert np.interp(60, s, z) == pytest.approx(3.0)


def test_heights_end_with_the_profile() -> None:
    file = read_landxml(landxml(FLAT, extra=profile("<PVI>20 1</PVI><PVI>120 2</PVI>")))
    assert "the profile begins 20.0 m after the line's start and ends 80.0 m before its end" in file.warnings[0]
    z = centre(file)[:, 2]
    assert np.isnan(z[[0, -1]]).all()
    assert np.isfinite(z).sum() == pytest.approx(51, abs=2)
    feet = '<Units><Imperial linearUnit="foot"/></Units>'
    flat = landxml(FLAT, extra=profile("<PVI>0 100</PVI><PVI>200 100</PVI>"), units=feet)
    assert centre(read_landxml(flat))[:, 2] == pytest.approx(100.0), "heights are in the unit of the file"


def test_stations_that_fall_along_the_line() -> None:
    extra = (
        '<StaEquation staBack="100" staAhead="900" staInternal="100" staIncrement="decreasing"/>'
        '<StaEquation staBack="850" staAhead="2000" staIncrement="increasing"/>'
    )
    stationing = read_landxml(landxml(FLAT, extra=extra)).stationing["CL"]
    assert [stationing.displayed_m(at) for at in (0, 99, 100, 120, 150, 160)] == [0, 99, 900, 880, 2000, 2010]


def test_each_alignment_has_its_own_stations() -> None:
    other = f'</Alignment><Alignment name="Ramp" staStart="5000"><CoordGeom>{line((0, 9), (90, 9))}</CoordGeom>'
    other += '<StaEquation staInternal="5040" staAhead="7000"/>'
    file = read_landxml(landxml(FLAT, extra=other, sta=100.0))
    assert file.warnings == ()
    shown = {name: [one.displayed_m(at) for at in (0.0, 50.0)] for name, one in file.stationing.items()}
    assert shown == {"CL": [100, 150], "Ramp": [5000, 7010]}


@pytest.mark.parametrize(
    ("units", "height"),
    [
        ('<Metric linearUnit="meter" elevationUnit="feet"/>', 30.48),
        ('<Metric linearUnit="meter" elevationUnit="meter"/>', 100.0),
        ('<Imperial linearUnit="USSurveyFoot" elevationUnit="feet"/>', 100.0),
        ('<Imperial linearUnit="foot" elevationUnit="meter"/>', 100.0 / 0.3048),
    ],
)
def test_heights_have_their_own_unit(units: str, height: float) -> None:
    flat = landxml(FLAT, extra=profile("<PVI>0 100</PVI><PVI>200 100</PVI>"), units=f"<Units>{units}</Units>")
    file = read_landxml(flat)
    assert centre(file)[:, 2] == pytest.approx(height, rel=1e-9), "in the unit of the lengths"
    points = flat.replace(b"</LandXML>", b'<CgPoints><CgPoint name="1">5e5 4e5 100</CgPoint></CgPoints></LandXML>')
    declared = ImportDeclaration(crs="EPSG:26915", vertical_datum="ellipsoid", format="landxml")
    survey = read_survey(points, declared)
    assert survey.height is not None
    height_m = survey.height[0] * METRES[survey.height_unit]
    assert height_m == pytest.approx(height * file.unit_m, rel=3e-6)


def test_points_of_one_name_at_several_places_are_no_reference() -> None:
    shape = '<Line><Start pntRef="A"/><End>0 30</End></Line>'
    points = '<CgPoints><CgPoint name="A">0 0</CgPoint></CgPoints><CgPoints><CgPoint name="A">5 {}</CgPoint></CgPoints>'
    with pytest.raises(UnreadableUpload, match="points of this name are at 2 places"):
        read_landxml(landxml(shape, head=points.format(1)))
    assert read_landxml(landxml(shape, head=points.replace("5 {}", "0  0"))).lanes
    assert read_landxml(landxml(FLAT, head=points.format(1))).lanes


def test_station_equations() -> None:
    """Stations as real files have them: 272+05.41 back is 2+05.41 ahead; staInternal may be missing."""
    feet = '<Units><Imperial linearUnit="USSurveyFoot"/></Units>'
    extra = (
        '<StaEquation staBack="27205.41" staAhead="205.41" staInternal="27205.41"/>'
        '<StaEquation staBack="305.41" staAhead="1000"/><StaEquation staAhead="5000" staInternal="27405.41"/>'
    )
    file = read_landxml(landxml(line((0, 0), (1000, 0)), extra=extra, units=feet, sta=27000))
    stationing = file.stationing["CL"]
    assert stationing.start_m == pytest.approx(27000 * US_FOOT_M)
    expected = [(205.41, 27205.41, 205.41), (305.41, 305.41, 1000.0), (405.41, 1100.0, 5000.0)]
    for equation, values in zip(stationing.equations, expected, strict=True):
        assert isinstance(equation, StationEquation)
        found = (equation.distance_m, equation.back_m, equation.ahead_m)
        assert np.array(found) / US_FOOT_M == pytest.approx(values)
    assert stations(file)[-1] == pytest.approx(1000 * US_FOOT_M), "geometry stays in true distance"
    outside = read_landxml(landxml(FLAT, extra='<StaEquation staAhead="1" staInternal="900"/>'))
    assert outside.stationing["CL"].equations == ()
    assert any("StaEquation 900" in warning for warning in outside.warnings)


# --- feet -------------------------------------------------------------------------------------------------------------


UNDECLARED = AlignmentDeclaration()


@pytest.mark.parametrize(
    ("unit", "epsg", "declared", "metres", "note"),
    [
        ("foot", 6539, UNDECLARED, US_FOOT_M, "read as ft-us, the unit of NAD83(2011) / New York Long Island (ftUS)"),
        ("Foot", 2222, UNDECLARED, 0.3048, "read as ft-intl, the unit of NAD83 / Arizona East (ft)"),
        ("foot", 25832, UNDECLARED, 0.3048, "read as ft-intl, because the CRS is not in feet"),
        ("foot", None, UNDECLARED, 0.3048, "read as ft-intl, because the CRS is not in feet"),
        ("foot", None, AlignmentDeclaration(crs="EPSG:6539"), US_FOOT_M, "read as ft-us"),
        ("foot", 25832, AlignmentDeclaration(unit="ft-us"), US_FOOT_M, ""),
        ("foot", 6539, AlignmentDeclaration(unit="ft-intl"), 0.3048, ""),
        ("inch", 6539, UNDECLARED, US_FOOT_M / 12, "read as ft-us"),
        ("mile", 25832, UNDECLARED, 1609.344, "read as ft-intl"),
        ("USSurveyFoot", 2222, UNDECLARED, US_FOOT_M, ""),
    ],
)
def test_feet_are_those_of_the_crs_or_declared(
    unit: str, epsg: int | None, declared: AlignmentDeclaration, metres: float, note: str
) -> None:
    head = f'<CoordinateSystem epsgCode="{epsg}"/>' if epsg else ""
    data = landxml(FLAT, units=f'<Units><Imperial linearUnit="{unit}"/></Units>', head=head, sta=1e6)
    file = read_alignment(data, declaration=declared)
    assert file.unit_m == pytest.approx(metres, rel=1e-12)
    assert file.stationing["CL"].start_m == pytest.approx(1e6 * metres, rel=1e-12)
    assert [note in warning for warning in file.warnings] == [True] * bool(note)


# --- elements without length, and sides of turns ----------------------------------------------------------------------


def test_elements_without_length_are_left_out() -> None:
    here = ends((100, 0), (100, 0))
    shape = (
        line((0, 0), (100, 0)) + f'<Line length="0">{here}</Line>'
        f'<Curve rot="cw" radius="100" length="0">{here}<Center>100 100</Center></Curve>'
        f'<Spiral rot="cw" length="0" radiusStart="INF" radiusEnd="100">{here}</Spiral>'
        f"<IrregularLine>{here}</IrregularLine>" + line((100, 0), (200, 0))
    )
    file = read_alignment(landxml(shape))
    assert stations(file)[-1] == pytest.approx(200.0)
    assert curvatures(file).tolist() == [0.0] * len(curvatures(file))
    assert file.warnings == ("alignment CL: elements of zero length that are left out: 4.",)
    circle = f'<Curve rot="cw" radius="10" length="62.83">{ends((0, 0), (0, 0))}<Center>10 0</Center></Curve>'
    with pytest.raises(UnreadableUpload, match="no arc of radius 10 joins"):
        read_alignment(landxml(circle))


def _clothoid_end(k0: float, k1: float, length: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """End of a clothoid from 0, 0 eastwards, and its PI on the tangents at both ends."""
    u, v, turn, _k, _dk = (float(value[0]) for value in clothoid(*(np.array([x]) for x in (length, k0, k1, length))))
    return (u, v), (u - v / math.tan(turn), 0.0)


def _spiral(rot: str, side: int, *, pi: bool = True, r0: str = "INF", r1: str = "200") -> str:
    k0, k1 = (0.0 if r == "INF" else side / float(r) for r in (r0, r1))
    (u, v), (at, _) = _clothoid_end(k0, k1, 50.0)
    stated = f"<PI>0 {100 + at:.4f}</PI>" if pi else ""
    rot = f'rot="{rot}"' if rot else ""
    points = f"<Start>0 100</Start>{stated}<End>{v:.4f} {100 + u:.4f}</End>"
    return f'<Spiral {rot} spiType="clothoid" length="50" radiusStart="{r0}" radiusEnd="{r1}">{points}</Spiral>'


SPIRALS = [("INF", "200"), ("400", "INF"), ("800", "150")]
BEFORE = line((0, 0), (100, 0))


@pytest.mark.parametrize(("r0", "r1"), SPIRALS)
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("rot", ["cw", "ccw", ""])
@pytest.mark.parametrize(("pi", "before"), [(True, True), (True, False), (False, True)])
def test_the_side_of_spirals_is_that_of_the_geometry(
    r0: str, r1: str, side: int, rot: str, pi: bool, before: bool
) -> None:
    file = read_alignment(landxml(BEFORE * before + _spiral(rot, side, pi=pi, r0=r0, r1=r1)))
    xy = centre(file)[:, :2]
    heading = np.unwrap(np.arctan2(*np.diff(xy, axis=0).T[::-1]))
    assert np.abs(np.diff(heading)).max() < 0.02, "no kink"
    assert np.sign(xy[-1, 1]) == side
    assert np.sign(curvatures(file)[np.abs(curvatures(file)).argmax()]) == side
    right = rot == ("ccw" if side > 0 else "cw")
    assert any("rot is missing or contradicts" in warning for warning in file.warnings) != right


@pytest.mark.parametrize("rot", ["cw", "ccw", ""])
@pytest.mark.parametrize("with_centre", [True, False])
@pytest.mark.parametrize("with_pi", [True, False])
@pytest.mark.parametrize("angle", [60, 270])
def test_the_side_of_curves_is_that_of_the_geometry(rot: str, with_centre: bool, with_pi: bool, angle: int) -> None:
    """To the left, after a line that is a tangent; arcs of more than 180 degrees have their PI behind the start."""
    turn = math.radians(angle)
    end = (100 + 80 * math.sin(turn), 80 - 80 * math.cos(turn))
    parts = "<Center>80 100</Center>" * with_centre + f"<PI>0 {100 + 80 * math.tan(turn / 2)!r}</PI>" * with_pi
    state = f'rot="{rot}"' if rot else ""
    arc = f'<Curve {state} radius="80" length="{80 * turn!r}">{ends((100, 0), end)}{parts}</Curve>'
    file = read_alignment(landxml(BEFORE + arc))
    on_arc = curvatures(file) != 0
    np.testing.assert_allclose(curvatures(file)[on_arc], 1 / 80)
    np.testing.assert_allclose(np.hypot(*(centre(file)[on_arc, :2] - (100, 80)).T), 80, atol=1e-6)
    assert stations(file)[-1] == pytest.approx(100 + 80 * turn)
    assert any("rot is missing or contradicts" in warning for warning in file.warnings) == (rot != "ccw")


def test_a_file_with_all_turns_mirrored_has_one_warning() -> None:
    (u, v), _pi = _clothoid_end(0.0, 1 / 200, 50.0)
    turn = 50 / 400
    cos, sin = math.cos(turn), math.sin(turn)
    last = (100 + u + 200 * (math.sin(turn + 0.5) - sin), v + 200 * (cos - math.cos(turn + 0.5)))
    arc = f'<Curve rot="cw" radius="200" length="100">{ends((100 + u, v), last)}</Curve>'
    after = line(last, (last[0] + 50 * math.cos(turn + 0.5), last[1] + 50 * math.sin(turn + 0.5)))
    spiral = _spiral("cw", 1).replace(f"{v:.4f} {100 + u:.4f}", f"{v!r} {100 + u!r}")
    file = read_alignment(landxml(BEFORE + spiral + arc + after))
    assert curvatures(file).min() == 0.0
    (warning,) = file.warnings
    assert "curves and spirals is 2, and the first is Spiral at 100.000 from its start" in warning


def test_turns_that_nothing_decides_are_refused() -> None:
    with pytest.raises(UnreadableUpload, match="rot is missing, and nothing else shows"):
        read_alignment(landxml(_spiral("", 1, pi=False)))
    (u, v), (at, _) = _clothoid_end(0.0, -1 / 200, 50.0)
    mirrored = _spiral("cw", -1).replace(f"<PI>0 {100 + at:.4f}</PI>", _mirrored_pi(u, v, at))
    with pytest.raises(UnreadableUpload, match="contradict its PI and its length"):
        read_alignment(landxml(BEFORE + mirrored))


def _mirrored_pi(u: float, v: float, at: float) -> str:
    """The PI on the other side of the chord."""
    across = np.array([-v, u]) / math.hypot(u, v)
    east, north = np.array([at, 0.0]) - 2 * (np.array([at, 0.0]) @ across) * across
    return f"<PI>{float(north)!r} {100 + float(east)!r}</PI>"


def test_a_pi_elsewhere_decides_nothing() -> None:
    far = _spiral("ccw", 1).replace("<PI>0 1", "<PI>-9000 7")
    assert read_alignment(landxml(BEFORE + far)).warnings == ()


def test_a_rounded_centre_does_not_bend_a_semicircle() -> None:
    """Radius and chord of a semicircle hardly show its turn: 1 mm of rounding moved the apex by 40 cm."""
    turn = math.pi - 0.02
    end = (round(100 * math.sin(turn), 3), round(100 - 100 * math.cos(turn), 3))
    file = read_alignment(landxml(f'<Curve rot="ccw">{ends((0, 0), end)}<Center>100.001 0.001</Center></Curve>'))
    np.testing.assert_allclose(np.hypot(*(centre(file)[:, :2] - (0, 100)).T), 100, atol=0.003)
    sized = landxml(f'<Curve rot="ccw" radius="100" length="{100 * turn:.3f}">{ends((0, 0), end)}</Curve>')
    np.testing.assert_allclose(np.hypot(*(centre(read_alignment(sized))[:, :2] - (0, 100)).T), 100, atol=0.003)


@pytest.mark.parametrize(
    ("unit", "delta"),
    [("", "3.5"), ("radians", "3.5"), ("grads", "222.8169"), ("decimal degrees", "200.5352"),
     ("decimal dd.mm.ss", "200.320677")],
)  # fmt: skip
def test_delta_shows_an_arc_of_more_than_180_degrees(unit: str, delta: str) -> None:
    end = (50 * math.sin(3.5), 50 - 50 * math.cos(3.5))
    arc = f'<Curve rot="ccw" radius="50" delta="{delta}">{ends((0, 0), end)}</Curve>'
    units = METRIC.replace('angularUnit="decimal degrees"', f'angularUnit="{unit}"' if unit else "")
    assert stations(read_alignment(landxml(arc, units=units)))[-1] == pytest.approx(175.0, abs=1e-3)


@pytest.mark.parametrize("before", [True, False])
def test_a_pi_behind_a_long_arc_about_a_centre_does_not_turn_it(before: bool) -> None:
    """Both arcs about a centre have the same PI; without a length the line before shows which it is, or else rot."""
    turn = 3.6
    end = (100 + 80 * math.sin(turn), 80 - 80 * math.cos(turn))
    pi = f"<PI>0 {100 + 80 * math.tan(turn / 2)!r}</PI>"
    arc = f'<Curve rot="ccw">{ends((100, 0), end)}<Center>80 100</Center>{pi}</Curve>'
    file = read_alignment(landxml(BEFORE * before + arc))
    assert stations(file)[-1] == pytest.approx(100 * before + 80 * turn)
    assert ["its PI lies behind its start" in warning for warning in file.warnings] == [True] * (not before)


def test_millimetres_of_a_projected_system() -> None:
    data = landxml(line((500_000_000, 5_400_000_000), (500_100_000, 5_400_000_000)))
    assert stations(read_alignment(data.replace(b'"meter"', b'"millimeter"')))[-1] == pytest.approx(100.0)


def test_reference_system() -> None:
    assert read_landxml(landxml(FLAT, head='<CoordinateSystem epsgCode="25832"/>')).crs == "EPSG:25832"
    unknown = read_landxml(landxml(FLAT, head='<CoordinateSystem epsgCode="99999"/>'))
    assert unknown.crs is None
    assert "declare the CRS" in (unknown.crs_problem or "")


def test_the_format_is_detected() -> None:
    assert read_alignment(landxml(FLAT)).format == "landxml"


GOOD_SPIRAL = f'<Spiral rot="cw" length="100" radiusStart="INF" radiusEnd="100">{ends((0, 0), (90, -20))}</Spiral>'


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (landxml(line((0, 0), (0, 0))), "no alignment with a CoordGeom that has a length"),
        (landxml(FLAT + line((200.5, 0), (300, 0))), "Line at 200.000 from its start: the element before ends away"),
        (landxml(FLAT.replace("200", "nan")), "Line at 0.000 from its start: the easting is 'nan'"),
        (landxml(FLAT.replace("0 200", "0")), "End is '0'"),
        (landxml("<Line><Start>0 0</Start></Line>"), "Start or End is missing"),
        (landxml(FLAT, units=""), "no linear unit"),
        (landxml(FLAT, units='<Units><Metric linearUnit="league"/></Units>'), "the linear unit 'league' is not known"),
        (landxml(""), "no alignment with a CoordGeom"),
        (landxml(f"<Chain>{ends((0, 0), (1, 1))}</Chain>"), "the element is not known"),
        (landxml(f'<Curve rot="up" radius="9">{ends((0, 0), (1, 1))}</Curve>'), "rot is 'up'"),
        (landxml(f'<Curve rot="cw" radius="9">{ends((0, 0), (100, 1))}</Curve>'), "no arc of radius 9 joins"),
        (landxml(f'<Curve rot="cw" radius="9">{ends((0, 0), (0, 0))}</Curve>'), "no arc of radius 9 joins"),
        (
            landxml(f'<Curve rot="cw">{ends((0, 0), (10, 0))}<Center>3 3</Center></Curve>'),
            "the distances of Start and End from Center differ by",
        ),
        (landxml(f'<Curve rot="cw" radius="0">{ends((0, 0), (0.01, 0))}</Curve>'), "no arc of radius 0 joins"),
        (landxml(FLAT, units='<Units><Metric linearUnit="meter" elevationUnit="rod"/></Units>'), "elevations 'rod' is"),
        (landxml(GOOD_SPIRAL), "the element misses its End by"),
        (landxml(GOOD_SPIRAL.replace('rot="cw"', 'rot="cw" spiType="bloss"')), "the spiral is 'bloss'"),
        (landxml(GOOD_SPIRAL.replace('"INF"', '"0"')), "radiusStart is 0"),
        (landxml(GOOD_SPIRAL.replace('"100" radiusS', '"-1" radiusS')), "the length is -1 m"),
        (
            landxml(FLAT, extra=profile("<PVI>0 1</PVI><PVI>0 2</PVI>")),
            "PVI at station 0: the station does not increase",
        ),
        (
            landxml(FLAT, extra=profile("<PVI>0 1</PVI><ParaCurve length='300'>100 2</ParaCurve><PVI>200 1</PVI>")),
            "ParaCurve at station 100: the curve begins 50.000 m before",
        ),
        (landxml(FLAT, extra=profile("<PVI>0 x</PVI>")), "PVI at station 0: the elevation is 'x'"),
        (landxml(FLAT, extra=profile("<PVI>0</PVI>")), "the text is '0'"),
        (landxml(FLAT, extra=profile("<Bump>0 1</Bump>")), "the profile has an element 'Bump'"),
        (landxml(FLAT)[:-30], "not XML"),
        (b'<!DOCTYPE x [<!ENTITY a "b">]><LandXML>&a;</LandXML>', "document type"),
    ],
)
def test_errors_name_the_place(data: bytes, message: str) -> None:
    with pytest.raises(UnreadableUpload) as caught:
        read_landxml(data)
    assert message in caught.value.message
    assert caught.value.cure
    assert caught.value.limit


def test_damaged_files_are_read_or_refused() -> None:
    arc = f'<Curve rot="ccw" radius="100">{ends((200, 0), (300, 100))}<Center>100 200</Center></Curve>'
    extra = profile(
        "<PVI>0 50</PVI><ParaCurve length='60'>80 54</ParaCurve><CircCurve radius='900'>200 51</CircCurve>"
    ) + ('<StaEquation staBack="100" staAhead="20" staInternal="100"/>')
    whole = landxml(FLAT + arc, extra=extra, head='<CoordinateSystem epsgCode="25832"/>')
    assert len(centre(read_landxml(whole))) > 100
    outcomes = {"read": 0, "refused": 0}
    for data in damaged(whole, 500):
        try:
            file = read_landxml(data)
        except WaymarkError:
            outcomes["refused"] += 1
            continue
        outcomes["read"] += 1
        assert np.isfinite(centre(file)[:, :2]).all()
    assert min(outcomes.values()) > 20
