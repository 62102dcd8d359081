"""Proxies of TCP and UDP on loopback that disturb what passes, as threads."""

import random
import select
import socket
import threading
import time
from contextlib import suppress


class TcpProxy:
    """Proxy of one TCP connection.

    after: number of bytes to the device after which the fault sets in
    fault: "stall" for a time, "half-open": nothing passes any more and nothing closes, or "reset"
    """

    def __init__(self, address, target, after, fault, stall_s=0.0):
        self.address, self.target, self.after, self.fault, self.stall_s = address, target, after, fault, stall_s
        self.listener = socket.create_server((address, target[1]))
        self.finished = threading.Event()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self):
        host, _ = self.listener.accept()
        device = socket.create_connection(self.target)
        passed, done = 0, False
        while not self.finished.is_set():
            for stream in select.select([host, device], [], [], 0.02)[0]:
                data = b""
                with suppress(OSError):
                    data = stream.recv(65_536)
                if not data:
                    self.finished.set()
                    break
                if stream is host:
                    passed += len(data)
                if passed > self.after and not done:
                    done = True
                    if self.fault == "stall":
                        time.sleep(self.stall_s)
                    elif self.fault == "half-open":
                        self.finished.wait()
                        break
                    else:
                        self.finished.set()
                        break
                with suppress(OSError):
                    (device if stream is host else host).sendall(data)
        for stream in (host, device):
            with suppress(OSError):
                stream.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                stream.close()

    def close(self):
        self.finished.set()
        self.thread.join()
        self.listener.close()


class UdpProxy:
    """Proxy of UDP between one host and a device, which loses, repeats, delays and reorders both ways.

    shares: chance of each fault by datagram: lost, repeated, delayed; delay_s: longest delay
    """

    def __init__(self, address, target, seed, lost=0.0, repeated=0.0, delayed=0.0, delay_s=0.05):
        self.address, self.rng = address, random.Random(seed)
        self.shares, self.delay_s = (lost, repeated, delayed), delay_s
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((address, target[1]))
        self.device = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.device.connect(target)
        self.host, self.pending = None, []
        self.counts = {"lost": 0, "repeated": 0, "delayed": 0}
        self.finished = threading.Event()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self):
        while not self.finished.is_set():
            for stream in select.select([self.socket, self.device], [], [], 0.002)[0]:
                with suppress(OSError):
                    if stream is self.socket:
                        data, self.host = self.socket.recvfrom(65_536)
                        self._disturb(data, True)
                    else:
                        self._disturb(self.device.recv(65_536), False)
            now_s = time.monotonic()
            for item in sorted(self.pending, key=lambda item: item[0]):
                if item[0] <= now_s:
                    self.pending.remove(item)
                    self._pass(item[1], item[2])

    def _disturb(self, data, to_device):
        lost, repeated, delayed = self.shares
        if self.rng.random() < lost:
            self.counts["lost"] += 1
            return
        if self.rng.random() < delayed:
            self.counts["delayed"] += 1
            self.pending.append((time.monotonic() + self.rng.uniform(0.0, self.delay_s), data, to_device))
        else:
            self._pass(data, to_device)
        if self.rng.random() < repeated:
            self.counts["repeated"] += 1
            self.pending.append((time.monotonic() + self.rng.uniform(0.0, self.delay_s), data, to_device))

    def _pass(self, data, to_device):
        with suppress(OSError):
            if to_device:
                self.device.send(data)
            elif self.host:
                self.socket.sendto(data, self.host)

    def close(self):
        self.finished.set()
        self.thread.join()
        self.socket.close()
        self.device.close()
