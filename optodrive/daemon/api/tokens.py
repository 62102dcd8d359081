"""The tokens of a daemon, one or more per role: read from a file, or created in a file that only its user can read."""

import json
import os
import re
import secrets
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import Field, ValidationError

from optodrive.core.errors import MISSING, InputError, refuse_os_error, suggest_nearest
from optodrive.core.files import lock_folder, read_regular_file, write_private_text
from optodrive.core.toml_model import Section, build_input_error, check_format, read_toml

Role = Literal["viewer", "operator", "armer"]
"""Each role includes those before it. A viewer reads and stops, an operator submits plans, an armer arms."""
PERMISSIONS: dict[Role, str] = {
    "viewer": "reads and stops",
    "operator": "also plays, pauses and dims",
    "armer": "also arms",
}
"""What each role may do besides what those before it may."""
ROLES: tuple[Role, ...] = get_args(Role)


def is_role_sufficient(role: Role, min_role: Role) -> bool:
    """Return whether a role includes the role that a route requires."""
    return ROLES.index(role) >= ROLES.index(min_role)


ENVIRONMENT_VARIABLE = "OPTODRIVE_TOKEN"
FILE_ENVIRONMENT_VARIABLE = "OPTODRIVE_TOKENS"
ALLOWED_PATTERN = r"^[!-~]{16,200}$"
NAME_PATTERN = r"^[\w.@ -]{1,40}$"
EXPECTED_VALUES = {
    "name": "1 to 40 letters, digits, spaces or any of . _ @ -",
    "role": f"one of {', '.join(ROLES)}",
    "secret": "16 to 200 letters, digits or signs, no spaces",
}
"""What each key of a token holds."""
SERVICE_TOKENS = Path("/var/lib/optodrive/tokens.toml")
FORMAT = "optodrive-tokens"
VERSION = 1
FILE_MAX_BYTES = 64_000
"""Largest size of a file of tokens, bytes: several hundred, which one message to the web process holds."""


@dataclass(frozen=True)
class Token:
    """A secret with the name of its holder and its role."""

    name: str
    role: Role
    secret: str = field(repr=False)


ANONYMOUS = Token("", "viewer", "")
"""In place of a token, of a request that presents none."""


class Tokens:
    """The tokens of a daemon."""

    def __init__(self, tokens: Iterable[Token]) -> None:
        self.all = tuple(tokens)
        self._secrets = [(token.secret.encode(), token) for token in self.all]

    def find(self, presented: str) -> Token | None:
        """Return the presented token, None if it is unknown. The time does not depend on which token matches."""
        presented_bytes = presented.encode()
        found = None
        # No break at a match: the time of an answer would tell its place in the file.
        for secret, token in self._secrets:
            if secrets.compare_digest(presented_bytes, secret):
                found = token
        return found

    def find_revoked(self, new: "Tokens") -> tuple[Token, ...]:
        """Return the tokens that new ones lack: removed, or with another name, role or secret."""
        return tuple(token for token in self.all if token not in new.all)

    @property
    def highest_role(self) -> Token:
        """The token with the highest role."""
        return max(self.all, key=lambda token: ROLES.index(token.role))


class _TokenEntry(Section):
    name: Annotated[str, Field(pattern=NAME_PATTERN)]
    role: Role
    secret: Annotated[str, Field(pattern=ALLOWED_PATTERN)]


class _TokensFile(Section):
    format: Literal["optodrive-tokens"]
    version: Literal[1]
    token: Annotated[tuple[_TokenEntry, ...], Field(min_length=1)]


def build_tokens_path(port: int) -> Path:
    """Build the default path of the tokens of the daemon on a TCP port."""
    runtime = os.environ.get("XDG_RUNTIME_DIR") or Path.home() / ".cache"
    return Path(runtime) / "optodrive" / f"token-{port}"


def read_tokens(path: Path, *, private: bool = False) -> Tokens:
    """Read the tokens of a file.

    Raise InputError, which never contains a secret, if the file is unreadable or invalid.
    private: refuse a file that others than its owner can read
    """
    table = read_toml(path, FILE_MAX_BYTES, private=private)
    check_format(path, table, FORMAT, VERSION)
    try:
        entries = _TokensFile.model_validate(table).token
    except ValidationError as error:
        named = build_input_error(error, str(path), _TokensFile)
        if named.value is MISSING or named.code == "unknown_key":
            raise named from None
        expected = EXPECTED_VALUES.get(named.where.rpartition(".")[2], named.expected)
        raise InputError(named.where, "a value that is not shown", expected) from None
    for key in ("name", "secret"):
        if len({getattr(entry, key) for entry in entries}) < len(entries):
            raise InputError(f"{path}: token", f"a {key} twice", "each once")
    return Tokens(Token(entry.name, entry.role, entry.secret) for entry in entries)


def read_private_tokens(path: Path) -> Tokens:
    """Read a daemon's own tokens. Raise InputError if others than the file's owner can read them."""
    return read_tokens(path, private=True)


def create_tokens(path: Path, armer_secret: str | None = None) -> Tokens:
    """Create a random token per role in a new file of mode 0600.

    armer_secret: the armer's secret, random if None or empty. InputError if it is invalid (its text is not shown) or
    the file cannot be created.
    """
    if armer_secret and not re.fullmatch(ALLOWED_PATTERN, armer_secret):
        raise InputError(ENVIRONMENT_VARIABLE, "a value that is not shown", EXPECTED_VALUES["secret"])
    tokens = Tokens(
        Token(role, role, armer_secret if armer_secret and role == "armer" else secrets.token_urlsafe(32))
        for role in ROLES
    )
    lines = [f'format = "{FORMAT}"\nversion = {VERSION}\n']
    lines += [
        f'\n[[token]] # {PERMISSIONS[t.role]}\nname = "{t.name}"\nrole = "{t.role}"\nsecret = {json.dumps(t.secret)}\n'
        for t in tokens.all
    ]
    with refuse_os_error(path, "a writable path for the daemon's tokens"):
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        write_private_text(path, "".join(lines))
    return tokens


def load_daemon_tokens(tokens_file: str, port: int) -> tuple[Tokens, Path]:
    """Load a daemon's tokens and return them with the path of their file.

    tokens_file: a file that persists, created if it does not exist; if empty, the daemon gets new tokens in the default
    file.
    """
    if tokens_file:
        path = Path(tokens_file)
        return (read_private_tokens(path) if os.path.lexists(path) else create_tokens(path)), path
    path = build_tokens_path(port)
    return create_tokens(path, os.environ.get(ENVIRONMENT_VARIABLE)), path


def read_token(port: int | None) -> str:
    """Read the token with the highest role for a daemon on a TCP port. Raise InputError if none is readable.

    port: None for a daemon on a Unix socket
    """
    secret = os.environ.get(ENVIRONMENT_VARIABLE)
    if secret:
        return secret
    file_name = os.environ.get(FILE_ENVIRONMENT_VARIABLE)
    own_paths = [] if port is None else [build_tokens_path(port)]
    candidates = [Path(file_name)] if file_name else [*own_paths, SERVICE_TOKENS]
    for path in candidates:
        if os.access(path, os.R_OK):
            return read_tokens(path).highest_role.secret
    listed = " or ".join(str(path) for path in candidates)
    expected = f"a token: set it, name a file of tokens by {FILE_ENVIRONMENT_VARIABLE}, or make {listed} readable"
    raise InputError(ENVIRONMENT_VARIABLE, MISSING, expected)


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
    with refuse_os_error(path, "a path for a new file"):
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
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
