"""Epochs, state and plan ends as the web process keeps them."""

import asyncio
import time
from pathlib import Path

import pytest

from displays import DISPLAYS
from optodrive.core.errors import LinkError
from optodrive.core.ipc import Message
from optodrive.daemon.api.daemon_client import DaemonClient, LinkClient
from optodrive.daemon.api.peer import Peer
from optodrive.daemon.api.state_merge import NO_PLANNER, NO_STATS
from optodrive.daemon.runtime_folder import RuntimeFolder
from optodrive.link.session.board_view import BoardView

NO_PAUSE = {"number": 0, "began_s": 0.0, "ends_in_s": None}


def build_status(epoch, state="ARMED"):
    return Message(
        "status",
        {
            "epoch": epoch,
            "epoch_reason": "",
            "connected": True,
            "port": "tty",
            "link_error": None,
            "stats": dict(NO_STATS),
            "board": BoardView(state=state).to_dict(),
            "stages": [],
            "control": None,
            "pause": NO_PAUSE,
        },
    )


@pytest.fixture
def link():
    return LinkClient(Peer("link", Path("nowhere")))


@pytest.fixture
def client():
    folder = RuntimeFolder(Path("nowhere"), Path("nowhere/link.sock"), 0o600, Path("nowhere"))
    return DaemonClient(DISPLAYS["display-16"], folder)


def test_a_request_has_the_epoch_of_its_arrival(link):
    link.on_message(build_status(7))
    before_s = time.monotonic()
    link.on_message(
        Message("result", {"id": 1, "error": None, "epoch": 8, "board": BoardView().to_dict(), "pause": NO_PAUSE})
    )
    assert link.require_epoch_at(before_s) == 7
    assert link.require_epoch_at(time.monotonic()) == 8
    # An older view is never too new: before the first status there is no epoch at all.
    assert link.require_epoch_at(0.0) == 0


def test_without_a_link_process_there_is_no_epoch(link):
    with pytest.raises(LinkError, match="link process does not run"):
        link.require_epoch_at(time.monotonic())
    link.on_message(build_status(7))
    link.on_lost()
    with pytest.raises(LinkError, match="link process does not run"):
        link.require_epoch_at(time.monotonic())
    link.on_message(build_status(9))
    assert link.require_epoch_at(time.monotonic()) == 9


def test_the_state_is_merged_anew_for_every_report(client):
    assert (client.build_state().link.state, client.is_complete) == ("down", False)
    client._on_link_message(build_status(1, "RUNNING"))
    client._on_planner_message(Message("state", NO_PLANNER.model_dump(mode="json")))
    assert (client.build_state().board.state, client.is_complete) == ("RUNNING", False)  # there are no previews yet
    client._on_link_message(
        Message("result", {"id": 1, "error": None, "epoch": 2, "board": BoardView().to_dict(), "pause": NO_PAUSE})
    )
    assert client.build_state().board.state == "UNKNOWN"
    client._on_link_lost()
    assert client.build_state().link.state == "down"
    client._on_planner_lost()
    assert client.planner.state is None


def test_the_last_state_answers_while_the_planner_is_silent(client):
    """STOP's answer does not wait for the planner."""
    client._on_planner_message(Message("state", NO_PLANNER.model_dump(mode="json")))
    client._on_link_message(build_status(1, "RUNNING"))
    client._on_link_message(
        Message(
            "result",
            {"id": 1, "error": None, "epoch": 2, "board": BoardView(state="DISARMED").to_dict(), "pause": NO_PAUSE},
        )
    )
    assert client.build_state().board.state == "DISARMED"


def test_a_lost_planner_ends_the_wait_for_its_plans(client):
    async def scenario():
        waiting = asyncio.ensure_future(client.planner.wait_for_end("p1"))
        await asyncio.sleep(0)
        client._on_planner_lost()
        with pytest.raises(LinkError, match="planner process does not run"):
            await waiting

    asyncio.run(scenario())


def test_readers_are_announced_to_the_planner(client):
    sent = []
    client.planner.peer.send = sent.append

    async def scenario():
        events = client.hub.stream_events(12.0)
        client._on_link_message(build_status(1))
        await anext(events)
        client.planner.peer.on_connected()  # again after a restart of the planner
        await events.aclose()

    asyncio.run(scenario())
    assert [message.fields["readers"] for message in sent] == [1, 1, 0]
    assert sent[0].fields["rate_hz"] == 12.0
