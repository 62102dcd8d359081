"""The command line as a whole: version, addresses, and the lists that its commands print."""

import socket
import termios

import pytest
import typer

from optodrive import __version__
from optodrive.cli import commands
from optodrive.cli.main import run
from optodrive.client.exchange import Endpoint
from optodrive.core.daemon_url import read_default_url
from optodrive.core.errors import InputError, LinkError


@pytest.fixture
def tokenless(monkeypatch, tmp_path):
    monkeypatch.delenv("OPTODRIVE_TOKEN", raising=False)
    monkeypatch.setenv("OPTODRIVE_TOKENS", str(tmp_path / "none"))


def test_the_version_is_printed(capsys):
    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"optodrive {__version__}\n"


def test_without_a_daemon_no_token_is_asked_for(tokenless, capsys):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{unused.getsockname()[1]}"
        assert run(["status", "--url", url]) == 1
    assert capsys.readouterr().err == (
        f"optodrive: no daemon answers at {url} (Connection refused); is `optodrive serve` running?\n"
    )


def test_without_a_daemon_on_a_unix_socket_no_token_is_asked_for(tokenless, tmp_path):
    with pytest.raises(LinkError, match="no daemon answers"):
        Endpoint(f"unix:{tmp_path}/s", None)


def test_a_daemon_without_a_readable_token_is_a_missing_token(tokenless):
    with socket.create_server(("127.0.0.1", 0)) as listener, pytest.raises(InputError, match="OPTODRIVE_TOKEN"):
        Endpoint(f"http://127.0.0.1:{listener.getsockname()[1]}", None)


def test_the_address_may_come_from_the_environment(tokenless, monkeypatch, capsys):
    assert read_default_url() == "http://127.0.0.1:8450"
    monkeypatch.setenv("OPTODRIVE_URL", "unix:/nowhere/optodrive.sock")
    assert read_default_url() == "unix:/nowhere/optodrive.sock"
    assert run(["status"]) == 1
    assert "no daemon answers at unix:/nowhere/optodrive.sock" in capsys.readouterr().err


def test_patterns_are_listed_with_their_bounds_and_units(capsys):
    assert run(["patterns"]) == 0
    text = capsys.readouterr().out
    assert "height_um=100.0 (1 to 1000 µm)" in text
    assert "direction=right (left, right, up, down)" in text
    assert "None" not in text


def test_an_error_of_a_terminal_is_one_line(monkeypatch, capfd):
    app = typer.Typer()

    @app.command()
    def status():
        raise termios.error(5, "Input/output error")

    app.callback()(lambda: None)
    monkeypatch.setattr(commands, "build_app", lambda command: app)
    assert commands.run_command(["status"], None) == 1
    assert capfd.readouterr().err == "optodrive: (5, 'Input/output error')\n"
