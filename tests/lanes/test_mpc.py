"""Model predictive steering."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy

from app.lanes import mpc
from app.lanes.control import SteeringSettings, follow_path, stanley_rad
from app.lanes.mpc import STEPS, MpcSteering, reference_drive

EAST = np.column_stack([np.arange(0.0, 201.0), np.zeros(201)])
NONE = np.empty(0)
EXACT = SteeringSettings(latency_s=0.0)


def bend(radius_m: float, turn_deg: float) -> np.ndarray:
    """A left bend from the origin, at first eastward."""
    angle = np.arange(0.0, math.radians(turn_deg), 0.05 / radius_m)
    return radius_m * np.column_stack([np.sin(angle), 1 - np.cos(angle)])


def steer(path: np.ndarray, front: tuple[float, float], yaw: float, wheel: float = 0.0, speed: float = 10.0) -> float:
    steering = MpcSteering(follow_path(path), EXACT)
    x, y = front[0] - EXACT.wheelbase_m * math.cos(yaw), front[1] - EXACT.wheelbase_m * math.sin(yaw)
    command, _left = steering.steer(x, y, yaw, speed, wheel, NONE, 0.01)
    return command


def test_on_the_path_nothing_is_steered_and_errors_are_steered_against():
    assert steer(EAST, (50.0, 0.0), 0.0) == pytest.approx(0.0, abs=1e-9)
    right, left = steer(EAST, (50.0, 0.3), 0.0), steer(EAST, (50.0, -0.3), 0.0)
    assert right < -0.005
    assert left == pytest.approx(-right, abs=1e-9)
    assert steer(EAST, (50.0, 0.0), math.radians(3.0)) < -0.01
    assert steer(EAST, (50.0, 0.0), math.radians(-3.0)) > 0.01


def test_commands_stay_within_reach_of_the_wheels():
    reach = math.radians(EXACT.max_steer_rate_deg_s) * EXACT.lag_s  # the wheels' rate is (command - wheel) / lag
    assert steer(EAST, (50.0, -2.5), -0.6, speed=3.0) == pytest.approx(reach)
    assert steer(EAST, (50.0, 2.5), 0.6, speed=3.0) == pytest.approx(-reach)
    limit = math.radians(EXACT.max_steer_deg)
    assert steer(EAST, (50.0, -2.5), -1.2, wheel=limit - 0.01, speed=3.0) == pytest.approx(limit)


def test_the_reference_s_front_axle_runs_on_the_path():
    path = follow_path(bend(24.0, 200.0))
    drive = reference_drive(path, 2.70)
    steady = slice(40, -40)
    np.testing.assert_allclose(drive.wheel[steady], math.asin(2.70 / 24.0), rtol=0.01)
    np.testing.assert_allclose(drive.yaw + drive.wheel, path.heading_rad, atol=1e-12)
    # the rear axle follows the front one without slipping: it moves along the vehicle
    rear = path.position_enu_m - 2.70 * np.column_stack([np.cos(drive.yaw), np.sin(drive.yaw)])
    moved = np.diff(rear, axis=0)
    along = np.arctan2(moved[:, 1], moved[:, 0])
    np.testing.assert_allclose(along[steady], (drive.yaw[:-1] + drive.yaw[1:])[steady] / 2, atol=2e-3)


def test_a_bend_ahead_is_steered_into_before_it_begins():
    straight = np.column_stack([np.arange(-100.0, 0.0, 0.5), np.zeros(200)])
    points = np.vstack([straight, bend(24.0, 120.0)])
    steering = MpcSteering(follow_path(points), EXACT)
    command, left = steering.steer(-1.5 - EXACT.wheelbase_m, 0.0, 0.0, 7.0, 0.0, NONE, 0.01)
    assert left == pytest.approx(0.0, abs=1e-9)
    assert command > 1e-3


def test_the_program_is_that_of_a_simulated_model_and_solved_to_its_optimum():
    """Costs by simulating the linear model with random commands, and scipy's optimum, against the matrices and daqp."""
    path, rng = follow_path(bend(30.0, 200.0)), np.random.default_rng(3)
    steering = MpcSteering(path, EXACT)
    reference, model = steering._reference, steering._model
    x, y, yaw, speed, wheel = 20.0, 7.0, 0.75, 8.0, 0.05
    hessian, gradient, rows, low, high, left, _command, near = mpc._write_program(
        reference, model, x, y, yaw, speed, wheel, NONE, 0.01, 1.0, 60
    )
    front = np.array([x + 2.70 * math.cos(yaw), y + 2.70 * math.sin(yaw)])
    piece = reference.points[near + 1] - reference.points[near]
    at = near + float((front - reference.points[near]) @ piece) / float(piece @ piece)
    grid = np.arange(len(reference.wheel))
    front_speed = speed / math.cos(np.interp(at, grid, reference.wheel))
    ahead = front_speed * model.step_s / reference.step_m

    def cost(commands: np.ndarray) -> float:
        total, error, angle = 0.0, left, wheel
        turned = yaw - float(np.interp(at, grid, reference.yaw))
        for k, command in enumerate(commands):
            jerk = speed**2 / model.wheelbase_m * (command - angle) / model.lag_s
            # a hundred small steps of the differential equations
            for _ in range(100):
                dt = model.step_s / 100
                deviation = angle - float(np.interp(at + (k + 0.5) * ahead, grid, reference.wheel))
                error += front_speed * (turned + deviation) * dt
                turned += speed / model.wheelbase_m * deviation * dt
                angle += (command - angle) / model.lag_s * dt
            course = turned + angle - float(np.interp(at + (k + 1) * ahead, grid, reference.wheel))
            total += error**2 + (model.velocity_s * front_speed * course) ** 2 + (model.jerk_s3 * jerk) ** 2
        return total / 2

    base = cost(np.zeros(STEPS))
    for _ in range(3):
        commands = 0.1 * rng.standard_normal(STEPS)
        program = 0.5 * commands @ hessian @ commands + gradient @ commands
        assert cost(commands) - base == pytest.approx(program, rel=0.03, abs=0.02)

    import daqp

    found, value, flag, _ = daqp.solve(hessian, gradient, rows, high, low)
    assert flag == 1
    best = scipy.optimize.minimize(
        lambda u: 0.5 * u @ hessian @ u + gradient @ u,
        np.full(STEPS, wheel),
        jac=lambda u: hessian @ u + gradient,
        method="SLSQP",
        bounds=list(zip(low[:STEPS], high[:STEPS], strict=True)),
        constraints=scipy.optimize.LinearConstraint(rows, low[STEPS:], high[STEPS:]),
        options={"maxiter": 500, "ftol": 1e-14},
    )
    assert value <= best.fun + 1e-9
    assert value == pytest.approx(best.fun, rel=1e-4)
    assert (found <= high[:STEPS] + 1e-6).all()
    assert (rows @ found <= high[STEPS:] + 1e-6).all()
    assert (rows @ found >= low[STEPS:] - 1e-6).all()


def test_commands_under_way_are_waited_out():
    path = follow_path(EAST)
    late = SteeringSettings(latency_s=0.2)
    straight, turning = (MpcSteering(path, late) for _ in range(2))
    ahead, _ = straight.steer(50.0, 0.0, 0.0, 10.0, 0.0, np.zeros(20), 0.01)
    against, _ = turning.steer(50.0, 0.0, 0.0, 10.0, 0.0, np.full(20, 0.02), 0.01)
    assert ahead == pytest.approx(0.0, abs=1e-9)
    assert against < -0.005


def test_a_program_without_a_solution_is_steered_by_equation_4_and_counted():
    path = follow_path(EAST)
    steering = MpcSteering(path, EXACT)
    steering._solve = lambda *_args: (np.full(STEPS, math.nan), math.nan, -1, {})
    command, left = steering.steer(50.0, 0.4, 0.05, 10.0, 0.0, NONE, 0.01)
    front = (50.0 + EXACT.wheelbase_m * math.cos(0.05), 0.4 + EXACT.wheelbase_m * math.sin(0.05))
    expected, error, *_ = stanley_rad(path.position_enu_m, path.heading_rad, *front, 0.05, 10.0, 1.0, 0.0, 200, 200)
    assert steering.unsolved_steps == 1
    assert (command, left) == pytest.approx((expected, error))


def test_misaligned_wheels_are_estimated():
    steering = MpcSteering(follow_path(EAST), EXACT)
    for _ in range(100):  # a second, 5 cm left of the path
        steering.steer(50.0, 0.05, 0.0, 10.0, 0.0, NONE, 0.01)
    assert steering._misalignment_rad == pytest.approx(0.06 * 0.05, rel=1e-6)
    far = MpcSteering(follow_path(EAST), EXACT)
    far.steer(50.0, 0.5, 0.0, 10.0, 0.0, NONE, 0.01)
    assert far._misalignment_rad == 0.0
