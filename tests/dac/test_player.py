"""Plans played on the emulated DAC: the emission, and the stop on every kind of exit."""

import numpy as np
import pytest

from dac.bench import Bench, build_display, build_frame, build_train, build_verified
from dac.emulated_helios import HostDeadError
from optodrive.core.errors import InputError, LinkError
from optodrive.link.dac import player as player_module
from optodrive.link.dac.encoding import PointScale
from optodrive.link.dac.formats.helios import POINT_BYTES, HeliosFormat
from optodrive.link.dac.player import play


def list_emissions(bench, since_s=0.0):
    return [stretch for stretch in bench.device.light() if stretch[0] >= since_s]


@pytest.mark.parametrize("rate", [20_000, 40_000, 50_000])
@pytest.mark.parametrize("name", ["display-16", "display-437"])
def test_the_emission_is_the_verified_one(name, rate):
    display = build_display(name, rate)
    sequence = build_frame(display) if name == "display-16" else build_frame(display, 5e-6, 2.0)
    plan, verified = build_verified(display, sequence)
    bench = Bench(display.config.board)
    with bench.helios as helios:
        played = play(helios, verified, bench.clock)
    light, scale = list_emissions(bench), PointScale.from_config(display.config)
    assert played.underruns == 0
    assert played.chunks == len(verified.chunks) == bench.device.frames_played
    assert len(light) == len(verified.pulses)
    start_s = np.array([stretch[0] for stretch in light])
    width_s = np.array([stretch[1] - stretch[0] for stretch in light])
    assert start_s - start_s[0] == pytest.approx(verified.pulses.start_s - verified.pulses.start_s[0], abs=1e-8)
    assert width_s == pytest.approx(verified.pulses.width_s, abs=1e-8)
    assert np.array([(x - 2048) * scale.rad_per_code for _, _, x, _, _ in light]) == pytest.approx(
        verified.pulses.x_rad
    )
    assert [level / 255 * scale.full_power_w for *_, level in light] == pytest.approx(verified.pulses.power_w)
    assert len(set(verified.row.tolist())) == len(plan)


def test_the_shutter_is_open_only_during_playback():
    display = build_display()
    _, verified = build_verified(display, build_frame(display))
    bench = Bench()
    with bench.helios as helios:
        play(helios, verified, bench.clock)
        assert not bench.device.shutter
    opened = [output.at_s for output in bench.device.log if output.shutter]
    light = list_emissions(bench)
    assert opened[0] < light[0][0]
    assert all(output.shutter for output in bench.device.log if any(output.colour))


def test_the_first_frame_starts_with_centred_mirrors():
    display = build_display()
    _, verified = build_verified(display, build_frame(display))
    bench = Bench()
    bench.device.position = (1, 1)
    with bench.helios as helios:
        bench.emulated.pass_time(0.0)
        assert bench.device.position == (0x800, 0x800)
        play(helios, verified, bench.clock)


def playing(display=None, sequence=None, **faults):
    display = display or build_display()
    _, verified = build_verified(display, sequence or build_train(width_s=0.04, gap_s=0.004, duration_s=1.0))
    bench = Bench(display.config.board)
    bench.helios.open()
    return bench, verified


MOMENTS_S = np.random.default_rng(1).uniform(0.0, 0.9, 100)
"""Random moments of a play, which lasts a second."""
at_random_moments = pytest.mark.parametrize(
    "moments_s", [MOMENTS_S[:12], pytest.param(MOMENTS_S[12:], marks=pytest.mark.slow)], ids=["some", "all"]
)


@at_random_moments
def test_emission_ends_within_the_bound_after_the_host_was_killed(moments_s):
    emitted = 0
    for after_s in moments_s:
        bench, verified = playing()
        killed_s = bench.clock.now_s() + after_s
        bench.emulated.dies_at_s = killed_s
        with pytest.raises(HostDeadError):
            play(bench.helios, verified, bench.clock)
        bench.emulated.pass_time(60.0)
        assert bench.device.dark_from_s() <= killed_s + HeliosFormat.host_loss_max_s
        assert not any(bench.device.colour)
        emitted += bool(list_emissions(bench))
    assert emitted > 0.8 * len(moments_s)


def play_suspended(after_s, length_s):
    """Play on a computer that suspends the host at a moment. Return the bench, when it did, and the report."""
    bench, verified = playing()
    due_s, suspended_s = bench.clock.now_s() + after_s, []

    def suspend(_share):
        if not suspended_s and bench.clock.now_s() >= due_s:
            suspended_s.append(bench.clock.now_s())
            bench.emulated.pass_time(length_s)

    return bench, play(bench.helios, verified, bench.clock, suspend), suspended_s[0]


@at_random_moments
def test_a_host_that_is_suspended_is_dark_within_the_bound(moments_s):
    underruns = 0
    for after_s in moments_s:
        bench, played, suspended_s = play_suspended(after_s, 0.4)
        dark_s = suspended_s + HeliosFormat.host_loss_max_s, suspended_s + 0.4
        assert not [light for light in list_emissions(bench) if light[0] < dark_s[1] and light[1] > dark_s[0]]
        underruns += played.underruns
    assert underruns > 0.8 * len(moments_s)  # none before the first chunk and after the last


def test_the_bound_is_tight():
    """The latest emission after a kill reaches 70 % of the bound."""
    worst_s = 0.0
    for after_s in np.linspace(0.2, 0.3, 25):
        bench, verified = playing(sequence=build_train(width_s=0.05, gap_s=0.001, duration_s=0.5, power_w=0.1))
        bench.emulated.dies_at_s = killed_s = bench.clock.now_s() + after_s
        with pytest.raises(HostDeadError):
            play(bench.helios, verified, bench.clock)
        bench.emulated.pass_time(1.0)
        worst_s = max(worst_s, bench.device.dark_from_s() - killed_s)
    assert 0.7 * HeliosFormat.host_loss_max_s < worst_s <= HeliosFormat.host_loss_max_s


def test_a_mutant_without_play_once_emits_forever():
    """Purpose of the rule: the same kill with the play-once flag removed below the driver."""
    bench, verified = playing()
    bench.emulated.bulk_write, write = (
        lambda handle, ep, intf, data, timeout: write(handle, ep, intf, bytes(data)[:-1] + b"\0", timeout),
        bench.emulated.bulk_write,
    )
    bench.emulated.dies_at_s = killed_s = bench.clock.now_s() + 0.3
    with pytest.raises(HostDeadError):
        play(bench.helios, verified, bench.clock)
    bench.emulated.pass_time(5.0)
    assert bench.device.dark_from_s() > killed_s + 4.0


@at_random_moments
def test_unplugging_ends_emission_at_once_and_is_reported(moments_s):
    for after_s in moments_s:
        bench, verified = playing()
        bench.emulated.unplugged_at_s = pulled_s = bench.clock.now_s() + after_s
        with pytest.raises(LinkError, match="unplugged"):
            play(bench.helios, verified, bench.clock)
        assert bench.device.dark_from_s() <= pulled_s + 1e-6
        with pytest.raises(LinkError, match="may not have received"):
            bench.helios.close()
        assert not bench.device.shutter


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, RuntimeError, InputError])
def test_an_exception_of_the_progress_callback_ends_emission(error):
    bench, verified = playing()
    raised = []

    def leave(_share):
        if bench.clock.now_s() > 0.6:
            raised.append(bench.clock.now_s())
            raise error("x", 1, "y") if error is InputError else error

    with pytest.raises(error):
        play(bench.helios, verified, bench.clock, leave)
    assert bench.device.dark_from_s() <= raised[0] + 0.002
    assert not bench.device.shutter


def test_a_dac_that_is_never_ready_is_stopped():
    bench, verified = playing()
    bench.emulated.busy = 10_000
    with pytest.raises(LinkError, match=r"not ready for a chunk within 0\.5 s"):
        play(bench.helios, verified, bench.clock)
    assert not list_emissions(bench)
    assert not bench.device.shutter


@pytest.mark.parametrize("fault", ["deaf", "busy", "garbage"])
def test_bad_answers_cause_underruns_without_emission_that_are_reported(fault):
    bench, verified = playing()
    quiet = {"deaf": 5, "busy": 60, "garbage": 8}[fault]
    done = []

    def disturb(share):
        if share > 0.5 and not done:
            done.append(share)
            if fault == "garbage":
                bench.emulated.garbage.extend([b"\x83\x02", b"", b"\x83\x01\x00", b"?" * 32] * quiet)
            else:
                setattr(bench.emulated, fault, quiet)

    played = play(bench.helios, verified, bench.clock, disturb)
    assert played.underruns >= 1
    assert played.underrun_s > 0.0
    light = list_emissions(bench)
    width_s = sum(end_s - begin_s for begin_s, end_s, *_ in light)
    assert width_s == pytest.approx(verified.pulses.width_s.sum(), abs=1e-6)
    assert bench.device.starved == played.underruns + 1  # one more at the end


def test_a_partially_accepted_frame_ends_playback():
    bench, verified = playing()
    bench.emulated.bulk_write = lambda handle, ep, intf, data, timeout: len(data) - POINT_BYTES
    with pytest.raises(LinkError, match="bytes"):
        play(bench.helios, verified, bench.clock)
    assert not bench.device.shutter


def test_progress_is_told_from_nothing_to_all():
    bench, verified = playing()
    shares = []
    play(bench.helios, verified, bench.clock, shares.append)
    assert shares[0] == 0.0
    assert shares[-1] == 1.0
    assert shares == sorted(shares)
    assert HeliosFormat.host_loss_max_s < player_module.READY_TIMEOUT_S
