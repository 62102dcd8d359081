"""Several simulated boards whose clocks drift and wander: skew of their gate edges, and time to STOP.

Full frames are drawn over and over by four board processes. Each board's own log and the known error of its clock give
the true time of every pulse; its skew is the deviation from the plan beside the median of the plan. The time that the
daemon reports of it divides the skew: what the host knows to be off the plan is the driver's part, and what it does not
know is that of the exchanges, through pseudo-terminal and scheduler.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from measuring import Row, to_ms

from optodrive.device.config_file import load_config
from optodrive.link.board_setup import build_scales
from optodrive.link.simulator.board_core import BoardClock
from optodrive.planning.display_model import DisplayModel
from rig import Board, Daemon, long_train, wait_for  # of the tests

CLOCKS = (BoardClock(50e-6), BoardClock(-50e-6, 10e-6), BoardClock(20e-6, 20e-6), BoardClock(-30e-6, 15e-6))
"""Drift and wander of the boards, of which the first ones are used."""
DISPLAY = "display-437"
OPTIONS = {
    "--boards": {"type": int, "nargs": "+", "default": [4], "choices": range(1, 5), "help": "numbers of boards"},
    "--minutes": {"type": float, "default": 10.0, "help": "time of drawing frames"},
    "--stops": {"type": int, "default": 100, "help": "number of STOPs; each arms for two seconds first"},
}
FIRST_TRAIN_PIXEL = 50
STAGE = """
[[stages]]
name = "stage-{number}"
board = {{ transport = "serial", port = "{port}", lease_s = 0.3, stream_lead_s = 0.06 }}
"""


class Bench:
    """A daemon on the boards of several stages."""

    def __init__(self, folder, count):
        self.clocks, self.boards = CLOCKS[:count], []
        for number, clock in enumerate(self.clocks):
            own = folder / f"board-{number}"
            own.mkdir()
            options = ("--clock-ppm", str(1e6 * clock.drift), "--clock-wander-ppm", str(1e6 * clock.wander))
            program = (sys.executable, "-m", "optodrive.link.simulator.board_process", *options)
            self.boards.append(Board(own, program=program))
        self.began_s = [wait_for(lambda: board.of("clock"), "its clock")[0]["monotonic_s"] for board in self.boards]
        several = count > 1
        stages = [STAGE.format(number=number, port=board.port) for number, board in enumerate(self.boards)]
        self.daemon = Daemon(folder, self.boards[0].port, DISPLAY, lease_s=0.3, stages="".join(stages) * several)
        layout_scale = build_scales(load_config(DISPLAY))[0]
        moves = DisplayModel.from_config(load_config(DISPLAY)).scan_head.moves
        codes = zip(layout_scale.to_codes(moves.x_rad), layout_scale.to_codes(moves.y_rad), strict=True)
        self.pixel_by_codes = {(int(x), int(y)): pixel for pixel, (x, y) in enumerate(codes)}

    def stop(self):
        self.daemon.stop()
        for board in self.boards:
            board.stop()

    def arm(self):
        wait_for(lambda: self.daemon.board_state() in ("DISARMED", "ARMED"), "the boards")
        if self.daemon.board_state() == "DISARMED":
            self.daemon.arm()

    def draw_frame(self):
        """Draw a full frame. Return the true and the reported deviation of each pulse from its plan, s, [n, 2]."""
        for board in self.boards:
            board.forget()
        body = {"frames": [{"show_at_s": 0, "duration_s": 0.1, "target_um": {str(k): 60.0 for k in range(437)}}]}
        answer = self.daemon.finished(self.daemon.call("POST", "/v1/plans", json=body)["plan"])
        assert (answer["status"], answer["executed"]) == ("done", answer["planned"]), answer["error"]
        planned_s, reported_s = (
            dict(zip(answer[columns]["pixel"], answer[columns]["start_s"], strict=True))
            for columns in ("pulses", "executed_pulses")
        )
        count = answer["executed"]
        wait_for(lambda: sum(len(board.of("pulse")) for board in self.boards) == count, "the logs")
        errors_s = []
        for board, clock, began_s in zip(self.boards, self.clocks, self.began_s, strict=True):
            for pulse in board.of("pulse"):
                true_s = began_s + clock.find_true_s(1e-6 * pulse["on_us"])
                pixel = self.pixel_by_codes[pulse["x"], pulse["y"]]
                errors_s.append((true_s - planned_s[pixel], reported_s[pixel] - planned_s[pixel]))
        errors_s = np.array(errors_s)
        return errors_s - np.median(errors_s, axis=0)

    def start_trains(self):
        """Let a long train run on every board."""
        trains = [long_train(FIRST_TRAIN_PIXEL + 60 * k)["trains"][0] for k in range(len(self.boards))]
        for board in self.boards:
            board.forget()
        self.daemon.call("POST", "/v1/plans", json={"trains": trains})
        wait_for(lambda: all(len(board.of("pulse")) > 2 for board in self.boards), "light on all boards")

    def measure_stop_s(self):
        """Arm, and return the time from a STOP until the gates of all boards are off, by the log, s."""
        self.arm()
        self.start_trains()
        time.sleep(np.random.default_rng().uniform(0.0, 0.02))
        stopped_s = time.monotonic()
        self.daemon.call("POST", "/v1/stop")
        wait_for(lambda: all(board.of("state")[-1:] for board in self.boards), "the logs")
        last_s = []
        for board, clock, began_s in zip(self.boards, self.clocks, self.began_s, strict=True):
            off_us = max(event["t_us"] for event in board.of("gate") if not event["on"])
            last_s.append(began_s + clock.find_true_s(1e-6 * off_us))
        return max(0.0, max(last_s) - stopped_s)


def measure(boards=(4,), minutes=10.0, stops=100):
    for count in boards:
        with tempfile.TemporaryDirectory() as name:
            bench = Bench(Path(name), count)
            try:
                bench.arm()
                time.sleep(5.0)  # until the rates of the clocks are known
                skews_s, end_s = [], time.monotonic() + 60.0 * minutes
                while time.monotonic() < end_s:
                    skews_s.append(bench.draw_frame())
                if skews_s:
                    true_us, reported_us = 1e6 * np.concatenate(skews_s).T
                    for what, skew_us in (
                        ("skew of gate edges", true_us),
                        ("of it the driver's, as the daemon reports it", reported_us),
                        ("of it unknown to the host: exchanges through pseudo-terminals", true_us - reported_us),
                    ):
                        yield Row(f"{count} boards: {what}", np.abs(skew_us).tolist(), "µs")
                    yield f"{count} boards: frames", len(skews_s), "1"
                    yield f"{count} boards: underruns", bench.daemon.state()["board"]["underruns"], "1"
                times_s = [bench.measure_stop_s() for _ in range(stops)]
                if times_s:
                    yield Row(f"{count} boards: STOP to all gates off", to_ms(times_s))
            finally:
                bench.stop()
