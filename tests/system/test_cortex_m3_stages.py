"""Two boards under one daemon: the firmware core on this computer, and on an emulated Cortex-M3.

The emulated chip keeps time only on a computer that is not overloaded.
"""

import pytest

from firmware_ports import build_board
from test_stages import (  # noqa: F401
    bench,
    test_the_loss_of_one_board_darkens_the_other_within_its_lease,
    test_two_boards_draw_a_frame_and_stop_together,
)


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("firmware")
    return [build_board(folder / port, port=port) for port in ("host", "mps2-an385")]
