"""The circuits of a Pico, judged by SKiDL's electrical rules and by ngspice."""

import re
import subprocess
import sys
from importlib.util import find_spec
from itertools import product
from math import pi
from pathlib import Path

import pytest

from firmware_ports import require

CIRCUIT = Path(__file__).parents[2] / "firmware_protocol" / "circuit"
sys.path.append(str(CIRCUIT))

import faults  # noqa: E402
import netlist  # noqa: E402
import page  # noqa: E402
from circuit import ANALOG, CIRCUITS, XY2_100, draw  # noqa: E402

GATE_S = 5e-9
SCHMITT_V = 0.8, 1.5
"""Between these the input of U4 turns low, of any specimen at 3.3 V."""
READBACK_US = int(re.search(r"BOARD_READBACK_US (\d+)u", (CIRCUIT.parent / "core" / "board.h").read_text())[1])


def simulate(deck, tmp_path, *commands):
    """Run a deck with commands of ngspice's control language, and return what its measurements print."""
    require("ngspice")
    path = tmp_path / "deck.cir"
    path.write_text(deck.replace(".end\n", "\n".join([".control", *commands, "quit", ".endc", ".end", ""])))
    ran = subprocess.run(["ngspice", "-b", path], capture_output=True, text=True)
    found = dict(re.findall(r"^(\w+)\s+=\s+(\S+)", ran.stdout, re.MULTILINE))
    assert found, ran.stdout + ran.stderr
    return {name: float(value) for name, value in found.items()}


EACH = pytest.mark.parametrize("circuit", CIRCUITS.values(), ids=CIRCUITS)

# --- the statement ---


def change(circuit, parts=None, **nets):
    """Return a circuit with other pins on some nets, None for a net that is gone, and other parts."""
    changed = {name: pins for name, pins in (circuit.nets | nets).items() if pins is not None}
    return circuit._replace(nets=changed, parts=circuit.parts if parts is None else parts)


@EACH
def test_every_pin_is_stated_once(circuit):
    assert circuit.check() == []


def test_a_pin_that_is_forgotten_unknown_or_stated_twice_is_named():
    wrong = change(ANALOG, TTL=["R2.2", "R3.1", "D1.A", "X1.TTL", "X1.TTL", "R44.1"])
    assert wrong.check() == ["R44.1: no such pin", "R4.1: stated 0 times", "X1.TTL: stated 2 times"]


@pytest.fixture
def build_skidl(tmp_path, monkeypatch):
    """Return a function that builds a circuit as SKiDL's, which writes its files into a folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["circuit.py"])
    pytest.importorskip("skidl")
    return netlist.build_skidl


@EACH
@pytest.mark.skipif(find_spec("skidl") is None, reason="skidl is not installed")
def test_the_electrical_rules_find_nothing_and_kicad_gets_a_netlist(circuit, tmp_path):
    out = tmp_path / "board.net"
    command = [sys.executable, netlist.__file__, circuit.name, out]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert f"{len(circuit.parts)} parts, {len(circuit.nets)} nets, no rule broken" in ran.stdout
    written = out.read_text()
    assert len(re.findall(r"\(comp\s", written)) == len(circuit.parts)
    assert {f'(name "{net}")' in written for net in circuit.nets} == {True}


@pytest.mark.parametrize(
    ("circuit", "nets", "freed"),
    [(ANALOG, {"READBACK": ["U4.Y", "A1.GP13", "A1.GP22"]}, "A1.GP22"),
     (XY2_100, {"STATUS": ["U6.1Y", "A1.GP21", "U6.2Y"]}, "U6.2Y")],
    ids=["analog", "xy2-100"],
)  # fmt: skip
def test_two_outputs_on_one_net_break_the_rules(build_skidl, circuit, nets, freed):
    wrong = change(circuit, **nets)._replace(unconnected=tuple(set(circuit.unconnected) - {freed}))
    assert netlist.check_rules(build_skidl(wrong))[0] == 1


# --- single faults ---


def test_no_single_fault_leaves_the_laser_on_and_the_page_says_which_were_tried():
    require("ngspice")
    assert page.PAGE.read_text() == page.build_page(), "run python firmware_protocol/circuit/page.py"
    for circuit in CIRCUITS.values():
        assert page.locate_drawing(circuit).read_text() == draw(circuit)


def test_a_digital_circuit_needs_no_second_supply_converter_or_amplifier():
    assert set(XY2_100.supplies) == {"5V", "3V3", "+12V"}
    assert not {"U2", "U3"} & set(XY2_100.parts)


@EACH
@pytest.mark.parametrize(
    ("mutant", "exposed"),
    [
        ("without D3", ["wire U1.GND (GND)"]),
        ("without R4", ["wire U1.GND (GND)", "wire X1.TTL (TTL)"]),
    ],
)
def test_a_circuit_that_lacks_a_part_leaves_it_on(circuit, mutant, exposed):
    require("ngspice")
    lost = mutant.removeprefix("without ")
    parts = {reference: part for reference, part in circuit.parts.items() if reference != lost}
    nets = {net: [pin for pin in circuit.nets[net] if not pin.startswith(f"{lost}.")] for net in ("TTL", "GND")}
    if lost == "D3":
        nets |= {"GATE_5V": ["U1.1Y", "R2.1"], "GATE_HIGH": None}
    outcomes = faults.list_outcomes(change(circuit, parts, **nets), ("GND", "TTL"))
    assert [outcome.fault for outcome in outcomes if not outcome.is_dark] == exposed


def test_a_lost_status_is_a_fault_also_of_an_unplugged_head():
    require("ngspice")
    unplugged = [f"X2.STATUS{sign}" for sign in "+-"]
    nets = {net: [pin for pin in XY2_100.nets[net] if pin not in unplugged] for net in ("STATUS+", "STATUS-")}
    (nothing, *cut) = [
        each for each in faults.list_outcomes(change(XY2_100, **nets), ("STATUS",)) if "sup" not in each.fault
    ]
    assert (nothing.notice, nothing.reads["STATUS"] > 2.0) == ("FAULT HEAD", True)
    assert {each.notice for each in cut} == {"FAULT HEAD"}
    assert {each.notice for each in faults.list_outcomes(XY2_100, ("STATUS",)) if "wire" in each.fault} == {
        "FAULT HEAD"
    }


# --- in time ---


@EACH
@pytest.mark.parametrize(("rise_s", "gate"), list(product((1e-5, 1e-3, 0.1), ("open", "low"))))
def test_power_up_gives_the_laser_nothing(tmp_path, circuit, rise_s, gate):
    deck = faults.build_deck(circuit, gate, rise_s=rise_s)
    found = simulate(deck, tmp_path, f"tran {rise_s / 100} {2 * rise_s} uic", "meas tran peak max v(ttl)")
    assert found["peak"] < 0.4


@pytest.mark.parametrize(("gate_hz", "duty"), list(product((30e3, 50e3, 488e3), (0.01, 0.5, 0.999))))
def test_the_readback_holds_through_a_pulse_and_ends_in_time(tmp_path, gate_hz, duty):
    period_s, pulses = 1.0 / gate_hz, 20
    source = f"pulse(0 3.3 1u {GATE_S} {GATE_S} {duty * period_s} {period_s} {pulses})"
    off_s = 1e-6 + (pulses - 1 + duty) * period_s
    found = simulate(
        faults.build_deck(ANALOG, source), tmp_path, f"tran {min(period_s / 200, 2e-7)} {off_s + 2e-4}",
        f"meas tran lowest min v(held) from={off_s - 5 * period_s} to={off_s}",
        f"meas tran early when v(held)={SCHMITT_V[1]} fall=last",
        f"meas tran late when v(held)={SCHMITT_V[0]} fall=last",
        "meas tran top max v(ttl)",
    )  # fmt: skip
    assert found["lowest"] > SCHMITT_V[1]
    assert 0.0 < found["early"] - off_s < found["late"] - off_s < 1e-6 * READBACK_US
    assert found["top"] > 3.0


@EACH
def test_no_part_carries_more_than_it_may(circuit):
    """AO3400A: 5.7 A; AHCT125: 8 mA an output; 0.25 W a resistor; relay and lamp on."""
    require("ngspice")
    (volts,) = faults.run_ngspice([faults.build_deck(circuit, "high")])
    volts["0"] = 0.0
    assert 0.05 < volts["vcoil#branch"] < 0.06
    assert 0.0 < (volts["gate_high"] - volts["ttl"]) / 100.0 < 8e-3
    for reference, part in circuit.parts.items():
        if reference.startswith("R"):
            ends = [volts[faults._spell(circuit.find_net(f"{reference}.{k}"))] for k in "12"]
            assert (ends[0] - ends[1]) ** 2 / faults._read_ohms(part.value.lower()) < 0.125, reference


# --- mirrors ---

AMPLIFIER = """amplifier
Vref vref 0 2.5
Vdac dac 0 pulse({low} {high} 1u 10n 10n 1 2)
R16 vref minus {r16}
R17 minus out {r17}
R18 minus 0 {r18}
Bgm 0 slew i = {amps}*tanh(v(dac,minus)/{linear})
Cgm slew 0 1n
Rgm slew 0 1g
Eout out 0 slew 0 1
Cload out 0 100p
.end
"""
"""OPA2192: 10 MHz, 20 V/µs, open loop of a limited transconductance and one pole."""
GBW_HZ, SLEW_V_PER_S = 10e6, 20e6


def build_amplifier(low, high, r16=1e4, r17=2e4, r18=2e4):
    amps = 1e-9 * SLEW_V_PER_S
    return AMPLIFIER.format(
        low=low, high=high, r16=r16, r17=r17, r18=r18, amps=amps, linear=amps / (1e-9 * 2 * pi * GBW_HZ)
    )


def test_the_outputs_settle_to_one_code_within_20_us(tmp_path):
    code_v = 10.0 / 65536
    found = simulate(
        build_amplifier(0.0, 2.5), tmp_path, "tran 10n 60u", "meas tran last find v(out) at=59u",
        f"meas tran settled when v(out)={5.0 - code_v} rise=last", "meas tran over max v(out)",
    )  # fmt: skip
    assert abs(found["last"] - 5.0) < code_v
    assert found["over"] < 5.0 + code_v
    assert found["settled"] - 1e-6 < 20e-6


@pytest.mark.parametrize("signs", list(product((-1, 1), repeat=3)))
def test_the_ends_of_the_range_are_within_a_tenth_of_a_percent(tmp_path, signs):
    parts = {
        f"r{k}": ohms * (1 + 5e-4 * sign) for k, ohms, sign in zip((16, 17, 18), (1e4, 2e4, 2e4), signs, strict=True)
    }
    deck = build_amplifier(0.0, 2.5, **parts)
    found = simulate(
        deck, tmp_path, "tran 10n 60u", "meas tran low find v(out) at=0.9u", "meas tran high find v(out) at=59u"
    )
    assert abs(found["low"] + 5.0) <= 5e-3 * 1.01
    assert abs(found["high"] - 5.0) <= 5e-3 * 1.01
