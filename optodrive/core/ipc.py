"""Messages between the processes of the daemon, over Unix stream sockets that never block, and sockets that listen.

message: u32 length of all | u32 length of the header | JSON object {"kind": …, fields} | payload; little-endian
"""

import json
import os
import socket
import stat
import struct
from pathlib import Path
from typing import Any, NamedTuple, Self

from optodrive.core.errors import InputError, OptodriveError


def open_unix_listener(
    path: Path, mode: int, backlog: int, where: str, kind: socket.SocketKind = socket.SOCK_STREAM
) -> socket.socket:
    """Open a socket that listens at a path, with a mode. Replace one on which nobody listens any more.

    Raise InputError, at `where`, if the path is in use or cannot hold a socket.
    """
    listener = socket.socket(socket.AF_UNIX, kind)
    try:
        if _is_stale_socket(path, kind):
            path.unlink()
        previous_umask = os.umask(0o777 & ~mode)  # never accessible to others, not even before a chmod
        try:
            listener.bind(str(path))
        finally:
            os.umask(previous_umask)
        listener.listen(backlog)
    except OSError as error:
        listener.close()
        raise InputError(where, str(path), f"a path for a new socket ({error.strerror or error})") from None
    return listener


def _is_stale_socket(path: Path, kind: socket.SocketKind) -> bool:
    """Return whether the path holds a socket on which nobody listens."""
    try:
        if not stat.S_ISSOCK(path.stat().st_mode):
            return False
        with socket.socket(socket.AF_UNIX, kind) as caller:
            caller.connect(str(path))
    except ConnectionRefusedError:
        return True
    except FileNotFoundError:
        pass
    return False


MESSAGE_MAX_BYTES = 64_000_000
HEADER_MAX_BYTES = 4_000_000
OUT_MAX_BYTES = MESSAGE_MAX_BYTES + HEADER_MAX_BYTES
"""Default bound of the bytes that wait for a peer. A peer that leaves more unread counts as lost."""
READ_BYTES = 1 << 18
"""Bytes read per call, so that a large message of one peer does not keep the others waiting."""
_LENGTHS = struct.Struct("<II")


class IpcError(OptodriveError):
    """Bytes of a peer that are no message, or a message too large to send."""

    code = "ipc"


class IpcClosed(IpcError):  # noqa: N818 - the usual end of a connection
    """The connection has ended, or the peer no longer reads and counts as lost."""


class Message(NamedTuple):
    """One message between two processes.

    fields: JSON values by name, without `kind`; payload: bytes after the header
    """

    kind: str
    fields: dict[str, Any]
    payload: bytes = b""


def encode_message(message: Message) -> bytes:
    """Return the bytes of a message. Raise IpcError if it exceeds MESSAGE_MAX_BYTES or a field is no JSON value."""
    try:
        header = json.dumps({**message.fields, "kind": message.kind}, separators=(",", ":")).encode()
    except (TypeError, ValueError) as error:
        raise IpcError(f"message {message.kind!r}: {error}") from None
    total_bytes = _LENGTHS.size + len(header) + len(message.payload)
    if total_bytes > MESSAGE_MAX_BYTES or len(header) > HEADER_MAX_BYTES:
        raise IpcError(
            f"message {message.kind!r}: got {total_bytes} bytes with a header of {len(header)}, "
            f"expected at most {MESSAGE_MAX_BYTES} and {HEADER_MAX_BYTES}"
        )
    return _LENGTHS.pack(total_bytes, len(header)) + header + message.payload


class MessageDecoder:
    """Decoder of a byte stream in arbitrary fragments. max_bytes: largest message that the peer may send."""

    def __init__(self, max_bytes: int = MESSAGE_MAX_BYTES) -> None:
        self.max_bytes = max_bytes
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Message]:
        """Return the messages that these bytes complete. Raise IpcError for bytes that are no message."""
        self._buffer += data
        messages, begin = [], 0
        while len(self._buffer) - begin >= _LENGTHS.size:
            total_bytes, header_bytes = _LENGTHS.unpack_from(self._buffer, begin)
            self._check_lengths(total_bytes, header_bytes)
            if len(self._buffer) - begin < total_bytes:
                break
            messages.append(self._decode(begin, total_bytes, header_bytes))
            begin += total_bytes
        del self._buffer[:begin]
        return messages

    def _check_lengths(self, total_bytes: int, header_bytes: int) -> None:
        if total_bytes > self.max_bytes:
            raise IpcError(f"message length: got {total_bytes} bytes, expected at most {self.max_bytes}")
        if header_bytes > min(HEADER_MAX_BYTES, total_bytes - _LENGTHS.size):
            raise IpcError(f"header length: got {header_bytes} bytes in a message of {total_bytes}, expected fewer")

    def _decode(self, begin: int, total_bytes: int, header_bytes: int) -> Message:
        payload_begin = begin + _LENGTHS.size + header_bytes
        try:
            fields = json.loads(self._buffer[begin + _LENGTHS.size : payload_begin])
            kind = fields.pop("kind")
        except (ValueError, AttributeError, KeyError, TypeError, RecursionError):
            raise IpcError("message header: expected a JSON object with a kind") from None
        if not isinstance(kind, str):
            raise IpcError(f"message kind: got {kind!r}, expected a name")
        return Message(kind, fields, bytes(memoryview(self._buffer)[payload_begin : begin + total_bytes]))


class MessageSocket:
    """Connected Unix stream socket for messages. No method waits.

    Every method but close() raises IpcClosed once the connection has ended.
    out_max_bytes: bound of the bytes that wait to be sent; beyond it the peer counts as lost
    """

    def __init__(
        self, connection: socket.socket, max_bytes: int = MESSAGE_MAX_BYTES, out_max_bytes: int = OUT_MAX_BYTES
    ) -> None:
        connection.setblocking(False)
        self.decoder = MessageDecoder(max_bytes)
        self._connection = connection
        self._out = bytearray()
        self._out_max_bytes = out_max_bytes
        self._closed = False

    @classmethod
    def connect(cls, path: Path | str) -> Self:
        """Connect to a listening socket. Raise OSError if there is none, or if it is full."""
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connection.setblocking(False)
            connection.connect(str(path))  # completes at once, or fails
        except OSError:
            connection.close()
            raise
        return cls(connection)

    def fileno(self) -> int:
        """Return the descriptor for a selector, −1 after the end."""
        return self._connection.fileno()

    @property
    def is_closed(self) -> bool:
        """Whether the connection has ended."""
        return self._closed

    @property
    def wants_write(self) -> bool:
        """Whether bytes wait until the peer reads: flush() when the socket is writable."""
        return bool(self._out)

    def send(self, message: Message) -> None:
        """Send a message, or keep the bytes that the peer does not accept yet."""
        self.send_bytes(encode_message(message))

    def send_bytes(self, data: bytes) -> None:
        """Send an encoded message, or keep the bytes that the peer does not accept yet."""
        self._require_open()
        # Lost, not waited for: a peer that does not read must not fill the memory of one in real time.
        if len(self._out) + len(data) > self._out_max_bytes:
            waiting_bytes = len(self._out)
            self.close()
            raise IpcClosed(f"the peer has left {waiting_bytes} bytes unread")
        self._out += data
        self.flush()

    def flush(self) -> None:
        """Send as much of the kept bytes as the peer accepts now."""
        self._require_open()
        sent_bytes = 0
        try:
            with memoryview(self._out) as view:
                while sent_bytes < len(view):
                    sent_bytes += self._connection.send(view[sent_bytes : sent_bytes + READ_BYTES])
        except BlockingIOError:
            pass
        except OSError as error:
            self.close()
            raise IpcClosed(f"the peer is gone: {error.strerror or error}") from None
        del self._out[:sent_bytes]

    def receive(self) -> list[Message]:
        """Return the messages that have arrived completely. Raise IpcClosed at the end, IpcError for other bytes.

        Messages before the end are returned first. An error closes the connection.
        """
        self._require_open()
        try:
            data = self._connection.recv(READ_BYTES)
        except BlockingIOError:
            return []
        except OSError as error:
            self.close()
            raise IpcClosed(f"the peer is gone: {error.strerror or error}") from None
        if not data:
            self.close()
            raise IpcClosed("the peer has closed the connection")
        try:
            return self.decoder.feed(data)
        except IpcError:
            self.close()
            raise

    def close(self) -> None:
        """Close the connection."""
        self._closed = True
        self._connection.close()

    def _require_open(self) -> None:
        if self._closed:
            raise IpcClosed("the connection is closed")
