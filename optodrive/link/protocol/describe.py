"""Human-readable form of messages: names for enumerations, units for numbers."""

from dataclasses import fields
from typing import Any

from optodrive.link.protocol import messages as m

DUTY_MAX = 65535
RESET_CAUSES = ("power-up", "reset", "brown-out", "watchdog")
DUTY_FIELDS = ("max_duty", "mean_duty")
NONCE_FIELDS = ("host_nonce", "board_nonce", "host_t")


def describe_reset_cause(code: int) -> str:
    """Return the cause of the board's last start as a word, or the number of an unknown cause."""
    return RESET_CAUSES[code] if code < len(RESET_CAUSES) else f"unknown cause {code}"


def describe(message: m.Message) -> dict[str, Any]:
    """Return the fields of a message by name.

    Enumerations become words and nonces become hex strings. Units are part of the names. Points and records become
    columns.
    """
    if isinstance(message, m.Data):
        return {"first_index": message.first_index, **_describe_points(message)}
    if isinstance(message, m.Executed):
        return {"first_index": message.first_index, **_describe_records(message)}
    described: dict[str, Any] = {}
    for item in fields(message):  # type: ignore[arg-type]
        described.update(_describe_field(message, item.name))
    return described


def _describe_field(message: m.Message, name: str) -> dict[str, Any]:
    value, names = getattr(message, name), message.ENUMS.get(name)
    if names is not None:
        return {name: names[value] or None}
    if isinstance(value, m.Limits):
        return {name: describe(value)}
    if isinstance(value, bytes):
        return {name: value.hex()}
    if name in NONCE_FIELDS:
        return {name: f"{value:08x}"}
    if name in DUTY_FIELDS:
        return {name.replace("duty", "duty_fraction"): value / DUTY_MAX}
    if name == "inputs":
        return {name: [input_name for bit, input_name in enumerate(m.INPUTS) if value >> bit & 1]}
    if name == "temperature_dc":
        return {"temperature_c": value / 10.0}
    if name == "reset_cause":
        return {name: describe_reset_cause(value)}
    if name == "firmware":
        return {name: f"{value >> 16}.{value & 0xFFFF}"}
    return {name: value}


def _describe_points(message: m.Data) -> dict[str, Any]:
    x, y, dark_us, on_us, duty = zip(*m.POINT.iter_unpack(message.points), strict=True)
    duty_fraction = [round(value / DUTY_MAX, 6) for value in duty]
    columns = {"x_code": x, "y_code": y, "dark_us": dark_us, "on_us": on_us}
    return {
        "points": len(x),
        **{name: list(values) for name, values in columns.items()},
        "duty_fraction": duty_fraction,
    }


def _describe_records(message: m.Executed) -> dict[str, Any]:
    on_tick, on_ticks, duty = zip(*message.records, strict=True)
    duty_fraction = [round(value / DUTY_MAX, 6) for value in duty]
    return {
        "records": len(on_tick),
        "on_tick": list(on_tick),
        "on_ticks": list(on_ticks),
        "duty_fraction": duty_fraction,
    }
