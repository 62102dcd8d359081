"""Keywords of the client's methods: an unknown one is refused by name, and a flag is True or False."""

import asyncio
import inspect
from typing import Any, get_args

import pytest

from optodrive import client
from optodrive.client import AsyncDisplay, Display
from optodrive.core.errors import InputError
from optodrive.core.types.push_options import PushOptions

OPEN = {"play"}
"""Methods that also take the parameters of a pattern, which the daemon knows."""
ADDRESS = {"url": "http://127.0.0.1:9", "token": "none"}


def find_classes(kind, found):
    """Return a class of the client and those that its methods return."""
    if not (isinstance(kind, type) and kind.__module__.startswith("optodrive.client.")) or kind in found:
        return found
    found.add(kind)
    for _, method in inspect.getmembers(kind, inspect.isfunction):
        find_classes(inspect.signature(method).return_annotation, found)
    return found


CLASSES = sorted(find_classes(AsyncDisplay, find_classes(Display, set())), key=lambda kind: kind.__name__)
METHODS = [
    pytest.param(kind, name, method, id=f"{kind.__name__}.{name}")
    for kind in CLASSES
    for name, method in inspect.getmembers(kind, inspect.isfunction)
    if (name == "__init__" or not name.startswith("_")) and method.__module__.startswith("optodrive.client.")
]


def call(kind, method, **keywords):
    """Call a method of an object that no daemon stands behind: what is refused is refused before."""
    result = method(kind.__new__(kind), **keywords)
    return asyncio.run(result) if inspect.iscoroutine(result) else result


def list_keywords(method):
    for parameter in inspect.signature(method).parameters.values():
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY) and parameter.name != "self":
            yield parameter.name, parameter.annotation
        elif parameter.kind is parameter.VAR_KEYWORD and parameter.annotation is not Any:
            yield from get_args(parameter.annotation)[0].__annotations__.items()


def test_every_class_of_the_client_is_looked_at():
    names = {kind.__name__ for kind in CLASSES}
    assert names == {"AsyncDisplay", "AsyncFingers", "AsyncStream", "Display", "Fingers", "Plan", "Stream"}
    exported = {name for name in client.__all__ if getattr(client, name).__module__.startswith("optodrive.client.")}
    assert exported <= names
    assert len(METHODS) > 50


@pytest.mark.parametrize(("kind", "name", "method"), METHODS)
def test_an_unknown_keyword_is_refused_by_name(kind, name, method):
    if name in OPEN:
        assert any(each.annotation is Any for each in inspect.signature(method).parameters.values())
        return
    with pytest.raises(InputError, match="'surely_unknown'"):
        call(kind, method, surely_unknown=1)


@pytest.mark.parametrize(("kind", "name", "method"), METHODS)
def test_a_misspelt_keyword_is_refused_with_the_nearest(kind, name, method):
    place = kind.__name__ if name == "__init__" else name
    for keyword, _ in list_keywords(method):
        if name not in OPEN:
            for wrong in (keyword[:-1] + "x", keyword.upper(), keyword + "_"):
                with pytest.raises(InputError, match=f"^{place}: got '{wrong}', expected .* nearest is '{keyword}'"):
                    call(kind, method, **{wrong: True})


@pytest.mark.parametrize(("kind", "name", "method"), METHODS)
def test_a_flag_is_true_or_false(kind, name, method):
    """Text is true, so that "false" would be, and in a query it is false, so that a dry run would emit."""
    place = kind.__name__ if name == "__init__" else name
    for keyword, annotation in list_keywords(method):
        if annotation is bool:
            for value in ("false", "true", 0, None):
                with pytest.raises(InputError, match=f"^{place}: {keyword}: got {value!r}, expected True or False"):
                    call(kind, method, **{keyword: value})


@pytest.mark.parametrize("kind", [Display, AsyncDisplay])
def test_every_method_that_submits_a_plan_has_a_dry_run_and_the_options_of_a_push(kind):
    """The methods that return a plan, but for those that are given one."""
    submitting = {
        name
        for name, method in inspect.getmembers(kind, inspect.isfunction)
        if not name.startswith("_")
        and inspect.signature(method).return_annotation is client.Plan
        and "plan" not in dict(list_keywords(method))
    }
    assert submitting == {"show", "push", "play"}
    for name in submitting:
        keywords = dict(list_keywords(getattr(kind, name)))
        assert keywords["dry_run"] is bool
        assert name in OPEN or keywords.keys() >= PushOptions.__annotations__.keys()


def test_both_displays_have_the_same_methods_and_keywords():
    for name, method in inspect.getmembers(Display, inspect.isfunction):
        if not name.startswith("_"):
            assert list(list_keywords(method)) == list(list_keywords(getattr(AsyncDisplay, name))), name


def test_every_method_of_a_display_has_a_docstring_and_a_type():
    """As an editor shows them, which does not follow assignments."""
    for name, member in vars(Display).items():
        if not name.startswith("_"):
            function = member.fget if isinstance(member, property) else member
            assert inspect.isfunction(function), name
            assert len(inspect.getdoc(function)) > 20, name
            assert inspect.signature(function).return_annotation is not inspect.Signature.empty, name


@pytest.mark.parametrize("kind", [Display, AsyncDisplay])
def test_a_misspelt_variable_of_the_environment_is_refused(kind, monkeypatch):
    monkeypatch.setenv("OPTODRIVE_ULR", "http://rig:8450")
    with pytest.raises(InputError, match=r"environment: got 'OPTODRIVE_ULR', expected .* nearest is 'OPTODRIVE_URL'"):
        kind(**ADDRESS)
