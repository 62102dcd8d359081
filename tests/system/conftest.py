import pytest

from board_fixtures import board, daemon, disarmed, kept, make_board, make_daemon, start  # noqa: F401 - fixtures
from optodrive.core.clock import MonotonicClock
from optodrive.daemon.one_process.engine import Engine
from optodrive.device.config_file import load_config
from optodrive.link.transport.serial_port import SerialPort
from optodrive.planning.display_model import DisplayModel
from rig import config_text


@pytest.fixture
def engine(board, tmp_path):  # noqa: F811
    config = tmp_path / "engine.toml"
    config.write_text(config_text(board.port))
    display = DisplayModel.from_config(load_config(config))
    engine = Engine(display, SerialPort(str(board.port), display.config.board.baud), MonotonicClock())
    engine.start()
    yield engine
    engine.close()


@pytest.fixture
def armed(engine):
    engine.arm().result(10)
    return engine
