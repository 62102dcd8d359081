"""Real messages of the streams against the schemas of the published AsyncAPI document."""

import json
from pathlib import Path

import httpx
import jsonschema_rs
import pytest
from websockets.sync.client import connect

from rig import TOKEN

DOCUMENT = json.loads((Path(__file__).parents[2] / "docs" / "reference" / "asyncapi.json").read_text(encoding="utf-8"))
BEARER = {"Authorization": f"Bearer {TOKEN}"}
FRAMES = ({"target_um": {"17": 60}}, {"frame": 7, "target_um": [0.0] * 437}, {"target_um": {}})
NO_FRAMES = ({}, {"target_um": {"-1": 60}}, {"target_um": {"17": -1}}, {"frame": -1, "target_um": {}}, {"more": 1})


def build_validator(channel, message):
    payload = DOCUMENT["channels"][channel]["messages"][message]["payload"]
    return jsonschema_rs.Draft202012Validator({**payload, "components": DOCUMENT["components"]})


def open_socket(daemon, path):
    return connect(f"{daemon.url.replace('http', 'ws')}{path}", additional_headers=BEARER, proxy=None)


def test_frames_and_their_results_follow_the_schemas(disarmed):
    _, daemon = disarmed
    frame, result = build_validator("stream", "frame"), build_validator("stream", "result")
    daemon.arm()
    statuses = set()
    with open_socket(daemon, "/v1/stream") as stream:
        for message in (*FRAMES, *NO_FRAMES):
            assert frame.is_valid(message) == (message in FRAMES), message
            stream.send(json.dumps(message))
            status = None
            while status not in ("done", "refused"):
                text = json.loads(stream.recv())
                result.validate(text)
                status = text["status"]
                statuses.add(status)
            assert (status == "done") == (message in FRAMES)
    assert statuses >= {"planned", "done", "refused"}
    assert not result.is_valid({"frame": 1, "status": "lost"})


def test_places_of_fingers_and_refusals_follow_the_schemas(disarmed):
    places, refusal = build_validator("fingers", "places"), build_validator("fingers", "refusal")
    finger = {"number": 1, "x_m": 0.01, "y_m": 0.0, "radius_m": 0.004}
    assert places.is_valid({"fingers": [finger], "age_s": 0.01})
    for wrong in ({}, {"fingers": [finger | {"x_m": 2.0}], "age_s": 0.0}, {"fingers": [{"number": 1}], "age_s": 0.0}):
        assert not places.is_valid(wrong)
        with open_socket(disarmed[1], "/v1/fingers") as fingers:
            fingers.send(json.dumps(wrong))
            refusal.validate(json.loads(fingers.recv()))


def test_reports_of_a_hold_follow_the_schema(disarmed):
    _, daemon = disarmed
    report = build_validator("hold", "report")
    with open_socket(daemon, "/v1/hold") as hold:
        hold.send("beat")
        held = [json.loads(hold.recv())]
        with open_socket(daemon, "/v1/hold") as second:
            held.append(json.loads(second.recv()))
        daemon.call("POST", "/v1/stop")
        held.append(json.loads(hold.recv()))
    assert [each["status"] for each in held] == ["armed", "refused", "ended"]
    for each in held:
        report.validate(each)


def test_events_of_the_telemetry_follow_the_schemas(disarmed):
    _, daemon = disarmed
    validators = {event: build_validator("telemetry", event) for event in DOCUMENT["channels"]["telemetry"]["messages"]}
    daemon.arm()
    seen = set()
    with httpx.stream("GET", f"{daemon.url}/v1/telemetry", headers=BEARER, timeout=None) as answer:
        daemon.call("POST", "/v1/plans", json={"frames": [{"show_at_s": 0, "duration_s": 1, **FRAMES[0]}]})
        for line in answer.iter_lines():
            key, _, text = line.partition(": ")
            if key == "event":
                event = text
            elif key == "data":
                validators[event].validate(json.loads(text))
                seen.add(event)
            if seen == set(validators):
                break


def test_every_message_of_the_document_is_judged_here():
    messages = {(channel, message) for channel, each in DOCUMENT["channels"].items() for message in each["messages"]}
    untyped = {("stream", "binaryFrame"), ("hold", "beat")}
    judged = {("stream", "frame"), ("stream", "result"), ("hold", "report")}
    judged |= {("fingers", "places"), ("fingers", "refusal")}
    assert messages - untyped - judged == {
        ("telemetry", event) for event in DOCUMENT["channels"]["telemetry"]["messages"]
    }
    with pytest.raises(jsonschema_rs.ValidationError):
        build_validator("telemetry", "budget").validate({"board_s": 0.0, "caps": []})
