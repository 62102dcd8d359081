"""The page on versions states those of the program, and the changelog begins with the program's."""

import re

import pytest
from pages import ROOT

from optodrive import __version__
from optodrive.link.protocol.messages import MAJOR, MINOR
from optodrive.study.study_file import Study

PAGE = (ROOT / "docs/reference/versions.md").read_text()


@pytest.mark.parametrize(
    ("interface", "version"),
    [
        ("program", __version__),
        ("board protocol", f"{MAJOR}.{MINOR}"),
        ("study files", str(*Study.model_fields["version"].annotation.__args__)),
    ],
)
def test_the_page_states_the_version(interface, version):
    (row,) = re.findall(rf"^\| {interface}.*? \| (.*?) \|", PAGE, re.M)
    assert row == version


def test_the_changelog_begins_with_the_version():
    assert re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.M)[1] == __version__
    assert f"# The board's protocol, version {MAJOR}.{MINOR}\n" in (ROOT / "firmware_protocol/PROTOCOL.md").read_text()
