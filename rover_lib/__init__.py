"""Put a learned driving policy (LeRobot ACT) on a small computer.

Imports go one way: onboard <- workshop <- playground <- cli.
"""

__version__ = "0.1.0"
