"""Discovery in a pixel: the term that no catalogue holds, found in a recording."""

from optodrive.lab.pixel_discovery.discover_pixel import discover_in_pixel
from optodrive.lab.pixel_discovery.findings import PixelDiscovery, PixelFinding

__all__ = ["PixelDiscovery", "PixelFinding", "discover_in_pixel"]
