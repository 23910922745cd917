"""The Arduino's port, where nobody names it."""

import pytest

from rover_lib.onboard.car.ports import find_port, other_ports
from rover_lib.onboard.errors import RoverError


def test_the_only_one_is_found_and_the_provisioned_name_goes_first(tmp_path):
    by_id = tmp_path / "serial" / "by-id"
    by_id.mkdir(parents=True)
    (tmp_path / "ttyS0").touch()  # a computer's own port is nobody's Arduino
    with pytest.raises(RoverError, match="no Arduino is plugged in"):
        find_port(tmp_path)
    (tmp_path / "ttyACM0").touch()
    assert find_port(tmp_path) == str(tmp_path / "ttyACM0")
    (tmp_path / "ttyUSB0").touch()
    (by_id / "usb-1a86").symlink_to("../../ttyUSB0")
    with pytest.raises(RoverError, match=r"found \S+ttyACM0, \S+ttyUSB0 \(usb-1a86\); pass it: --port \S+ttyACM0"):
        find_port(tmp_path)
    (tmp_path / "rover-arduino").symlink_to("ttyUSB0")
    assert find_port(tmp_path) == str(tmp_path / "rover-arduino")


def test_of_two_that_are_alike_the_other_one_is_named(tmp_path):
    """Two CH340 have no serial number, and udev gives both the provisioned name."""
    (tmp_path / "ttyUSB0").touch()
    (tmp_path / "rover-arduino").symlink_to("ttyUSB0")
    assert other_ports(str(tmp_path / "rover-arduino"), tmp_path) == ""
    (tmp_path / "ttyUSB1").touch()
    assert other_ports(str(tmp_path / "rover-arduino"), tmp_path).startswith(
        f"{tmp_path}/ttyUSB0 was asked, and there is also {tmp_path}/ttyUSB1"
    )
