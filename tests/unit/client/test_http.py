from math import inf

import httpx
import pytest

from optodrive.client.http import Endpoint, build_error, parse_response
from optodrive.core.errors import (
    BoardFaultError,
    InputError,
    LinkError,
    NotReadyError,
    OptodriveError,
    OverBudgetError,
    RefusedError,
)
from optodrive.daemon.web.api import build_error_problem


@pytest.mark.parametrize(
    "error",
    [
        InputError("frames[0].target_um", 9, "a height", "unknown_pixel"),
        RefusedError("refused: it does not fit"),
        OverBudgetError("too hot", 17, "absorber_temperature", 0.01, 2.5),
        OverBudgetError("too hot for ever", 17, "touch_temperature", 0.01, inf),
        NotReadyError("the board is DISARMED"),
        BoardFaultError("the board is in FAULT"),
        LinkError("no link to the board"),
    ],
)
def test_what_the_daemon_raises_comes_out_the_same_at_the_caller(error):
    document = build_error_problem(error)
    found = build_error(document["status"], document)
    assert type(found) is type(error)
    assert str(found) == str(error)
    assert found.code == error.code
    assert found.problem == document
    for name in ("where", "expected", "pixel", "cap", "margin_j", "earliest_s"):
        assert getattr(found, name, None) == getattr(error, name, None)


def test_an_answer_that_is_no_problem_document_is_said_to_be_none():
    for body in (b"<html>", b"[1]", b'{"error": 1}'):
        with pytest.raises(LinkError, match="502 without a problem document"):
            parse_response(httpx.Response(502, content=body))


def test_codes_that_are_not_known_here_are_refusals_with_their_code():
    error = build_error(429, {"detail": "too often", "code": "too_many_requests"})
    assert type(error) is RefusedError
    assert error.code == "too_many_requests"
    assert isinstance(build_error(500, {"detail": "?"}), OptodriveError)


@pytest.mark.parametrize("url", ["127.0.0.1:8450", "ftp://127.0.0.1", "http://", "unix:", "unix://host/path", "unix:/"])
def test_an_address_that_is_none_is_refused(url):
    with pytest.raises(InputError, match="--url"):
        Endpoint(url, "token")
