"""Writes core/messages.h from messages.toml; run it as a script after the table has changed."""

import tomllib
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
SIZES = {"u8": 1, "u16": 2, "u32": 4, "u64": 8, "i16": 2, "bytes12": 12}
ENUMERATIONS = {"state": "STATE", "fault": "FAULT", "nak_reason": "NAK", "reason": "REASON"}
Table = dict[str, Any]


def header(table: Table) -> str:
    """The C header of the whole table: numbers, enumerations, layouts, limits, forms of bodies."""
    parts = [
        "/* Generated from messages.toml by generate.py: do not edit. PROTOCOL.md says what the messages mean. */",
        "#ifndef MESSAGES_H\n#define MESSAGES_H",
        numbers(table),
        *(enumeration(prefix, table["enumerations"][name]) for name, prefix in ENUMERATIONS.items()),
        input_bits(table["enumerations"]["input_bit"]),
        "\n".join(f"#define MESSAGE_{entry['name']} 0x{entry['id']:02x}" for entry in table["message"]),
        "\n\n".join(layout(entry["name"].upper(), entry["fields"], table) for entry in table["message"]),
        "\n\n".join(layout(name.upper(), fields, table) for name, fields in table["struct"].items()),
        limits(table["struct"]["limits"]),
        forms(table),
        "#endif",
    ]
    return "\n\n".join(parts) + "\n"


def numbers(table: Table) -> str:
    """Protocol version, framing and timing as defines."""
    frame = table["frame"]
    values = {f"PROTOCOL_{name.upper()}": value for name, value in table["protocol"].items()}
    values |= {"RAW_MAX": frame["raw_max"], "RX_WINDOW": frame["window"], "SEQ_MODULUS": frame["seq_modulus"]}
    values |= {name.upper(): value for name, value in table["timing"].items()}
    for entry in table["message"]:
        if "repeat" in entry:
            values[f"{entry['name']}_ITEMS_MAX"] = entry["repeat"]["max"]
    return "\n".join(f"#define {name} {value}u" for name, value in values.items())


def enumeration(prefix: str, words: list[str]) -> str:
    """An enum, its count, and its names as the initialiser of an array of strings."""
    lines = [f"    {prefix}_{(word or 'none').replace(' ', '_').upper()} = {k}," for k, word in enumerate(words)]
    names = ", ".join(f'"{word}"' for word in words)
    listed = "\n".join(lines)
    defines = f"#define {prefix}_COUNT {len(words)}u\n#define {prefix}_NAMES {{{names}}}"
    return f"enum {prefix.lower()} {{\n{listed}\n}};\n{defines}"


def input_bits(words: list[str]) -> str:
    """The inputs' bits and names."""
    lines = [f"#define INPUT_{word.upper()} {1 << k}u" for k, word in enumerate(words)]
    names = ", ".join(f'"{word}"' for word in words)
    return "\n".join([*lines, f"#define INPUT_COUNT {len(words)}u", f"#define INPUT_NAMES {{{names}}}"])


def size(fields: list[Table], table: Table, repeats: bool) -> int:
    """Bytes of fields; of a repeated last one nothing."""
    counted = fields[:-1] if repeats else fields
    return sum(SIZES.get(entry["type"]) or size(table["struct"][entry["type"]], table, False) for entry in counted)


def layout(name: str, fields: list[Table], table: Table) -> str:
    """NAME_FIELD_AT for each field and NAME_SIZE, without what is repeated."""
    repeats = any(entry.get("repeat") and entry["name"] == name for entry in table["message"])
    lines = [
        f"#define {name}_{entry['name'].upper()}_AT {size(fields[:k], table, False)}u" for k, entry in enumerate(fields)
    ]
    return "\n".join([*lines, f"#define {name}_SIZE {size(fields, table, repeats)}u"])


def limits(fields: list[Table]) -> str:
    """F(name, bits, offset, way) for each limit; way: LESS or MORE is tighter, or FIXED."""
    lines, at = [], 0
    for entry in fields:
        lines.append(f"    F({entry['name']}, {8 * SIZES[entry['type']]}, {at}, {entry['tighter'].upper()})")
        at += SIZES[entry["type"]]
    return "#define LIMITS_FIELDS(F) \\\n" + " \\\n".join(lines)


def forms(table: Table) -> str:
    """What a frame of each type must be: F(type, from host, sequenced, body, item, most items, three enumerations)."""
    lines = [
        "/* F(type, from_host, sequenced, body bytes, bytes an item, most items, offset and count of up to three",
        "   enumerations in the body; count 0: none) */",
        "#define MESSAGE_FORMS(F) \\",
    ]
    rows = []
    for entry in table["message"]:
        fields, repeat = entry["fields"], entry.get("repeat")
        item = size(table["struct"][fields[-1]["type"]], table, False) if repeat else 0
        named = [(k, field["enum"]) for k, field in enumerate(fields) if "enum" in field]
        enums = [f"{size(fields[:k], table, False)}, {ENUMERATIONS[name]}_COUNT" for k, name in named]
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
    text = header(tomllib.loads((HERE / "messages.toml").read_text(encoding="utf-8")))
    (HERE / "core" / "messages.h").write_text(text, encoding="utf-8")
