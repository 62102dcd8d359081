"""A process between a host and an instrument, as a cable that can be pulled out (SIGKILL) or be silent (SIGSTOP)."""

import os
import selectors
import subprocess
import sys
import tty
from pathlib import Path

from optodrive.link.simulator.pseudo_terminal import open_pty


class Cable:
    """Process that connects a pseudo-terminal, `port`, with the port of an instrument."""

    def __init__(self, instrument):
        self.port = instrument.with_name(instrument.name + "-cable")
        self.process = subprocess.Popen([sys.executable, __file__, self.port, instrument], stdout=subprocess.PIPE)
        assert self.process.stdout.readline()

    def stop(self):
        self.port.unlink(missing_ok=True)  # the kernel soon gives its terminal to another program
        self.process.kill()
        self.process.communicate()


def relay(link, instrument):
    """Relay bytes both ways."""
    device = os.open(instrument, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(device)
    host = open_pty(link)
    os.open(link, os.O_RDWR | os.O_NOCTTY)  # kept: without a host the pty would report a hang-up
    selector = selectors.DefaultSelector()
    selector.register(host, selectors.EVENT_READ, device)
    selector.register(device, selectors.EVENT_READ, host)
    print("connected", flush=True)
    while True:
        for key, _ in selector.select():
            os.write(key.data, os.read(key.fd, 4096))


if __name__ == "__main__":
    relay(Path(sys.argv[1]), sys.argv[2])
