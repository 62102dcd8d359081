"""Windows on the pages of a study, and a participant who takes it in one of them."""

from window import TIMEOUT_MS, WIDE

PHASES = ("start", "pause", "example", "stimulus", "question", "rest", "done", "stopped", "lost")


class StudyVisit:
    """A window on a page of a study that records its console errors."""

    def __init__(self, browser, url, viewport=WIDE, **options):
        self.context = browser.new_context(viewport=viewport, reduced_motion="reduce", **options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(TIMEOUT_MS)
        self.errors = []
        self.page.on("console", lambda line: line.type in ("error", "warning") and self.errors.append(line.text))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(url)

    def wait_for(self, *phases):
        """Wait until the participant's page shows one of some phases, and return it."""
        selector = ", ".join(f'body[data-phase="{phase}"]' for phase in phases)
        return self.page.locator(selector).get_attribute("data-phase")

    def wait_for_other(self, phase):
        """Wait until the participant's page shows another phase, and return it."""
        return self.wait_for(*(each for each in PHASES if each != phase))

    def read_state(self):
        """Return the heading that states the phase, and the hint below it."""
        return self.page.inner_text("#state"), self.page.inner_text("#hint")

    def take(self, answer):
        """Take the study to its end: begin by the button, and call `answer` at each question. Return the last phase."""
        while (phase := self.wait_for("start", "question", "done", "stopped")) in ("start", "question"):
            if phase == "start":
                self.page.locator("#begin").click()
            else:
                answer()
            self.wait_for_other(phase)
        return phase
