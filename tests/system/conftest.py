import pytest

from board_fixtures import board, daemon, disarmed, kept, make_board, make_daemon, start  # noqa: F401 - fixtures
from engine_rig import RiggedEngine
from optodrive.device.config_file import load_config
from rig import config_text


@pytest.fixture
def engine(board, tmp_path):  # noqa: F811
    config = tmp_path / "engine.toml"
    config.write_text(config_text(board.port))
    engine = RiggedEngine(tmp_path, load_config(config), board.port)
    engine.start()
    yield engine
    engine.stop_all()


@pytest.fixture
def armed(engine):
    engine.arm().result()
    return engine
