"""Address of a board, as plain values."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class PortSettings:
    """Address of a board, of the fields of these names in its section of the configuration.

    transport: name of a transport; port: serial device; baud: its bit rate, 1/s
    vendor_id, product_id, serial_number: of a USB device; an empty serial number accepts the only device of its kind
    own_settings: the settings that a simulated board has by itself, by their name in its file of limits
    """

    transport: str
    port: str = ""
    baud: int = 1_000_000
    vendor_id: int | None = None
    product_id: int | None = None
    serial_number: str = ""
    own_settings: dict[str, int] = field(default_factory=dict)
