"""Where the daemon is, and the token that it requires."""

import socket
from urllib.parse import urlsplit

import httpx

from optodrive.core.errors import InputError, LinkError
from optodrive.daemon.web.tokens import read_token

DEFAULT_URL = "http://127.0.0.1:8450"
STOP_UNANSWERED = (
    "stop was not answered by {url} ({error}): the running plan may go on to its end; use the emergency stop or the key"
)


class Endpoint:
    """The daemon's address, and the token: as given, from OPTODRIVE_TOKEN, or from the file that the daemon wrote.

    address: as given; url: base of the requests; unix_path: the daemon's Unix socket, None for a TCP address
    """

    def __init__(self, address: str, token: str | None) -> None:
        parts = urlsplit(address)
        self.address = address.rstrip("/")
        self.unix_path = parts.path if parts.scheme == "unix" and not parts.netloc and parts.path != "/" else None
        if not self.unix_path and (parts.scheme not in ("http", "https") or not parts.hostname):
            raise InputError("--url", address, f"an address like {DEFAULT_URL} or unix:/run/optodrive/optodrive.sock")
        self.url = "http://localhost" if self.unix_path else self.address
        self._port = None if self.unix_path else parts.port or (443 if parts.scheme == "https" else 80)
        self._explicit_token = token
        self._token = token or read_token(self._port)

    @property
    def headers(self) -> dict[str, str]:
        """The headers of every request."""
        return {"Authorization": f"Bearer {self._token}"}

    def renew_token(self) -> bool:
        """Read the token again after a refusal; return whether it changed: a restarted daemon has a new one."""
        if self._explicit_token is not None:
            return False
        previous, self._token = self._token, read_token(self._port)
        return self._token != previous

    def open_unix_socket(self) -> socket.socket | None:
        """Connect to the Unix socket; None for a TCP address, OSError if the connection is refused."""
        if self.unix_path is None:
            return None
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(self.unix_path)
        except OSError:
            connection.close()
            raise
        return connection

    def open_client(self, timeout_s: float) -> httpx.Client:
        """Open an HTTP client for the daemon."""
        transport = httpx.HTTPTransport(uds=self.unix_path)
        return httpx.Client(base_url=self.url, transport=transport, timeout=timeout_s)

    def open_async_client(self, timeout_s: float) -> httpx.AsyncClient:
        """Open an asynchronous HTTP client for the daemon."""
        transport = httpx.AsyncHTTPTransport(uds=self.unix_path)
        return httpx.AsyncClient(base_url=self.url, transport=transport, timeout=timeout_s)

    def build_unreachable_error(self, error: Exception) -> LinkError:
        """Build the error for a daemon that does not answer."""
        cause = str(error) or type(error).__name__
        return LinkError(f"no daemon answers at {self.address} ({cause}); is `optodrive serve` running?")

    def build_stop_error(self, error: Exception) -> LinkError:
        """Build the error for a stop that is not answered."""
        return LinkError(STOP_UNANSWERED.format(url=self.address, error=str(error) or type(error).__name__))
