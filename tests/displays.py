"""The shipped displays, resolved once for all tests."""

from optodrive.device.config_file import list_shipped_configs, load_config
from optodrive.planning.display_model import DisplayModel

DISPLAYS = {name: DisplayModel.from_config(load_config(name)) for name in list_shipped_configs()}
