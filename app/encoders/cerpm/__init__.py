"""CERPMs: their messages, what they are programmed with, and what their radio allows."""

from app.encoders.cerpm.airtime import time_on_air_s
from app.encoders.cerpm.battery import Battery, battery_life_days
from app.encoders.cerpm.checks import RadioFinding, Verdict
from app.encoders.cerpm.collisions import Receiver, aloha_success
from app.encoders.cerpm.explain import ExplainedBytes, explain_payload, hex_dump
from app.encoders.cerpm.hearing import RoadHearing, RoadMarkers, StationHearing, hear_at, hear_road
from app.encoders.cerpm.legal import check_legal, is_legal
from app.encoders.cerpm.link import LinkModel, sensitivity_dbm
from app.encoders.cerpm.lorawan import F_PORT, LorawanUplink, Region, wrap_uplink
from app.encoders.cerpm.payload import encode_body, encode_message
from app.encoders.cerpm.program import MarkerProgram, write_programs_csv
from app.encoders.cerpm.radio import PreviewRule, RadioCheck, RadioPlan, check_radio
from app.encoders.cerpm.recommend import Recommendation, recommend_settings
from app.encoders.cerpm.settings import RadioSettings

__all__ = [
    "F_PORT",
    "Battery",
    "ExplainedBytes",
    "LinkModel",
    "LorawanUplink",
    "MarkerProgram",
    "PreviewRule",
    "RadioCheck",
    "RadioFinding",
    "RadioPlan",
    "RadioSettings",
    "Receiver",
    "Recommendation",
    "Region",
    "RoadHearing",
    "RoadMarkers",
    "StationHearing",
    "Verdict",
    "aloha_success",
    "battery_life_days",
    "check_legal",
    "check_radio",
    "encode_body",
    "encode_message",
    "explain_payload",
    "hear_at",
    "hear_road",
    "hex_dump",
    "is_legal",
    "recommend_settings",
    "sensitivity_dbm",
    "time_on_air_s",
    "wrap_uplink",
    "write_programs_csv",
]
