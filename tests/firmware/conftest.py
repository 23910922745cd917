"""What tests of the firmware share."""

import pytest


@pytest.fixture
def armed(board):
    """The test's board, armed by its human."""
    board.wiggle()
    assert board.command("A") == "k"
    return board
