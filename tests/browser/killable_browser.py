"""A Chromium in a process group of its own, which may be killed at any moment."""

import os
import shutil
import signal
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path

from playwright.sync_api import Error

from rig import wait_for
from window import CHROMIUM, FLAGS


class KillableBrowser:
    """A headless browser with a new profile. script: is run in every page before the page's own."""

    def __init__(self, playwright, script):
        self.folder = Path(tempfile.mkdtemp(prefix="chromium-"))
        self.process = subprocess.Popen(
            [
                CHROMIUM,
                *FLAGS,
                "--headless",
                "--remote-debugging-port=0",
                f"--user-data-dir={self.folder}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        port = self.folder / "DevToolsActivePort"
        text = wait_for(lambda: port.exists() and port.read_text(), "the browser")
        self.browser = playwright.chromium.connect_over_cdp(f"http://127.0.0.1:{text.split()[0]}")
        self.browser.contexts[0].add_init_script(script)
        self.page = None

    def open(self, url):
        """Open an address in a further window."""
        self.page = self.browser.contexts[0].new_page()
        self.page.goto(url)

    def reload(self):
        self.page.reload()

    def kill(self):
        """Kill all processes of the browser."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        with suppress(Error):
            self.browser.close()
        shutil.rmtree(self.folder, ignore_errors=True)
