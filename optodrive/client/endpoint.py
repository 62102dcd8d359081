"""Where the daemon is, and the token that it requires."""

import socket
from urllib.parse import urlsplit

import httpx

from optodrive.core.daemon_url import DEFAULT_URL
from optodrive.core.errors import InputError, LinkError
from optodrive.daemon.api.tokens import read_token

PROBE_TIMEOUT_S = 2.0
STOP_UNANSWERED = (
    "stop was not answered by {url} ({error}): the running plan may go on to its end; use the emergency stop or the key"
)
TLS_REMEDIES = {
    "WRONG_VERSION_NUMBER": "without TLS: state http:// in place of https://",
    "CERTIFICATE_VERIFY_FAILED": "its certificate does not hold here: name the file of its authority by SSL_CERT_FILE",
}
"""What to do about a failure of TLS, by OpenSSL's name of it."""


class Endpoint:
    """The daemon's address, and the token: as given, from OPTODRIVE_TOKEN, or from the file that the daemon wrote.

    address: as given; url: base of the requests; unix_path: the daemon's Unix socket, None for a TCP address
    is_lost: whether the last request was given up because nobody answered
    """

    def __init__(self, address: str, token: str | None) -> None:
        parts = urlsplit(address)
        self.address = address.rstrip("/")
        self.unix_path = parts.path if parts.scheme == "unix" and not parts.netloc and parts.path != "/" else None
        if not self.unix_path and (parts.scheme not in ("http", "https") or not parts.hostname):
            raise InputError("url", address, f"an address like {DEFAULT_URL} or unix:/run/optodrive/optodrive.sock")
        self.url = "http://localhost" if self.unix_path else self.address
        self._port = None if self.unix_path else parts.port or (443 if parts.scheme == "https" else 80)
        self._has_certificate = parts.scheme == "https"  # loading what verifies it takes as long as many requests
        self.is_lost = False
        self._explicit_token = token
        self._token = token or self._read_token()

    @property
    def headers(self) -> dict[str, str]:
        """The headers of every request."""
        return {"Authorization": f"Bearer {self._token}"}

    def renew_token(self) -> bool:
        """Read the token again after a refusal and return whether it changed. A restarted daemon has a new one."""
        if self._explicit_token is not None:
            return False
        previous, self._token = self._token, self._read_token()
        return self._token != previous

    def _read_token(self) -> str:
        """Read the token. Raise InputError if none is readable, LinkError if that is because no daemon runs."""
        try:
            return read_token(self._port)
        except InputError:
            try:
                self._probe()
            except OSError as error:
                raise self.build_unreachable_error(error) from None
            raise

    def _probe(self) -> None:
        """Connect and close. Raise OSError if nobody listens."""
        if self.unix_path is not None:
            with socket.socket(socket.AF_UNIX) as connection:
                connection.settimeout(PROBE_TIMEOUT_S)
                connection.connect(self.unix_path)
        else:
            host = str(urlsplit(self.address).hostname)
            socket.create_connection((host, self._port), PROBE_TIMEOUT_S).close()

    def open_unix_socket(self) -> socket.socket | None:
        """Connect to the Unix socket, or return None for a TCP address. Raise OSError if the connection is refused."""
        if self.unix_path is None:
            return None
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.settimeout(PROBE_TIMEOUT_S)  # a daemon that is suspended accepts until its backlog is full
            connection.connect(self.unix_path)
            connection.settimeout(None)
        except OSError:
            connection.close()
            raise
        return connection

    def open_client(self, timeout_s: float | None) -> httpx.Client:
        """Open an HTTP client for the daemon."""
        transport = httpx.HTTPTransport(uds=self.unix_path, verify=self._has_certificate)
        return httpx.Client(base_url=self.url, transport=transport, timeout=timeout_s)

    def open_async_client(self, timeout_s: float | None) -> httpx.AsyncClient:
        """Open an asynchronous HTTP client for the daemon."""
        transport = httpx.AsyncHTTPTransport(uds=self.unix_path, verify=self._has_certificate)
        return httpx.AsyncClient(base_url=self.url, transport=transport, timeout=timeout_s)

    def build_unreachable_error(self, error: Exception) -> LinkError:
        """Build the error for a daemon that does not answer."""
        cause = (isinstance(error, OSError) and error.strerror) or str(error) or type(error).__name__
        for name, remedy in TLS_REMEDIES.items():
            if name in cause:
                return LinkError(f"{self.address} answers, but {remedy} ({cause})")
        return LinkError(f"no daemon answers at {self.address} ({cause}); is `optodrive serve` running?")

    def build_stop_error(self, error: Exception) -> LinkError:
        """Build the error for a stop that is not answered."""
        return LinkError(STOP_UNANSWERED.format(url=self.address, error=str(error) or type(error).__name__))
