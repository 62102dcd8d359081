"""`optodrive terms`: list the physical effects beyond the nominal pixel, and how a parameter set states them."""

from typing import Annotated

import typer

from optodrive.cli.options import JsonOption
from optodrive.cli.output import print_json
from optodrive.core.errors import InputError, suggest_nearest
from optodrive.core.quantity import format_quantity, format_range


def terms(
    name: Annotated[str | None, typer.Argument(metavar="TERM", help="Show this term with its parameters.")] = None,
    json: JsonOption = False,
) -> None:
    """List the terms of model.toml, or show one: equation, parameters, ranges, and a model.toml that states it."""
    from optodrive.physics.term_reference import build_example_file, describe_term
    from optodrive.physics.terms import discover_terms, load_plug_ins

    known = discover_terms()
    broken = load_plug_ins().broken
    if name is not None and name in broken:
        raise InputError("TERM", name, f"one that can be used ({broken[name]})", code="broken_plug_in")
    if name is not None and name not in known:
        raise InputError("TERM", name, f"a known term, {suggest_nearest(name, sorted(known))}")
    if json:
        selected = [known[key] for key in sorted(known) if name in (None, key)]
        reasons = {"broken": broken} if broken and name is None else {}
        print_json({"terms": [describe_term(term) for term in selected]} | reasons)
        return
    if name is None:
        for key in sorted(known):
            print(f"{key:<22}{known[key].label}")
        for key, reason in broken.items():
            print(f"{key:<22}cannot be used ({reason})")
        print("\n`optodrive terms TERM` shows the parameters of one.")
        return
    term = known[name]
    about = describe_term(term)
    print(f"{name}: {about['label']}\n\n{about['equation']}\n")
    for item in about["parameters"]:
        limits = format_range(item["low"], item["high"], item["unit"])
        default = item["if_omitted"]
        omitted = "required" if default is None else f"{format_quantity(default, item['unit'])} if omitted"
        print(f"{item['name']:<18}{limits}, {omitted}; {item['source']}")
    if term.requires:
        print(f"\nneeds {', '.join(term.requires)}")
    print("\nmodel.toml:\n\n" + "\n".join(build_example_file(term)))
