"""The default decoder on simulated drives: what is there, what is not, and the same for any chunking."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple

import numpy as np
import pytest

from app.decoders.magnet.decoder import MagnetDecoder, decode_trace
from app.decoders.magnet.identify import TagCandidates, TagFormat
from app.decoders.magnet.readings import Finding, LineCrossing, MagnetReading, NoiseFinding, NoiseKind, Side, TagReading
from app.decoders.magnet.recording_check import find_mistakes
from app.errors import InvalidParameter
from app.markers.magnet import InformationTag, LineStyle, Orientation, Polarity
from app.sensors.magnetometer_bar import MagnetometerBar, MagnetTrace, SensorRole
from app.simulation.magnetic.clutter import ferrous_clutter, town_clutter
from app.simulation.magnetic.drive import MPH, Course, Scene, SimulatedDrive, Vehicle, Wheel, simulate_drive
from app.simulation.magnetic.recorder import CanBus, Chip
from app.simulation.magnetic.road import PlacedTag, Road, RoadMagnet, line_magnets

BAR = Vehicle.compact().bar


def magnets_drive(seed: int, clearance_m: float, mph: float, count: int = 30) -> SimulatedDrive:
    rng = np.random.default_rng(seed)
    magnets = [
        RoadMagnet(
            30 + 3 * i, float(rng.uniform(-0.8, 0.8)), list(Polarity)[i % 2], list(Orientation)[i // 2 % 2]
        )
        for i in range(count)
    ]  # fmt: skip
    vehicle = Vehicle.compact(clearance_m=clearance_m)
    return simulate_drive(Scene(Road(50 + 3 * count), vehicle, Course(mph * MPH), lines=magnets), rng)


def right_and_other(drive: SimulatedDrive, findings: Sequence[Finding]) -> tuple[int, int]:
    readings = [f for f in findings if isinstance(f, MagnetReading)]
    right = sum(
        any(
            abs(r.t_s - m.t_s) * m.speed_m_s < 0.15
            and abs(r.lateral_cm - m.lateral_cm) < 8
            and (r.polarity, r.phi_deg) == (m.polarity, m.orientation)
            for r in readings
        )
        for m in drive.magnets
    )
    return right, len(readings) - right


@pytest.mark.parametrize(("clearance_m", "mph"), [(0.16, 15), (0.16, 70), (0.30, 30), (0.30, 70)])
def test_finds_every_magnet_up_to_30_cm(clearance_m: float, mph: float) -> None:
    drive = magnets_drive(11, clearance_m, mph)
    assert right_and_other(drive, decode_trace(drive.trace, BAR)) == (30, 0)


def test_nothing_there_is_a_result() -> None:
    drive = simulate_drive(Scene(Road(300), Vehicle.compact()), np.random.default_rng(12))
    assert not [f for f in decode_trace(drive.trace, BAR) if isinstance(f, MagnetReading | TagReading | LineCrossing)]


@pytest.mark.slow
def test_town_iron_is_named_not_read() -> None:
    rng = np.random.default_rng(13)
    lines = line_magnets(20, 60, 6, 0.2, Polarity.N)
    scene = Scene(Road(1000), Vehicle.compact(), Course(25 * MPH), lines=lines, clutter=town_clutter(80, 1000, rng))
    drive = simulate_drive(scene, rng)
    findings = decode_trace(drive.trace, BAR)
    assert right_and_other(drive, findings) == (7, 0)
    unlike = {NoiseKind.FERROUS, NoiseKind.WRONG_MOMENT, NoiseKind.WRONG_HEIGHT, NoiseKind.SKEW}
    iron = [f for f in findings if isinstance(f, NoiseFinding) and f.kind in unlike]
    assert len(iron) > 20
    assert all("%" in f.reason or "cm" in f.reason for f in iron)


@pytest.mark.slow
def test_a_line_is_not_learnt_as_the_noise_of_a_wheel_whose_turn_is_about_as_long() -> None:
    lines = line_magnets(60, 200, 2, 0.6, Polarity.N)  # a turn is 1.95 m long
    vehicle = Vehicle.compact(clearance_m=0.25, wheel_moment_am2=1.0)
    scene = Scene(Road(220), vehicle, Course(25 * MPH, weave_m=0.1), lines=lines)
    drive = simulate_drive(scene, np.random.default_rng(23))
    findings = [f for f in decode_trace(drive.trace, BAR) if isinstance(f, MagnetReading)]
    assert len(findings) >= 0.95 * len(lines)
    assert {(f.phi_deg, f.polarity) for f in findings} == {(Orientation.UP, Polarity.N)}


@pytest.mark.slow
def test_iron_alone_shows_no_clearance_and_no_magnet() -> None:
    rng = np.random.default_rng([5, 0, 0])  # a drive that had eight magnets at clearances of 26 to 52 cm
    vehicle = Vehicle.compact(clearance_m=0.24)
    scene = Scene(Road(1500), vehicle, Course(12.0, weave_m=0.15), clutter=ferrous_clutter(120, 1500, 20, rng))
    drive = simulate_drive(scene, rng)
    findings = decode_trace(drive.trace, BAR)
    assert not [f for f in findings if isinstance(f, MagnetReading)]
    assert len([f for f in findings if isinstance(f, NoiseFinding)]) > 20


def test_one_magnet_is_read_where_the_clearance_is_declared() -> None:
    lines = line_magnets(40, 41, 6, 0.2, Polarity.N)
    scene = Scene(Road(80), Vehicle.compact(clearance_m=0.16), Course(12.0), lines=lines)
    drive = simulate_drive(scene, np.random.default_rng(4))
    (unsure,) = [f for f in decode_trace(drive.trace, BAR) if isinstance(f, NoiseFinding)]
    assert unsure.kind is NoiseKind.UNKNOWN_CLEARANCE
    assert "no three magnets show" in unsure.reason
    declared = MagnetometerBar.metro(clearance_m=0.16)
    assert right_and_other(drive, decode_trace(drive.trace, declared)) == (1, 0)


def test_a_wrong_clearance_is_corrected_and_named() -> None:
    drive = magnets_drive(11, 0.16, 30)
    declared = MagnetometerBar.metro(clearance_m=0.30)
    findings = decode_trace(drive.trace, declared)
    assert right_and_other(drive, findings) == (30, 0)
    (mistake,) = find_mistakes(drive.trace, declared, findings)
    assert mistake.field == "bar.clearance_m"
    assert "30 cm were declared" in mistake.reason


def test_magnets_under_a_truck_are_read_from_the_beginning() -> None:
    rng = np.random.default_rng(8)
    orientations = (Orientation.UP, Orientation.FORWARD)
    magnets = [
        RoadMagnet(15 + 3.0 * i, float(rng.uniform(-0.6, 0.6)), Polarity.N, orientations[i % 2]) for i in range(24)
    ]
    scene = Scene(Road(110), Vehicle.compact(clearance_m=0.4), Course(22.0), lines=magnets)
    drive = simulate_drive(scene, rng)
    right, other = right_and_other(drive, decode_trace(drive.trace, BAR))
    assert right >= 23
    assert other == 0


def test_a_line_passes_half_a_metre_beside_the_tags() -> None:
    tag = InformationTag.from_gaps("SNS", 1.0, (1, 3))
    tags = [PlacedTag(tag, 20.0 + 15 * i, 0.0) for i in range(6)]
    lines = line_magnets(20, 105, 2, 0.6, Polarity.N)
    scene = Scene(Road(120), Vehicle.compact(clearance_m=0.18), Course(15.0), tags=tags, lines=lines)
    drive = simulate_drive(scene, np.random.default_rng(3))
    findings = decode_trace(drive.trace, BAR, candidates=TagCandidates(formats=[TagFormat()]))
    read = [f.tag for f in findings if isinstance(f, TagReading) and f.tag is not None]
    assert read == [tag] * len(read)
    assert len(read) >= 4


@pytest.mark.parametrize("seed", [1, 2])
def test_any_chunking_gives_the_same(seed: int) -> None:
    drive = tags_drive(14, [InformationTag.from_gaps("SNS", 1.0, (1, 3))] * 3, 25.0)
    candidates = TagCandidates(formats=[TagFormat()])
    at_once = MagnetDecoder(BAR, candidates=candidates)
    whole = at_once.feed(drive.trace) + at_once.finish()
    rng = np.random.default_rng(seed)
    decoder = MagnetDecoder(BAR, candidates=candidates)
    pieces: list[Finding] = []
    t = -1.0
    while t < drive.trace.t_s[-1]:
        step = float(rng.choice([0.002, 0.02, 0.3, 2.0]))
        pieces += decoder.feed(drive.trace.between(t, t + step))
        t += step
    pieces += decoder.finish()
    assert [type(f) for f in pieces] == [type(f) for f in whole]
    assert all(alike(astuple(a), astuple(b)) for a, b in zip(pieces, whole, strict=True))
    assert sum(isinstance(f, TagReading) for f in whole) == 3


def alike(one: object, other: object) -> bool:
    """Whether values are equal but for rounding, which depends on where arrays happen to lie in memory."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(alike(a, b) for a, b in zip(one, other, strict=True))
    return one == pytest.approx(other, rel=1e-6, abs=1e-9) if isinstance(one, float) else one == other


def tags_drive(
    seed: int, tags: Sequence[InformationTag], pitch_m: float, *, wrong_way: bool = False,
    drop: tuple[int, int] | None = None, extra: Sequence[RoadMagnet] = (),
) -> SimulatedDrive:  # fmt: skip
    """Tags one after the other; drop: number of a tag and of its magnet that is missing on the road."""
    placed = [PlacedTag(tag, 30 + pitch_m * i) for i, tag in enumerate(tags)]
    lines = list(extra)
    if drop:
        gone = placed.pop(drop[0])
        lines += [
            RoadMagnet(gone.chainage_m + m.along_m, 0, m.polarity, m.orientation)
            for k, m in enumerate(gone.tag.magnets)
            if k != drop[1]
        ]
    scene = Scene(Road(60 + pitch_m * len(tags)), Vehicle.compact(), tags=placed, lines=lines, wrong_way=wrong_way)
    return simulate_drive(scene, np.random.default_rng(seed))


TAGS = [
    InformationTag.from_gaps(p, 1.0, g) for p, g in (("NNS", (1, 3)), ("SNS", (3, 1)), ("SSN", (2, 2)), ("NSS", (1, 3)))
]


@pytest.mark.parametrize("known", ["formats", "tags"])
def test_reads_tags(known: str) -> None:
    drive = tags_drive(15, TAGS, 15.0)
    candidates = TagCandidates(formats=[TagFormat()]) if known == "formats" else TagCandidates(TAGS)
    tags = [f for f in decode_trace(drive.trace, BAR, candidates=candidates) if isinstance(f, TagReading)]
    assert [t.tag for t in tags] == TAGS
    assert not any(t.wrong_way or t.missing or t.extra for t in tags)
    for reading in tags:
        assert reading.tag is not None
        for ratio, std, true in zip(reading.ratios, reading.ratio_std, reading.tag.ratios, strict=True):
            assert abs(ratio - true) < 4 * std + 0.01 * true


@pytest.mark.parametrize("magnet", [0, 1, 2])
def test_a_missing_magnet_costs_only_its_own_tag(magnet: int) -> None:
    drive = tags_drive(16, TAGS, 9.0, drop=(1, magnet))
    tags = [f for f in decode_trace(drive.trace, BAR, candidates=TagCandidates(TAGS)) if isinstance(f, TagReading)]
    whole = [t.tag for t in tags if not t.missing]
    assert [t for t in whole if t is not None] == [TAGS[0], TAGS[2], TAGS[3]]


def test_an_extra_magnet_costs_nothing() -> None:
    more = [RoadMagnet(30 + 9 + 2.0, 0.0, Polarity.N, Orientation.FORWARD)]
    drive = tags_drive(17, TAGS, 9.0, extra=more)
    tags = [f for f in decode_trace(drive.trace, BAR, candidates=TagCandidates(TAGS)) if isinstance(f, TagReading)]
    assert [t.tag for t in tags] == TAGS
    assert [t.extra for t in tags] == [0, 1, 0, 0]


def test_the_wrong_way_is_recognised() -> None:
    tags = [InformationTag.from_gaps("NNN", 1.0, (1, 3)), InformationTag.from_gaps("NSN", 1.0, (3, 1))]
    drive = tags_drive(18, tags, 15.0, wrong_way=True)
    readings = [f for f in decode_trace(drive.trace, BAR, candidates=TagCandidates(tags)) if isinstance(f, TagReading)]
    assert [r.tag for r in readings] == tags
    assert all(r.wrong_way for r in readings)


def test_a_line_crossing_says_which_line_and_side() -> None:
    lines = line_magnets(20, 90, 6, 1.2, Polarity.N)
    course = Course(lefts=[(0, 0.0), (30, 0.0), (60, 0.9)], weave_m=0)
    drive = simulate_drive(Scene(Road(100), Vehicle.compact(), course, lines=lines), np.random.default_rng(19))
    crossings = [f for f in decode_trace(drive.trace, BAR) if isinstance(f, LineCrossing)]
    assert [(c.style, c.side) for c in crossings] == [(LineStyle.SOLID, Side.LEFT)]


def test_other_bars_and_rates() -> None:
    positions = np.array([[0.0, y, 0.0] for y in np.arange(-0.8, 0.81, 0.2)])
    bar = MagnetometerBar(positions, ("array",) * 9)  # type: ignore[arg-type]
    rng = np.random.default_rng(20)
    magnets = [
        RoadMagnet(20 + 3.0 * i, 0.1 * (i % 9 - 4), list(Polarity)[i % 2], Orientation.FORWARD) for i in range(12)
    ]
    scene = Scene(
        Road(65),
        Vehicle.compact(bar=bar, wheel_moment_am2=0),
        Course(20 * MPH),
        lines=magnets,
        chip=Chip(rate_hz=100.0),
    )
    drive = simulate_drive(scene, rng)
    assert right_and_other(drive, decode_trace(drive.trace, bar)) == (12, 0)


@pytest.mark.slow
def test_strong_wheels_are_cancelled_on_bars_with_other_spacings() -> None:
    metro = MagnetometerBar.metro(forward_m=3.2)
    places = [(3.2, y, 0.0) for y in (-0.9, -0.75, -0.6, -0.35, -0.3, -0.1, 0.05, 0.12, 0.3, 0.5, 0.55, 0.8, 0.9)]
    positions = np.array([*places, *metro.positions_m[metro.references].tolist()])
    roles = (SensorRole.ARRAY,) * len(places) + (SensorRole.REFERENCE,) * 2
    bar = MagnetometerBar(positions, roles, axis_delay_s=metro.axis_delay_s)
    rng = np.random.default_rng([7700, 5])
    magnets = [RoadMagnet(30 + 3.3 * i, 0.15 * (i % 9 - 4), list(Polarity)[i % 2], Orientation.UP) for i in range(40)]
    vehicle = Vehicle.compact(bar=bar, clearance_m=0.3, wheel_moment_am2=2.0)
    drive = simulate_drive(Scene(Road(175), vehicle, Course(14.0), lines=magnets), rng)
    right, other = right_and_other(drive, decode_trace(drive.trace, bar))
    assert other == 0
    assert right >= 38


def test_missing_samples_and_a_gap_are_survived_and_reported() -> None:
    drive = magnets_drive(21, 0.16, 30)
    t, field = drive.trace.t_s, drive.trace.field_ut.copy()
    field[:, 4] = np.nan  # a dead sensor
    middle = (drive.magnets[10].t_s + drive.magnets[11].t_s) / 2
    keep = np.abs(t - middle) > 0.06
    cut = MagnetTrace(t[keep], field[keep], drive.trace.speed_t_s, drive.trace.speed_m_s)
    findings = decode_trace(cut, BAR)
    right, other = right_and_other(drive, findings)
    assert right >= 29
    assert other == 0
    gaps = [f for f in findings if isinstance(f, NoiseFinding) and f.kind is NoiseKind.GAP]
    assert len(gaps) == 1
    assert gaps[0].t_s == pytest.approx(middle, abs=0.1)


def test_bad_input_is_named() -> None:
    field = np.zeros((3, 14, 3))
    t = np.array([0.0, 0.1, 0.2])
    with pytest.raises(InvalidParameter, match="time does not rise"):
        MagnetTrace(np.array([0.0, 0.2, 0.1]), field, t, t)
    with pytest.raises(InvalidParameter, match="no speed"):
        decode_trace(MagnetTrace(t, field, np.empty(0), np.empty(0)), BAR)
    with pytest.raises(InvalidParameter, match="3 sensors"):
        decode_trace(MagnetTrace(t, field[:, :3], t, t), BAR)
    with pytest.raises(InvalidParameter, match="finite"):
        MagnetTrace(t, field, t, np.array([1, np.nan, 2]))


@pytest.mark.parametrize("clearance_m", [0.30, 0.36])
@pytest.mark.parametrize("seed", [22, 23, 24])
def test_opposed_magnets_half_a_metre_apart_are_not_one_of_the_other_kind(clearance_m: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    magnets = [
        RoadMagnet(at_m + shift, 0.1, polarity, Orientation.FORWARD)
        for at_m in 20 + np.cumsum(rng.uniform(3, 6, 12))
        for shift, polarity in ((0.0, Polarity.N), (0.5, Polarity.S))
    ]
    scene = Scene(Road(110), Vehicle.compact(clearance_m=clearance_m), Course(18.0), lines=magnets)
    drive = simulate_drive(scene, rng)
    right, other = right_and_other(drive, decode_trace(drive.trace, BAR))
    assert other == 0
    assert right >= 20


@pytest.mark.parametrize(("beside_m", "seed"), [(0.5, 0), (0.45, 1)])
def test_a_magnet_is_of_the_kind_that_its_moment_shows_beside_one_of_the_other_kind(beside_m: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    magnets = []
    for at_m in 20 + 6.0 * np.arange(12):
        magnets.append(RoadMagnet(at_m, 0.0, Polarity.N, Orientation.FORWARD))
        magnets.append(RoadMagnet(at_m + rng.uniform(-0.15, 0.15), beside_m, Polarity.N, Orientation.UP))
    scene = Scene(Road(110), Vehicle.compact(clearance_m=0.32), Course(18.0), lines=magnets)
    drive = simulate_drive(scene, rng)
    right, other = right_and_other(drive, decode_trace(drive.trace, BAR))
    assert other == 0
    assert right >= 17  # 11 and 13 where each keeps the kind as which it was found


@pytest.mark.parametrize("lateral_m", [0.05, 0.35, 0.6])
def test_a_line_as_far_apart_as_a_turn_is_long_is_never_taken_out_as_the_noise_of_a_wheel(lateral_m: float) -> None:
    turn_m = 2 * np.pi * Wheel((0.0, 0.0, 0.0)).radius_m
    lines = line_magnets(14, 150, turn_m, lateral_m, Polarity.N)
    vehicle = Vehicle.compact(clearance_m=0.2, wheel_moment_am2=0.3)
    scene = Scene(Road(160), vehicle, Course(13.0, weave_m=0.0, hunting=0.0), lines=lines, can=CanBus(speed_scale=0.0))
    drive = simulate_drive(scene, np.random.default_rng(5))
    right, other = right_and_other(drive, decode_trace(drive.trace, BAR))
    assert other == 0
    assert right >= 60


@pytest.mark.parametrize(
    ("turns", "lateral_m", "length_m"), [(1.0, 0.8, 110.0), (0.99, -0.75, 110.0), (2.0, 0.8, 110.0), (1.0, 0.8, 94.0)]
)
def test_a_line_under_the_end_of_a_high_bar_is_not_a_wheel(turns: float, lateral_m: float, length_m: float) -> None:
    turn_m = turns * 2 * np.pi * Wheel((0.0, 0.0, 0.0)).radius_m
    lines = line_magnets(14, 94, turn_m, lateral_m, Polarity.N)  # the last drive ends with it
    vehicle = Vehicle.compact(clearance_m=0.33, wheel_moment_am2=0.4)
    drive = simulate_drive(
        Scene(Road(length_m), vehicle, Course(13.0, weave_m=0.02), lines=lines), np.random.default_rng(5)
    )
    right, other = right_and_other(drive, decode_trace(drive.trace, BAR))
    assert other == 0  # 12, 0, 10 and 0 with what is learnt on the way alone
    assert right >= len(drive.magnets) - 1  # 1, 0, 21 and 0 with that


@pytest.mark.slow
def test_tags_beside_a_line_are_read_although_their_fields_merge_with_it() -> None:
    tag = InformationTag.from_gaps("SNS", 0.5, (1, 7))  # two opposed magnets half a metre apart
    tags = [PlacedTag(tag, 20.0 + 15 * i, 0.15) for i in range(8)]
    lines = line_magnets(20, 145, 3, 0.65, Polarity.N)
    scene = Scene(Road(150), Vehicle.compact(clearance_m=0.3), Course(15.0), tags=tags, lines=lines)
    drive = simulate_drive(scene, np.random.default_rng(4))
    right, other = right_and_other(drive, decode_trace(drive.trace, BAR))
    assert other == 0
    assert right >= len(drive.magnets) - 3


@pytest.mark.slow
def test_a_magnet_at_the_border_of_two_regions_is_read_once() -> None:
    lines = line_magnets(20, 180, 2.0, 0.7, Polarity.N)  # regions end after 8 m, wherever a magnet is
    scene = Scene(Road(200), Vehicle.compact(clearance_m=0.16), Course(15.0, weave_m=0.1), lines=lines)
    findings = decode_trace(simulate_drive(scene, np.random.default_rng(6)).trace, BAR)
    places = np.sort([f.odometer_m for f in findings if isinstance(f, MagnetReading)])
    assert len(places) > 60
    assert np.diff(places).min() > 1.0
