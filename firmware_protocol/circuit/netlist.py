"""Check a circuit's electrical rules by SKiDL and write KiCad's netlist.

python firmware_protocol/circuit/netlist.py analog|xy2-100 FILE.net
"""

import logging
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parent))

from circuit import CIRCUITS, Circuit


def build_skidl(circuit: Circuit) -> Any:
    """Return a circuit as SKiDL's. SKiDL writes its log files into the current folder."""
    logging.getLogger().handlers.clear()
    import skidl

    types = skidl.Pin.types
    kinds = {"input": types.INPUT, "output": types.OUTPUT, "passive": types.PASSIVE, "tristate": types.TRISTATE}
    kinds |= {"power_in": types.PWRIN, "power_out": types.PWROUT}
    built, parts = skidl.Circuit(), {}
    for reference, part in circuit.parts.items():
        pins = [skidl.Pin(num=pin.number, name=pin.name, func=kinds[pin.kind]) for pin in part.pins]
        parts[reference] = skidl.Part(
            name=part.value, ref=reference, value=part.value, tool=skidl.SKIDL, dest=skidl.NETLIST, pins=pins,
            footprint=part.footprint, circuit=built,
        )  # fmt: skip
    for net, names in circuit.nets.items():
        joined = skidl.Net(net, circuit=built)
        for pin in names:
            joined += _find_pin(parts, pin)
        if net == "GND":
            joined.drive = skidl.POWER
    for pin in circuit.unconnected:
        _find_pin(parts, pin).func = types.NOCONNECT
    return built


def _find_pin(parts: dict[str, Any], pin: str) -> Any:
    reference, _, name = pin.partition(".")
    return next(each for each in parts[reference].pins if each.name == name)


def check_rules(built: Any) -> tuple[int, int]:
    """Return the number of errors and warnings that SKiDL's electrical rules find."""
    import skidl

    built.ERC()
    return skidl.erc_logger.error.count, skidl.erc_logger.warning.count


def build_netlist(built: Any) -> str:
    """Return KiCad's netlist."""
    import skidl

    return str(built.generate_netlist(tool=skidl.KICAD9))


def main() -> int:
    """Write the file; return status 2 for other options, 1 if a rule is broken."""
    if len(sys.argv) != 3 or sys.argv[1] not in CIRCUITS:
        given = " ".join(sys.argv[1:]) or "nothing"
        sys.stderr.write(f"options: got {given}, expected: {'|'.join(CIRCUITS)} FILE.net\n")
        return 2
    target, sys.argv[1:] = Path(sys.argv[2]).absolute(), [sys.argv[1]]
    circuit = CIRCUITS[sys.argv[1]]
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        built = build_skidl(circuit)
        errors, warnings = check_rules(built)
        if errors or warnings:
            sys.stderr.write(f"{circuit.name}: {errors} errors and {warnings} warnings of the electrical rules\n")
            return 1
        target.write_text(build_netlist(built))
        os.chdir(target.parent)
    sys.stdout.write(f"{target}: {len(circuit.parts)} parts, {len(circuit.nets)} nets, no rule broken\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
