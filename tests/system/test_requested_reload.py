"""A reload that a caller requests, without a service manager: `optodrive reload` and POST /v1/reload."""

import json
import os
import signal

from forked_process import run_process
from rig import OPTODRIVE, TOKEN, wait_for

HEAD = 'format = "optodrive-tokens"\nversion = 1\n'
ENTRY = '[[token]]\nname = "{}"\nrole = "{}"\nsecret = "{}"\n'
OPERATOR = "another-token-for-ben"


def run_reload(daemon, *options, token=TOKEN):
    environment = {**os.environ, "OPTODRIVE_TOKEN": token}
    command = [OPTODRIVE, "reload", "--url", daemon.url, *options]
    return run_process(command, capture_output=True, text=True, env=environment)


def test_a_caller_reloads_a_daemon_in_a_terminal(board, make_daemon, tmp_path):
    kept, audit = tmp_path / "kept.toml", tmp_path / "audit.jsonl"
    sound = HEAD + ENTRY.format("rig", "armer", TOKEN) + ENTRY.format("ben", "operator", OPERATOR)
    kept.write_text(sound)
    kept.chmod(0o600)
    section = f'[daemon]\ntokens = "{kept}"\naudit = "{audit}"\n#'
    daemon = make_daemon(board, replace=[("lease_s = 1.0", f"lease_s = 1.0\n{section}")])
    text = daemon.config.read_text()

    # Keys that apply at once, and one that needs a restart.
    changed = text.replace("[daemon]", '[daemon]\nhosts = ["lab.example"]').replace(
        "ambient_c = 20.0", "ambient_c = 25.0"
    )
    daemon.config.write_text(changed)
    daemon.call("GET", "/v1/health", status=421, headers={"Host": "lab.example"})
    done = run_reload(daemon, "--json")
    report = json.loads(done.stdout)
    assert (done.returncode, report["applied"], report["revoked"]) == (0, ["daemon.hosts"], [])
    assert report["waiting"] == ["ambient_c"]
    assert "RESTART REQUIRED FOR: ambient_c" in report["message"]
    daemon.call("GET", "/v1/health", headers={"Host": "lab.example"})

    # An invalid file: the reason, with the file and the line; nothing changes.
    daemon.config.write_text(text.replace("rows = ", "rows = 4 ", 1))
    done = run_reload(daemon)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert f"{daemon.config}, line {1 + text[: text.index('rows = ')].count(chr(10))}, column" in done.stderr
    daemon.call("GET", "/v1/health", headers={"Host": "lab.example"})

    # The right role.
    assert "requires a token of role armer; token 'ben' has role operator" in run_reload(daemon, token=OPERATOR).stderr

    # While the board is armed, it revokes and does nothing else.
    daemon.config.write_text(text)
    daemon.arm()
    refused = run_reload(daemon)
    assert (refused.returncode, "disarm it first" in refused.stderr) == (1, True)
    kept.write_text(HEAD + ENTRY.format("rig", "armer", TOKEN))
    assert "tokens revoked: ben" in run_reload(daemon).stdout
    daemon.call("GET", "/v1/state", status=401, headers={"Authorization": f"Bearer {OPERATOR}"})
    assert daemon.board_state() == "ARMED"
    wait_for(lambda: audit.read_text().count('"reload_refused"') == 2, "the audit")
    assert audit.read_text().count('"event": "reloaded"') == 2

    # A hang-up of its terminal still ends it, dark.
    daemon.process.send_signal(signal.SIGHUP)
    assert daemon.process.wait() == 0
    assert board.of("state")[-1]["state"] == "DISARMED"


def test_a_caller_that_revokes_its_own_token_is_told_so(board, make_daemon, tmp_path):
    kept = tmp_path / "kept.toml"
    kept.write_text(HEAD + ENTRY.format("rig", "armer", TOKEN))
    kept.chmod(0o600)
    daemon = make_daemon(board, replace=[("lease_s = 1.0", f'lease_s = 1.0\n[daemon]\ntokens = "{kept}"\n#')])
    kept.write_text(HEAD + ENTRY.format("ben", "armer", OPERATOR))
    assert daemon.call("POST", "/v1/reload", status=401)["code"] == "token_revoked"
    assert run_reload(daemon, token=OPERATOR).returncode == 0
