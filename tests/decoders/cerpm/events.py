"""Uplink events as network servers write them: field by field after their documentation and real messages."""

from __future__ import annotations

import base64
from typing import Any


def chirpstack(payload: bytes, *, count: int = 7, at: str = "2026-03-16T13:39:32.656322720+00:00") -> dict[str, Any]:
    """An event of ChirpStack v4, after messages in its issues 349 and 883 (with nulls, and without an SNR of 0)."""
    return {
        "deduplicationId": f"e3eb5131-fb38-481a-b9df-{count:012d}",
        "time": at,
        "deviceInfo": {
            "tenantId": "52f14cd4-c6f1-4fbd-8f87-4025e1d49242",
            "tenantName": "ChirpStack",
            "applicationId": "ca739e26-7b67-4f14-b69e-d568c22a5a75",
            "applicationName": "road",
            "deviceProfileId": "605d08d4-65f5-4d2c-8a5a-3d2457662f79",
            "deviceProfileName": "CERPM",
            "deviceName": "cerpm-7",
            "devEui": "0101010101010107",
            "deviceClassEnabled": "CLASS_A",
            "tags": {},
        },
        "devAddr": "00189440",
        "dr": 2,
        "fCnt": count,
        "fPort": 5,
        "data": base64.b64encode(payload).decode(),
        "rxInfo": [
            {
                "gatewayId": "ffffffffffffff01",
                "uplinkId": 45825,
                "gwTime": "2026-03-16T13:39:32.6+00:00",
                "nsTime": "2026-03-16T13:39:32.7+00:00",
                "timeSinceGpsEpoch": "1457703590.656s",
                "rssi": -117,
                "snr": -9.5,
                "channel": 6,
                "location": {"latitude": 42.28, "longitude": -85.61},
                "context": "rxh28g==",
                "crcStatus": "CRC_OK",
            },
            {"gatewayId": "ffffffffffffff02", "uplinkId": 1, "rssi": -103, "crcStatus": "CRC_OK"},
        ],
        "txInfo": {
            "frequency": 915000000,
            "modulation": {"lora": {"bandwidth": 125000, "spreadingFactor": 10, "codeRate": "CR_4_5"}},
        },
    }


def things_stack(payload: bytes, *, count: int = 43, at: str = "2026-05-25T13:42:11.412680817Z") -> dict[str, Any]:
    """An event of The Things Stack v3, after its "Data Formats" page."""
    event: dict[str, Any] = {
        "end_device_ids": {
            "device_id": "cerpm-7",
            "application_ids": {"application_id": "road"},
            "dev_eui": "70B3D57ED005B89A",
            "join_eui": "0000000000000001",
            "dev_addr": "260BABCD",
        },
        "correlation_ids": ["as:up:01HX6YGQ7E0V83YRZ7K4S5J4ZN"],
        "received_at": "2026-05-25T13:42:11.9Z",
        "uplink_message": {
            "session_key_id": "AWNbm/4zfqx0jZ5q1NlBmw==",
            "f_port": 2,
            "f_cnt": count,
            "frm_payload": base64.b64encode(payload).decode(),
            "rx_metadata": [
                {"gateway_ids": {"gateway_id": "a"}, "time": at, "timestamp": 1, "rssi": -120, "snr": -12.2},
                {"gateway_ids": {"gateway_id": "b"}, "timestamp": 2, "rssi": -99, "channel_rssi": -98},
            ],
            "settings": {
                "data_rate": {"lora": {"bandwidth": 125000, "spreading_factor": 10}},
                "coding_rate": "4/5",
                "frequency": "915000000",
            },
            "received_at": at,
            "consumed_airtime": "0.370688s",
        },
    }
    if not count:  # zero is left out
        del event["uplink_message"]["f_cnt"]
    return event


STORED = (
    '{"result":{"end_device_ids":{"device_id":"dev1","application_ids":{"application_id":"app1"},"dev_eui":'
    '"1111111111111111","dev_addr":"014457CB"},"received_at":"2020-08-24T10:08:44.868680817Z","uplink_message":'
    '{"session_key_id":"AXPoziFRvbcEguvZQoCCZw==","f_port":10,"f_cnt":43,"frm_payload":"AQoBCgEKAQo=","rx_metadata":'
    '[{"gateway_ids":{"gateway_id":"gtw1"},"time":"2020-08-24T10:08:43.385687165Z","timestamp":3313328983,'
    '"uplink_token":"ChIKEAoEZ3R3MRIIEREREREREREQ18b1qwwaDAiso476BRDl6YiuAiDYl7COt2A="}],"settings":{"data_rate":'
    '{"lora":{"bandwidth":125000,"spreading_factor":12}},"coding_rate":"4/5","frequency":"868100000","timestamp":'
    '3313328983,"time":"2020-08-24T10:08:43.385687165Z"},"received_at":"2020-08-24T10:08:44.634338856Z"}}}'
)
"""From The Things Stack's documentation of its Storage Integration, as it stands there."""
