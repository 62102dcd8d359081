"""JSON bodies of the client: NumPy's values are sent, what JSON does not have is refused with its place."""

import json
from types import MappingProxyType

import numpy as np
import pytest

from optodrive.cli.main import run
from optodrive.client.requests import build_dim_request, build_play_request, build_push_request, encode_body
from optodrive.core.errors import InputError

NOWHERE = "http://127.0.0.1:9"


def build_body(**labels):
    return {"frames": [{"show_at_s": 0.0, "duration_s": 0.5, "target_um": {"17": 50.0}}], "labels": labels}


def test_values_of_numpy_are_sent_as_numbers():
    body = build_body(trial=np.int64(3), gain=np.float32(0.5), odd=np.bool_(True))
    body["frames"][0]["target_um"] = np.array([0.0, 50.0])
    sent = json.loads(build_push_request(MappingProxyType(body), {}, False).arguments["content"])
    assert sent["labels"] == {"trial": 3, "gain": 0.5, "odd": True}
    assert sent["frames"][0]["target_um"] == [0.0, 50.0]


def test_the_bytes_of_a_file_are_sent_as_they_are():
    assert encode_body(b'{"a": NaN}')["content"] == b'{"a": NaN}'


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ({"gain": float("nan")}, r"body: labels\.gain: got nan, expected "),
        ({"gain": np.float64("inf")}, r"body: labels\.gain: got .*inf.*, expected "),
        ({"gain": np.float32("nan")}, r"body: labels\.gain: got nan, expected "),
        ({"session": {1, 2}}, r"body: labels\.session: got \{1, 2\}, expected "),
        ({"steps": [1.0, b"2"]}, r"body: labels\.steps\[1\]: got b'2', expected "),
        ({"by_pixel": {np.int64(17): 1.0}}, r"body: labels\.by_pixel: got .*17.*, expected keys of text"),
    ],
)
def test_a_value_that_json_does_not_have_is_refused_with_its_place(labels, message):
    with pytest.raises(InputError, match=message):
        build_push_request(build_body(**labels), {}, False)
    with pytest.raises(InputError, match=message):
        build_play_request("pixel", {"labels": labels}, {}, False)


def test_a_body_that_contains_itself_is_refused():
    body = build_body()
    body["frames"].append(body)
    with pytest.raises(InputError, match="expected objects and lists at most"):
        build_push_request(body, {}, False)


@pytest.mark.parametrize("share", ["nan", "inf", "1.5", "50"])
def test_a_share_of_power_outside_its_range_is_refused_before_anything_is_sent(capsys, share):
    with pytest.raises(InputError, match="share: got "):
        build_dim_request(float(share))
    assert run(["dim", share, "--url", NOWHERE]) == 2
    assert capsys.readouterr().err == f"optodrive: share: got {float(share)!r}, expected a number from 0 to 1\n"
