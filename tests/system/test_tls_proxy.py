"""The daemon behind a TLS proxy, for other computers and phones: names, origins, cookie, WebSockets, client."""

import asyncio
import os
import select
import socket
import ssl
import subprocess
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import httpx
import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from forked_process import run_process
from optodrive.client import Display
from optodrive.core.errors import NotReadyError
from rig import OPTODRIVE, TOKEN

NAME = "lab.example"
AUTHORIZATION = {"Authorization": f"Bearer {TOKEN}"}


class TlsProxy:
    """Ends TLS and passes all bytes on, so that the Host is that of the client, as a proxy has to be configured."""

    def __init__(self, folder, target_port):
        self.certificate = folder / "certificate.pem"
        key = folder / "key.pem"
        names = ("-subj", f"/CN={NAME}", "-addext", f"subjectAltName=DNS:{NAME},DNS:localhost")
        options = ("-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", *names, "-keyout", key)
        subprocess.run(["openssl", "req", *options, "-out", self.certificate], check=True, capture_output=True)
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._context.load_cert_chain(self.certificate, key)
        self._target_port = target_port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._clients = []
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        with ThreadPoolExecutor(16) as executor, suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                self._clients.append(client)
                executor.submit(self._pass_on, client)

    def _pass_on(self, raw):
        """Pass bytes on until one side ends."""
        with (
            suppress(OSError),
            self._context.wrap_socket(raw, server_side=True) as client,
            socket.create_connection(("127.0.0.1", self._target_port)) as daemon,
        ):
            self._clients.append(client)
            sinks = {client: daemon, daemon: client}
            while True:
                for source in [client] if client.pending() else select.select([*sinks], [], [])[0]:
                    data = source.recv(65536)
                    if not data:
                        return
                    sinks[source].sendall(data)

    def close(self):
        for sock in (self._listener, *self._clients):
            with suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._listener.close()


@pytest.fixture
def behind_proxy(board, make_daemon, tmp_path):
    """Return a daemon that knows its name on the network, and the proxy before it."""
    daemon = make_daemon(board, replace=[("lease_s = 1.0", f'lease_s = 1.0\n[daemon]\nhosts = ["{NAME}"]\n#')])
    proxy = TlsProxy(tmp_path, int(daemon.url.rpartition(":")[2]))
    yield daemon, proxy
    proxy.close()


def request(proxy, path, host=NAME, **headers):
    """Send a request as a browser does that found the proxy under a name."""
    context = ssl.create_default_context(cafile=proxy.certificate)
    with httpx.Client(base_url=f"https://127.0.0.1:{proxy.port}", verify=context, timeout=None) as client:
        return client.get(path, headers={"Host": host, **headers}, extensions={"sni_hostname": NAME})


def test_names_and_origins_are_checked_behind_a_proxy(behind_proxy):
    _, proxy = behind_proxy
    assert request(proxy, "/v1/state", **AUTHORIZATION).status_code == 200
    for origin, status in ((f"https://{NAME}", 200), (f"https://{NAME}.evil", 403), ("https://evil.example", 403)):
        assert request(proxy, "/v1/state", Origin=origin, **AUTHORIZATION).status_code == status, origin
    with_port = f"{NAME}:{proxy.port}"
    assert request(proxy, "/v1/me", with_port, Origin=f"https://{with_port}", **AUTHORIZATION).status_code == 200
    assert request(proxy, "/v1/me", with_port, Origin=f"https://{NAME}", **AUTHORIZATION).status_code == 403
    assert request(proxy, "/v1/me", "localhost", Origin="https://localhost", **AUTHORIZATION).status_code == 403
    refused = request(proxy, "/v1/state", "phone.example", **AUTHORIZATION)
    assert (refused.status_code, refused.json()["code"]) == (421, "host_not_allowed")
    assert "daemon.hosts" in refused.json()["detail"]


def test_the_page_opens_with_the_cookie_of_its_name(behind_proxy):
    _, proxy = behind_proxy
    assert request(proxy, "/").status_code == 401
    assert request(proxy, "/", Cookie=f"optodrive-80={TOKEN}").status_code == 200
    assert request(proxy, "/", f"{NAME}:8443", Cookie=f"optodrive-8443={TOKEN}").status_code == 200


def test_websockets_pass_a_proxy_for_their_own_origin_only(behind_proxy):
    _, proxy = behind_proxy
    context = ssl.create_default_context(cafile=proxy.certificate)
    options = {"ssl": context, "additional_headers": AUTHORIZATION, "proxy": None, "server_hostname": NAME}

    def open_stream(origin):
        return connect(f"wss://{NAME}/v1/stream", host="127.0.0.1", port=proxy.port, origin=origin, **options)

    async def open_streams():
        async with open_stream(f"https://{NAME}") as stream:
            await stream.send("no frame")
            assert "refused" in await stream.recv()
        with pytest.raises(InvalidStatus, match="HTTP 403"):
            await open_stream("https://evil.example")

    asyncio.run(open_streams())


def test_client_and_commands_reach_the_daemon_over_tls(behind_proxy, monkeypatch):
    daemon, proxy = behind_proxy
    monkeypatch.setenv("SSL_CERT_FILE", str(proxy.certificate))
    url = f"https://localhost:{proxy.port}"
    with Display(url, TOKEN) as display:
        assert display.state().board.state == "DISARMED"
        with display.stream() as stream, pytest.raises(NotReadyError):
            stream.wait(stream.send({5: 60.0}))
        display.arm(hold=True)
        assert daemon.state()["control"]["hold"] is True
    environment = {**os.environ, "OPTODRIVE_TOKEN": TOKEN}
    done = run_process([OPTODRIVE, "stop", "--url", url], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
