"""The check of clocks finds verdicts on the computer's speed, and allows statements of order."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "scripts"))

from check_clocks import find_problems

BEGIN = "import time\nbegin_s = time.monotonic()\n"


def count(body, **others):
    sources = {"tests/test_one.py": body} | {f"tests/{name}.py": text for name, text in others.items()}
    return len(find_problems(sources))


@pytest.mark.parametrize(
    "verdict",
    [
        "assert time.monotonic() - begin_s < 1.0",
        "assert time.monotonic() - begin_s > 0.2",
        "assert 0.4 < time.monotonic() - begin_s < 5.0",
        "assert time.monotonic() < begin_s + 5",
        "took_s = time.perf_counter() - begin_s\nassert took_s <= END_S",
        "took_s = time.process_time() - begin_s\nassert took_s == approx(1.0)",
        "times = []\ntimes.append(time.time() - begin_s)\nassert max(times) < 1",
        "times = [time.monotonic_ns() - begin_s for _ in range(3)]\nassert sorted(times)[1] < 1e6",
        "late = {'late_s': time.monotonic() - begin_s}\nassert late['late_s'] < 1",
        "if time.monotonic() - begin_s > 5:\n    pytest.fail('late')",
        "while time.monotonic() < begin_s + 5:\n    pass\nraise AssertionError",
        "while (waited_s := time.monotonic() - begin_s) < 5:\n    pass\nassert done",
        "np.testing.assert_allclose(time.monotonic() - begin_s, 5)",
        "def measure():\n    return time.monotonic() - begin_s\nassert measure() < 1",
        "def measure():\n    return time.monotonic() - begin_s, None\ntook_s, _ = measure()\nassert took_s < 1",
        "class Timer:\n    def end(self):\n        self.took_s = time.monotonic() - begin_s\nassert Timer().took_s < 1",
        "loop_s = asyncio.get_running_loop().time()\nassert asyncio.get_running_loop().time() - loop_s < 1",
    ],
)
def test_a_verdict_on_the_speed_of_the_computer_is_found(verdict):
    assert count(BEGIN + verdict) == 1


@pytest.mark.parametrize(
    "statement",
    [
        "end_s = time.monotonic()\nassert begin_s <= end_s",
        "assert begin_s <= event_s",
        "while time.monotonic() < begin_s + 0.3:\n    step()\nstop()",
        "print(time.monotonic() - begin_s)",
        "time.sleep(0.1)\nassert clock.now_s() - clock.start_s < 1.0",
        "assert board.pulses[0].width_s < 0.01",
        "took_s = time.monotonic() - begin_s\nassert took_s is not None",
    ],
)
def test_order_and_other_clocks_are_allowed(statement):
    assert count(BEGIN + statement) == 0


def test_a_duration_is_followed_into_the_module_that_imports_it():
    other = "import time\ndef measure(work):\n    return time.monotonic() - work()\n"
    assert count("from rig import measure\nassert measure(f) < 1.0\n", rig=other) == 1
    assert count("from elsewhere import measure\nassert measure(f) < 1.0\n", rig=other) == 0
