"""Health of markers: sequential tests on what vehicles observe of them.

A drive's passes are first judged together (`judge_drive`), so that the vehicle's own errors accuse no marker. Each pass
then adds evidence to the tests of its marker (`update_marker`). Drives past a stretch of road add evidence to the test
whether all of its markers are displaced alike (`update_stretch`). docs/health.md describes the models.
"""

from app.health.marker_tests import JudgedDrive as JudgedDrive
from app.health.marker_tests import judge_drive as judge_drive
from app.health.marker_tests import update_marker as update_marker
from app.health.marker_tests import update_unregistered as update_unregistered
from app.health.states import Displacement as Displacement
from app.health.states import Evidence as Evidence
from app.health.states import Fault as Fault
from app.health.states import HealthRules as HealthRules
from app.health.states import MarkerState as MarkerState
from app.health.states import Pass as Pass
from app.health.states import VehicleState as VehicleState
from app.health.states import Verdict as Verdict
from app.health.stretches import StretchDrive as StretchDrive
from app.health.stretches import StretchState as StretchState
from app.health.stretches import stretch_drive as stretch_drive
from app.health.stretches import update_stretch as update_stretch
