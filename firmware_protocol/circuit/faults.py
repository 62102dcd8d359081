"""Each wire cut and each supply missing, one at a time, in ngspice: what the laser's input gets, what the board reads.

Rows of the table are of a board whose gate is off: the Pico drives GP14 low, or not at all (reset). The input of the
laser must stay below OFF_MAX_V, or the laser must have no supply. Models are simple and pessimistic: a logic output
without a supply floats, one whose GND is cut pulls to what its other pins let it, an open input takes any level, and
the laser's input itself sources LEAK_A.
"""

import itertools
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from circuit import Circuit

OFF_MAX_V = 0.4
"""Largest voltage at the laser's input, above its GND, with the gate off: half of what TTL takes as low."""
LEAK_A = 1e-4
"""Current that the laser's input sources, worst of CMOS and TTL inputs with a pull-up of its own."""
RELAY_MIN_A = 0.03
"""Coil current below which the relay is open: its rated 54 mA release at a tenth, so this is pessimistic."""
SUPPLY_MIN_V = 1.0
HIGH_MIN_V, LOW_MAX_V = 2.0, 0.8
"""Levels of the Pico's inputs."""
INPUTS = {"STOP": "A1.GP8", "KEY": "A1.GP9", "DOOR": "A1.GP10"}

TERMINALS = {"R4.1": "X1.TTL"}
"""Pins that are soldered to a terminal of the laser: a wire that is cut there takes them along."""

MODELS = """
.model schottky d(is=315n n=2.03 rs=2.8 cjo=2p tt=1.4n)
.model silicon d(is=4n n=1.9 rs=0.6 cjo=4p tt=4n)
.model esd d(is=1f n=1 rs=5)
.model closed sw(vt=0.5 vh=0.01 ron=25 roff=1g)
.model channel sw(vt=1.5 vh=0.01 ron=0.1 roff=1g)
"""


class Outcome(NamedTuple):
    """What a fault does. ttl_v: at the laser's input; reads: levels at the Pico, V; coil_a, supply_v: of the laser."""

    fault: str
    ttl_v: float
    reads: dict[str, float]
    coil_a: float
    supply_v: float

    @property
    def is_dark(self) -> bool:
        """Whether the laser cannot emit."""
        return self.ttl_v <= OFF_MAX_V or self.notice != ""

    @property
    def notice(self) -> str:
        """What opens the laser's supply: the relay itself, or a fault that the board sees. Empty: nothing."""
        if self.supply_v < SUPPLY_MIN_V:
            return "relay open"
        for name, fault in (("STOP", "ESTOP"), ("KEY", "KEY"), ("DOOR", "INTERLOCK")):
            if self.reads[name] < HIGH_MIN_V:
                return f"FAULT {fault}"
        if self.reads["READBACK"] > LOW_MAX_V:
            return "FAULT READBACK"
        return "FAULT HEAD" if self.reads.get("HEAD", 0.0) > 0.0 else ""


def build_deck(circuit: Circuit, gate: str, cut: str = "", missing: str = "", rise_s: float = 0.0) -> str:
    """Build a circuit for ngspice. A scan head's line of status is high while GP14 is low.

    gate: of GP14: low, high, open, or a source of ngspice; cut: pin whose wire is cut; missing: net whose supply is;
    rise_s: time in which the supplies rise from 0, 0 if they stand
    """

    def node(pin: str) -> str:
        if cut in (pin, TERMINALS.get(pin)):
            return "cut"
        return next((_spell(net) for net, pins in circuit.nets.items() if pin in pins), _spell(pin))

    lost = "5V" if cut in ("A1.VSYS", "J1.5V") else missing  # the Pico is without supply then, too
    lines = ["circuit of a Pico", MODELS, "Rcut cut 0 1g"]
    for reference, part in circuit.parts.items():
        lines += _describe(reference, part.value.lower(), partial(_locate, node, reference), gate, lost)
    lines += [f"Rnet{k} {_spell(net)} 0 1g" for k, net in enumerate(circuit.nets) if net != "GND"]
    text = "\n".join([*lines, ".end", ""])
    return re.sub(r"^(V\w+ \w+ \w+) (-?[\d.]+)$", rf"\1 pwl(0 0 {rise_s} \2)", text, flags=re.M) if rise_s else text


def _locate(node: Callable[[str], str], reference: str, name: str) -> str:
    return node(f"{reference}.{name}")


def _spell(name: str) -> str:
    """Return a net's or a pin's name as ngspice takes it, GND as its node 0."""
    return "0" if name == "GND" else re.sub(r"[^0-9a-z]", "_", name.lower().replace("+", "p").replace("-", "m"))


def _describe(ref: str, value: str, at: Callable[[str], str], gate: str, missing: str) -> Iterator[str]:
    """Yield the model of a part. at: the node of one of its pins."""
    kind = ref[0]
    if kind == "R":
        yield f"{ref} {at('1')} {at('2')} {_read_ohms(value)}"
    elif kind == "C":
        yield f"{ref} {at('1')} {at('2')} {_read_farads(value)}"
    elif kind == "D":
        yield f"{ref} {at('A')} {at('K')} {'schottky' if value == '1n5711' else 'silicon'}"
    elif kind == "Q":
        yield f"S{ref} {at('D')} {at('S')} {at('G')} {at('S')} channel"
    elif kind == "S":
        yield from (f"R{ref}{pole} {at(pole + '1')} {at(pole + '2')} 0.05" for pole in "AB")
    elif ref == "K1":
        yield f"Rcoil {at('COIL+')} coil 220"
        yield f"Vcoil coil {at('COIL-')} 0"
        yield f"Bcontact contact {at('C1')} i = i(vcoil) > {RELAY_MIN_A} ? -v({at('C1')},contact)/0.05 : -1n"
        yield f"Rcontact contact {at('NO1')} 0.05"
    elif ref == "H1":
        yield f"Rlamp {at('+')} {at('-')} 600"
    elif ref in ("U1", "U4"):
        yield from _describe_buffer(ref, at)
    elif ref == "U5":
        yield from _describe_line_driver(ref, at)
    elif ref == "U6":
        yield from _describe_line_receiver(ref, at)
    elif ref == "U3":
        for side in "AB":
            yield f"B{ref}{side} {ref}{side} 0 v = v({at('V+')}) > 5 ? 1e5*v({at(side + '+')},{at(side + '-')}) : 0"
            yield f"R{ref}{side} {ref}{side} {at('OUT' + side)} 100"
    elif ref == "U2":
        yield f"V{ref}r {at('VREF')} {at('GND')} 2.5"
        yield from (f"V{ref}{side} {at('VOUT' + side)} {at('GND')} 1.25" for side in "AB")
    elif ref == "J1":
        yield _describe_supply("5v", at("5V"), at("GND"), 5.0, missing == "5V")
    elif ref == "J2":
        yield _describe_supply("p12v", at("+12V"), at("GND"), 12.0, missing == "+12V")
        if value != "supply +12 v":
            yield _describe_supply("m12v", at("-12V"), at("GND"), -12.0, missing == "-12V")
    elif ref == "A1":
        yield from _describe_pico(at, gate, missing)
    elif ref == "X2" and value == "scan head":
        yield from _describe_head(at, gate)
    elif ref == "X1":  # the driver's own GND is that of its supply: without it, it has none
        yield f"Rlaser {at('VIN')} {at('GND')} 100"
        yield f"Ileak {at('GND')} {at('TTL')} {LEAK_A}"


def _describe_supply(name: str, node: str, ground: str, volts: float, is_missing: bool) -> str:
    return f"Rmissing{name} {node} {ground} 1meg" if is_missing else f"V{name} {node} {ground} {volts}"


def _describe_buffer(ref: str, at: Callable[[str], str]) -> Iterator[str]:
    """Yield a buffer whose levels are those of its own supply pins. Its inputs hold its GND by their clamps."""
    source, enable, output = ("1A", "1OE#", "1Y") if ref == "U1" else ("A", "", "Y")
    vcc, ground, inside = at("VCC"), at("GND"), f"{ref.lower()}g"
    yield f"R{ref}g {ground} {inside} 0.05"
    yield f"R{ref}q {vcc} {inside} 3.3k"  # its own current, pessimistic
    on = f"v({vcc},{inside}) > 1.5 ? 1 : 0"
    level = f"v({at(source)},{inside}) > 1.5 ? 1 : 0"
    off = f"(v({at(enable)},{inside}) > 1.5 ? 1 : 0)" if enable else "0"
    yield f"B{ref}h {ref}h 0 v = ({on})*({level})*(1-{off})"
    yield f"B{ref}l {ref}l 0 v = ({on})*(1-({level}))*(1-{off})"
    yield f"S{ref}h {vcc} {at(output)} {ref}h 0 closed"
    yield f"S{ref}l {at(output)} {inside} {ref}l 0 closed"
    for k, pin in enumerate(filter(None, (source, enable, output))):
        yield f"D{ref}c{k} {inside} {at(pin)} esd"
    yield f"R{ref}i {at(source)} {inside} 10meg"


def _describe_line_driver(ref: str, at: Callable[[str], str]) -> Iterator[str]:
    """Yield an AM26LS31, whose inputs are low here and which draws 80 mA; its pins hold its GND by their clamps."""
    vcc, inside = at("VCC"), f"{ref.lower()}g"
    yield f"R{ref}g {at('GND')} {inside} 0.05"
    yield f"R{ref}q {vcc} {inside} 62"
    for k in "1234":
        yield f"R{ref}{k}z {vcc} {at(k + 'Z')} 100"
        yield f"R{ref}{k}y {at(k + 'Y')} {inside} 25"
        yield f"R{ref}{k}a {at(k + 'A')} {vcc} 15k"
        yield from (f"D{ref}{k}{pin} {inside} {at(k + pin)} esd" for pin in "AYZ")


def _describe_line_receiver(ref: str, at: Callable[[str], str]) -> Iterator[str]:
    """Yield an AM26LV32 with a threshold of 0.2 V, whose output of an undecided line is the wrong one."""
    vcc, inside = at("VCC"), f"{ref.lower()}g"
    yield f"R{ref}g {at('GND')} {inside} 0.05"
    yield f"R{ref}q {vcc} {inside} 200"
    on = f"(v({vcc},{inside}) > 1.5 ? 1 : 0)*(v({at('G')},{inside}) > 1.5 ? 1 : 0)"
    yield f"B{ref}h {ref}h 0 v = {on}*(v({at('1A')},{at('1B')}) > 0.2 ? 1 : 0)"
    yield f"B{ref}l {ref}l 0 v = {on}*(v({at('1A')},{at('1B')}) > 0.2 ? 0 : 1)"
    yield f"S{ref}h {vcc} {at('1Y')} {ref}h 0 closed"
    yield f"S{ref}l {at('1Y')} {inside} {ref}l 0 closed"
    yield from (f"R{ref}{pin} {at(pin)} {inside} 12k" for pin in ("1A", "1B"))
    yield from (f"D{ref}{pin.strip('#')} {inside} {at(pin)} esd" for pin in ("1Y", "G"))


def _describe_head(at: Callable[[str], str], gate: str) -> Iterator[str]:
    """Yield a scan head: 100 Ω across each pair that it receives, and its status of 3 V across that pair."""
    yield from (f"Rhead{name.lower()} {at(name + '+')} {at(name + '-')} 100" for name in ("CLK", "SYNC", "X", "Y"))
    high, low = (3.5, 0.5) if gate == "low" else (0.5, 3.5)
    yield f"Vstatusp headp {at('GND')} {high}"
    yield f"Vstatusm headm {at('GND')} {low}"
    yield f"Rstatusp headp {at('STATUS+')} 25"
    yield f"Rstatusm headm {at('STATUS-')} 25"


def _describe_pico(at: Callable[[str], str], gate: str, missing: str) -> Iterator[str]:
    """Yield the Pico: its supply, GP14 as `gate` says, relay closed, lamp on, inputs with their pulls."""
    yield f"Rgnd {at('GND')} pico 0.05"
    yield f"Rgnd2 {at('GND2')} pico 0.05"
    lacks = missing in ("5V", "3V3")
    yield _describe_supply("3v3", "core", "pico", 3.3, lacks)
    yield f"R3v3 core {at('3V3')} 0.1"
    yield f"Rvsys {at('VSYS')} pico 1k"
    levels = {"low": "0", "high": "3.3"}
    if gate != "open" and not lacks:
        yield f"Vgate gate_pin pico {levels.get(gate, gate)}"
        yield f"Rgate gate_pin {at('GP14')} 30"
    for name in ("GP11", "GP12"):
        yield f"R{name} {'pico' if lacks else 'core'} {at(name)} 30"
    for name in ("GP8", "GP9", "GP10"):
        yield f"R{name} {at(name)} pico 60k"
    yield f"RGP13 {at('GP13')} core 60k"
    yield f"RGP21 {at('GP21')} pico 60k"
    if gate != "open" and not lacks:
        yield from (f"RGP{k} {at(f'GP{k}')} pico 30" for k in (16, 17, 18, 19))


def _read_ohms(value: str) -> float:
    whole, unit, rest = re.fullmatch(r"(\d+)([kr])(\d*)", value).groups()
    return float(f"{whole}.{rest or 0}") * {"k": 1e3, "r": 1.0}[unit]


def _read_farads(value: str) -> float:
    whole, rest = re.fullmatch(r"(\d+)n(\d*)", value).groups()
    return float(f"{whole}.{rest or 0}") * 1e-9


def run_ngspice(decks: list[str]) -> list[dict[str, float]]:
    """Return the voltages and currents of each deck's operating point, by ngspice's names."""
    with tempfile.TemporaryDirectory() as name:
        folder, script = Path(name), [".control", "set numdgt=7"]
        for k, deck in enumerate(decks):
            (folder / f"{k}.cir").write_text(deck)
            script += [f"source {folder}/{k}.cir", "op", f"echo deck {k}", "print all"]
        (folder / "all.cir").write_text("\n".join(["all", *script, "quit", ".endc", ".end", ""]))
        ngspice = shutil.which("ngspice") or "ngspice"
        ran = subprocess.run([ngspice, "-b", folder / "all.cir"], capture_output=True, text=True, check=False)
    results: list[dict[str, float]] = [{} for _ in decks]
    at = -1
    for line in ran.stdout.splitlines():
        if found := re.fullmatch(r"deck (\d+)", line.strip()):
            at = int(found[1])
        elif (found := re.fullmatch(r"(?:v\()?([^\s()]+)\)? = (\S+)", line.strip())) and at >= 0:
            results[at][found[1]] = float(found[2])
    if not all(results):
        raise RuntimeError(f"ngspice found no operating point of {results.count({})} decks: {ran.stderr[-500:]}")
    return results


def list_outcomes(circuit: Circuit, nets: Collection[str] = ()) -> list[Outcome]:
    """Return the outcome of every single fault: the worse of a GP14 that is low and one that is open.

    nets: where wires are cut, all if empty
    """
    faults = [("nothing", "", "")]
    faults += [(f"wire {pin} ({net})", pin, "") for net, pin in circuit.list_wires() if not nets or net in nets]
    faults += [(f"supply {net}", "", net) for net in circuit.supplies]
    cases = list(itertools.product(faults, ("low", "open")))
    results = run_ngspice([build_deck(circuit, gate, cut, missing) for (_, cut, missing), gate in cases])
    outcomes = [_read(circuit, name, cut, each) for ((name, cut, _), _), each in zip(cases, results, strict=True)]
    pairs = [_judge_status(*pair) for pair in zip(outcomes[::2], outcomes[1::2], strict=True)]
    return [max(pair, key=lambda outcome: (not outcome.is_dark, outcome.ttl_v)) for pair in pairs]


def _judge_status(high: Outcome, low: Outcome) -> tuple[Outcome, Outcome]:
    """Note in both whether the Pico lacks the status of a head whose line was high in one, and low in the other."""
    if "STATUS" in high.reads:
        is_lost = high.reads["STATUS"] < HIGH_MIN_V or low.reads["STATUS"] > LOW_MAX_V
        for outcome in (high, low):
            outcome.reads["HEAD"] = float(is_lost)
    return high, low


def _read(circuit: Circuit, fault: str, cut: str, volts: dict[str, float]) -> Outcome:
    def at(pin: str, net: str) -> float:
        return volts["cut" if pin == cut else _spell(net)]

    ground = volts["cut"] if cut == "X1.GND" else 0.0
    inputs = INPUTS | {"READBACK": "A1.GP13"} | ({"STATUS": "A1.GP21"} if "STATUS" in circuit.nets else {})
    reads = {name: at(pin, name) for name, pin in inputs.items()}
    ttl_v, supply_v = at("X1.TTL", "TTL") - ground, at("X1.VIN", "LASER_12V") - ground
    return Outcome(fault, ttl_v, reads, volts["vcoil#branch"], supply_v)
