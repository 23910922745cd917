"""The rover in LeRobot's own commands: robot `rover`, teleoperator `rover_transmitter`, policy `rover_artifact`.

LeRobot imports this package because of its distribution's name, and finds the classes by the names of their configs.
"""

from lerobot_robot_rover.configuration_rover_artifact import RoverArtifactConfig
from lerobot_robot_rover.rover import Rover, RoverConfig
from lerobot_robot_rover.rover_transmitter import RoverTransmitter, RoverTransmitterConfig

__all__ = ["Rover", "RoverArtifactConfig", "RoverConfig", "RoverTransmitter", "RoverTransmitterConfig"]
