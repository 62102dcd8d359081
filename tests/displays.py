"""The shipped displays, resolved once for all tests."""

from optodrive.device.config import load_config, shipped_configs
from optodrive.planning.pipeline import Display

DISPLAYS = {name: Display.of(load_config(name)) for name in shipped_configs()}
