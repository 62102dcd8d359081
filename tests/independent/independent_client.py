"""The client that was written in JavaScript from PROTOCOL.md alone, in virtual time."""

import json
import subprocess

from javascript import HERE, javascript

STEP_S = 0.001
PLAY_MAX_S = 120.0


def client_command(*arguments):
    """Return the command of a client's process."""
    return javascript(HERE / "client_process.mjs", *arguments)


def play(line, clock, carry_up=lambda data: data, carry_down=lambda data: data):
    """Let a client play its plan on the host's end of a board's line. Return its report.

    carry_up, carry_down: what arrives of the bytes to and from the board
    """
    with subprocess.Popen(client_command(), stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        try:
            while clock.now_s() < PLAY_MAX_S:
                before_s = clock.now_s()
                data = carry_down(line.read())
                request = {"at": round(clock.now_s() * 1e6), "data": data.hex()}
                process.stdin.write(json.dumps(request).encode() + b"\n")
                process.stdin.flush()
                answer = json.loads(process.stdout.readline() or "null")
                assert answer, "the client ended by itself"
                if answer["data"]:
                    line.write(carry_up(bytes.fromhex(answer["data"])))
                if "report" in answer:
                    return answer["report"]
                if clock.now_s() == before_s:
                    clock.sleep(STEP_S)
            raise AssertionError("the client has not finished its plan")
        finally:
            process.kill()
