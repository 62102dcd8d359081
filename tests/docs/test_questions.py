"""A newcomer of each role finds the answer to ten questions from the role's part of the index within two pages."""

import re

import pytest
from pages import ROOT

DOCS = ROOT / "docs"
LINK = re.compile(r"\]\(([^)#:]+\.md)")
QUESTIONS = {
    "Laboratory": {
        "What do I state about my display?": ("reference/configuration.md", "pitch_m"),
        "In which units are quantities?": ("reference/units.md", "µm"),
        "How do I aim the beam?": ("how-to/calibrate-the-field.md", "optodrive calibrate field"),
        "How accurate is the aim?": ("how-to/calibrate-the-field.md", "## Accuracy"),
        "How do I measure the laser's power?": ("how-to/measure-the-laser.md", "optodrive calibrate power"),
        "How hot may walls and skin become?": ("reference/limits.md", "touch_max_c"),
        "In which form do I give my measurements?": ("reference/recordings.md", "displacement_m"),
        "What does my model get wrong?": ("explanation/diagnosis.md", "optodrive diagnose"),
        "How often is a diagnosis wrong?": ("explanation/blind-tests.md", "| wrong |"),
        "How far is the model from the paper?": ("explanation/validation.md", "| z_peak_w020 |"),
    },
    "Maker": {
        "Which parts do I need?": ("reference/circuit.md", "€ each"),
        "What must my galvos offer?": ("how-to/write-a-configuration.md", "## What your parts must offer"),
        "How do I wire the board?": ("how-to/wire-a-board.md", "## Circuit"),
        "How do I flash it?": ("how-to/wire-a-board.md", "optodrive board flash"),
        "What must the oscilloscope show?": ("how-to/bring-up-a-pico.md", "## 4. Every way to darkness"),
        "Can I try it without a board?": ("how-to/emulate-a-pico.md", "optodrive board emulate"),
        "Can I buy the electronics?": ("how-to/use-a-laser-dac.md", "optodrive dac play"),
        "Why is there no connection?": ("explanation/link.md", "optodrive doctor"),
        "In which order do I start with a laser?": (
            "explanation/what-it-cannot-do.md",
            "## The first day with hardware",
        ),
        "What must a board of my own do?": ("reference/board-conformance.md", "| B3 |"),
    },
    "Psychologist": {
        "How do I run a session?": ("how-to/run-a-study.md", "optodrive study"),
        "How do I write a design?": ("how-to/design-a-study.md", "[factors]"),
        "How do I find a threshold?": ("how-to/find-thresholds.md", "procedure"),
        "How many participants do I need?": ("how-to/analyse-a-study.md", "power"),
        "What stands in the table of trials?": ("reference/formats/study-toml.md", "## The table of trials"),
        "How do I go on after an interruption?": ("how-to/run-a-study.md", "**After an interruption**"),
        "Which trials are excluded?": ("reference/formats/study-toml.md", "exclusion"),
        "Are response times comparable?": ("reference/formats/study-toml.md", "response_time"),
        "What does the simulated participant feel?": ("explanation/perception.md", "channel"),
        "How warm does a finger get?": ("reference/limits.md", "43 °C"),
    },
    "Designer of tactile content": {
        "How do I show a text?": ("how-to/show-stimuli.md", "optodrive p"),
        "Which patterns are there?": ("reference/patterns.md", "## Braille"),
        "How do I show a drawing?": ("reference/patterns.md", "SVG"),
        "Does my stimulus fit?": ("how-to/show-stimuli.md", "## Whether it fits"),
        "How long does it take?": ("how-to/show-stimuli.md", "## What a stimulus costs"),
        "How high is a pixel at most?": ("how-to/show-stimuli.md", "518 µm"),
        "How do I write frames?": ("reference/formats/frames-json.md", "target_um"),
        "How do I make an animation live?": ("how-to/stream-frames.md", "/v1/stream"),
        "How do I preview it?": ("how-to/operate-the-page.md", "Preview"),
        "How do I add a pattern of my own?": ("how-to/add-patterns-and-terms.md", "entry"),
    },
    "Reader of braille": {
        "Which screen readers work?": ("how-to/read-with-a-screen-reader.md", "NVDA"),
        "How do I start it?": ("how-to/read-with-a-screen-reader.md", "optodrive braille"),
        "Can I have several lines?": ("how-to/read-with-a-screen-reader.md", "lines"),
        "How do I go to the next line?": ("how-to/read-with-a-screen-reader.md", "`next`"),
        "How do I stop the light?": ("how-to/operate-the-page.md", "Escape"),
        "May it burn my finger?": ("reference/limits.md", "burn thresholds"),
        "Is contracted braille there?": ("reference/patterns.md", "contracted"),
        "How do I read a braille file?": ("reference/patterns.md", "`braille-file` shows BRF"),
        "How does it follow my fingers?": ("how-to/track-fingers.md", "film"),
        "Can I use the page without seeing it?": (
            "how-to/operate-the-page.md",
            "## By keyboard and with a screen reader",
        ),
    },
    "Developer": {
        "How do I call it from Python?": ("how-to/use-the-python-client.md", "with Display"),
        "Which routes are there?": ("reference/rest.md", "## POST /v1/plans"),
        "What may change in the next version?": ("reference/versions.md", "**Minor**"),
        "How are the packages layered?": ("explanation/architecture.md", "lab"),
        "Where does a frame go?": ("explanation/paths-through-the-code.md", "## One frame from request to light"),
        "How fast is it?": ("reference/benchmarks.md", "pulses planned per second"),
        "Why is it so?": ("decisions/0002-limits-on-both-sides.md", "Date: "),
        "What do I receive while it runs?": ("reference/telemetry.md", "pulses"),
        "What does a token protect?": ("explanation/threat-model.md", "a token is stolen"),
        "Under which licences are the packages?": ("reference/licences.md", "| always | MIT |"),
    },
}


def read_parts():
    """Return the text of the index by role; what stands before the first belongs to every role."""
    head, *parts = (DOCS / "index.md").read_text().split("\n## ")
    return {part.partition("\n")[0]: head + part for part in parts}


def count_pages(part, page):
    """Return how many pages lie between the index and the end of the way, the page included; 3: more than two."""
    first = {(DOCS / link).resolve() for link in LINK.findall(part)}
    second = {
        (near.parent / link).resolve()
        for near in first
        if near.is_relative_to(DOCS)
        for link in LINK.findall(near.read_text())
    }
    target = (DOCS / page).resolve()
    return 1 if target in first else 2 if target in second else 3


@pytest.mark.parametrize("role", QUESTIONS)
def test_ten_questions_are_answered_within_two_pages(role):
    part, questions = read_parts()[role], QUESTIONS[role]
    assert len(questions) == 10
    far = {question for question, (page, _) in questions.items() if count_pages(part, page) > 2}
    assert far == set()
    assert {question for question, (page, says) in questions.items() if says not in (DOCS / page).read_text()} == set()


def test_a_page_that_nothing_links_is_found():
    assert count_pages("[one](tutorials/quickstart.md)", "reference/formats/tokens-and-audit.md") == 3
