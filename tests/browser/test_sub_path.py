"""Pages, their WebSockets and the client below a path of a proxy: nginx with the lines that the documentation shows."""

import re
import shutil
import socket
import subprocess
from pathlib import Path

import pytest
from playwright.sync_api import expect

from optodrive.client import Display
from optodrive.core.errors import LinkError
from page_bench import Bench
from rig import TOKEN, wait_for
from study_page_rig import PageStudy
from study_rig import write_study
from study_visit import StudyVisit
from window import PageVisit, arm, press_escape

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "reach-it-from-the-network.md"
NGINX = shutil.which("nginx", path="/usr/sbin:/usr/bin")


def read_documented(daemon_port, study_port, port):
    """Return nginx's `http` block from the documentation: without TLS, with the ports of this test."""
    text = PAGE.read_text(encoding="utf-8")
    (server,) = re.findall(r"(?ms)^    server \{\n.*?^    \}\n", text)
    (upgrade,) = re.findall(r"(?m)^    map \$http_upgrade .*", text)
    locations = re.findall(r"(?m)^    location /lab/.*", text)
    assert len(locations) == 2
    server = re.sub(r"(?m)^ *(ssl_certificate\S*|server_name) .*\n", "", server)
    server = server.replace("listen 443 ssl", f"listen 127.0.0.1:{port}")
    server = server.replace("        location / { proxy_pass http://127.0.0.1:8450; }\n", "\n".join(locations) + "\n")
    for shown, real in (("127.0.0.1:8450", daemon_port), ("lab.example:8460", study_port)):
        assert server.count(f"{shown}/;") == 1
        server = server.replace(shown, f"127.0.0.1:{real}")
    return f"{server}{upgrade}\n"


class Proxy:
    """nginx on a free port of loopback."""

    def __init__(self, folder, daemon_port, study_port):
        assert NGINX, "pages below a path are tested behind nginx, which is missing: apt-get install nginx-light"
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        folders = "".join(
            f"{kind}_temp_path {folder}/{kind};\n" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
        )
        config = folder / "nginx.conf"
        config.write_text(
            f"daemon off;\npid {folder}/nginx.pid;\nerror_log {folder}/error.log;\nevents {{ }}\n"
            f"http {{\naccess_log {folder}/access.log;\n{folders}"
            f"{read_documented(daemon_port, study_port, self.port)}}}\n"
        )
        self.process = subprocess.Popen([NGINX, "-e", folder / "error.log", "-c", config])
        wait_for(self._is_open, "nginx")

    def _is_open(self):
        assert self.process.poll() is None, "nginx has ended"
        with socket.socket() as connection:
            return connection.connect_ex(("127.0.0.1", self.port)) == 0

    @property
    def url(self):
        return f"http://127.0.0.1:{self.port}"

    def stop(self):
        self.process.terminate()
        self.process.wait()


@pytest.fixture
def study(bench, tmp_path):
    bench.daemon.arm()
    study = PageStudy(tmp_path, bench.daemon, write_study(tmp_path, repetitions=1))
    assert study.read_urls(), study.said
    yield study
    study.kill()


@pytest.fixture
def proxy(bench, study, tmp_path):
    study_port = int(re.search(r":(\d+)/", study.urls["operator"])[1])
    folder = tmp_path / "nginx"
    folder.mkdir()
    proxy = Proxy(folder, bench.daemon.client.base_url.port, study_port)
    yield proxy
    proxy.stop()


def test_page_study_and_client_work_below_a_path(browser, bench, proxy, study, tmp_path):
    base = f"{proxy.url}/lab/display1"
    window = PageVisit(browser, base, reduced_motion="reduce")
    page = window.open()
    (cookie,) = window.context.cookies()
    assert (cookie["path"], cookie["name"]) == ("/lab/display1/", f"optodrive-{proxy.port}")
    assert page.url == f"{base}/"
    page.goto(base)  # without the slash nginx redirects
    expect(page.locator("#board-state")).to_have_text("ARMED")
    expect(page.locator("#summary")).not_to_have_text("No data yet.")
    press_escape(page)
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    arm(page)
    page.get_by_role("button", name="Disarm").click()
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    page.get_by_role("button", name="Hold to run").focus()  # a WebSocket
    page.keyboard.down("Enter")
    expect(page.locator("#control")).to_contain_text("while held")
    page.keyboard.up("Enter")
    expect(page.locator("#board-state")).to_have_text("DISARMED")
    assert window.unexpected_errors() == []
    visits = [
        StudyVisit(browser, f"{proxy.url}/lab/study1/{role}#{study.urls[role].partition('#')[2]}")
        for role in ("participant", "operator")
    ]
    participant, operator = visits
    expect(operator.page.locator("#page")).to_have_text("Participant’s page open")
    address = operator.page.locator("#address")
    expect(address).to_have_text(f"{proxy.url}/lab/study1/participant#{study.urls['participant'].partition('#')[2]}")
    participant.wait_for("start")
    assert [visit.errors for visit in visits] == [[], []]
    with Display(base, TOKEN) as display:
        assert display.state().board.state == "DISARMED"
        display.arm(hold=True)  # a WebSocket of the client
        assert bench.daemon.state()["control"]["hold"]
        display.disarm()
    for visit in (window, *visits):
        visit.context.close()


def test_the_client_says_that_the_proxy_answers_and_the_daemon_does_not(tmp_path):
    bench = Bench(tmp_path, "display-16")
    try:
        proxy = Proxy(tmp_path, bench.daemon.client.base_url.port, 1)
    except BaseException:
        bench.stop()
        raise
    try:
        with Display(f"{proxy.url}/lab/display1", TOKEN) as display:
            assert display.state().board.state == "DISARMED"
            bench.stop()
            with pytest.raises(LinkError, match="a proxy answered 502: the daemon behind it is not there"):
                display.state()
    finally:
        proxy.stop()
