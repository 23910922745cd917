"""The Arduino's port, where nobody names it."""

import pytest

from rover_lib.onboard.car.ports import find_port
from rover_lib.onboard.errors import RoverError


@pytest.fixture
def dev(tmp_path):
    by_id = tmp_path / "serial" / "by-id"
    by_id.mkdir(parents=True)
    (tmp_path / "ttyS0").touch()  # a computer's own port is nobody's Arduino
    return tmp_path


def test_the_only_one_is_found_and_the_provisioned_name_goes_first(dev):
    with pytest.raises(RoverError, match="no Arduino is plugged in, found no /dev/ttyACM"):
        find_port(dev)
    (dev / "ttyACM0").touch()
    assert find_port(dev) == str(dev / "ttyACM0")
    (dev / "ttyUSB0").touch()
    (dev / "serial" / "by-id" / "usb-1a86_USB_Serial-if00-port0").symlink_to("../../ttyUSB0")
    with pytest.raises(
        RoverError, match=r"which .* found \S+ttyACM0, \S+ttyUSB0 \(usb-1a86_USB\S+\); say it: --port \S+ttyACM0"
    ):
        find_port(dev)
    (dev / "rover-arduino").symlink_to("ttyUSB0")
    assert find_port(dev) == str(dev / "rover-arduino")
