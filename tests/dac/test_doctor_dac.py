"""`optodrive doctor` of an emulated Helios, through the real pyusb."""

import json

import pytest
import usb.backend.libusb1

from dac.bench import Bench, build_config, build_display, record_cold
from dac.emulated_helios import EmulatedHelios
from optodrive.cli.doctor_dac import check_dac
from optodrive.cli.main import run
from optodrive.core.clock import ManualClock
from optodrive.device.config_file import locate_shipped


@pytest.fixture
def examine(monkeypatch):
    def examine(bench, **board):
        monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: bench.emulated)
        return {finding.check: finding for finding in check_dac(build_config(**board), bench.clock)}

    return examine


def test_a_helios_in_order(examine):
    bench = Bench()
    record_cold(build_display(), "helios", "any")
    findings = examine(bench, uid="Helios 1163021877")
    assert {finding.status for finding in findings.values()} == {"ok"}
    assert findings["board"].observation == "Helios 1163021877, firmware 6, stopped, its light off"
    assert findings["rate"].observation.startswith("39985.7 points/s for 40000 requested")
    assert "at most 50 ms" in findings["not reported"].observation
    assert not bench.device.shutter
    assert not bench.emulated.claimed
    assert not bench.device.light()


def test_any_device_and_no_interlock_are_warnings(examine):
    findings = examine(Bench(), interlock_watched=False)
    warnings = {check for check, finding in findings.items() if finding.status == "warning"}
    assert warnings == {"board", "interlock", "heat"}
    assert findings["heat"].observation == (
        "the display counts as hot, because this machine had no record of its heat; it cools within 786 s"
    )
    assert 'uid = "Helios 1163021877"' in findings["board"].remedy
    assert "nothing is emitted before" in findings["interlock"].remedy


def test_another_device_is_a_problem(examine):
    findings = examine(Bench(), uid="Helios 1")
    assert findings["port"].status == "problem"
    assert "Helios 1163021877" in findings["port"].remedy


def test_an_unplugged_device_is_a_problem(examine):
    bench = Bench()
    bench.emulated.unplugged_at_s = 0.0
    findings = examine(bench)
    assert list(findings) == ["port"]
    assert findings["port"].status == "problem"
    assert "a connected USB device" in findings["port"].remedy


def test_a_device_that_takes_no_frames_is_a_problem(examine):
    bench = Bench()
    bench.emulated.busy = 1000
    assert examine(bench)["link"].status == "problem"


def test_a_device_that_does_not_answer_is_a_problem(examine):
    bench = Bench()
    bench.emulated.deaf = 1000
    findings = examine(bench)
    assert list(findings) == ["board"]
    assert findings["board"].status == "problem"
    assert "does not answer" in findings["board"].observation
    assert not bench.emulated.claimed


def test_the_command_checks_a_helios_instead_of_a_port(tmp_path, monkeypatch, capsys):
    clock = ManualClock()
    emulated = EmulatedHelios(clock)
    monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: emulated)
    text = locate_shipped("display-16.toml").read_text()
    path = tmp_path / "helios.toml"
    text = text.replace('transport = "simulated"', 'transport = "helios"\ninterlock_watched = true')
    path.write_text(text.replace("[scanner]", "[scanner]\nhalf_range_codes = 2047"))
    monkeypatch.setattr("optodrive.core.clock.MonotonicClock", lambda: clock)
    run(["doctor", "--config", str(path), "--json"])
    findings = {item["check"]: item for item in json.loads(capsys.readouterr().out)["findings"]}
    assert findings["board"]["observation"].startswith("Helios 1163021877")
    assert "port" not in findings
