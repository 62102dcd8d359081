"""The log of a board under test, which is the witness of its actions."""


class BoardLog:
    """Queries of a board's log.

    clock: the host's; patience_s: of all waiting, beyond any stall of the machine; late_us: permitted lateness of edges

    Each board provides `events` with all log entries so far, in order. An entry precedes the bytes that the board sent
    after it: once a host has received an answer, the log contains what led to it.
    """

    clock = None
    patience_s = 60.0
    late_us = 0

    def of(self, kind):
        """Return the log entries of a kind."""
        return [entry for entry in self.events() if entry["event"] == kind]

    def states(self):
        """Return (state, reason) of each state change."""
        return [(entry["state"], entry["reason"]) for entry in self.of("state")]

    def changes(self, reason):
        """Return the state changes for a reason."""
        return [entry for entry in self.of("state") if entry["reason"] == reason]

    def faults(self):
        """Return the names of all faults."""
        return [entry["fault"] for entry in self.of("fault")]

    def pulse_numbers(self):
        """Return the numbers of all pulses."""
        return [entry["index"] for entry in self.of("pulse")]

    def is_gate_on(self):
        """Return whether the gate is on."""
        edges = self.of("gate")
        return bool(edges) and edges[-1]["on"]

    def output_edges(self):
        """Return (time, on) of each edge of the gate's output, by default as logged."""
        return [(entry["t_us"], entry["on"]) for entry in self.of("gate")]

    def wait(self, condition, what):
        """Wait until condition() is true, without a host."""
        until_s = self.clock.now_s() + self.patience_s
        while not condition():
            assert self.clock.now_s() < until_s, f"timed out waiting for {what}; log {self.events()[-8:]}"
            self.clock.sleep(0.005)
