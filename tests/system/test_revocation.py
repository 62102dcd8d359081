"""Tokens that are removed while they are in use: calls begun with them end at once, and the others stay."""

import threading

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from optodrive.cli.main import run
from optodrive.daemon.api.tokens import read_private_tokens
from rig import TOKEN, long_train, wait_for
from service_manager import Manager, reload

SECRETS = {"rig": TOKEN, "ben": "another-token-for-ben", "cara": "another-token-for-cara"}
ROLES = {"rig": "armer", "ben": "operator", "cara": "armer"}


def write_tokens(path, *names):
    entries = (f'[[token]]\nname = "{name}"\nrole = "{ROLES[name]}"\nsecret = "{SECRETS[name]}"\n' for name in names)
    path.write_text('format = "optodrive-tokens"\nversion = 1\n' + "".join(entries))
    path.chmod(0o600)


def present(name):
    return {"Authorization": f"Bearer {SECRETS[name]}"}


@pytest.fixture
def manager(tmp_path, monkeypatch):
    manager = Manager(tmp_path, monkeypatch)
    yield manager
    manager.close()


class Reader(threading.Thread):
    """Reads telemetry until it ends. text: everything that came."""

    def __init__(self, daemon, name):
        super().__init__()
        self.text = ""
        self._request = daemon.url + "/v1/telemetry", present(name)
        self.start()
        wait_for(lambda: "event: state" in self.text, "telemetry")

    def run(self):
        url, headers = self._request
        with httpx.stream("GET", url, headers=headers, timeout=None) as response:
            for piece in response.iter_text():
                self.text += piece


def open_stream(daemon, name):
    return connect(f"ws{daemon.url.removeprefix('http')}/v1/stream", additional_headers=present(name), compression=None)


def test_a_reload_while_armed_ends_what_a_removed_token_has_begun(manager, board, make_daemon, tmp_path):
    path = tmp_path / "tokens.toml"
    write_tokens(path, "rig", "ben", "cara")
    daemon = make_daemon(board, replace=[("lease_s = 1.0", f'lease_s = 1.0\n[daemon]\ntokens = "{path}"\n#')])
    daemon.arm()
    assert daemon.state()["control"]["caller"] == "rig"

    # An operator's plan, streams and kept connection end; the board stays armed, and the others stay connected.
    kept = httpx.Client(base_url=daemon.url, headers=present("ben"), timeout=None)
    plan = kept.post("/v1/plans", json=long_train(seconds=60.0)).json()["plan"]
    of_ben, of_cara = Reader(daemon, "ben"), Reader(daemon, "cara")
    wait_for(lambda: daemon.state()["totals"]["executed"], "light")
    write_tokens(path, "rig", "cara")
    with open_stream(daemon, "ben") as stream, open_stream(daemon, "cara") as other_stream:
        said = reload(daemon, manager, lambda text: text + "\n# changed\n")
        with pytest.raises(ConnectionClosed) as closed:
            stream.recv()
        assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1008, "the token 'ben' was revoked")
        other_stream.send("no frame")
        assert "refused" in other_stream.recv()
    of_ben.join()
    assert of_ben.text.endswith(": the token 'ben' was revoked\n\n")
    assert "tokens revoked: ben; the rest waits" in said
    assert any(line.startswith("STATUS=tokens revoked: ben") for line in manager.heard)
    ended = daemon.finished(plan)
    assert (ended["status"], ended["error"]) == ("cancelled", "the token 'ben' was revoked")
    assert kept.get("/v1/state").status_code == 401
    kept.close()
    assert daemon.board_state() == "ARMED"
    assert of_cara.is_alive()

    # The token that has armed the board takes the light with it, also of the plans of others.
    daemon.call("POST", "/v1/disarm")
    daemon.call("POST", "/v1/arm", headers=present("cara"))
    assert daemon.state()["control"]["caller"] == "cara"
    plan = daemon.call("POST", "/v1/plans", json=long_train(seconds=60.0))["plan"]
    wait_for(lambda: board.of("state")[-1]["state"] == "RUNNING", "the plan to run")
    write_tokens(path, "rig")
    reload(daemon, manager, lambda text: text)
    wait_for(lambda: board.of("state")[-1]["state"] == "DISARMED", "DISARMED")
    ended = daemon.finished(plan)
    assert (ended["status"], ended["error"]) == ("failed", "the token 'cara', which armed the board, was revoked")
    of_cara.join()
    assert of_cara.text.endswith(": the token 'cara' was revoked\n\n")
    assert daemon.state()["control"] is None


def test_a_running_daemon_takes_tokens_of_the_command_by_reload(manager, board, make_daemon, tmp_path):
    path, out = tmp_path / "tokens.toml", tmp_path / "dora.toml"
    write_tokens(path, "rig")
    daemon = make_daemon(board, replace=[("lease_s = 1.0", f'lease_s = 1.0\n[daemon]\ntokens = "{path}"\n#')])
    assert run(["token", "add", "dora", "--role", "operator", "--out", str(out), "--config", str(daemon.config)]) == 0
    (token,) = read_private_tokens(out).all
    headers = {"Authorization": f"Bearer {token.secret}"}
    assert httpx.get(f"{daemon.url}/v1/me", headers=headers, timeout=None).status_code == 401
    said = reload(daemon, manager, lambda text: text)
    assert token.secret not in said
    assert httpx.get(f"{daemon.url}/v1/me", headers=headers, timeout=None).json()["role"] == "operator"
    assert run(["token", "revoke", "dora", "--config", str(daemon.config)]) == 0
    assert "tokens revoked: dora" in reload(daemon, manager, lambda text: text)
    assert httpx.get(f"{daemon.url}/v1/me", headers=headers, timeout=None).status_code == 401
    assert token.secret not in daemon.errors.read_text()
