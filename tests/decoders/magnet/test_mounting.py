"""A bar that is not mounted as declared is named, and corrected or refused; a healthy one gets no finding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from app.decoders.magnet.mounting import Mounting, MountingModel, check_mounting, find_events
from app.decoders.magnet.readings import Finding, MagnetReading, NoiseFinding, NoiseKind
from app.decoders.magnet.recording_check import decode_checked
from app.decoding.declarations import DeclaredTrace
from app.markers.magnet import Orientation, Polarity
from app.planning.proof.drives import pack
from app.sensors.magnetometer_bar import BarDeclaration, MagnetTrace
from app.services.decodes.trace_tasks import DecodedTrace, decode_recording
from app.simulation.magnetic.clutter import Clutter
from app.simulation.magnetic.drive import Course, Scene, SimulatedDrive, Vehicle, simulate_drive
from app.simulation.magnetic.recorder import write_tables
from app.simulation.magnetic.road import Road, RoadMagnet, line_magnets

pytestmark = pytest.mark.slow

VEHICLE = Vehicle.compact(clearance_m=0.18)
BAR = VEHICLE.bar
BEND = ((25.0, 65.0, 30.0),)
MIRRORED = [7, 8, 9, 10, 11, 12, 6, 0, 1, 2, 3, 4, 5, 13]
"""Channels of an array whose left and right are exchanged."""
BACKWARDS_IN_HALVES = [5, 4, 3, 2, 1, 0, 6, 12, 11, 10, 9, 8, 7, 13]


def drive(*, turning: bool = False, seed: int = 1, vehicle: Vehicle = VEHICLE) -> SimulatedDrive:
    """24 magnets of both kinds and polarities within 110 m, anywhere under the bar."""
    rng = np.random.default_rng(seed)
    magnets = [
        RoadMagnet(
            12 + 4.0 * k, float(rng.uniform(-0.75, 0.75)), Polarity.N if rng.random() < 0.5 else Polarity.S,
            Orientation.UP if rng.random() < 0.5 else Orientation.FORWARD,
        )
        for k in range(24)
    ]  # fmt: skip
    road = Road(115.0, BEND if turning else ())
    return simulate_drive(Scene(road, vehicle, Course(9.0), lines=magnets), rng)


def upload(trace: MagnetTrace) -> DecodedTrace:
    """What the server finds in a recording that is uploaded."""
    declared = DeclaredTrace(unit="uT", axes="ISO8855", bar=BarDeclaration(forward_m=3.2))
    return decode_recording("drive.zip", pack(write_tables(trace)), declared)


def right_and_wrong(one: SimulatedDrive, findings: Sequence[Finding]) -> tuple[int, int]:
    """Readings at the time and place of a magnet of their kind and polarity, and others."""
    right = 0
    readings = [f for f in findings if isinstance(f, MagnetReading)]
    for reading in readings:
        right += any(
            abs(reading.t_s - m.t_s) * m.speed_m_s < 0.3 and abs(reading.lateral_cm - m.lateral_cm) < 15
            and reading.polarity is m.polarity and reading.phi_deg is m.orientation
            for m in one.magnets
        )  # fmt: skip
    return right, len(readings) - right


def faults(findings: Sequence[Finding]) -> list[str]:
    """What is reported of sensors."""
    return [f.reason for f in findings if isinstance(f, NoiseFinding) and f.kind is NoiseKind.SENSOR]


def with_channels(trace: MagnetTrace, order: list[int]) -> MagnetTrace:
    return replace(trace, field_ut=np.ascontiguousarray(trace.field_ut[:, order]))


def with_signs(trace: MagnetTrace, sensors: list[int], signs: tuple[int, int, int]) -> MagnetTrace:
    field = trace.field_ut.copy()
    field[:, sensors] *= np.array(signs, np.float32)
    return replace(trace, field_ut=field)


def swapped(trace: MagnetTrace, first: int, second: int) -> MagnetTrace:
    order = list(range(14))
    order[first], order[second] = second, first
    return with_channels(trace, order)


def test_mountings_that_look_alike_from_below_have_one_misfit() -> None:
    """All signs inverted is another polarity; left and right exchanged with y inverted a mirrored road."""
    model, same = MountingModel(find_events(drive().trace, BAR), BAR), Mounting.declared(14)
    assert len(model.events) > 15
    whole = np.array([one.share for one in model.declared()])
    assert np.median(whole) < 0.02

    def misfits(signs: tuple[int, int, int], order: list[int]) -> np.ndarray:
        mounting = replace(same, signs=np.tile(np.array(signs, float), (14, 1)), channels=np.array(order))
        return np.array([model.misfit(event, mounting).share for event in model.events])

    declared_order = list(range(14))
    assert misfits((-1, -1, -1), declared_order) == pytest.approx(whole, abs=0.01)
    assert misfits((1, -1, 1), MIRRORED) == pytest.approx(whole, abs=0.01)
    for signs in ((-1, 1, 1), (1, -1, 1), (1, 1, -1)):
        assert np.median(misfits(signs, declared_order)) > 0.1


@pytest.mark.parametrize("turning", [False, True], ids=["straight", "bend"])
@pytest.mark.parametrize("wheels_am2", [0.15, 1.0])
def test_a_bar_as_declared_gets_no_finding(turning: bool, wheels_am2: float) -> None:
    vehicle = Vehicle.compact(clearance_m=0.18, wheel_moment_am2=wheels_am2)
    decoded = upload(drive(turning=turning, vehicle=vehicle).trace)
    assert not faults(decoded.findings)
    assert not [text for text in decoded.report.warnings if "sensor" in text or "inverted" in text]


def test_lines_that_are_crossed_look_like_no_fault() -> None:
    """Each is seen by a few sensors of one half, as the order of all sensors reversed would show it."""
    for seed, (left_m, other_m) in enumerate(((0.6, -0.7), (1.0, -0.4), (0.3, -1.1))):
        lines = line_magnets(40, 80, 5.0, left_m, Polarity.S) + line_magnets(90, 105, 5.0, other_m, Polarity.N)
        scene = Scene(Road(140.0), Vehicle.compact(), Course(12.0, weave_m=0.15), lines=lines)
        assert not check_mounting(simulate_drive(scene, np.random.default_rng(seed)).trace, BAR).faults


@pytest.mark.parametrize("kind", ["manhole cover", "bridge joint", "slab joint", "scrap", "tram rails"])
def test_iron_looks_like_no_fault(kind: str) -> None:
    rng = np.random.default_rng(4)
    iron = [Clutter(kind, float(at), float(rng.uniform(-0.8, 0.8))) for at in np.arange(15, 105, 6.0)]
    scene = Scene(Road(115.0), Vehicle.compact(wheel_moment_am2=0.6), Course(9.0), clutter=iron)
    assert not check_mounting(simulate_drive(scene, rng).trace, BAR).faults


def test_a_sensor_that_is_upside_down_is_corrected_and_named() -> None:
    one = drive()
    decoded = upload(with_signs(one.trace, [2], (1, -1, -1)))
    assert faults(decoded.findings) == ["sensor 3 is turned over (y and z are inverted); corrected"]
    assert [text for text in decoded.report.warnings if text.startswith("sensor 3 is turned over")]
    right, wrong = right_and_wrong(one, decoded.findings)
    assert right >= 23
    assert wrong == 0


def test_exchanged_cables_are_corrected_and_named() -> None:
    one = drive(seed=2)
    checked = decode_checked(swapped(one.trace, 8, 9), BAR)
    assert [fault.reason for fault in checked.faults] == ["sensors 9 and 10 are exchanged"]
    right, wrong = right_and_wrong(one, checked.findings)
    assert right >= 23
    assert wrong == 0


@pytest.mark.parametrize(
    ("order", "signs", "name"),
    [
        (MIRRORED, (1, 1, 1), "left and right of the bar are exchanged"),
        (list(range(14)), (-1, 1, -1), "x and z are inverted"),
        (list(range(14)), (1, -1, -1), "the axes are FRD where FLU was declared or the other way round"),
        (MIRRORED, (-1, -1, 1), "the bar is mounted backwards"),
    ],
)
def test_what_looks_alike_on_a_straight_road_is_refused_and_corrected_in_a_bend(
    order: list[int], signs: tuple[int, int, int], name: str
) -> None:
    straight = drive(seed=3)
    decoded = upload(with_signs(with_channels(straight.trace, order), list(range(14)), signs))
    assert name in faults(decoded.findings)[0]
    assert [text for text in decoded.report.warnings if name in text]
    assert not [f for f in decoded.findings if isinstance(f, MagnetReading)]
    bend = drive(turning=True, seed=3)
    decoded = upload(with_signs(with_channels(bend.trace, order), list(range(14)), signs))
    assert faults(decoded.findings) == [f"{name}; corrected"]
    right, wrong = right_and_wrong(bend, decoded.findings)
    assert right >= 22
    assert wrong == 0


@pytest.mark.parametrize(
    ("order", "name"),
    [
        (list(range(14))[::-1], "the order of all sensors is reversed"),
        (BACKWARDS_IN_HALVES, "both halves are numbered from their other ends"),
    ],
)
def test_reversed_orders_are_corrected_without_a_bend(order: list[int], name: str) -> None:
    one = drive(seed=4)
    checked = decode_checked(with_channels(one.trace, order), BAR)
    assert [fault.reason for fault in checked.faults] == [name]
    right, wrong = right_and_wrong(one, checked.findings)
    assert right >= 23
    assert wrong == 0


@pytest.mark.parametrize("noise_ut", [0.0, 1.5])
def test_a_dead_sensor_is_left_out(noise_ut: float) -> None:
    one = drive(seed=5)
    field = one.trace.field_ut.copy()
    field[:, 1] = field[0, 1] + np.random.default_rng(1).normal(0, noise_ut, field[:, 1].shape)
    checked = decode_checked(replace(one.trace, field_ut=field), BAR)
    assert [fault.reason for fault in checked.faults] == ["sensor 2 shows no field"]
    right, wrong = right_and_wrong(one, checked.findings)
    assert right >= 22
    assert wrong == 0


def test_a_short_recording_shows_nothing() -> None:
    trace = with_signs(drive().trace, [2], (1, -1, -1)).between(0.0, 0.6)
    assert check_mounting(trace, BAR).faults == ()
