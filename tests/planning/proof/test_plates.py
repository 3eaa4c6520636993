"""How bends and grades appear in the frames of a pass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.planning.plan import Plan
from app.planning.proof import ProofTerms
from app.planning.proof.plates import PlatePass, scenes_of
from app.planning.proof.report import drive_terms
from app.simulation.plate_scene import PlateScene
from tests.planning.proof.conftest import prover_of
from tests.planning.roads import bend, straight


@pytest.fixture(scope="module")
def one(plates: Plan) -> PlatePass:
    prover = prover_of(plates, ProofTerms(drives=1))
    made = prover.plate_pass(plates.markers[0], drive_terms(plates, prover.terms, 0))
    return replace(made, left_m=0.0, rotation_deg=0.0)


def first_scene(one: PlatePass) -> PlateScene:
    return next(scenes_of(one, np.random.default_rng(1)))


def test_a_plate_in_a_left_bend_is_on_the_left_and_turned_to_it(one: PlatePass) -> None:
    lane = bend(100.0, 20, 60.0)
    placed = first_scene(replace(one, lane=lane, marker=replace(one.marker, chainage_m=60.0))).faces[0]
    d = placed.ahead_m
    assert placed.left_m == pytest.approx(d**2 / 200, rel=0.02)
    assert placed.rotation_deg == pytest.approx(-np.degrees(d / 100), rel=0.02)


def test_an_even_grade_changes_nothing_and_a_crest_lowers_the_camera(one: PlatePass) -> None:
    even = first_scene(replace(one, lane=straight(200, grade=0.06)))
    assert even.camera == one.camera
    lane = straight(200)
    crest = replace(lane, grade=0.05 - 0.001 * lane.chainage_m)  # radius 1 km
    scene = first_scene(replace(one, lane=crest))
    d = scene.faces[0].ahead_m
    assert one.camera.height_m - scene.camera.height_m == pytest.approx(d**2 / 2000, rel=1e-6)
    flat = first_scene(replace(one, lane=crest, grades=False))
    assert scene.body_deg[1] - flat.body_deg[1] == pytest.approx(-np.degrees(0.001 * d))
