"""A bar that is not mounted as declared is named, and corrected or refused; a healthy one gets no finding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.decoders.magnet.mounting import Mounting, MountingModel, check_mounting, measure_spectra, rotation_about
from app.decoders.magnet.readings import Finding, MagnetReading, NoiseFinding, NoiseKind
from app.decoders.magnet.recording_check import decode_checked
from app.markers.magnet import Orientation, Polarity
from app.sensors.magnetometer_bar import MagnetTrace
from app.simulation.magnetic.clutter import Clutter
from app.simulation.magnetic.drive import Course, Scene, SimulatedDrive, Vehicle, simulate_drive
from app.simulation.magnetic.road import Road, RoadMagnet

VEHICLE = Vehicle.compact(clearance_m=0.18)
BAR = VEHICLE.bar
BEND = ((25.0, 65.0, 30.0),)
MIRRORED = [7, 8, 9, 10, 11, 12, 6, 0, 1, 2, 3, 4, 5, 13]
"""Channels of an array whose left and right are exchanged."""


def drive(*, turning: bool = False, seed: int = 1, vehicle: Vehicle = VEHICLE, iron: bool = False) -> SimulatedDrive:
    """24 magnets of both kinds and polarities within 110 m, anywhere under the bar."""
    rng = np.random.default_rng(seed)
    magnets = [
        RoadMagnet(
            12 + 4.0 * k, float(rng.uniform(-0.75, 0.75)), Polarity.N if rng.random() < 0.5 else Polarity.S,
            Orientation.UP if rng.random() < 0.5 else Orientation.FORWARD,
        )
        for k in range(24)
    ]  # fmt: skip
    scrap = [Clutter("scrap", float(at), 0.3 * (-1) ** k) for k, at in enumerate(np.arange(50, 95, 1.2))]
    road = Road(115.0, BEND if turning else ())
    return simulate_drive(Scene(road, vehicle, Course(9.0), lines=magnets, clutter=scrap if iron else []), rng)


def right_and_wrong(one: SimulatedDrive, findings: list[Finding]) -> tuple[int, int]:
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


def test_mountings_that_look_alike_from_below_have_one_likelihood() -> None:
    """All signs inverted is another polarity; left and right exchanged with y inverted a mirrored road."""
    spectra = measure_spectra(drive().trace, BAR, [float(at) for at in np.arange(9.0, 101.0, 4.0)])
    assert spectra is not None
    model, declared = MountingModel(spectra, BAR, [1, 2]), Mounting.declared(14)
    whole = model.evaluate(declared).total

    def turned(signs: tuple[int, int, int], order: list[int]) -> float:
        axes = np.tile(np.diag(signs).astype(float), (14, 1, 1))
        return model.evaluate(replace(declared, axes=axes, channels=np.array(order))).total

    same = list(range(14))
    mirrored = [*MIRRORED[:6], 13, *MIRRORED[7:13], 6]
    assert turned((-1, -1, -1), same) == pytest.approx(whole, abs=1e-3)
    assert turned((1, -1, 1), mirrored) == pytest.approx(whole, abs=1.0)  # the vehicle weaves
    for signs in ((-1, 1, 1), (1, -1, 1), (1, 1, -1)):
        assert turned(signs, same) < whole - 100


@pytest.mark.parametrize("turning", [False, True], ids=["straight", "bend"])
@pytest.mark.parametrize("wheels_am2", [0.15, 1.0])
def test_a_bar_as_declared_gets_no_finding(turning: bool, wheels_am2: float) -> None:
    vehicle = Vehicle.compact(clearance_m=0.18, wheel_moment_am2=wheels_am2)
    checked = decode_checked(drive(turning=turning, vehicle=vehicle).trace, BAR)
    assert checked.faults == ()
    assert not [f for f in checked.findings if isinstance(f, NoiseFinding) and f.kind is NoiseKind.SENSOR]


def test_a_sensor_that_is_upside_down_is_corrected_and_named() -> None:
    one = drive()
    checked = decode_checked(with_signs(one.trace, [2], (1, -1, -1)), BAR)
    (fault,) = checked.faults
    assert fault.reason == "sensor 3 is turned over (y and z are inverted)"
    note = checked.findings[0]
    assert isinstance(note, NoiseFinding)
    assert note.kind is NoiseKind.SENSOR
    assert "sensor 3" in note.reason
    right, wrong = right_and_wrong(one, checked.findings)
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
    checked = decode_checked(with_signs(with_channels(straight.trace, order), list(range(14)), signs), BAR)
    assert checked.is_refused
    assert name in checked.faults[0].reason
    assert not [f for f in checked.findings if isinstance(f, MagnetReading)]
    bend = drive(turning=True, seed=3)
    checked = decode_checked(with_signs(with_channels(bend.trace, order), list(range(14)), signs), BAR)
    assert [fault.reason for fault in checked.faults] == [name]
    right, wrong = right_and_wrong(bend, checked.findings)
    assert right >= 22
    assert wrong == 0


def test_reversed_orders_are_corrected_without_a_bend() -> None:
    one = drive(seed=4)
    for order, name in (
        (list(range(14))[::-1], "the order of all sensors is reversed"),
        ([5, 4, 3, 2, 1, 0, 6, 12, 11, 10, 9, 8, 7, 13], "both halves are numbered from their other ends"),
    ):
        checked = decode_checked(with_channels(one.trace, order), BAR)
        assert [fault.reason for fault in checked.faults] == [name]
        right, wrong = right_and_wrong(one, checked.findings)
        assert right >= 23
        assert wrong == 0


def test_a_turned_bar_is_named_with_its_angle() -> None:
    turn = rotation_about("z", np.radians(12.0))
    positions = BAR.positions_m.copy()
    middle = positions[BAR.array].mean(axis=0)
    positions[BAR.array] = middle + (positions[BAR.array] - middle) @ turn.T
    one = drive(vehicle=replace(VEHICLE, bar=replace(BAR, positions_m=positions)))
    field = one.trace.field_ut.copy()
    field[:, BAR.array] = field[:, BAR.array] @ turn.astype(np.float32)
    checked = decode_checked(replace(one.trace, field_ut=field), BAR)
    (fault,) = checked.faults
    assert "to the left" in fault.reason
    assert abs(float(fault.reason.split("turned by ")[1].split()[0]) - 12) <= 3
    assert right_and_wrong(one, checked.findings)[0] >= 23


@pytest.mark.parametrize("noise_ut", [0.0, 1.5])
def test_a_dead_sensor_is_named(noise_ut: float) -> None:
    one = drive(seed=5)
    field = one.trace.field_ut.copy()
    field[:, 1] = field[0, 1] + np.random.default_rng(1).normal(0, noise_ut, field[:, 1].shape)
    checked = decode_checked(replace(one.trace, field_ut=field), BAR)
    assert [fault.reason for fault in checked.faults] == ["sensor 2 shows no field"]
    right, wrong = right_and_wrong(one, checked.findings)
    assert right >= 22
    assert wrong == 0


def test_a_short_recording_shows_nothing() -> None:
    trace = drive().trace.between(0.0, 0.6)
    assert check_mounting(trace, BAR, []).faults == ()


def test_a_stretch_full_of_iron_is_reported_as_one_that_cannot_be_read() -> None:
    stretches = [
        f for f in decode_checked(drive(iron=True).trace, BAR).findings
        if isinstance(f, NoiseFinding) and f.kind is NoiseKind.UNREADABLE
    ]  # fmt: skip
    assert stretches
    assert 45 < stretches[0].odometer_m < 75
    assert "iron hides magnets from" in stretches[0].reason
