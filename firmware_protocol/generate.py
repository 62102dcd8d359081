"""Generate header, model, the states of Python and web page, and PROTOCOL.md's transitions from messages.toml."""

import tomllib
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
PAGE = HERE.parent / "optodrive" / "daemon" / "page"
STATES_MODULE = HERE.parent / "optodrive" / "link" / "protocol" / "state_table.py"
BEGIN, END = "<!-- transitions of messages.toml -->\n", "<!-- end of the transitions -->\n"
SIZES = {"u8": 1, "u16": 2, "u32": 4, "u64": 8, "i16": 2, "bytes12": 12}
PREFIXES = {"state": "STATE", "fault": "FAULT", "nak_reason": "NAK", "reason": "REASON"}
Table = dict[str, Any]


def build_header(table: Table) -> str:
    """Return the C header of the whole table: numbers, enumerations, transitions, layouts and limits."""
    parts = [
        "/* Generated from messages.toml by generate.py: do not edit. PROTOCOL.md defines the messages. */",
        "#ifndef MESSAGES_H\n#define MESSAGES_H",
        format_numbers(table),
        *(format_enumeration(prefix, table["enumerations"][name]) for name, prefix in PREFIXES.items()),
        format_state_groups(table["state_group"]),
        format_transitions(table),
        format_input_bits(table["enumerations"]["input_bit"]),
        "\n".join(f"#define MESSAGE_{entry['name']} 0x{entry['id']:02x}" for entry in table["message"]),
        "\n\n".join(format_offsets(entry["name"].upper(), entry["fields"], table) for entry in table["message"]),
        "\n\n".join(format_offsets(name.upper(), fields, table) for name, fields in table["struct"].items()),
        format_limits(table["struct"]["limits"]),
        format_layouts(table),
        "#endif",
    ]
    return "\n\n".join(parts) + "\n"


def build_page_module(table: Table) -> str:
    """Return the JavaScript module of the board's states, groups of states and inputs."""
    states = table["enumerations"]["state"]
    lines = [
        "// Generated from firmware_protocol/messages.toml by generate.py: do not edit.",
        "",
        "export const BoardState = Object.freeze({",
        *(f'  {state}: "{state}",' for state in states),
        "});",
    ]
    for name, members in table["state_group"].items():
        listed = ", ".join(f"BoardState.{state}" for state in members)
        lines += ["", f"export const {name.upper()}_STATES = Object.freeze([{listed}]);"]
    inputs = ", ".join(f'"{word}"' for word in table["enumerations"]["input_bit"])
    lines += ["", "// The inputs by bit, bit 0 first.", f"export const INPUTS = Object.freeze([{inputs}]);"]
    return "\n".join(lines) + "\n"


def build_model_table(table: Table) -> str:
    """Return the transitions between the states of the SPIN model, which has no BOOT, as a condition."""
    pairs = {(state, entry["to"]): None for entry in table["transition"] for state in entry["from"] if state != "BOOT"}
    rows = " || \\\n".join(f"    (from == {state} && to == {to})" for state, to in pairs)
    return (
        "/* Generated from messages.toml by generate.py: do not edit. */\n"
        f"#define IS_TRANSITION(from, to) ( \\\n{rows})\n"
    )


def format_numbers(table: Table) -> str:
    """Return the protocol version, the framing and the timing as defines."""
    frame = table["frame"]
    values = {f"PROTOCOL_{name.upper()}": value for name, value in table["protocol"].items()}
    values |= {"RAW_MAX": frame["raw_max"], "RX_WINDOW": frame["window"], "SEQ_MODULUS": frame["seq_modulus"]}
    values |= {name.upper(): value for name, value in table["timing"].items()}
    for entry in table["message"]:
        if "repeat" in entry:
            values[f"{entry['name']}_ITEMS_MAX"] = entry["repeat"]["max"]
    return "\n".join(f"#define {name} {value}u" for name, value in values.items())


def constant_name(prefix: str, word: str) -> str:
    """Return the C constant of an enumeration's word."""
    return f"{prefix}_{(word or 'none').replace(' ', '_').upper()}"


def format_enumeration(prefix: str, words: list[str]) -> str:
    """Return an enum, its count, and its names as the initialiser of an array of strings."""
    lines = [f"    {constant_name(prefix, word)} = {k}," for k, word in enumerate(words)]
    names = ", ".join(f'"{word}"' for word in words)
    listed = "\n".join(lines)
    defines = f"#define {prefix}_COUNT {len(words)}u\n#define {prefix}_NAMES {{{names}}}"
    return f"enum {prefix.lower()} {{\n{listed}\n}};\n{defines}"


def format_state_groups(groups: dict[str, list[str]]) -> str:
    """Return each group of states as a mask with one bit per state."""
    lines = []
    for name, states in groups.items():
        bits = " | ".join(f"1u << {constant_name('STATE', state)}" for state in states)
        lines.append(f"#define STATES_{name.upper()} ({bits})")
    return "\n".join(lines)


def list_transitions(table: Table) -> dict[tuple[str, str], Table]:
    """Return the entry of each state and event, once where several conditions cause the event."""
    found: dict[tuple[str, str], Table] = {}
    for entry in table["transition"]:
        for state in entry["from"]:
            known = found.setdefault((state, entry["event"]), entry)
            if (known["to"], known["drops"]) != (entry["to"], entry["drops"]):
                raise ValueError(f"{entry['event']} in {state}: two entries differ, expected one state and one effect")
    return found


def format_transitions(table: Table) -> str:
    """Return T(from, event, to, drops) of each transition; an event is the reason in EVENT."""
    rows = [
        f"    T({constant_name('STATE', state)}, {constant_name('REASON', event)},"
        f" {constant_name('STATE', entry['to'])}, {int(entry['drops'])})"
        for (state, event), entry in list_transitions(table).items()
    ]
    return "#define STATE_TRANSITIONS(T) \\\n" + " \\\n".join(rows)


def build_states_module(table: Table) -> str:
    """Return the Python module of states, events, groups of states and transitions."""
    states, events = table["enumerations"]["state"], table["enumerations"]["reason"]
    names = {event: event.replace(" ", "_").upper() or "NONE" for event in events}
    lines = [
        '"""Generated from firmware_protocol/messages.toml by generate.py: do not edit."""',
        "",
        "from enum import StrEnum",
        "from typing import NamedTuple",
        "",
        "",
        "class BoardState(StrEnum):",
        '    """A state of the board, in the order of its number on the wire."""',
        "",
        *(f'    {state} = "{state}"' for state in states),
        "",
        "",
        "class EventReason(StrEnum):",
        '    """An event of the state machine, as EVENT reports it, in the order of its number on the wire."""',
        "",
        *(f'    {names[event]} = "{event}"' for event in events),
        "",
        "",
        "class Transition(NamedTuple):",
        '    """State that an event leads to, and whether queue and job are dropped."""',
        "",
        "    to: BoardState",
        "    drops: bool",
        "",
        "",
    ]
    for name, members in table["state_group"].items():
        listed = ", ".join(f"BoardState.{state}" for state in members)
        lines.append(f"{name.upper()}_STATES = ({listed})")
    lines.append("TRANSITIONS = {")
    for (state, event), entry in list_transitions(table).items():
        after = f"Transition(BoardState.{entry['to']}, drops={entry['drops']})"
        lines.append(f"    (BoardState.{state}, EventReason.{names[event]}): {after},")
    return "\n".join([*lines, "}"]) + "\n"


def build_protocol_page(table: Table, page: str) -> str:
    """Return PROTOCOL.md with the table of transitions."""
    before, _, rest = page.partition(BEGIN)
    states = [state for state in table["enumerations"]["state"] if state != "FAULT"]
    rows = ["| from | on | to | reason | drops queue and job |", "|---|---|---|---|---|"]
    for entry in table["transition"]:
        listed = "any but FAULT" if entry["from"] == states else ", ".join(entry["from"])
        drops = "yes" if entry["drops"] else ""
        rows.append(f"| {listed} | {entry['when']} | {entry['to']} | {entry['event']} | {drops} |")
    return before + BEGIN + "\n" + "\n".join(rows) + "\n\n" + END + rest.partition(END)[2]


def format_input_bits(words: list[str]) -> str:
    """Return the bits and names of the inputs."""
    lines = [f"#define INPUT_{word.upper()} {1 << k}u" for k, word in enumerate(words)]
    names = ", ".join(f'"{word}"' for word in words)
    return "\n".join([*lines, f"#define INPUT_COUNT {len(words)}u", f"#define INPUT_NAMES {{{names}}}"])


def count_bytes(fields: list[Table], table: Table, repeats: bool) -> int:
    """Return the number of bytes of fields, without a repeated last one."""
    fixed = fields[:-1] if repeats else fields
    return sum(SIZES.get(entry["type"]) or count_bytes(table["struct"][entry["type"]], table, False) for entry in fixed)


def format_offsets(name: str, fields: list[Table], table: Table) -> str:
    """Return NAME_FIELD_AT of each field and NAME_SIZE, without the repeated part."""
    repeats = any(entry.get("repeat") and entry["name"] == name for entry in table["message"])
    lines = [
        f"#define {name}_{entry['name'].upper()}_AT {count_bytes(fields[:k], table, False)}u"
        for k, entry in enumerate(fields)
    ]
    return "\n".join([*lines, f"#define {name}_SIZE {count_bytes(fields, table, repeats)}u"])


def format_limits(fields: list[Table]) -> str:
    """Return F(name, bits, offset, direction) of each limit; direction: LESS or MORE is tighter, or FIXED."""
    lines, at = [], 0
    for entry in fields:
        lines.append(f"    F({entry['name']}, {8 * SIZES[entry['type']]}, {at}, {entry['tighter'].upper()})")
        at += SIZES[entry["type"]]
    return "#define LIMITS_FIELDS(F) \\\n" + " \\\n".join(lines)


def format_layouts(table: Table) -> str:
    """Return the layout of each message: direction, sequencing, size, repeated items and enumerated fields."""
    lines = [
        "/* F(type, from_host, sequenced, bytes of the body, bytes per item, maximum number of items, then offset and",
        "   count of up to three enumerations in the body; count 0: none) */",
        "#define MESSAGE_LAYOUTS(F) \\",
    ]
    rows = []
    for entry in table["message"]:
        fields, repeat = entry["fields"], entry.get("repeat")
        item = count_bytes(table["struct"][fields[-1]["type"]], table, False) if repeat else 0
        named = [(k, field["enum"]) for k, field in enumerate(fields) if "enum" in field]
        enums = [f"{count_bytes(fields[:k], table, False)}, {PREFIXES[name]}_COUNT" for k, name in named]
        columns = [
            f"MESSAGE_{entry['name']}",
            str(int(entry["from"] == "host")),
            str(int(entry["sequenced"])),
            f"{entry['name']}_SIZE",
            str(item),
            str(repeat["max"] if repeat else 0),
            *enums,
            *["0, 0"] * (3 - len(enums)),
        ]
        rows.append(f"    F({', '.join(columns)})")
    return "\n".join(lines) + "\n" + " \\\n".join(rows)


if __name__ == "__main__":
    messages = tomllib.loads((HERE / "messages.toml").read_text(encoding="utf-8"))
    (HERE / "core" / "messages.h").write_text(build_header(messages), encoding="utf-8")
    (HERE / "model" / "transitions.pml").write_text(build_model_table(messages), encoding="utf-8")
    (PAGE / "board_states.js").write_text(build_page_module(messages), encoding="utf-8")
    STATES_MODULE.write_text(build_states_module(messages), encoding="utf-8")
    protocol = HERE / "PROTOCOL.md"
    protocol.write_text(build_protocol_page(messages, protocol.read_text(encoding="utf-8")), encoding="utf-8")
