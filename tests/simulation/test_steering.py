"""A simulated drive along a path."""

from __future__ import annotations

import math

import numpy as np
import pytest

from app.errors import InvalidParameter
from app.lanes.control import Controller, SteeringSettings, follow_path, plan_speed, stanley_rad
from app.lanes.mpc import MpcSteering
from app.simulation import steering
from app.simulation.steering import PoseNoise, Vehicle, check_steering, draw_pose_errors

pytestmark = pytest.mark.slow

EAST = np.column_stack([np.arange(0.0, 301.0), np.zeros(301)])


def lane(radius_m: float, turn_deg: float) -> np.ndarray:
    """Straight, bend to the left, straight."""
    turn, step = math.radians(turn_deg), 0.5
    angle = np.arange(0.0, turn, step / radius_m)
    arc = radius_m * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    out = np.arange(step, 60.0, step)[:, None] * (math.cos(turn), math.sin(turn))
    end = radius_m * np.array([math.sin(turn), 1 - math.cos(turn)])
    return np.vstack([np.column_stack([np.arange(-60.0, 0, step), np.zeros(120)]), arc, end + out])


def clothoid(steps: int = 1000) -> np.ndarray:
    """A lane of 500 m whose curvature changes evenly, to 1 / 25 m and back, both ways."""
    s = np.linspace(0, 500, steps)
    curvature = np.interp(
        s, [0, 100, 140, 160, 200, 280, 320, 340, 380, 500], [0, 0, 0.04, 0.04, 0, 0, -0.04, -0.04, 0, 0]
    )
    heading = np.concatenate(([0.0], np.cumsum((curvature[1:] + curvature[:-1]) / 2 * np.diff(s))))
    middle = (heading[1:] + heading[:-1]) / 2
    chords = np.column_stack([np.cos(middle), np.sin(middle)]) * np.diff(s)[:, None]
    return np.vstack([(0.0, 0.0), np.cumsum(chords, axis=0)])


def wobbly(path: np.ndarray, sigma_m: float, over_m: float, rng: np.random.Generator) -> np.ndarray:
    """The path with sideways errors that change over some metres, as a decoded one has them."""
    step = np.hypot(*np.diff(path, axis=0).T).mean()
    kernel = np.exp(-0.5 * (np.arange(-200, 201) * step / over_m) ** 2)
    errors = np.convolve(rng.standard_normal(len(path) + 400), kernel, "valid")
    tangent = np.gradient(path, axis=0)
    tangent /= np.hypot(*tangent.T)[:, None]
    return path + (sigma_m * errors / errors.std())[:, None] * np.column_stack([-tangent[:, 1], tangent[:, 0]])


def test_goals_hold_on_a_path_with_the_errors_of_40_ft_spacing():
    truth = clothoid()
    for seed in (1000, 1001, 1002):
        rng = np.random.default_rng(seed)
        path = wobbly(truth, 0.020, 6.0, rng)
        check = check_steering(path, 50.0, truth_enu_m=truth, noise=PoseNoise(), rng=rng)
        assert check.completed
        assert check.rms_m <= 0.03
        assert check.mse_m2 <= 0.001
        assert check.path_rms_m < 0.02
        assert check.rms_m > 0.015  # the errors of path and pose are not lost on the way
        assert check.distance_m == pytest.approx(500, rel=0.02)


def test_paper_s_laws_cut_what_the_prediction_follows():
    path = clothoid()
    checks = {law: check_steering(path, 40.0, controller=law) for law in Controller}
    assert all(check.controller is law for law, check in checks.items())
    assert checks[Controller.PREDICTIVE].rms_m < 0.005
    assert checks[Controller.PREDICTIVE].max_m < 0.02
    assert checks[Controller.MPC].rms_m < 0.005
    assert checks[Controller.MPC].max_m < 0.02
    assert checks[Controller.MPC].unsolved_steps == 0
    assert 0.005 < checks[Controller.STANLEY].rms_m < 0.1
    assert checks[Controller.STANLEY_LOOKAHEAD].rms_m > 0.3


@pytest.mark.parametrize("radius_m", [60.0, 100.0])
def test_equation_5_drives_inside_of_a_bend_by_its_geometry(radius_m):
    settings = SteeringSettings(gain_per_s=0.6)
    check = check_steering(lane(radius_m, 270.0), 30.0, controller="stanley-lookahead", settings=settings)
    # a steady turn has psi = steer, so the point 15 m ahead is on the path: r^2 = R^2 - d^2 - 2 d L for the front axle
    inside_m = radius_m - math.sqrt(radius_m**2 - 15.0**2 - 2 * 15.0 * 2.70)
    middle = (check.trace.station_m > 60 + 2.5 * radius_m) & (check.trace.station_m < 60 + 4 * radius_m)
    assert np.median(check.trace.path_error_m[middle]) == pytest.approx(inside_m, abs=0.03)


def test_a_steady_bend_is_driven_by_its_geometry():
    check = check_steering(lane(24.0, 300.0), 60.0)
    trace = check.trace
    steady = (trace.station_m > 100) & (trace.station_m < 160)
    centre = np.array([0.0, 24.0])
    front, rear = (np.hypot(*(at[steady] - centre).T) for at in (trace.front_enu_m, trace.rear_enu_m))
    np.testing.assert_allclose(front, 24.0, atol=0.01)
    np.testing.assert_allclose(rear, math.sqrt(24.0**2 - 2.70**2), atol=0.01)
    np.testing.assert_allclose(trace.steer_deg[steady], math.degrees(math.asin(2.70 / 24.0)), atol=0.15)
    np.testing.assert_allclose(trace.speed_m_s[steady], math.sqrt(2.0 * 24.0), rtol=0.05)
    assert check.lateral_acceleration_m_s2 < 2.6
    assert check.rear_rms_m > 0.05


@pytest.mark.parametrize("radius_m", [8.0, 15.0, 24.0, 60.0])
def test_bends_are_stable(radius_m):
    for law in (Controller.PREDICTIVE, Controller.MPC, Controller.STANLEY):
        check = check_steering(lane(radius_m, 270.0), 40.0, controller=law)
        assert check.completed
        assert check.max_m < (0.35 if law is Controller.STANLEY else 0.05)


@pytest.mark.parametrize("law", [Controller.PREDICTIVE, Controller.MPC])
@pytest.mark.parametrize("speed_kmh", [60.0, 100.0, 130.0])
def test_an_offset_dies_out_at_any_speed(speed_kmh, law):
    path = np.column_stack([np.arange(0.0, 800.0), np.zeros(800)])
    for offset_m in (0.5, -0.5):
        check = check_steering(path, speed_kmh, controller=law, start_offset_m=offset_m)
        assert check.completed
        assert check.trace.path_error_m[0] == pytest.approx(offset_m)
        assert np.abs(check.trace.path_error_m[400:]).max() < 0.02
        assert (check.trace.path_error_m * math.copysign(1, offset_m)).min() > -0.1  # without much overshoot


def test_delay_makes_equation_4_unstable_at_80_km_h_and_the_check_says_so():
    path = np.column_stack([np.arange(0.0, 1500.0), np.zeros(1500)])
    check = check_steering(path, 80.0, controller="stanley", start_offset_m=0.5)
    assert not check.completed
    assert check.ended == "left the path"
    assert check.distance_m < 1490
    prompt = Vehicle(latency_s=0.0, steer_lag_s=0.0, max_steer_rate_deg_s=500.0)
    assert check_steering(path, 80.0, controller="stanley", start_offset_m=0.5, vehicle=prompt).completed


@pytest.mark.parametrize(
    "vehicle",
    [
        Vehicle(latency_s=0.15), Vehicle(latency_s=0.09), Vehicle(steer_lag_s=0.15), Vehicle(wheelbase_m=2.8),
        Vehicle(steer_offset_deg=0.3), Vehicle(max_steer_rate_deg_s=20.0),
    ],
)  # fmt: skip
def test_a_vehicle_that_is_not_as_the_controller_assumes(vehicle):
    for law in (Controller.PREDICTIVE, Controller.MPC):
        rng = np.random.default_rng(1003)
        check = check_steering(clothoid(), 40.0, controller=law, vehicle=vehicle, noise=PoseNoise(), rng=rng)
        assert check.completed
        assert check.rms_m < 0.025
        assert check.max_m < 0.12


def test_model_predictive_control_steers_more_calmly_at_the_same_error():
    truth = clothoid()
    checks = {}
    for law in (Controller.PREDICTIVE, Controller.MPC):
        rng = np.random.default_rng(1004)
        path = wobbly(truth, 0.020, 6.0, rng)
        checks[law] = check_steering(path, 50.0, controller=law, truth_enu_m=truth, noise=PoseNoise(), rng=rng)
    assert checks[Controller.MPC].rms_m < 1.05 * checks[Controller.PREDICTIVE].rms_m
    assert checks[Controller.MPC].steer_rate_rms_deg_s < 0.8 * checks[Controller.PREDICTIVE].steer_rate_rms_deg_s
    for check in checks.values():
        assert check.steer_rate_rms_deg_s < check.steer_rate_max_deg_s <= Vehicle().max_steer_rate_deg_s + 1e-9


def test_two_loops_of_the_simulation_are_the_same_drive():
    """`drive_course_by_mpc` with equation 4 in place of the program gives the drive of `drive_course`."""
    path = follow_path(clothoid())
    speed = plan_speed(path, clothoid(), 40.0)
    course = steering.Course(path.position_enu_m, path.heading_rad, speed, path.step_m)
    car, settings = steering.car_values(Vehicle()), SteeringSettings()
    start = steering.start_on_bend(course, 0.0, 0.1, 2.7)
    errors = draw_pose_errors(PoseNoise(), 10_000, np.random.default_rng(4))

    class Stanley(MpcSteering):
        piece = 0

        def steer(self, x, y, yaw, speed, wheel, pending, step_s):
            front = x + 2.7 * math.cos(yaw), y + 2.7 * math.sin(yaw)
            command, left, self.piece, _ = stanley_rad(
                path.position_enu_m, path.heading_rad, *front, yaw, speed, settings.gain_per_s, 0.0, self.piece, 0
            )
            return command, left

    law = steering.law_values(Controller.STANLEY, settings)
    expected, ending = steering.drive_course(course, start, errors, law, car)
    found, same_ending = steering.drive_course_by_mpc(course, start, errors, 0.0, car, Stanley(path, settings))
    assert ending == same_ending == steering.REACHED_END
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_kinks_and_coarse_polylines_are_driven():
    kinked = np.column_stack(
        [np.arange(0, 201.0), np.interp(np.arange(0, 201.0), [0, 50, 100, 150, 200], [0, 0, 8, 0, 0])]
    )
    check = check_steering(kinked, 40.0)
    assert check.completed
    assert check.max_m < 0.15
    coarse = lane(24.0, 180.0)[::24]
    assert check_steering(coarse, 40.0).completed


def test_error_is_measured_against_the_truth_and_left_is_positive():
    truth = EAST - (0.0, 0.2)
    check = check_steering(EAST, 40.0, truth_enu_m=truth)
    assert check.rms_m == pytest.approx(0.2, abs=1e-6)
    assert check.path_rms_m == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(check.trace.cross_track_m[:-1], 0.2, atol=1e-6)
    assert (check.mse_east_m2, check.mse_north_m2, check.mse_m2) == pytest.approx((0, 0.04, 0.04), abs=1e-6)
    diagonal = EAST @ np.array([[1.0, 1.0], [-1.0, 1.0]]) / math.sqrt(2)
    check = check_steering(diagonal, 40.0, truth_enu_m=diagonal + np.array([0.2, -0.2]) / math.sqrt(2))
    assert check.rms_m == pytest.approx(0.2, abs=1e-6)
    assert check.mse_m2 == pytest.approx(0.04 / math.sqrt(2), abs=1e-6)


def test_only_what_lies_along_the_truth_counts():
    check = check_steering(EAST, 40.0, truth_enu_m=EAST[50:200])
    assert check.completed
    beside = np.isnan(check.trace.cross_track_m)
    at = check.trace.front_enu_m[:, 0]
    assert beside[at < 50].all()
    assert beside[at > 199].all()
    assert not beside[(at > 50) & (at < 199)].any()
    with pytest.raises(InvalidParameter, match="never") as caught:
        check_steering(EAST, 40.0, truth_enu_m=EAST + np.array([1000.0, 0.0]))
    assert caught.value.field == "truth_enu_m"


def test_speed_keeps_to_the_limit_and_to_what_it_can():
    limits = np.where(EAST[:, 0] > 100, 50.0, 30.0)
    limits[200:] = 20.0
    check = check_steering(EAST, limits)
    speed = check.trace.speed_m_s
    assert check.excess_speed_m_s < 0.7
    gained = np.diff(speed) / 0.01
    assert gained.max() <= 2.0 + 1e-9
    assert gained.min() >= -3.0 - 1e-9
    assert speed[np.abs(check.trace.station_m - 95) < 1].mean() == pytest.approx(30 / 3.6, rel=0.03)
    assert speed[-1] == pytest.approx(20 / 3.6, rel=0.05)


def test_same_seed_same_drive_and_noise_is_as_stated():
    path = clothoid()
    first, again, other = (
        check_steering(path, 40.0, noise=PoseNoise(), rng=np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.trace.front_enu_m, again.trace.front_enu_m)
    assert first.rms_m != other.rms_m
    noise = PoseNoise(drift_over_s=1.0)
    errors = draw_pose_errors(noise, 200_000, np.random.default_rng(5))
    assert errors[:, :2].std() == pytest.approx(math.hypot(noise.drift_m, noise.jitter_m), rel=0.05)
    assert np.diff(errors[:, 0]).std() == pytest.approx(math.sqrt(2) * 0.004, rel=0.1)
    assert errors[:, 2].std() == pytest.approx(math.radians(0.1), rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"controller": "pure-pursuit"}, "controller"),
        ({"noise": PoseNoise()}, "rng"),
        ({"start_offset_m": math.nan}, "start_offset_m"),
        ({"start_offset_m": 5.0}, "start_offset_m"),
        ({"truth_enu_m": EAST[:3]}, "truth_enu_m"),
        ({"path_enu_m": EAST[:3]}, "path_enu_m"),
        ({"path_enu_m": np.where(EAST == 7, np.nan, EAST)}, "path_enu_m"),
        ({"speed_limit_kmh": math.nan}, "speed_limit_kmh"),
    ],
)
def test_bad_input_is_refused_by_name(arguments, field):
    given = {"path_enu_m": EAST, "speed_limit_kmh": 40.0} | arguments
    with pytest.raises(InvalidParameter) as caught:
        check_steering(**given)
    assert caught.value.field == field


@pytest.mark.parametrize("values", [{"wheelbase_m": 0.0}, {"latency_s": math.nan}, {"max_steer_deg": 90.0}])
def test_vehicles_out_of_range_are_refused(values):
    with pytest.raises(InvalidParameter) as caught:
        Vehicle(**values)
    assert caught.value.field == f"vehicle.{next(iter(values))}"


def test_settings_can_be_chosen():
    eager = check_steering(EAST, 40.0, start_offset_m=0.5, settings=SteeringSettings(gain_per_s=3.0))
    slow = check_steering(EAST, 40.0, start_offset_m=0.5, settings=SteeringSettings(gain_per_s=0.5))
    assert eager.rms_m < slow.rms_m
