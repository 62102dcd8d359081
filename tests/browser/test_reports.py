"""Reports as pages of their own: complete for a screen reader, in both colour schemes, on a desk and on a phone."""

import pytest

from labs import lab
from optodrive.core.provenance import Provenance
from optodrive.device.config_file import load_config
from optodrive.lab.diagnosis.diagnose import diagnose
from optodrive.lab.diagnosis.display_diagnosis import DisplayAnswer, PixelAnswer
from optodrive.lab.diagnosis.display_report import build_display_report
from optodrive.lab.diagnosis.report import build_report
from optodrive.study.report import StudyResults
from optodrive.study.trial_table import read_tables
from study_tables import write_thresholds
from window import PHONE, WIDE, list_violations

DROOP = {"laser_droop": {"share": 0.08, "time": 0.05, "spread": 1.0}}
PROVENANCE = Provenance.capture(["diagnose", "a-recording-with-a-long-name.h5"], ["a-recording-with-a-long-name.h5"])


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    found = diagnose(lab(12, DROOP, groups=("short", "weak", "middle", "strong")))
    assert found.verdict == "cause"
    assert found.held_out_traces
    pixels = (PixelAnswer(0, found), PixelAnswer(1, found), PixelAnswer(2, None, "an error"))
    config = load_config("display-16")
    return {
        "one": build_report(found, "a-recording-with-a-long-name.h5", PROVENANCE),
        "study": StudyResults(read_tables(write_thresholds(folder))[0]).to_html(PROVENANCE),
        "display": build_display_report(DisplayAnswer(pixels, None, 1.0), "film.h5", config, PROVENANCE),
    }


@pytest.mark.parametrize("name", ["one", "display", "study"])
def test_axe_finds_nothing_and_nothing_sticks_out(browser, axe, reports, name, tmp_path):
    path = tmp_path / "report.html"
    path.write_text(reports[name], encoding="utf-8")
    page = browser.new_page()
    requests = []
    page.on("request", lambda request: requests.append(request.url))
    page.goto(path.as_uri())
    backgrounds = set()
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        backgrounds.add(page.evaluate("getComputedStyle(document.body).backgroundColor"))
        for viewport in (WIDE, PHONE):
            page.set_viewport_size(viewport)
            assert list_violations(page, axe) == []
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert len(backgrounds) == 2
    assert requests == [path.as_uri()]
    page.close()
