"""The byte rate of a simulated line."""

from optodrive.link.simulator.pseudo_terminal import BURST_BYTES, READ_MAX, LineRate


def test_bytes_pass_at_the_rate_of_the_line():
    rate = LineRate(115_200)
    rate.consume(rate.available_bytes(0.0))
    passed = 0
    for k in range(1, 101):
        available = rate.available_bytes(0.01 * k)
        rate.consume(available)
        passed += available
    assert 11_519 <= passed <= 11_520


def test_an_idle_line_accumulates_no_credit_and_a_late_process_catches_up_with_one_read():
    rate = LineRate(115_200)
    rate.available_bytes(0.5)
    rate.cap_credit()
    assert rate.available_bytes(0.5) == BURST_BYTES
    assert rate.available_bytes(60.0) == READ_MAX
