"""docs/reference/board-conformance.md is current with the suite."""

from board_table import table

from optodrive.device.config_file import locate_shipped

PAGE = locate_shipped().parent / "docs" / "reference" / "board-conformance.md"


def test_the_page_has_the_table_of_this_suite():
    assert table() in PAGE.read_text(), "PYTHONPATH=tests:tests/system python tests/conformance/board_table.py"
