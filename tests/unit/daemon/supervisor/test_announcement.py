"""What the daemon says when it has started."""

from pathlib import Path

import pytest

from optodrive.daemon.api.tokens import Token, Tokens
from optodrive.daemon.supervisor.daemon import _announce
from optodrive.device.config_file import load_config

TOKENS = Tokens((Token("ann", "armer", "a" * 43),))


@pytest.mark.parametrize(
    ("is_new", "says"),
    [(True, "a token per role, created in /srv/new/tokens.toml"), (False, "tokens in /srv/new/tokens.toml")],
)
def test_a_file_of_tokens_that_was_created_is_said_with_its_folder(capsys, is_new, says):
    """The folder of a misspelt path was created without a word."""
    _announce(load_config("display-1"), "http://127.0.0.1:1", None, TOKENS, Path("/srv/new/tokens.toml"), is_new)
    said = capsys.readouterr().out
    assert f", {says}: armer also arms" in said
    assert "aaa" not in said
