from contextlib import closing
from types import SimpleNamespace

import pytest

from optodrive.core.clock import ManualClock
from optodrive.core.errors import InputError, NotReadyError
from optodrive.daemon.api.tokens import Token, Tokens
from optodrive.daemon.log import DaemonLog, Notifier
from optodrive.daemon.reload import (
    ConfigReloader,
    describe_reload,
    merge_reloadable,
    split_changed_keys,
)
from optodrive.daemon.supervisor.daemon import ReloadHandler
from optodrive.device.config_file import load_config
from optodrive.link.protocol.states import LEASED_STATES


@pytest.fixture(scope="module")
def config():
    return load_config()


def with_(config, section, **changes):
    part = getattr(config, section).model_copy(update=changes)
    return config.model_copy(update={section: part})


def test_nothing_changed(config):
    assert split_changed_keys(config, load_config()) == ([], [])


def test_hosts_and_limits_apply_at_once_and_the_rest_needs_a_restart(config):
    new = with_(config, "daemon", hosts=("lab",), port=9000, body_max_bytes=2048)
    new = with_(new, "limits", absorber_max_c=300.0)
    reloaded, waiting = split_changed_keys(config, new)
    assert reloaded == ["daemon.body_max_bytes", "daemon.hosts"]
    assert waiting == ["daemon.port", "limits.absorber_max_c"]
    running = merge_reloadable(config, new)
    assert running.daemon.hosts == ("lab",)
    assert running.daemon.port == config.daemon.port
    assert running.limits == config.limits
    # Keys that need a restart are reported again at the next reload.
    assert split_changed_keys(running, new) == ([], waiting)
    assert "RESTART REQUIRED FOR: daemon.port, limits.absorber_max_c" in describe_reload(reloaded, waiting, None)


@pytest.mark.parametrize("state", LEASED_STATES)
def test_an_armed_board_prevents_a_reload(config, state):
    reloader = ConfigReloader(config, TOKENS, lambda: with_(config, "daemon", hosts=("lab",)))
    with pytest.raises(NotReadyError, match="disarm it first"):
        reloader.reload(state)
    assert reloader.config == config


@pytest.mark.parametrize("state", ["DISARMED", "FAULT", "BOOT", "no link"])
def test_an_unarmed_board_permits_a_reload(config, state):
    assert ConfigReloader(config, TOKENS, lambda: config).reload(state).tokens is TOKENS


ANN, BEN, CARA = (
    Token(name, role, f"the-secret-of-{name}")
    for name, role in (("ann", "armer"), ("ben", "operator"), ("cara", "viewer"))
)
TOKENS = Tokens([ANN])


def write_tokens(path, *tokens):
    entries = (f'[[token]]\nname = "{t.name}"\nrole = "{t.role}"\nsecret = "{t.secret}"\n' for t in tokens)
    path.write_text('format = "optodrive-tokens"\nversion = 1\n' + "".join(entries))
    path.chmod(0o600)


def test_an_armed_board_permits_only_to_revoke_tokens(config, tmp_path):
    """A new token, secret or key waits until the board is disarmed. The replaced ones end at once."""
    path = tmp_path / "tokens.toml"
    running = with_(config, "daemon", tokens=str(path))
    reloader = ConfigReloader(running, Tokens([ANN, BEN]), lambda: with_(running, "daemon", hosts=("lab",)))
    changed = Token("ben", "operator", "the-new-secret-of-ben")
    write_tokens(path, ANN, changed, CARA)
    result = reloader.reload("RUNNING")
    assert (result.tokens.all, result.revoked) == ((ANN,), (BEN,))
    assert result.build_web_message(1)["fields"]["revoked"] == ["ben"]
    assert "tokens revoked: ben; the rest waits" in result.line
    assert (reloader.config, reloader.tokens.all) == (running, (ANN,))
    with pytest.raises(NotReadyError, match="disarm it first"):
        reloader.reload("RUNNING")
    result = reloader.reload("DISARMED")
    assert (result.tokens.all, result.revoked, result.reloaded) == ((ANN, changed, CARA), (), ["daemon.hosts"])
    path.chmod(0o644)
    with pytest.raises(InputError, match="chmod 600"):
        reloader.reload("ARMED")
    assert reloader.tokens.all == (ANN, changed, CARA)


def test_a_reload_is_kept_for_a_web_process_that_starts_later(config):
    new = with_(config, "daemon", hosts=("lab",), port=9000)
    reloader = ConfigReloader(config, TOKENS, lambda: new)
    message = reloader.reload("DISARMED").build_web_message(7)
    assert (message["kind"], message["id"], message["daemon"]["hosts"]) == ("reload", 7, ("lab",))
    assert message["tokens"] == [["ann", "armer", "the-secret-of-ann"]]
    assert message["fields"] == {
        "event": "reloaded",
        "applied": ["daemon.hosts"],
        "waiting": ["daemon.port"],
        "revoked": [],
    }
    assert reloader.config.daemon.hosts == ("lab",)
    assert reloader.config.daemon.port == config.daemon.port


def test_a_refused_reload_changes_nothing(config, tmp_path):
    unreadable = with_(config, "daemon", hosts=("lab",), tokens=str(tmp_path / "missing.toml"))
    reloader = ConfigReloader(config, TOKENS, lambda: unreadable)
    with pytest.raises(NotReadyError):
        reloader.reload("ARMED")
    reloader = ConfigReloader(unreadable, TOKENS, lambda: with_(unreadable, "daemon", hosts=("other",)))
    with pytest.raises(InputError, match=r"missing\.toml"):
        reloader.reload("DISARMED")
    assert (reloader.config, reloader.tokens) == (unreadable, TOKENS)


def test_an_error_that_no_reader_foresees_is_a_refusal_in_one_line(config, capsys):
    """The supervisor, which watches the other processes, goes on with the configuration that it had."""

    def read_config():
        raise ZeroDivisionError("a\nb")

    audit, answers = [], []
    supervisor = SimpleNamespace(
        link_view=SimpleNamespace(board_state="DISARMED"), record_audit=audit.append, send_to_web=answers.append
    )
    reloader = ConfigReloader(config, TOKENS, read_config)
    with closing(DaemonLog()) as log, closing(Notifier(ManualClock())) as notifier:
        handler = ReloadHandler(reloader, supervisor, notifier, log)
        handler.on_web_message({"kind": "reload_request", "id": "x"})
    assert (reloader.config, reloader.tokens) == (config, TOKENS)
    assert capsys.readouterr().err == "optodrive: not reloaded, nothing changed: ZeroDivisionError: a\\nb\n"
    assert [entry["event"] for entry in audit] == ["reload_refused"]
    ((kind, problem),) = [(answer["kind"], answer["problem"]) for answer in answers]
    assert (kind, problem["status"], problem["detail"]) == ("reload_result", 500, "ZeroDivisionError: a\\nb")
