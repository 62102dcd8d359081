"""The circuits around a Raspberry Pi Pico, each stated once: its parts and its nets.

ANALOG drives two galvo drivers by voltages, XY2_100 a digital scan head; all else is the same. Pin table, parts list
and drawing follow from them.

A net is a name and the pins on it, `REF.PIN`; a wire is one pin's place on its net. `faults.py` cuts each wire and
removes each supply in ngspice; `netlist.py` has SKiDL check the electrical rules and write KiCad's netlist.

What is less obvious in it:
- D3 lets U1 drive the laser's input high only. A U1 that has lost its GND pulls its low level up to 0.6 V.
- The laser's input has two pull-downs, one of them at its own connector: a cut cable or resistor leaves the other one.
- U1's enable is tied to GND; U4 tolerates 5 V at its input without a supply of its own.
- One line of each galvo input gets ±5 V and the other one GND: a driver for ILDA's ±10 V across the pair turns half
  of its angle then. Set its gain for it, or state the half as `scanner.range_rad`.
- U6 has 3.3 V because its output goes to the Pico, which does not take 5 V. R23 and R24 hold the line of an unplugged
  head high, which is no status.
"""

import re
from collections.abc import Iterator
from typing import NamedTuple


class Pin(NamedTuple):
    """A pin of a part. kind: of the electrical rules, as KiCad names them."""

    number: str
    name: str
    kind: str


class Part(NamedTuple):
    """A part of the circuit. order: what to order; price_eur: of one, about, in 2024."""

    value: str
    order: str
    footprint: str
    price_eur: float
    pins: tuple[Pin, ...]


def _part(value: str, order: str, footprint: str, price_eur: float, pins: str) -> Part:
    """Build a part from `number name kind` of its pins, separated by commas."""
    return Part(value, order, footprint, price_eur, tuple(Pin(*each.split()) for each in pins.split(",")))


def _resistor(value: str, order: str = "metal film, 0.25 W, 1 %", price_eur: float = 0.05) -> Part:
    return _part(value, order, "Resistor_THT:R_Axial_DIN0207", price_eur, "1 1 passive, 2 2 passive")


def _precise(value: str, order: str) -> Part:
    return _resistor(value, f"Susumu {order}, 0.05 %, 10 ppm/K", 1.2)


def _capacitor(value: str, order: str = "ceramic X7R or C0G, 50 V") -> Part:
    return _part(value, order, "Capacitor_THT:C_Disc_D5.0mm", 0.1, "1 1 passive, 2 2 passive")


def _diode(value: str) -> Part:
    return _part(value, value, "Diode_THT:D_DO-35_SOD27", 0.3, "1 K passive, 2 A passive")


def _contacts(value: str, order: str, price_eur: float) -> Part:
    pins = "11 A1 passive, 12 A2 passive, 21 B1 passive, 22 B2 passive"
    return _part(value, order, "Connector:Terminal_4", price_eur, pins)


def _transistor() -> Part:
    return _part("AO3400A", "AO3400A, or another whose R_DS(on) is stated at 2.5 V", "Package_TO_SOT_SMD:SOT-23", 0.3,
                 "1 G input, 2 S passive, 3 D passive")  # fmt: skip


class Circuit(NamedTuple):
    """A circuit. parts: by reference; nets: by name, each with its pins as `REF.PIN`; unconnected: pins that are free.

    supplies: nets that have a supply, each with the pin that gives it
    """

    name: str
    parts: dict[str, Part]
    nets: dict[str, list[str]]
    unconnected: tuple[str, ...]
    supplies: dict[str, str]

    def list_wires(self) -> Iterator[tuple[str, str]]:
        """Yield each wire: its net, and the pin that it connects."""
        for net, pins in self.nets.items():
            yield from ((net, pin) for pin in pins)

    def find_net(self, pin: str) -> str:
        """Return the net of a pin, empty for one that is free."""
        return next((net for net, pins in self.nets.items() if pin in pins), "")

    def check(self) -> list[str]:
        """Return what is wrong with the statement itself: unknown pins, pins twice or nowhere, a net of one pin."""
        stated = [pin for _, pin in self.list_wires()] + list(self.unconnected)
        real = {f"{reference}.{pin.name}" for reference, part in self.parts.items() for pin in part.pins}
        faults = [f"{pin}: no such pin" for pin in stated if pin not in real]
        faults += [f"{pin}: stated {stated.count(pin)} times" for pin in sorted(real) if stated.count(pin) != 1]
        return faults + [f"{net}: one pin" for net, pins in self.nets.items() if len(pins) < 2]


_COMMON_PARTS = {
    "A1": _part(
        "Raspberry Pi Pico", "SC0915", "Module:RaspberryPi_Pico", 4.0,
        "1 GP0 output, 2 GP1 input, 3 GND power_in, 4 GP2 input, 11 GP8 input, 12 GP9 input, 14 GP10 input, "
        "15 GP11 output, 16 GP12 output, 17 GP13 input, 19 GP14 output, 21 GP16 output, 22 GP17 output, "
        "24 GP18 output, 25 GP19 output, 26 GP20 input, 27 GP21 input, "
        "29 GP22 output, 36 3V3 power_out, 38 GND2 power_in, 39 VSYS power_in",
    ),
    "J1": _part(
        "FT232R adapter, 3.3 V, with DTR#", "SparkFun DEV-09873, or another FT232R module that has DTR#",
        "Connector:Header_6", 16.0,
        "1 DTR# output, 2 RXD input, 3 TXD output, 4 5V power_out, 5 CTS# input, 6 GND power_out",
    ),
    "U1": _part(
        "SN74AHCT125N", "SN74AHCT125N", "Package_DIP:DIP-14_W7.62mm", 0.6,
        "1 1OE# input, 2 1A input, 3 1Y tristate, 4 2OE# input, 5 2A input, 6 2Y tristate, 7 GND power_in, "
        "8 3Y tristate, 9 3A input, 10 3OE# input, 11 4Y tristate, 12 4A input, 13 4OE# input, 14 VCC power_in",
    ),
    "U4": _part(
        "SN74LVC1G17", "SN74LVC1G17DBVR", "Package_TO_SOT_SMD:SOT-23-5", 0.3,
        "2 A input, 3 GND power_in, 4 Y output, 5 VCC power_in",
    ),
    "K1": _part(
        "relay 12 V, two contacts", "Finder 40.52.9.012.0000, socket 95.05", "Relay_THT:Relay_DPDT_Finder_40.52", 9.0,
        "A1 COIL+ passive, A2 COIL- passive, 11 C1 passive, 14 NO1 passive",
    ),
    "Q1": _transistor(), "Q2": _transistor(),
    "D1": _diode("1N5711"), "D2": _diode("1N4148"), "D3": _diode("1N5711"),
    "S1": _contacts("emergency stop, two contacts that open", "Schneider XB4BS8444", 20.0),
    "S2": _contacts("key switch, two contacts", "Schneider XB4BG21 and a second contact ZBE101", 25.0),
    "S3": _contacts("interlock, two contacts that open", "a guard switch with two direct opening contacts", 40.0),
    "H1": _part("indicator lamp, 12 V, 20 mA", "an LED panel lamp for 12 V", "Connector:Terminal_2",
                8.0, "1 + passive, 2 - passive"),
    "X1": _part("laser driver", "yours", "Connector:Terminal_3", 0.0, "1 TTL input, 2 GND power_in, 3 VIN passive"),
    "R1": _resistor("4k7"), "R2": _resistor("100R"), "R3": _resistor("2k2"), "R4": _resistor("2k2"),
    "R5": _resistor("33k"), "R6": _resistor("1k"), "R7": _resistor("100k"), "R8": _resistor("1k"),
    "R9": _resistor("100k"), "R10": _resistor("1k"), "R11": _resistor("10k"), "R12": _resistor("1k"),
    "R13": _resistor("10k"), "R14": _resistor("1k"), "R15": _resistor("10k"),
    "C1": _capacitor("1n5", "ceramic C0G, 50 V, 5 %"), "C2": _capacitor("100n"), "C3": _capacitor("100n"),
    "C4": _capacitor("100n"), "C6": _capacitor("100n"), "C7": _capacitor("100n"), "C8": _capacitor("100n"),
}  # fmt: skip

_ANALOG_PARTS = {
    "U2": _part(
        "DAC8563", "DAC8563SDGSR on an MSOP-10 adapter", "Package_SO:MSOP-10_3x3mm", 14.0,
        "1 VOUTA output, 2 VOUTB output, 3 GND power_in, 4 LDAC# input, 5 CLR# input, 6 SYNC# input, 7 SCLK input, "
        "8 DIN input, 9 AVDD power_in, 10 VREF output",
    ),
    "U3": _part(
        "OPA2192", "OPA2192ID on an SOIC-8 adapter", "Package_SO:SOIC-8_3.9x4.9mm", 6.0,
        "1 OUTA output, 2 A- input, 3 A+ input, 4 V- power_in, 5 B+ input, 6 B- input, 7 OUTB output, 8 V+ power_in",
    ),
    "J2": _part("supply +12 V, ±12 V", "Mean Well RT-50B (5 V, ±12 V) or two bricks of 12 V", "Connector:Terminal_3",
                15.0, "1 +12V power_out, 2 GND passive, 3 -12V power_out"),
    "X2": _part("galvo driver X", "yours", "Connector:Terminal_3", 0.0, "1 X+ input, 2 X- input, 3 GND passive"),
    "X3": _part("galvo driver Y", "yours", "Connector:Terminal_3", 0.0, "1 Y+ input, 2 Y- input, 3 GND passive"),
    "R16": _precise("10k", "RG2012N-103-W-T1"), "R17": _precise("20k", "RG2012N-203-W-T1"),
    "R18": _precise("20k", "RG2012N-203-W-T1"), "R19": _precise("10k", "RG2012N-103-W-T1"),
    "R20": _precise("20k", "RG2012N-203-W-T1"), "R21": _precise("20k", "RG2012N-203-W-T1"),
    "C5": _capacitor("150n"), "C9": _capacitor("100n"), "C10": _capacitor("100n"),
}  # fmt: skip

_XY2_100_PARTS = {
    "U5": _part(
        "AM26LS31", "AM26LS31CN", "Package_DIP:DIP-16_W7.62mm", 1.5,
        "1 1A input, 2 1Y output, 3 1Z output, 4 G input, 5 2Z output, 6 2Y output, 7 2A input, 8 GND power_in, "
        "9 3A input, 10 3Y output, 11 3Z output, 12 G# input, 13 4Z output, 14 4Y output, 15 4A input, 16 VCC power_in",
    ),
    "U6": _part(
        "AM26LV32", "AM26LV32CD on an SOIC-16 adapter", "Package_SO:SOIC-16_3.9x9.9mm", 1.5,
        "1 1B input, 2 1A input, 3 1Y output, 4 G input, 5 2Y output, 6 2A input, 7 2B input, 8 GND power_in, "
        "9 3B input, 10 3A input, 11 3Y output, 12 G# input, 13 4Y output, 14 4A input, 15 4B input, 16 VCC power_in",
    ),
    "J2": _part("supply +12 V", "a brick of 12 V for relay, lamp and laser driver", "Connector:Terminal_2", 12.0,
                "1 +12V power_out, 2 GND passive"),
    "X2": _part(
        "scan head", "yours, with its own supply and its cable of twisted pairs", "Connector:DSUB-25", 0.0,
        "1 CLK- input, 2 SYNC- input, 3 X- input, 4 Y- input, 6 STATUS- output, 11 GND passive, 14 CLK+ input, "
        "15 SYNC+ input, 16 X+ input, 17 Y+ input, 19 STATUS+ output",
    ),
    "R22": _resistor("100R"), "R23": _resistor("680R"), "R24": _resistor("680R"), "C11": _capacitor("100n"),
}  # fmt: skip


def _split(nets: dict[str, str]) -> dict[str, list[str]]:
    return {name: pins.split() for name, pins in nets.items()}


_COMMON_NETS = {
    "GND": "A1.GND A1.GND2 J1.GND J1.CTS# U1.1OE# U1.GND U1.2OE# U1.2A U1.3OE# U1.3A U1.4OE# U1.4A U4.GND "
    "Q1.S Q2.S R1.2 R3.2 R5.2 R7.2 R9.2 R11.2 R13.2 R15.2 C1.2 C2.2 C3.2 C4.2 C6.2 C7.2 C8.2 J2.GND R4.2 X1.GND X2.GND",
    "5V": "J1.5V A1.VSYS U1.VCC C6.1",
    "3V3": "A1.3V3 U4.VCC S1.B1 S2.B1 S3.B1 C7.1 C8.1",
    "+12V": "J2.+12V S1.A1 K1.COIL+ D2.K H1.+",
    "TXD": "J1.TXD A1.GP1",
    "RXD": "J1.RXD A1.GP0",
    "DTR": "J1.DTR# A1.GP2",
    "GATE": "A1.GP14 R1.1 U1.1A",
    "GATE_5V": "U1.1Y D3.A",
    "GATE_HIGH": "D3.K R2.1",
    "TTL": "R2.2 R3.1 D1.A X1.TTL R4.1",
    "HELD": "D1.K R5.1 C1.1 U4.A",
    "READBACK": "U4.Y A1.GP13",
    "STOP_IN": "S1.B2 R10.1",
    "STOP": "R10.2 R11.1 C2.1 A1.GP8",
    "KEY_IN": "S2.B2 R12.1",
    "KEY": "R12.2 R13.1 C3.1 A1.GP9",
    "DOOR_IN": "S3.B2 R14.1",
    "DOOR": "R14.2 R15.1 C4.1 A1.GP10",
    "LAMP": "A1.GP11 R6.1",
    "LAMP_GATE": "R6.2 R7.1 Q1.G",
    "LAMP_LOW": "Q1.D H1.-",
    "RELAY": "A1.GP12 R8.1",
    "RELAY_GATE": "R8.2 R9.1 Q2.G",
    "RELAY_LOW": "Q2.D K1.COIL- D2.A",
    "STOPPED": "S1.A2 S3.A1",
    "CLOSED": "S3.A2 S2.A1",
    "KEYED": "S2.A2 K1.C1",
    "LASER_12V": "K1.NO1 X1.VIN",
}
"""The nets of both circuits. `GND` is one star at the laser driver."""

_ANALOG_NETS = {
    "GND": "U2.GND R18.2 R21.2 C5.2 C9.2 C10.2 X2.X- X3.Y- X3.GND",
    "3V3": "U2.AVDD U2.LDAC# U2.CLR#",
    "+12V": "U3.V+ C9.1",
    "-12V": "J2.-12V U3.V- C10.1",
    "SYNC": "A1.GP17 U2.SYNC#",
    "CLOCK": "A1.GP18 U2.SCLK",
    "DATA": "A1.GP19 U2.DIN",
    "VREF": "U2.VREF C5.1 R16.1 R19.1",
    "VOUT_X": "U2.VOUTA U3.A+",
    "VOUT_Y": "U2.VOUTB U3.B+",
    "SUM_X": "R16.2 R17.1 R18.1 U3.A-",
    "SUM_Y": "R19.2 R20.1 R21.1 U3.B-",
    "X": "U3.OUTA R17.2 X2.X+",
    "Y": "U3.OUTB R20.2 X3.Y+",
}

_XY2_100_NETS = {
    "GND": "U5.GND U5.G# U6.GND U6.G# R24.2 C11.2",
    "5V": "U5.VCC U5.G C11.1",
    "3V3": "U6.VCC U6.G R23.1",
    "CLOCK": "A1.GP16 U5.1A",
    "SYNC": "A1.GP17 U5.2A",
    "X": "A1.GP18 U5.3A",
    "Y": "A1.GP19 U5.4A",
    "CLOCK+": "U5.1Y X2.CLK+",
    "CLOCK-": "U5.1Z X2.CLK-",
    "SYNC+": "U5.2Y X2.SYNC+",
    "SYNC-": "U5.2Z X2.SYNC-",
    "X+": "U5.3Y X2.X+",
    "X-": "U5.3Z X2.X-",
    "Y+": "U5.4Y X2.Y+",
    "Y-": "U5.4Z X2.Y-",
    "STATUS+": "X2.STATUS+ R22.1 R23.2 U6.1A",
    "STATUS-": "X2.STATUS- R22.2 R24.1 U6.1B",
    "STATUS": "U6.1Y A1.GP21",
}


def _join(one: dict[str, str], other: dict[str, str]) -> dict[str, list[str]]:
    """Return the nets of both, a net of one name as one."""
    return _split({name: f"{one.get(name, '')} {other.get(name, '')}" for name in one | other})


_SPARE = ("A1.GP20", "A1.GP22", "U1.2Y", "U1.3Y", "U1.4Y")
"""Pins that are free in both: trigger, tick for an oscilloscope, spare drivers."""

ANALOG = Circuit(
    name="analog",
    parts=_COMMON_PARTS | _ANALOG_PARTS,
    nets=_join(_COMMON_NETS, _ANALOG_NETS),
    unconnected=(*_SPARE, "A1.GP16", "A1.GP21"),
    supplies={"5V": "J1.5V", "3V3": "A1.3V3", "+12V": "J2.+12V", "-12V": "J2.-12V"},
)
XY2_100 = Circuit(
    name="xy2-100",
    parts=_COMMON_PARTS | _XY2_100_PARTS,
    nets=_join(_COMMON_NETS, _XY2_100_NETS),
    unconnected=(*_SPARE, *(f"U6.{k}{pin}" for k in (2, 3, 4) for pin in "ABY")),
    supplies={"5V": "J1.5V", "3V3": "A1.3V3", "+12V": "J2.+12V"},
)
CIRCUITS = {circuit.name: circuit for circuit in (ANALOG, XY2_100)}

STATES = {
    "GP1": "no bytes, the lease lapses: gate off",
    "GP2": "pulled up: port closed, disarms",
    "GP8": "pulled down: FAULT ESTOP",
    "GP9": "pulled down: FAULT KEY",
    "GP10": "pulled down: FAULT INTERLOCK",
    "GP11": "lamp off",
    "GP12": "relay open",
    "GP13": "pulled up: FAULT READBACK",
    "GP14": "R1 to GND: gate off",
    "GP16": "the head decides",
    "GP17": "mirrors stay, or the head decides",
    "GP18": "mirrors stay, or the head decides",
    "GP19": "mirrors stay, or the head decides",
    "GP20": "pulled down: no edge",
    "GP21": "pulled down: FAULT HEAD",
}
"""What the board does at a pin of the Pico that nothing drives or whose wire is cut."""


def build_pin_table(circuit: Circuit) -> str:
    """Return the table of the Pico's pins: where each goes, and what an open wire means."""
    rows = ["| GPIO | Pico's pin | goes to | undriven or cut |", "|---|---|---|---|"]
    for pin in circuit.parts["A1"].pins:
        net = circuit.find_net(f"A1.{pin.name}")
        others = ", ".join(other for other in circuit.nets.get(net, ()) if not other.startswith("A1."))
        goes = f"{net}: {others}" if 0 < len(circuit.nets.get(net, ())) < 8 else net or "free"
        rows.append(f"| {pin.name} | {pin.number} | {goes} | {STATES.get(pin.name, '') if net else ''} |")
    return "\n".join(rows)


def build_parts_list(circuit: Circuit) -> str:
    """Return the table of parts: references, quantity, what to order, price."""
    groups: dict[tuple[str, str, float], list[str]] = {}
    for reference, part in circuit.parts.items():
        groups.setdefault((part.value, part.order, part.price_eur), []).append(reference)
    rows = ["| parts | n | value | order | € each |", "|---|---|---|---|---|"]
    for (value, order, price_eur), references in groups.items():
        shown = f"{price_eur:g}" if price_eur else ""
        rows.append(f"| {', '.join(references)} | {len(references)} | {value} | {order} | {shown} |")
    total_eur = sum(part.price_eur for part in circuit.parts.values())
    return "\n".join([*rows, f"| | {len(circuit.parts)} | | | {total_eur:.0f} in all |"])


ROW, BOX, GAP, PER_COLUMN = 16, 190, 110, 46


def draw(circuit: Circuit) -> str:
    """Return the drawing as SVG: each part a box with its pins, each pin with the name of its net."""
    boxes, column, y = [], 0, 0
    for reference, part in circuit.parts.items():
        rows = len(part.pins) + 2
        if y + rows > PER_COLUMN:
            column, y = column + 1, 0
        boxes.append((reference, part, 20 + column * (BOX + GAP), 20 + y * ROW))
        y += rows
    width, height = 20 + (column + 1) * (BOX + GAP), 40 + PER_COLUMN * ROW
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif"'
        ' font-size="11">',
        f"<title>Circuit of a Pico, {circuit.name}: parts, pins and nets</title>",
        f'<rect width="{width}" height="{height}" fill="white"/>',
    ]
    for reference, part, x, top in boxes:
        bottom = ROW * (len(part.pins) + 1)
        lines.append(f'<rect x="{x}" y="{top}" width="{BOX}" height="{bottom}" fill="#f4f4f4" stroke="black"/>')
        lines.append(
            f'<text x="{x + 4}" y="{top + 12}" font-weight="bold">{reference} {_escape(part.value[:26])}</text>'
        )
        for k, pin in enumerate(part.pins, 1):
            at, net = top + 12 + k * ROW, circuit.find_net(f"{reference}.{pin.name}") or "free"
            lines.append(f'<text x="{x + 4}" y="{at}">{pin.number}</text>')
            lines.append(f'<text x="{x + BOX - 4}" y="{at}" text-anchor="end">{_escape(pin.name)}</text>')
            lines.append(f'<path d="M{x + BOX} {at - 4}h18" stroke="black"/>')
            lines.append(f'<text x="{x + BOX + 21}" y="{at}" fill="#1a4f8a">{_escape(net)}</text>')
    return "\n".join([*lines, "</svg>", ""])


def _escape(text: str) -> str:
    return re.sub(r"[<>&]", lambda match: f"&#{ord(match[0])};", text)
