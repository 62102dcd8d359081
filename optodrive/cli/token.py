"""`optodrive token add | list | revoke`: change the file of tokens of a daemon."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import ConfigOption, JsonOption
from optodrive.cli.output import print_answer, print_json
from optodrive.core.errors import MISSING, InputError

NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Name of the holder; it appears in the audit file.")]
FileOption = Annotated[
    Path | None,
    typer.Option(
        "--file", metavar="FILE", help="File of tokens; default: [daemon] tokens of --config, or the service's."
    ),
]


GROUP = typer.Typer(help="Add, list or revoke tokens; a running daemon takes them on reload.", no_args_is_help=True)


@GROUP.command()
def add(
    name: NameArgument,
    role: Annotated[str, typer.Option("--role", metavar="ROLE", help="viewer, operator or armer.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="FILE", help="Write the token to a new file of mode 0600 instead of the terminal."
        ),
    ] = None,
    file: FileOption = None,
    config: ConfigOption = None,
    json: JsonOption = False,
) -> None:
    """Add a token with a random secret, which is shown once on the terminal or written to a file for its holder."""
    from optodrive.core.errors import suggest_nearest
    from optodrive.core.files import check_output
    from optodrive.daemon.api.tokens import ROLES, add_token, create_token, read_private_tokens, write_holder_file

    known = {each: each for each in ROLES}
    if role not in known:
        raise InputError("--role", role, f"a role, {suggest_nearest(role, list(ROLES))}")
    if out is None and (json or not sys.stdout.isatty()):
        raise InputError("--out", MISSING, "--out FILE: a secret is shown on a terminal only, never in a pipe or a log")
    check_output("--out", out)
    path = _locate(file, config)
    token = create_token(name, known[role])
    if out is not None:
        write_holder_file(out, token)
    try:
        add_token(path, token)
    except InputError:
        if out is not None:
            out.unlink()
        raise
    if json:
        print_json({"name": name, "role": role, "file": str(path), "out": str(out)})
    elif out is None:
        print(token.secret)
    _print_next(f"{name}, {role}: added to {path}" + (f", and written to {out}" if out is not None else ""))
    if not any(each.role == "armer" for each in read_private_tokens(path).all):
        print(f"optodrive: warning: no token of {path} may arm; add one with --role armer", file=sys.stderr)


@GROUP.command("list")
def list_tokens(file: FileOption = None, config: ConfigOption = None, json: JsonOption = False) -> None:
    """List names and roles, without secrets."""
    from optodrive.daemon.api.tokens import read_private_tokens

    tokens = read_private_tokens(_locate(file, config)).all
    document = {"tokens": [{"name": token.name, "role": token.role} for token in tokens]}
    print_answer(document, [f"{token.name:<20} {token.role}" for token in tokens], json)


@GROUP.command()
def revoke(name: NameArgument, file: FileOption = None, config: ConfigOption = None, json: JsonOption = False) -> None:
    """Remove a token. A reload ends everything begun with it at once, also while the board is armed."""
    from optodrive.daemon.api.tokens import remove_token

    path = _locate(file, config)
    token = remove_token(path, name)
    if json:
        print_json({"name": token.name, "role": token.role, "file": str(path)})
    _print_next(f"{token.name}, {token.role}: removed from {path}")


def _locate(file: Path | None, config: str | None) -> Path:
    from optodrive.daemon.api.tokens import SERVICE_TOKENS
    from optodrive.device.config_file import load_config

    if file is not None:
        return file
    configured = load_config(config).daemon.tokens
    if not configured and config is not None:
        raise InputError("daemon.tokens", configured, "a file of tokens in the configuration, or --file")
    return Path(configured) if configured else SERVICE_TOKENS


def _print_next(done: str) -> None:
    print(f"optodrive: {done}; a running service takes it by: systemctl reload optodrive", file=sys.stderr)
