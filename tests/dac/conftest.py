"""A folder of heat records for each test."""

import pytest

from optodrive.planning import heat_record


@pytest.fixture(autouse=True)
def heat_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(heat_record, "FOLDER", tmp_path / "heat")
    return tmp_path / "heat"
