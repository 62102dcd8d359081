"""`optodrive docs`: list, print or copy the documentation and the firmware that the package contains."""

import shutil
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated

import typer

from optodrive.cli.options import JsonOption
from optodrive.cli.output import print_answer
from optodrive.core.errors import InputError, suggest_near_name

FOLDERS = ("docs", "firmware_protocol")
PAGE_SUFFIX = ".md"


def docs(
    page: Annotated[
        str | None, typer.Argument(metavar="PAGE", help="Print this page, for example wire-a-board or PROTOCOL.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FOLDER", help="Copy all pages and the firmware's sources into a new folder."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """List the pages of the documentation, print one, or copy all of them with the firmware of the board."""
    from optodrive.core.files import check_output

    roots = {name: locate_shipped_folder(name) for name in FOLDERS}
    if out is not None:
        if page is not None:
            raise InputError("PAGE", page, "no page together with --out, which copies all")
        check_output("--out", out, folder=True)
        for name, root in roots.items():
            _copy_tree(root, out / name)
        print_answer({"out": str(out)}, [f"written          {out}: {', '.join(FOLDERS)}"], json)
        return
    pages = {path: item for name, root in roots.items() for path, item in _list_pages(root, name)}
    if page is not None:
        print(pages[_find_page(page, list(pages))].read_text(encoding="utf-8"), end="")
        return
    print_answer({"pages": sorted(pages)}, sorted(pages), json)


def locate_shipped_folder(name: str) -> Traversable:
    """Return a folder of the installed package, or of the checkout that it runs from."""
    package = files("optodrive")
    shipped = package / "_shipped" / name
    return shipped if shipped.is_dir() else Path(str(package)).parent / name


def _list_pages(folder: Traversable, prefix: str) -> list[tuple[str, Traversable]]:
    found = []
    for item in folder.iterdir():
        path = f"{prefix}/{item.name}"
        if item.is_dir():
            found += _list_pages(item, path)
        elif item.name.endswith(PAGE_SUFFIX):
            found.append((path, item))
    return found


def _find_page(name: str, paths: list[str]) -> str:
    """Return the path of a page by its path or the end of it, with or without its suffix."""
    requested = name.removesuffix(PAGE_SUFFIX).lower()
    matches = [path for path in paths if f"/{path.lower()}".endswith(f"/{requested}{PAGE_SUFFIX}")]
    if len(matches) != 1:
        if matches:
            raise InputError("PAGE", name, f"one of {', '.join(sorted(matches))}")
        stems = [path.rpartition("/")[2].removesuffix(PAGE_SUFFIX) for path in paths]
        near = suggest_near_name(name, stems)
        raise InputError("PAGE", name, "a page that `optodrive docs` lists" + (f", {near}" if near else ""))
    return matches[0]


def _copy_tree(source: Traversable, target: Path) -> None:
    from optodrive.core.files import create_folder

    create_folder(target)
    for item in source.iterdir():
        if item.is_dir():
            if not item.name.startswith((".", "__")):
                _copy_tree(item, target / item.name)
            continue
        with item.open("rb") as content, (target / item.name).open("wb") as copy:
            shutil.copyfileobj(content, copy)
