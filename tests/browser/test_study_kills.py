"""kill -9 of daemon, study and browser, and pages reloaded or opened twice, at random moments of sessions on a page.

The participant is a script in the page. It answers by the number of the trial that the page shows, and its network
sends every message once more, up to 1.5 s later; so an answer that counts for another trial shows in the log.
"""

import random
import time

import pytest
from playwright.sync_api import Error, sync_playwright

from killable_browser import KillableBrowser
from page_bench import Bench
from rig import Daemon, wait_for
from study_page_rig import PageStudy
from study_rig import assert_on_the_board, find_defects, read_records, write_study

TRIALS = 3
ANSWERS = ["2-3", "3-4", "4-5"]
EVENTS_MAX = 3
EVENTS = ("study", "daemon", "browser", "reload", "twice")
SESSIONS = [*range(4), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(4, 100))]
PARTICIPANT = """(() => {
    const send = WebSocket.prototype.send;
    WebSocket.prototype.send = function (text) {
        send.call(this, text);
        setTimeout(() => this.readyState === WebSocket.OPEN && send.call(this, text), Math.random() * 1500);
    };
    const find = (id) => document.getElementById(id);
    setInterval(() => {
        const phase = document.body?.dataset.phase;
        if (phase === "start") {
            find("begin").click();
        } else if (phase !== "question" || Math.random() > 0.05) {
            return; // a participant thinks for 0.4 s on average
        } else if (Math.random() < 0.1) {
            find("again").click();
        } else {
            const trial = Number(/Trial (\\d+)/.exec(find("progress-text").textContent)[1]);
            find("answers").children[(trial - 1) % 3].click();
        }
    }, 20);
})()"""


@pytest.fixture(scope="module")
def playwright():
    with sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    bench = Bench(tmp_path_factory.mktemp("bench"))
    yield bench
    bench.stop()


class Session:
    """A person's session whose parts may end at any moment; `restore` starts again those that have ended."""

    def __init__(self, folder, bench, playwright):
        self.folder, self.bench, self.playwright = folder, bench, playwright
        self.path = folder / "data/sourcedata/sub-07/sub-07_task-short_trials.jsonl"
        self.study = self.browser = None
        self.status = None  # of the last run that ended by itself

    def count(self, kind):
        return sum(record["record"] == kind for record in read_records(self.path))

    @property
    def is_running(self):
        return self.study is not None and self.study.process.poll() is None

    @property
    def is_done(self):
        return self.status == 0

    def restore(self):
        """Start the daemon, the study and the browser that have ended, until the page is open or the session done."""
        while not self.is_done:
            if self.bench.daemon.process.poll() is not None:
                self._replace_daemon()
            if not self.is_running:
                self._end_study()
                if self.is_done:
                    return
                wait_for(lambda: self.bench.daemon.board_state() == "DISARMED", "disarmed")
                study = write_study(self.folder, repetitions=1)
                self.study = PageStudy(self.folder, self.bench.daemon, study, "--hold")
                if not self.study.read_urls():
                    continue
                is_new = True
            else:
                is_new = self.browser is None
            if self.browser is None:
                self.browser = KillableBrowser(self.playwright, PARTICIPANT)
            if is_new and not self.load(lambda: self.browser.open(self.study.urls["participant"])):
                continue
            return

    def load(self, action):
        """Let the browser load the page. Return False if the run had ended before."""
        try:
            action()
        except Error:
            wait_for(lambda: not self.is_running, "the end of the run")
            return False
        return True

    def disturb(self, event):
        if event == "study":
            self.study.kill()
            self.study = None
        elif event == "daemon":
            self.bench.daemon.process.kill()
            self.bench.daemon.process.wait()
        elif event == "browser":
            self.browser.kill()
            self.browser = None
        elif event == "reload":
            self.load(self.browser.reload)
        else:
            self.load(lambda: self.browser.open(self.study.urls["participant"]))

    def run(self, rng, events):
        """Take the session to its end with some events, each at a random moment of some later attempt."""
        for event in events:
            self.restore()
            begun = self.count("begun") + rng.randint(0, 2)
            wait_for(lambda begun=begun: not self.is_running or self.count("begun") >= begun, "the moment")
            time.sleep(rng.uniform(0.0, 1.0))
            if self.is_running:
                self.disturb(event)
        self.restore()
        while not self.is_done:
            wait_for(lambda: not self.is_running, "the end of the run")
            self.restore()

    def stop(self):
        if self.is_running:
            self.study.kill()
        if self.browser is not None:
            self.browser.kill()

    def _end_study(self):
        if self.study is not None:
            self.status, self.study = self.study.end(), None

    def _replace_daemon(self):
        wait_for(lambda: self.bench.board.all_of("state")[-1]["state"] == "DISARMED", "disarmed")
        self.bench.daemon.stop()
        self.bench.daemon = Daemon(self.bench.folder, self.bench.board.port)


@pytest.mark.parametrize("seed", SESSIONS)
def test_a_session_on_a_page_has_every_trial_once(tmp_path, bench, playwright, seed):
    rng = random.Random(seed)
    events = rng.choices(EVENTS, k=rng.randint(1, EVENTS_MAX))
    session = Session(tmp_path, bench, playwright)
    try:
        session.run(rng, events)
    finally:
        session.stop()
    records = read_records(session.path)
    assert find_defects(records) == [], events
    trials = sorted((record for record in records if record["record"] == "trial"), key=lambda trial: trial["trial"])
    assert [trial["answer"] for trial in trials] == ANSWERS, events
    logged = [(pulse["on_us"], pulse["off_us"]) for pulse in bench.board.all_of("pulse")]
    for trial in trials:
        assert len(trial["presentations"]) == 1 + sum("repeated" in shown for shown in trial["presentations"])
        for shown in trial["presentations"]:
            assert_on_the_board(shown, logged)
