"""`optodrive calibrate sweep` on a board process: kill -9 loses no pulse that the journal has."""

import signal

from rig import wait_for
from signalled_processes import assert_dark_within_lease

MIDDLE_W = 2.45


def test_a_killed_sweep_leaves_its_journal_and_a_dark_board(board, start, tmp_path):
    folder = tmp_path / "sweep"
    journal = folder / "pulses.csv"
    command = start(board, "calibrate", "sweep", "--out", folder, "--yes")
    wait_for(lambda: journal.exists() and journal.read_text().count("\n") > 22, "20 pulses in the journal")
    command.process.send_signal(signal.SIGKILL)
    seen = journal.read_text()
    command.ended()
    wait_for(lambda: board.of("gate")[-1]["on"] is False, "the gate to be off")
    wait_for(lambda: board.of("state")[-1]["state"] in ("DISARMED", "FAULT"), "the board to end")
    assert_dark_within_lease(board)
    lines = journal.read_text().splitlines()
    assert journal.read_text().startswith(seen)
    executed = board.of("pulse")
    assert 20 <= len(lines) - 2 <= len(executed)
    assert [float(line.split(",")[5]) for line in lines[2:]] == [MIDDLE_W] * (len(lines) - 2)
    assert not (folder / "recording").exists()
