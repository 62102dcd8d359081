"""Licences of packages: the page states those of the installed ones, and each permits what optodrive does with it."""

import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

sys.path.append(str(Path(__file__).parents[2] / "scripts"))

import licences

STATED = licences.read_rows(licences.PAGE.read_text())


def test_the_page_states_the_installed_packages():
    installed = licences.list_licences()
    assert {name: STATED.get(name) for name in installed} == installed
    direct = map(Requirement, (each for listed in licences.read_extras().values() for each in listed))
    elsewhere = {licences.normalise(each.name) for each in direct if each.marker}
    assert STATED.keys() - installed.keys() <= elsewhere
    assert licences.find_incompatible(STATED) == []


@pytest.mark.parametrize(
    ("group", "licence"),
    [("always", "GPL-3.0"), ("reading", "GPL-3.0"), ("development", "elkai License"), ("always", "MIT and unknown")],
)
def test_a_licence_that_does_not_permit_it_is_found(group, licence):
    assert licences.find_incompatible({**STATED, "mutant": (group, licence)}) == ["mutant"]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("BSD 3-Clause License", {"BSD"}),
        ("GNU Lesser General Public License v3 (LGPLv3)", {"LGPL-3.0"}),
        ("GPL-3.0-or-later", {"GPL-3.0"}),
        ("Apache-2.0 OR BSD-2-Clause", {"Apache-2.0"}),
        ("MIT AND GPL-2.0-only", {"MIT", "GPL-3.0"}),
        ("for non-commercial use", {"for non-commercial use"}),
    ],
)
def test_a_licence_is_known_by_what_a_package_states(text, names):
    assert licences.name_licences(text) == names
