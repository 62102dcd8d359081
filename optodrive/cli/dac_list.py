"""Text of `optodrive dac list`."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from optodrive.link.dac.discovery import FoundDac


def summarize_dacs(found: "list[FoundDac]") -> tuple[dict[str, Any], list[str]]:
    """Return the document and the lines on found DACs."""
    lines = [f"{dac.transport:<12} {dac.port:<16} {dac.name}: {dac.description}" for dac in found]
    return {"dacs": [asdict(dac) for dac in found]}, lines or ["no laser DAC found"]
