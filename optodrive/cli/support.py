"""`optodrive support`: an archive for the report of a fault, without secrets."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import ConfigOption, UrlOption
from optodrive.core.daemon_url import DEFAULT_URL
from optodrive.core.files import atomic_write, check_output


def support(
    config: ConfigOption = None,
    url: UrlOption = DEFAULT_URL,
    log: Annotated[
        list[Path] | None, typer.Option("--log", metavar="FILE", help="A log besides the journal; may be repeated.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.tar.gz", help="Archive; by default named after the time.")
    ] = None,
) -> None:
    """Write an archive for the report of a fault: versions, configuration, logs, audit and state, without secrets."""
    from optodrive.cli.support_archive import build_archive, collect_entries

    path = out or Path(f"optodrive-support-{datetime.now(UTC):%Y%m%d-%H%M%S}.tar.gz")
    check_output("--out", path, ".gz")
    entries = collect_entries(config, url, log or [])
    archive = build_archive(entries)
    with atomic_write(path) as temporary:
        temporary.write_bytes(archive)
    path.chmod(0o600)
    for entry in entries:
        print(f"{len(entry.text.encode(errors='replace')):9}  {entry.name}")
    print(f"{path}: {len(archive)} bytes. Tokens are removed; read it before you send it")
