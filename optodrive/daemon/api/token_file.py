"""Changes of a file of tokens: one is added or removed, and every other line stays as it was written."""

import json
import os
import re
import secrets
import tempfile
from contextlib import suppress
from pathlib import Path

from optodrive.core.errors import InputError, suggest_nearest
from optodrive.core.files import lock_folder, read_regular_file
from optodrive.daemon.api.tokens import (
    EXPECTED_VALUES,
    FILE_MAX_BYTES,
    FORMAT,
    NAME_PATTERN,
    VERSION,
    Role,
    Token,
    read_private_tokens,
    read_tokens,
)

HEAD = f'format = "{FORMAT}"\nversion = {VERSION}\n'
TABLE = re.compile(r"^(?:[ \t]*#[^\n]*\n)*[ \t]*\[", re.MULTILINE)
"""Begin of a table, with the comments right above it."""


def create_token(name: str, role: Role) -> Token:
    """Create a token with a random secret. Raise InputError for a name that is not allowed."""
    if not re.fullmatch(NAME_PATTERN, name):
        raise InputError("NAME", name, EXPECTED_VALUES["name"])
    return Token(name, role, secrets.token_urlsafe(32))


def add_token(path: Path, token: Token) -> None:
    """Add a token to the file, which is created if it does not exist.

    Raises InputError, which never contains a secret, for a name that is taken and for a file that cannot be used.
    """
    with lock_folder(path.absolute().parent):
        text, known = (_read_text(path), read_private_tokens(path).all) if path.exists() else (HEAD, ())
        if token.name in {other.name for other in known}:
            raise InputError("NAME", token.name, f"a name that no token in {path} has; revoke that one first")
        _replace(path, text + ("" if text.endswith("\n") else "\n") + format_token(token), {*known, token})


def remove_token(path: Path, name: str) -> Token:
    """Remove a token from the file and return it. Raise InputError for an unknown name, and for the last token."""
    with lock_folder(path.absolute().parent):
        known = {token.name: token for token in read_private_tokens(path).all}
        if name not in known:
            raise InputError("NAME", name, f"a token in {path}, {suggest_nearest(name, list(known))}")
        if len(known) == 1:
            raise InputError("NAME", name, f"one of several tokens: {path} must keep at least one")
        text = _cut_table(_read_text(path), [*known].index(name))
        _replace(path, text, {other for other in known.values() if other.name != name})
        return known[name]


def write_holder_file(path: Path, token: Token) -> None:
    """Write a new file of mode 0600 with one token, for `OPTODRIVE_TOKENS` of its holder."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise InputError(str(path), error.strerror, "a path for a new file") from None
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(HEAD + format_token(token))
    except OSError as error:
        path.unlink()  # a part of it would be in the way of the next attempt
        raise InputError(str(path), error.strerror, "a path for a new file") from None


def format_token(token: Token) -> str:
    """Return the table of a token in TOML, after an empty line."""
    return f'\n[[token]]\nname = "{token.name}"\nrole = "{token.role}"\nsecret = {json.dumps(token.secret)}\n'


def _cut_table(text: str, index: int) -> str:
    """Return the text without a table, counted from 0, or unchanged if there are fewer."""
    starts = [match.start() for match in TABLE.finditer(text)] + [len(text)]
    if index + 1 >= len(starts):
        return text
    return (text[: starts[index]] + text[starts[index + 1] :]).rstrip("\n") + "\n"


def _read_text(path: Path) -> str:
    return read_regular_file(path, FILE_MAX_BYTES).decode("utf-8", "replace")


def _replace(path: Path, text: str, expected: set[Token]) -> None:
    """Replace the file atomically, with mode 0600 and the owner that it had, or that its folder has.

    expected: the tokens that the new text must have. Raises InputError, and changes nothing, if it has others.
    """
    temporary: Path | None = None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")  # mode 0600
        temporary = Path(name)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
            owner = (path if path.exists() else path.absolute().parent).stat()
            with suppress(PermissionError):  # only root may give a file away
                os.fchown(file.fileno(), owner.st_uid, owner.st_gid)
        if set(read_tokens(temporary).all) != expected:
            raise InputError(str(path), "tables that cannot be told apart", "one [[token]] per token: edit it by hand")
        temporary.replace(path)
    except OSError as error:
        raise InputError(str(path), error.strerror, "a file that can be written") from None
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
